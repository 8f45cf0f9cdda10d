"""A survey: where fixed beacons are, how late they sound and how fast sound is, from what a drive heard."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sonofix.ranging import with_sound_speed
from sonofix.records import Event, Floats, RangeEpoch, Survey
from sonofix.site import Beacon, Site
from sonofix.survey import gauge
from sonofix.survey.begin import from_ranges, placed_states, untellable
from sonofix.survey.bundle import adjust
from sonofix.survey.conclude import conclude, failed
from sonofix.survey.rows import Drive, Guess, gather
from sonofix.survey.task import Fit, Task, residuals
from sonofix.survey.weak import UNDECIDED_CHI2

Biases = Literal["beacon", "pair", "none"]

BIAS_SD_M = 0.1
"""What delays nobody stated are taken to be worth."""

ROUGH_M = 1.0
"""Guesses of less deviation are begun from; with others, ranges alone make the beginning."""

HOLDS_M = 20.0
"""Deviation of a guess that still tells the frame."""

CERTAIN = 1e-8
"""Relative deviation of a sound speed that is taken as stated."""

DRIFT = 1e-4
"""Deviation of a free clock's speed: two cheap crystals."""

WARMING_MPS2 = 1e-6
"""Deviation of a clock's drift's change: a crystal that warms up by 0.2 ppm a minute."""

MOST_ROWS = 12_000
"""Ranges that an adjustment takes: of more, epochs are left out as long as those that stay are close together."""

CLOSE_S = 0.5
"""Between epochs so close a vehicle is followed without losing it."""

STRAYED = 0.3
"""Share of rows left out from which a beginning is doubted."""


@dataclass(frozen=True, slots=True)
class Wishes:
    """How a survey is done.

    Attributes
    ----------
    ignore_guesses : bool
        Places of beacons with ``position_sd_m`` above 0 are not looked at.
    biases : "beacon", "pair" or "none"
        One for each fixed end, for each emitter–receiver pair, or none.
    bias_sd_m : float
        What they are expected to be, about 0.
    speed_sd_mps : float or None
        Of the sound speed that made the ranges; None: as the epochs state it; 0: it is taken as it is.
    """

    ignore_guesses: bool = False
    biases: Biases = "beacon"
    bias_sd_m: float = BIAS_SD_M
    speed_sd_mps: float | None = None


def survey(
    site: Site, epochs: Sequence[RangeEpoch], wishes: Wishes | None = None, on_step: Callable[[], None] | None = None
) -> Survey:
    """Find the places of a site's fixed beacons from the ranges of a drive.

    Beacons with ``position_sd_m`` of 0 are known and stay; others are guesses of that deviation. No vehicle position
    need be known.

    Parameters
    ----------
    site : Site
    epochs : sequence of RangeEpoch
        In order of time, of one sound speed.
    wishes : Wishes or None
    on_step : callable or None
        Is told of every round of the adjustment.

    Returns
    -------
    Survey
        ``status`` tells an expected failure, with its remedy.

    Raises
    ------
    ValueError
        If no range has a fixed end, or epochs differ in clock or sound speed.
    """
    wishes = wishes or Wishes()
    if wishes.speed_sd_mps is None:
        wishes = replace(wishes, speed_sd_mps=max((e.sound_speed_sd_mps for e in epochs), default=0.0))
    epochs, told = thinned(epochs)
    # its error is an unknown here, and no noise that ranges share
    epochs = [with_sound_speed(e, e.sound_speed_mps, 0.0) for e in epochs]
    drive = gather(site, epochs)
    fixed = [b for b in site.beacons if b.vehicle is None]
    movable = np.array([i for i, b in enumerate(fixed) if b.position_sd_m > 0 and i in set(drive.point)], np.int64)
    nothing = untellable(drive, len(movable), _task(drive, movable, wishes, fixed).asked)
    if nothing:
        return failed(site, drive, nothing)
    rough = not wishes.ignore_guesses and all(fixed[i].position_sd_m <= ROUGH_M for i in movable)
    why = ""
    before = _placed(drive, site, epochs, wishes, drive.place_m) if rough or not len(movable) else None
    before_m = _rms(residuals(_task(drive, movable, wishes, fixed), before)[0]) if before is not None else np.nan
    found: tuple[Task, Fit] | None = None
    if before is not None:
        found = _adjusted(drive, movable, wishes, fixed, before, on_step)
    if len(movable) and (found is None or _doubtful(found[1])):
        places, why = from_ranges(drive, np.random.default_rng(0))
        for reflect in (False, True) if places else ():
            begun = _in_frame(drive, fixed, movable, places, wishes, reflect)
            guess = None if begun is None else _placed(drive, site, epochs, wishes, begun)
            if guess is None:
                continue
            tried = _adjusted(drive, movable, wishes, fixed, guess, on_step)
            if found is None or _worth(tried[1]) < _worth(found[1]):
                found = tried
        if found is None and not wishes.ignore_guesses and not rough:
            before = _placed(drive, site, epochs, wishes, drive.place_m)
            found = None if before is None else _adjusted(drive, movable, wishes, fixed, before, on_step)
    if found is None:
        return failed(site, drive, why or "ranges and places do not fit; give position_m of the beacons within a metre")
    task, fit = found
    rival = _image(task, fit, on_step)
    if rival is not None and rival.chi2 < fit.chi2 - UNDECIDED_CHI2:
        fit, rival = rival, fit
    if rival is not None and rival.chi2 > fit.chi2 + UNDECIDED_CHI2:
        rival = None
    found_all = conclude(site, task, fit, wishes, before_m, rival)
    return replace(found_all, events=(*told, *found_all.events))


