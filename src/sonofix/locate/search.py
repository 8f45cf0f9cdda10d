"""All of one fix but its judgement, as kernels: from every start to every solution, and again without some rows.

Arrays have one layout throughout: ``rows``, ``index`` and states as `solve.misfit` takes them, one vehicle; rows that
err together share ``covariance`` (m, m), of ranges and then of rates.
"""

from __future__ import annotations

import numba
import numpy as np

from sonofix.geometry import expected
from sonofix.locate.dense import principal, whitener
from sonofix.locate.solve import alike, descend, misfit
from sonofix.locate.start import MOST_STARTS, begin

YAW_STARTS = 12
"""Headings looked at from each starting place."""

MOST = 2 * (MOST_STARTS + 1)
"""Solutions there may be: from each start and a mirror image, by two headings."""

STEPS = 50
"""Of one descent at most."""


@numba.njit(cache=True, error_model="numpy")
def search(rows, c, clock, covariance, index, flat, level_m, states, chi2s, jacobians):
    """Find solutions from all starts, best first, none twice.

    Parameters
    ----------
    flat : bool
        The level is known, as ``level_m``, which is not looked at otherwise.
    states, chi2s, jacobians : float64 (MOST, 10), (MOST,) and (MOST, m, k), out

    Returns
    -------
    int
        How many there are; −1 where the covariance is not positive.
    """
    ends, dt, measured = rows
    emitter_vehicle, emitter_point, _, receiver_point = ends
    n, m = len(dt), len(measured)
    whiten = np.empty((m, m))
    if not whitener(covariance, whiten):
        return -1
    anchors = np.empty((n, 3))
    for i in range(n):
        listening = emitter_vehicle[i] < 0
        for axis in range(3):
            anchors[i, axis] = emitter_point[i, axis] if listening else receiver_point[i, axis]
        anchors[i, 2] -= receiver_point[i, 2] if listening else emitter_point[i, 2]
    turns = False
    for j in range(len(index)):
        turns |= index[j] == 3
    begins, state, yaws = np.empty((MOST_STARTS + 1, 4)), np.empty(10), np.zeros(2)
    count, found = begin(anchors, measured[:n], flat, level_m, clock, begins), 0
    plain, miss, jacobian = np.empty(m), np.empty(m), np.empty((m, len(index)))
    for b in range(MOST_STARTS + 1):
        if b >= count and not (b == count and turns and found):
            break
        if b == count:
            # anchors nearly in one plane have nearly a mirror solution, which the linear start may have missed, or hit
            for axis in range(3):
                begins[b, axis] = states[0, axis]
            begins[b, 3] = states[0, 8]
            _mirror(begins[b], anchors, 2 if flat else 3)
        if turns:
            _yaws(rows, c, clock, whiten, begins[b], yaws)
        for k in range(2 if turns else 1):
            state[:] = 0.0
            for axis in range(3):
                state[axis] = begins[b, axis]
            state[3], state[8] = yaws[k], begins[b, 3]
            known = states[:found]
            chi2, rests = descend(rows, c, clock, whiten, index, known, STEPS, state, plain, miss, jacobian)
            if rests:
                found = _insert(states, chi2s, found, state, chi2)
    kept = 0
    for i in range(found):
        new = True
        for k in range(kept):
            new &= not alike(states[i], states[k], 0.01, 0.02)
        if new:
            for j in range(10):
                states[kept, j] = states[i, j]
            chi2s[kept] = misfit(rows, c, clock, whiten, index, states[kept], plain, miss, jacobians[kept])
            kept += 1
    return kept


@numba.njit(cache=True, error_model="numpy")
def _insert(states, chi2s, count, state, chi2):
    """Put a solution where its χ² belongs; return how many there are."""
    at = count
    while at > 0 and chi2s[at - 1] > chi2:
        chi2s[at] = chi2s[at - 1]
        for j in range(10):
            states[at, j] = states[at - 1, j]
        at -= 1
    chi2s[at] = chi2
    for j in range(10):
        states[at, j] = state[j]
    return count + 1


