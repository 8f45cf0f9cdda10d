"""What steps and odometry share: an anchor where the last row ended, its correction, and freer motion between rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE, YAW
from sonofix.records import Floats
from sonofix.track.kernel import joseph, stir

AGILE_TURN_PSD = 20.0
"""White angular acceleration in rad²/s³ that a vehicle whose turns a sensor tells adds to that of others: it turns on
the spot, and rows tell."""


def lift(mean: Floats, covariance: Floats, free: NDArray[np.bool_], slot: int, size: int) -> None:
    """Take an anchor of ``size`` states away, in place: it is not known on this track. ``slot`` −1: nothing."""
    if slot < 0:
        return
    own = slice(slot, slot + size)
    mean[own] = 0.0
    covariance[own, :] = covariance[:, own] = 0.0
    free[own] = False


def open_errors(covariance: Floats, free: NDArray[np.bool_], slot: int, sds: tuple[float, ...]) -> None:
    """Open errors of a sensor from state ``slot`` on, in place, before anything but their deviations is known."""
    for i, sd in enumerate(sds, start=slot):
        covariance[i, i] = sd**2
        free[i] = True


def free_turns(covariance: Floats, free: NDArray[np.bool_], vehicle: int, dt: float) -> None:
    """Let a vehicle whose heading is followed turn for ``dt``, in place, as freely as rows of a sensor may tell."""
    at = SIZE * vehicle + YAW
    if free[at]:
        stir(covariance, at, at + 4, AGILE_TURN_PSD, dt)


def correct(mean: Floats, covariance: Floats, miss: Floats, derivative: Floats, noise: Floats, unlikely: float) -> None:
    """Correct a belief in place: an extended Kalman update in Joseph form.

    What misses by more than ``unlikely``, squared and over its variance, is left out.
    """
    crossed = derivative @ covariance
    expected = crossed @ derivative.T + noise
    if miss @ np.linalg.solve(expected, miss) > unlikely:
        return
    gain = np.linalg.solve(expected, crossed).T
    mean += gain @ miss
    covariance[:] = joseph(covariance, gain, derivative, noise)
