"""A robot placed by two that stand: the third seed's triangle (eqs 1, 2), both its solutions, and their covariance.

K and R2 stand at known places, R1 is ranged from both. With a the part of K–R1 along K–R2 (length d3),

    a = (d3² + d2² − d1²) / (2 d3) = d2 cos θ3,   h² = d2² − a²,

R1 lies at a along and ±h beside that line: θ1 = θ2 ± θ3, of which the seed keeps the first quadrant's. Nothing but the
covariance divides by h, so places stay right where arccos would lose digits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sonofix.records import Floats

FLAT_SD = 5.0
"""Deviations of its height below which a triangle is flat: there its two solutions flow into each other, and a
covariance of first order means nothing. Above, the height's bias −σ²/(2h) is a tenth of its deviation at most."""

IMPOSSIBLE_SD = 5.0
"""Deviations by which h² may be negative before ranges contradict each other."""

SHORT_SD = 5.0
"""Deviations of its length that a base line needs at least."""

SURE_ODDS = 1000.0
"""Likelihood of one solution over the other at which it is chosen."""

Side = Literal["left", "right"]
Status = Literal["ok", "ambiguous", "flat", "no-triangle", "short-base"]


@dataclass(frozen=True, slots=True, eq=False)
class Corner:
    """One of the two solutions.

    Attributes
    ----------
    side : "left" or "right"
        Of the line from K to R2, looking towards R2.
    position_m : float64 (2,)
        Of R1, in the frame of K and R2.
    covariance_m2 : float64 (2, 2)
    crossed_m2 : float64 (2, 4)
        Covariance of R1's place with those of K and R2 (x, y of each): what a chain of triangles hands on.
    """

    side: Side
    position_m: Floats
    covariance_m2: Floats
    crossed_m2: Floats


@dataclass(frozen=True, slots=True, eq=False)
class TriangleFix:
    """Where R1 may be.

    Attributes
    ----------
    status : str
        "ok"; "ambiguous": two solutions and nothing to choose by; "flat": R1 on the line through K and R2, as far as
        the ranges tell; "no-triangle": ranges contradict each other; "short-base": K and R2 too close together.
    remedy : str
        What would help; empty where ok.
    chosen : Corner or None
        None unless ok.
    corners : tuple of Corner
        Left and right; empty where there is none of first order (flat, no triangle, short base).
    """

    status: Status
    remedy: str
    chosen: Corner | None
    corners: tuple[Corner, ...]


