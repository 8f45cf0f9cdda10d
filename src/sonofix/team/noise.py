"""How good ranges and bearings are that nobody vouches for: learnt from themselves, while they are used.

Two things are learnt: how far single measurements scatter, listener by listener and octave of range by octave, and
which share of a range's error stays from one to the next. What stays tells less than it seems to: many measurements of
one pair within `KEPT_S` count as few. Of a direction, where the other end's middle is stays (`BODY_M`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from sonofix.records import Floats
from sonofix.track.stated import BEGIN_SD_M, POOL, SCALE_SD

OCTAVES = 8
"""Of range, the fourth of which begins at 1 m."""

BEGIN_SD_RAD = 0.02
"""Of bearings, before they have told."""

LEAST_SD_M, LEAST_SD_RAD = 0.01, 2e-3
"""What nobody vouches for is told no better."""

BODY_M = 0.03
"""Ends are no points: from one view, the place that a direction tells is so far off, and stays so."""

KEPT_S = 10.0
"""How long the part of an error lasts that stays: a view, an echo's way, a body in between."""

BEGIN_SHARE = 0.5
"""The part that stays, before measurements have told."""

SHARE_POOL = 30.0
"""Pairs of measurements by which that is outweighed."""

MOST_SHARE = 0.98

REMEMBERED = 200.0
"""Measurements of a listener by which their scatter is judged."""

SHARED = 2000.0
"""Those of all, by which scatter and the share that stays are."""

CLIPPED = 9.0
"""A single product counts as at most so many variances."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """What V listeners have learnt; row V is of fixed ones. Arrays are written in place.

    Attributes
    ----------
    ranges : float64 (V + 2, OCTAVES, 3)
        Faded count, sum of squares, sum of stated variances; last row: of all.
    bearings : float64 (V + 2, 2)
        Count, sum of squares.
    share : float64 (2,)
        Of ranges: sum of products of successive misses over their noise, and of what these would be if all stayed.
    last_s, last : float64 (P,), (P, 2, 4)
        When each pair was last used, and what `hear.hear` told of it then; NaN: never.
    believed : bool
        Ranges are as good as stated, and nothing of them stays.
    """

    ranges: Floats
    bearings: Floats
    share: Floats
    last_s: Floats
    last: Floats
    believed: bool


def noise(robots: int, pairs: int, believed: bool) -> Noise:
    """Return what is known before anything was heard."""
    return Noise(
        np.zeros((robots + 2, OCTAVES, 3)),
        np.zeros((robots + 2, 2)),
        np.array([BEGIN_SHARE * SHARE_POOL, SHARE_POOL]),
        np.full(pairs, np.nan),
        np.full((pairs, 2, 4), np.nan),
        believed,
    )


@numba.njit(cache=True, error_model="numpy")
def octave(range_m):
    """Return the octave of a range."""
    return int(min(max(np.floor(np.log2(max(range_m, 1e-9))) + 3, 0), OCTAVES - 1))


@numba.njit(cache=True, error_model="numpy")
def beyond(ranges, listener, range_m):
    """Return the variance (m²) that a listener's ranges have beyond what they state."""
    k = octave(range_m)
    begin = BEGIN_SD_M**2 + (SCALE_SD * range_m) ** 2
    every = (ranges[-1, k, 1] - ranges[-1, k, 2] + POOL * begin) / (ranges[-1, k, 0] + POOL)
    own = (ranges[listener, k, 1] - ranges[listener, k, 2] + POOL * every) / (ranges[listener, k, 0] + POOL)
    return max(own, LEAST_SD_M**2)


@numba.njit(cache=True, error_model="numpy")
def scatter(bearings, listener):
    """Return the variance (rad²) of a listener's bearings."""
    every = (bearings[-1, 1] + POOL * BEGIN_SD_RAD**2) / (bearings[-1, 0] + POOL)
    own = (bearings[listener, 1] + POOL * every) / (bearings[listener, 0] + POOL)
    return max(own, LEAST_SD_RAD**2)


@numba.njit(cache=True, error_model="numpy")
def repeated(part, since_s):
    """Return by what a variance is to be multiplied where the pair was used ``since_s`` ago (NaN: never).

    ``part`` of it stays. Of n samples of a process that fades by ρ from one to the next, the mean has
    (1 + ρ)/(1 − ρ)/n of the variance.
    """
    if not np.isfinite(since_s):
        return 1.0
    fade = np.exp(-max(since_s, 1e-3) / KEPT_S)
    return 1.0 - part + part * (1.0 + fade) / (1.0 - fade)


@numba.njit(cache=True, error_model="numpy")
def staying(share):
    """Return the part of a noise that stays, as ``share`` has it."""
    return min(max(share[0] / share[1], 0.0), MOST_SHARE)


@numba.njit(cache=True, error_model="numpy")
def weigh(told, begin):
    """Return what a miss says of its noise's variance, and the weight of that in a maximum of the likelihood.

    ``told`` is the miss, the variance that the belief gave it, and that of its noise; ``begin`` the latter before
    anything was learnt, by which it is weighed: by what it is now, one that came out too small would never grow again.
    """
    square = min(told[0] * told[0], CLIPPED * (told[1] + told[2]))
    return square - told[1], (begin / (told[1] + begin)) ** 2


@numba.njit(cache=True, error_model="numpy")
def learn_range(ranges, listener, range_m, told, stated):
    """Take in one range, of which variance ``stated`` is stated; ``told`` as `weigh` has it."""
    k = octave(range_m)
    square, weight = weigh(told, BEGIN_SD_M**2 + (SCALE_SD * range_m) ** 2)
    for row in (listener, len(ranges) - 1):
        keep = 1.0 - weight / (REMEMBERED if row == listener else SHARED)
        ranges[row, k, 0] = keep * ranges[row, k, 0] + weight
        ranges[row, k, 1] = keep * ranges[row, k, 1] + weight * square
        ranges[row, k, 2] = keep * ranges[row, k, 2] + weight * stated


@numba.njit(cache=True, error_model="numpy")
def learn_bearing(bearings, listener, told, body):
    """Take in one bearing, likewise; variance ``body`` is not its listener's."""
    square, weight = weigh(told, BEGIN_SD_RAD**2)
    for row in (listener, len(bearings) - 1):
        keep = 1.0 - weight / (REMEMBERED if row == listener else SHARED)
        bearings[row, 0] = keep * bearings[row, 0] + weight
        bearings[row, 1] = keep * bearings[row, 1] + weight * (square - body)


@numba.njit(cache=True, error_model="numpy")
def learn_share(share, told, last, since_s):
    """Take in two successive misses of a pair.

    ``told`` (4,), ``last`` (4,): miss, variance that the belief gave it, that of its noise, and the one taken for it.
    That the latter is more leaves a part of the belief's own error in the next miss, which is not counted.
    """
    fade = np.exp(-since_s / KEPT_S)
    if not fade > 0.1:
        return
    left = last[1] * (last[3] - last[2]) / (last[1] + last[3])
    weight = told[2] * last[2] / ((told[1] + told[2]) * (last[1] + last[2]))
    most = CLIPPED * told[2]
    keep = 1.0 - weight / SHARED
    product = min(max(told[0] * last[0] - left, -most), most) / told[2]
    share[0] = keep * share[0] + weight * product * fade
    share[1] = keep * share[1] + weight * fade * fade
