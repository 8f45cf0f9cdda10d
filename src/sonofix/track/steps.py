"""Step-and-heading: how steps carry a walker's position, and what they learn of their own errors.

A step is told at its end: the chord walked since the step before. So the state keeps where the step before ended (the
anchor), and a step measures the difference of the two places. Between steps the walker moves as any vehicle does, and
after each the position is as certain as the anchor and the chord are, however freely it may have moved meanwhile.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE
from sonofix.records import Floats
from sonofix.track.anchor import correct, open_errors
from sonofix.track.kernel import fade, stir

LENGTH_SD = 0.05 / 0.6
"""Of the slow error of step length, as a share of it: 5 cm of a step of 60 cm."""

HEADING_SD_RAD = float(np.radians(2.0))
"""Of the slow error of heading."""

CORRELATED_S = 20.0
"""Both are first-order Gauss–Markov processes of this correlation time."""

STEP_SD_M = 0.005
"""What each step's length and place across are off by on their own."""

AGILE_PSD = 0.5
"""White acceleration in m²/s³ that a walker adds to that of vehicles: he turns a corner within a step."""

UNLIKELY = 40.0
"""Squared distance, over its variance, of a step that is not believed: noise alone comes there once in 10⁸ steps."""


def begin(covariance: Floats, free: NDArray[np.bool_], slot: int) -> None:
    """Open a walker's step errors, in place, before anything is known of them."""
    open_errors(covariance, free, slot + 2, (LENGTH_SD, HEADING_SD_RAD))


def wander(mean: Floats, covariance: Floats, vehicle: int, slot: int, dt: float, placed: bool) -> None:
    """Let a walker's step errors age by ``dt`` in place, and his velocity be as free as a walker's.

    The errors fade towards zero with `CORRELATED_S` while noise keeps their variance (Gelb 1974, section 3.7).
    """
    left = float(np.exp(-abs(dt) / CORRELATED_S))
    for i, sd in ((slot + 2, LENGTH_SD), (slot + 3, HEADING_SD_RAD)):
        fade(mean, covariance, i, left, sd**2)
    if not placed:
        return
    for at in (SIZE * vehicle, SIZE * vehicle + 1):
        stir(covariance, at, at + 4, AGILE_PSD, dt)


def take(
    mean: Floats,
    covariance: Floats,
    free: NDArray[np.bool_],
    vehicle: int,
    slot: int,
    length_m: float,
    heading_rad: float,
    about: Floats | None = None,
) -> None:
    """Correct a belief at a step's end, in place, and put the anchor there: the next step begins.

    A step without an anchor, or with an empty cell, tells only that. The step is linearised at ``about``, or else at
    the mean.
    """
    if free[slot] and np.isfinite(length_m) and np.isfinite(heading_rad):
        about = mean if about is None else about
        miss, derivative, noise = measure(about, vehicle, slot, length_m, heading_rad)
        correct(mean, covariance, miss - derivative @ (mean - about), derivative, noise, UNLIKELY)
    at = SIZE * vehicle
    mean[slot : slot + 2] = mean[at : at + 2]
    covariance[slot : slot + 2, :] = covariance[at : at + 2, :]
    covariance[:, slot : slot + 2] = covariance[:, at : at + 2]
    free[slot : slot + 2] = True


def measure(
    about: Floats, vehicle: int, slot: int, length_m: float, heading_rad: float
) -> tuple[Floats, Floats, Floats]:
    """Return by how much a step misses a state (2,), what it measures there, and its covariance.

    With a the anchor and k and ψ the errors of length and heading, p − a = (1 − k) L u(h − ψ).
    """
    at = SIZE * vehicle
    length = length_m * (1.0 - about[slot + 2])
    cos, sin = np.cos(heading_rad - about[slot + 3]), np.sin(heading_rad - about[slot + 3])
    along, across = np.array([cos, sin]), np.array([-sin, cos])
    miss = length * along - (about[at : at + 2] - about[slot : slot + 2])
    derivative = np.zeros((2, len(about)))
    derivative[0, at] = derivative[1, at + 1] = 1.0
    derivative[0, slot] = derivative[1, slot + 1] = -1.0
    derivative[:, slot + 2] = length_m * along
    derivative[:, slot + 3] = length * across
    return miss, derivative, STEP_SD_M**2 * np.eye(2)