@numba.njit(cache=True, error_model="numpy")
def _mirror(place, anchors, dims):
    """Mirror a place in the plane (on a level: the line) that anchors are nearest to."""
    centre, axes, width = np.empty(3), np.empty((3, 3)), np.empty(3)
    principal(anchors, dims, centre, axes, width)
    off = 0.0
    for k in range(dims):
        off += (place[k] - centre[k]) * axes[dims - 1, k]
    for k in range(dims):
        place[k] -= 2 * off * axes[dims - 1, k]


@numba.njit(cache=True, error_model="numpy")
def _yaws(rows, c, clock, whiten, place, out):
    """Headings worth starting from at a place: the best of a round by ranges alone, and its best rival well away."""
    ends, dt, measured = rows
    n = len(dt)
    state, misfits, best = np.zeros(10), np.zeros(YAW_STARTS), 0
    state[0], state[1], state[2], state[8] = place[0], place[1], place[2], place[3]
    value, derivative = np.empty(n), np.empty((n, 10))
    for y in range(YAW_STARTS):
        state[3] = y * (2 * np.pi / YAW_STARTS)
        expected(ends, state, dt, c, clock, value, derivative)
        for i in range(n):
            miss = 0.0
            for k in range(i + 1):
                miss += whiten[i, k] * (measured[k] - value[k])
            misfits[y] += miss**2
        if misfits[y] < misfits[best]:
            best = y
    rival = -1
    for y in range(YAW_STARTS):
        apart = min(abs(y - best), YAW_STARTS - abs(y - best)) * (2 * np.pi / YAW_STARTS)
        if apart > 1.0 and (rival < 0 or misfits[y] < misfits[rival]):
            rival = y
    out[0], out[1] = best * (2 * np.pi / YAW_STARTS), rival * (2 * np.pi / YAW_STARTS)


@numba.njit(cache=True, error_model="numpy")
def without(rows, c, clock, covariance, index, choices, begin_at, states, chi2s, deviations):
    """Solve again with only some rows, from one state, for each of many choices.

    Parameters
    ----------
    choices : int64 (q, p)
        Rows to keep, each time.
    begin_at : float64 (10,)
    states, chi2s : float64 (q, 10) and (q,), out
    deviations : float64 (q,), out
        The largest of any unknown, the others taken as known.
    """
    ends, dt, measured = rows
    emitter_vehicle, emitter_point, receiver_vehicle, receiver_point = ends
    n, count = len(dt), choices.shape[1]
    m = len(measured) // n * count
    part, whiten, kept_measured, from_row = np.empty((m, m)), np.empty((m, m)), np.empty(m), np.empty(m, np.int64)
    plain, miss, jacobian = np.empty(m), np.empty(m), np.empty((m, len(index)))
    kept_ends = (
        np.empty(count, np.int64),
        np.empty((count, 3)),
        np.empty(count, np.int64),
        np.empty((count, 3)),
    )
    kept_dt, known = np.empty(count), np.empty((0, 10))
    for q in range(len(choices)):
        for i in range(m):
            from_row[i] = choices[q, i % count] + i // count * n
            kept_measured[i] = measured[from_row[i]]
        for i in range(m):
            for k in range(m):
                part[i, k] = covariance[from_row[i], from_row[k]]
        for i in range(count):
            row = choices[q, i]
            kept_ends[0][i], kept_ends[2][i], kept_dt[i] = emitter_vehicle[row], receiver_vehicle[row], dt[row]
            for axis in range(3):
                kept_ends[1][i, axis], kept_ends[3][i, axis] = emitter_point[row, axis], receiver_point[row, axis]
        whitener(part, whiten)
        for j in range(10):
            states[q, j] = begin_at[j]
        kept, at = (kept_ends, kept_dt, kept_measured), states[q]
        chi2s[q], _ = descend(kept, c, clock, whiten, index, known, STEPS, at, plain, miss, jacobian)
        deviations[q] = 0.0
        for j in range(len(index)):
            size = 0.0
            for i in range(m):
                size += jacobian[i, j] ** 2
            deviations[q] = max(deviations[q], 1.0 / max(np.sqrt(size), 1e-9))
