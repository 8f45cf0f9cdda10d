"""Fixes over many trials: as good as the Cramér–Rao bound allows, and as good as they say.

All bands follow from the number of trials: a sum of N squared errors of k components, each over its own variance, is χ²
with N k degrees of freedom; a count of hits among N is binomial. A band holds all but 1e-6 of a right program's runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

from locate.made_epochs import BOUNDS, HALL, SPEED, ends, heard_range_m, make_epoch, make_site
from locate.made_tilts import CORNERS, Flight
from sonofix.geometry import SIZE
from sonofix.locate.fix import fix
from sonofix.locate.noise import CLOCK_SPEED_SD
from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site

OUTSIDE = 1e-6
PLACE = (3.0, 5.5, 1.1)
CEILING = ((0.0, 0.0, 3.2), (10.0, 0.0, 3.2), (10.0, 8.0, 3.2), (0.0, 8.0, 3.2), (4.0, 3.0, 3.2))
TWO_ARMS = ((0.35, 0.1, 0.5), (-0.3, -0.2, 0.5))
COMPONENTS = {"x": 0, "y": 1, "z": 2, "yaw": 3, "vx": 4, "vy": 5, "vz": 6, "roll": 8, "pitch": 9}


STANDING = Flight(PLACE)
DRIVING = Flight(PLACE, (0.8, -0.6, 0.0), yaw_rad=0.5)


@dataclass(frozen=True)
class Case:
    site: Site
    states: tuple[str, ...]
    rate_sd_mps: float | None = None
    clock_m: float | None = None
    drive: Flight = STANDING
    sd_m: float = 0.01


CASES = {
    "space": Case(make_site(HALL), ("x", "y", "z")),
    "level": Case(make_site(HALL, level_m=1.1), ("x", "y")),
    "ceiling, in its room": Case(make_site(CEILING, bounds_m=BOUNDS), ("x", "y", "z")),
    "space, TDoA": Case(make_site(HALL), ("x", "y", "z"), clock_m=30.0),
    "level, TDoA": Case(make_site(HALL, level_m=1.1), ("x", "y"), clock_m=30.0),
    "space, rates": Case(make_site(HALL), ("x", "y", "z", "vx", "vy", "vz"), rate_sd_mps=0.05, drive=DRIVING),
    "level, TDoA, rates": Case(
        make_site(HALL, level_m=1.1), ("x", "y", "vx", "vy"), rate_sd_mps=0.05, clock_m=30.0, drive=DRIVING
    ),
    "sounding, TDoA, rates": Case(
        make_site(HALL, sounding=True),
        ("x", "y", "z", "vx", "vy", "vz"),
        rate_sd_mps=0.05,
        clock_m=30.0,
        drive=DRIVING,
    ),
    "three microphones on a body that tilts": Case(
        make_site(HALL, arms_m=CORNERS),
        ("x", "y", "z", "yaw", "roll", "pitch"),
        sd_m=0.002,
        drive=Flight(PLACE, yaw_rad=0.5, roll_rad=0.3, pitch_rad=-0.2),
    ),
    "the same, rocking, rates": Case(
        make_site(HALL, arms_m=CORNERS),
        ("x", "y", "z", "yaw", "roll", "pitch", "vx", "vy", "vz"),
        sd_m=0.002,
        rate_sd_mps=0.01,
        drive=Flight(PLACE, (0.8, -0.6, 0.3), 0.5, 0.4, 0.3, -0.2, 0.9, -0.7),
    ),
    "two microphones": Case(make_site(HALL, arms_m=TWO_ARMS, level_m=1.1), ("x", "y", "yaw"), drive=DRIVING),
}


def bound(case: Case) -> Floats:
    """Cramér–Rao: inverse Fisher information by differences of the exact model, with nuisances (clock, yaw rate)."""
    site, drive = case.site, case.drive
    pairs = [(b.id, m.id) for b in site.beacons for m in site.microphones]
    tilt = (drive.roll_rad, drive.pitch_rad, drive.roll_rate_radps, drive.pitch_rate_radps)
    truth = np.array([*drive.position_m, drive.yaw_rad, *drive.velocity_mps, drive.yaw_rate_radps, *tilt])
    free = [COMPONENTS[s] for s in case.states]
    if case.rate_sd_mps is not None and "yaw" in case.states:
        free += [7] + [10, 11] * ("roll" in case.states)

    def shown(pose: Floats) -> Floats:
        moved = Flight(pose[:3], pose[4:7], pose[3], pose[7], *pose[8:])
        rows = [ends(site, moved, *pair) for pair in pairs]
        ranges = np.array([heard_range_m(*row, 0.0) for row in rows]) / case.sd_m
        if case.rate_sd_mps is None:
            return ranges
        after, before = (np.array([heard_range_m(*row, t) for row in rows]) for t in (1e-3, -1e-3))
        return np.concatenate([ranges, (after - before) / 2e-3 / case.rate_sd_mps])

    columns = []
    for i in free:
        step = np.zeros(SIZE)
        step[i] = 1e-4
        columns.append((shown(truth + step) - shown(truth - step)) / 2e-4)
    if case.clock_m is not None:
        clock = np.zeros(len(columns[0]))
        clock[: len(pairs)] = 1 / case.sd_m
        columns.append(clock)
    jacobian = np.column_stack(columns)
    information = jacobian.T @ jacobian
    if case.clock_m is not None and case.rate_sd_mps is not None:
        # the clock's speed, drawn anew in every trial, is in all rates: one more unknown with a prior, then left out
        shared = np.repeat([0.0, 1 / case.rate_sd_mps], len(pairs))
        cross = jacobian.T @ shared
        information -= np.outer(cross, cross) / (shared @ shared + (CLOCK_SPEED_SD * SPEED) ** -2)
    return np.linalg.inv(information)[: len(case.states), : len(case.states)]


@dataclass(frozen=True)
class Outcome:
    """Errors (N, k) and normalised squared errors (N,) of N fixes, how many doubted a row, and the bound (k, k)."""

    error: Floats
    squared: Floats
    horizontal: Floats
    doubted: int
    bound: Floats


def measure(case: Case, trials: int, rng: np.random.Generator) -> Outcome:
    error, squared, horizontal, doubted = [], [], [], 0
    pose = [*case.drive.position_m, case.drive.yaw_rad, *case.drive.velocity_mps]
    truth = np.array([*pose, 0.0, case.drive.roll_rad, case.drive.pitch_rad])
    index = [COMPONENTS[s] for s in case.states]
    exact = make_epoch(case.site, case.drive, sd_m=case.sd_m, rate_sd_mps=case.rate_sd_mps, clock_m=case.clock_m)
    for _ in range(trials):
        found = fix(noisy(exact, case, rng), case.site, "v")
        assert found.status == "ok", found.remedy
        doubted += not found.used.all()
        velocity = found.velocity_mps if found.velocity_mps is not None else np.zeros(3)
        attitude = (found.yaw_rad or 0.0, found.roll_rad or 0.0, found.pitch_rad or 0.0)
        whole = np.array([*found.position_m, attitude[0], *velocity, 0.0, *attitude[1:]])
        miss = (whole - truth)[index]
        if "yaw" in case.states:
            miss[case.states.index("yaw")] = np.angle(np.exp(1j * miss[case.states.index("yaw")]))
        own = [found.states.index(s) for s in case.states]
        covariance = found.covariance[np.ix_(own, own)]
        error.append(miss)
        squared.append(miss @ np.linalg.solve(covariance, miss))
        horizontal.append(miss[:2] @ np.linalg.solve(covariance[:2, :2], miss[:2]))
    return Outcome(np.array(error), np.array(squared), np.array(horizontal), doubted, bound(case))


def noisy(exact: RangeEpoch, case: Case, rng: np.random.Generator) -> RangeEpoch:
    rates = exact.range_rate_mps
    if rates is not None and case.rate_sd_mps is not None:
        rates = rates + case.rate_sd_mps * rng.standard_normal(len(exact))
        if case.clock_m is not None:
            rates = rates + CLOCK_SPEED_SD * SPEED * rng.standard_normal()
    range_m = exact.range_m + case.sd_m * rng.standard_normal(len(exact))
    return replace(exact, range_m=range_m, range_rate_mps=rates)


def band(degrees: int) -> tuple[float, float]:
    """Interval of a mean of χ² per degree of freedom."""
    low, high = chi2.interval(1 - OUTSIDE, degrees)
    return low / degrees, high / degrees


def check(outcome: Outcome, trials: int) -> None:
    k = outcome.error.shape[1]
    low, high = band(trials * k)
    assert low < outcome.squared.mean() / k < high
    # errors against the bound, all components together: whitened by it, they are χ² as well
    whitened = np.einsum("ni,ij,nj->n", outcome.error, np.linalg.inv(outcome.bound), outcome.error)
    assert low < whitened.mean() / k < high
    one_low, one_high = band(trials)
    ratio = (outcome.error**2).mean(axis=0) / np.diag(outcome.bound)
    assert ((one_low < ratio) & (ratio < one_high)).all()
    # no bias: each mean within five of its deviations
    assert (np.abs(outcome.error.mean(axis=0)) < 5 * np.sqrt(np.diag(outcome.bound) / trials)).all()
    inside = int((outcome.horizontal < chi2.ppf(0.95, 2)).sum())
    assert binom.ppf(OUTSIDE / 2, trials, 0.95) <= inside <= binom.ppf(1 - OUTSIDE / 2, trials, 0.95)


@pytest.mark.parametrize("name", CASES)
def test_fixes_reach_the_bound_and_tell_their_error(name: str, rng: np.random.Generator) -> None:
    trials = 250
    check(measure(CASES[name], trials, rng), trials)


@pytest.mark.prove
def test_fixes_over_thousands_of_trials(rng: np.random.Generator) -> None:
    trials = 2000
    low, high = band(trials)
    print(f"\nFixes at one place of a hall of 10 m × 8 m, {trials} trials a row; ranges good to 1 cm, rates to 5 cm/s.")
    print(f"A right variance ratio of one component lies between {low:.3f} and {high:.3f} in all but 1e-6 of runs.\n")
    print("| case | states | rms / bound | NEES / states | 95 % ellipse holds | a row doubted |")
    print("|---|---|---|---|---|---|")
    for name, case in CASES.items():
        outcome = measure(case, trials, rng)
        ratio = np.sqrt((outcome.error**2).mean(axis=0) / np.diag(outcome.bound))
        inside = (outcome.horizontal < chi2.ppf(0.95, 2)).mean()
        nees = outcome.squared.mean() / len(case.states)
        cells = [name, ", ".join(case.states), ", ".join(f"{r:.3f}" for r in ratio), f"{nees:.3f}"]
        print("| " + " | ".join([*cells, f"{100 * inside:.1f} %", f"{outcome.doubted}"]) + " |")
        check(outcome, trials)
