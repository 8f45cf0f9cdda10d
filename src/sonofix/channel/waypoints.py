"""A drive along waypoints: straight legs at constant speed, corners rounded by arcs, so that velocity is continuous."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sonofix.channel.motion import Poses
from sonofix.records import Floats

SHARPEST_TURN_RAD = np.radians(170.0)
"""Beyond this a corner is a reversal, which no arc can round."""


SHORTEST_LEG_M = 1e-6
"""Neighbouring points nearer than this are the same point."""


@dataclass(frozen=True, slots=True, eq=False)
class _Path:
    """Pieces in order of arc length: straight where ``curvature`` is 0, else arcs from ``along`` towards ``inward``."""

    start_s: Floats  # (k + 1,) arc length at each piece's start, and the whole length
    point: Floats  # (k, 3) where each piece starts
    along: Floats  # (k, 3) unit vector, its direction there
    inward: Floats  # (k, 3) unit vector towards the arc's centre; 0 where straight
    curvature: Floats  # (k,) 1/m
    yaw: Floats  # (k,) heading at each piece's start, unwrapped
    turn_rad: float  # heading gained over the whole path


@dataclass(frozen=True, slots=True)
class Waypoints:
    """Along straight legs between ``points_m``, corners rounded.

    The vehicle passes the path's start at time 0 at full speed (before, it came along the first leg) and brakes to rest
    at the last point. Where the last point is the first again, it laps the closed path for ever, starting where
    the first leg becomes straight. Yaw follows the direction of travel, so that the vehicle never slips sideways.

    Attributes
    ----------
    points_m : tuple of (x, y, z)
        At least two, neighbours apart.
    speed_mps : float
        Kept on legs and in corners.
    radius_m : float
        Of the corners' arcs; smaller where half a leg leaves no room for them.
    braking_mps2 : float
        Deceleration at the end; stronger where the path is too short for it.
    """

    points_m: tuple[tuple[float, float, float], ...]
    speed_mps: float
    radius_m: float = 0.5
    braking_mps2: float = 1.0
    _path: _Path = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the points and lay the path.

        Raises
        ------
        ValueError
            Fewer than two points, equal neighbours, a reversal, or a speed, radius or braking that is not positive.
        """
        for name in ("speed_mps", "radius_m", "braking_mps2"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} = {getattr(self, name)}; it must be positive")
        points = np.asarray(self.points_m, float)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or not np.isfinite(points).all():
            raise ValueError(f"points_m = {self.points_m}; at least two points of three finite numbers are needed")
        object.__setattr__(self, "_path", _laid(points, self.radius_m, self.closed))

    @property
    def closed(self) -> bool:
        """Whether the path ends where it began, and is driven lap by lap."""
        return len(self.points_m) > 3 and tuple(self.points_m[0]) == tuple(self.points_m[-1])

    @property
    def length_m(self) -> float:
        """Length of the way, corners as driven; of one lap where closed."""
        return float(self._path.start_s[-1])

    def at(self, time_s: Floats) -> Poses:
        """Return the poses at ``time_s`` (n,)."""
        time, path, length = np.asarray(time_s, float), self._path, self.length_m
        if self.closed:
            laps, way = np.divmod(time * self.speed_mps, length)
            speed = np.full(len(time), self.speed_mps)
        else:
            laps = np.zeros(len(time))
            braking = max(self.braking_mps2, self.speed_mps**2 / (2 * length))
            before_end = length / self.speed_mps + self.speed_mps / (2 * braking) - time  # time left until rest
            left = np.clip(before_end, 0.0, self.speed_mps / braking)
            cruising = before_end > self.speed_mps / braking
            way = np.where(cruising, time * self.speed_mps, length - braking * left**2 / 2)
            speed = np.where(cruising, self.speed_mps, braking * left)
        i = np.clip(np.searchsorted(path.start_s, way, side="right") - 1, 0, len(path.curvature) - 1)
        inside = (way - path.start_s[i])[:, None]
        bend = path.curvature[i][:, None]
        angle = inside * bend
        # sin and versine over the curvature; both limits hold on straight pieces
        radius = 1.0 / np.where(bend > 0, bend, 1.0)
        forward = np.where(bend > 0, np.sin(angle) * radius, inside)
        sideways = np.where(bend > 0, (1.0 - np.cos(angle)) * radius, 0.0)
        position = path.point[i] + forward * path.along[i] + sideways * path.inward[i]
        direction = np.cos(angle) * path.along[i] + np.sin(angle) * path.inward[i]
        yaw = _heading(direction, path.yaw[i]) + laps * path.turn_rad
        return Poses(position, speed[:, None] * direction, yaw)


