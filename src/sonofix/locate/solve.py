"""Gauss–Newton with Levenberg damping on ranges and range rates, each at its own moment (the first seed's eq 7)."""

from __future__ import annotations

import numba
import numpy as np

from sonofix.geometry import ALONE, PITCH, ROLL, SIZE, YAW, expected
from sonofix.locate.dense import factor, substitute

UNUSUAL = 3.0
"""Deviations that a tilt counts for at most."""

SAME = 1e-3
"""A descent that comes within so many metres and radians of where an earlier one came to rest ends there."""


@numba.njit(cache=True, error_model="numpy")
def beforehand(index):
    """How many unknowns are roughly known before anything is heard: angles of tilt and their rates.

    Each has a row of its own behind those measured, which says that it is 0 with its deviation. What is many of these
    off is as unlikely as what is `UNUSUAL`: that a body leans over is no fault of a range.
    """
    count = 0
    for j in index:
        if ROLL <= j < SIZE:
            count += 1
    return count


@numba.njit(cache=True, error_model="numpy")
def misfit(rows, c, clock, whiten, index, state, plain, miss, jacobian):
    """Fill misfit and Jacobian at a state; return χ².

    Parameters
    ----------
    rows : tuple
        ``ends`` as `geometry.expected` takes them, ``dt`` (n,), and what was measured (m,): ranges, then rates if any,
        then 0 for each of `beforehand`.
    whiten : float64 (m, m)
        Lower triangular.
    index : int64 (k,)
        Which of ``state`` are unknown.
    state : float64 (ALONE,)
        One vehicle's pose, then clock offset and drift.
    plain, miss : float64 (m,), out
        Measured less expected, and the same whitened.
    jacobian : float64 (m, k), out
        Whitened derivative of what is expected.
    """
    ends, dt, measured = rows
    m = len(measured)
    derivative = np.empty((m, ALONE))
    known = beforehand(index)
    last = m - known
    expected(ends, state, dt, c, clock, known > 0, plain[:last], derivative[:last])
    for j in index:
        if ROLL <= j < SIZE:
            most = UNUSUAL / whiten[last, last]
            share = np.tanh(state[j] / most)
            plain[last] = most * share
            derivative[last] = 0.0
            derivative[last, j] = 1.0 - share**2
            last += 1
    chi2 = 0.0
    for i in range(m):
        plain[i] = measured[i] - plain[i]
        miss[i] = 0.0
        for j in range(len(index)):
            jacobian[i, j] = 0.0
        for k in range(i + 1):
            w = whiten[i, k]
            if w != 0.0:
                miss[i] += w * plain[k]
                for j in range(len(index)):
                    jacobian[i, j] += w * derivative[k, index[j]]
        chi2 += miss[i] ** 2
    return chi2


@numba.njit(cache=True, error_model="numpy")
def alike(a, b, place_m, turn_rad):
    """Whether two states are one within so much."""
    square = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
    if not square < place_m**2:
        return False
    for j in (YAW, ROLL, PITCH):
        turn = a[j] - b[j]
        turn -= 2 * np.pi * np.floor(turn / (2 * np.pi) + 0.5)
        if not abs(turn) < turn_rad:
            return False
    return True


@numba.njit(cache=True, error_model="numpy")
def descend(rows, c, clock, whiten, index, known, iterations, state, plain, miss, jacobian):
    """Descend from ``state``, in place, until the step is far below the deviation of what is solved for.

    Arguments as of `misfit`; ``known`` (q, ALONE) are states found earlier. Returns χ² and whether it came to rest, and
    not where one is known.
    """
    m, count = len(miss), len(index)
    chi2 = misfit(rows, c, clock, whiten, index, state, plain, miss, jacobian)
    new_plain, new_miss, new_jacobian = np.empty(m), np.empty(m), np.empty((m, count))
    normal, step, size = np.empty((count, count)), np.empty(count), np.empty(count)
    tried = np.empty(ALONE)
    damping, gained, new_chi2 = 1e-6, np.inf, np.inf
    for _ in range(iterations):
        for k in range(len(known)):
            if alike(state, known[k], SAME, SAME):
                return chi2, False
        size[:] = 0.0
        step[:] = 0.0
        normal[:] = 0.0
        for i in range(m):
            for j in range(count):
                step[j] += jacobian[i, j] * miss[i]
                for k in range(j + 1):
                    normal[j, k] += jacobian[i, j] * jacobian[i, k]
        for j in range(count):
            size[j] = np.sqrt(normal[j, j]) + 1e-300
        for j in range(count):
            step[j] /= size[j]
            for k in range(j + 1):
                normal[j, k] = normal[j, k] / size[j] / size[k]
            normal[j, j] += damping
        downhill = factor(normal)
        if downhill:
            substitute(normal, step)
            for j in range(ALONE):
                tried[j] = state[j]
            for j in range(count):
                tried[index[j]] += step[j] / size[j]
            new_chi2 = misfit(rows, c, clock, whiten, index, tried, new_plain, new_miss, new_jacobian)
            downhill = not new_chi2 > chi2 * (1 + 1e-9) + 1e-12
        if not downhill:
            damping = 10 * max(damping, 1e-4)
            if damping > 1e8:
                break
            continue
        gained = chi2 - new_chi2
        chi2, damping = new_chi2, damping / 10
        for j in range(ALONE):
            state[j] = tried[j]
        for i in range(m):
            plain[i], miss[i] = new_plain[i], new_miss[i]
            for j in range(count):
                jacobian[i, j] = new_jacobian[i, j]
        longest = 0.0
        for j in range(count):
            longest = max(longest, abs(step[j]))
        if longest < 1e-4:
            return chi2, True
    # beside a beacon the range has a kink: steps zigzag over it long after nothing is gained any more
    return chi2, gained < 1e-3
