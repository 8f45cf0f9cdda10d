"""Runs of leap-frog over 100 m: three robots leave a strip of triangles, ranges drawn or heard; and odometry alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sonofix.records import Floats
from sonofix.studies import robots_stops
from sonofix.studies.robots_stops import ROBOTS, Heard
from sonofix.team.ahead import MOST_LEAPS, Course, Ranging, hindmost, landing
from sonofix.team.leapfrog import Formation, Leap, begin, leapt
from sonofix.team.planner import Plan

LENGTH_M, LEG_M, WIDTH_M = 100.0, 10.0, 10.0
"""Each robot goes 10 m along at a time, 3.3 m past the foremost: triangles of 10.5 m and 6.7 m."""

SPEED_SD = 5e-4
"""Deviation of the speed of sound, a share: 0.3 K."""

BASE_SD_M = 1e-3
"""Of the distance from K to R2 at the start, where it is measured."""

SNR_DB, TONE_DB = 6.0, 20.0
"""Of a burst over noise in 4 kHz, and of the tone over a burst, 10 m away."""

WAY_SD = 0.05
"""Of a leap by odometry, a share; robots end their leaps as far from where they should."""

WHEEL_SCALE_SD, WHEEL_TURN_SD = 0.01, np.radians(0.2)
"""Odometry alone: ways too long by a constant share, and a heading that wanders (rad per √m)."""

TRIES = 3
BENCH_STOPS = 8


class Ears(Protocol):
    """Ranges among robots that stand at true places (3, 2), sound being slower than taken for by a share."""

    def __call__(self, place_m: Floats, scale: float) -> Heard:
        """Range all pairs."""
        ...


@dataclass(frozen=True, slots=True)
class Case:
    """One kind of run: the speed of sound's deviation, and that of a measured base or None."""

    name: str
    speed_sd: float
    base_sd_m: float | None = None
    step_m: float = LEG_M
    width_m: float = WIDTH_M


