"""The second seed's figure 4: a walker round a rectangle, by differences of arrival times, by steps, and by both.

On the seed's own numbers arrival times are true ones with white noise. Beside it a walk is heard: beacons sound
without a common clock, a microphone is carried, all beacons but one fall silent for five seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.air import sound_speed_linear_mps
from sonofix.channel import Waypoints
from sonofix.records import Curve, Finding, Floats, Panel, Sheet, Table
from sonofix.studies import reckoning, tdoa
from sonofix.studies.halls import Heard, hall, laid_out, listened, sounded, truth_at
from sonofix.studies.work import Work, batches, percentile, rms, share

BEACONS_M = np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 8.0], [0.0, 8.0]])
CEILING_M, LEVEL_M = 3.0, 0.85
CORNER_M, SIZE_M = np.array([2.0, 2.0]), (8.0, 4.0)
STEP_M = 0.6
SPEED_MPS = STEP_M / reckoning.STEP_S
LAPS = 10
STEPS = round(LAPS * 2 * sum(SIZE_M) / STEP_M)
FIX_EVERY = 2
"""Steps: a fix a second."""

TEMPERATURE_C, COLDER_C = 20.0, 10.0
"""Of the air; and what a walker without a thermometer takes it for."""

NOISES_S = (100e-6, 300e-6)
CLAIM_M = 0.10
LAP_S, BLIND_S = 20.0, (8.0, 13.0)
"""In the runs with a blind zone no fix comes in this part of each lap."""

WALK_S, WALK_BLIND_S = 20.0, (8.0, 13.0)
"""The walk that is heard, and when only the first beacon sounds."""

CLOCK_S = 0.3
"""Start of the first epoch on the recorder's clock, which nothing tells the receiver."""

TURN_M = 0.3
"""Corners of the walk that is heard: no microphone turns within no time."""


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """Walks on the seed's numbers, errors in m (runs, steps): of fixes (NaN where none), steps alone, and both."""

    fixes: Floats
    alone: Floats
    both: Floats


def study(
    runs: int, seed: int, waveforms: int, walk_s: float = WALK_S, blind_s: tuple[float, float] = WALK_BLIND_S
) -> Work:
    """Set the study up; a walk from waveforms lasts ``walk_s`` and is blind within ``blind_s``."""
    return _Pedestrian(runs, seed, waveforms, walk_s, blind_s)


def walked(time_s: Floats) -> Floats:
    """True places (n, 2) round the rectangle, by the seed's sharp corners."""
    long, short = SIZE_M
    way = (SPEED_MPS * np.asarray(time_s)) % (2 * (long + short))
    corners = np.array([0.0, long, long + short, 2 * long + short, 2 * (long + short)])
    x = np.interp(way, corners, [0.0, long, long, 0.0, 0.0])
    y = np.interp(way, corners, [0.0, 0.0, short, short, 0.0])
    return CORNER_M + np.column_stack([x, y])


def simulated(
    numbers: range, seed: int, noise_s: float, blind: bool = False, assumed_c: float = TEMPERATURE_C, steps: int = STEPS
) -> Runs:
    """Compute walks by their numbers, each with a generator of its own, whatever the noise.

    ``blind``: no fixes within `BLIND_S` of each lap; ``assumed_c``: temperature that makes ways of times.
    """
    time_s = reckoning.STEP_S * np.arange(steps + 1)
    places = walked(time_s)
    rise_m, speed = CEILING_M - LEVEL_M, float(sound_speed_linear_mps(TEMPERATURE_C))
    fixed = np.arange(FIX_EVERY - 1, steps, FIX_EVERY)
    flights = tdoa.slants(places[1:][fixed], BEACONS_M, rise_m) / speed
    told, noise = [], []
    for run in numbers:
        rng = np.random.default_rng([seed, 2, run])
        told.append(reckoning.told_steps(np.diff(places, axis=0), rng))
        noise.append(rng.standard_normal(flights.shape))
    lengths, headings = (np.array(part) for part in zip(*told, strict=True))
    found, spread, _ = tdoa.fixes(
        flights + noise_s * np.array(noise), BEACONS_M, rise_m, float(sound_speed_linear_mps(assumed_c)), noise_s
    )
    fixes, covariance = np.full((len(numbers), steps, 2), np.nan), np.zeros((len(numbers), steps, 2, 2))
    fixes[:, fixed], covariance[:, fixed] = found, spread
    if blind:
        within = time_s[1:] % LAP_S
        fixes[:, (within >= BLIND_S[0]) & (within < BLIND_S[1])] = np.nan
    both, _ = reckoning.integrated(places[0], lengths, headings, fixes, covariance)
    alone = reckoning.reckoned(places[0], lengths, headings)
    return Runs(*(np.linalg.norm(each - places[1:], axis=-1) for each in (fixes, alone, both)))


