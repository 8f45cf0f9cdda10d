"""Mirror images that a set of ranges hardly tells from the place itself.

Beacons near one plane (near one line in plan, where the level is known) fit a mirror image behind it as well, or
almost: Gauss–Newton from that image finds how large the χ² of the best place there is, and the rules of `locate` say
whether a fix tells the two apart.
"""

from __future__ import annotations

import numba
import numpy as np

from sonofix.locate.fix import AMBIGUOUS_CHI2, FLAT_M

TWIN_M = 0.01
"""Two places nearer to each other than this are one."""

MIRROR_STEPS = 6
HOPELESS = 50.0
"""Times the χ² that is still alike: a mirror image that fits worse than this, linearly, is looked at no further."""


@numba.njit(cache=True, error_model="numpy")
def inverse(matrix, n, out):
    """Invert the (n, n) corner of ``matrix`` (its lower triangle) by Cholesky; say whether it has an inverse."""
    root, scale = np.zeros((5, 5)), np.zeros(5)
    for i in range(n):
        if not matrix[i, i] > 0.0:
            return False
        scale[i] = 1.0 / np.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = total / root[j, j]
            elif total > 1e-14:
                root[i, i] = np.sqrt(total)
            else:
                return False
    # inverse of the triangle, in place; then its product with its transpose
    for j in range(n):
        root[j, j] = 1.0 / root[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= root[i, k] * root[k, j]
            root[i, j] = total / root[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += root[k, i] * root[k, j]
            out[i, j] = out[j, i] = total * scale[i] * scale[j]
    return True


@numba.njit(cache=True, error_model="numpy")
def _normal(nodes, weight, count, flat, normal):
    """Find the direction in which the nodes heard spread least: off their plane, or off their line in plan."""
    middle, spread = np.zeros(3), np.zeros((3, 3))
    for b in range(len(nodes)):
        if weight[b] > 0.0:
            for i in range(3):
                middle[i] += nodes[b, i] / count
    for b in range(len(nodes)):
        if weight[b] > 0.0:
            for i in range(3):
                for j in range(3):
                    spread[i, j] += (nodes[b, i] - middle[i]) * (nodes[b, j] - middle[j])
    normal[:] = 0.0
    if flat:
        angle = 0.5 * np.arctan2(2.0 * spread[0, 1], spread[0, 0] - spread[1, 1])
        normal[0], normal[1] = -np.sin(angle), np.cos(angle)
        return middle
    # powers of the adjugate turn towards the least spread; with all nodes on one plane it is that normal already
    adjugate = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            adjugate[i, j] = spread[a, c] * spread[b, d] - spread[a, d] * spread[b, c]
    for _ in range(4):
        size = np.abs(adjugate).max()
        if not size > 0.0:
            return middle
        adjugate /= size
        squared = np.zeros((3, 3))
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    squared[i, j] += adjugate[i, k] * adjugate[k, j]
        adjugate = squared
    column = 0
    for i in range(1, 3):
        if adjugate[i, i] > adjugate[column, column]:
            column = i
    length = np.sqrt(adjugate[0, column] ** 2 + adjugate[1, column] ** 2 + adjugate[2, column] ** 2)
    if length > 0.0:
        for i in range(3):
            normal[i] = adjugate[i, column] / length
    return middle


@numba.njit(cache=True, error_model="numpy")
def _twin(place, nodes, weight, count, unknown, twin):
    """Walk from the place's mirror image to where it fits best; return the χ² there, large where that is no rival."""
    dims, clock, speed_sd = unknown
    moving = dims + (1 if clock else 0)
    states = moving + (1 if speed_sd > 0.0 else 0)
    normal = np.zeros(3)
    middle = _normal(nodes, weight, count, dims == 2, normal)
    off = 0.0
    for i in range(3):
        off += (place[i] - middle[i]) * normal[i]
    for i in range(3):
        twin[i] = place[i] - 2.0 * off * normal[i]
    if abs(off) < TWIN_M / 2.0:
        return np.inf
    offset = excess = 0.0
    matrix, covariance = np.zeros((5, 5)), np.zeros((5, 5))
    pull, g = np.zeros(5), np.zeros(5)
    chi2 = np.inf
    for _ in range(MIRROR_STEPS):
        matrix[:], pull[:], chi2 = 0.0, 0.0, 0.0
        for b in range(len(nodes)):
            w = weight[b]
            if w <= 0.0:
                continue
            true = there = 0.0
            for i in range(3):
                true += (place[i] - nodes[b, i]) ** 2
                there += (twin[i] - nodes[b, i]) ** 2
            true, there = np.sqrt(true), np.sqrt(there)
            for i in range(dims):
                g[i] = (twin[i] - nodes[b, i]) / there if there > 0.0 else 0.0
            if clock:
                g[dims] = 1.0
            if speed_sd > 0.0:
                g[moving] = there
            residual = true - there - offset - excess * there
            chi2 += w * residual**2
            for i in range(states):
                pull[i] += w * g[i] * residual
                for j in range(i + 1):
                    matrix[i, j] += w * g[i] * g[j]
        if speed_sd > 0.0:
            chi2 += (excess / speed_sd) ** 2
            pull[moving] -= excess / speed_sd**2
            matrix[moving, moving] += 1.0 / speed_sd**2
        if not inverse(matrix, states, covariance):
            return chi2
        longest = 0.0
        for i in range(states):
            step = 0.0
            for j in range(states):
                step += covariance[i, j] * pull[j]
            chi2 -= step * pull[i]
            if i < dims:
                twin[i] += step
                longest = max(longest, abs(step))
            elif clock and i == dims:
                offset += step
            else:
                excess += step
        if chi2 > HOPELESS * AMBIGUOUS_CHI2 or longest < 1e-4:
            break
    return chi2


@numba.njit(cache=True, error_model="numpy")
def undecided(place, nodes, weight, count, unknown, box):
    """Whether a mirror image fits alike and nothing rules it out; else half the height by which it lies above.

    As `locate.fix` judges: with a room, exactly one of the two must lie in it (give or take 0.1 m); without, two just
    above each other whose middle fits all ranges are one place of an open height.
    """
    twin = np.zeros(3)
    if _twin(place, nodes, weight, count, unknown, twin) >= AMBIGUOUS_CHI2:
        return False, 0.0
    apart = np.sqrt((twin[0] - place[0]) ** 2 + (twin[1] - place[1]) ** 2)
    half = (twin[2] - place[2]) / 2.0
    if apart**2 + 4.0 * half**2 < TWIN_M**2:
        return False, 0.0
    if not np.isnan(box[0, 0]):
        here = there = True
        for i in range(3):
            here &= box[0, i] - 0.1 <= place[i] <= box[1, i] + 0.1
            there &= box[0, i] - 0.1 <= twin[i] <= box[1, i] + 0.1
        return there or not here, 0.0
    if apart >= 0.02:
        return True, 0.0
    ranges, deviations, k = np.zeros(count), np.zeros(count), 0
    for b in range(len(nodes)):
        if weight[b] > 0.0:
            for i in range(3):
                ranges[k] += (place[i] - nodes[b, i]) ** 2
            ranges[k], deviations[k] = np.sqrt(ranges[k]), 1.0 / np.sqrt(weight[b])
            k += 1
    close = half**2 / (2.0 * np.median(ranges)) < max(FLAT_M, np.median(deviations))
    return not close, half if close else 0.0
