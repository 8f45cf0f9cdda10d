"""Leap-frog as the planner picks it, asked anew after each leap: end errors wanted and reached, and one run's leaps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sonofix.records import Curve, Finding, Floats, Listing, Panel
from sonofix.studies.robots_strip import COURSE, WAY_SD, Case, Run, drive, stated
from sonofix.studies.work import rms
from sonofix.team.ahead import Ranging
from sonofix.team.leapfrog import Formation
from sonofix.team.planner import Plan, plan

SHARES = (1.0, 0.5, 0.75, 1.5)
"""Of the end error wanted, that the planner is asked for; the first in all runs."""

FEWER = 3
"""For the other shares there are so many times fewer runs."""

DRAWN = 10
"""Runs drawn leap by leap."""


class Planned:
    """Runs that are planned for a wanted end error (1 σ, √(σx² + σy²)), the speed of sound known."""

    def __init__(self, start: Formation, ranging: Ranging, wanted_m: float, seed: int) -> None:
        self._ranging, self._seed = ranging, seed
        self.wanted_m = [share * wanted_m for share in SHARES]
        self.first = [self._asked(start, wanted) for wanted in self.wanted_m]
        # for shares out of reach there is nothing to tell but for what was asked
        self._shares = [k for k, first in enumerate(self.first) if k == 0 or first.status == "ok"]
        self._done: dict[int, list[Run]] = {k: [] for k in self._shares}
        self._once: list[Run] = []

    @property
    def begun(self) -> bool:
        """Whether each share has a run."""
        return all(self._done.values()) and bool(self._once)

    def work(self, numbers: range) -> Iterator[float]:
        """Do runs, and yield the share of them that is done."""
        fewer = [number for number in numbers if number % FEWER == 0]
        todo = [(-1, number) for number in numbers] + [(0, number) for number in numbers]
        todo += [(k, number) for k in self._shares[1:] for number in fewer]
        for count, (k, number) in enumerate(todo, 1):
            rng = np.random.default_rng([self._seed, 34, k + 1, number])
            ears, case = stated(self._ranging, rng), Case("planned", 0.0)
            if k < 0:
                self._once.append(drive(case, ears, rng, self._kept))
            else:
                wanted_m = self.wanted_m[k]
                self._done[k].append(drive(case, ears, rng, lambda now, wanted_m=wanted_m: self._asked(now, wanted_m)))
            yield count / len(todo)

    def findings(self) -> list[Finding]:
        """What was reached, planned once and anew, and for other shares of what is wanted."""
        wanted_m, first, runs = self.wanted_m[0], self.first[0], self._done[0]
        case = f"planned once, for {_text(wanted_m)}"
        beyond = "" if first.status == "ok" else "out of reach: the best there is"
        out = [
            Finding(case, "end error foreseen", first.end_sd_m, None, "m", 1, beyond),
            rms(_ends(self._once), case, "end error, rms", "m"),
            _mean([float(len(run.robots)) for run in self._once], case, "leaps"),
            self._apart(self._once, case),
        ]
        case = f"planned anew, for {_text(wanted_m)}"
        ratio = _ends(runs) / np.sqrt(np.mean(_variances(runs)))
        out += [
            rms(np.sqrt(_variances(runs)), case, "end error stated, rms", "m", self._claim(0)),
            rms(_ends(runs), case, "end error, rms", "m", self._claim(0)),
            rms(ratio, case, "error over its deviation", "1", "1"),
            _mean([float(len(run.robots)) for run in runs], case, "leaps"),
            self._apart(runs, case),
        ]
        for k in self._by_share():
            if k:
                case = f"planned anew, for {_text(self.wanted_m[k])}"
                out.append(rms(_ends(self._done[k]), case, "end error, rms", "m", self._claim(k)))
                out.append(_mean([float(len(run.robots)) for run in self._done[k]], case, "leaps"))
        return out

    def listing(self) -> Listing:
        """Return the first run, a leap a row."""
        run, first = self._done[0][0], self.first[0]
        expected = _expected(run)
        rows = tuple(
            (
                k + 1,
                run.robots[k],
                float(run.way_m[k]),
                *(float(v) for v in run.places_m[k + 3]),
                run.plans[k].step_m,
                run.plans[k].width_m,
                float(np.sqrt(np.trace(run.covariance_m2[k]))),
                float(expected[k]),
                run.plans[k + 1].leaps if k + 1 < len(run.plans) else 0,
            )
            for k in range(len(run.robots))
        )
        columns = ("leap", "robot", "way_m", "x_m", "y_m", "step_m", "width_m", "sd_m", "end_sd_m", "left")
        wanted = self.wanted_m[0]
        if first.status == "ok":
            note = f"{_text(wanted)} wanted; foreseen at the start: {_text(first.end_sd_m)} after {first.leaps} leaps"
        else:
            best = f"the best that can be reached is {_text(first.end_sd_m)}, after {first.leaps} leaps"
            note = f"{_text(wanted)} wanted, which is out of reach; {best}: {first.remedy.partition(': ')[2]}"
        return Listing("leaps", "Planned anew after each leap: the first run", note, columns, rows)

    def panels(self) -> tuple[Panel, Panel]:
        """Draw what was expected leap by leap, and what was reached."""
        wanted_m = self.wanted_m[0]
        curves = (
            Curve("planned once", *_along(self._once[:DRAWN]), "alone"),
            Curve("planned anew", *_along(self._done[0][:DRAWN]), "result"),
            Curve("wanted", np.array([0.0, COURSE.length_m]), np.full(2, wanted_m), "bound"),
        )
        low, high = (f([f(curve.y) for curve in curves]) for f in (np.nanmin, np.nanmax))
        limits = (0.9 * float(low), float(high) + 0.5 * float(high - low) + 0.05 * wanted_m)
        note = f"as then expected, {min(DRAWN, len(self._once))} runs each"
        leaps = Panel("Plans leap by leap", note, "way, m", "end error (1 σ), m", curves, limits)
        order = self._by_share()
        x = np.array(self.wanted_m)[order]
        reached = np.array([np.sqrt(np.mean(_ends(self._done[k]) ** 2)) for k in order])
        told = np.array([np.sqrt(np.mean(_variances(self._done[k]))) for k in order])
        planned_once = np.array([np.sqrt(np.mean(_ends(self._once) ** 2))])
        kept = (
            Curve("as wanted", np.array([0.0, 1.05 * x[-1]]), np.array([0.0, 1.05 * x[-1]]), "bound"),
            Curve("stated", x, told, "result"),
            Curve("found", x, reached, "points"),
            Curve("planned once", np.array(self.wanted_m[:1]), planned_once, "raw"),
        )
        return leaps, Panel("Wanted and reached", "rms over runs", "end error wanted, m", "end error, m", kept)

    def _by_share(self) -> list[int]:
        """Shares in rising order."""
        return sorted(self._shares, key=SHARES.__getitem__)

    def _apart(self, runs: Sequence[Run], case: str) -> Finding:
        """How many stops a run leave two robots where they cannot hear each other."""
        beyond = [float(np.sum(run.farthest_m > self._ranging.reach_m)) for run in runs]
        return _mean(beyond, case, "stops out of reach, a run")

    def _claim(self, k: int) -> str:
        if self.first[k].status == "ok":
            return f"at most {_text(self.wanted_m[k])}"
        return f"out of reach; best: {_text(self.first[k].end_sd_m)}"

    def _asked(self, now: Formation, wanted_m: float) -> Plan:
        return plan(now, COURSE, self._ranging, wanted_m, WAY_SD)

    def _kept(self, now: Formation) -> Plan:
        """What the strip of the first plan comes to, which is kept whatever comes of it."""
        strip = self.first[0]
        unbounded = replace(self._ranging, reach_m=np.inf)
        return plan(now, COURSE, unbounded, self.wanted_m[0], WAY_SD, (strip.step_m,), (strip.width_m,))


def _along(runs: Sequence[Run]) -> tuple[Floats, Floats]:
    """How far along each leap ended, and the end error expected by then, from the start on; NaN between runs."""
    x = [np.array([0.0, *run.along_m, np.nan]) for run in runs]
    y = [np.array([run.plans[0].end_sd_m, *_expected(run), np.nan]) for run in runs]
    return np.concatenate(x), np.concatenate(y)


def _expected(run: Run) -> Floats:
    """End error (n,) that the plan asked for after each leap expects; at last what is stated."""
    last = float(np.sqrt(np.trace(run.covariance_m2[-1])))
    return np.array([*(plan.end_sd_m for plan in run.plans[1:]), last])


def _ends(runs: Sequence[Run]) -> Floats:
    """Errors (runs,) of the robots that arrived."""
    return np.array([float(np.hypot(*run.miss_m[-1])) for run in runs])


def _variances(runs: Sequence[Run]) -> Floats:
    return np.array([float(np.trace(run.covariance_m2[-1])) for run in runs])


def _mean(values: Sequence[float], case: str, quantity: str) -> Finding:
    sd = float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return Finding(case, quantity, float(np.mean(values)), sd, "1", len(values))


def _text(length_m: float) -> str:
    return f"{100 * length_m:.3g} cm"
