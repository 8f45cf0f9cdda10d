"""Smoothed tracks: better than causal ones, between any two epochs, across resets, with a lag, before the first fix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site, rows_of
from sonofix.files import read_recording, read_truth
from sonofix.flow import run, smoothed
from sonofix.geometry import POSE
from sonofix.locate.fix import fix
from sonofix.records import Estimate, Floats, RangeEpoch, Step, Table, Truth
from sonofix.site import Site
from sonofix.track.belief import predict
from sonofix.track.follow import Follower
from sonofix.track.inputs import gather
from sonofix.track.passage import Heard
from sonofix.track.smooth import FixedLag, smooth
from track.made_walks import SITE as HALLWAY
from track.made_walks import Walk, epoch_of, steps_of
from track.test_follow_team import robots_epoch, two_robots

PERIOD_S = 0.5


def heard_of(site: Site, epochs: list[RangeEpoch]) -> list[Heard]:
    return [(epoch, tuple(fix(epoch, site, v.id) for v in site.vehicles)) for epoch in epochs]


def causal(begin: Callable[[], Follower], heard: list[Heard]) -> list[tuple[Estimate, ...]]:
    follower = begin()
    return [follower.step(*one)[0] for one in heard]


def rms_m(track: list[tuple[Estimate, ...]], place: Callable[[float], Floats]) -> float:
    miss = [e.position_m[:2] - place(e.time_s)[:2] for some in track for e in some]
    return float(np.sqrt(np.mean(np.sum(np.square(miss), axis=1))))


def nees(got: Estimate, place: Floats) -> float:
    miss = got.position_m[:2] - place[:2]
    return float(miss @ np.linalg.solve(got.covariance[:2, :2], miss))


def curve(time_s: float) -> Floats:
    return np.array([5.0 + 3.0 * np.cos(0.3 * time_s), 4.0 + 2.0 * np.sin(0.3 * time_s), 1.1])


def curving(site: Site, count: int, rng: np.random.Generator, sd_m: float = 0.1) -> list[Heard]:
    moments = [PERIOD_S * k for k in range(count)]
    return heard_of(site, [make_epoch(site, Drive(tuple(curve(t))), t, sd_m=sd_m, rng=rng) for t in moments])


def test_a_smoothed_track_is_better_and_says_so(rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    heard = curving(site, 60, rng)
    before, after = causal(lambda: Follower(site), heard), smooth(lambda: Follower(site), heard)
    assert [len(some) for some in after] == [1] * 60
    assert rms_m(after, curve) < 0.85 * rms_m(before, curve)
    for (a,), (b,) in zip(before, after, strict=True):
        assert b.source == "smoothed"
        assert b.time_s == a.time_s
        assert (b.sd("x") or 0) <= (a.sd("x") or 0) + 1e-12
    # the last epoch has nothing after it
    np.testing.assert_allclose(after[-1][0].position_m, before[-1][0].position_m, atol=1e-4)


def test_an_endless_lag_is_smoothing_between_the_ends(rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    heard = curving(site, 40, rng)
    lag, out = FixedLag(Follower(site), np.inf, 8.0), []
    for one in heard:
        assert lag.take(one) == []
    out = lag.finish()
    whole = smooth(lambda: Follower(site), heard, 8.0, passes=1)
    assert sum(len(some) for some in whole) > 150
    for a, b in zip(out, whole, strict=True):
        for x, y in zip(a, b, strict=True):
            assert x.time_s == y.time_s
            np.testing.assert_allclose(x.position_m, y.position_m, rtol=0, atol=1e-12)
            np.testing.assert_allclose(x.covariance, y.covariance, rtol=0, atol=1e-12)


def test_rows_leave_as_late_as_the_lag_and_no_more_is_remembered(rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    heard = curving(site, 80, rng)
    lag, left = FixedLag(Follower(site), 2.0), 0
    for k, one in enumerate(heard):
        for (got,) in lag.take(one):
            left += 1
            assert one[0].sync_s - got.time_s == pytest.approx(2.0, abs=PERIOD_S)
        assert k + 1 - left <= 5
        assert len(lag._passage.chain.knots) <= 7
    assert left + len(lag.finish()) == 80


def test_without_lag_it_is_the_filter(rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    heard = curving(site, 20, rng)
    lag = FixedLag(Follower(site), 0.0)
    for one, (want,) in zip(heard, causal(lambda: Follower(site), heard), strict=True):
        ((got,),) = lag.take(one)
        np.testing.assert_allclose(got.position_m, want.position_m, atol=1e-9)
        np.testing.assert_allclose(got.covariance, want.covariance, atol=1e-9)


def test_a_longer_lag_is_better(rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    heard, found = curving(site, 100, rng), []
    for lag_s in (0.0, 1.0, 10.0):
        lag = FixedLag(Follower(site), lag_s)
        track = [some for one in heard for some in lag.take(one)] + lag.finish()
        found.append(rms_m(track, curve))
    assert found[1] < 0.95 * found[0]
    assert found[2] <= 1.02 * found[1]


def test_rows_between_epochs_know_both_sides(rng: np.random.Generator) -> None:
    # epochs two seconds apart, rows ten a second: halfway a row is known worst, and far better than a prediction
    site = make_site(HALL, level_m=1.1)
    drive = Drive((2.0, 2.0, 1.1), (0.2, 0.15, 0.0))
    heard = heard_of(site, [make_epoch(site, drive, 2.0 * k, rng=rng) for k in range(8)])
    rows = [e for some in smooth(lambda: Follower(site), heard, 10.0) for e in some]
    times = np.array([e.time_s for e in rows])
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-9)
    assert times[-1] == pytest.approx(14.0)
    sd = {round(e.time_s, 1): e.sd("x") or 0.0 for e in rows}
    assert sd[8.0] < sd[8.5] < sd[9.0]
    assert sd[9.0] == pytest.approx(sd[7.0], rel=0.1)
    # of a motion pinned at both ends T apart the middle is off by sqrt(q T³ / 192) at least (ends' speeds known)
    assert np.sqrt(0.5 * 8 / 192) < sd[9.0] < 3 * np.sqrt(0.5 * 8 / 192)
    assert max(nees(e, drive.origin(e.time_s)) for e in rows) < 30
    epochs = smooth(lambda: Follower(site), heard)
    (whole,) = epochs[4]
    (same,) = [e for e in rows if abs(e.time_s - whole.time_s) < 1e-9]
    np.testing.assert_allclose(same.position_m, whole.position_m, atol=1e-9)
    np.testing.assert_allclose(same.covariance, whole.covariance, atol=1e-9)


def test_a_reset_ties_nothing_of_before_to_after(rng: np.random.Generator) -> None:
    site = make_site(np.array(HALL) * 30.0)
    here, there = Drive((60.0, 60.0, 30.0)), Drive((240.0, 180.0, 20.0))
    epochs = [make_epoch(site, here if k < 10 else there, PERIOD_S * k, rng=rng) for k in range(20)]
    track = smooth(lambda: Follower(site), heard_of(site, epochs))
    for k, (got,) in enumerate(track):
        assert nees(got, np.array((here if k < 10 else there).position_m)) < 30
        assert (got.sd("x") or 1.0) < 0.05


def test_a_blind_zone_shrinks_to_what_both_ends_leave_open() -> None:
    before, after, off = [], [], []
    for seed in range(6):
        rng = np.random.default_rng([17, seed])
        walk = Walk()
        inputs = gather(HALLWAY, {"steps": steps_of(walk, 20.0, rng)})
        blind = [8 <= 0.1 + PERIOD_S * k < 13 for k in range(36)]
        epochs = [
            epoch_of(walk, 0.1 + PERIOD_S * k, rng, (0,) if b else (0, 1, 2, 3, 4, 5)) for k, b in enumerate(blind)
        ]
        heard = heard_of(HALLWAY, epochs)

        def begin(inputs=inputs) -> Follower:
            return Follower(HALLWAY, inputs=inputs)

        for track, out in ((causal(begin, heard), before), (smooth(begin, heard), after)):
            out.append(rms_m([some for some, b in zip(track, blind, strict=True) if b], walk.place))
        off += [nees(e, walk.place(e.time_s)) for some in smooth(begin, heard)[3:] for e in some]
    assert np.mean(after) < 0.6 * np.mean(before)
    assert np.mean(after) < 0.05
    assert np.mean(off) < 3.0


def odometry(rows: Floats) -> Table:
    columns = {"time_s": rows[:, 0], "v_mps": rows[:, 1], "yaw_rate_radps": rows[:, 2]}
    return Table(columns, {"vehicle": ("v",) * len(rows)})


def test_a_heading_learnt_on_the_way_is_known_from_the_start(rng: np.random.Generator) -> None:
    # the causal track needs metres to tell where the vehicle looks; nothing states it
    site = make_site(HALL, level_m=1.1)
    times = np.arange(0.0, 20.0, 0.1)
    inputs = gather(site, {"odometry": odometry(np.column_stack([times, 0.4 + 0 * times, 0.25 + 0 * times]))})

    def way(time_s: float) -> Floats:
        yaw = 2.5 + 0.25 * time_s
        return np.array([5.0 + 1.6 * (np.sin(yaw) - np.sin(2.5)), 4.0 - 1.6 * (np.cos(yaw) - np.cos(2.5)), 1.1])

    epochs = [make_epoch(site, Drive(tuple(way(t))), t, sd_m=0.05, rng=rng) for t in 0.05 + PERIOD_S * np.arange(38)]
    heard = heard_of(site, epochs)

    def begin() -> Follower:
        return Follower(site, inputs=inputs)

    before, after = causal(begin, heard), smooth(begin, heard)
    assert before[0][0].yaw_rad is None
    for (got,) in after:
        off = np.angle(np.exp(1j * (got.yaw_rad - 2.5 - 0.25 * got.time_s)))
        assert abs(off) < 4 * (got.sd("yaw") or 0.0)
        assert (got.sd("yaw") or 1.0) < 0.1
        assert nees(got, way(got.time_s)) < 25
    assert rms_m(after, way) < 0.5 * rms_m(before, way)


def test_two_vehicles_of_which_one_comes_later(rng: np.random.Generator) -> None:
    site = two_robots()
    a, b = Drive((2.0, 2.0, 0.0), (0.3, 0.2, 0.0)), Drive((8.0, 6.0, 0.0), (-0.2, 0.0, 0.0))
    epochs = [robots_epoch(site, a, b, PERIOD_S * k, rng) for k in range(24)]
    for k in range(4):  # b hears nothing yet and is not heard
        epochs[k] = rows_of(epochs[k], [i for i, m in enumerate(epochs[k].receiver) if m == "A" and i < 6])
    heard = heard_of(site, epochs)
    before, after = causal(lambda: Follower(site), heard), smooth(lambda: Follower(site), heard)
    assert [len(some) for some in after] == [1] * 4 + [2] * 20
    for name, drive in (("a", a), ("b", b)):
        own = [[tuple(e for e in some if e.vehicle == name) for some in track] for track in (before, after)]
        assert rms_m(own[1], drive.origin) < rms_m(own[0], drive.origin)
        assert max(nees(e, drive.origin(e.time_s)) for some in own[1] for e in some) < 30


def test_a_track_is_led_back_to_before_its_first_fix(rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    drive = Drive((2.0, 2.0, 1.1), (0.4, 0.3, 0.0))
    epochs = [make_epoch(site, drive, PERIOD_S * k, rng=rng) for k in range(16)]
    epochs[:4] = [rows_of(e, [1]) for e in epochs[:4]]  # one range says no place
    heard = heard_of(site, epochs)
    assert [len(some) for some in causal(lambda: Follower(site), heard)] == [0] * 4 + [1] * 12
    for rate_hz in (None, 4.0):
        track = smooth(lambda: Follower(site), heard, rate_hz)
        times = [e.time_s for some in track for e in some]
        np.testing.assert_allclose(np.diff(times), 1 / (rate_hz or 1 / PERIOD_S), atol=1e-9)
        assert times[0] <= 0.5  # as far back as its place is known to a metre
        assert times[-1] == pytest.approx(7.5)
        for got in [e for some in track for e in some]:
            assert nees(got, drive.origin(got.time_s)) < 25
            assert (got.sd("x") or 2.0) < 1.0


def place_of(truth: Truth) -> Callable[[float], Floats]:
    return lambda t: np.array([np.interp(t, truth.time_s, truth.position_m[:, i]) for i in range(3)])


def test_a_real_drive_smoothed(data: Path) -> None:
    recording, truths = read_recording(data / "labyrinth", to_run=True), read_truth(data / "labyrinth")
    truth = next(iter(truths.values()))
    steps = list(run(recording))
    after = list(smoothed(recording, steps))

    def rms(some: list[Step]) -> float:
        inside = (truth.time_s[0], truth.time_s[-1])
        return rms_m(
            [tuple(e for e in s.estimates if inside[0] <= e.time_s <= inside[1]) for s in some], place_of(truth)
        )

    assert rms(after) < 0.040
    assert rms(after) < 0.7 * rms(steps)


def test_where_to_linearise_counts_turns_as_the_track_does() -> None:
    site = make_site(HALL, level_m=1.1)
    times = np.arange(0.0, 2.0, 0.1)
    belief = Follower(site, inputs=gather(site, {"odometry": odometry(np.column_stack([times, times, times]))})).belief
    yaw, anchor = POSE.index("yaw"), len(POSE) + 2
    mean, nominal = belief.mean.copy(), np.full(len(belief.mean), np.nan)
    mean[yaw], mean[anchor] = 7.0, 6.9
    nominal[yaw], nominal[anchor] = 0.5, 0.4
    got = belief.near(nominal, mean)
    assert got[yaw] == pytest.approx(0.5 + 2 * np.pi)
    assert got[anchor] == pytest.approx(0.4 + 2 * np.pi)
    got[[yaw, anchor]] = mean[[yaw, anchor]]
    np.testing.assert_array_equal(got, mean)  # what is not known stays


def test_a_row_told_at_the_instant_of_a_knot_is_not_lost() -> None:
    site = make_site(HALL, level_m=1.1)
    times = np.arange(0.0, 1.05, 0.1)
    follower = Follower(
        site, inputs=gather(site, {"odometry": odometry(np.column_stack([times, 0.5 + 0 * times, 0 * times]))})
    )
    follower.start("v", 0.05, np.array([2.0, 2.0, 1.1]), 0.0)
    whole = halted = follower.belief
    whole = predict(whole, 0.95, follower.motion)
    for time_s in times[1:-1]:
        for stop_s in (np.nextafter(time_s, -np.inf), time_s):
            halted = predict(halted, float(stop_s), follower.motion)
    halted = predict(halted, 0.95, follower.motion)
    np.testing.assert_allclose(halted.mean, whole.mean, atol=1e-12)
    np.testing.assert_allclose(halted.covariance, whole.covariance, atol=1e-12)


def test_more_knots_than_memory_holds_are_refused_beforehand(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = make_site(HALL, level_m=1.1)
    heard = heard_of(site, [make_epoch(site, Drive((3.0, 3.0, 1.1)), 0.5 * k, rng=rng) for k in range(4)])
    monkeypatch.setattr("sonofix.track.smooth.MOST_BYTES", 1000.0)
    with pytest.raises(ValueError, match="--lag"):
        smooth(lambda: Follower(site), heard)