def chords(motion: Waypoints, ends_s: Floats) -> Floats:
    """True chords (n, 2) of steps that end at given times."""
    return (motion.at(ends_s).position_m - motion.at(ends_s - reckoning.STEP_S).position_m)[:, :2]


@dataclass(frozen=True, slots=True, eq=False)
class _Walk:
    """A walk that was heard: what the receiver made of it, and its steps alone."""

    heard: Heard
    step_s: Floats
    alone_m: Floats


class _Pedestrian:
    """The study in progress."""

    def __init__(self, runs: int, seed: int, waveforms: int, walk_s: float, blind_s: tuple[float, float]) -> None:
        self._wanted, self._seed, self._walks = runs, seed, waveforms
        self._walk_s, self._blind_s = walk_s, blind_s
        self._done: dict[str, list[Runs]] = {}
        self._heard: list[_Walk] = []
        low, high = CORNER_M, CORNER_M + np.array(SIZE_M)
        way = ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]), (low[0], low[1]))
        self._motion = Waypoints(tuple((float(x), float(y), LEVEL_M) for x, y in way), SPEED_MPS, radius_m=TURN_M)

    def work(self) -> Iterator[tuple[str, float]]:
        """Compute the cases on the seed's numbers, then the walks from waveforms."""
        for name, noise_s, blind, assumed_c in _CASES:
            done = self._done.setdefault(name, [])
            for numbers in batches(self._wanted):
                done.append(simulated(numbers, self._seed, noise_s, blind, assumed_c))
                yield name, numbers.stop / self._wanted
        beacons = [(float(x), float(y), CEILING_M) for x, y in BEACONS_M]
        site = hall("hall of 12 m × 8 m", (12.0, 8.0, 3.2), beacons, "walker", LEVEL_M, synchronised=False)
        epochs = self._walks * round(self._walk_s / 0.5)
        count = 0
        for walk in range(self._walks):
            rng = np.random.default_rng([self._seed, 3, walk])
            ends_s = np.arange(0.44, self._walk_s, reckoning.STEP_S)
            lengths, headings = reckoning.told_steps(chords(self._motion, ends_s), rng)
            table = Table(
                {"time_s": ends_s, "length_m": lengths, "heading_rad": headings}, {"vehicle": ("walker",) * len(ends_s)}
            )
            # beacons fall silent between two epochs
            blind = (self._blind_s[0] + CLOCK_S - 0.01, self._blind_s[1] + CLOCK_S - 0.01)
            recording = sounded(
                site, self._motion, self._walk_s, self._seed + walk, CLOCK_S, blind, (site.beacons[0].id,)
            )
            steps = []
            for step in listened(recording, {"steps": table}):
                steps.append(step)
                count += 1
                yield "from waveforms", min(1.0, count / epochs)
            start = self._motion.at(ends_s[:1] - reckoning.STEP_S).position_m[0, :2]
            self._heard.append(_Walk(laid_out(steps), ends_s, reckoning.reckoned(start, lengths, headings)))

    def sheet(self) -> Sheet | None:
        """Show what is finished."""
        if not self._done or not self._done[_CASES[0][0]]:
            return None
        note = (
            f"{SIZE_M[0]:g} m × {SIZE_M[1]:g} m walked {LAPS} times at {SPEED_MPS:g} m/s, two steps and one fix"
            " a second, four ceiling beacons"
        )
        panels = [
            _over_time(name, done[0], blind)
            for name, _, blind, assumed_c in _CASES
            if assumed_c == TEMPERATURE_C and (done := self._done.get(name))
        ]
        if self._heard:
            panels.append(self._walk_panel(self._heard[0]))
        return Sheet("Pedestrian: arrival differences and steps", note, 2, tuple(panels), self._findings())

    def _findings(self) -> tuple[Finding, ...]:
        out: list[Finding] = []
        for name, _, blind, assumed_c in _CASES:
            done = self._done.get(name)
            if not done:
                continue
            runs = Runs(*(np.concatenate([getattr(d, part) for d in done]) for part in Runs.__slots__))
            out.append(rms(runs.fixes, f"{name}: fixes alone", "rms", "m"))
            if assumed_c != TEMPERATURE_C:
                continue
            out += [
                percentile(runs.fixes, 95, f"{name}: fixes alone", "95 %", "m"),
                rms(runs.both, f"{name}: integrated", "rms", "m", "" if blind else "below fixes alone"),
                percentile(runs.both, 95, f"{name}: integrated", "95 %", "m", "" if blind else "within 10 cm"),
                share((runs.both <= CLAIM_M).astype(float), f"{name}: integrated", "within 10 cm"),
            ]
            if blind:
                last = _blind_ends(runs.both.shape[1])
                out.append(rms(runs.both[:, last], f"{name}: integrated", "rms at their end", "m"))
            else:
                out.append(rms(runs.alone[:, -1:], f"{name}: steps alone", "rms after ten laps", "m", "drifts"))
        if self._heard:
            out += self._heard_findings()
        return tuple(out)

    def _heard_findings(self) -> list[Finding]:
        fixes, track, alone, ends = [], [], [], []
        for walk in self._heard:
            heard = walk.heard
            at_fix, _ = truth_at(self._motion, heard.fix_s)
            at_track, _ = truth_at(self._motion, heard.track_s)
            miss = np.linalg.norm(heard.track_m - at_track, axis=1)
            blind = self._blind(heard.track_s)
            fixes.append(np.linalg.norm(heard.fix_m - at_fix, axis=1))
            track.append(np.where(blind, np.nan, miss))
            ends.append(miss[np.flatnonzero(blind)[-1:]])
            at_steps, _ = truth_at(self._motion, walk.step_s)
            alone.append(np.linalg.norm(walk.alone_m - at_steps, axis=1)[-1:])
        name = "from waveforms"
        return [
            rms(_even(fixes), f"{name}: fixes alone", "rms", "m"),
            rms(np.array(alone), f"{name}: steps alone", "rms after one lap", "m"),
            rms(_even(track), f"{name}: track, beacons heard", "rms", "m", "within 3 cm"),
            rms(np.array(ends), f"{name}: track", "rms at blind zone's end", "m", "within 10 cm, one beacon heard"),
        ]

    def _blind(self, time_s: Floats) -> NDArray[np.bool_]:
        """Whether the epoch of an estimate fell into the blind zone."""
        sent_s = time_s - CLOCK_S
        return (sent_s >= self._blind_s[0]) & (sent_s < self._blind_s[1])

    def _walk_panel(self, walk: _Walk) -> Panel:
        heard = walk.heard
        at_fix, _ = truth_at(self._motion, heard.fix_s)
        at_track, _ = truth_at(self._motion, heard.track_s)
        at_steps, _ = truth_at(self._motion, walk.step_s)
        low, high = self._blind_s
        return Panel(
            "From waveforms",
            "one beacon of four sounds in the blind zone",
            "time, s",
            "error, m",
            (
                Curve("fixes alone", heard.fix_s, np.linalg.norm(heard.fix_m - at_fix, axis=1), "raw"),
                Curve("steps alone", walk.step_s, np.linalg.norm(walk.alone_m - at_steps, axis=1), "alone"),
                Curve("track", heard.track_s, np.linalg.norm(heard.track_m - at_track, axis=1), "result"),
                Curve("10 cm", np.array([0.0, self._walk_s]), np.full(2, CLAIM_M), "bound"),
            ),
            (1e-4, 10.0),
            logarithmic=True,
            blind=((low + CLOCK_S, high + CLOCK_S),),
        )