def triangle(
    anchors_m: Floats,
    anchors_covariance_m2: Floats,
    ranges_m: Floats,
    ranges_covariance_m2: Floats,
    side: Side | None = None,
    expected: tuple[Floats, Floats] | None = None,
) -> TriangleFix:
    """Place R1 by its ranges from K and R2, eqs 1 and 2 of the third seed, in the plane.

    Parameters
    ----------
    anchors_m : float64 (2, 2)
        Places of K and R2; a row each.
    anchors_covariance_m2 : float64 (4, 4)
        Of (x, y) of K, then of R2, with what they share. Zero where they define the frame.
    ranges_m : float64 (2,)
        |K R1| and |R2 R1|: the seed's d2 and d1, in the plane.
    ranges_covariance_m2 : float64 (2, 2)
        Independent of the places.
    side : "left" or "right", optional
        Half-plane that R1 keeps to, seen from K towards R2.
    expected : (position_m (2,), covariance_m2 (2, 2)), optional
        Where R1 should be, by its last place and what it moved since; chooses unless ``side`` does.

    Returns
    -------
    TriangleFix
        Covariances by first-order propagation of all that is uncertain.

    Raises
    ------
    ValueError
        If shapes are wrong, values not finite, a range not positive, or a covariance not one.
    """
    anchors, ranges = np.asarray(anchors_m, np.float64), np.asarray(ranges_m, np.float64)
    base_covariance = np.asarray(anchors_covariance_m2, np.float64)
    noise = np.asarray(ranges_covariance_m2, np.float64)
    _check(anchors, base_covariance, ranges, noise)
    base = anchors[1] - anchors[0]
    d3 = float(np.hypot(*base))
    along = base / d3 if d3 > 0.0 else np.array([1.0, 0.0])
    to_base = np.concatenate([-along, along])
    base_sd = float(np.sqrt(to_base @ base_covariance @ to_base))
    if d3 <= SHORT_SD * base_sd or d3 == 0.0:
        text = f"K and R2 stand {d3:.3g} m apart, known to {base_sd:.2g} m: move one of them away"
        return TriangleFix("short-base", text, None, ())
    d2, d1 = float(ranges[0]), float(ranges[1])
    a = (d3**2 + (d2 - d1) * (d2 + d1)) / (2 * d3)
    h2 = (d2 - a) * (d2 + a)
    # derivatives of h² by d2, d1 and d3
    by_ranges = np.array([2 * d2 - 2 * a * d2 / d3, 2 * a * d1 / d3])
    by_base = -2 * a * (1 - a / d3)
    h2_sd = float(np.sqrt(by_ranges @ noise @ by_ranges + (by_base * base_sd) ** 2))
    if h2 < -IMPOSSIBLE_SD * h2_sd - 1e-12 * d3**2:
        text = f"ranges of {d2:.3f} m and {d1:.3f} m over a base of {d3:.3f} m meet nowhere: measure them again"
        return TriangleFix("no-triangle", text, None, ())
    # the height's deviation is that of h² over 2 h
    if 2 * h2 <= FLAT_SD * h2_sd or h2 <= 1e-12 * d3**2:
        text = f"R1 is near the line through K and R2, {a:.3f} m from K: let it, or one of them, move aside"
        return TriangleFix("flat", text, None, ())
    h = float(np.sqrt(h2))
    normal = np.array([-along[1], along[0]])
    corners = tuple(
        _corner(side_, anchors, anchors[0] + a * along + sign * h * normal, ranges, noise, base_covariance)
        for side_, sign in _SIDES
    )
    return _chosen(corners, side, expected)


def measured_base(
    control_m: Floats,
    control_covariance_m2: Floats,
    length_m: float,
    length_sd_m: float,
    bearing_rad: float,
    bearing_sd_rad: float,
) -> tuple[Floats, Floats]:
    """Places of K and R2 with their joint covariance, from a measured base line: the seed's d3 and θ2.

    Parameters
    ----------
    control_m, control_covariance_m2 : float64 (2,), (2, 2)
        Place of K.
    length_m, bearing_rad : float
        d3 = |K R2|, and the direction of R2 from K, counter-clockwise from the x axis; with their deviations.

    Returns
    -------
    anchors_m : float64 (2, 2)
    covariance_m2 : float64 (4, 4)
        R2 inherits K's errors whole.
    """
    cos, sin = np.cos(bearing_rad), np.sin(bearing_rad)
    control = np.asarray(control_m, np.float64)
    inherited = np.asarray(control_covariance_m2, np.float64)
    turn = np.array([[cos, -length_m * sin], [sin, length_m * cos]])
    own = turn @ np.diag([length_sd_m**2, bearing_sd_rad**2]) @ turn.T
    return (
        np.stack([control, control + length_m * np.array([cos, sin])]),
        np.block([[inherited, inherited], [inherited, inherited + own]]),
    )


