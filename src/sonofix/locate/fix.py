"""A fix: closed-form starts, Gauss–Newton from each, mirror solutions told apart, faulty rows left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import PITCH, POSE, ROLL, YAW, Links, from_arm, link, open_arms, tilting
from sonofix.locate.exclude import agrees, exclude
from sonofix.locate.rows import ROCKING_RADPS, Rows, Solution
from sonofix.locate.search import AT_REST
from sonofix.records import Fix, FixStatus, Floats, RangeEpoch
from sonofix.site import Site

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Two corners of a room."""

FLAT_M = 0.01
"""Two heights whose middle fits every range within this, or its deviation, are one position with an open height."""

ONE_HEADING_RAD = 0.1
"""Two solutions whose headings differ by less head alike."""

MOSTLY = 0.9
"""Share of a direction from which it is called up and down: within 26° of it."""

NO_PLACE = "no position fits; check beacon positions and units"

OPEN_DIRECTION = "the beacons in reach leave a direction open; spread them off one line or plane"

OPEN_HEIGHT = (
    "beacons and vehicle near one level leave the height open; state the level that the vehicle keeps to (z_m of its "
    "[[vehicle]]: the height of its origin), or hang a beacon well above or below"
)

AMBIGUOUS_CHI2 = 28.0
"""Two solutions whose χ² differ by less are both believed: wherever the two lie, noise prefers the wrong one by more
with a probability of Q(√28) = 6e-8."""


def fix(epoch: RangeEpoch, site: Site, vehicle: str) -> Fix:
    """Solve for one vehicle's position, velocity where range rates are there, and attitude as microphones allow it.

    Two ends on one body tell where it heads; a body that tilts (`geometry.tilting`) has roll and pitch solved for with
    them, from 0 with the deviation that its site states: three ends that are not on one line tell both.

    Rows whose other end is fixed are used; rows between vehicles are left to the track. Where all ranges share an
    unknown clock it is solved for beside the position, which equals TDoA with its full covariance.

    Parameters
    ----------
    epoch : RangeEpoch
    site : Site
    vehicle : str
        Its id; a known level is ``site.vehicle(vehicle).z_m``.

    Returns
    -------
    Fix
        ``status`` tells an expected failure, with its remedy; nothing is raised for poor geometry.
    """
    who = [v.id for v in site.vehicles].index(vehicle)
    links, level_m = link(site, epoch.emitter, epoch.receiver), site.vehicles[who].z_m
    return judged(epoch, links, who, vehicle, level_m, site.bounds_m, open_arms(site)[who], float(tilting(site)[who]))


