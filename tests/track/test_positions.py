"""What positions that others computed gainsay: a place, a start, a heading, sensors; and when they stop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import HALL, make_site
from sonofix.flow import run, smoothed
from sonofix.records import Event, Floats, Recording, Step, Table
from sonofix.site import Site

SD_M, PERIOD_S, LAST_S = 0.2, 0.5, 40.0
SITE = make_site(HALL, level_m=1.1)
TIMES = np.arange(0.0, LAST_S, PERIOD_S)


def at(time_s: Floats) -> Floats:
    return np.column_stack([5.0 + 3.0 * np.cos(0.2 * time_s), 4.0 + 3.0 * np.sin(0.2 * time_s)])


def made(
    told: Floats, turn: float | None = 0.2, start: Mapping[str, float] | None = None, sd_m: float = SD_M
) -> Recording:
    """Positions (n, 2) at `TIMES`, with odometry of a yaw rate unless that is None."""
    columns = {"time_s": TIMES, "x_m": told[:, 0], "y_m": told[:, 1], "sd_m": np.full(len(TIMES), sd_m)}
    tables = {"positions": Table(columns)}
    if turn is not None:
        rows = np.arange(0.0, LAST_S, 0.1)
        tables["odometry"] = Table({"time_s": rows, "v_mps": 0.6 + 0 * rows, "yaw_rate_radps": turn + 0 * rows})
    if start is not None:
        tables["start"] = Table({name: np.array([value]) for name, value in start.items()})
    return Recording(site=SITE, tables=tables)


def noisy(rng: np.random.Generator, sd_m: float = SD_M) -> Floats:
    return at(TIMES) + sd_m * rng.standard_normal((len(TIMES), 2))


def judge(steps: list[Step], since_s: float, until_s: float = np.inf) -> tuple[float, float]:
    """Error (rms) and NEES an axis."""
    told = [e for step in steps for e in step.estimates if since_s <= e.time_s < until_s]
    miss = np.array([e.position_m[:2] - at(np.array([e.time_s]))[0] for e in told])
    spread = np.array([e.covariance[:2, :2] for e in told])
    nees = np.einsum("ki,kij,kj->k", miss, np.linalg.inv(spread), miss) / 2.0
    return float(np.sqrt(np.mean(np.sum(miss**2, axis=1)))), float(np.mean(nees))


def events(steps: list[Step], *words: str) -> list[Event]:
    return [event for step in steps for event in step.events if event.event in words]


def test_a_start_that_is_elsewhere_is_not_told(rng: np.random.Generator) -> None:
    recording = made(noisy(rng), start={"x_m": 11.0, "y_m": 7.0, "yaw_rad": np.pi / 2})
    steps = list(run(recording))
    (reset,) = events(steps, "reset")
    assert reset.time_s <= 3 * PERIOD_S
    assert not any(step.estimates for step in steps if step.ranges.sync_s < reset.time_s)
    assert judge(steps, 0.0)[0] < SD_M
    after = list(smoothed(recording, steps))
    assert judge(after, 0.0)[1] < 2.5
    assert after[0].estimates  # a start that was refuted leaves no hole


@pytest.mark.parametrize("turn", [None, 0.2])
@pytest.mark.parametrize("off_m", [1.0, 2.0, 3.0, 4.2, 6.0])
def test_no_row_tells_a_start_that_is_off(off_m: float, turn: float | None, rng: np.random.Generator) -> None:
    nees: list[float] = []
    for _ in range(8):
        steps = list(run(made(noisy(rng), turn, start={"x_m": 8.0 + off_m, "y_m": 4.0, "yaw_rad": np.pi / 2})))
        early = [e for step in steps for e in step.estimates if e.time_s < 1.0]
        assert all(np.hypot(*(e.position_m[:2] - at(np.array([e.time_s]))[0])) < 0.7 * off_m for e in early)
        assert any(step.estimates for step in steps if step.ranges.sync_s < 10 * PERIOD_S)
        if any(step.estimates for step in steps if step.ranges.sync_s <= 6.0):
            nees.append(judge(steps, 0.0, 6.0)[1])
    assert np.mean(nees) < 5.0


def test_a_start_that_is_right_is_told_at_once(rng: np.random.Generator) -> None:
    since_s = []
    for _ in range(16):
        steps = list(run(made(noisy(rng), start={"x_m": 8.0, "y_m": 4.0, "yaw_rad": np.pi / 2})))
        assert not events(steps, "reset")
        since_s.append(min(e.time_s for step in steps for e in step.estimates))
    assert np.median(since_s) == 0.0
    assert max(since_s) <= 3 * PERIOD_S


def test_a_start_that_is_right_is_kept_through_an_outlier(rng: np.random.Generator) -> None:
    told = noisy(rng)
    told[0] += (6.0, -5.0)
    steps = list(run(made(told, start={"x_m": 8.0, "y_m": 4.0, "yaw_rad": np.pi / 2})))
    assert not events(steps, "reset")
    assert judge(steps, PERIOD_S)[0] < SD_M
    off_m = float(np.hypot(*(told[0] - (8.0, 4.0))))
    assert f"a position {off_m:.2f} m, " in events(steps, "excluded")[0].detail


@pytest.mark.parametrize("sd_m", [0.2, 0.5])
def test_a_heading_that_is_wrong_is_found_out(sd_m: float, rng: np.random.Generator) -> None:
    recording = made(noisy(rng, sd_m), start={"x_m": 8.0, "y_m": 4.0, "yaw_rad": np.pi / 2 + 2.2}, sd_m=sd_m)
    steps = list(run(recording))
    (reset,) = events(steps, "reset")
    assert "how it was stated to start" in reset.detail
    assert reset.time_s < 6.0
    error_m, nees = judge(steps, 12.0)
    assert error_m < sd_m
    assert nees < 2.5
    # smoothed it is as if none had been stated
    bare = made(np.column_stack([recording.tables["positions"].columns[c] for c in ("x_m", "y_m")]), sd_m=sd_m)
    without = [e.position_m for step in smoothed(bare, list(run(bare))) for e in step.estimates]
    after = [e.position_m for step in smoothed(recording, steps) for e in step.estimates]
    np.testing.assert_allclose(after, without, atol=1e-6)


def test_a_yaw_rate_of_the_wrong_sign_is_found_out(rng: np.random.Generator) -> None:
    recording = made(noisy(rng), turn=-0.2)
    steps = list(run(recording))
    first, *again = events(steps, "reset")
    assert "gainsay its own sensors, unheard for 5 s" in first.detail
    assert first.time_s < 15.0
    assert all("10 s" in event.detail for event in again[:1])
    # positions by themselves are off by √2 sd, and sensors that are heard in vain cost less than as much again
    assert judge(steps, 5.0)[0] < 2.0 * np.sqrt(2.0) * SD_M
    unheard = judge(steps, first.time_s + 1.0, first.time_s + 5.0)
    assert unheard[1] < 2.5


@pytest.mark.parametrize(("turn", "off_rad", "found_s"), [(0.2, 0.0, None), (-0.2, 0.0, 15.0), (0.2, 2.2, 6.0)])
def test_sensors_of_several_vehicles_are_found_out_too(
    turn: float, off_rad: float, found_s: float | None, rng: np.random.Generator
) -> None:
    site = Site.model_validate({"name": "yard", "vehicle": [{"id": "a", "z_m": 0.0}, {"id": "b", "z_m": 0.0}]})
    names, rows = ("a", "b") * len(TIMES), np.repeat(np.arange(0.0, LAST_S, 0.1), 2)
    told = np.repeat(at(TIMES), 2, axis=0) + SD_M * rng.standard_normal((len(names), 2))
    columns = {"time_s": np.repeat(TIMES, 2), "x_m": told[:, 0], "y_m": told[:, 1], "sd_m": np.full(len(told), SD_M)}
    rates = np.tile([turn, 0.2], len(rows) // 2)
    wheels = {"time_s": rows, "v_mps": 0.6 + 0 * rows, "yaw_rate_radps": rates}
    yaw = np.pi / 2 + np.array([off_rad, 0.0])
    tables = {
        "positions": Table(columns, {"vehicle": names}),
        "odometry": Table(wheels, {"vehicle": ("a", "b") * (len(rows) // 2)}),
        "start": Table({"x_m": np.full(2, 8.0), "y_m": np.full(2, 4.0), "yaw_rad": yaw}, {"vehicle": ("a", "b")}),
    }
    steps = list(run(Recording(site=site, tables=tables)))
    resets = events(steps, "reset")
    assert all(event.vehicle == "a" for event in resets)
    assert (resets[0].time_s < found_s) if found_s else not resets
    a, b = ([replace(s, estimates=tuple(e for e in s.estimates if e.vehicle == v)) for s in steps] for v in "ab")
    assert judge(b, 10.0)[0] < 0.7 * SD_M
    error_m, nees = judge(a, 12.0)
    # with wheels that are wrong for good there are positions alone, √2 sd, and as much until they are found out again
    assert error_m < (0.7 if turn > 0.0 else 2.0 * np.sqrt(2.0)) * SD_M
    assert nees < (1.5 if turn > 0.0 else 4.0)


def test_sensors_that_are_right_are_heard_throughout(rng: np.random.Generator) -> None:
    for _ in range(4):
        steps = list(run(made(noisy(rng))))
        assert not events(steps, "reset")
        assert judge(steps, 10.0)[0] < 0.7 * SD_M


@pytest.mark.parametrize("turn", [None, 0.2])
def test_one_that_is_carried_off_is_found_by_three_positions(turn: float | None, rng: np.random.Generator) -> None:
    shift = np.where(TIMES[:, None] >= 20.0, (3.0, -2.0), 0.0)
    steps = list(run(made(noisy(rng) + shift, turn)))
    (reset,) = events(steps, "reset")
    assert 20.0 + PERIOD_S <= reset.time_s <= 20.0 + 3 * PERIOD_S
    # nor is it taken for noise
    assert np.median([e.sd("x") for step in steps for e in step.estimates if e.time_s > 25.0]) < SD_M


@pytest.mark.parametrize("turn", [None, 0.2])
def test_noise_that_is_larger_than_stated_is_learnt_at_once(turn: float | None, rng: np.random.Generator) -> None:
    told = noisy(rng, 0.7)
    steps, right = (list(run(made(told, turn, sd_m=sd_m))) for sd_m in (0.1, 0.7))
    assert judge(steps, 10.0)[0] < 1.3 * judge(right, 10.0)[0]
    assert 0.4 < judge(steps, 10.0)[1] < 2.0
    # the first few seconds: placed anew by what fits all that came, it does not fly off
    worst = max(np.hypot(*(e.position_m[:2] - at(np.array([e.time_s]))[0])) for s in steps for e in s.estimates)
    assert worst < 8.0


@pytest.mark.parametrize("turn", [None, 0.2])
@pytest.mark.parametrize("times", [1.0, 3.0, 5.0])
def test_height_errs_by_a_scale_of_its_own(times: float, turn: float | None, rng: np.random.Generator) -> None:
    told, resets, squared = noisy(rng), 0, []
    for _ in range(3):
        level = made(told, turn)
        columns = level.tables["positions"].columns | {"z_m": 1.1 + times * SD_M * rng.standard_normal(len(TIMES))}
        there = Recording(site=make_site(HALL), tables=level.tables | {"positions": Table(columns)})
        steps = list(run(there))
        resets += len(events(steps, "reset"))
        late = [e for step in steps for e in step.estimates if e.time_s >= 10.0]
        squared += [(e.position_m[2] - 1.1) ** 2 / e.covariance[2, 2] for e in late]
        # what errs in height takes nothing from the level
        assert judge(steps, 10.0)[0] < 1.1 * judge(list(run(level)), 10.0)[0]
    assert resets <= 1
    assert np.mean(squared) < 2.0


def test_positions_that_stop_and_come_back_are_told(rng: np.random.Generator) -> None:
    site = Site.model_validate({"name": "yard", "vehicle": [{"id": "a", "z_m": 0.0}, {"id": "b", "z_m": 0.0}]})
    there = (TIMES < 15.0) | (TIMES >= 25.0)
    told = np.concatenate([noisy(rng), noisy(rng)[there]])
    time_s = np.concatenate([TIMES, TIMES[there] + 0.2])
    order = np.argsort(time_s)
    names = np.array(["a"] * len(TIMES) + ["b"] * int(there.sum()))[order]
    columns = {"time_s": time_s[order], "x_m": told[order, 0], "y_m": told[order, 1]}
    steps = list(run(Recording(site=site, tables={"positions": Table(columns, {"vehicle": tuple(names.tolist())})})))
    lost, found = events(steps, "lost", "found")
    assert (lost.event, lost.vehicle, found.event, found.vehicle) == ("lost", "b", "found", "b")
    assert lost.time_s == pytest.approx(14.7)
    assert found.time_s == pytest.approx(25.2)
    assert "after 10.5 s" in found.detail
