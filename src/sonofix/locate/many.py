"""Fixes by the thousand: one call for many epochs of ranges to fixed places, without Python in between.

All is one compiled loop, wrong ranges included; only epochs that fit two heights which nothing tells apart go the way
of `fix`. Both judge alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sonofix.geometry import Links
from sonofix.locate.exclude import MENDED
from sonofix.locate.fix import AMBIGUOUS_CHI2, Bounds, judged
from sonofix.locate.integrity import FALSE_ALARM, threshold
from sonofix.locate.standing import ONE_BY_ONE
from sonofix.locate.standing_all import solve_all
from sonofix.records import FixStatus, Floats, RangeEpoch

NEGATIVE_SIGMA = 6.0
"""Deviations that noise may put a range below 0 by, right at an anchor."""

STATUSES: tuple[FixStatus, ...] = ("ok", "too-few", "no-convergence", "inconsistent", "ambiguous")
"""What the numbers in `Fixes.status` mean."""

REMEDIES = (
    "",
    "too few ranges; bring more beacons in reach or state what is known (level_m)",
    "no position fits, or a direction is left open; check the anchors' places, spread them off one line or plane, or"
    " state level_m where all is near one level",
    "ranges disagree, and which is wrong cannot be told; check the anchors' places, sound speed and echoes",
    "two positions fit alike; state the room's bounds_m or the level_m, or move one anchor",
)
"""What would help, for each of `STATUSES`."""


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Positions from many epochs of ranges.

    Attributes
    ----------
    states : tuple of str
        Names of the rows of ``covariance``: x, y, then z and clock where they are solved for.
    status : int8 (n,)
        Index into `STATUSES`, 0 where all is well.
    position_m : float64 (n, 3)
        NaN where the status is neither "ok" nor "inconsistent".
    clock_offset_m : float64 (n,) or None
        Offset that an epoch's ranges share; NaN likewise; None where the clock is known.
    covariance : float64 (n, k, k)
        In m²; NaN likewise.
    chi2 : float64 (n,)
        Misfit of the rows used; NaN likewise.
    used : bool (n, b)
        Which ranges the position rests on.
    """

    states: tuple[str, ...]
    status: NDArray[np.int8]
    position_m: Floats
    clock_offset_m: Floats | None
    covariance: Floats
    chi2: Floats
    used: NDArray[np.bool_]

    def __len__(self) -> int:
        """Return the number of epochs."""
        return len(self.status)

    def remedy(self, epoch: int) -> str:
        """Return what would help one epoch; empty where it is well."""
        return REMEDIES[self.status[epoch]]


def fix_many(
    anchors_m: ArrayLike,
    ranges_m: ArrayLike,
    covariance_m2: ArrayLike,
    *,
    level_m: float | None = None,
    clock: bool = False,
    bounds_m: Sequence[Sequence[float]] | None = None,
) -> Fixes:
    """Solve each epoch's ranges for a position, as `fix` does for a receiver (or a sounder) that stands still in it.

    Parameters
    ----------
    anchors_m : float64 (b, 3)
        The fixed ends' places, less the lever arm's height where the receiver sits above the origin.
    ranges_m : float64 (n, b)
        An epoch a row, an anchor a column; NaN where not heard.
    covariance_m2 : float64 (b,), (b, b), (n, b) or (n, b, b)
        Variances of ranges, or their full covariance; the same in all epochs, or for each. Where n = b, two axes are
        one (b, b) covariance.
    level_m : float or None
        The level that the position lies on; None: solved for.
    clock : bool
        Whether all ranges of an epoch share an offset, which is solved for.
    bounds_m : (2, 3) or None
        Two corners of the room, lower first: what tells mirror solutions apart.

    Returns
    -------
    Fixes

    Raises
    ------
    ValueError
        If what is given is no numbers; shapes do not match; a place, a level or a range is not finite; a range is below
        0 by more than noise makes it where the clock is known; or the covariance of ranges heard is not positive,
        finite and symmetric.
    """
    anchors = _numbers("anchors_m", anchors_m, "one row of x, y, z an anchor")
    ranges = _numbers("ranges_m", ranges_m, "an epoch a row and an anchor a column, NaN where not heard")
    if anchors.ndim != 2 or anchors.shape[1] != 3:
        raise ValueError(f"anchors_m has shape {anchors.shape}; give one row of x, y, z an anchor: (b, 3)")
    if ranges.ndim != 2 or ranges.shape[1] != len(anchors):
        raise ValueError(f"ranges_m has shape {ranges.shape}; give a column an anchor: (n, {len(anchors)})")
    if not np.all(np.isfinite(anchors)):
        i = int(np.argmin(np.isfinite(anchors).all(axis=1)))
        raise ValueError(f"anchors_m[{i}] is {anchors[i].tolist()}; give finite places, or leave the anchor out")
    level = "a finite level, or None where it is solved for"
    if level_m is not None:
        given = _numbers("level_m", level_m, level)
        if given.ndim or not np.isfinite(given):
            raise ValueError(f"level_m {level_m}: give {level}")
        level_m = float(given)
    covariance, each = _covariances(_numbers("covariance_m2", covariance_m2, "variances or covariances"), *ranges.shape)
    _check_ranges(ranges, np.diagonal(covariance, axis1=1, axis2=2), clock)
    corners = "two corners of the room, the lower first: [[x, y, z], [x, y, z]]"
    bounds = _numbers("bounds_m", [[-np.inf] * 3, [np.inf] * 3] if bounds_m is None else bounds_m, corners)
    if bounds.shape != (2, 3) or not np.all(bounds[0] <= bounds[1]):
        raise ValueError(f"bounds_m {bounds_m}: give {corners}")
    flat, clock, n = level_m is not None, bool(clock), len(ranges)
    places = [0, 1] + [2] * (not flat)
    index = np.array(places + [3] * clock)
    degrees = np.maximum(np.arange(len(anchors) + 1) - len(index), 1)
    limits = np.array([[threshold(int(d), rate) for d in degrees] for rate in (FALSE_ALARM, MENDED)])
    status, state, chi2 = np.zeros(n, np.int8), np.full((n, 4), np.nan), np.full(n, np.nan)
    spreads, used = np.full((n, len(index), len(index)), np.nan), np.zeros((n, len(anchors)), bool)
    known = (flat, float(level_m or 0.0), clock, index)
    judge = (limits, AMBIGUOUS_CHI2, bounds_m is not None, bounds)
    bad = solve_all(anchors, ranges, covariance, each, known, judge, status, state, spreads, chi2, used)
    if bad >= 0:
        raise ValueError(f"covariance_m2 of epoch {bad} is not positive definite; give every range a variance above 0")
    room: Bounds | None = None if bounds_m is None else tuple(tuple(float(v) for v in corner) for corner in bounds)  # type: ignore[assignment]
    for e in np.flatnonzero(status == ONE_BY_ONE):
        heard = np.flatnonzero(np.isfinite(ranges[e]))
        own = covariance[e if each else 0][np.ix_(heard, heard)]
        epoch, links = _epoch(anchors[heard], ranges[e, heard], own, clock)
        found = judged(epoch, links, 0, "", level_m, room, np.zeros(2))
        status[e] = STATUSES.index(found.status)
        state[e], spreads[e], chi2[e] = np.nan, np.nan, np.nan
        if found.position_m is not None and found.covariance is not None:
            state[e, :3], spreads[e], used[e, heard] = found.position_m, found.covariance, found.used
            state[e, 3] = found.clock_offset_m or 0.0
            left, kept = found.residual_m[found.used], np.ix_(found.used, found.used)
            chi2[e] = left @ np.linalg.solve(own[kept], left)
    states = ("x", "y") + ("z",) * (not flat) + ("clock",) * clock
    return Fixes(states, status, state[:, :3], state[:, 3] if clock else None, spreads, chi2, used)