def judged(
    epoch: RangeEpoch,
    links: Links,
    who: int,
    vehicle: str,
    level_m: float | None,
    bounds_m: Bounds | None,
    arm: Floats,
    tilt_sd_rad: float = 0.0,
) -> Fix:
    """Do as `fix`, with what it asks of a site looked up.

    That is ends of rows, level, room, the arm that no heading places, and how far the body tilts.
    """
    solver = Rows(epoch, links, who, level_m, tilt_sd_rad)
    rows, time_s = solver.rows, solver.time_s
    if len(rows) < solver.needed:
        text = f"{len(rows)} of {solver.needed} ranges; bring more beacons in reach or state what is known (z_m)"
        return failed(epoch, vehicle, time_s, "too-few", text)
    everything = np.arange(len(rows))
    found = solver.candidates(everything)
    if not found:
        return failed(epoch, vehicle, time_s, "no-convergence", NO_PLACE)
    misfit = found[0].chi2
    kept, found, isolated = exclude(solver, everything, found)
    best = found[0]
    status: FixStatus = "ok"
    remedy = ""
    inflation = 1.0
    if not agrees(solver, len(kept), best.chi2):
        status, inflation = "inconsistent", best.chi2 / max(1, solver.degrees(len(kept)))
        if solver.descends(kept, best) > AT_REST * inflation:
            return failed(epoch, vehicle, time_s, "no-convergence", NO_PLACE)
        remedy = "ranges disagree and no single one explains it; check beacon positions, sound speed and echoes"
    elif not isolated:
        status, inflation = "inconsistent", misfit / solver.degrees(len(rows))
        remedy = "a range is wrong, but which cannot be told; bring more beacons in reach"
    rivals = [s for s in found[1:] if s.chi2 < best.chi2 + AMBIGUOUS_CHI2 * inflation]
    best, mirror, undecided = _tell_apart(best, rivals, bounds_m, epoch, rows[kept])
    mirror_m = None if mirror is None else mirror.position_m.copy()
    if undecided:
        text = "two positions or headings fit alike; state the room's bounds_m or the vehicle's z_m, or move one beacon"
        return replace(failed(epoch, vehicle, time_s, "ambiguous", text), mirror_m=mirror_m)
    covariance = solver.covariance(best)
    if covariance is None or _too_weak(best, covariance * inflation, solver, kept):
        height = solver.level_m is None and _height_is_open(best)
        return failed(epoch, vehicle, time_s, "no-convergence", OPEN_HEIGHT if height else OPEN_DIRECTION)
    if solver.tilts:
        covariance = covariance + solver.bent(kept, best, covariance)
    hpl_m = vpl_m = None
    if status == "ok":
        hpl_m, vpl_m = solver.protection(kept, best, [s for s in found if s is not best], bounds_m)
    if mirror is not None and solver.level_m is None and (bounds_m is None or _inside(mirror, bounds_m)):
        best, covariance = _between(best, mirror, covariance, solver.components)
    states = tuple(POSE[i] for i in solver.components) + ("clock",) * solver.clock
    used = np.zeros(len(epoch), bool)
    used[rows[kept]] = True
    speed_mps, speed_sd_mps = solver.sound_speed(kept, best) or (None, None)
    residual = np.full(len(epoch), np.nan)
    residual[rows], hdop, vdop = solver.look(kept, best)
    arm = solver.open_arm + arm
    position, covariance = _shift_to_origin(best, covariance * inflation, arm)
    aside_m, along_m = 0.0, 0.0
    if solver.swing_rad:
        aside_m, along_m = float(np.hypot(*arm)), solver.reach_up_m
        covariance = _swung(covariance, states, aside_m, along_m, solver.swing_rad)
    return Fix(
        time_s=time_s,
        vehicle=vehicle,
        status=status,
        remedy=remedy,
        states=states,
        position_m=position,
        velocity_mps=best.state[4:7].copy() if solver.rates else None,
        yaw_rad=float(best.state[YAW]) if solver.turns else None,
        clock_offset_m=best.clock_m if solver.clock else None,
        covariance=covariance,
        hdop=hdop,
        vdop=vdop,
        # a lever arm of open heading may point anywhere, and one of a body that tilts up or down
        hpl_m=None if hpl_m is None else hpl_m + 2.0 * float(np.hypot(*arm)) + float(along_m),
        vpl_m=None if vpl_m is None else vpl_m + float(max(aside_m, 2.0 * along_m)),
        used=used,
        residual_m=residual,
        mirror_m=mirror_m,
        sound_speed_mps=speed_mps,
        sound_speed_sd_mps=speed_sd_mps,
        roll_rad=_angle(best.state[ROLL]) if solver.tilts else None,
        pitch_rad=_angle(best.state[PITCH]) if solver.tilts else None,
    )


def _tell_apart(
    best: Solution, rivals: list[Solution], bounds_m: Bounds | None, epoch: RangeEpoch, kept: NDArray[np.int64]
) -> tuple[Solution, Solution | None, bool]:
    """Choose among solutions that fit alike by the room's bounds; say so where that does not decide.

    Two that lie so close above each other that a range hardly tells them from their middle need no decision.
    """
    if not rivals:
        return best, None, False
    close = _close(best, rivals[0], epoch, kept)
    if bounds_m is None:
        return best, rivals[0], len(rivals) > 1 or not close
    inside = [s for s in [best, *rivals] if _inside(s, bounds_m)]
    if len(inside) == 2 and inside[1] is rivals[0] and close and bool(best.state[ROLL] or best.state[PITCH]):
        return best, rivals[0], False
    if len(inside) != 1:
        return best, rivals[0], True
    others = [s for s in [best, *rivals] if s is not inside[0]]
    return inside[0], others[0], False


def _inside(found: Solution, bounds_m: Bounds) -> bool:
    low, high = np.array(bounds_m)
    return bool(np.all(found.position_m >= low - 0.1) and np.all(found.position_m <= high + 0.1))