CASES = (
    Case("speed of sound known", 0.0),
    Case("known to 0.05 %", SPEED_SD),
    Case("K–R2 measured to 1 mm", SPEED_SD, BASE_SD_M),
)


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One run, a leap a row.

    Attributes
    ----------
    along_m : float64 (n,)
        How far along the robot is that leapt.
    miss_m : float64 (n, 2)
        Its error.
    covariance_m2 : float64 (n, 2, 2)
        As stated.
    scale_miss, scale_sd : float
        Of the speed of sound at the end.
    by_scale_m : float
        Error at the end for each 1 of the scale's.
    places_m : float64 (n + 3, 2)
        Where robots stood, those of the start first.
    again : int
        Stops that had to be ranged anew.
    robots : tuple of str
        Who leapt.
    way_m : float64 (n,)
        How far each leap was meant to go.
    farthest_m : float64 (n,)
        Greatest distance of two robots after each.
    plans : tuple of Plan
        What was asked for before each leap; empty where all was set before.
    """

    along_m: Floats
    miss_m: Floats
    covariance_m2: Floats
    scale_miss: float
    scale_sd: float
    by_scale_m: float
    places_m: Floats
    again: int
    robots: tuple[str, ...]
    way_m: Floats
    farthest_m: Floats
    plans: tuple[Plan, ...]


START_M = np.array([[i * LEG_M / 3, WIDTH_M / 2 * (-1.0, 1.0, -1.0)[i]] for i in range(3)])
"""Places of K, R2 and R1 at the start: as if the strip came from behind."""

COURSE = Course(np.zeros(2), 0.0, LENGTH_M + 2 * LEG_M / 3)
"""Straight on, 100 m for R1, the foremost."""


def drive(case: Case, ears: Ears, rng: np.random.Generator, ask: Callable[[Formation], Plan] | None = None) -> Run:
    """Do one run.

    Parameters
    ----------
    ask : callable, optional
        Tells each leap by what is known before it; else the hindmost leaps, by the case's strip.

    Raises
    ------
    RuntimeError
        If a stop yields no place in `TRIES` attempts, a plan none at all, or the end is not reached in `MOST_LEAPS`.
    """
    true = START_M.copy()
    scale = case.speed_sd * float(rng.standard_normal())
    base = None
    if case.base_sd_m is not None:
        base = (float(np.hypot(*(true[1] - true[0])) + case.base_sd_m * rng.standard_normal()), case.base_sd_m)
    heard = ears(true, scale)
    # roughly where they stand: each within a metre of that
    rough = true + rng.uniform(-0.5, 0.5, (3, 2)) * np.array([[0.0], [0.0], [1.0]])
    found = begin(ROBOTS, rough, heard.pairs, heard.range_m, heard.covariance_m2, case.speed_sd, base)
    if found.status != "ok":
        raise RuntimeError(f"the start: {found.remedy}")
    now, again, arrived = found.formation, 0, False
    along, miss, spread, places = [], [], [], [*true.copy()]
    robots: list[str] = []
    ways: list[float] = []
    farthest: list[float] = []
    plans: list[Plan] = []
    while not arrived:
        if len(robots) == MOST_LEAPS:
            raise RuntimeError(f"the end is not reached in {MOST_LEAPS} leaps")
        if ask is not None:
            plans.append(ask(now))
            if plans[-1].status == "unreachable":
                raise RuntimeError(f"after {len(robots)} leaps: {plans[-1].remedy}")
            robot, to_m = plans[-1].robot, plans[-1].place_m
            who = now.index(robot)
        else:
            robot = hindmost(now, COURSE)
            who = now.index(robot)
            (to_m,) = landing(
                now.place_m[None], np.array([who]), COURSE, np.array([case.step_m]), np.array([case.width_m])
            )
        meant = to_m - now.place_m[who]
        way_m = float(np.hypot(*meant))
        true[who] += meant + WAY_SD * way_m * rng.standard_normal(2)
        leap, tries = _leapt(now, robot, meant, WAY_SD * way_m, ears, true, scale)
        if leap.status != "ok":
            raise RuntimeError(f"{robot} after {len(along)} leaps: {leap.remedy}")
        now, again = leap.formation, again + tries - 1
        # the last leap is the one that is meant to end there, or one that is past it by chance
        arrived = COURSE.arrived(to_m) or COURSE.arrived(now.place_m[who])
        along.append(float(now.place_m[who, 0]))
        miss.append(now.place_m[who] - true[who])
        spread.append(now.covariance_m2(robot))
        places.append(true[who].copy())
        robots.append(robot)
        ways.append(way_m)
        farthest.append(float(np.hypot(*(true - true[:, None]).T).max()))
    return Run(
        along_m=np.array(along),
        miss_m=np.array(miss),
        covariance_m2=np.array(spread),
        scale_miss=now.scale - scale,
        scale_sd=now.scale_sd,
        by_scale_m=float(np.hypot(*now.by_scale_m(robots[-1]))),
        places_m=np.array(places),
        again=again,
        robots=tuple(robots),
        way_m=np.array(ways),
        farthest_m=np.array(farthest),
        plans=tuple(plans),
    )


def _leapt(
    now: Formation, robot: str, meant: Floats, way_sd: float, ears: Ears, true: Floats, scale: float
) -> tuple[Leap, int]:
    """Range a robot that has leapt, anew where that gives no place; with the number of tries."""
    for tries in range(1, TRIES):
        heard = ears(true, scale)
        leap = leapt(now, robot, meant, way_sd**2 * np.eye(2), heard.pairs, heard.range_m, heard.covariance_m2)
        if leap.status == "ok":
            return leap, tries
    heard = ears(true, scale)
    return leapt(now, robot, meant, way_sd**2 * np.eye(2), heard.pairs, heard.range_m, heard.covariance_m2), TRIES


def stated(ranging: Ranging, rng: np.random.Generator) -> Ears:
    """Ears that draw ranges of a stated covariance."""
    pairs = (("K", "R2"), ("K", "R1"), ("R2", "R1"))

    def ears(place_m: Floats, scale: float) -> Heard:
        distance = np.array([np.hypot(*(place_m[ROBOTS.index(b)] - place_m[ROBOTS.index(a)])) for a, b in pairs])
        noise = ranging.covariance_m2(distance)
        drawn = (1.0 + scale) * distance + np.sqrt(np.diag(noise)) * rng.standard_normal(len(pairs))
        return Heard(pairs, drawn, noise)

    return ears


def hearing(bench: robots_stops.Bench, rng: np.random.Generator) -> Ears:
    """Ears that simulate bursts and hear them."""
    return lambda place_m, scale: robots_stops.stop(bench, place_m, scale, rng.integers(2**31, size=2).tolist())


def heard_run(bench: robots_stops.Bench, number: int, seed: int) -> Run:
    """Run from waveforms, the speed of sound known to `SPEED_SD`."""
    rng = np.random.default_rng([seed, 31, number])
    return drive(CASES[1], hearing(bench, rng), rng)


def calibrated(bench: robots_stops.Bench, seed: int) -> tuple[Ranging, Floats, Floats]:
    """Measure how well robots range each other 10 m apart: the model, and errors (stops, 3) and stated deviations."""
    place = robots_stops.AT_M * np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])
    heard = [robots_stops.stop(bench, place, 0.0, (seed, 32, k)) for k in range(BENCH_STOPS)]
    whole = [h for h in heard if len(h.pairs) == 3]
    miss = np.array([h.range_m - robots_stops.AT_M for h in whole])
    sd = np.sqrt(np.array([np.diag(h.covariance_m2) for h in whole]))
    model = Ranging(
        float(np.sqrt(np.mean(sd**2))), robots_stops.AT_M, robots_stops.ABSORPTION_DB_PER_M, robots_stops.REACH_M
    )
    return model, miss, sd


def wheels_alone(numbers: range, seed: int) -> Floats:
    """Errors (runs, 100, 2) of odometry alone, after each metre of R1's way straight on."""
    out = []
    for run in numbers:
        rng = np.random.default_rng([seed, 33, run])
        steps = round(LENGTH_M)
        heading = np.cumsum(WHEEL_TURN_SD * rng.standard_normal(steps))
        told = (1 + WHEEL_SCALE_SD * rng.standard_normal()) * np.column_stack([np.cos(heading), np.sin(heading)])
        out.append(np.cumsum(told, axis=0) - np.column_stack([np.arange(1.0, steps + 1), np.zeros(steps)]))
    return np.array(out)
