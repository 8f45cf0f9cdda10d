"""From an adjustment to a survey: covariances, what stays unknown, and what there is to say of each beacon."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Event, Floats, OpenDirection, PairBias, Survey, SurveyedBeacon
from sonofix.site import Site
from sonofix.survey import gauge, weak
from sonofix.survey.rows import Drive, Guess
from sonofix.survey.task import Fit, Scale, Task

if TYPE_CHECKING:
    from sonofix.survey.places import Wishes

FEW_ROWS = 8
MOST_EVENTS = 40

TOGETHER_SIGMA = 2.0
"""Deviations of noise by which residuals must agree to be taken for alike."""

MOST_TAKEN = 0.7
"""Share of a correlation that unknowns are thought to take, at most."""

TOLD_ALIKE = 1.5
"""Ranges in a row that err alike, from which that is said."""


def conclude(site: Site, task: Task, fit: Fit, wishes: Wishes, before_m: float, rival: Fit | None) -> Survey:
    """Draw the conclusions.

    Parameters
    ----------
    before_m : float
        Root mean square of ranges' residuals by the old site file.
    rival : Fit or None
        The mirror image of everything, where it fits alike.
    """
    drive, p = task.drive, 3 * len(task.movable)
    free = gauge.freedom_of(drive, task.movable, fit.guess.place_m)
    guess = fit.guess
    full, inflation, together = _covariance(task, fit)
    raw = full[:p, :p]
    away = np.eye(p) - free.basis @ free.basis.T
    shape = away @ raw @ away
    names = [drive.names[i] for i in task.movable]
    places = guess.place_m[task.movable]
    scale = Scale(drive.range_sd_m * fit.scale[0], drive.rate_sd_mps * fit.scale[1], False, fit.used)
    if p:
        shape = shape + weak.bends(task, fit, scale, shape, free.basis)
        shape = weak.widened(task, shape)
    least = max(weak.OPEN_M, float(np.median(scale.range_sd_m)))
    directions: list[OpenDirection] = []
    if p:
        information = weak.drive_information(task, fit)
        directions = weak.open_directions(information, shape, free.basis, names, places, least)
    bounds = None if site.bounds_m is None else (np.array(site.bounds_m[0]), np.array(site.bounds_m[1]))
    images = [weak.image_m(task, fit, i, bounds) for i in range(len(names))]
    sides = [image is not None for image in images]
    # either may be true: half of a jump's square is what the one reported is off by, in the mean
    jumps = [_jump(p, i, image - places[i]) for i, image in enumerate(images) if image is not None]
    if rival is not None:
        jumps.append((rival.guess.place_m[task.movable] - places).ravel())
    shape = weak.bounded(task, fit, shape)
    for jump in jumps:
        shape = shape + np.outer(jump, jump) / 2
    mirror = _mirror_text(names, sides, rival is not None)
    if _own_frame(task, free):
        turn, shift = gauge.convention(places, gauge.upright(drive))
        guess = gauge.moved(guess, turn, shift, task.movable)
        spin = np.kron(np.eye(len(names)), turn)
        shape = spin @ shape @ spin.T
        directions = [_turned(d, turn, names, guess.place_m[task.movable]) for d in directions]
    beacons, joint = _beacons(site, task, fit, guess, shape, full, sides, wishes)
    speed = drive.sound_speed_mps
    excess = p + task.biases
    clock = drive.common_clock
    residual, used = fit.residual, fit.used
    rates = residual[1][used & np.isfinite(residual[1])]
    status, remedy = _judgement(directions, mirror)
    return Survey(
        status=status,
        remedy=remedy,
        beacons=beacons,
        covariance_m2=joint,
        gauge=_gauge_text(task, free, guess.place_m),
        frame_sd=_frame(free, raw, places) if task.information[:p].any() else {},
        mirror=mirror,
        open=tuple(_on_all(d, site, drive, task) for d in directions),
        pairs=_pairs(task, guess.bias_m, full, wishes),
        sound_speed_mps=speed * (1.0 + guess.excess),
        sound_speed_sd_mps=speed * float(np.sqrt(full[excess, excess])) if wishes.speed_sd_mps else 0.0,
        sound_speed_prior_mps=speed,
        sound_speed_prior_sd_mps=wishes.speed_sd_mps or 0.0,
        clock_offset_m=float(guess.clock[0]) if clock else None,
        clock_drift_mps=float(guess.clock[1]) if clock else None,
        drive=_way(site, drive, guess.states),
        rows=len(drive),
        excluded=int(np.count_nonzero(~used)),
        before_m=before_m,
        after_m=_rms(residual[0][used]),
        rate_after_mps=_rms(rates),
        inflation=max(inflation, fit.scale[0]),
        events=_events(task, fit, together),
    )


def failed(site: Site, drive: Drive, remedy: str) -> Survey:
    """Return a survey that found nothing, and why."""
    fixed = [b for b in site.beacons if b.vehicle is None]
    heard = [int(np.count_nonzero(drive.point == i)) for i in range(len(fixed))]
    beacons = tuple(
        SurveyedBeacon(
            b.id, place, place, b.position_sd_m, np.eye(3) * b.position_sd_m**2, None, None, heard[i], 0, np.nan
        )
        for i, b in enumerate(fixed)
        for place in (np.array(b.position_m, float),)
    )
    joint = np.diag(np.repeat([b.position_sd_m**2 for b in fixed], 3).astype(float))
    speed, nan = drive.sound_speed_mps, float("nan")
    return Survey(
        "failed", remedy, beacons, joint, "the site file's", {}, "", (), (), speed, 0.0, speed, 0.0, None, None, {},
        len(drive), len(drive), nan, nan, nan, 1.0, (),
    )  # fmt: skip


def _rms(residual: Floats) -> float:
    return float(np.sqrt(np.mean(residual**2))) if len(residual) else float("nan")


def _covariance(task: Task, fit: Fit) -> tuple[Floats, float, float]:
    """Covariance (g, g) of the shared unknowns, rigid motions that nothing holds left out.

    And how much its deviations are inflated, since residuals are larger than stated; and its variances, by `alike`.
    """
    drive = task.drive
    z = fit.residual / np.stack([drive.range_sd_m * fit.scale[0], drive.rate_sd_mps * fit.scale[1]])
    z = z[:, fit.used]
    chi2 = float(np.nansum(z**2))
    # where an epoch brings fewer rows than a state has unknowns, χ² has no degrees of its own to be held against
    judged = fit.degrees > 0.2 * np.count_nonzero(fit.used)
    inflation = float(np.sqrt(max(1.0, chi2 / fit.degrees))) if judged else 1.0
    held = fit.information + task.gauge @ task.gauge.T * float(np.trace(fit.information)) / len(fit.information)
    # unit diagonal first: places, biases and the sound speed differ by many orders of magnitude
    unit = 1.0 / np.sqrt(np.maximum(np.diag(held), 1e-30))
    size, axes = np.linalg.eigh(held * unit[:, None] * unit[None, :])
    size = np.maximum(size, 1e-14)
    covariance = unit[:, None] * (axes / size) @ axes.T * unit[None, :]
    together = alike(drive, z[0], fit.used, task.followed)
    return covariance * inflation**2 * together, inflation, together


def alike(drive: Drive, z: Floats, used: NDArray[np.bool_], unknowns: int) -> float:
    """Return how many ranges in a row err alike: by so much fewer they count (Bartlett 1935), 1 where each is alone.

    That is the sum f of the autocorrelation of each pair's residuals, all pairs together, up to where it is lost in
    noise: walls and antennas err for seconds, and what a bias or a scale leaves over stays while the way is alike.
    Unknowns follow what is slow and leave quick noise: of a correlation, residuals show what unknowns do not take,
    their share of the ranges.

    Parameters
    ----------
    z : float64 (m,)
        Whitened residuals of the ranges used.
    used : bool (n,)
    unknowns : int
        That ranges were fitted by.
    """
    rows = np.flatnonzero(used)
    ends = [(drive.emitter[i], drive.receiver[i]) for i in rows]
    number = {pair: i for i, pair in enumerate(dict.fromkeys(ends))}
    pair = np.array([number[p] for p in ends], np.int64)
    order = np.lexsort((drive.time_s[rows], pair))
    z, pair = z[order], pair[order]
    seen: list[float] = []
    power = float(np.mean(z**2)) if len(z) else 0.0
    for lag in range(1, len(z) // max(2 * len(number), 1)):
        same = pair[lag:] == pair[:-lag]
        together = float(np.mean((z[lag:] * z[:-lag])[same])) / max(power, 1e-30)
        if together < TOGETHER_SIGMA / np.sqrt(np.count_nonzero(same)):
            break
        seen.append(together)
    return 1.0 + 2.0 * sum(seen) / (1.0 - min(unknowns / max(len(z), 1), MOST_TAKEN))


def _beacons(
    site: Site, task: Task, fit: Fit, guess: Guess, shape: Floats, full: Floats, sides: list[bool], wishes: Wishes
) -> tuple[tuple[SurveyedBeacon, ...], Floats]:
    """Tell of each fixed beacon; and their joint covariance."""
    drive = task.drive
    fixed = [b for b in site.beacons if b.vehicle is None]
    slot = {int(index): k for k, index in enumerate(task.movable)}
    joint = np.zeros((3 * len(fixed),) * 2)
    spots = np.array([3 * i + a for i in task.movable for a in range(3)], int)
    joint[np.ix_(spots, spots)] = shape
    out = []
    for i, beacon in enumerate(fixed):
        mine = drive.point == i
        used = mine & fit.used
        at = slice(3 * i, 3 * i + 3)
        if i not in slot and beacon.position_sd_m > 0:  # not heard: as uncertain as before
            joint[at, at] = np.eye(3) * beacon.position_sd_m**2
        bias = bias_sd = None
        if wishes.biases == "beacon" and mine.any():
            k = int(task.bias[mine][0, 0])
            bias = float(guess.bias_m[k])
            bias_sd = float(np.sqrt(full[3 * len(task.movable) + k, 3 * len(task.movable) + k]))
        out.append(
            SurveyedBeacon(
                id=beacon.id,
                before_m=drive.place_m[i],
                position_m=guess.place_m[i],
                before_sd_m=None if wishes.ignore_guesses and i in slot else beacon.position_sd_m,
                covariance_m2=joint[at, at].copy(),
                bias_m=bias,
                bias_sd_m=bias_sd,
                heard=int(np.count_nonzero(mine)),
                used=int(np.count_nonzero(used)),
                residual_m=_rms(fit.residual[0][used]),
                mirrored=sides[slot[i]] if i in slot else False,
            )
        )
    return tuple(out), joint


def _pairs(task: Task, bias_m: Floats, full: Floats, wishes: Wishes) -> tuple[PairBias, ...]:
    if wishes.biases == "none":
        return ()
    drive, start = task.drive, 3 * len(task.movable)
    single = wishes.biases == "beacon"
    # in one pass from the end, each bias's first row stays
    first = {int(task.bias[i, 0]): i for i in range(len(drive) - 1, -1, -1) if not single or drive.sends[i]}
    sds = np.sqrt(np.diag(full))[start:]
    return tuple(
        PairBias("" if single else drive.emitter[i], drive.receiver[i], float(bias_m[k]), float(sds[k]))
        for k, i in sorted(first.items())
    )


def _jump(size: int, slot: int, way_m: Floats) -> Floats:
    out = np.zeros(size)
    out[3 * slot : 3 * slot + 3] = way_m
    return out


def _own_frame(task: Task, free: gauge.Freedom) -> bool:
    """Whether nothing known, nor any guess, gives the frame."""
    p = 3 * len(task.movable)
    known = np.setdiff1d(np.unique(task.drive.point), task.movable)
    return bool(p and free.count and not task.information[:p].any() and not len(known))


def _mirror_text(names: list[str], sides: list[bool], undecided: bool) -> str:
    texts = []
    if undecided:
        texts.append("the mirror image of everything fits as well: state where three beacons are, roughly")
    unsure = [name for name, side in zip(names, sides, strict=True) if side]
    if unsure:
        texts.append(f"{', '.join(unsure)}: above or below the drive is not told; state bounds_m or a rough height")
    return "; ".join(texts)


def _gauge_text(task: Task, free: gauge.Freedom, place_m: Floats) -> str:
    """Say what the frame rests on."""
    drive = task.drive
    if not len(task.movable):
        return "all beacons are known: they hold the frame"
    known = [drive.names[i] for i in np.setdiff1d(np.unique(drive.point), task.movable)]
    if not free.count:
        return f"held by what is known: {', '.join(known[:6])}{' …' if len(known) > 6 else ''}"
    what = "shift and turn" if not known else f"turn about {', '.join(known)}"
    if not free.motions[[3, 4]].any():
        what += " on the level"
    if task.information[: 3 * len(task.movable)].any():
        return f"{what} as guesses fit best; deviations are of the shape alone"
    if known:
        return f"{what} is arbitrary; deviations are of the shape alone"
    first, second = (drive.names[i] for i in task.movable[:2]) if len(task.movable) > 1 else (drive.names[0], "")
    return f"a frame of its own: {first} at the origin, {second} along x; deviations are of the shape alone"


def _frame(free: gauge.Freedom, raw: Floats, place_m: Floats) -> dict[str, float]:
    """Deviations of the rigid motions that only guesses tell, about the beacons' middle."""
    if not free.count:
        return {}
    moves = gauge.generators(place_m, free.about_m) @ free.motions
    solve = free.motions @ np.linalg.pinv(moves)
    sd = np.sqrt(np.diag(solve @ raw @ solve.T))
    open_ = np.linalg.norm(free.motions, axis=1) > 1e-6
    units = ("m", "m", "m", "rad", "rad", "rad")
    return {
        f"{motion}_{unit}": float(value)
        for motion, unit, value, there in zip(gauge.MOTIONS, units, sd, open_, strict=True)
        if there
    }


