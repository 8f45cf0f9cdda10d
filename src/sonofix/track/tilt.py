"""How roll and pitch age: a body that tilts comes back upright, as what floats, flies or hangs does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import PITCH, PITCH_RATE, ROLL, ROLL_RATE, SIZE
from sonofix.records import Floats

PAIRS = ((ROLL, ROLL_RATE), (PITCH, PITCH_RATE))


def rock(mean: Floats, covariance: Floats, vehicle: int, sd_rad: float, pace_radps: float, dt: float) -> None:
    """Age a vehicle's roll and pitch by ``dt``, in place: critically damped second-order Gauss–Markov processes.

    With white angular acceleration driving them they keep the variance ``sd_rad``², and (``pace_radps`` sd_rad)² of
    their rates, however long nothing is heard (Gelb 1974, section 3.8); backwards in time alike, rates mirrored.
    """
    step, noise = step_of(sd_rad, pace_radps, dt)
    for pair in PAIRS:
        own = SIZE * vehicle + np.array(pair)
        mean[own] = step @ mean[own]
        covariance[own, :] = step @ covariance[own, :]
        covariance[:, own] = covariance[:, own] @ step.T
        covariance[np.ix_(own, own)] += noise


def step_of(sd_rad: float, pace_radps: float, dt: float) -> tuple[Floats, Floats]:
    """Return how an angle and its rate move within ``dt`` (2, 2), and the covariance that this adds (2, 2)."""
    span = abs(dt)
    turn, fade = pace_radps * span, np.exp(-pace_radps * span)
    step = fade * np.array([[1.0 + turn, dt], [-pace_radps * pace_radps * dt, 1.0 - turn]])
    settled = np.diag([sd_rad**2, (pace_radps * sd_rad) ** 2])
    return step, settled - step @ settled @ step.T


def open_tilt(covariance: Floats, free: NDArray[np.bool_], vehicle: int, sd_rad: float, pace_radps: float) -> None:
    """Begin to follow those of a vehicle's roll, pitch and their rates, in place, that nothing tells of yet."""
    for pair in PAIRS:
        for j, sd in zip(pair, (sd_rad, pace_radps * sd_rad), strict=True):
            at = SIZE * vehicle + j
            if not free[at]:
                covariance[at, at] = sd**2
                free[at] = True
