"""The least bias that a χ² test notices, of ranges as they are: curved.

A bias b in one row has the noncentrality λ(b), the least χ² that any place leaves of exact rows with that bias. Where
few rows are to spare a bias moves the place far before it shows, ranges bend on the way, and λ(b) is not the b² Pᵢᵢ of
the linear model (`integrity.minimum_detectable_bias`), but less or more. Its valleys lie where the other rows have a
solution: at the place itself, b = 0, and at each of their mirror solutions. All are walked out of.

Noise moves the place as well, along the bend: with B what residuals times second derivatives take off JᵀJ (Bates &
Watts, J. R. Statist. Soc. B 42(1), 1980), χ² is that of the noise across plus c z² for each direction along, z normal,
c = −β/(1 − β), β an eigenvalue of B in units of JᵀJ. Its lower tail is taken by the saddlepoint (Lugannani & Rice, Adv.
Appl. Prob. 12(2), 1980; of quadratic forms, Kuonen, Biometrika 86(4), 1999).
"""

from __future__ import annotations

from math import erfc

import numba
import numpy as np

from sonofix.geometry import ALONE
from sonofix.locate.dense import factor, whitener
from sonofix.locate.search import MOST, STEPS, keep, room, search, size
from sonofix.locate.solve import alike, beforehand, descend, misfit

FIRST_SIGMA, GROWTH, GROWN = 4.0, 1.3, 40
"""Biases tried: first so many deviations of the row, each so much larger than the one before, so many at most."""

HALVINGS = 9
"""Of the last step, between a bias missed and one noticed: to a part in two thousand."""

FREE = 1e6
"""Deviations of its own that a row is given which shall have no say."""

NUDGE = 1e-4
"""Step of the differences that second derivatives are taken by, in m, rad, m/s."""


@numba.njit(cache=True, error_model="numpy")
def tail(limit, degrees, square, bends):
    """Probability that χ² stays below a limit; 1 where it does more often than not.

    Parameters
    ----------
    limit : float
    degrees : int
    square : float
        Noncentrality.
    bends : float64 (k,)
        Factors c of further squares of normal variables that are added.
    """
    if limit >= degrees + square + np.sum(bends):
        return 1.0
    low, high = min(0.5 - 0.5 * (degrees + len(bends) + square) / limit, 0.0), 0.0
    for bend in bends:
        if bend < 0.0:
            low = max(low, 0.5 / bend)
    for _ in range(60):
        t = (low + high) / 2
        grows = degrees / (1 - 2 * t) + square / (1 - 2 * t) ** 2
        for bend in bends:
            grows += bend / (1 - 2 * bend * t)
        if grows > limit:
            high = t
        else:
            low = t
    t = (low + high) / 2
    own = 1 - 2 * t
    value, bent = square * t / own - degrees * np.log(own) / 2, 2 * degrees / own**2 + 4 * square / own**3
    for bend in bends:
        one = 1 - 2 * bend * t
        value -= np.log(one) / 2
        bent += 2 * bend**2 / one**2
    w, v = -np.sqrt(2 * (t * limit - value)), t * np.sqrt(bent)
    return 0.5 * erfc(-w / np.sqrt(2.0)) + np.exp(-(w**2) / 2) / np.sqrt(2 * np.pi) * (1 / w - 1 / v)


@numba.njit(cache=True, error_model="numpy")
def bends_at(rows, c, clock, whiten, index, state, limit):
    """χ² at a solution, and the factors c of the noise along it; χ² 0 where a direction is open.

    Of noise that hides a bias the residuals are no longer than ``limit`` allows: so long they are taken to be.
    """
    m, count = len(rows[2]), len(index)
    plain, miss, jacobian, moved = np.empty(m), np.empty(m), np.empty((m, count)), np.empty(ALONE)
    lower, bent, bends = np.zeros((count, count)), np.zeros((count, count)), np.zeros(count)
    for side in (-1.0, 1.0):
        for j in range(count):
            for i in range(ALONE):
                moved[i] = state[i]
            moved[index[j]] += side * NUDGE
            misfit(rows, c, clock, whiten, index, moved, plain, miss, jacobian)
            for k in range(count):
                for i in range(m):
                    bent[k, j] += side * jacobian[i, k] * miss[i] / (2 * NUDGE)
    chi2 = misfit(rows, c, clock, whiten, index, state, plain, miss, jacobian)
    for j in range(count):
        for k in range(count):
            for i in range(m):
                lower[j, k] += jacobian[i, j] * jacobian[i, k]
    # the gradient's change is −JᵀJ + B; as long as residuals are, so much does B weigh
    bent = (bent + bent.T) / 2 + lower
    if chi2 > limit:
        bent *= np.sqrt(limit / chi2)
    if not factor(lower):
        return 0.0, bends
    for _ in range(2):
        for column in range(count):
            for j in range(count):
                for k in range(j):
                    bent[j, column] -= lower[j, k] * bent[k, column]
                bent[j, column] /= lower[j, j]
        bent = np.ascontiguousarray(bent.T)
    bends = np.linalg.eigvalsh(bent)
    if not bends[-1] < 1.0:
        return 0.0, np.zeros(count)
    return chi2, -bends / (1.0 - bends)