def _turned(direction: OpenDirection, turn: Floats, names: list[str], place_m: Floats) -> OpenDirection:
    move = direction.move_m @ turn.T
    return OpenDirection(move, direction.drive_sd_m, direction.sd_m, weak.describe(move, names, place_m))


def _on_all(direction: OpenDirection, site: Site, drive: Drive, task: Task) -> OpenDirection:
    """Lay a direction of movable beacons out over all of them."""
    move = np.zeros((sum(b.vehicle is None for b in site.beacons), 3))
    move[task.movable] = direction.move_m
    return OpenDirection(move, direction.drive_sd_m, direction.sd_m, direction.text)


def _judgement(directions: list[OpenDirection], mirror: str) -> tuple[Literal["ok", "open"], str]:
    if directions:
        return "open", "drive again: neither straight nor on one circle, close by every beacon and far from it"
    return ("open", mirror) if mirror else ("ok", "")


def _way(site: Site, drive: Drive, states: Floats) -> dict[str, Floats]:
    out = {}
    for i, vehicle in enumerate(site.vehicles):
        mine = drive.state_vehicle == i
        if mine.any():
            out[vehicle.id] = np.column_stack([drive.state_time_s[mine], states[mine, :3]])
    return out


def _events(task: Task, fit: Fit, together: float) -> tuple[Event, ...]:
    """Tell of rows that err alike, of those left out, a beacon an event, and of those that a survey does not take."""
    drive, events = task.drive, []
    if together > TOLD_ALIKE:
        text = f"a pair's ranges err alike: {together:.1f} in a row tell as much as one; deviations are so widened"
        events.append(Event(0.0, "", "alike", text))
    for name in dict.fromkeys(drive.names[i] for i in drive.point):
        mine = np.array([drive.names[i] == name for i in drive.point])
        out = np.flatnonzero(mine & ~fit.used)
        if len(out):
            worst = out[np.argmax(np.abs(fit.residual[0][out]))]
            off_m = fit.residual[0][worst]
            text = f"{len(out)} of {np.count_nonzero(mine)} ranges of {name} left out, the worst {off_m:+.3f} m off"
            events.append(Event(float(drive.time_s[out[0]]), "", "excluded", text))
    for k, index in enumerate(task.movable):
        at = slice(3 * k, 3 * k + 3)
        off = float(np.max(np.abs(fit.guess.place_m[index] - task.mean[at]) * np.sqrt(task.information[at])))
        if off > weak.STRANGE:
            text = f"{drive.names[index]} is {off:.0f} deviations off its guess; check position_m and position_sd_m"
            events.append(Event(0.0, "", "guess", text))
    if drive.skipped:
        events.append(Event(0.0, "", "skipped", f"{drive.skipped} ranges between vehicles, or not finite"))
    return tuple(events[:MOST_EVENTS])
