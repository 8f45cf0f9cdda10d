"""One instant's measurements taken into a team's belief: judged one by one, used or refused, and learnt from."""

from __future__ import annotations

import numba
import numpy as np

from sonofix.team.feed import COMPASS, SIGHTING, UNHEARD
from sonofix.team.kernel import expect, turned_by
from sonofix.team.noise import BEARING, CLIPPED, NEW, STAYING, fade, follow_run, take, variance_of
from sonofix.team.state import SIZE, YAW
from sonofix.track.kernel import absorb
from sonofix.track.wheels import COMPASS_SD_RAD, ROBUST

REFUSED = 25.0
"""Squared miss, over its variance, beyond which a measurement is not believed."""


TURNS = 4
"""Linearisations of one row at most."""

STRAIGHT = 0.05**2
"""In rad²: the variance of a direction below which one does."""

TOLD = 7
"""Numbers told of each measurement."""


@numba.njit(cache=True, error_model="numpy")
def spread(covariance, row):
    """Return hᵀ P h of a row with few entries."""
    total = 0.0
    for i in range(len(row)):
        if row[i] != 0.0:
            part = 0.0
            for j in range(len(row)):
                if row[j] != 0.0:
                    part += covariance[i, j] * row[j]
            total += row[i] * part
    return total


@numba.njit(cache=True, error_model="numpy")
def age(mean, covariance, at, left):
    """Let one error of unit variance fade to a part of itself, in place (Gauss-Markov: Gelb 1974, section 3.7)."""
    mean[at] *= left
    for j in range(len(mean)):
        covariance[at, j] *= left
        covariance[j, at] *= left
    covariance[at, at] += 1.0 - left * left


@numba.njit(cache=True, error_model="numpy")
def hear(
    mean, covariance, about, follows, placed, rows, time_s, kind, listener, source, listener_point, source_point,
    range_m, range_sd_m, bearing_rad, view, known, fading, swell, last, believed, flight_s_per_m, speed, used, told,
    work,
):  # fmt: skip
    """Take the measurements of some ``rows`` in, in place.

    Parameters
    ----------
    mean, covariance, about : float64 (n,), (n, n), (n,)
    follows : bool
        Linearise at the mean as it moves instead, and anew about what a row leads to (Bell and Cathey 1993) where its
        direction is so uncertain that a straight line will not do.
    placed : bool (V,)
        Robots whose place is known; what others heard, or were heard by, is left.
    rows : (first, last)
        Of the `Feed`'s arrays that follow.
    known, believed
        `Noise`.
    last : float64 (P, 2), in and out
        When each view's error was last followed, and at which range; NaN: never.
    used : bool (rows, 2), out
        Range and bearing taken.
    told : float64 (rows, 2, TOLD), out
        Of each: what was measured less what was expected (NaN where nothing was), the variance that the belief gave
        that, the variance of its noise, and that taken for it; of ranges besides the expected square of the error that
        stays (m²), and how much of that is new; and what was measured less what was expected, squared, over the
        variance of that, before any is taken for larger.
    work : float64 (3, n)
        Room.

    """
    n, robots = len(mean), len(placed)
    row = np.empty((2, n))
    point, before, doubt = about.copy(), np.empty(n), np.empty((n, n))
    for i in range(rows[0], rows[1]):
        k = i - rows[0]
        a, b = listener[i], source[i]
        used[k, 0] = used[k, 1] = False
        told[k, 0, 0] = told[k, 1, 0] = np.nan
        if kind[i] == UNHEARD or (a >= 0 and not placed[a]) or (b >= 0 and not placed[b]):
            continue
        if kind[i] == COMPASS:
            row[1, :] = 0.0
            at = SIZE * a + YAW
            row[1, at] = 1.0
            off = turned_by(bearing_rad[i] - mean[at])
            variance = COMPASS_SD_RAD**2
            variance *= max(1.0, abs(off) / np.sqrt(covariance[at, at] + variance) / ROBUST)
            absorb(mean, covariance, row[1], off, variance, work)
            told[k, 1, 0], told[k, 1, 3] = off, variance
            used[k, 1] = True
            continue
        who = a if a >= 0 else robots
        own_error = -1
        stays = 0.0
        renewed = 0.0
        if not believed and np.isfinite(range_m[i]):
            own_error = SIZE * robots + view[i]
            stays = np.sqrt(variance_of(known, who, STAYING, range_m[i]))
            left = fade(time_s[i] - last[view[i], 0], range_m[i], last[view[i], 1], fading)
            renewed = 1.0 - left * left
            age(mean, covariance, own_error, left)
            last[view[i], 0], last[view[i], 1] = time_s[i], range_m[i]
        if follows:
            point[:], before[:], doubt[:, :] = mean, mean, covariance
        for turn in range(TURNS):
            if turn > 0:
                point[:], mean[:], covariance[:, :] = mean, before, doubt
            shown, direction, _ = expect(
                point, a, b, listener_point[i], source_point[i], flight_s_per_m, speed, believed, row
            )
            if own_error >= 0:
                row[0, own_error] = stays
                shown += stays * point[own_error]
            wrong = False
            for j in (1, 0):
                used[k, j] = False
                measured = bearing_rad[i] if j == 1 else range_m[i]
                if not np.isfinite(measured) or (j == 1 and a < 0):
                    continue
                off = turned_by(measured - direction) if j == 1 else measured - shown
                for m in range(n):
                    if row[j, m] != 0.0:
                        off -= row[j, m] * (mean[m] - point[m])
                if j == 1:
                    variance = variance_of(known, who, BEARING, range_m[i])
                else:
                    variance = range_sd_m[i] ** 2 if np.isfinite(range_sd_m[i]) else 0.0
                    if not believed:
                        variance += variance_of(known, who, NEW, range_m[i])
                taken = variance if believed else variance * swell[who, j]
                own = spread(covariance, row[j])
                square = off * off / (own + taken)
                told[k, j, 0], told[k, j, 1], told[k, j, 2], told[k, j, 3] = off, own, variance, taken
                told[k, j, 6] = square
                # a direction that cannot be is that of something else, whose range then tells nothing either
                if square > REFUSED or wrong:
                    wrong = True
                    continue
                taken *= max(1.0, np.sqrt(square) / ROBUST)
                told[k, j, 3] = taken
                absorb(mean, covariance, row[j], off, taken, work)
                used[k, j] = True
            if not follows or spread(doubt, row[1]) < STRAIGHT or not (used[k, 0] or used[k, 1]):
                break
        if own_error >= 0:
            told[k, 0, 4] = stays**2 * (mean[own_error] ** 2 + covariance[own_error, own_error])
            told[k, 0, 5] = renewed


