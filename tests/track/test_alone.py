"""Sensors that are wrong beside ranges that others state: they are found out, and right ones are heard throughout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site, rows_of
from sonofix.records import Event, Floats, Table
from sonofix.street import Street
from sonofix.track.alone import FORGIVEN, SILENT_S, Silence

SITE = make_site(HALL, level_m=1.1)
PAIRS = tuple((b.id, m.id) for b in SITE.beacons for m in SITE.microphones)
PERIOD_S, COUNT, SD_M = 0.5, 120, 0.05


def pose(time_s: Floats) -> Floats:
    """Place and heading (3, n) of a lying eight."""
    a = 0.2 * np.asarray(time_s)
    x, y = 5.0 + 2.5 * np.cos(a), 4.0 + 1.5 * np.sin(2 * a)
    return np.array([x, y, np.unwrap(np.arctan2(3.0 * np.cos(2 * a), -2.5 * np.sin(a)))])


def tables(rng: np.random.Generator) -> dict[str, Table]:
    """What wheels and a compass tell of it."""
    t = 0.1 * np.arange(620)
    x, y, yaw = pose(t)
    speed = np.hypot(np.diff(x), np.diff(y)) / 0.1 * 1.03 + 0.01 * rng.standard_normal(619)
    odometry = {"time_s": t[:-1], "v_mps": speed, "yaw_rate_radps": np.diff(yaw) / 0.1}
    return {
        "odometry": Table(odometry),
        "compass": Table({"time_s": t, "heading_rad": yaw + 0.03 * rng.standard_normal(620)}),
    }


def driven(
    told: dict[str, Table], rng: np.random.Generator, start: Table | None = None, late: float = 0.0
) -> tuple[Floats, Floats, list[Event]]:
    """Errors (n,) of the track, their squares over what is stated (n,), and events.

    ``late``: share of ranges that are 5 m too long.
    """
    street = Street(SITE, start)
    street.sense(told, stated=PAIRS)
    error, nees, events = [], [], []
    for k in range(COUNT):
        time_s = PERIOD_S * k + 0.05
        x, y, _ = pose(np.array([time_s]))[:, 0]
        epoch = rows_of(make_epoch(SITE, Drive((x, y, 1.1)), sd_m=SD_M, rng=rng, stated=True), [0, 1, 2, 3])
        wrong = np.where(rng.random(4) < late, 5.0, 0.0)
        heard = replace(epoch, time_s=np.full(4, time_s), sync_s=time_s, range_m=epoch.range_m + wrong)
        step = street.walk(heard)
        events += step.events
        for got in step.estimates:
            miss = (got.position_m - (x, y, 1.1))[:2]
            error.append(float(np.hypot(*miss)))
            nees.append(float(miss @ np.linalg.solve(got.covariance[:2, :2], miss)))
    return np.array(error), np.array(nees), events


def gainsaid(events: list[Event]) -> list[float]:
    return [e.time_s for e in events if e.event == "reset" and "gainsay" in e.detail]


WRONG: dict[str, tuple[str, str, Callable[[Floats], Floats]]] = {
    "a compass from north, clockwise": ("compass", "heading_rad", lambda h: np.pi / 2 - h),
    "a compass in degrees": ("compass", "heading_rad", np.degrees),
    "turns in degrees": ("odometry", "yaw_rate_radps", np.degrees),
    "speed of the wrong sign, under a compass": ("odometry", "v_mps", np.negative),
}


@pytest.mark.parametrize("name", WRONG)
def test_sensors_that_are_wrong_are_found_out(name: str, rng: np.random.Generator) -> None:
    told = tables(rng)
    stem, column, spoil = WRONG[name]
    if name == "turns in degrees":
        del told["compass"]
    told[stem] = Table({**told[stem].columns, column: spoil(told[stem].columns[column])})
    error, nees, events = driven(told, rng)
    first = gainsaid(events)[0]
    assert first < 20.0
    # found out again and again, ever more rarely; between, ranges alone place it
    assert np.median(error) < 0.1
    assert np.sqrt(np.mean(error**2)) < 0.5
    assert np.mean(nees < 9.2) > 0.8


@pytest.mark.parametrize("late", [0.0, 0.1], ids=["clean", "one range in ten 5 m late"])
def test_sensors_that_are_right_are_heard_throughout(late: float, rng: np.random.Generator) -> None:
    told = tables(rng)
    error, nees, events = driven(told, rng, late=late)
    assert late or not gainsaid(events)
    assert np.median(error) < 0.08
    assert np.mean(nees < 9.2) > 0.9


@pytest.mark.parametrize("off_m", [(-4.0, 0.0), (5.0, 0.0), (4.0, 4.0), (0.0, -4.0)])
def test_a_start_that_ranges_gainsay_is_not_told(off_m: tuple[float, float], rng: np.random.Generator) -> None:
    x, y, yaw = pose(np.zeros(1))[:, 0]
    columns = {"x_m": np.array([x + off_m[0]]), "y_m": np.array([y + off_m[1]]), "yaw_rad": np.array([yaw])}
    error, _, events = driven(tables(rng), rng, start=Table(columns, {"vehicle": (SITE.vehicles[0].id,)}))
    assert any(e.event in ("slip", "reset") for e in events)
    assert len(error) > COUNT - 30
    assert error.max() < 0.6


def test_sensors_are_silent_for_longer_each_time_until_they_are_forgiven() -> None:
    silence = Silence()
    assert silence.over(0.0)
    assert silence.begin(100.0) == SILENT_S
    assert not silence.over(100.0 + 0.9 * SILENT_S)
    assert silence.over(100.0 + SILENT_S)
    assert silence.begin(110.0) == 2 * SILENT_S
    assert silence.begin(130.0) == 4 * SILENT_S
    assert silence.begin(150.0 + (FORGIVEN + 0.1) * 4 * SILENT_S) == SILENT_S
