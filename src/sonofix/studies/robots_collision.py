"""The third seed's figures 3 and 6: a robot knocked from (15, 15) to (10, 15), brought back by its fellows' fixes.

The seed gives the knock and the picture's frame; speed, period and noise are ours. Beside it the same is heard: three
robots sound and listen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sonofix import flow
from sonofix.channel import Sampled
from sonofix.locate.triangle import triangle
from sonofix.records import Curve, Finding, Floats, Panel, Sheet
from sonofix.studies import robots_team
from sonofix.studies.robots_fusion import Followed, Way, epochs_until_back, follow, reckoned
from sonofix.studies.work import batches, rms, share

ANCHORS_M = ((0.0, 0.0), (20.0, 0.0))
"""K and R2, which define the frame and stand; R1 keeps to the left of the line from K to R2: the first quadrant."""

START_M, CORNER_M, BESIDE_M = (5.0, 5.0), (15.0, 15.0), (10.0, 15.0)
PERIOD_S = 0.5
STEP_M = (0.5, 0.5)
"""An epoch's way: 1.41 m/s."""

EPOCHS, KNOCK = 40, 20
"""After epoch 20 it stands at the corner and is knocked; epoch 21 is the first to see that."""

WAY_SD, HEADING_SD_RAD = 0.02, np.radians(1.0)
"""Errors of wheels, a share of each epoch's way, and of the compass; white."""

RANGE_SD_M = 0.02
BACK_M, WITHIN = 0.15, 3
"""Error below which the track is back, four of its deviations; and the epochs in which it should be."""

WAYS: dict[Way, str] = {"reset": "as printed", "plain": "eqs 5 to 9 alone", "proper": "with a test for collisions"}

HEARD_START_M, HEARD_S = (12.1, 12.1), 7.0
"""Of the run from waveforms: the part of the way round the knock."""


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """Runs on the seed's numbers: wheels and cooperative fixes (runs, n, 2), and what each way makes of them."""

    wheels_m: Floats
    fixes_m: Floats
    ways: dict[Way, Followed]


def truth() -> Floats:
    """True places (n, 2) at the end of each epoch."""
    driven: Floats = np.array(START_M) + np.arange(1.0, EPOCHS + 1)[:, None] * np.array(STEP_M)
    driven[KNOCK:] += np.array(BESIDE_M) - np.array(CORNER_M)
    return driven


def simulated(numbers: range, seed: int) -> Runs:
    """Compute runs by their numbers, each with a generator of its own."""
    true, anchors = truth(), np.array(ANCHORS_M)
    told, fixes, spread = [], [], []
    way, heading = float(np.hypot(*STEP_M)), float(np.arctan2(STEP_M[1], STEP_M[0]))
    for run in numbers:
        rng = np.random.default_rng([seed, 9, run])
        ways = way * (1 + WAY_SD * rng.standard_normal(EPOCHS))
        headings = heading + HEADING_SD_RAD * rng.standard_normal(EPOCHS)
        told.append(np.column_stack([ways * np.cos(headings), ways * np.sin(headings)]))
        noise = RANGE_SD_M * rng.standard_normal((EPOCHS, 2))
        ranges = np.linalg.norm(true[:, None] - anchors, axis=2) + noise
        corners = [_fixed(anchors, row) for row in ranges]
        fixes.append([place for place, _ in corners])
        spread.append([covariance for _, covariance in corners])
    told_m, fixes_m, fixes_covariance = np.array(told), np.array(fixes), np.array(spread)
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    told_covariance = turn @ np.diag([(way * WAY_SD) ** 2, (way * HEADING_SD_RAD) ** 2]) @ turn.T
    start = np.array(START_M)
    return Runs(
        reckoned(start, told_m),
        fixes_m,
        {w: follow(start, np.zeros((2, 2)), told_m, told_covariance, fixes_m, fixes_covariance, w) for w in WAYS},
    )


