"""All of one fix but its judgement, as kernels: from every start to every solution, and again without some rows.

Arrays have one layout throughout: ``rows``, ``index`` and states as `solve.misfit` takes them, one vehicle; rows that
err together share ``covariance`` (m, m), of ranges and then of rates.
"""

from __future__ import annotations

import numba
import numpy as np

from sonofix.geometry import ALONE, CLOCK, PITCH, PITCH_RATE, ROLL, YAW, expected
from sonofix.locate.dense import principal, spread, whitener
from sonofix.locate.solve import alike, beforehand, descend, misfit
from sonofix.locate.start import MOST_STARTS, begin

YAW_STARTS = 12
"""Headings looked at from each starting place."""

LEAN_STARTS, LEAN_RAD = 6, 0.7
"""Ways that a body which tilts is tried leant over, and how far."""

MOST = (2 + LEAN_STARTS) * (MOST_STARTS + 1) + LEAN_STARTS
"""Solutions there may be: from each start and a mirror image, by two headings and leant over; and so from the best."""

REDUNDANT = 3
"""A body that tilts has one attitude that fits where rows are so many times the unknowns; else others are sought."""

NEARLY_FLAT = 0.3
"""Anchors that spread less across than this share of their widest spread may have nearly a mirror solution."""

STEPS = 50
"""Of one descent at most."""

FAR = 100.0
"""χ² a row beyond which the end of a descent that never rests is a solution, where there is no other.

With a row off by metres Gauss–Newton creeps for ever: misfits times the ranges' curvature outweigh their slopes. Rows
are left out from there; where that does not mend it, there is no position.
"""


AT_REST = 0.01
"""χ², in units of what a degree of freedom has, by which a solution at rest falls at most when descended further."""


