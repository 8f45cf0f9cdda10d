"""All of one fix but its judgement, as kernels: from every start to every solution, and again without some rows.

Arrays have one layout throughout: ``rows``, ``index`` and states as `solve.misfit` takes them, one vehicle; rows that
err together share ``covariance`` (m, m), of ranges and then of rates.
"""

from __future__ import annotations

import numba
import numpy as np

from sonofix.geometry import expected
from sonofix.locate.dense import principal, spread, whitener
from sonofix.locate.solve import alike, descend, misfit
from sonofix.locate.start import MOST_STARTS, begin

YAW_STARTS = 12
"""Headings looked at from each starting place."""

MOST = 2 * (MOST_STARTS + 1)
"""Solutions there may be: from each start and a mirror image, by two headings."""

NEARLY_FLAT = 0.3
"""Anchors that spread less across than this share of their widest spread may have nearly a mirror solution."""

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
        if b > count or (b == count and not found):
            break
        if b == count:
            # anchors nearly in one plane have nearly a mirror solution, which the linear start may have missed, or hit
            for axis in range(3):
                begins[b, axis] = states[0, axis]
            begins[b, 3] = states[0, 8]
            if not mirror(begins[b], anchors, 2 if flat else 3) and not turns:
                break
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
def mirror(place, anchors, dims):
    """Mirror a place in the plane (on a level: the line) that anchors are nearest to; whether they are near at all."""
    centre, axes, width = np.empty(3), np.empty((3, 3)), np.empty(3)
    principal(anchors, dims, centre, axes, width)
    off = 0.0
    for k in range(dims):
        off += (place[k] - centre[k]) * axes[dims - 1, k]
    for k in range(dims):
        place[k] -= 2 * off * axes[dims - 1, k]
    return width[dims - 1] < NEARLY_FLAT * width[0]


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
def without(rows, c, clock, covariance, index, choices, begin_at, states, chi2s):
    """Solve again with only some rows, from one state, for each of many choices.

    Parameters
    ----------
    choices : int64 (q, p)
        Rows to keep, each time.
    begin_at : float64 (10,)
    states, chi2s : float64 (q, 10) and (q,), out
    """
    count, m = choices.shape[1], len(rows[2]) // len(rows[1]) * choices.shape[1]
    part, whiten = np.empty((m, m)), np.empty((m, m))
    plain, miss, jacobian = np.empty(m), np.empty(m), np.empty((m, len(index)))
    kept, known = room(count, m), np.empty((0, 10))
    for q in range(len(choices)):
        keep(rows, covariance, choices[q], kept, part)
        whitener(part, whiten)
        for j in range(10):
            states[q, j] = begin_at[j]
        chi2s[q], _ = descend(kept, c, clock, whiten, index, known, STEPS, states[q], plain, miss, jacobian)


@numba.njit(cache=True, error_model="numpy")
def room(count, m):
    """Return empty rows for `keep` to fill: so many ends, and m measurements of them."""
    ends = (np.empty(count, np.int64), np.empty((count, 3)), np.empty(count, np.int64), np.empty((count, 3)))
    return ends, np.empty(count), np.empty(m)


@numba.njit(cache=True, error_model="numpy")
def keep(rows, covariance, choice, kept, part):
    """Fill ``kept`` and ``part`` (m, m) with some of the rows and their covariance."""
    ends, dt, measured = rows
    kept_ends, kept_dt, kept_measured = kept
    n, count = len(dt), len(choice)
    for i in range(len(kept_measured)):
        a = choice[i % count] + i // count * n
        kept_measured[i] = measured[a]
        for k in range(len(kept_measured)):
            part[i, k] = covariance[a, choice[k % count] + k // count * n]
    for i in range(count):
        row = choice[i]
        kept_ends[0][i], kept_ends[2][i], kept_dt[i] = ends[0][row], ends[2][row], dt[row]
        for axis in range(3):
            kept_ends[1][i, axis], kept_ends[3][i, axis] = ends[1][row, axis], ends[3][row, axis]


@numba.njit(cache=True, error_model="numpy")
def rivals(rows, c, clock, covariance, index, flat, level_m, kept, best, limit, reach, bend_m2, bounds_m, away):
    """Fill ``away`` (4,): how far, level and in height, places may be that rows less any one of ``kept`` allow.

    The first two are of other solutions, the last two of the same one where it is so loose that ranges bend within its
    reach (solution separation); infinite where a solution leaves a direction open.

    Parameters
    ----------
    kept : int64 (p,)
    best : float64 (10,)
        The solution of them all.
    limit : float
        χ² up to which another is allowed.
    reach : float
        How many of its deviations a place may be farther.
    bend_m2 : float
        Squared reach within which ranges are straight.
    bounds_m : float64 (2, 3)
        Solutions outside are none; infinite where no room is known.
    """
    count, m = len(kept) - 1, len(rows[2]) // len(rows[1]) * (len(kept) - 1)
    part, fewer, choice = np.empty((m, m)), room(count, m), np.empty(count, np.int64)
    states, chi2s, jacobians = np.empty((MOST, 10)), np.empty(MOST), np.empty((MOST, m, len(index)))
    deviation, sd = np.empty((len(index), len(index))), np.empty(3)
    away[:] = 0.0
    for left_out in range(len(kept)):
        for i in range(count):
            choice[i] = kept[i + (i >= left_out)]
        keep(rows, covariance, choice, fewer, part)
        found = search(fewer, c, clock, part, index, flat, level_m, states, chi2s, jacobians)
        own, nearest = -1, np.inf
        for s in range(found):
            square = 0.0
            for axis in range(3):
                square += (states[s, axis] - best[axis]) ** 2
            if square < nearest:
                own, nearest = s, square
        for s in range(found):
            inside = chi2s[s] <= limit
            for axis in range(3):
                inside &= bounds_m[0, axis] - 0.1 <= states[s, axis] <= bounds_m[1, axis] + 0.1
            if inside and spread(jacobians[s], deviation):
                for axis in range(3):
                    sd[axis] = 0.0
                    for j in range(len(index)):
                        if index[j] == axis:
                            sd[axis] = np.sqrt(deviation[j, j])
                wide, high = reach * np.hypot(sd[0], sd[1]), reach * sd[2]
                k = 0
                if s == own:
                    if wide**2 + high**2 < bend_m2:
                        continue
                    k = 2
                far = np.hypot(states[s, 0] - best[0], states[s, 1] - best[1])
                away[k] = max(away[k], far + wide)
                away[k + 1] = max(away[k + 1], abs(states[s, 2] - best[2]) + high)
            elif inside:
                away[:] = np.inf
