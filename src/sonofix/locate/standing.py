"""A position from ranges to fixed places, as kernels: the plain case of a fix, for `many`.

States are x, y, z and the clock's offset (4,).
"""

from __future__ import annotations

import numba
import numpy as np

from sonofix.locate.dense import factor, substitute
from sonofix.locate.search import FAR, STEPS, mirror
from sonofix.locate.start import MOST_STARTS, begin

MOST = MOST_STARTS + 1
"""Solutions there may be: from each start and a mirror image."""

TOO_FEW, OPEN_DIRECTION, INCONSISTENT, AMBIGUOUS, ONE_BY_ONE = 1, 2, 3, 4, 9
"""What is said of an epoch where not all is well, as `many.STATUSES` counts; the last: that `fix` shall judge it."""


@numba.njit(cache=True, error_model="numpy")
def misfit(anchors, measured, whiten, index, state, plain, jacobian):
    """Fill the whitened misfit (m,) and Jacobian (m, k) at a state; return χ².

    Parameters
    ----------
    whiten : float64 (m, m)
        Lower triangular.
    index : int64 (k,)
        Which of ``state`` are unknown.
    """
    m, count, chi2 = len(measured), len(index), 0.0
    unit = np.empty(4)
    unit[3] = 1.0
    # from the last row up: a row of the triangle takes those before it as they were
    for i in range(m):
        square = 0.0
        for axis in range(3):
            unit[axis] = state[axis] - anchors[i, axis]
            square += unit[axis] ** 2
        distance = np.sqrt(square)
        plain[i] = measured[i] - distance - state[3]
        for axis in range(3):
            unit[axis] /= max(distance, 1e-6)
        for j in range(count):
            jacobian[i, j] = unit[index[j]]
    for i in range(m - 1, -1, -1):
        w = whiten[i, i]
        plain[i] *= w
        for j in range(count):
            jacobian[i, j] *= w
        for k in range(i):
            w = whiten[i, k]
            if w != 0.0:
                plain[i] += w * plain[k]
                for j in range(count):
                    jacobian[i, j] += w * jacobian[k, j]
        chi2 += plain[i] ** 2
    return chi2


@numba.njit(cache=True, error_model="numpy")
def descend(anchors, measured, whiten, index, known, state, work):
    """Descend as `solve.descend` does, from ``state`` in place; return χ² and whether it came to rest, and anew.

    ``work``: two misfits (m,) and two Jacobians (m, k) to write in.
    """
    plain, new_plain, jacobian, new_jacobian = work
    m, count = len(measured), len(index)
    normal, step, tried = np.empty((count, count)), np.empty(count), np.empty(4)
    size = np.empty(count)
    chi2, damping, gained = misfit(anchors, measured, whiten, index, state, plain, jacobian), 1e-6, np.inf
    for _ in range(STEPS):
        for k in range(len(known)):
            if alike(state, known[k], 1e-3):
                return chi2, False
        for j in range(count):
            step[j] = 0.0
            for k in range(j + 1):
                normal[j, k] = 0.0
        for i in range(m):
            for j in range(count):
                step[j] += jacobian[i, j] * plain[i]
                for k in range(j + 1):
                    normal[j, k] += jacobian[i, j] * jacobian[i, k]
        for j in range(count):
            size[j] = np.sqrt(normal[j, j]) + 1e-300
        for j in range(count):
            step[j] /= size[j]
            for k in range(j + 1):
                # one after the other: where a direction is open, the square of its size is 0
                normal[j, k] = normal[j, k] / size[j] / size[k]
            normal[j, j] += damping
        downhill, new_chi2 = factor(normal), np.inf
        if downhill:
            substitute(normal, step)
            for j in range(4):
                tried[j] = state[j]
            for j in range(count):
                tried[index[j]] += step[j] / size[j]
            new_chi2 = misfit(anchors, measured, whiten, index, tried, new_plain, new_jacobian)
            downhill = not new_chi2 > chi2 * (1 + 1e-9) + 1e-12
        if not downhill:
            damping = 10 * max(damping, 1e-4)
            if damping > 1e8:
                break
            continue
        gained = chi2 - new_chi2
        chi2, damping = new_chi2, damping / 10
        plain, new_plain = new_plain, plain
        jacobian, new_jacobian = new_jacobian, jacobian
        longest = 0.0
        for j in range(4):
            state[j] = tried[j]
        for j in range(count):
            longest = max(longest, abs(step[j]))
        if longest < 1e-4:
            return chi2, True
    return chi2, gained < 1e-3


@numba.njit(cache=True, error_model="numpy")
def alike(a, b, within_m):
    """Whether two places are one."""
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2 < within_m**2


@numba.njit(cache=True, error_model="numpy")
def solutions(anchors, measured, whiten, known, work, states, chi2s):
    """Fill places (MOST, 4) that the ranges fit, best first, none twice, and their χ²; return how many."""
    flat, level_m, clock, index = known
    begins, found, creeping, least = np.empty((MOST, 4)), 0, 0, np.inf
    count = begin(anchors, measured, flat, level_m, clock, begins)
    for b in range(count + 1):
        if b == count:
            if not found:
                break
            begins[b] = states[0]
            if not mirror(begins[b], anchors, 2 if flat else 3):
                break
        chi2, rests = descend(anchors, measured, whiten, index, states[:found], begins[b], work)
        for s in range(found):
            rests &= not alike(begins[b], states[s], 0.01)
        if not rests:
            if FAR * len(measured) < chi2 < least:
                creeping, least = b, chi2
            continue
        at = found
        while at > 0 and chi2s[at - 1] > chi2:
            chi2s[at] = chi2s[at - 1]
            states[at] = states[at - 1]
            at -= 1
        chi2s[at] = chi2
        states[at] = begins[b]
        found += 1
    if not found and least < np.inf:
        states[0], chi2s[0] = begins[creeping], least
        return 1
    return found


@numba.njit(cache=True, error_model="numpy")
def choose(states, chi2s, found, judge, inflation):
    """Which solution holds, as `fix` tells mirror images apart; or, below 0, the negative of what to say of it."""
    _, alike_chi2, bounded, bounds = judge
    rivals, inside, chosen = 0, 0, 0
    for s in range(found):
        if s > 0 and chi2s[s] >= chi2s[0] + alike_chi2 * inflation:
            continue
        rivals += s > 0
        within = True
        for axis in range(3):
            within &= bounds[0, axis] - 0.1 <= states[s, axis] <= bounds[1, axis] + 0.1
        if within:
            inside += 1
            chosen = s
    if not rivals:
        return 0
    if bounded:
        return chosen if inside == 1 else -AMBIGUOUS
    above = np.hypot(states[1, 0] - states[0, 0], states[1, 1] - states[0, 1]) < 0.02
    return -ONE_BY_ONE if rivals == 1 and above else -AMBIGUOUS


@numba.njit(cache=True, error_model="numpy")
def too_weak(measured, state, covariance, places):
    """Whether the deviation is so large against the ranges that it means nothing, as `fix` has it."""
    nearest, widest = np.inf, 0.0
    for i in range(len(measured)):
        nearest = min(nearest, abs(measured[i] - state[3]))
    for j in range(places):
        widest = max(widest, covariance[j, j])
    return widest > (0.5 * max(nearest, 0.2)) ** 2
