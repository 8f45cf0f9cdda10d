"""The gyro: how far a vehicle has turned since its row before, and what it learns of the gyro's bias.

Rates of turn are summed over `SUMMED_S`; the sum measures the difference of two headings, that now and that where the
sum began (the anchor), as odometry's arcs do. Between rows a rate holds until the next.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE, YAW
from sonofix.records import Floats
from sonofix.track.anchor import correct, free_turns, open_errors

BIAS_SD_RADPS = 0.02
"""Of the rate that is told at rest: a cheap gyro, uncalibrated."""

BIAS_PSD = 1e-9
"""In rad²/s³, how it wanders."""

NOISE_PSD = 1e-6
"""In rad²/s, of the heading summed up: 0.06 °/s/√Hz, several times what data sheets of cheap gyros state."""

SCALE_SD = 0.005
"""By what share of itself a turn is told wrongly, and by so much of it the axis that leans: no state of its own."""

SUMMED_S = 0.05
"""Rows closer than this are summed up."""

LONGEST_S = 0.5
"""A row that is followed by none for longer tells nothing."""

UNLIKELY = 40.0
"""Squared distance, over its variance, of a turn that is not believed."""


def begin(covariance: Floats, free: NDArray[np.bool_], slot: int) -> None:
    """Open a gyro's bias, in place, before anything is known of it."""
    open_errors(covariance, free, slot + 1, (BIAS_SD_RADPS,))


def wander(covariance: Floats, free: NDArray[np.bool_], vehicle: int, slot: int, dt: float) -> None:
    """Let a gyro's bias wander for ``dt``, in place, and its vehicle's turns be as free as rows may tell."""
    covariance[slot + 1, slot + 1] += BIAS_PSD * abs(dt)
    free_turns(covariance, free, vehicle, dt)


def take(
    mean: Floats,
    covariance: Floats,
    free: NDArray[np.bool_],
    vehicle: int,
    slot: int,
    turn_rad: float,
    dt: float,
) -> None:
    """Correct a belief by a turn that took ``dt``, in place, and put the anchor at its end.

    Without a heading to turn, without time, or with an empty cell or a gap, it tells nothing.
    """
    at = SIZE * vehicle + YAW
    if free[slot] and free[at] and np.isfinite(turn_rad) and 0.0 < dt <= LONGEST_S:
        derivative = np.zeros((1, len(mean)))
        derivative[0, at], derivative[0, slot], derivative[0, slot + 1] = 1.0, -1.0, dt
        miss = np.array([turn_rad - mean[slot + 1] * dt - (mean[at] - mean[slot])])
        noise = np.array([[NOISE_PSD * dt + (SCALE_SD * turn_rad) ** 2]])
        correct(mean, covariance, miss, derivative, noise, UNLIKELY)
    mean[slot], free[slot] = mean[at], free[at]
    covariance[slot, :] = covariance[at, :]
    covariance[:, slot] = covariance[:, at]


def summed(time_s: Floats, rate_radps: Floats) -> tuple[Floats, Floats, Floats]:
    """Sum rows of a gyro up.

    Parameters
    ----------
    time_s, rate_radps : float64 (n,)
        NaN where a cell is empty.

    Returns
    -------
    time_s, turn_rad, dt : float64 (m,)
        End of each sum, the turn since the one before and how long it took; NaN where a row of it was empty or a gap
        longer than `LONGEST_S`. The first tells nothing but where the next begins.
    """
    # a rate holds until the next row
    dt = np.diff(time_s)
    turn = np.where(dt <= LONGEST_S, rate_radps[:-1] * dt, np.nan)
    ends = [0]
    for i in range(1, len(time_s)):
        if time_s[i] - time_s[ends[-1]] >= SUMMED_S * (1 - 1e-9) or i == len(time_s) - 1:
            ends.append(i)
    at = np.array(ends)
    sums = np.add.reduceat(turn, at[:-1]) if len(at) > 1 else np.zeros(0)
    return time_s[at], np.append(np.nan, sums), np.append(np.nan, np.diff(time_s[at]))