_CASES = (
    *((f"{1e6 * noise_s:.0f} µs", noise_s, False, TEMPERATURE_C) for noise_s in NOISES_S),
    (f"{1e6 * NOISES_S[0]:.0f} µs, blind zones", NOISES_S[0], True, TEMPERATURE_C),
    (f"{1e6 * NOISES_S[0]:.0f} µs, air taken for {COLDER_C:g} °C", NOISES_S[0], False, COLDER_C),
)
"""Name, noise of arrival times, whether there are blind zones, and the temperature assumed."""


def _over_time(name: str, runs: Runs, blind: bool) -> Panel:
    """Figure 4 of one run: errors over time."""
    time_s = reckoning.STEP_S * np.arange(1, runs.both.shape[1] + 1)
    fixed = slice(FIX_EVERY - 1, None, FIX_EVERY)
    spans = tuple((LAP_S * lap + BLIND_S[0], LAP_S * lap + BLIND_S[1]) for lap in range(LAPS)) if blind else ()
    return Panel(
        f"As printed, {name}",
        "steps go on alone in the blind zones" if blind else "",
        "time, s",
        "error, m",
        (
            Curve("fixes alone", time_s[fixed], runs.fixes[0][fixed], "raw"),
            Curve("steps alone", time_s, runs.alone[0], "alone"),
            Curve("integrated", time_s, runs.both[0], "result"),
            Curve("10 cm", time_s[[0, -1]], np.full(2, CLAIM_M), "bound"),
        ),
        (1e-3, 10.0),
        logarithmic=True,
        blind=spans,
    )


def _blind_ends(steps: int) -> NDArray[np.intp]:
    """Steps that are the last of a blind zone."""
    within = (reckoning.STEP_S * np.arange(1, steps + 1)) % LAP_S
    return np.flatnonzero(np.isclose(within, BLIND_S[1] - reckoning.STEP_S))


def _even(rows: list[Floats]) -> Floats:
    """Rows of unequal length as one array, the shorter filled with NaN."""
    out = np.full((len(rows), max(map(len, rows))), np.nan)
    for i, row in enumerate(rows):
        out[i, : len(row)] = row
    return out
