"""Who sees whom across a floor plan: straight lines of sound against upright walls of some height.

Walls are vertical, so a line of sight is crossed where it is in plan, and is blocked if it is below the wall's top
there. That takes a handful of products a pair, and neither polygon clipping nor its library.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, Walls

FACE_M = 0.01
"""A node is fastened to a wall, not inside it: what a line crosses this close to the node does not block it."""


def in_sight(walls: Walls, nodes_m: Floats, places_m: Floats) -> NDArray[np.bool_]:
    """Whether the straight way from each node to each place passes no wall.

    Parameters
    ----------
    walls : Walls
    nodes_m : float64 (b, 3)
    places_m : float64 (p, 3)

    Returns
    -------
    bool (p, b)
    """
    nodes, places = (np.ascontiguousarray(a, dtype=np.float64) for a in (nodes_m, places_m))
    return _in_sight(walls.start_m, walls.end_m, walls.height_m, nodes, places)


@numba.njit(cache=True, error_model="numpy")
def _in_sight(start, end, height, nodes, places):
    out = np.ones((len(places), len(nodes)), np.bool_)
    for b in range(len(nodes)):
        nx, ny, nz = nodes[b]
        for p in range(len(places)):
            dx, dy, dz = places[p, 0] - nx, places[p, 1] - ny, places[p, 2] - nz
            near = FACE_M / max(np.sqrt(dx * dx + dy * dy), FACE_M)
            for k in range(len(height)):
                ax, ay = start[k, 0] - nx, start[k, 1] - ny
                wx, wy = end[k, 0] - start[k, 0], end[k, 1] - start[k, 1]
                cross = dx * wy - dy * wx
                if cross == 0.0:  # along the wall
                    continue
                along = (ax * wy - ay * wx) / cross
                if along <= near or along >= 1.0:
                    continue
                across = (ax * dy - ay * dx) / cross
                # where two pieces meet, neither may let sound through
                if across < -1e-9 or across > 1.0 + 1e-9:
                    continue
                if nz + along * dz < height[k]:
                    out[p, b] = False
                    break
    return out


def inside(walls: Walls, places_m: Floats) -> NDArray[np.bool_]:
    """Whether each place (p, 3) lies in an obstacle: within its outline, outside its holes, below its top.

    Even–odd rule, a ray to the east.
    """
    x, y, z = (np.asarray(places_m, float)[:, axis, None] for axis in range(3))
    out = np.zeros(len(places_m), bool)
    for number in np.unique(walls.solid[walls.solid >= 0]):
        edge = walls.solid == number
        (x0, y0), (x1, y1) = walls.start_m[edge].T, walls.end_m[edge].T
        spans = (y0 > y) != (y1 > y)
        rise = np.where(y1 == y0, 1.0, y1 - y0)
        east = x < x0 + (y - y0) / rise * (x1 - x0)
        out |= (np.sum(spans & east, axis=1) % 2 == 1) & (z[:, 0] < walls.height_m[edge][0])
    return out
