"""Vehicles carried by odometry and compass: the update by its plain twin, long runs, slips, pushes and bad readings."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.stats import chi2

from locate.made_epochs import HALL, Drive, make_epoch, make_site, rows_of
from sonofix.files import read_recording, read_truth
from sonofix.flow import run
from sonofix.geometry import SIZE
from sonofix.records import Floats, Table
from sonofix.street import Street
from sonofix.track import wheels
from sonofix.track.belief import Motion, estimate, predict
from sonofix.track.follow import Follower
from sonofix.track.inputs import gather

OUTSIDE = 1e-6
SLOT = SIZE
SITE = make_site(HALL, level_m=1.1)
ARM = np.array([0.3, -0.2])


def test_an_arc_moves_a_belief_as_its_numerical_derivatives_say(rng: np.random.Generator) -> None:
    n, own = SIZE + 5 + 2, [0, 1, 3, 4, 5, 7]
    for _ in range(10):
        half = 0.02 * rng.standard_normal((n, n))
        mean, covariance = 0.05 * rng.standard_normal(n), half @ half.T
        way, turn, dt = rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), 0.1
        speed, rate = rng.uniform(-3, 3), rng.uniform(-3, 3)
        mean[[0, 1, 3]] += 0.3 * rng.standard_normal(3)  # nothing that was believed of these has a say

        # of all headings that it may have set out on, the mean
        shorter = np.exp(-covariance[SLOT + 2, SLOT + 2] / 2)

        def turned(yaw: float) -> Floats:
            return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ ARM

        def driven(
            x: Floats, way: float = shorter * way, turn: float = turn, dt: float = dt,
            speed: float = shorter * speed, rate: float = rate,
        ) -> Floats:  # fmt: skip
            # the origin drives the arc in a thousand short pieces; the arm turns with it; the last n are noise
            pieces = 1000
            ahead = (turn - x[SLOT + 4] * dt) / pieces
            yaw = x[SLOT + 2] + ahead * (np.arange(pieces) + 0.5)
            step = way * (1 - x[SLOT + 3]) / pieces
            end = x[SLOT + 2] + pieces * ahead + x[n + 2]
            place = x[SLOT : SLOT + 2] + [np.sum(step * np.cos(yaw)), np.sum(step * np.sin(yaw))]
            place = place + turned(end) - turned(x[SLOT + 2]) + x[n : n + 2]
            turns, goes = rate - x[SLOT + 4] + x[n + 5], speed * (1 - x[SLOT + 3])
            swung = turned(end)
            left = turns * np.array([-swung[1], swung[0]])
            moves = goes * np.array([np.cos(end), np.sin(end)]) + left + x[n + 3 : n + 5]
            return np.array([*place, end, *moves, turns])

        strays = wheels.CREEP_PSD * dt + wheels.SLIP_M * abs(way) * shorter
        twists = wheels.TWIST_PSD * dt + wheels.TWIST_M * abs(way) * shorter + wheels.TWIST_RAD * abs(turn)
        uneven = (wheels.CREEP_PSD + wheels.SLIP_M * abs(speed) * shorter) / wheels.EVEN_S
        unsteady = wheels.TWIST_PSD + wheels.TWIST_M * abs(speed) * shorter + wheels.TWIST_RAD * abs(rate)
        noise = np.diag([strays, strays, twists, uneven, uneven, unsteady / wheels.EVEN_S])
        x = np.append(mean, np.zeros(6))
        by = np.array([approx_fprime(x, lambda x, i=i: driven(x)[i], 1e-7) for i in range(6)])
        carry, expected = np.eye(n), mean.copy()
        carry[own], expected[own] = by[:, :n], driven(x)
        after = carry @ covariance @ carry.T
        after[np.ix_(own, own)] += by[:, n:] @ noise @ by[:, n:].T
        got, spread = mean.copy(), covariance.copy()
        spread[own, own] += 1.0  # as of a vehicle of which only its odometry tells
        wheels.take(got, spread, np.ones(n, bool), 0, SLOT, np.array([way, turn, dt, 0.0, speed, rate]), ARM)
        # the anchor is where the vehicle is now
        expected[SLOT : SLOT + 3] = expected[[0, 1, 3]]
        move = np.eye(n)
        move[[SLOT, SLOT + 1, SLOT + 2]] = move[[0, 1, 3]]
        np.testing.assert_allclose(got, expected, atol=2e-6)
        np.testing.assert_allclose(spread, move @ after @ move.T, atol=1e-5)


def odometry(rows: Floats) -> Table:
    return Table(
        {"time_s": rows[:, 0], "v_mps": rows[:, 1], "yaw_rate_radps": rows[:, 2]}, {"vehicle": ("v",) * len(rows)}
    )


def reckoned(seed: int) -> tuple[float, float, float]:
    """Error, NEES of x and y and of the heading after 10 s by odometry alone, errors drawn as the filter has them."""
    rng = np.random.default_rng([3, seed])
    scale, bias = wheels.SCALE_SD * rng.standard_normal(), wheels.BIAS_SD_RADPS * rng.standard_normal()
    dt = 0.1
    yaw, place = 0.3 + 0.1 * rng.standard_normal(), np.array([3.0, 3.0]) + 0.05 * rng.standard_normal(2)
    rows, speed, rate = [], 0.3, 0.0
    for k in range(101):
        rows.append((dt * k, speed / (1 - scale), rate + bias))
        if k == 100:
            break
        way, turn = speed * dt, rate * dt
        place = place + way * np.array([np.cos(yaw + turn / 2), np.sin(yaw + turn / 2)])
        place = place + np.sqrt(wheels.CREEP_PSD * dt + wheels.SLIP_M * way) * rng.standard_normal(2)
        twist = wheels.TWIST_PSD * dt + wheels.TWIST_M * way / (1 - scale) + wheels.TWIST_RAD * abs(turn)
        yaw += turn + np.sqrt(twist) * rng.standard_normal()
        rate = float(np.clip(rate + 0.1 * rng.standard_normal(), -0.5, 0.5))
        speed = float(np.clip(speed + 0.02 * rng.standard_normal(), 0.1, 0.5))
    follower = Follower(SITE, inputs=gather(SITE, {"odometry": odometry(np.array(rows))}))
    follower.start("v", -0.001, np.array([3.0, 3.0, 1.1]), 0.3)
    got = estimate(predict(follower.belief, 10.0, Motion()), SITE, 0, "predicted")
    miss = got.position_m[:2] - place
    assert got.yaw_rad is not None
    off = float(np.angle(np.exp(1j * (got.yaw_rad - yaw)))) / (got.sd("yaw") or np.nan)
    return float(np.hypot(*miss)), float(miss @ np.linalg.solve(got.covariance[:2, :2], miss)), off**2


def test_odometry_is_as_good_as_it_says() -> None:
    runs = 100
    found = np.array([reckoned(k) for k in range(runs)])
    for column, degrees in ((1, 2), (2, 1)):
        low, high = chi2.ppf([OUTSIDE / 2, 1 - OUTSIDE / 2], degrees * runs) / runs
        assert low < found[:, column].mean() < high
    assert np.sqrt(np.mean(found[:, 0] ** 2)) < 0.6


def driving(scale: float, drive: Drive, until_s: float) -> Table:
    times = np.arange(0.0, until_s, 0.1)
    speed = float(np.hypot(*drive.velocity_mps[:2]))
    return odometry(np.column_stack([times, np.full(len(times), speed * (1 + scale)), np.zeros(len(times))]))


def test_a_wrong_scale_and_the_heading_are_found_by_driving(rng: np.random.Generator) -> None:
    # one microphone at the origin: only the way that the track goes tells where the vehicle looks
    drive, street = Drive((1.0, 1.0, 1.1), (0.4, 0.3, 0.0)), Street(SITE)
    street.sense({"odometry": driving(0.08, drive, 12.0)})
    for k in range(22):
        step = street.walk(make_epoch(SITE, drive, 0.05 + 0.5 * k, rng=rng))
    got, belief = step.estimates[0], street.follower.belief
    assert got.yaw_rad == pytest.approx(np.arctan2(3, 4), abs=0.03)
    assert belief.mean[SLOT + 3] == pytest.approx(0.08 / 1.08, abs=0.02)
    assert np.hypot(*(got.position_m - drive.origin(got.time_s))[:2]) < 0.02


def test_odometry_carries_through_silence(rng: np.random.Generator) -> None:
    drive, street = Drive((1.0, 1.0, 1.1), (0.4, 0.3, 0.0)), Street(SITE)
    street.sense({"odometry": driving(0.08, drive, 16.0)})
    for k in range(30):
        epoch = make_epoch(SITE, drive, 0.05 + 0.5 * k, rng=rng)
        step = street.walk(rows_of(epoch, np.zeros(0, int)) if k > 19 else epoch)
    got = step.estimates[0]
    miss = (got.position_m - drive.origin(got.time_s))[:2]
    assert got.source == "predicted"
    assert np.hypot(*miss) < 0.2
    assert (got.sd("x") or 1.0) < 0.2


def test_a_row_that_stands_there_twice_changes_nothing(rng: np.random.Generator) -> None:
    drive, ends = Drive((1.0, 1.0, 1.1), (0.4, 0.3, 0.0)), []
    once = driving(0.08, drive, 6.0)
    twice = Table({name: np.repeat(values, 2) for name, values in once.columns.items()}, {"vehicle": ("v",) * 120})
    epochs = [make_epoch(SITE, drive, 0.05 + 0.5 * k, rng=rng) for k in range(11)]
    for table in (once, twice):
        street = Street(SITE)
        street.sense({"odometry": table})
        ends.append([street.walk(epoch) for epoch in epochs][-1].estimates[0])
    np.testing.assert_allclose(ends[1].position_m, ends[0].position_m, atol=1e-9)
    np.testing.assert_allclose(ends[1].covariance, ends[0].covariance, atol=1e-9)


def test_a_compass_gives_the_heading_and_its_bad_readings_do_not(rng: np.random.Generator) -> None:
    times = np.arange(0.0, 10.0, 0.1)
    heading = 0.7 + 0.03 * rng.standard_normal(len(times))
    heading[40::10] += rng.uniform(1.0, 5.0, len(heading[40::10]))
    site = SITE
    tables = {
        "compass": Table({"time_s": times, "heading_rad": heading}),
        "odometry": odometry(np.column_stack([times, np.zeros(len(times)), np.zeros(len(times))])),
    }
    street = Street(site)
    street.sense(tables)
    for k in range(18):
        step = street.walk(make_epoch(site, Drive((3.0, 5.0, 1.1)), 0.05 + 0.5 * k, rng=rng))
        if k > 2:
            assert step.estimates[0].yaw_rad == pytest.approx(0.7, abs=0.06)


def test_stated_ranges_that_are_all_too_long_are_found_out(rng: np.random.Generator) -> None:
    # round a circle of 1.5 m, every range 5 % too long: a fix of each epoch alone is decimetres off
    times = np.arange(0.0, 60.0, 0.1)
    street, miss = Street(SITE), []
    pairs = tuple((b.id, m.id) for b in SITE.beacons for m in SITE.microphones)
    street.sense({"odometry": odometry(np.column_stack([times, 0.6 + 0 * times, 0.4 + 0 * times]))}, stated=pairs)
    for k in range(119):
        time_s = 0.5 * k + 0.05
        place = (5.0 + 1.5 * np.sin(0.4 * time_s), 4.0 - 1.5 * np.cos(0.4 * time_s), 1.1)
        epoch = make_epoch(SITE, Drive(place), rng=rng, stated=True)
        heard = replace(epoch, time_s=np.full(6, time_s), sync_s=time_s, range_m=1.05 * epoch.range_m)
        got = street.walk(heard).estimates[0]
        miss.append(float(np.hypot(*(got.position_m - place)[:2])))
    assert np.sqrt(np.mean(np.square(miss[40:]))) < 0.03


def test_a_push_that_odometry_does_not_see_is_told_and_followed(captures: Path) -> None:
    folder = captures / "team"
    truths = read_truth(folder)
    miss: dict[str, list[tuple[float, float]]] = {v: [] for v in truths}
    slips = []
    for step in run(read_recording(folder, to_run=True)):
        slips += [(e.vehicle, e.time_s) for e in step.events if e.event == "slip"]
        for got in step.estimates:
            truth = truths[got.vehicle]
            place = [np.interp(got.time_s, truth.time_s, truth.position_m[:, i]) for i in range(2)]
            miss[got.vehicle].append((got.time_s, float(np.hypot(*(got.position_m[:2] - place)))))
    assert [v for v, _ in slips] == ["R1"]
    assert 9.0 < slips[0][1] < 10.5
    for vehicle, rows in miss.items():
        errors = np.array([e for _, e in rows])
        assert np.sqrt(np.mean(errors**2)) < 0.03, vehicle
        assert errors[-1] < 0.02, vehicle


@pytest.mark.parametrize(("name", "least"), [("labyrinth", 0.09), ("plaza1", 0.5)])
def test_real_odometry_with_ranges_that_are_off(data: Path, name: str, least: float) -> None:
    truth = next(iter(read_truth(data / name).values()))
    miss = []
    for step in islice(run(read_recording(data / name, to_run=True)), 700):
        for got in step.estimates:
            place = [np.interp(got.time_s, truth.time_s, truth.position_m[:, i]) for i in range(2)]
            miss.append(np.hypot(*(got.position_m[:2] - place)))
    assert np.sqrt(np.mean(np.square(miss))) < least


def test_a_start_amid_a_row_moves_as_that_row_tells() -> None:
    drive, street = Drive((1.0, 1.0, 1.1), (0.8, 0.6, 0.0)), Street(SITE)
    street.sense({"odometry": driving(0.0, drive, 6.0)})
    street.follower.start("v", 0.05, drive.origin(0.05), float(np.arctan2(0.6, 0.8)))
    aged = predict(street.follower.belief, 0.09, Motion())
    np.testing.assert_allclose(aged.mean[:2], drive.origin(0.09)[:2], atol=1e-9)
    np.testing.assert_allclose(aged.mean[4:6], (0.8, 0.6), atol=1e-9)


def test_a_row_that_jumps_to_another_speed_is_not_believed(rng: np.random.Generator) -> None:
    """One row in thirty tells twelve times the speed: the track stays where ranges of a centimetre have it."""
    drive, street = Drive((1.0, 1.0, 1.1), (0.4, 0.3, 0.0)), Street(SITE)
    table = driving(0.0, drive, 12.0)
    speed = table.columns["v_mps"].copy()
    speed[20::30] *= 12.0
    street.sense({"odometry": replace(table, columns={**table.columns, "v_mps": speed})})
    for k in range(22):
        step = street.walk(make_epoch(SITE, drive, 0.05 + 0.5 * k, rng=rng))
        if k > 4:
            got = step.estimates[0]
            off = (got.position_m - drive.origin(got.time_s))[:2]
            assert np.hypot(*off) < 0.03
            assert off @ np.linalg.solve(got.covariance[:2, :2], off) < 16.0
    assert abs(street.follower.belief.mean[SLOT + 3]) < 0.02