def _numbers(name: str, given: ArrayLike, remedy: str) -> Floats:
    """Return what was given as decimal numbers; refuse text, complex numbers and rows of different lengths by name."""
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "SUcmM":
            return np.asarray(array, float, order="C")
    except (TypeError, ValueError):
        pass
    raise ValueError(f"{name} {given!r:.80}: give numbers, {remedy}")


def _check_ranges(ranges: Floats, variance: Floats, clock: bool) -> None:
    """Refuse what would be solved to a wrong place without a word; ``variance`` (1 or n, b)."""
    endless = np.isinf(ranges)
    if endless.any():
        e, i = np.argwhere(endless)[0]
        raise ValueError(f"ranges_m[{e}, {i}] is {ranges[e, i]}; give NaN where an anchor was not heard")
    bad = np.isfinite(ranges) & ~((variance > 0.0) & np.isfinite(variance))
    if bad.any():
        e, i = np.argwhere(bad)[0]
        value = np.broadcast_to(variance, ranges.shape)[e, i]
        raise ValueError(
            f"covariance_m2 of epoch {e}, anchor {i} is {value}; give every range that was heard a variance above 0"
        )
    with np.errstate(invalid="ignore"):
        negative = ranges < (-np.inf if clock else -NEGATIVE_SIGMA * np.sqrt(variance))
    if negative.any():
        e, i = np.argwhere(negative)[0]
        raise ValueError(
            f"ranges_m[{e}, {i}] is {ranges[e, i]}; a range is not negative: give NaN where an anchor was not heard, "
            "or clock=True where all ranges of an epoch share an offset"
        )


def _covariances(given: Floats, n: int, b: int) -> tuple[Floats, bool]:
    """Return covariances (1 or n, b, b), and whether each epoch has its own."""
    if given.shape == (b,):
        return np.diag(given)[None], False
    if given.shape == (n, b) != (b, b):
        return given[:, :, None] * np.eye(b), True
    if given.shape in ((b, b), (n, b, b)):
        each = given.ndim == 3
        whole = np.ascontiguousarray(given if each else given[None])
        if not np.allclose(whole, whole.transpose(0, 2, 1), rtol=1e-6, atol=0.0, equal_nan=True):
            raise ValueError("covariance_m2 is not symmetric; give the covariance of ranges, in m²")
        return whole, each
    raise ValueError(f"covariance_m2 has shape {given.shape}; give ({b},), ({b}, {b}), ({n}, {b}) or ({n}, {b}, {b})")


def _epoch(anchors: Floats, ranges: Floats, covariance: Floats, clock: bool) -> tuple[RangeEpoch, Links]:
    """Return one epoch as `fix` takes it, heard at the origin of vehicle 0."""
    n = len(ranges)
    names = tuple(str(i) for i in range(n))
    zeros = np.zeros(n, np.int64)
    links = Links(zeros - 1, anchors, zeros, np.zeros((n, 3)), np.zeros(n))
    time_s, known = np.zeros(n), "common" if clock else "known"
    return RangeEpoch(0, 0.0, names, ("",) * n, time_s, ranges, covariance, None, None, None, known, 343.0), links