def _fixed(anchors: Floats, ranges: Floats) -> tuple[Floats, Floats]:
    """Cooperative place of R1 and its covariance."""
    found = triangle(anchors, np.zeros((4, 4)), ranges, RANGE_SD_M**2 * np.eye(2), side="left")
    assert found.chosen is not None, found.remedy  # the way keeps far from the line through K and R2
    return found.chosen.position_m, found.chosen.covariance_m2


class Collision:
    """The study in progress."""

    def __init__(self, runs: int, seed: int, waveforms: int) -> None:
        self._wanted, self._seed, self._drives = runs, seed, waveforms
        self._done: list[Runs] = []
        self._heard: list[robots_team.Team] = []
        self._motion, self._over_s = robots_team.knocked(HEARD_START_M, CORNER_M, BESIDE_M, _SPEED_MPS, HEARD_S)

    def work(self) -> Iterator[tuple[str, float]]:
        """Compute the runs, then those from waveforms."""
        for numbers in batches(self._wanted):
            self._done.append(simulated(numbers, self._seed))
            yield "on the seed's numbers", numbers.stop / self._wanted
        team = robots_team.site(ANCHORS_M)
        epochs = round(HEARD_S / robots_team.PERIOD_S)
        for drive in range(self._drives):
            recording = robots_team.recorded(
                team, ANCHORS_M, self._motion, _SPEED_MPS, HEARD_S, HEADING_SD_RAD, WAY_SD, self._seed + drive
            )
            steps = []
            for step in flow.run(recording):
                steps.append(step)
                yield "from waveforms", min(1.0, (drive + len(steps) / epochs) / self._drives)
            self._heard.append(robots_team.laid_out(steps))

    def sheet(self) -> Sheet | None:
        """Show what is finished."""
        if not self._done:
            return None
        first = self._done[0]
        panels = [
            _tracks(
                first, "reset", "Figures 3 and 6, as printed", "the last cooperative place stands for the estimate"
            ),
            _tracks(first, "proper", "A proper update", "opened where ranges show a collision"),
            _over_epochs(first),
        ]
        if self._heard:
            panels.append(_heard_panel(self._heard[0], self._motion, self._over_s))
        note = "K at (0, 0) and R2 at (20, 0) stand and range R1, which is knocked from (15, 15) to (10, 15) unnoticed"
        return Sheet("Robots: a collision", note, 2, tuple(panels), self._findings())

    def _findings(self) -> tuple[Finding, ...]:
        true, since = truth(), KNOCK
        fixes = np.concatenate([done.fixes_m for done in self._done]) - true
        wheels = np.concatenate([done.wheels_m for done in self._done]) - true
        out = [
            rms(np.linalg.norm(fixes, axis=2), "cooperative fixes", "rms", "m"),
            rms(np.linalg.norm(wheels, axis=2)[:, -1:], "wheels and compass", "rms at the end", "m", "lost: 5 m"),
        ]
        for way, name in WAYS.items():
            miss = np.concatenate([done.ways[way].places_m for done in self._done]) - true
            off = np.linalg.norm(miss, axis=2)
            back = epochs_until_back(off, since, BACK_M)
            claim = "all" if way != "plain" else ""
            out += [
                rms(off[:, :since], name, "rms before", "m"),
                rms(off[:, since : since + 1], name, "rms at the first epoch after", "m"),
                share((back <= WITHIN)[:, None].astype(float), name, "back within three epochs", claim),
                _mean(back, name, "until back", "epochs", "within 3" if way != "plain" else ""),
                rms(off[:, since + WITHIN :], name, "rms later", "m"),
            ]
        proper = [done.ways["proper"] for done in self._done]
        collision = np.concatenate([each.collision for each in proper])
        miss = np.concatenate([each.places_m for each in proper]) - true
        covariance = np.concatenate([each.covariance_m2 for each in proper])
        nees = np.einsum("rki,rki->rk", miss, np.linalg.solve(covariance, miss[..., None])[..., 0])
        name = WAYS["proper"]
        out += [
            share(collision[:, since : since + 1].astype(float), name, "collision reported at once", "all"),
            share(np.delete(collision, since, axis=1).astype(float), name, "reported elsewhere", "one in a million"),
            _mean(nees.mean(axis=1), name, "NEES of x, y", "1", "2"),
        ]
        return (*out, *self._heard_findings())

    def _heard_findings(self) -> list[Finding]:
        if not self._heard:
            return []
        off = np.array([_miss(team, self._motion) for team in self._heard])
        since = int(np.flatnonzero(self._heard[0].time_s > self._over_s)[0])
        back = epochs_until_back(np.nan_to_num(off, nan=np.inf), since, BACK_M)
        last_s = self._over_s + WITHIN * PERIOD_S
        told = [any(self._over_s <= e.time_s <= last_s and e.vehicle == "R1" for e in t.events) for t in self._heard]
        name = "from waveforms"
        return [
            rms(off[:, :since], f"{name}: track", "rms before", "m"),
            rms(off[:, since:], f"{name}: track", "rms after", "m"),
            _mean(back, f"{name}: track", "until back", "epochs", "within 3"),
            share(np.array(told, float)[:, None], name, "collision reported", "all"),
        ]