@numba.njit(cache=True, error_model="numpy")
def search(rows, c, clock, covariance, index, flat, level_m, states, chi2s, jacobians):
    """Find solutions from all starts, best first, none twice.

    Parameters
    ----------
    flat : bool
        The level is known, as ``level_m``, which is not looked at otherwise.
    states, chi2s, jacobians : float64 (MOST, ALONE), (MOST,) and (MOST, m, k), out

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
    turns, tilts = np.any(index == YAW), beforehand(index) > 0
    begins, state, attitudes = np.empty((MOST_STARTS + 1, 4)), np.empty(ALONE), np.zeros((2, 3))
    count, found = begin(anchors, measured[:n], flat, level_m, clock, begins), 0
    scarce = tilts and m < REDUNDANT * len(index)
    plain, miss, jacobian = np.empty(m), np.empty(m), np.empty((m, len(index)))
    creeping, least = np.empty(ALONE), np.inf
    for b in range(MOST_STARTS + 1):
        if b > count or (b == count and not found):
            break
        if b == count:
            # anchors nearly in one plane have nearly a mirror solution, which the linear start may have missed, or hit
            for axis in range(3):
                begins[b, axis] = states[0, axis]
            begins[b, 3] = states[0, CLOCK]
            if not mirror(begins[b], anchors, 2 if flat else 3) and not turns:
                break
        if turns:
            _attitudes(rows, c, clock, whiten, begins[b], tilts, attitudes)
        for k in range((2 + LEAN_STARTS if scarce else 2) if turns else 1):
            state[:] = 0.0
            for axis in range(3):
                state[axis] = begins[b, axis]
            state[YAW], state[ROLL], state[PITCH] = attitudes[k if k < 2 else 0]
            if k >= 2:
                _lean(k - 2, state)
            state[CLOCK] = begins[b, 3]
            known = states[:found]
            chi2, rests = descend(rows, c, clock, whiten, index, known, STEPS, state, plain, miss, jacobian)
            if rests:
                if tilts:
                    _least_turned(state)
                found = _insert(states, chi2s, found, state, chi2)
            elif FAR * m < chi2 < least:
                creeping[:] = state
                least = chi2
    if not found and least < np.inf:
        found = _insert(states, chi2s, 0, creeping, least)
    for lean in range(LEAN_STARTS if scarce and found else 0):
        for j in range(ALONE):
            state[j] = states[0, j]
        _lean(lean, state)
        chi2, rests = descend(rows, c, clock, whiten, index, states[:found], STEPS, state, plain, miss, jacobian)
        if rests:
            _least_turned(state)
            found = _insert(states, chi2s, found, state, chi2)
    kept = 0
    for i in range(found):
        new = True
        for k in range(kept):
            new &= not alike(states[i], states[k], 0.01, 0.02)
        if new:
            for j in range(ALONE):
                states[kept, j] = states[i, j]
            chi2s[kept] = misfit(rows, c, clock, whiten, index, states[kept], plain, miss, jacobians[kept])
            kept += 1
    return kept


@numba.njit(cache=True, error_model="numpy")
def _lean(lean, state):
    """Lean a state over, in place, one of `LEAN_STARTS` ways."""
    way = lean * (2 * np.pi / LEAN_STARTS)
    state[ROLL], state[PITCH] = LEAN_RAD * np.cos(way), LEAN_RAD * np.sin(way)


@numba.njit(cache=True, error_model="numpy")
def _least_turned(state):
    """Bring pitch within ±90° and roll within ±180°, in place: each attitude has two sets of angles."""
    for j in (ROLL, PITCH):
        state[j] -= 2 * np.pi * np.floor(state[j] / (2 * np.pi) + 0.5)
    if abs(state[PITCH]) > np.pi / 2:
        state[YAW] += np.pi
        state[PITCH] = (np.pi if state[PITCH] > 0.0 else -np.pi) - state[PITCH]
        state[PITCH_RATE] = -state[PITCH_RATE]
        state[ROLL] += np.pi if state[ROLL] <= 0.0 else -np.pi


@numba.njit(cache=True, error_model="numpy")
def _insert(states, chi2s, count, state, chi2):
    """Put a solution where its χ² belongs; return how many there are."""
    at = count
    while at > 0 and chi2s[at - 1] > chi2:
        chi2s[at] = chi2s[at - 1]
        for j in range(ALONE):
            states[at, j] = states[at - 1, j]
        at -= 1
    chi2s[at] = chi2
    for j in range(ALONE):
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
def _attitudes(rows, c, clock, whiten, place, tilts, out):
    """Yaw, roll and pitch worth starting from at a place, (2, 3): the best by ranges alone, its best rival well away.

    Looked at are a round of headings, upright, and where the body ``tilts`` those two leant over every way.
    """
    ends, dt, measured = rows
    n, turn = len(dt), 2 * np.pi / YAW_STARTS
    state, misfits, best, rival = np.zeros(ALONE), np.zeros(YAW_STARTS), 0, -1
    state[0], state[1], state[2], state[CLOCK] = place[0], place[1], place[2], place[3]
    value, derivative = np.empty(n), np.empty((n, ALONE))
    for y in range(YAW_STARTS):
        state[YAW] = y * turn
        expected(ends, state, dt, c, clock, tilts, value, derivative)
        misfits[y] = _square(measured, value, whiten)
        if misfits[y] < misfits[best]:
            best = y
    for y in range(YAW_STARTS):
        apart = min(abs(y - best), YAW_STARTS - abs(y - best)) * turn
        if apart > 1.0 and (rival < 0 or misfits[y] < misfits[rival]):
            rival = y
    for k in range(2):
        y = best if k == 0 else rival
        out[k, 0], out[k, 1], out[k, 2] = y * turn, 0.0, 0.0
        least = misfits[y]
        for lean in range(LEAN_STARTS if tilts else 0):
            state[YAW] = y * turn
            _lean(lean, state)
            expected(ends, state, dt, c, clock, tilts, value, derivative)
            square = _square(measured, value, whiten)
            if square < least:
                least, out[k, 1], out[k, 2] = square, state[ROLL], state[PITCH]


@numba.njit(cache=True, error_model="numpy")
def _square(measured, value, whiten):
    """χ² of ranges."""
    square = 0.0
    for i in range(len(value)):
        miss = 0.0
        for k in range(i + 1):
            miss += whiten[i, k] * (measured[k] - value[k])
        square += miss**2
    return square


@numba.njit(cache=True, error_model="numpy")
def without(rows, c, clock, covariance, index, choices, begin_at, states, chi2s):
    """Solve again with only some rows, from one state, for each of many choices.

    Parameters
    ----------
    choices : int64 (q, p)
        Rows to keep, each time.
    begin_at : float64 (ALONE,)
    states, chi2s : float64 (q, ALONE) and (q,), out
    """
    count, m = choices.shape[1], size(rows, index, choices.shape[1])
    part, whiten = np.empty((m, m)), np.empty((m, m))
    plain, miss, jacobian = np.empty(m), np.empty(m), np.empty((m, len(index)))
    kept, known = room(count, m), np.empty((0, ALONE))
    for q in range(len(choices)):
        keep(rows, covariance, choices[q], beforehand(index), kept, part)
        whitener(part, whiten)
        for j in range(ALONE):
            states[q, j] = begin_at[j]
        chi2s[q], _ = descend(kept, c, clock, whiten, index, known, STEPS, states[q], plain, miss, jacobian)


@numba.njit(cache=True, error_model="numpy")
def size(rows, index, count):
    """How many measurements so many of all rows have, with what is known `beforehand`."""
    before = beforehand(index)
    return (len(rows[2]) - before) // len(rows[1]) * count + before


@numba.njit(cache=True, error_model="numpy")
def room(count, m):
    """Return empty rows for `keep` to fill: so many ends, and m measurements of them."""
    ends = (np.empty(count, np.int64), np.empty((count, 3)), np.empty(count, np.int64), np.empty((count, 3)))
    return ends, np.empty(count), np.empty(m)


@numba.njit(cache=True, error_model="numpy")
def keep(rows, covariance, choice, before, kept, part):
    """Fill ``kept`` and ``part`` (m, m) with some of the rows, ``before`` of them `beforehand`, and covariance."""
    ends, dt, measured = rows
    kept_ends, kept_dt, kept_measured = kept
    n, count = len(dt), len(choice)
    source = np.empty(len(kept_measured), np.int64)
    for i in range(len(source)):
        # what is known beforehand stands behind ranges and rates of every selection
        behind = i - (len(source) - before)
        source[i] = choice[i % count] + i // count * n if behind < 0 else len(measured) - before + behind
    for i in range(len(source)):
        kept_measured[i] = measured[source[i]]
        for k in range(len(source)):
            part[i, k] = covariance[source[i], source[k]]
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
    best : float64 (ALONE,)
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
    count, m = len(kept) - 1, size(rows, index, len(kept) - 1)
    part, fewer, choice = np.empty((m, m)), room(count, m), np.empty(count, np.int64)
    states, chi2s, jacobians = np.empty((MOST, ALONE)), np.empty(MOST), np.empty((MOST, m, len(index)))
    deviation, sd = np.empty((len(index), len(index))), np.empty(3)
    away[:] = 0.0
    for left_out in range(len(kept)):
        for i in range(count):
            choice[i] = kept[i + (i >= left_out)]
        keep(rows, covariance, choice, beforehand(index), fewer, part)
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