def chosen_by_motion(
    before: TriangleFix, after: TriangleFix, moved_m: Floats, covariance_m2: Floats
) -> tuple[TriangleFix, TriangleFix]:
    """Choose the sides of two fixes of one robot by what it moved between them, with K and R2 standing.

    A move's mirror image differs from it unless it goes along the base line, so odometry and a compass tell the side.

    Parameters
    ----------
    before, after : TriangleFix
        With corners each; what was chosen there counts for nothing.
    moved_m, covariance_m2 : float64 (2,), (2, 2)
        Displacement of R1 by its own sensors, independent of the ranges.

    Returns
    -------
    before, after : TriangleFix
        "ok" with a side, or "ambiguous" still; as they came where one has no corners.
    """
    if not before.corners or not after.corners:
        return before, after
    moved, noise = np.asarray(moved_m, np.float64), np.asarray(covariance_m2, np.float64)
    pairs = [(one, other) for one in before.corners for other in after.corners]
    strange = []
    for one, other in pairs:
        spread = one.covariance_m2 + other.covariance_m2 + noise
        miss = other.position_m - one.position_m - moved
        strange.append(float(miss @ np.linalg.solve(spread, miss) + np.linalg.slogdet(spread)[1]))
    best = int(np.argmin(strange))
    one, other = pairs[best]

    def sure(of_before: bool) -> bool:
        rivals = [
            value
            for value, (first, second) in zip(strange, pairs, strict=True)
            if (first is not one if of_before else second is not other)
        ]
        return min(rivals) - strange[best] >= 2 * np.log(SURE_ODDS)

    return _settled(before, one if sure(True) else None), _settled(after, other if sure(False) else None)


_SIDES: tuple[tuple[Side, float], ...] = (("left", 1.0), ("right", -1.0))


def _corner(
    side: Side, anchors: Floats, place: Floats, ranges: Floats, noise: Floats, base_covariance: Floats
) -> Corner:
    """Propagate: rows uᵢ = (p − pᵢ) / dᵢ give uᵢ · (dp − dpᵢ) = ddᵢ, so dp = U⁻¹ (dd + G dp_anchors)."""
    units = (place - anchors) / ranges[:, None]
    pulled = np.zeros((2, 4))
    pulled[0, :2], pulled[1, 2:] = units
    crossed = np.linalg.solve(units, pulled @ base_covariance)
    spread = noise + pulled @ base_covariance @ pulled.T
    covariance = np.linalg.solve(units, np.linalg.solve(units, spread).T)
    return Corner(side, place, (covariance + covariance.T) / 2, crossed)


def _chosen(corners: tuple[Corner, ...], side: Side | None, expected: tuple[Floats, Floats] | None) -> TriangleFix:
    both = TriangleFix("ambiguous", "", None, corners)
    if side is not None:
        return _settled(both, next(corner for corner in corners if corner.side == side))
    if expected is None:
        return _settled(both, None)
    place, spread = (np.asarray(part, np.float64) for part in expected)
    strange = []
    for corner in corners:
        total, miss = corner.covariance_m2 + spread, corner.position_m - place
        strange.append(float(miss @ np.linalg.solve(total, miss) + np.linalg.slogdet(total)[1]))
    best = int(np.argmin(strange))
    return _settled(both, corners[best] if strange[1 - best] - strange[best] >= 2 * np.log(SURE_ODDS) else None)


def _settled(fix: TriangleFix, corner: Corner | None) -> TriangleFix:
    """The same fix with a solution chosen, or none."""
    if corner is not None:
        return replace(fix, status="ok", remedy="", chosen=corner)
    text = "R1 may be on either side of the line through K and R2: tell its half-plane, or let it move off that line"
    return replace(fix, status="ambiguous", remedy=text, chosen=None)


def _check(anchors: Floats, base_covariance: Floats, ranges: Floats, noise: Floats) -> None:
    for name, value, shape in (
        ("anchors_m", anchors, (2, 2)),
        ("anchors_covariance_m2", base_covariance, (4, 4)),
        ("ranges_m", ranges, (2,)),
        ("ranges_covariance_m2", noise, (2, 2)),
    ):
        if value.shape != shape:
            raise ValueError(f"{name} has shape {value.shape}; {shape} is needed")
        if not np.isfinite(value).all():
            raise ValueError(f"{name} = {value.tolist()}; all must be finite")
    if not (ranges > 0.0).all():
        raise ValueError(f"ranges_m = {ranges.tolist()}; both must be above 0")
    for name, value in (("anchors_covariance_m2", base_covariance), ("ranges_covariance_m2", noise)):
        size = float(np.abs(value).max())
        if np.abs(value - value.T).max() > 1e-9 * size or np.linalg.eigvalsh(value).min() < -1e-9 * size:
            raise ValueError(f"{name} = {value.tolist()}; it must be symmetric, without negative variances")