@numba.njit(cache=True, error_model="numpy")
def hides(problem, test, row, bias_m, state):
    """Whether a bias slips through more often than it may; ``state`` moves to where it leads, in place.

    Parameters
    ----------
    problem : tuple
        Exact rows and what else `search.search` takes, up to the level, and what whitens the rows.
    test : tuple
        The χ² test's limit, and how often a bias that counts as noticed may slip through.
    """
    rows, c, clock, covariance, index, flat, level_m, whiten = problem
    limit, rate = test
    ends, dt, measured = rows
    m, count = len(measured), len(index)
    biased, known = measured.copy(), np.empty((0, ALONE))
    biased[row] += bias_m
    at = (ends, dt, biased)
    plain, miss, jacobian = np.empty(m), np.empty(m), np.empty((m, count))
    descend(at, c, clock, whiten, index, known, STEPS, state, plain, miss, jacobian)
    chi2, bends = bends_at(at, c, clock, whiten, index, state, limit)
    slips = tail(limit, m - count, chi2, bends)
    if slips > rate:
        return True
    # a bias may lead to several places, of which a walk sees one
    states, chi2s, jacobians = np.empty((MOST, ALONE)), np.empty(MOST), np.empty((MOST, m, count))
    for s in range(search(at, c, clock, covariance, index, flat, level_m, states, chi2s, jacobians)):
        if not alike(states[s], state, 0.01, 0.02):
            chi2, bends = bends_at(at, c, clock, whiten, index, states[s], limit)
            slips += tail(limit, m - count, chi2, bends)
    return slips > rate


@numba.njit(cache=True, error_model="numpy")
def edge(problem, test, row, begin_at, bias_m, side, sd_m):
    """Walk from a bias at which a state fits outwards, ``side`` of it, until it is noticed; inf where it never is.

    Where the first one does not hide, 0 comes back: there is no valley.
    """
    state, tried = begin_at.copy(), begin_at.copy()
    if not hides(problem, test, row, bias_m, state):
        return 0.0
    hidden, seen, step = bias_m, np.inf, side * FIRST_SIGMA * sd_m
    for _ in range(GROWN):
        tried[:] = state
        if not hides(problem, test, row, bias_m + step, tried):
            seen = bias_m + step
            break
        hidden, step = bias_m + step, step * GROWTH
        state[:] = tried
    if not np.isfinite(seen):
        return seen
    for _ in range(HALVINGS):
        middle = (hidden + seen) / 2
        tried[:] = state
        if hides(problem, test, row, middle, tried):
            hidden = middle
            state[:] = tried
        else:
            seen = middle
    return seen


@numba.njit(cache=True, error_model="numpy")
def least_biases(rows, c, clock, covariance, index, flat, level_m, places, limit, rate, out):
    """Fill ``out`` (n, 2): of each range the least bias that is noticed, and that beyond which none hides.

    Of either sign, wherever of some places the true one is; infinite where there is none. Where a second place fits
    that lies so near that its valley joins that of the first, both are the same.

    Parameters
    ----------
    rows, c, clock, covariance, index, flat, level_m
        As `search.search` takes them.
    places : float64 (p, ALONE)
        States, from which exact rows are taken.
    limit : float
        Of the χ² test.
    rate : float
        How often a bias that is noticed may slip through.
    """
    ends, dt, measured = rows
    n, m, count = len(dt), len(measured), len(index)
    out[:] = np.inf
    part_m = size(rows, index, n - 1)
    if m <= count or part_m < count:
        return
    exact, whiten, loose = np.empty(m), np.empty((m, m)), np.empty((m, m))
    plain, miss, jacobian = np.empty(m), np.empty(m), np.empty((m, count))
    whitener(covariance, whiten)
    at, test = (ends, dt, exact), (limit, rate)
    problem = (at, c, clock, covariance, index, flat, level_m, whiten)
    part, fewer, choice = np.empty((part_m, part_m)), room(n - 1, part_m), np.empty(n - 1, np.int64)
    states, chi2s, jacobians = np.empty((MOST, ALONE)), np.empty(MOST), np.empty((MOST, part_m, count))
    before, known = beforehand(index), np.empty((0, ALONE))
    own, nearest, farthest = np.zeros(n), np.full(n, np.inf), np.zeros(n)
    for p in range(len(places)):
        place = places[p]
        misfit(rows, c, clock, whiten, index, place, plain, miss, jacobian)
        for i in range(m):
            exact[i] = measured[i] - plain[i]
        for row in range(n):
            sd_m = np.sqrt(covariance[row, row])
            for side in (-1.0, 1.0):
                own[row] = max(own[row], abs(edge(problem, test, row, place, 0.0, side, sd_m)))
            # the other rows' other solutions: with its range free, but not its rate, each is a valley of λ
            for i in range(n - 1):
                choice[i] = i + (i >= row)
            keep(at, covariance, choice, before, fewer, part)
            others = search(fewer, c, clock, part, index, flat, level_m, states, chi2s, jacobians)
            part_of = covariance.copy()
            part_of[row, row] += (FREE * sd_m) ** 2
            whitener(part_of, loose)
            for s in range(others):
                descend(at, c, clock, loose, index, known, STEPS, states[s], plain, miss, jacobian)
                bias_m = -plain[row]
                side = 1.0 if bias_m > 0.0 else -1.0
                outer = edge(problem, test, row, states[s], bias_m, side, sd_m) * side
                if outer > own[row]:
                    inner = edge(problem, test, row, states[s], bias_m, -side, sd_m) * side
                    nearest[row] = min(nearest[row], inner)
                    farthest[row] = max(farthest[row], outer)
    for row in range(n):
        out[row, 1] = max(own[row], farthest[row])
        out[row, 0] = own[row] if nearest[row] > own[row] else out[row, 1]
