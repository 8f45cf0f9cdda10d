"""Where a robot is that nobody has placed yet: from what was heard within some seconds, and its odometry meanwhile.

Its own odometry gives its way in a frame of its own; three numbers bring that into the frame of the site. All
directions are tried, each is bettered by robust Gauss–Newton steps, and the best is taken where no other comes near.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.noise import BEGIN_SHARE
from sonofix.track.stated import BEGIN_SD_M, SCALE_SD
from sonofix.track.wheels import COMPASS_SD_RAD

DIRECTIONS = 12
"""Headings tried."""

STEPS = 15
"""Gauss–Newton steps of each."""

BEARING_SD_RAD = 0.05
"""Taken for bearings of which nothing is learnt yet."""

LIMIT = 3.0
"""A residual of more deviations counts as this many: it is another thing that was heard."""

BEGIN_LIMIT = 16.0
"""So many times that the first step allows, half as many times each next."""

RIVALS = 9.0
"""How much more another place must cost."""

WAY_SD, TURN_SD = 0.1, 0.15
"""Of odometry of whose errors nothing is told, per metre and radian."""

LEAST = 6
"""Ranges and bearings that must agree: what is sought told twice over, as one thing heard may have been another."""

AGREEING = 0.7
"""Share of the rows that must be within `LIMIT`."""

PLACED_SD = (0.5, 0.3)
"""In m and rad: a place that is known no better is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """Errors that some of m clues may have in common.

    Attributes
    ----------
    spread : float64 (m, 3, 3)
        Covariance of the other end's pose, shared to any degree; zeros where it is fixed.
    astray : float64 (m, 3, q)
        Derivative of the robot's own pose, seen from where it is now, by q errors of odometry of unit variance.
    stray : float64 (m, 3, 3)
        Covariance of what odometry does not tell of the way since.
    """

    spread: Floats
    astray: Floats
    stray: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Clues:
    """What may place one robot, a row each of m.

    Attributes
    ----------
    own : float64 (m, 3)
        The robot's pose in the frame of its odometry.
    other : float64 (m, 3)
        Pose of the end that it heard, or that heard it, lever arm included; yaw 0 where fixed.
    anchor : int (m,)
        Which placed robot that is; −1: a fixed end.
    listens : bool (m,)
        The robot itself heard; else the other did.
    arm : float64 (m, 3)
        Lever arm of its own end, and how much higher the other one is.
    range_m, bearing_rad : float64 (m,)
        NaN where not measured.
    compass : bool (m,)
        ``bearing_rad`` is the robot's heading, by its compass.
    pair : int (m,)
        Number of its pair of ends.
    shared : Shared or None
        What is known of errors that clues have in common. None: they are taken for new each time.
    """

    own: Floats
    other: Floats
    anchor: NDArray[np.int64]
    listens: NDArray[np.bool_]
    arm: Floats
    range_m: Floats
    bearing_rad: Floats
    compass: NDArray[np.bool_]
    pair: NDArray[np.int64]
    shared: Shared | None
    doubt: Floats | None = None
    """Where nothing is known of such, by how much odometry may have erred since, (m, 2) in m and rad: `place` tells."""

    def keep(self, rows: NDArray[np.bool_]) -> Clues:
        """Return some of them alone, of which no errors are shared."""
        return Clues(
            self.own[rows], self.other[rows], self.anchor[rows], self.listens[rows], self.arm[rows],
            self.range_m[rows], self.bearing_rad[rows], self.compass[rows], self.pair[rows], None,
            None if self.doubt is None else self.doubt[rows],
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A robot's pose (3,) by clues, its covariance (3, 3) from them alone, and its derivative (3, 3) by each anchor."""

    pose: Floats
    covariance: Floats
    by: dict[int, Floats]


def place(clues: Clues, now: Floats, sd: tuple[float, float] = PLACED_SD) -> Placed | None:
    """Return where a robot is whose odometry has it at ``now`` (3,) in its own frame; None where clues do not say.

    ``sd``: in m and rad, how well they must.
    """
    told = np.count_nonzero(np.isfinite(clues.range_m)) + np.count_nonzero(np.isfinite(clues.bearing_rad))
    if told < LEAST:
        return None
    best: list[tuple[float, Floats]] = []
    clues = replace(clues, doubt=doubt_of(clues, now))
    for start in _starts(clues):
        found = settle(clues, start)
        best.append((_cost(clues, found), found))
    best.sort(key=lambda pair: pair[0])
    cost, found = best[0]
    missed = residuals(clues, found)
    residual, by, by_other = missed.residual, missed.by, missed.by_other
    kept = np.abs(residual) < LIMIT
    if np.count_nonzero(kept) < max(LEAST, AGREEING * len(residual)):
        return None
    information = by[kept].T @ by[kept]
    if not np.linalg.cond(information) < 1e12:
        return None
    covariance = np.linalg.inv(information)
    for other_cost, other in best[1:]:
        apart = _at(other, now) - _at(found, now)
        apart[2] -= 2 * np.pi * np.round(apart[2] / (2 * np.pi))
        if other_cost - cost < RIVALS and np.any(np.abs(apart) > [0.5, 0.5, 0.5]):
            return None
    cos, sin = np.cos(found[2]), np.sin(found[2])
    turn = np.eye(3)
    turn[:2, 2] = [-sin * now[0] - cos * now[1], cos * now[0] - sin * now[1]]
    spread = turn @ covariance @ turn.T
    if clues.shared is not None:
        spread = _bounded(clues, clues.shared, found, kept, -turn @ covariance @ by[kept].T)
    if np.sqrt(max(spread[0, 0], spread[1, 1])) > sd[0] or np.sqrt(spread[2, 2]) > sd[1]:
        return None
    gain = -turn @ covariance @ by[kept].T
    whose = np.concatenate([clues.anchor, clues.anchor])[_told(clues)][kept]
    moved = {who: gain @ (by_other[kept] * (whose == who)[:, None]) for who in np.unique(whose[whose >= 0]).tolist()}
    return Placed(_at(found, now), spread, moved)


def _cost(clues: Clues, frame: Floats) -> float:
    """Return the sum of squared misses; where errors may be shared, so much of those of one pair counts once."""
    missed = residuals(clues, frame)
    square, new = np.minimum(missed.residual**2, LIMIT**2), missed.new
    if clues.shared is None:
        return float(np.sum(square))
    _, place, count = np.unique(_kinds(clues), return_inverse=True, return_counts=True)
    return float(np.sum(square * (new + (1.0 - new) / count[place])))


def _bounded(clues: Clues, shared: Shared, frame: Floats, kept: NDArray[np.bool_], gain: Floats) -> Floats:
    """Return the covariance (3, 3) of a place by clues that share errors.

    ``gain`` (3, k) says what whitened misses make of the place. Half of noise lasts for all clues of a pair, and
    errors of odometry for all clues. What others, and ways untold, make of the place may be shared to any degree: the
    sum's covariance is no larger than that of each, 1/ω times as large, if Σ ω = 1 (covariance intersection); here ω
    goes with their deviations.
    """
    missed = residuals(clues, frame)
    m, turn = len(clues.range_m), _turn(frame)
    row = np.tile(np.arange(m), 2)[_told(clues)][kept]
    by_other, by_own, new = missed.by_other[kept], missed.by_own[kept] @ turn, missed.new[kept]
    parts: list[Floats] = []
    for k in np.unique(row).tolist():
        some = row == k
        alike = by_other[some] @ shared.spread[k] @ by_other[some].T + by_own[some] @ shared.stray[k] @ by_own[some].T
        parts.append(gain[:, some] @ alike @ gain[:, some].T)
    scale = np.sqrt([np.trace(part) for part in parts])
    bound = np.sum([part * scale.sum() / max(one, 1e-12) for part, one in zip(parts, scale, strict=True)], axis=0)
    by_odometry = gain @ np.einsum("ki,kiq->kq", by_own, shared.astray[row])
    lasting = np.sqrt(BEGIN_SHARE / (1.0 - BEGIN_SHARE) * new)
    which = _kinds(clues)[kept]
    by_views = np.column_stack([gain[:, which == one] @ lasting[which == one] for one in np.unique(which)])
    return bound + gain @ (new[:, None] * gain.T) + by_odometry @ by_odometry.T + by_views @ by_views.T


def _kinds(clues: Clues) -> NDArray[np.int64]:
    """Return numbers (k,) of what is measured of whom: ranges and bearings of each pair."""
    return np.concatenate([clues.pair, -1 - clues.pair])[_told(clues)]


def _turn(frame: Floats) -> Floats:
    """Return what turns poses (3,) of the robot's own frame into the site's directions."""
    cos, sin = np.cos(frame[2]), np.sin(frame[2])
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def doubt_of(clues: Clues, now: Floats) -> Floats:
    """Return `Clues.doubt` of a robot that its odometry has at ``now`` (3,)."""
    way = np.hypot(*(clues.own[:, :2] - now[:2]).T)
    turned = np.abs(clues.own[:, 2] - now[2])
    return np.column_stack([WAY_SD * way + TURN_SD * turned * way / 2, TURN_SD * turned])


def _told(clues: Clues) -> NDArray[np.bool_]:
    """Which of all ranges, then all bearings, were measured."""
    return np.concatenate([np.isfinite(clues.range_m), np.isfinite(clues.bearing_rad)])


def _at(frame: Floats, own: Floats) -> Floats:
    """Bring a pose of the robot's own frame into the site's."""
    cos, sin = np.cos(frame[2]), np.sin(frame[2])
    return np.array([frame[0] + cos * own[0] - sin * own[1], frame[1] + sin * own[0] + cos * own[1], frame[2] + own[2]])


def _starts(clues: Clues) -> list[Floats]:
    """Frames to begin with: for each heading where ranges with directions say, else round the other ends."""
    directed = np.isfinite(clues.range_m) & np.isfinite(clues.bearing_rad) & ~clues.compass
    heard = ~clues.compass
    out: list[Floats] = []
    for heading in 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        yaw = heading + clues.own[:, 2]
        cos, sin = np.cos(heading), np.sin(heading)
        from_own = np.column_stack(
            [cos * clues.own[:, 0] - sin * clues.own[:, 1], sin * clues.own[:, 0] + cos * clues.own[:, 1]]
        )
        if directed.any():
            toward = np.where(clues.listens, yaw + clues.bearing_rad, clues.other[:, 2] + clues.bearing_rad + np.pi)
            there = clues.other[:, :2] - clues.range_m[:, None] * np.column_stack([np.cos(toward), np.sin(toward)])
            out.append(np.array([*np.median((there - from_own)[directed], axis=0), heading]))
        elif heard.any():
            middle = np.mean(clues.other[heard, :2] - from_own[heard], axis=0)
            reach = float(np.nanmedian(clues.range_m)) if np.isfinite(clues.range_m).any() else 1.0
            out += [
                np.array([*(middle + reach * np.array(side)), heading]) for side in ((1, 0), (-1, 0), (0, 1), (0, -1))
            ]
    return out


def settle(clues: Clues, frame: Floats) -> Floats:
    """Return the frame (3,) that robust Gauss–Newton steps lead to, from all that was heard to what agrees."""
    for step in range(STEPS):
        # graduated non-convexity (Yang et al., RA-L 5(2), 2020): from afar all would count as outliers
        limit = LIMIT * max(1.0, BEGIN_LIMIT * 0.5**step)
        missed = residuals(clues, frame)
        residual, by = missed.residual, missed.by
        weight = 1.0 / (1.0 + (residual / limit) ** 2) ** 2  # Geman and McClure 1987
        normal = by.T @ (weight[:, None] * by) + 1e-6 * np.eye(3)
        moved = -np.linalg.solve(normal, by.T @ (weight * residual))
        moved[:2] *= min(1.0, 2.0 / max(np.hypot(*moved[:2]), 1e-9))
        moved[2] = np.clip(moved[2], -0.5, 0.5)
        frame = frame + moved
        if limit == LIMIT and np.max(np.abs(moved)) < 1e-6:
            break
    return frame


@dataclass(frozen=True, slots=True, eq=False)
class _Missed:
    """What clues miss by: all ranges that were measured, then all bearings, k in all.

    Attributes
    ----------
    residual : float64 (k,)
        Misses over their deviations.
    by, by_other, by_own : float64 (k, 3)
        Their derivatives by the frame, by the other end, and by the robot's own pose then.
    new : float64 (k,)
        What share of their variances is new each time.
    """

    residual: Floats
    by: Floats
    by_other: Floats
    by_own: Floats
    new: Floats


def residuals(clues: Clues, frame: Floats) -> _Missed:
    """Return by how much a frame (3,) misses clues: all ranges that were measured, then all bearings."""
    cos, sin = np.cos(frame[2]), np.sin(frame[2])
    ox, oy = clues.own[:, 0], clues.own[:, 1]
    yaw = frame[2] + clues.own[:, 2]
    ax = np.cos(yaw) * clues.arm[:, 0] - np.sin(yaw) * clues.arm[:, 1]
    ay = np.sin(yaw) * clues.arm[:, 0] + np.cos(yaw) * clues.arm[:, 1]
    from_x, from_y = cos * ox - sin * oy + ax, sin * ox + cos * oy + ay
    dx, dy = clues.other[:, 0] - frame[0] - from_x, clues.other[:, 1] - frame[1] - from_y
    flat = np.maximum(dx**2 + dy**2, 1e-6)
    r = np.sqrt(flat + clues.arm[:, 2] ** 2)
    m = len(r)
    range_new = BEGIN_SD_M**2 + (SCALE_SD * np.nan_to_num(clues.range_m)) ** 2
    by_place = np.column_stack([-dx / r, -dy / r])  # of r, by the robot's place
    range_by = np.column_stack([by_place, -by_place[:, 0] * from_y + by_place[:, 1] * from_x])
    range_other = np.column_stack([-by_place, np.zeros(m)])
    direction = np.where(clues.listens, np.arctan2(dy, dx), np.arctan2(-dy, -dx))
    about = np.where(clues.listens, yaw, clues.other[:, 2])
    bearing_place = np.column_stack([dy / flat, -dx / flat])  # the same for both ways round
    bearing_by = np.column_stack(
        [bearing_place, -bearing_place[:, 0] * from_y + bearing_place[:, 1] * from_x - clues.listens]
    )
    bearing_other = np.column_stack([-bearing_place, -1.0 * ~clues.listens])
    off = direction - about - clues.bearing_rad
    if clues.compass.any():
        c = clues.compass
        off[c] = (yaw - clues.bearing_rad)[c]
        bearing_by[c] = [0.0, 0.0, 1.0]
        bearing_other[c] = 0.0
    off = off - 2 * np.pi * np.round(off / (2 * np.pi))
    bearing_new = np.where(clues.compass, COMPASS_SD_RAD, BEARING_SD_RAD) ** 2
    by, other = np.vstack([range_by, bearing_by]), np.vstack([range_other, bearing_other])
    own = by.copy()
    own[:m, 2], own[m:, 2] = 0.0, np.where(clues.compass, 1.0, -1.0 * clues.listens)
    noise = np.concatenate([range_new, bearing_new])
    if clues.shared is None:
        way, turned = (np.zeros(m), np.zeros(m)) if clues.doubt is None else clues.doubt.T
        variance = noise + np.concatenate([way, turned + way / np.sqrt(flat)]) ** 2
    else:
        errors, turn = clues.shared, _turn(frame)
        ways = turn @ (errors.astray @ errors.astray.transpose(0, 2, 1) + errors.stray) @ turn.T
        variance = (
            noise + _along(own, np.vstack([ways, ways])) + _along(other, np.vstack([errors.spread, errors.spread]))
        )
    sd = np.sqrt(variance)
    residual = np.concatenate([r - clues.range_m, off]) / sd
    new = (1.0 - BEGIN_SHARE) * noise / sd**2
    told = _told(clues)
    return _Missed(
        residual[told], (by / sd[:, None])[told], (other / sd[:, None])[told], (own / sd[:, None])[told], new[told]
    )


def _along(rows: Floats, spread: Floats) -> Floats:
    """Return the variances (m,) of m rows (m, 3) of as many errors of covariance (m, 3, 3)."""
    return np.einsum("ki,kij,kj->k", rows, spread, rows)