def thinned(epochs: Sequence[RangeEpoch]) -> tuple[list[RangeEpoch], tuple[Event, ...]]:
    """Leave epochs out where there are more ranges than an adjustment needs; say so.

    Of each k epochs in a row one stays, drawn at random, so that no order in which beacons take turns falls in
    step with it. Ranges a fraction of a second apart err much alike, so little is lost; deviations are those of what
    stays.
    """
    rows = sum(len(e) for e in epochs)
    most = 1 + int(CLOSE_S / max(_spacing_s(epochs), 1e-9))
    k = min(-(-rows // MOST_ROWS), most)
    if k <= 1:
        return list(epochs), ()
    rng = np.random.default_rng(0)
    kept = [epochs[min(i + int(rng.integers(k)), len(epochs) - 1)] for i in range(0, len(epochs), k)]
    text = f"{rows} ranges in {len(epochs)} epochs are more than it takes: of each {k} epochs in a row one was taken"
    return kept, (Event(epochs[0].sync_s, "", "thinned", text),)


def _spacing_s(epochs: Sequence[RangeEpoch]) -> float:
    """Return the median time between epochs; infinite where there is but one."""
    return float(np.median(np.diff([e.sync_s for e in epochs]))) if len(epochs) > 1 else np.inf


def _rms(residual: Floats) -> float:
    there = residual[np.isfinite(residual)]
    return float(np.sqrt(np.mean(there**2))) if len(there) else float("nan")


def _doubtful(fit: Fit) -> bool:
    return bool(np.mean(fit.used) < 1 - STRAYED or fit.scale[0] > 10.0)


def _worth(fit: Fit) -> float:
    """Misfit by which beginnings are compared: rows left out count as gross."""
    return fit.chi2 + 100.0 * float(np.count_nonzero(~fit.used)) + len(fit.used) * np.log(fit.scale[0]) * 2


def _task(drive: Drive, movable: NDArray[np.int64], wishes: Wishes, fixed: list[Beacon]) -> Task:
    """Lay out the shared unknowns and what is known of them."""
    bias, bias_sd = _biases(drive, wishes)
    sd = np.repeat([fixed[i].position_sd_m for i in movable], 3)
    information = np.zeros(len(sd)) if wishes.ignore_guesses else sd**-2.0
    relative = max((wishes.speed_sd_mps or 0.0) / drive.sound_speed_mps, CERTAIN)
    clock = [1e-12, (DRIFT * drive.sound_speed_mps) ** -2.0, WARMING_MPS2**-2.0] if drive.common_clock else []
    mean = np.concatenate([drive.place_m[movable].ravel(), np.zeros(len(bias_sd) + 1 + len(clock))])
    known = np.concatenate([information, bias_sd**-2.0, [relative**-2.0], clock])
    basis = gauge.freedom_of(drive, movable, drive.place_m).basis
    held = np.zeros((len(mean), basis.shape[1] if wishes.ignore_guesses else 0))
    held[: len(sd)] = basis[:, : held.shape[1]]
    return Task(drive, movable, bias, mean, known, held)


def _biases(drive: Drive, wishes: Wishes) -> tuple[NDArray[np.int64], Floats]:
    """Return which biases each row has (n, 2), and what each bias is expected to be, one deviation (b,).

    First those asked for; then, of pairs whose ranges the site states a doubt of, that one error of each. Where each
    pair's is asked for the two are one.
    """
    pairs = list(zip(drive.emitter, drive.receiver, strict=True))
    ends = [(drive.names[i], "") for i in drive.point]
    keys = {"pair": pairs, "beacon": ends, "none": []}[wishes.biases]
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    bias = np.full((len(drive), 2), -1)
    bias[:, 0] = [number[key] for key in keys] or -1
    doubted = {} if wishes.biases == "pair" else {p: s for p, s in zip(pairs, drive.lasting_sd_m, strict=True) if s}
    lasting = {pair: len(number) + i for i, pair in enumerate(doubted)}
    bias[:, 1] = [lasting.get(pair, -1) for pair in pairs]
    return bias, np.array([wishes.bias_sd_m] * len(number) + list(doubted.values()), float)


def _placed(drive: Drive, site: Site, epochs: Sequence[RangeEpoch], wishes: Wishes, place_m: Floats) -> Guess | None:
    """Begin with beacons at given places, vehicles where fixes put them."""
    number = {name: i for i, name in enumerate(drive.names[: sum(b.vehicle is None for b in site.beacons)])}
    beacons = tuple(
        b if b.vehicle is not None else b.model_copy(update={"position_m": tuple(map(float, place_m[number[b.id]]))})
        for b in site.beacons
    )
    # a bias is a misplacement to a fix
    loose = tuple(
        b.model_copy(update={"position_sd_m": float(min(max(b.position_sd_m, wishes.bias_sd_m / 2), ROUGH_M))})
        if b.vehicle is None and wishes.biases != "none"
        else b
        for b in beacons
    )
    begun = placed_states(drive, site.model_copy(update={"beacons": loose}), epochs)
    if begun is None:
        return None
    return Guess(begun[0], place_m.copy(), np.zeros(len(_biases(drive, wishes)[1])), 0.0, begun[1])


def _adjusted(
    drive: Drive,
    movable: NDArray[np.int64],
    wishes: Wishes,
    fixed: list[Beacon],
    guess: Guess,
    on_step: Callable[[], None] | None,
) -> tuple[Task, Fit]:
    task = _task(drive, movable, wishes, fixed)
    if task.gauge.shape[1]:
        held = np.zeros_like(task.gauge)
        held[: 3 * len(movable)] = gauge.freedom_of(drive, movable, guess.place_m).basis
        task = Task(task.drive, task.movable, task.bias, task.mean, task.information, held)
    return task, adjust(task, guess, on_step)


def _in_frame(
    drive: Drive,
    fixed: list[Beacon],
    movable: NDArray[np.int64],
    places: dict[int, Floats],
    wishes: Wishes,
    reflect: bool,
) -> Floats | None:
    """Lay places that ranges gave upon what is known: beacons, guesses and microphones; else a frame by convention."""
    rows = np.array(sorted(places))
    found = np.array([places[i] for i in rows])
    sd = np.array([fixed[i].position_sd_m if i < len(fixed) else 0.0 for i in rows])
    tells = ~np.isin(rows, movable) | (np.zeros(len(rows), bool) if wishes.ignore_guesses else sd < HOLDS_M)
    flat = gauge.upright(drive)
    if tells.any():
        target = drive.place_m[rows[tells]]
        turn, shift = gauge.rigid(found[tells], target, 1.0 / (sd[tells] ** 2 + 1e-4), flat, reflect)
    else:
        mirror = np.diag([1.0, -1.0, 1.0]) if reflect else np.eye(3)
        turn, shift = gauge.convention(found @ mirror.T, flat)
        turn = turn @ mirror
        third = found @ turn.T + shift
        if len(third) > 2 and third[2, 1] < 0:
            return None
    out = drive.place_m.copy()
    moved = found @ turn.T + shift
    for row, place in zip(rows, moved, strict=True):
        if row in movable:
            out[row] = place
    return out


def _image(task: Task, fit: Fit, on_step: Callable[[], None] | None) -> Fit | None:
    """Adjust again from the mirror image, where what is known before could go with it."""
    drive, m = task.drive, len(task.movable)
    known = np.setdiff1d(np.unique(drive.point), task.movable)
    places = fit.guess.place_m
    if m == 0 or len(known) > 2:
        return None
    rows = np.concatenate([task.movable, known])
    information = np.concatenate([task.information[: 3 * m : 3], np.full(len(known), 1e8)])
    target = np.concatenate([task.mean[: 3 * m].reshape(-1, 3), places[known]])
    if not information.any():
        information, target = np.ones(len(rows)), places[rows]
    turn, shift = gauge.rigid(places[rows], target, information, gauge.upright(drive), True)
    begun = gauge.moved(fit.guess, turn, shift, rows)
    begun.place_m[known] = places[known]
    more = (begun.place_m[task.movable] - task.mean[: 3 * m].reshape(-1, 3)) ** 2
    if float(np.sum(task.information[: 3 * m].reshape(-1, 3) * more)) > fit.chi2 + 1000.0:
        return None
    return adjust(task, begun, on_step)
