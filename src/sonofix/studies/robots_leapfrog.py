"""Leap-frog over 100 m in legs of 10 m: errors foreseen and found, against odometry and a published system.

Ranges have the covariance that the receiver states of bursts under a loud tone; then they are heard.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sonofix.records import Curve, Finding, Floats, Panel, Sheet
from sonofix.studies import robots_stops
from sonofix.studies.robots_planned import Planned
from sonofix.studies.robots_stops import ROBOTS
from sonofix.studies.robots_strip import (
    BASE_SD_M,
    CASES,
    COURSE,
    LEG_M,
    LENGTH_M,
    SNR_DB,
    SPEED_SD,
    START_M,
    TONE_DB,
    WAY_SD,
    WIDTH_M,
    Case,
    Run,
    calibrated,
    drive,
    heard_run,
    stated,
    wheels_alone,
)
from sonofix.studies.work import batches, rms
from sonofix.team.ahead import Ranging, ahead
from sonofix.team.leapfrog import Formation, begin
from sonofix.team.planner import STEPS_M

PUBLISHED = 1.2e-3
"""Error over path of CPS-II (Kurazume & Hirose 2000, Autonomous Robots 8): robots with a laser, ranges and bearings."""

WANTED = 1e-3
"""Of the path."""

FEW = 10
"""Of fewer runs, root mean squares and means of squares scatter too much to be held against what is expected."""

PLANNED_SD_M = 0.06
"""End error that the planner is asked for, unless told otherwise."""


def ratio(miss_m: Floats, covariance_m2: Floats, case: str) -> Finding:
    """Root mean square of errors (runs, 2) over that of stated deviations (runs, 2, 2)."""
    sd = float(np.sqrt(np.mean(np.trace(covariance_m2, axis1=1, axis2=2))))
    return rms(
        miss_m * np.sqrt(2.0) / sd, case, "error over its deviation", "1", _unless_few("0.7 to 1.4", len(miss_m))
    )


def _unless_few(claim: str, runs: int) -> str:
    return claim if runs >= FEW else ""


class Leapfrog:
    """The study in progress."""

    def __init__(self, runs: int, seed: int, waveforms: int, planned_m: float = PLANNED_SD_M) -> None:
        self._wanted, self._seed, self._drives, self._planned_m = runs, seed, waveforms, planned_m
        self._bench = robots_stops.bench(SNR_DB, TONE_DB)
        self._ranging: Ranging | None = None
        self._checked: tuple[Floats, Floats] | None = None
        self._planned: Planned | None = None
        self._done: dict[str, list[Run]] = {}
        self._wheels: list[Floats] = []
        self._heard: list[Run] = []
        self._scan: list[Curve] = []

    def work(self) -> Iterator[tuple[str, float]]:
        """Measure ranges, plan, compute the runs, then those from waveforms."""
        self._ranging, *checked = calibrated(self._bench, self._seed)
        self._checked = (checked[0], checked[1])
        self._planned = Planned(_formation(self._ranging, 0.0), self._ranging, self._planned_m, self._seed)
        self._scan = _scan(self._ranging)
        for numbers in batches(self._wanted):
            for k, case in enumerate(CASES):
                for run in numbers:
                    rng = np.random.default_rng([self._seed, 30, k, run])
                    self._done.setdefault(case.name, []).append(drive(case, stated(self._ranging, rng), rng))
                    here = (k + (run - numbers.start) / len(numbers)) / (len(CASES) + 1)
                    yield "by ranges", (numbers.start + here * len(numbers)) / self._wanted
            for share in self._planned.work(numbers):
                here = (len(CASES) + share) / (len(CASES) + 1)
                yield "by ranges", (numbers.start + here * len(numbers)) / self._wanted
            self._wheels.append(wheels_alone(numbers, self._seed))
            yield "by ranges", numbers.stop / self._wanted
        for number in range(self._drives):
            self._heard.append(heard_run(self._bench, number, self._seed))
            yield "from waveforms", (number + 1) / self._drives

    def sheet(self) -> Sheet | None:
        """Show what is finished."""
        planned = self._planned
        if planned is None or not planned.begun or any(c.name not in self._done for c in CASES):
            return None
        panels = (
            self._along(),
            self._strip(),
            self._by_speed(),
            Panel(
                "What the planner weighs",
                "by the strip's width",
                "each robot's step along, m",
                "end error (1 σ), m",
                (*self._scan, Curve("wanted", _ENDS_M, np.full(2, self._planned_m), "bound")),
                (min(1e-2, self._planned_m / 2), max(2.0, 4 * self._planned_m)),
                logarithmic=True,
            ),
            *planned.panels(),
        )
        note = (
            f"three robots go {LENGTH_M:g} m in legs of {LEG_M:g} m; 40 kHz bursts under a tone {TONE_DB:g} dB louder"
        )
        return Sheet("Robots: leap-frog", note, 3, panels, self._findings(planned), (planned.listing(),))

    def _findings(self, planned: Planned) -> tuple[Finding, ...]:
        assert self._checked is not None
        miss, sd = self._checked
        at = f"ranges over {robots_stops.AT_M:g} m, from waveforms"
        out = [rms(miss, at, "rms", "m"), rms(miss / sd, at, "error over its deviation", "1", "1")]
        for case in CASES:
            out += _ends(self._done[case.name], case)
        if self._heard:
            out += _ends(self._heard, Case("from waveforms", SPEED_SD))
            again = float(np.mean([run.again for run in self._heard]))
            out.append(Finding("from waveforms", "stops ranged anew, a run", again, None, "1", len(self._heard)))
        wheels = np.concatenate(self._wheels) if self._wheels else wheels_alone(range(1), self._seed)
        out.append(rms(wheels[:, -1] * np.sqrt(2.0), "odometry alone", "end error, rms", "m"))
        runs = self._done[CASES[1].name]
        per_step = 1e-4 * float(np.mean([run.by_scale_m for run in runs]))
        out.append(
            Finding("0.01 % of the speed of sound", "end error it makes", per_step, None, "m", len(runs), "1 cm")
        )
        out += planned.findings()
        return tuple(out)

    def _along(self) -> Panel:
        """Errors over the way."""
        runs = self._done[CASES[1].name]
        x, found, foreseen = _by_way(runs)
        curves = [
            Curve("odometry", *_wheels_by_way(self._wheels, self._seed), "alone"),
            Curve("leap-frog", x, found, "result"),
            Curve("stated", x, foreseen, "truth"),
            Curve("CPS-II, 0.12 %", x, PUBLISHED * x, "bound"),
        ]
        if self._heard:
            curves.insert(2, Curve("waveforms", *_by_way(self._heard)[:2], "raw"))
        return Panel(
            "Error along the way",
            CASES[1].name,
            "way, m",
            "error, rms, m",
            tuple(curves),
            (1e-3, 100.0),
            logarithmic=True,
        )

    def _strip(self) -> Panel:
        """Where robots stood in one run, and what odometry alone would have made of the way."""
        run = self._done[CASES[1].name][0]
        places = run.places_m
        wheels = self._wheels[0][0] if self._wheels else wheels_alone(range(1), self._seed)[0]
        reckoned = wheels + np.column_stack([np.arange(1.0, len(wheels) + 1), np.zeros(len(wheels))])
        curves = (
            Curve("odometry alone", reckoned[:, 0], reckoned[:, 1], "alone"),
            Curve("stops of all, in order", places[:, 0], places[:, 1], "result"),
            Curve("of R1", places[2::3, 0], places[2::3, 1], "raw"),
        )
        note = "one run; each leap crosses the course"
        return Panel("Where they stood", note, "x, m", "y, m", curves, (-25.0, 25.0))

    def _by_speed(self) -> Panel:
        """How the end error grows with the doubt about the speed of sound."""
        assert self._ranging is not None
        sds = np.linspace(0.0, 2e-3, 21)
        ends = np.array([_end_sd_m(_formation(self._ranging, sd), self._ranging) for sd in sds])
        based = np.array([_end_sd_m(_formation(self._ranging, sd, BASE_SD_M), self._ranging) for sd in sds])
        curves = [
            Curve("foreseen", 100 * sds, ends, "truth"),
            Curve("K–R2 measured to 1 mm", 100 * sds, based, "result"),
            Curve("0.1 % of path", 100 * sds[[0, -1]], np.full(2, WANTED * LENGTH_M), "bound"),
        ]
        known, doubted, based_found = (_end_rms_m(self._done[case.name]) for case in CASES)
        x = 100 * SPEED_SD * np.array([0.0, 1.0, 1.0])
        curves.append(Curve("found", x, np.array([known, doubted, based_found]), "points"))
        note = "it grows with the way"
        return Panel("Speed of sound in doubt", note, "its deviation, %", "end error, m", tuple(curves), (0.0, 0.22))


_ENDS_M = np.array([STEPS_M[0], STEPS_M[-1]])
_KINDS = ("alone", "result", "raw")
_SCAN_M = (7.5, 10.0, 15.0)


def _formation(ranging: Ranging, speed_sd: float, base_sd_m: float | None = None) -> Formation:
    """What is known at the start, by ranges that happen to be right."""
    true = START_M
    pairs = (("K", "R2"), ("K", "R1"), ("R2", "R1"))
    distance = np.array([np.hypot(*(true[ROBOTS.index(b)] - true[ROBOTS.index(a)])) for a, b in pairs])
    base = None if base_sd_m is None else (float(distance[0]), base_sd_m)
    return begin(ROBOTS, true, pairs, distance, ranging.covariance_m2(distance), speed_sd, base).formation


def _end_sd_m(formation: Formation, ranging: Ranging) -> float:
    """Deviation that the course would end with."""
    step, width = np.array([LEG_M]), np.array([WIDTH_M])
    return float(ahead(formation, COURSE, ranging, WAY_SD, step, width).end_sd_m[0])


def _scan(ranging: Ranging) -> list[Curve]:
    """End errors by step and width; NaN where out of reach."""
    steps, known = np.array(STEPS_M), _formation(ranging, 0.0)

    def ends(width_m: float) -> Floats:
        return ahead(known, COURSE, ranging, WAY_SD, steps, np.full(len(steps), width_m)).end_sd_m

    return [Curve(f"{width:g} m", steps, ends(width), kind) for width, kind in zip(_SCAN_M, _KINDS, strict=True)]


def _ends(runs: Sequence[Run], case: Case) -> list[Finding]:
    """What is to be told of runs of one kind: their ends."""
    miss = np.array([run.miss_m[-1] for run in runs])
    spread = np.array([run.covariance_m2[-1] for run in runs])
    nees = np.einsum("ri,ri->r", miss, np.linalg.solve(spread, miss[..., None])[..., 0])
    claim = _unless_few("2", len(runs))
    out = [
        rms(miss * np.sqrt(2.0), case.name, "end error, rms", "m"),
        rms(miss * np.sqrt(2.0) / LENGTH_M, case.name, "end error over path", "", "at most 0.1 %; CPS-II 0.12 %"),
        ratio(miss, spread, case.name),
        Finding(case.name, "NEES of x, y", float(nees.mean()), _standard_error(nees), "1", len(runs), claim),
    ]
    if case.speed_sd:
        off = np.array([[run.scale_miss] for run in runs])
        sd = float(np.mean([run.scale_sd for run in runs]))
        out.append(rms(off, case.name, "error of the speed of sound", "", _unless_few(f"{100 * sd:.2g} %", len(runs))))
    return out


def _standard_error(values: Floats) -> float | None:
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None


def _end_rms_m(runs: Sequence[Run]) -> float:
    return float(np.sqrt(np.mean([run.miss_m[-1] @ run.miss_m[-1] for run in runs])))


def _by_way(runs: Sequence[Run]) -> tuple[Floats, Floats, Floats]:
    """Middles of stretches of the way, errors found and stated there (root mean squares)."""
    along = np.concatenate([run.along_m for run in runs]) - 2 * LEG_M / 3
    square = np.concatenate([np.sum(run.miss_m**2, axis=1) for run in runs])
    stated = np.concatenate([np.trace(run.covariance_m2, axis1=1, axis2=2) for run in runs])
    edges = np.arange(0.0, LENGTH_M + 10.0, 5.0)
    which = np.digitize(along, edges)
    filled = [k for k in range(1, len(edges)) if np.any(which == k)]
    means = np.array([[v[which == k].mean() for v in (along, square, stated)] for k in filled])
    return means[:, 0], np.sqrt(means[:, 1]), np.sqrt(means[:, 2])


def _wheels_by_way(done: Sequence[Floats], seed: int) -> tuple[Floats, Floats]:
    off = np.concatenate(done) if done else wheels_alone(range(1), seed)
    return np.arange(1.0, LENGTH_M + 1), np.sqrt(np.mean(np.sum(off**2, axis=2), axis=0))
