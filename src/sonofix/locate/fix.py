"""A fix: closed-form starts, Gauss–Newton from each, mirror solutions told apart, faulty rows left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import POSE, Links, from_arm, link, open_arms
from sonofix.locate.exclude import agrees, exclude
from sonofix.locate.rows import Rows, Solution
from sonofix.records import Fix, FixStatus, Floats, RangeEpoch
from sonofix.site import Site

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Two corners of a room."""

FLAT_M = 0.01
"""Two heights whose middle fits every range within this, or its deviation, are one position with an open height."""

AMBIGUOUS_CHI2 = 28.0
"""Two solutions whose χ² differ by less are both believed: wherever the two lie, noise prefers the wrong one by more
with a probability of Q(√28) = 6e-8."""


def fix(epoch: RangeEpoch, site: Site, vehicle: str) -> Fix:
    """Solve for one vehicle's position, velocity where range rates are there, heading where microphones allow it.

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
    return judged(epoch, links, who, vehicle, level_m, site.bounds_m, open_arms(site)[who])


def judged(
    epoch: RangeEpoch, links: Links, who: int, vehicle: str, level_m: float | None, bounds_m: Bounds | None, arm: Floats
) -> Fix:
    """Do as `fix`, with what it asks of a site looked up: ends of rows, level, room, the arm that no heading places."""
    solver = Rows(epoch, links, who, level_m)
    rows, time_s = solver.rows, solver.time_s
    if len(rows) < solver.needed:
        text = f"{len(rows)} of {solver.needed} ranges; bring more beacons in reach or state what is known (z_m)"
        return _failed(epoch, vehicle, time_s, "too-few", text)
    everything = np.arange(len(rows))
    found = solver.candidates(everything)
    if not found:
        return _failed(epoch, vehicle, time_s, "no-convergence", "no position fits; check beacon positions and units")
    misfit = found[0].chi2
    kept, found, isolated = exclude(solver, everything, found)
    best = found[0]
    status: FixStatus = "ok"
    remedy = ""
    inflation = 1.0
    if not agrees(solver, len(kept), best.chi2):
        status, inflation = "inconsistent", best.chi2 / solver.degrees(len(kept))
        remedy = "ranges disagree and no single one explains it; check beacon positions, sound speed and echoes"
    elif not isolated:
        status, inflation = "inconsistent", misfit / solver.degrees(len(rows))
        remedy = "a range is wrong, but which cannot be told; bring more beacons in reach"
    rivals = [s for s in found[1:] if s.chi2 < best.chi2 + AMBIGUOUS_CHI2 * inflation]
    best, mirror, undecided = _tell_apart(best, rivals, bounds_m, epoch, rows[kept])
    mirror_m = None if mirror is None else mirror.position_m.copy()
    if undecided:
        text = "two positions or headings fit alike; state the room's bounds_m or the vehicle's z_m, or move one beacon"
        return replace(_failed(epoch, vehicle, time_s, "ambiguous", text), mirror_m=mirror_m)
    covariance = solver.covariance(best)
    if covariance is None or _too_weak(best, covariance * inflation, solver, kept):
        text = "the beacons in reach leave a direction open; spread them off one line or plane"
        return _failed(epoch, vehicle, time_s, "no-convergence", text)
    hpl_m = vpl_m = None
    if status == "ok":
        hpl_m, vpl_m = solver.protection(kept, best, [s for s in found if s is not best], bounds_m)
    if mirror is not None and bounds_m is None and solver.level_m is None:
        best, covariance = _between(best, mirror, covariance)
    states = tuple(POSE[i] for i in solver.components) + ("clock",) * solver.clock
    used = np.zeros(len(epoch), bool)
    used[rows[kept]] = True
    speed_mps, speed_sd_mps = solver.sound_speed(kept, best) or (None, None)
    residual = np.full(len(epoch), np.nan)
    residual[rows], hdop, vdop = solver.look(kept, best)
    arm = solver.open_arm + arm
    position, covariance = _shift_to_origin(best, covariance * inflation, arm)
    return Fix(
        time_s=time_s,
        vehicle=vehicle,
        status=status,
        remedy=remedy,
        states=states,
        position_m=position,
        velocity_mps=best.state[4:7].copy() if solver.rates else None,
        yaw_rad=float(best.state[3]) if solver.turns else None,
        clock_offset_m=best.clock_m if solver.clock else None,
        covariance=covariance,
        hdop=hdop,
        vdop=vdop,
        # a lever arm of open heading may point anywhere
        hpl_m=None if hpl_m is None else hpl_m + 2.0 * float(np.hypot(*arm)),
        vpl_m=vpl_m,
        used=used,
        residual_m=residual,
        mirror_m=mirror_m,
        sound_speed_mps=speed_mps,
        sound_speed_sd_mps=speed_sd_mps,
    )


def _tell_apart(
    best: Solution, rivals: list[Solution], bounds_m: Bounds | None, epoch: RangeEpoch, kept: NDArray[np.int64]
) -> tuple[Solution, Solution | None, bool]:
    """Choose among solutions that fit alike by the room's bounds; say so where that does not decide.

    Two that lie so close above each other that a range hardly tells them from their middle need no decision.
    """
    if not rivals:
        return best, None, False
    if bounds_m is None:
        apart = best.position_m - rivals[0].position_m
        range_m = abs(float(np.median(epoch.range_m[kept])))
        seen_m = max(FLAT_M, float(np.median(np.sqrt(np.diag(epoch.covariance_m2)[kept]))))
        close = np.hypot(apart[0], apart[1]) < 0.02 and (apart[2] / 2) ** 2 / (2 * range_m) < seen_m
        return best, rivals[0], len(rivals) > 1 or not close
    low, high = np.array(bounds_m)
    inside = [s for s in [best, *rivals] if np.all(s.position_m >= low - 0.1) and np.all(s.position_m <= high + 0.1)]
    if len(inside) != 1:
        return best, rivals[0], True
    others = [s for s in [best, *rivals] if s is not inside[0]]
    return inside[0], others[0], False


def _between(best: Solution, mirror: Solution, covariance: Floats) -> tuple[Solution, Floats]:
    """Return the middle of two solutions just above each other; half their distance is the height's deviation."""
    half_m = (best.state[2] - mirror.state[2]) / 2
    state = best.state.copy()
    state[2] -= half_m
    wider = covariance.copy()
    wider[2, :] = wider[:, 2] = 0.0
    wider[2, 2] = half_m**2 + covariance[2, 2]
    return replace(best, state=state), wider


def _too_weak(best: Solution, covariance: Floats, solver: Rows, rows: NDArray[np.int64]) -> bool:
    """Whether the deviation is so large against the ranges that it means nothing."""
    nearest = float(np.abs(solver.range_m[rows] - best.clock_m).min())
    places = 2 if solver.level_m is not None else 3
    return float(covariance.diagonal()[:places].max()) > (0.5 * max(nearest, 0.2)) ** 2


def _shift_to_origin(best: Solution, covariance: Floats, arm: Floats) -> tuple[Floats, Floats]:
    """Position of the vehicle's origin where a lever arm leaves the heading open: the arm becomes uncertainty."""
    position, covariance = best.position_m.copy(), covariance.copy()
    shift, sd_m = from_arm(arm, best.state[4:7])
    position[:2] += shift
    covariance[:2, :2] += np.eye(2) * sd_m**2
    return position, covariance


def _failed(epoch: RangeEpoch, vehicle: str, time_s: float, status: FixStatus, remedy: str) -> Fix:
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