def _close(best: Solution, other: Solution, epoch: RangeEpoch, kept: NDArray[np.int64]) -> bool:
    """Whether two solutions are one above the other, heading alike, so near that no range tells of their middle."""
    apart = best.position_m - other.position_m
    range_m = abs(float(np.median(epoch.range_m[kept])))
    seen_m = max(FLAT_M, float(np.median(np.sqrt(np.diag(epoch.covariance_m2)[kept]))))
    near = np.hypot(apart[0], apart[1]) < 0.02 and (apart[2] / 2) ** 2 / (2 * range_m) < seen_m
    return bool(near) and abs(_angle(best.state[YAW] - other.state[YAW])) < ONE_HEADING_RAD


def _between(
    best: Solution, mirror: Solution, covariance: Floats, components: tuple[int, ...]
) -> tuple[Solution, Floats]:
    """Return the middle of two solutions just above each other; half their distance is the height's deviation.

    Those of a body that tilts differ in attitude too: the middle of both, with the covariance of their mixture.
    """
    state, wider = best.state.copy(), covariance.copy()
    if ROLL in components:
        half = (best.state - mirror.state) / 2
        half[[YAW, ROLL, PITCH]] = [_angle(2 * angle) / 2 for angle in half[[YAW, ROLL, PITCH]]]
        own = list(components)
        wider[: len(own), : len(own)] += np.outer(half[own], half[own])
        return replace(best, state=state - half), wider
    half_m = (best.state[2] - mirror.state[2]) / 2
    state[2] -= half_m
    wider[2, :] = wider[:, 2] = 0.0
    wider[2, 2] = half_m**2 + covariance[2, 2]
    return replace(best, state=state), wider


def _too_weak(best: Solution, covariance: Floats, solver: Rows, rows: NDArray[np.int64]) -> bool:
    """Whether the deviation is so large against the ranges that it means nothing."""
    nearest = float(np.abs(solver.range_m[rows] - best.clock_m).min())
    places = 2 if solver.level_m is not None else 3
    return float(covariance.diagonal()[:places].max()) > (0.5 * max(nearest, 0.2)) ** 2


def _height_is_open(found: Solution) -> bool:
    """Whether what rows tell least of the position, all else being free, is up and down."""
    place, others = found.jacobian[:, :3], found.jacobian[:, 3:]
    told = place - others @ np.linalg.lstsq(others, place, rcond=None)[0]
    return bool(abs(np.linalg.svd(told)[2][-1, 2]) > MOSTLY)


def _shift_to_origin(best: Solution, covariance: Floats, arm: Floats) -> tuple[Floats, Floats]:
    """Position of the vehicle's origin where a lever arm leaves the heading open: the arm becomes uncertainty."""
    position, covariance = best.position_m.copy(), covariance.copy()
    if not arm[0] and not arm[1]:
        return position, covariance
    shift, sd_m = from_arm(arm, best.state[4:7])
    position[:2] += shift
    covariance[:2, :2] += np.eye(2) * sd_m**2
    return position, covariance


def _swung(covariance: Floats, states: tuple[str, ...], aside_m: float, along_m: float, tilt_sd_rad: float) -> Floats:
    """Widen a covariance for ends ``aside_m`` off a body's axis and ``along_m`` up it, whose tilt nothing tells."""
    out = covariance.copy()
    for axis, arm_m in (("x", along_m), ("y", along_m), ("z", aside_m)):
        for name, swing_m in ((axis, tilt_sd_rad * arm_m), (f"v{axis}", ROCKING_RADPS * arm_m)):
            if name in states:
                out[states.index(name), states.index(name)] += swing_m**2
    return out


def _angle(angle_rad: float) -> float:
    """Return the same angle between −π and π."""
    return float(np.angle(np.exp(1j * angle_rad)))


def failed(epoch: RangeEpoch, vehicle: str, time_s: float, status: FixStatus, remedy: str) -> Fix:
    """Return the fix of a vehicle whose position an epoch does not tell, and what would help."""
    nothing = np.zeros(len(epoch), bool)
    return Fix(
        time_s,
        vehicle,
        status,
        remedy,
        (),
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        nothing,
        np.full(len(epoch), np.nan),
    )
