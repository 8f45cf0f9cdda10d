"""Epoch after epoch of ranges to fixed places in one compiled loop, faulty ones and all (`many`)."""

from __future__ import annotations

import numba
import numpy as np

from sonofix.locate.dense import spread, whitener
from sonofix.locate.search import AT_REST
from sonofix.locate.standing import (
    INCONSISTENT,
    MOST,
    OPEN_DIRECTION,
    TOO_FEW,
    choose,
    descend,
    misfit,
    solutions,
    too_weak,
)
from sonofix.locate.standing_faults import chosen, leave_out


@numba.njit(cache=True, error_model="numpy")
def solve_all(anchors, ranges, covariance, each, known, judge, status, state, spreads, chi2, used):
    """Solve epoch after epoch, and judge each as `fix.judged` does.

    Parameters
    ----------
    anchors, ranges : float64 (b, 3), (n, b)
    covariance : float64 (n, b, b) if ``each``, else (1, b, b)
    known : tuple
        Whether the level is known, it, whether the clock is not, and which of a state are unknown.
    judge : tuple
        χ² beyond which so many rows disagree, and have hardly been mended (2, b + 1), χ² within which two solutions are
        alike, whether there is a room, and it (2, 3).
    status, state, spreads, chi2, used : (n,), (n, 4), (n, k, k), (n,), (n, b), out
        Left as they are where an epoch is not solved, the status aside.

    Returns
    -------
    int
        The epoch whose covariance is not positive, or −1.
    """
    n, most = ranges.shape
    count, limits = len(known[3]), judge[0]
    heard, last = np.empty(most, np.int64), -1
    states, chi2s = np.empty((MOST, 4)), np.empty(MOST)
    places, measured, whiten, part = np.empty((0, 3)), np.empty(0), np.empty((0, 0)), np.empty((0, 0))
    work = (measured, measured, whiten, whiten)
    for e in range(n):
        m, again = 0, last >= 0 and not each
        for i in range(most):
            there = np.isfinite(ranges[e, i])
            if there:
                heard[m] = i
                m += 1
            again = again and there == np.isfinite(ranges[last, i])
        if m < count:
            status[e] = TOO_FEW
            continue
        if not again:
            places, measured, whiten, part = np.empty((m, 3)), np.empty(m), np.empty((m, m)), np.empty((m, m))
            work = (np.empty(m), np.empty(m), np.empty((m, count)), np.empty((m, count)))
            for i in range(m):
                for axis in range(3):
                    places[i, axis] = anchors[heard[i], axis]
                for k in range(m):
                    part[i, k] = covariance[e if each else 0, heard[i], heard[k]]
            if not whitener(part, whiten):
                return e
        last = e
        for i in range(m):
            measured[i] = ranges[e, heard[i]]
        found = solutions(places, measured, whiten, known, work, states, chi2s)
        status[e] = OPEN_DIRECTION
        if not found:
            continue
        if not chi2s[0] > limits[0, m]:
            rows = (places, measured, whiten, work)
            told = settle(rows, known, judge, 1.0, states, chi2s, found, state[e], spreads[e])
            if told < 0:
                status[e] = -told
                continue
            status[e], chi2[e] = 0, chi2s[told]
            for i in range(m):
                used[e, heard[i]] = True
            continue
        misfit_of_all = chi2s[0]
        problem = (places, measured, part, known)
        kept, found, isolated = leave_out(problem, limits, states, chi2s, found)
        inflation = 1.0
        if chi2s[0] > limits[0, len(kept)]:
            inflation = chi2s[0] / max(1, len(kept) - count)
            if descends(chosen(problem, kept), known, states[0], chi2s[0]) > AT_REST * inflation:
                continue
        elif not isolated:
            inflation = misfit_of_all / (m - count)
        told = settle(chosen(problem, kept), known, judge, inflation, states, chi2s, found, state[e], spreads[e])
        if told < 0:
            status[e] = -told
            continue
        status[e], chi2[e] = 0 if inflation == 1.0 else INCONSISTENT, chi2s[told]
        for i in kept:
            used[e, heard[i]] = True
    return -1


@numba.njit(cache=True, error_model="numpy")
def descends(rows, known, state, chi2):
    """How far χ² falls from a solution on: not at all where it is at rest."""
    places, measured, whiten, work = rows
    return chi2 - descend(places, measured, whiten, known[3], np.empty((0, 4)), state.copy(), work)[0]


@numba.njit(cache=True, error_model="numpy")
def settle(rows, known, judge, inflation, states, chi2s, found, state, spreads):
    """Choose a solution of some rows; fill its state and covariance. Below 0: the negative of what to say instead."""
    places, measured, whiten, work = rows
    best = choose(states, chi2s, found, judge, inflation)
    if best < 0:
        return best
    misfit(places, measured, whiten, known[3], states[best], work[0], work[2])
    there = spread(work[2], spreads)
    if there:
        spreads *= inflation
    if not there or too_weak(measured, states[best], spreads, 2 if known[0] else 3):
        spreads[:] = np.nan
        return -OPEN_DIRECTION
    for i in range(4):
        state[i] = states[best, i]
    return best
