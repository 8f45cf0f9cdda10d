"""One instant's measurements taken into a team's belief: judged one by one, used or refused, and learnt from."""

from __future__ import annotations

import numba
import numpy as np

from sonofix.team.feed import COMPASS
from sonofix.team.kernel import expect, turned_by
from sonofix.team.noise import (
    BODY_M,
    MOST_SHARE,
    beyond,
    learn_bearing,
    learn_range,
    learn_share,
    repeated,
    scatter,
    staying,
)
from sonofix.team.state import SIZE, YAW
from sonofix.track.kernel import absorb
from sonofix.track.wheels import COMPASS_SD_RAD, ROBUST

REFUSED = 25.0
"""Squared miss, over its variance, beyond which a measurement is not believed."""


TURNS = 4
"""Linearisations of one row at most."""

STRAIGHT = 0.05**2
"""In rad²: the variance of a direction below which one does."""

ALIKE = 0.1
"""Ranges that differ by a lesser share of themselves are seen the same way and err together."""


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
def crowd(rows, listener, range_m):
    """Return how many ranges of about the same length each row's listener heard at once, itself included."""
    many = np.ones(rows[1] - rows[0])
    for i in range(rows[0], rows[1]):
        for j in range(rows[0], i):
            if listener[i] == listener[j] and abs(range_m[i] - range_m[j]) < ALIKE * range_m[i]:
                many[i - rows[0]] += 1.0
                many[j - rows[0]] += 1.0
    return many


@numba.njit(cache=True, error_model="numpy")
def hear(
    mean, covariance, about, follows, placed, rows, time_s, kind, listener, source, listener_point, source_point,
    range_m, range_sd_m, bearing_rad, pair, ranges, bearings, share, last_s, believed, flight_s_per_m, speed, used,
    told, work,
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
    ranges, bearings, share, last_s, believed
        `Noise`.
    used : bool (rows, 2), out
        Range and bearing taken.
    told : float64 (rows, 2, 4), out
        Of each: what was measured less what was expected (NaN where nothing was), the variance that the belief gave
        that, the variance of its noise, and that taken for it.
    work : float64 (3, n)
        Room.

    """
    n, robots = len(mean), len(placed)
    row = np.empty((2, n))
    point, before, doubt = about.copy(), np.empty(n), np.empty((n, n))
    alike = crowd(rows, listener, range_m)
    for i in range(rows[0], rows[1]):
        k = i - rows[0]
        a, b = listener[i], source[i]
        used[k, 0] = used[k, 1] = False
        told[k, 0, 0] = told[k, 1, 0] = np.nan
        if (a >= 0 and not placed[a]) or (b >= 0 and not placed[b]):
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
        since = time_s[i] - last_s[pair[i]]
        if follows:
            point[:], before[:], doubt[:, :] = mean, mean, covariance
        for turn in range(TURNS):
            if turn > 0:
                point[:], mean[:], covariance[:, :] = mean, before, doubt
            shown, direction, way = expect(point, a, b, listener_point[i], source_point[i], flight_s_per_m, speed, row)
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
                    body = (BODY_M / way) ** 2
                    variance = scatter(bearings, who) + body
                    taken = variance - body + body * repeated(MOST_SHARE, since)
                else:
                    variance = range_sd_m[i] ** 2 if np.isfinite(range_sd_m[i]) else 0.0
                    taken = variance
                    if not believed:
                        variance += beyond(ranges, who, range_m[i])
                        taken = variance * repeated(staying(share), since) * alike[k]
                own = spread(covariance, row[j])
                square = off * off / (own + taken)
                told[k, j, 0], told[k, j, 1], told[k, j, 2], told[k, j, 3] = off, own, variance, taken
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


@numba.njit(cache=True, error_model="numpy")
def learn(
    rows, time_s, kind, listener, range_m, range_sd_m, pair, ranges, bearings, share, last_s, last, believed, used, told
):
    """Learn from the measurements just taken in how good such are, in place; arguments as `hear` has them."""
    robots = len(ranges) - 2
    for i in range(rows[0], rows[1]):
        k = i - rows[0]
        if kind[i] == COMPASS or not (used[k, 0] or used[k, 1]):
            continue
        who = listener[i] if listener[i] >= 0 else robots
        since = time_s[i] - last_s[pair[i]]
        for j in range(2):
            if used[k, j]:
                if j == 0 and np.isfinite(since) and np.isfinite(last[pair[i], j, 0]):
                    learn_share(share, told[k, j], last[pair[i], j], since)
                if j == 1:
                    learn_bearing(bearings, who, told[k, j], told[k, j, 2] - scatter(bearings, who))
                elif not believed:
                    stated = range_sd_m[i] ** 2 if np.isfinite(range_sd_m[i]) else 0.0
                    learn_range(ranges, who, range_m[i], told[k, j], stated)
                last[pair[i], j] = told[k, j]
            else:
                last[pair[i], j, 0] = np.nan
        last_s[pair[i]] = time_s[i]
