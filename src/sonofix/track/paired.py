"""Biases of pairs in our own ranges, as far as the site file leaves them open: one constant each, for the whole run.

`bias_sd_m` of a pair is one error, the same in every epoch. Taken for noise, it would be averaged away as epochs come
in; a state whose deviation begins there holds on to it, and shrinks only as far as ranges really tell of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats


def begin(covariance: Floats, free: NDArray[np.bool_], slot: int, known_sd_m: Floats) -> None:
    """Open biases of deviations ``known_sd_m`` (P,), in place; what is known of them was taken off the ranges."""
    at = np.arange(slot, slot + len(known_sd_m))
    covariance[at, at] = known_sd_m**2
    free[at] = True


def show(mean: Floats, slot: int, pair: NDArray[np.int64], shown: Floats, derivative: Floats) -> tuple[Floats, Floats]:
    """Return what rows would show, and its derivative, once biases are added to what geometry says.

    Parameters
    ----------
    pair : int (n,)
        Number of each row's pair; -1: its bias is known.
    shown, derivative : float64 (n,), (n, states)
        Or twice as many rows: range rates, which no constant touches.
    """
    rows = np.flatnonzero(pair >= 0)
    shown, derivative = shown.copy(), derivative.copy()
    shown[rows] += mean[slot + pair[rows]]
    derivative[rows, slot + pair[rows]] = 1.0
    return shown, derivative
