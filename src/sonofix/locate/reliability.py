"""Baarda's reliability as kernels: what a bias in some rows does to unknowns and to residuals (`integrity`)."""

from __future__ import annotations

import numba
import numpy as np

from sonofix.locate.dense import OPEN, orthogonalise

BLIND = 1e-9
"""A bias that leaves less than this share of its square in the residuals cannot be noticed."""


@numba.njit(cache=True, error_model="numpy")
def parts(white, whiten):
    """Return A (k, m), P (m, m), the diagonal of W (m,), and how many unknowns the rows tell of.

    A is only of use where that is all of them.
    """
    m, count = white.shape
    q, r, size = np.empty((m, count)), np.empty((count, count)), np.zeros(count)
    for j in range(count):
        for i in range(m):
            size[j] += white[i, j] ** 2
        size[j] = np.sqrt(size[j]) + 1e-300
        for i in range(m):
            q[i, j] = white[i, j] / size[j]
    orthogonalise(q, r)
    rank = 0
    for j in range(count):
        if r[j, j] >= OPEN:
            rank += 1
        else:
            q[:, j] = 0.0
            r[j, j] = 1.0
    along, gain = np.zeros((count, m)), np.zeros((count, m))
    seen, weight = np.zeros((m, m)), np.zeros(m)
    for j in range(count):
        for i in range(m):
            for k in range(i, m):
                along[j, i] += q[k, j] * whiten[k, i]
    for j in range(count - 1, -1, -1):
        for i in range(m):
            rest = along[j, i]
            for k in range(j + 1, count):
                rest -= r[j, k] * gain[k, i]
            gain[j, i] = rest / r[j, j]
    left = whiten.copy()
    for i in range(m):
        for k in range(m):
            weight[i] += whiten[k, i] ** 2
            for j in range(count):
                left[k, i] -= q[k, j] * along[j, i]
    for i in range(m):
        for k in range(i + 1):
            for row in range(m):
                seen[i, k] += left[row, i] * left[row, k]
            seen[k, i] = seen[i, k]
    for j in range(count):
        for i in range(m):
            gain[j, i] /= size[j]
    return gain, seen, weight, rank


@numba.njit(cache=True, error_model="numpy")
def steepest(gain, seen, size, sets, states):
    """Largest slope of any set of rows: root of the largest eigenvalue of A P⁻¹ Aᵀ; inf where one does not show."""
    g, n, worst = sets.shape[1], len(states), 0.0
    lower, reach = np.empty((g, g)), np.empty((n, g))
    for h in range(len(sets)):
        for i in range(g):
            a = sets[h, i]
            for j in range(i + 1):
                b = sets[h, j]
                rest = seen[a, b] / np.sqrt(size[a] * size[b])
                for k in range(j):
                    rest -= lower[i, k] * lower[j, k]
                if j < i:
                    lower[i, j] = rest / lower[j, j]
                elif rest > BLIND:
                    lower[i, i] = np.sqrt(rest)
                else:
                    return np.inf
            for s in range(n):
                rest = gain[states[s], a] / np.sqrt(size[a])
                for k in range(i):
                    rest -= lower[i, k] * reach[s, k]
                reach[s, i] = rest / lower[i, i]
        worst = max(worst, largest(reach @ reach.T, np.arange(n)))
    return worst


@numba.njit(cache=True, error_model="numpy")
def largest(square, states):
    """Root of the largest eigenvalue of one or two rows and columns of a symmetric matrix."""
    if len(states) == 1:
        return np.sqrt(max(square[states[0], states[0]], 0.0))
    a, b = square[states[0], states[0]], square[states[1], states[1]]
    return np.sqrt(max((a + b) / 2 + np.hypot((a - b) / 2, square[states[0], states[1]]), 0.0))