@numba.njit(cache=True, error_model="numpy")
def learn(
    rows, time_s, kind, listener, range_m, range_sd_m, view, known, runs, swell, believed, used, told
):  # fmt: skip
    """Learn from the measurements just taken in how good such are, in place; arguments as `hear` has them."""
    robots = len(known) - 2
    for i in range(rows[0], rows[1]):
        k = i - rows[0]
        if kind[i] != SIGHTING:
            continue
        who = listener[i] if listener[i] >= 0 else robots
        for j in range(2):
            if j == 0 and believed:
                continue
            apart = used[k, 1] or not np.isfinite(told[k, 1, 0])
            if j == 0 and not used[k, 0] and apart and np.isfinite(range_sd_m[i]) and np.isfinite(told[k, 0, 0]):
                # worse than stated, as its direction is not wrong: so they open to what they are
                for sort in (STAYING, NEW):
                    take(known, who, sort, range_m[i], CLIPPED * variance_of(known, who, sort, range_m[i]), 1.0)
            if not used[k, j]:
                continue
            off, own, variance, taken = told[k, j, 0], told[k, j, 1], told[k, j, 2], told[k, j, 3]
            if not believed:
                swell[who, j] = follow_run(runs[view[i], j], swell[who, j], time_s[i], off / np.sqrt(own + taken))
            part = variance / (own + variance)
            square = min((off * part) ** 2, CLIPPED * variance) + own * part
            if j == 1:
                take(known, who, BEARING, range_m[i], square, 1.0)
            else:
                stated = range_sd_m[i] ** 2 if np.isfinite(range_sd_m[i]) else 0.0
                take(known, who, NEW, range_m[i], max(square - stated, 0.0), 1.0)
                take(known, who, STAYING, range_m[i], told[k, 0, 4], told[k, 0, 5])
