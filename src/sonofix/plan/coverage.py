"""Where on a level a vehicle can be found, and how well: beacons in reach and horizontal dilution of precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.plan.judge import judged
from sonofix.site import Beacon, Microphone, Site

Floats = NDArray[np.float64]

MOST_POINTS = 4_000_000
AT_ONCE = 4096
"""Places whose distances are held at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """A map of one level, east-north-up frame; grids are indexed ``[j, i]`` for the point ``(x_m[i], y_m[j])``.

    Attributes
    ----------
    x_m : float64 (nx,)
    y_m : float64 (ny,)
    level_m : float
        Height of the map: that of the vehicle's microphone (or of its beacon, where the vehicle sounds).
    count : int64 (ny, nx)
        Fixed beacons within reach (fixed microphones, where the vehicle sounds).
    hdop : float64 (ny, nx)
        Standard deviation of the horizontal position, √(σx² + σy²), for ranges of unit standard deviation and a known
        level; NaN where no fix is possible: too few in reach, or all on one line with the point.
    share_covered : float
        Share of the points with a fix, 0 … 1.
    """

    x_m: Floats
    y_m: Floats
    level_m: float
    count: NDArray[np.int64]
    hdop: Floats
    share_covered: float


def coverage(
    site: Site, level_m: float, spacing_m: float = 0.5, margin_m: float = 0.0, reach_m: float | None = None
) -> Coverage:
    """Map how many beacons reach each point of a level, and the horizontal dilution of precision there.

    The unknowns are x and y, and the clock offset too where the site's schedule is not synchronised, so a fix takes two
    or three ranges. Two ranges, or beacons on one line, leave a mirror solution, which no dilution shows.

    Parameters
    ----------
    site : Site
        Its fixed beacons count, those with a code if any has one; its fixed microphones where no beacon is fixed.
        The map spans ``bounds_m``, or else the horizontal box of the fixed nodes.
    level_m : float
        Height of what moves: the vehicle's ``z_m`` plus the upward part of the lever arm.
    spacing_m : float
        Distance of grid points; the grid is centred in the area.
    margin_m : float
        Strip left out along the edges of the area; a negative one widens it.
    reach_m : float or None
        Greatest slant range at which a burst is heard; None: everywhere.

    Returns
    -------
    Coverage

    Raises
    ------
    ValueError
        No node is fixed, an argument is out of range, the margin leaves no area, or the grid would be too large.
    """
    for name, value, good in (
        ("level_m", level_m, True),
        ("reach_m", 1.0 if reach_m is None else reach_m, reach_m is None or reach_m > 0),
    ):
        if not (np.isfinite(value) and good):
            raise ValueError(f"{name} = {value:g}; it must be {'a finite number' if good else 'above 0'}")
    nodes = np.array([node.position_m for node in coded_or_all(site)], dtype=np.float64)
    x, y = grid(site, spacing_m, margin_m)
    places = np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x)), np.full(len(x) * len(y), level_m)])
    clock = site.schedule is not None and not site.schedule.synchronised
    count, hdop = np.zeros(len(places), np.int64), np.zeros(len(places))
    for start in range(0, len(places), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        apart = np.linalg.norm(places[part, None, :] - nodes[None, :, :], axis=2)
        got = judged(places[part], nodes, apart <= (np.inf if reach_m is None else reach_m), clock=clock)
        count[part], hdop[part] = got.heard, got.hdop
    shape = (len(y), len(x))
    return Coverage(x, y, float(level_m), count.reshape(shape), hdop.reshape(shape), float(np.mean(np.isfinite(hdop))))


def coded_or_all(site: Site) -> Sequence[Beacon] | Sequence[Microphone]:
    """Return the nodes that stand still: beacons before microphones, coded before others.

    Raises
    ------
    ValueError
        Nothing is fixed.
    """
    beacons = [b for b in site.coded_beacons if b.position_m is not None]
    beacons = beacons or [b for b in site.beacons if b.position_m is not None]
    nodes = beacons or [m for m in site.microphones if m.position_m is not None]
    if not nodes:
        raise ValueError("the site has no fixed node; give a beacon or a microphone a position_m")
    return nodes


def grid(site: Site, spacing_m: float, margin_m: float) -> tuple[Floats, Floats]:
    """Return the x and the y of a map of the site, centred in ``bounds_m``, or else in the box of its fixed nodes.

    Raises
    ------
    ValueError
        An argument is out of range, the margin leaves no area, or there would be too many points.
    """
    for name, value, good in (("spacing_m", spacing_m, spacing_m > 0), ("margin_m", margin_m, True)):
        if not (np.isfinite(value) and good):
            raise ValueError(f"{name} = {value:g}; it must be {'a finite number' if good else 'above 0'}")
    corners = np.array(site.bounds_m or [node.position_m for node in coded_or_all(site)], dtype=np.float64)
    low, high = corners.min(axis=0)[:2], corners.max(axis=0)[:2]
    size = high - low - 2.0 * margin_m
    if np.any(size < 0):
        raise ValueError(f"margin_m = {margin_m:g} leaves nothing of {high[0] - low[0]:g} m by {high[1] - low[1]:g} m")
    # A width of a whole number of spacings keeps its last point in spite of rounding.
    points = np.floor(size / spacing_m + 1e-9) + 1
    if points.prod() > MOST_POINTS:
        raise ValueError(
            f"spacing_m = {spacing_m:g} makes {points.prod():.3g} points of {size[0]:g} m by {size[1]:g} m;"
            f" take at least {spacing_m * np.sqrt(points.prod() / MOST_POINTS):.2g} m"
        )
    centre = (low + high) / 2.0
    x, y = (c + spacing_m * (np.arange(int(n)) - (n - 1) / 2.0) for c, n in zip(centre, points, strict=True))
    return x, y
