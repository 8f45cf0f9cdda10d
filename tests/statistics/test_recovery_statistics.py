"""Vehicles carried off, and wheels that slip: how soon a track is right again, over ten-minute drives.

Between epochs a vehicle drives a smooth loop; at random times it is carried five metres, within one epoch, to another
place of the hall. It counts as found once the track is within `NEAR_M` and stays there for two epochs.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np
import pytest
from numpy.typing import NDArray

from locate.made_epochs import BOUNDS, HALL, Drive, make_epoch, make_site, rows_of
from sonofix.records import Floats, Table
from sonofix.site import Site
from sonofix.street import Street

PERIOD_S = 0.5
LEVEL_M = 0.5
CARRIED_M = 5.0
NEAR_M = 0.05
PROCESSES = 2


@dataclass(frozen=True)
class Kind:
    """How a vehicle is heard: range and rate deviations, an unknown clock, odometry; how often it is carried."""

    name: str
    sd_m: float = 0.003
    rate_sd_mps: float | None = 0.005
    clock_m: float | None = None
    odometry: bool = False
    every_s: float = 20.0
    lone: float = 0.2
    """Share of epochs in which only three beacons are heard."""


KINDS = (
    Kind("ranges and rates"),
    Kind("ranges alone", rate_sd_mps=None),
    Kind("TDoA", clock_m=12.0),
    Kind("odometry that does not notice", odometry=True),
)


def loop(time_s: float, phase: float) -> tuple[Floats, Floats]:
    """Place and velocity (2,) of a loop of 3 m x 2 m about a middle, at 0.2 to 1 m/s."""
    a, b = 0.25 * time_s + phase, 0.4 * time_s
    place = np.array([1.5 * np.cos(a), 1.0 * np.sin(b)])
    return place, np.array([-0.375 * np.sin(a), 0.4 * np.cos(b)])


def middles(time_s: Floats, every_s: float, rng: np.random.Generator) -> Floats:
    """Middles (n, 2) of the loop at each instant: now and then five metres further to the other side of the hall."""
    middle, out = np.array([2.6, 4.0]), []
    due = time_s[0] + every_s * rng.uniform(0.75, 1.25)
    for t in time_s:
        while t >= due:
            angle = rng.uniform(-0.4, 0.4) + (np.pi if middle[0] > 5.0 else 0.0)
            there = middle + CARRIED_M * np.array([np.cos(angle), np.sin(angle)])
            if np.all(there > [1.6, 1.5]) and np.all(there < [8.4, 6.5]):
                middle, due = there, due + every_s * rng.uniform(0.75, 1.25)
        out.append(middle)
    return np.array(out)


def odometry(time_s: Floats, phase: float, factor: Floats) -> Table:
    """What wheels tell: speed, times ``factor`` (n,), and yaw rate of the loop; nothing of being carried."""
    velocity = np.array([loop(t, phase)[1] for t in time_s])
    yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    middle = np.array([loop(t, phase)[1] for t in time_s[:-1] + np.diff(time_s) / 2])
    speed = np.append(np.hypot(*middle.T), 0.0) * factor
    rate = np.append(np.diff(yaw) / np.diff(time_s), 0.0)
    columns = {"time_s": time_s, "v_mps": speed, "yaw_rate_radps": rate}
    return Table(columns, {"vehicle": ("v",) * len(time_s)})


def drive(kind: Kind, duration_s: float, seed: int, slip: tuple[float, float, float] | None = None) -> tuple:
    """One drive: instants, errors (n,), squared errors over their variance (n,), and the epochs just after a carriage.

    ``slip`` is when wheels begin to slip, for how long, and by what factor they then read.
    """
    rng = np.random.default_rng([7, seed])
    site: Site = make_site(HALL, level_m=LEVEL_M, bounds_m=BOUNDS)
    street, phase = Street(site), rng.uniform(0, 2 * np.pi)
    time_s = PERIOD_S * np.arange(round(duration_s / PERIOD_S)) + 0.02
    middle = middles(time_s, kind.every_s, rng)
    if kind.odometry:
        fine_s = np.arange(0.0, duration_s + 0.2, 0.1)
        factor = np.ones(len(fine_s))
        if slip is not None:
            factor[(fine_s >= slip[0]) & (fine_s < slip[0] + slip[1])] = slip[2]
        street.sense({"odometry": odometry(fine_s, phase, factor)})
    error, nees = np.full(len(time_s), np.inf), np.full(len(time_s), np.nan)
    for k, t in enumerate(time_s):
        place, velocity = loop(t, phase)
        here = Drive((*(place + middle[k] - velocity * t).tolist(), LEVEL_M), (*velocity.tolist(), 0.0))
        epoch = make_epoch(
            site, here, float(t), sd_m=kind.sd_m, rate_sd_mps=kind.rate_sd_mps, clock_m=kind.clock_m, rng=rng
        )
        if k > 2 and rng.random() < kind.lone:
            epoch = rows_of(epoch, rng.choice(len(epoch), 3, replace=False))
        for got in street.walk(epoch).estimates:
            miss = (got.position_m - here.origin(got.time_s))[:2]
            error[k], nees[k] = np.hypot(*miss), miss @ np.linalg.solve(got.covariance[:2, :2], miss)
    after = np.flatnonzero(np.any(np.diff(middle, axis=0) != 0, axis=1)) + 1
    return time_s, error, nees, after


def found_after_s(time_s: Floats, error: Floats, after: NDArray[np.int64]) -> Floats:
    """Time (c,) from the first epoch at each new place until the track is near and stays; infinite: never.

    A carriage in the last seconds is left out.
    """
    near = error < NEAR_M
    out = []
    for k, until in zip(after, [*after[1:], len(time_s)], strict=True):
        if until - k < 8:
            continue
        there = np.flatnonzero(near[k : until - 1] & near[k + 1 : until])
        out.append(time_s[k + there[0]] - time_s[k] if len(there) else np.inf)
    return np.array(out)


def recovery(kind: Kind, runs: int, duration_s: float, pool: Executor | None = None) -> tuple[Floats, Floats, float]:
    """Times to be found again, NEES of epochs that are not in between, and their rms error, of many drives."""
    one = partial(drive, kind, duration_s)
    times, calm, errors = [], [], []
    for time_s, error, nees, after in (pool.map if pool else map)(one, range(runs)):
        times.append(found_after_s(time_s, error, after))
        settled = error < NEAR_M
        calm.append(nees[settled])
        errors.append(error[settled])
    return np.concatenate(times), np.concatenate(calm), float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def slipping(lone: float, runs: int, pool: Executor | None = None) -> tuple[float, float]:
    """Rms error while wheels read half as much again for five seconds, and in the same seconds of drives where not."""
    kind = Kind("slip", odometry=True, every_s=1e9, lone=lone)
    squares = []
    for factor in (1.5, 1.0):
        one = partial(drive, kind, 20.0, slip=(10.0, 5.0, factor))
        told = list((pool.map if pool else map)(one, range(runs)))
        window = (told[0][0] > 10.0) & (told[0][0] < 16.0)
        squares.append(np.mean([error[window] ** 2 for _, error, *_ in told]))
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.name)
def test_a_vehicle_carried_off_is_found_again(kind: Kind) -> None:
    times, calm, rms_m = recovery(kind, 1, 120.0)
    assert len(times) >= 4
    assert times.max() <= 3.0
    assert rms_m < 3 * kind.sd_m
    assert 1.0 < calm.mean() < 3.5


def test_wheels_that_slip_hardly_move_the_track() -> None:
    slipped, nominal = slipping(0.2, 4)
    assert slipped < 2 * nominal


@pytest.fixture(scope="module")
def workers() -> Iterator[Executor]:
    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")) as pool:
        yield pool


@pytest.mark.prove
def test_table_of_vehicles_carried_off(workers: Executor) -> None:
    runs, minutes = 40, 10
    print(f"\nCarried off by {CARRIED_M:g} m about every 20 s, {runs} drives of {minutes} minutes a row.\n")
    print("| heard by | carried off | found within 3 s | longest | rms error else | NEES / 2 else |\n|" + "---|" * 6)
    for kind in KINDS:
        times, calm, rms_m = recovery(kind, runs, 60.0 * minutes, workers)
        share, longest = float(np.mean(times <= 3.0)), float(times.max())
        print(
            f"| {kind.name} | {len(times)} | {100 * share:.2f} % | {longest:.1f} s | {1e3 * rms_m:.1f} mm "
            f"| {calm.mean() / 2:.3f} |"
        )
        assert share >= 0.999
        assert 0.8 < calm.mean() / 2 < 1.2


@pytest.mark.prove
def test_table_of_wheels_that_slip(workers: Executor) -> None:
    runs = 100
    print(f"\nWheels that read half as much again for 5 s, {runs} drives a row; rms error in those seconds.\n")
    print("| epochs in which only three beacons are heard | without slip | with slip | ratio |\n|" + "---|" * 4)
    for lone in (0.0, 0.5, 1.0):
        slipped, nominal = slipping(lone, runs, workers)
        print(f"| {100 * lone:g} % | {1e3 * nominal:.1f} mm | {1e3 * slipped:.1f} mm | {slipped / nominal:.2f} |")
        assert slipped < 2 * nominal
