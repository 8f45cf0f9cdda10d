"""A track from its first epoch on: placed, followed, lost, found again; what is told on the way."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from locate.made_epochs import HALL, SPEED, Drive, make_epoch, make_site, rows_of, shifted
from sonofix.locate.fix import fix
from sonofix.records import Estimate, Event, Floats, RangeEpoch
from sonofix.site import Site
from sonofix.track.belief import Motion, blank, estimate, predict, start_at
from sonofix.track.follow import PATIENCE, Follower, expectations
from sonofix.track.inputs import gather

PLACE = (3.0, 5.5, 1.1)
PERIOD_S = 0.5


@dataclass(frozen=True)
class Seen:
    """One epoch as a follower saw it."""

    estimates: tuple[Estimate, ...]
    used: Floats
    events: tuple[Event, ...]

    @property
    def words(self) -> list[str]:
        return [e.event for e in self.events]

    @property
    def only(self) -> Estimate:
        (one,) = self.estimates
        return one


def follow(follower: Follower, epochs: list[RangeEpoch]) -> Iterator[Seen]:
    for epoch in epochs:
        fixes = tuple(fix(epoch, follower.site, v.id) for v in follower.site.vehicles)
        yield Seen(*follower.step(epoch, fixes))


def drive_past(
    site: Site, drive: Drive, count: int, rng: np.random.Generator, spread_s: float = 0.03, **how: float
) -> list[RangeEpoch]:
    """Epochs of a drive, every row heard at its own moment."""
    n = len(site.beacons) * len(site.microphones)
    moments = [PERIOD_S * k + spread_s * rng.random(n) for k in range(count)]
    return [make_epoch(site, drive, t, rng=rng, **how) for t in moments]


def silence(epoch: RangeEpoch) -> RangeEpoch:
    return rows_of(epoch, np.zeros(0, int))


def sigmas(got: Estimate, place: Floats) -> float:
    index = [got.states.index(s) for s in "xyz" if s in got.states]
    miss = (got.position_m - place)[: len(index)]
    return float(np.sqrt(miss @ np.linalg.solve(got.covariance[np.ix_(index, index)], miss)))


@pytest.mark.parametrize("rate_sd_mps", [None, 0.05])
@pytest.mark.parametrize("clock_m", [None, 20.0])
@pytest.mark.parametrize("sounding", [False, True], ids=["listening", "sounding"])
def test_follows_a_straight_drive(
    sounding: bool, clock_m: float | None, rate_sd_mps: float | None, rng: np.random.Generator
) -> None:
    site = make_site(HALL, sounding=sounding)
    drive = Drive((1.5, 2.0, 1.0), (0.5, 0.35, 0.0))
    epochs = drive_past(site, drive, 14, rng, rate_sd_mps=rate_sd_mps, clock_m=clock_m)
    seen = list(follow(Follower(site), epochs))
    assert seen[0].words == ["start"]
    assert not any(s.words for s in seen[1:])
    assert all(s.used.all() for s in seen)
    for s in seen[4:]:
        assert s.only.source == "fused"
        assert sigmas(s.only, drive.origin(s.only.time_s)) < 5
        assert np.linalg.norm(s.only.velocity_mps - drive.velocity_mps) < 0.3
    if clock_m is not None:
        assert seen[-1].only.clock_offset_m == pytest.approx(clock_m, abs=0.1)


def test_a_recording_may_begin_long_before_its_clock_shows_zero(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    drive = Drive(PLACE)
    epochs = drive_past(site, drive, 4, rng)
    early = [replace(e, sync_s=e.sync_s - 5e6, time_s=e.time_s - 5e6) for e in epochs]
    for s, told in zip(follow(Follower(site), early), follow(Follower(site), epochs), strict=True):
        assert s.words == told.words
        assert s.only.time_s == pytest.approx(told.only.time_s - 5e6)
        np.testing.assert_allclose(s.only.position_m, told.only.position_m, atol=1e-5)
        np.testing.assert_allclose(s.only.covariance, told.only.covariance, rtol=1e-3, atol=1e-9)


def test_a_track_is_better_than_its_fixes(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    drive = Drive((1.5, 2.0, 1.0), (0.5, 0.35, 0.0))
    epochs = drive_past(site, drive, 15, rng, rate_sd_mps=0.1, sd_m=0.05)
    follower = Follower(site, Motion(acceleration_psd=1e-3))
    for epoch, s in list(zip(epochs, follow(follower, epochs), strict=True))[3:]:
        assert s.only.sd("x") < fix(epoch, site, "v").sd("x")


def test_the_first_epoch_counts_once(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    epoch = make_epoch(site, Drive(PLACE), rng=rng)
    found = fix(epoch, site, "v")
    (first,) = follow(Follower(site), [epoch])
    assert first.used.all()
    assert first.only.time_s == found.time_s
    np.testing.assert_allclose(first.only.position_m, found.position_m)
    for state in "xyz":
        assert first.only.sd(state) == pytest.approx(found.sd(state), rel=1e-9)


def test_two_microphones_give_a_heading_that_is_followed(rng: np.random.Generator) -> None:
    site = make_site(HALL, arms_m=((0.35, 0.1, 0.5), (-0.3, -0.2, 0.5)), level_m=1.1)
    drive = Drive((2.0, 2.0, 1.1), (0.4, 0.3, 0.0), yaw_rad=2.4, yaw_rate_radps=0.4)
    seen = list(follow(Follower(site), drive_past(site, drive, 12, rng, rate_sd_mps=0.05)))
    for s in seen[3:]:
        off = np.angle(np.exp(1j * (s.only.yaw_rad - drive.yaw(s.only.time_s))))
        assert abs(off) < 5 * s.only.sd("yaw")
        assert s.only.sd("yaw") < 0.05


def test_a_single_heard_beacon_keeps_the_track_going(rng: np.random.Generator) -> None:
    # one beacon at a time, each too little for a fix; round all six the track stays
    site = make_site(HALL, level_m=1.1)
    drive = Drive((2.0, 2.0, 1.1), (0.4, 0.3, 0.0))
    epochs = drive_past(site, drive, 24, rng)
    epochs = epochs[:4] + [rows_of(e, [k % 6]) for k, e in enumerate(epochs[4:])]
    seen = list(follow(Follower(site, Motion(acceleration_psd=0.01)), epochs))
    for s in seen[4:]:
        assert s.only.source == "fused"
        assert sigmas(s.only, drive.origin(s.only.time_s)) < 5
        assert s.only.sd("x") < 0.3


@pytest.mark.parametrize("together", [1, 2], ids=["one at a time", "two, which leave a mirror image"])
def test_ranges_too_few_for_any_epochs_fix_are_gathered(together: int, rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    passed = drive_past(site, Drive(PLACE), 8, rng, stated=True)
    epochs = [rows_of(e, [(together * k + i) % 6 for i in range(together)]) for k, e in enumerate(passed)]
    seen = list(follow(Follower(site), epochs))
    assert not seen[0].estimates
    begun = next(k for k, s in enumerate(seen) if s.estimates)
    assert "start" in seen[begun].words
    assert begun <= 5
    assert sigmas(seen[-1].only, np.array(PLACE)) < 5


def test_silence_is_told_and_only_predicted(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    drive = Drive((1.5, 2.0, 1.0), (0.5, 0.35, 0.0))
    epochs = drive_past(site, drive, 12, rng, rate_sd_mps=0.05)
    epochs[6:9] = [silence(e) for e in epochs[6:9]]
    seen = list(follow(Follower(site), epochs))
    assert seen[6].words == ["lost"]
    assert seen[7].words == seen[8].words == []
    assert seen[9].words == ["found"]
    assert [s.only.source for s in seen[5:10]] == ["fused", "predicted", "predicted", "predicted", "fused"]
    grown = [s.only.sd("x") for s in seen[5:9]]
    assert grown == sorted(grown)
    for s in seen[6:9]:
        assert sigmas(s.only, drive.origin(s.only.time_s)) < 5
    # in silence an epoch still has its own instant, a period after the last
    assert np.diff([s.only.time_s for s in seen[5:9]]) == pytest.approx(PERIOD_S, abs=0.03)


@pytest.mark.parametrize("clock_m", [None, 12.0])
@pytest.mark.parametrize("sounding", [False, True], ids=["listening", "sounding"])
def test_a_kidnapped_vehicle_is_found_again(sounding: bool, clock_m: float | None, rng: np.random.Generator) -> None:
    site = make_site(HALL, sounding=sounding)
    here, there = Drive((2.0, 2.0, 1.0)), Drive((8.0, 6.0, 0.6))
    epochs = drive_past(site, here, 10, rng, rate_sd_mps=0.05, clock_m=clock_m)
    taken = drive_past(site, there, 20, rng, rate_sd_mps=0.05, clock_m=clock_m)[10:]
    seen = list(follow(Follower(site), epochs + taken))
    after = seen[10:]
    assert {"lost", "reset"} & {word for s in after[: PATIENCE + 2] for word in s.words}
    for s in after[PATIENCE + 2 :]:
        assert s.used.all()
        assert sigmas(s.only, np.array(there.position_m)) < 5
        assert np.linalg.norm(s.only.position_m - there.position_m) < 0.2


def test_a_fix_far_from_the_track_is_followed_at_once(rng: np.random.Generator) -> None:
    site = make_site(np.array(HALL) * 30.0)
    here, there = Drive((60.0, 60.0, 30.0)), Drive((240.0, 180.0, 20.0))
    epochs = drive_past(site, here, 10, rng, rate_sd_mps=0.05)
    taken = drive_past(site, there, 14, rng, rate_sd_mps=0.05)[10:]
    seen = list(follow(Follower(site), epochs + taken))
    assert [s.words for s in seen[10:]] == [["reset"], [], [], []]
    (told,) = seen[10].events
    assert "disagreed" in told.detail
    for s in seen[10:]:
        assert s.used.all()
        assert sigmas(s.only, np.array(there.position_m)) < 5


def test_ranges_without_one_to_check_by_have_to_disagree_for_some_epochs(rng: np.random.Generator) -> None:
    # two ranges on a level, and the room to choose by: a position, but nothing to tell a wrong range from another place
    site = make_site(np.array(HALL[:2]) * 10.0, level_m=1.1, bounds_m=((-1.0, 0.0, 0.0), (101.0, 80.0, 40.0)))
    here, there = Drive((30.0, 20.0, 1.1)), Drive((75.0, 60.0, 1.1))
    epochs = drive_past(site, here, 10, rng, rate_sd_mps=0.05)
    taken = drive_past(site, there, 10 + PATIENCE + 3, rng, rate_sd_mps=0.05)[10:]
    seen = list(follow(Follower(site), epochs + taken))
    after = seen[10:]
    assert [s.words for s in after] == [["lost"], *[[]] * (PATIENCE - 1), ["reset"], [], []]
    assert not any(s.used.any() for s in after[:PATIENCE])
    for s in after[PATIENCE:]:
        assert s.used.all()
        assert sigmas(s.only, np.array(there.position_m)) < 5


def test_one_epoch_heard_from_elsewhere_leaves_no_trace(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    epochs = drive_past(site, Drive(PLACE), 12, rng, rate_sd_mps=0.05)
    epochs[6] = drive_past(site, Drive((8.0, 2.0, 0.6)), 7, rng, rate_sd_mps=0.05)[6]
    seen = list(follow(Follower(site), epochs))
    # it is believed, as all its ranges agree, and so is the next
    assert [k for k, s in enumerate(seen) if "reset" in s.words] == [6, 7]
    for s in seen[7:]:
        assert s.used.all()
        assert sigmas(s.only, np.array(PLACE)) < 5


@pytest.mark.parametrize("clock_m", [None, 20.0])
@pytest.mark.parametrize("hours", [2.0, 24.0, 470_000.0], ids=["an hour or two", "a day", "since 1970"])
def test_after_hours_of_silence_a_track_begins_anew(
    hours: float, clock_m: float | None, rng: np.random.Generator
) -> None:
    site, later = make_site(HALL, level_m=1.1), 3600.0 * hours
    epochs = [make_epoch(site, Drive(PLACE), 0.5 * k, clock_m=clock_m, rng=rng) for k in range(4)]
    epochs += [make_epoch(site, Drive((5.0, 5.0, 1.1)), later + 0.5 * k, clock_m=clock_m, rng=rng) for k in range(4)]
    seen = list(follow(Follower(site), epochs))
    assert {"lost", "start"} <= set(seen[4].words)
    for s in seen[4:]:
        assert np.hypot(*(s.only.position_m - (5.0, 5.0, 1.1))[:2]) < 0.05


def test_a_lone_microphone_off_the_axis_is_followed_and_the_origin_told(rng: np.random.Generator) -> None:
    site = make_site(HALL, arms_m=((0.4, -0.1, 0.5),), level_m=1.1)
    drive = Drive((2.0, 2.0, 1.1), (0.6, 0.45, 0.0), yaw_rad=float(np.arctan2(0.45, 0.6)))
    seen = list(follow(Follower(site), drive_past(site, drive, 10, rng, rate_sd_mps=0.05)))
    for s in seen[3:]:
        assert s.used.all()
        assert np.linalg.norm(s.only.position_m - drive.origin(s.only.time_s)) < 0.1
        assert sigmas(s.only, drive.origin(s.only.time_s)) < 5


def test_an_echo_is_left_out_and_told(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    epochs = drive_past(site, Drive(PLACE), 8, rng, rate_sd_mps=0.05)
    epochs[5] = shifted(epochs[5], 3, 1.2)
    seen = list(follow(Follower(site), epochs))
    assert seen[5].used.tolist() == [True, True, True, False, True, True]
    assert seen[5].words == ["excluded"]
    assert "B3 to M0" in seen[5].events[0].detail
    assert sigmas(seen[5].only, np.array(PLACE)) < 5


def test_a_free_running_clock_is_another_in_every_epoch(rng: np.random.Generator) -> None:
    site = make_site(HALL, sounding=True)
    drive = Drive((2.0, 2.0, 1.0), (0.4, 0.3, 0.0))
    offsets = rng.uniform(-300, 300, 12)
    epochs = [
        replace(e, range_m=e.range_m + offset)
        for e, offset in zip(drive_past(site, drive, 12, rng, rate_sd_mps=0.05, clock_m=0.0), offsets, strict=True)
    ]
    seen = list(follow(Follower(site, free_running=True), epochs))
    for s, offset in zip(seen, offsets, strict=True):
        assert s.used.all()
        assert s.only.clock_offset_m == pytest.approx(offset, abs=0.2)
        # the state belongs to when its sound was heard, not sent: 10 ms of drive are 5 mm
        assert sigmas(s.only, drive.origin(s.only.time_s)) < 5
    assert not any("reset" in s.words for s in seen)


def test_a_common_clock_that_drifts_is_followed(rng: np.random.Generator) -> None:
    # 20 ppm of a crystal are 7 mm/s of sound
    site = make_site(HALL)
    drift = 20e-6 * SPEED
    epochs = [
        replace(e, range_m=e.range_m + drift * PERIOD_S * k)
        for k, e in enumerate(drive_past(site, Drive(PLACE), 40, rng, clock_m=5.0))
    ]
    seen = list(follow(Follower(site), epochs))
    for k, s in enumerate(seen):
        assert abs(s.only.clock_offset_m - 5.0 - drift * PERIOD_S * k) < 5 * s.only.sd("clock")
    assert sigmas(seen[-1].only, np.array(PLACE)) < 5


def test_looking_ahead_extends_the_motion_and_changes_nothing(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    drive = Drive((1.5, 2.0, 1.0), (0.5, 0.35, 0.0))
    follower = Follower(site)
    last = list(follow(follower, drive_past(site, drive, 8, rng, rate_sd_mps=0.05)))[-1].only
    before = follower.belief
    ahead = estimate(predict(before, last.time_s + 0.8, follower.motion), site, 0, "predicted")
    assert follower.belief is before
    assert ahead.time_s == last.time_s + 0.8
    np.testing.assert_allclose(ahead.position_m, last.position_m + 0.8 * last.velocity_mps, atol=1e-12)
    assert ahead.sd("x") > last.sd("x")
    assert sigmas(ahead, drive.origin(ahead.time_s)) < 5


def test_a_stated_start_needs_no_fix(rng: np.random.Generator) -> None:
    # two beacons on the ground plane of a known start: mirrored without it
    site = make_site(HALL[:2], level_m=1.1)
    follower = Follower(site)
    follower.start("v", 0.0, np.array(PLACE), 0.3)
    seen = list(follow(follower, drive_past(site, Drive(PLACE), 10, rng)))
    assert all(s.used.all() for s in seen)
    assert sigmas(seen[-1].only, np.array(PLACE)) < 5
    assert seen[-1].only.sd("x") < 0.05


def test_stated_ranges_that_err_more_than_they_say_are_trusted_less(rng: np.random.Generator) -> None:
    # they claim 2 cm and err by 20 cm: after some rounds the track's deviation has learnt that
    site = make_site(HALL)
    wrong = drive_past(site, Drive(PLACE), 60, rng, sd_m=0.2, stated=True)
    claimed = [replace(e, covariance_m2=0.02**2 * np.eye(6)) for e in wrong]
    others = gather(site, {}, [(b.id, m.id) for b in site.beacons for m in site.microphones])
    seen = list(follow(Follower(site, Motion(acceleration_psd=0.01), inputs=others), claimed))
    assert max(sigmas(s.only, np.array(PLACE)) for s in seen[30:]) < 5


def test_expectations_are_ranges_and_their_deviations() -> None:
    site = make_site(HALL, position_sd_m=0.03)
    belief = predict(start_at(blank(site), 0, np.array(PLACE), 0.0, False, False), 0.0, Motion())
    pairs = [("B0", "M0"), ("B4", "M0")]
    range_m, range_sd, rate, rate_sd = expectations(belief, site, pairs, SPEED)
    for i, beacon in enumerate((0, 4)):
        assert range_m[i] == pytest.approx(np.linalg.norm(np.array(PLACE) - HALL[beacon]))
    # 5 cm in every direction and the beacon's 3 cm; 0.5 m/s in every direction
    np.testing.assert_allclose(range_sd, np.hypot(0.05, 0.03))
    np.testing.assert_allclose(rate, 0.0, atol=1e-12)
    np.testing.assert_allclose(rate_sd, 0.5)
