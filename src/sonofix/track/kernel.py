"""What every filter here is made of: Joseph's form, one scalar measurement at a time by it, and noise that ages states.

Rows that share noise are whitened first (`locate.dense.whitener`); taken one by one they then give the very same result
as together, without a matrix to invert (Bierman 1977, section II.7).
"""

from __future__ import annotations

import numba
import numpy as np

from sonofix.records import Floats


def joseph(before: Floats, gain: Floats, derivative: Floats, noise: Floats) -> Floats:
    """Return a covariance (n, n) after measurements of ``derivative`` (m, n) and ``noise`` (m, m) entered by ``gain``.

    Joseph form (Bucy & Joseph 1968), exactly symmetric.
    """
    keep = np.eye(len(before)) - gain @ derivative
    after = keep @ before @ keep.T + gain @ noise @ gain.T
    return (after + after.T) / 2


@numba.njit(cache=True, error_model="numpy")
def stir(covariance, at, rate, density, dt):
    """Let state ``at`` and its ``rate`` be disturbed for ``dt``, in place, by white acceleration of a density.

    Bar-Shalom 2001, eq 6.2.2-12.
    """
    span = abs(dt)
    covariance[rate, rate] += density * span
    covariance[at, at] += density * span**3 / 3
    covariance[at, rate] += density * dt * span / 2
    covariance[rate, at] += density * dt * span / 2


@numba.njit(cache=True, error_model="numpy")
def fade(mean, covariance, at, left, variance):
    """Let a state fade, in place, to the share ``left``, while noise keeps its ``variance``.

    A first-order Gauss–Markov process (Gelb 1974, section 3.7).
    """
    mean[at] *= left
    for k in range(len(mean)):
        covariance[at, k] *= left
    for k in range(len(mean)):
        covariance[k, at] *= left
    covariance[at, at] += variance * (1.0 - left**2)


@numba.njit(cache=True, error_model="numpy")
def absorb(mean, covariance, row, miss, variance, work):
    """Correct a belief in place by one measurement.

    ``P' = (I − k hᵀ) P (I − k hᵀ)ᵀ + r k kᵀ`` with ``k = P h / (hᵀ P h + r)`` (Joseph form: Bucy & Joseph 1968),
    exactly symmetric.

    Parameters
    ----------
    mean, covariance : float64 (n,), (n, n), in and out
    row : float64 (n,)
        h, what the measurement answers to each state.
    miss : float
        Measured less expected at ``mean``.
    variance : float
        r, above 0.
    work : float64 (3, n)
        Room.

    Returns
    -------
    float
        Squared miss over the variance expected of it, given all before it: they sum up to the innovations' χ².
    """
    n = len(mean)
    total = variance
    for i in range(n):
        told = 0.0
        for j in range(n):
            told += covariance[i, j] * row[j]
        work[0, i] = told
        total += row[i] * told
    for i in range(n):
        gain = work[0, i] / total
        work[1, i] = gain
        mean[i] += gain * miss
        left = 0.0
        for j in range(n):
            covariance[i, j] -= gain * work[0, j]
            left += covariance[i, j] * row[j]
        work[2, i] = left
    for i in range(n):
        for j in range(i + 1):
            value = covariance[i, j] + (variance * work[1, i] - work[2, i]) * work[1, j]
            covariance[i, j] = value
            covariance[j, i] = value
    return miss**2 / total