def _heading(direction: Floats, near: Floats) -> Floats:
    """Heading of unit vectors (n, 3), unwrapped to within π of ``near`` (n,); ``near`` where they are vertical."""
    off = np.arctan2(direction[:, 1], direction[:, 0]) - near
    level = np.hypot(direction[:, 0], direction[:, 1]) > 1e-9
    return near + np.where(level, off - 2 * np.pi * np.round(off / (2 * np.pi)), 0.0)


def _laid(points: Floats, radius_m: float, closed: bool) -> _Path:
    """Pieces of the path: leg, arc, leg, …; closed ones start on the first leg and end with the first point's arc."""
    legs = np.diff(points, axis=0)
    length = np.linalg.norm(legs, axis=1)
    if (length < SHORTEST_LEG_M).any():
        k = int(np.flatnonzero(length < SHORTEST_LEG_M)[0])
        raise ValueError(f"points_m: points {k + 1} and {k + 2} are the same, {tuple(points[k].tolist())}; drop one")
    unit = legs / length[:, None]
    count = len(legs)
    corners = range(count if closed else count - 1)  # corner k joins leg k to the next
    cut = np.zeros(count)  # what the corner after leg k takes of both its legs
    turn = np.zeros(count)
    for k in corners:
        after = (k + 1) % count
        turn[k] = np.arccos(np.clip(unit[k] @ unit[after], -1.0, 1.0))
        if turn[k] > SHARPEST_TURN_RAD:
            raise ValueError(
                f"points_m: the path turns back on itself at {tuple(points[k + 1].tolist())}; "
                "add a point beside it, so that the corner can be driven round"
            )
        cut[k] = min(radius_m * np.tan(turn[k] / 2), length[k] / 2, length[after] / 2)
    pieces: list[tuple[Floats, Floats, Floats, float, float]] = []  # point, along, inward, curvature, length
    straight = np.zeros(3)
    for k in range(count):
        taken = cut[k - 1] if k or closed else 0.0  # cut[-1] is the closing corner's
        pieces.append((points[k] + taken * unit[k], unit[k], straight, 0.0, length[k] - taken - cut[k]))
        if cut[k] > 1e-12:
            radius = cut[k] / np.tan(turn[k] / 2)
            inward = unit[(k + 1) % count] - np.cos(turn[k]) * unit[k]
            inward /= np.linalg.norm(inward)
            pieces.append((points[k + 1] - cut[k] * unit[k], unit[k], inward, 1.0 / radius, radius * turn[k]))
    # a half-cut leg has no length left, but rounding may have given it less than none
    lengths = np.maximum([p[4] for p in pieces], 0.0)
    yaw = np.zeros(len(pieces) + 1)
    near = np.zeros(1)
    for k, (_, along, _, _, _) in enumerate(pieces):
        near = _heading(along[None], near)
        yaw[k] = near[0]
    # the end of the last piece; on a closed path that is the first direction again, some turns later
    yaw[-1] = _heading(pieces[0][1][None] if closed else unit[-1:], near)[0]
    return _Path(
        np.concatenate([[0.0], np.cumsum(lengths)]),
        np.array([p[0] for p in pieces]),
        np.array([p[1] for p in pieces]),
        np.array([p[2] for p in pieces]),
        np.array([p[3] for p in pieces]),
        yaw[:-1],
        float(yaw[-1] - yaw[0]),
    )
