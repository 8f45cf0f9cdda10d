"""Faulty ranges to fixed places left out, as kernels: what `exclude` does, for the plain case of a fix (`many`)."""

from __future__ import annotations

import numba
import numpy as np

from sonofix.locate.dense import spread, whitener
from sonofix.locate.exclude import APART_SIGMA, MOST_ANEW, MOST_PAIRS
from sonofix.locate.standing import descend, misfit, solutions


@numba.njit(cache=True, error_model="numpy")
def room(p, count):
    """Return empty places (p, 3), ranges (p,) and whitening matrix (p, p) of p rows, and room to descend in."""
    work = (np.empty(p), np.empty(p), np.empty((p, count)), np.empty((p, count)))
    return np.empty((p, 3)), np.empty(p), np.empty((p, p)), work


@numba.njit(cache=True, error_model="numpy")
def fill(problem, choice, rows, part):
    """Put some rows where `room` made room for them; ``part`` (p, p) is spoilt."""
    anchors, measured, covariance, _ = problem
    places, some, whiten, _ = rows
    for i in range(len(choice)):
        some[i] = measured[choice[i]]
        for axis in range(3):
            places[i, axis] = anchors[choice[i], axis]
        for k in range(len(choice)):
            part[i, k] = covariance[choice[i], choice[k]]
    whitener(part, whiten)


@numba.njit(cache=True, error_model="numpy")
def chosen(problem, choice):
    """Return some rows as `room` has them."""
    rows = room(len(choice), len(problem[3][3]))
    fill(problem, choice, rows, np.empty((len(choice), len(choice))))
    return rows


@numba.njit(cache=True, error_model="numpy")
def anew(problem, choice, states, chi2s):
    """Fill solutions of some rows from new starts, as `standing.solutions` does; return how many."""
    places, some, whiten, work = chosen(problem, choice)
    return solutions(places, some, whiten, problem[3], work, states, chi2s)


@numba.njit(cache=True, error_model="numpy")
def leaving(rows, count):
    """Rows without each choice of one or two of them (choices, n − count)."""
    n = len(rows)
    choices = np.empty((n if count == 1 else n * (n - 1) // 2, n - count), np.int64)
    q = 0
    for a in range(n):
        for b in range(a + 1, n if count == 2 else a + 2):
            at = 0
            for i in range(n):
                if i != a and (count == 1 or i != b):
                    choices[q, at] = rows[i]
                    at += 1
            q += 1
    return choices


@numba.njit(cache=True, error_model="numpy")
def without(problem, choices, begin_at, states, chi2s):
    """Descend from one state with each choice of rows alone: (q, 4) and (q,), out."""
    p, nothing = choices.shape[1], np.empty((0, 4))
    rows, part = room(p, len(problem[3][3])), np.empty((p, p))
    places, some, whiten, work = rows
    for q in range(len(choices)):
        fill(problem, choices[q], rows, part)
        for j in range(4):
            states[q, j] = begin_at[j]
        chi2s[q], _ = descend(places, some, whiten, problem[3][3], nothing, states[q], work)


@numba.njit(cache=True, error_model="numpy")
def place_sd_m(problem, choice, state):
    """Deviation of a position along its widest axis, all else being unknown too; 0 where a direction is open."""
    places, some, whiten, work = chosen(problem, choice)
    flat, index = problem[3][0], problem[3][3]
    misfit(places, some, whiten, index, state, work[0], work[2])
    covariance = np.empty((len(index), len(index)))
    if not spread(work[2], covariance):
        return 0.0
    dims = 2 if flat else 3
    return np.sqrt(np.linalg.eigvalsh(np.ascontiguousarray(covariance[:dims, :dims]))[-1])


@numba.njit(cache=True, error_model="numpy")
def leave_out(problem, limits, states, chi2s, found):
    """Leave out one row, or two, or one by one, as `exclude.exclude` does.

    Parameters
    ----------
    problem : tuple
        Places (m, 3), ranges (m,), their covariance (m, m), and ``known`` as `standing.solutions` takes it.
    limits : float64 (2, b + 1)
        χ² beyond which so many rows disagree, and beyond which they have hardly been mended.
    states, chi2s, found
        Solutions of all rows; replaced by those of the rows kept.

    Returns
    -------
    kept : int64 (p,)
    found : int
    isolated : bool
    """
    m, needed = len(problem[1]), len(problem[3][3])
    everything = np.arange(m)
    if m <= needed + 1:
        return everything, found, True
    begin_at, whole = states[0].copy(), chi2s[0]
    singles, pairs = leaving(everything, 1), np.empty((0, max(m - 2, 0)), np.int64)
    if m - 2 > needed and m * (m - 1) // 2 <= MOST_PAIRS:
        pairs = leaving(everything, 2)
    # a choice that mends well is taken at once; one that mends just so, only where none does well
    places_1, chi2_1 = np.empty((len(singles), 4)), np.empty(len(singles))
    places_2, chi2_2 = np.empty((len(pairs), 4)), np.empty(len(pairs))
    for turn in range(4):
        choices, places, misfits = (singles, places_1, chi2_1) if turn % 2 == 0 else (pairs, places_2, chi2_2)
        if not len(choices):
            continue
        left = choices.shape[1]
        if turn < 2:
            without(problem, choices, begin_at, places, misfits)
            for i in np.argsort(misfits, kind="mergesort")[:MOST_ANEW]:
                # a descent from where the faulty row drew the fix may end in a wrong valley: begin anew without it, for
                # the true choice to gainsay another that agrees by chance
                if anew(problem, choices[i], states, chi2s) and chi2s[0] < misfits[i]:
                    misfits[i], places[i] = chi2s[0], states[0]
        best = np.argmin(misfits)
        if not misfits[best] <= limits[1 if turn < 2 else 0, left]:
            continue
        again = anew(problem, choices[best], states, chi2s)
        if not again:
            continue
        farthest = 0.0
        for i in range(len(choices)):
            if misfits[i] <= limits[0, left]:
                gap = 0.0
                for axis in range(3):
                    gap += (places[i, axis] - places[best, axis]) ** 2
                farthest = max(farthest, np.sqrt(gap))
        isolated = not farthest or farthest <= APART_SIGMA * place_sd_m(problem, choices[best], states[0])
        return choices[best].copy(), again, isolated
    kept, found = one_by_one(problem, limits, begin_at, whole, states, chi2s)
    return kept, found, True


@numba.njit(cache=True, error_model="numpy")
def one_by_one(problem, limits, begin_at, misfit_of_all, states, chi2s):
    """Leave out row after row, as long as each halves the misfit per degree of freedom; return what is left, as above.

    ``begin_at``, ``misfit_of_all``: of the best solution of all rows.
    """
    kept, needed = np.arange(len(problem[1])), len(problem[3][3])
    state, before = begin_at.copy(), misfit_of_all
    while len(kept) > needed + 1 and not before <= limits[0, len(kept)]:
        choices = leaving(kept, 1)
        places, misfits = np.empty((len(choices), 4)), np.empty(len(choices))
        without(problem, choices, state, places, misfits)
        best = np.argmin(misfits)
        share = misfits[best] / max(1, len(kept) - 1 - needed)
        if share > 0.5 * before / (len(kept) - needed) or not anew(problem, choices[best], states, chi2s):
            break
        kept = choices[best].copy()
        state, before = states[0].copy(), chi2s[0]
    return kept, anew(problem, kept, states, chi2s)