_KINDS: dict[Way, Literal["raw", "alone", "result"]] = {"reset": "raw", "plain": "alone", "proper": "result"}
_SPEED_MPS = float(np.hypot(*STEP_M)) / PERIOD_S


def _mean(values: Floats, case: str, quantity: str, unit: str, claim: str) -> Finding:
    """Mean of a number over runs, with its standard error."""
    sd = float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return Finding(case, quantity, float(np.mean(values)), sd, unit, len(values), claim)


def _tracks(runs: Runs, way: Way, title: str, note: str) -> Panel:
    """Tracks of one run: true, wheels, prediction and filtered."""
    true, followed = truth(), runs.ways[way]
    broken = np.insert(true, KNOCK, np.nan, axis=0)
    curves = (
        Curve("true", broken[:, 0], broken[:, 1], "truth"),
        Curve("wheels and compass", runs.wheels_m[0, :, 0], runs.wheels_m[0, :, 1], "alone"),
        Curve("predicted", followed.ahead_m[0, :, 0], followed.ahead_m[0, :, 1], "raw"),
        Curve("filtered", followed.places_m[0, :, 0], followed.places_m[0, :, 1], "result"),
    )
    return Panel(title, note, "x, m", "y, m", curves, (0.0, 27.0))


def _over_epochs(runs: Runs) -> Panel:
    true, epochs = truth(), np.arange(1, EPOCHS + 1, dtype=np.float64)
    curves = tuple(
        Curve(name, epochs, np.linalg.norm(runs.ways[way].places_m[0] - true, axis=1), _KINDS[way])
        for way, name in WAYS.items()
    )
    bound = Curve(f"{100 * BACK_M:.0f} cm", epochs[[0, -1]], np.full(2, BACK_M), "bound")
    blind = ((KNOCK + 0.5, KNOCK + WITHIN + 0.5),)
    note = "grey: three epochs after the knock"
    return Panel("Errors", note, "epoch", "error, m", (*curves, bound), (1e-3, 30.0), logarithmic=True, blind=blind)


def _miss(team: robots_team.Team, motion: Sampled) -> Floats:
    """Errors (n,) of R1's track, NaN where there is none."""
    off = np.full(len(team.time_s), np.nan)
    known = np.isfinite(team.time_s)
    off[known] = np.linalg.norm(team.place_m[known] - motion.at(team.time_s[known]).position_m[:, :2], axis=1)
    return off


def _heard_panel(team: robots_team.Team, motion: Sampled, over_s: float) -> Panel:
    curves = (
        Curve("track", team.time_s, _miss(team, motion), "result"),
        Curve("its stated deviation", team.time_s, team.sd_m, "alone"),
        Curve(f"{100 * BACK_M:.0f} cm", team.time_s[[0, -1]], np.full(2, BACK_M), "bound"),
    )
    told = next((e.detail for e in team.events if e.vehicle == "R1"), "no collision was reported")
    blind = ((over_s, over_s + WITHIN * robots_team.PERIOD_S),)
    return Panel("From waveforms", told, "time, s", "error, m", curves, (1e-4, 10.0), logarithmic=True, blind=blind)
