"""Positions that others computed: a track by them alone, with odometry, with outliers, and beside its own ranges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locate.made_epochs import HALL, make_site
from sonofix.files import RecordingError, read_recording
from sonofix.flow import run, smoothed
from sonofix.records import Fix, Floats, Recording, Step, Table
from sonofix.site import Site
from sonofix.track.belief import blank, place, predict
from sonofix.track.follow import Follower
from sonofix.track.loose import take
from sonofix.track.spreads import spreads

SD_M, PERIOD_S = 0.2, 0.5


def at(time_s: Floats) -> Floats:
    return np.column_stack([5.0 + 3.0 * np.cos(0.2 * time_s), 4.0 + 3.0 * np.sin(0.2 * time_s)])


def recording(rng: np.random.Generator, odometry: bool, outliers: float = 0.0, pushed: bool = False) -> Recording:
    times = np.arange(0.0, 60.0, PERIOD_S)
    told = at(times) + SD_M * rng.standard_normal((len(times), 2))
    told[rng.random(len(times)) < outliers] += rng.normal(0.0, 8.0, 2)
    if pushed:
        told[times >= 30.0] += (3.0, -2.0)
    columns = {"time_s": times, "x_m": told[:, 0], "y_m": told[:, 1], "sd_m": np.full(len(times), SD_M)}
    tables = {"positions": Table(columns)}
    if odometry:
        rows = np.arange(0.0, 60.0, 0.1)
        tables["odometry"] = Table({"time_s": rows, "v_mps": 0.6 + 0 * rows, "yaw_rate_radps": 0.2 + 0 * rows})
    return Recording(site=make_site(HALL, level_m=1.1), tables=tables)


def judge(steps: list[Step], since_s: float = 10.0, shift: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
    told = [e for step in steps for e in step.estimates if e.time_s > since_s]
    miss = np.array([e.position_m[:2] - at(np.array([e.time_s]))[0] - shift for e in told])
    spread = np.array([e.covariance[:2, :2] for e in told])
    return float(np.sqrt(np.mean(np.sum(miss**2, axis=1)))), float(
        np.mean(np.einsum("ki,kij,kj->k", miss, np.linalg.inv(spread), miss))
    )


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_odometry_betters_positions_and_smoothing_both(outliers: float, rng: np.random.Generator) -> None:
    alone = list(run(recording(rng, False, outliers)))
    made = recording(rng, True, outliers)
    driven = list(run(made))
    after = list(smoothed(made, driven))
    # by itself a position is off by √2 sd on the level
    assert judge(alone)[0] < np.sqrt(2) * SD_M
    assert judge(driven)[0] < 0.6 * judge(alone)[0]
    assert judge(after)[0] < judge(driven)[0]
    assert max(judge(alone)[1], judge(driven)[1], judge(after)[1]) < 4.0
    assert all(e.source == "smoothed" for step in after for e in step.estimates)


def test_one_that_is_carried_off_is_found(rng: np.random.Generator) -> None:
    steps = list(run(recording(rng, True, pushed=True)))
    (reset,) = [event for step in steps for event in step.events if event.event == "reset"]
    assert 30.0 <= reset.time_s <= 30.0 + 4 * PERIOD_S
    assert judge(steps, 35.0, (3.0, -2.0))[0] < 0.25


def made_fix(site: Site, place_m: Floats, covariance: Floats) -> Fix:
    states, none = ("x", "y"), np.zeros(0)
    told = (None, None, None, covariance, None, None, None, None)
    return Fix(1.0, site.vehicles[0].id, "ok", "", states, np.append(place_m, 1.1), *told, none.astype(bool), none)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_position_enters_as_two_measurements_of_place(seed: int) -> None:
    rng, site = np.random.default_rng(seed), make_site(HALL, level_m=1.1)
    follower = Follower(site)
    half = rng.standard_normal((2, 2))
    first = made_fix(site, np.array([3.0, 4.0]), 0.01 * np.eye(2))
    begun = predict(place(blank(site), 0, first, np.zeros(2)), 1.0, follower.motion)
    noise = half @ half.T + 0.01 * np.eye(2)
    told = made_fix(site, np.array([3.0, 4.0]) + 0.1 * rng.standard_normal(2), noise)
    taken = take(begun, spreads(), 0, told)
    assert taken.believed
    after, noise = taken.belief, taken.scatter.scale**2 * noise
    # information adds up
    own = np.flatnonzero(begun.free)
    rows = np.zeros((2, len(own)))
    rows[0, own.tolist().index(0)] = rows[1, own.tolist().index(1)] = 1.0
    prior, weight = np.linalg.inv(begun.covariance[np.ix_(own, own)]), np.linalg.inv(noise)
    spread = np.linalg.inv(prior + rows.T @ weight @ rows)
    mean = spread @ (prior @ begun.mean[own] + rows.T @ weight @ told.position_m[:2])
    np.testing.assert_allclose(after.covariance[np.ix_(own, own)], spread, atol=1e-9)
    np.testing.assert_allclose(after.mean[own], mean, atol=1e-9)


def test_a_folder_of_positions_runs_and_tells_what_it_lacks(tmp_path: Path, rng: np.random.Generator) -> None:
    beacon = '[[beacon]]\nid = "B1"\nposition_m = [0.0, 0.0, 3.0]\n'
    site = f'[site]\nname = "yard"\n{beacon}[[vehicle]]\nid = "agv"\n'
    (tmp_path / "site.toml").write_text("format = 1\n" + site)
    rows = "".join(f"{t},{x:.3f},{y:.3f}\n" for t, (x, y) in zip(range(9), at(np.arange(9.0)), strict=True))
    (tmp_path / "positions.csv").write_text("time_s,x_m,y_m\n" + rows)
    with pytest.raises(RecordingError, match=r"positions\.csv: vehicle = \"agv\": has rows without z_m"):
        read_recording(tmp_path, to_run=True)
    (tmp_path / "site.toml").write_text("format = 1\n" + site + "z_m = 0.0\n")
    steps = list(run(read_recording(tmp_path, to_run=True)))
    assert [len(step.estimates) for step in steps] == [1] * 9
    with pytest.raises(ValueError, match=r"positions\.csv is smoothed without"):
        list(smoothed(read_recording(tmp_path), steps, graph=True))


def test_two_positions_of_one_vehicle_at_one_time_are_refused(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text('format = 1\n[site]\nname = "yard"\n[[vehicle]]\nid = "agv"\nz_m = 0.0\n')
    (tmp_path / "positions.csv").write_text("time_s,x_m,y_m\n0.0,1.0,2.0\n1.0,1.0,2.0\n1.0,3.0,2.0\n")
    with pytest.raises(RecordingError, match=r"positions\.csv: row 3, time_s = 1\.0: row 2 tells of 'agv' at the same"):
        read_recording(tmp_path, to_run=True)
