"""Where on a level a vehicle can be found, and how well: beacons in reach and horizontal dilution of precision."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.site import Site

Floats = NDArray[np.float64]

# Beyond this dilution a millimetre of range error is ten metres of position: no fix in any useful sense.
NO_FIX_HDOP = 1e4
MOST_POINTS = 4_000_000


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

    Notes
    -----
    With unit vectors u from each node in reach to the point, the normal matrix of the ranges is Σ u uᵀ (horizontal
    parts), and with an unknown clock Σ (u − ū)(u − ū)ᵀ, ū their mean: the Schur complement of the clock. HDOP is the
    root of the trace of its inverse (Kaplan and Hegarty, Understanding GPS, section 7.3).
    """
    for name, value, good in (
        ("level_m", level_m, True),
        ("spacing_m", spacing_m, spacing_m > 0),
        ("margin_m", margin_m, True),
        ("reach_m", 1.0 if reach_m is None else reach_m, reach_m is None or reach_m > 0),
    ):
        if not (np.isfinite(value) and good):
            raise ValueError(f"{name} = {value:g}; it must be {'a finite number' if good else 'above 0'}")
    nodes = _fixed_nodes(site)
    x, y = _grid(site, nodes, spacing_m, margin_m)
    count = np.zeros((y.size, x.size), dtype=np.int64)
    sum_x, sum_y, sum_xx, sum_xy, sum_yy = (np.zeros(count.shape) for _ in range(5))
    for node in nodes:
        east, north = x[None, :] - node[0], y[:, None] - node[1]
        distance = np.sqrt(east**2 + north**2 + (level_m - node[2]) ** 2)
        heard = np.full(count.shape, True) if reach_m is None else distance <= reach_m
        # A node at the very point tells no direction, so it adds a count and nothing else.
        scale = np.where(heard & (distance > 0), 1.0 / np.where(distance > 0, distance, 1.0), 0.0)
        ux, uy = east * scale, north * scale
        count += heard
        sum_x += ux
        sum_y += uy
        sum_xx += ux * ux
        sum_xy += ux * uy
        sum_yy += uy * uy
    if site.schedule is not None and not site.schedule.synchronised:
        share = 1.0 / np.maximum(count, 1)
        sum_xx, sum_xy, sum_yy = sum_xx - share * sum_x**2, sum_xy - share * sum_x * sum_y, sum_yy - share * sum_y**2
    trace, determinant = sum_xx + sum_yy, sum_xx * sum_yy - sum_xy**2
    # HDOP² = trace / determinant; compared without dividing, so that singular points need no special care.
    fix = (trace > 0) & (determinant * NO_FIX_HDOP**2 > trace)
    hdop = np.full(count.shape, np.nan)
    hdop[fix] = np.sqrt(trace[fix] / determinant[fix])
    return Coverage(x, y, float(level_m), count, hdop, float(np.mean(fix)))


def _fixed_nodes(site: Site) -> Floats:
    """Return the positions (n, 3) of the nodes that stand still: beacons before microphones, coded before others."""
    beacons = [b for b in site.coded_beacons if b.position_m is not None]
    beacons = beacons or [b for b in site.beacons if b.position_m is not None]
    nodes = beacons or [m for m in site.microphones if m.position_m is not None]
    if not nodes:
        raise ValueError("the site has no fixed node; give a beacon or a microphone a position_m")
    return np.array([node.position_m for node in nodes], dtype=np.float64)


def _grid(site: Site, nodes: Floats, spacing_m: float, margin_m: float) -> tuple[Floats, Floats]:
    """Return the x and the y of the map, centred in the area."""
    corners = np.array(site.bounds_m, dtype=np.float64) if site.bounds_m is not None else nodes
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
