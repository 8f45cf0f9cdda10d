"""Made-up recordings of another maker, with exact truth: the receiver's promises, where the recordings are present."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix import score
from sonofix.files import read_recording, read_truth
from sonofix.flow import run, smoothed
from sonofix.records import Recording, Step, Truth


@cache
def walked(folder: Path) -> tuple[Recording, dict[str, Truth], list[Step]]:
    """A whole recording, run once for all tests."""
    recording = read_recording(folder)
    return recording, read_truth(folder), list(run(recording))


def beginning(recording: Recording, lasting_s: float) -> Recording:
    """The same recording, ended early."""
    whole = recording.blocks
    assert whole is not None
    assert recording.rate_hz is not None
    count = int(lasting_s * recording.rate_hz)

    def blocks(length: int) -> Iterator[NDArray[np.float32]]:
        left = count
        for block in whole(length):
            yield block[:left]
            left -= len(block)
            if left <= 0:
                return

    return replace(recording, blocks=blocks, sample_count=count)


def figures_of(folder: Path) -> tuple[score.RangeFigures, dict[str, score.TrackFigures]]:
    recording, truths, steps = walked(folder)
    ranges = score.score_ranges(recording.site, truths, score.range_columns(steps), recording.site.sound_speed_mps)
    tracks = {v: score.score_track(truths[v], columns) for v, columns in score.track_columns(steps).items()}
    return ranges, {v: figures for v, figures in tracks.items() if figures is not None}


def expected_epochs(recording: Recording, lasting_s: float, burst_s: float, furthest_s: float) -> int:
    """Epochs that hold whole bursts of all beacons."""
    assert recording.site.schedule is not None
    assert recording.site.schedule.period_s is not None
    return int((lasting_s - burst_s - furthest_s) / recording.site.schedule.period_s) + 1


@pytest.mark.parametrize("name", ["still", "drive"])
def test_every_beacon_is_ranged_in_every_epoch(captures: Path, name: str) -> None:
    recording, _, steps = walked(captures / name)
    assert recording.rate_hz is not None
    assert recording.sample_count is not None
    lasting_s = recording.sample_count / recording.rate_hz
    # 511 chips of 0.25 ms and 40 ms of way
    epochs = expected_epochs(recording, lasting_s, 0.128, 0.04)
    beacons = {b.id for b in recording.site.coded_beacons}
    assert len(steps) >= epochs
    for step in steps[:epochs]:
        assert set(step.ranges.emitter) == beacons
        assert len(step.ranges) == len(beacons)
        assert step.range_used.all()
    figures, _ = figures_of(captures / name)
    assert figures.share_of_expected == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["still", "drive"])
def test_ranges_and_track_are_right(captures: Path, name: str) -> None:
    ranges, tracks = figures_of(captures / name)
    assert ranges.every.beyond_5cm == 0
    assert ranges.used.rms_m is not None
    assert ranges.used.rms_m < 1.5e-3
    assert ranges.error_over_sd_rms is not None
    assert 0.7 < ranges.error_over_sd_rms < 1.4
    assert ranges.range_rate_rms_mps is not None
    assert ranges.range_rate_rms_mps < 1e-3
    (track,) = tracks.values()
    assert track.rmse_xy_m < 2e-3
    assert track.max_xy_m < 5e-3
    assert track.velocity_rms_mps is not None
    assert track.velocity_rms_mps < 5e-3


@pytest.mark.parametrize("name", ["still", "drive"])
def test_fixes_are_sound(captures: Path, name: str) -> None:
    _, truths, steps = walked(captures / name)
    for step in steps:
        (fix,) = step.fixes
        assert fix.status == "ok"
        assert fix.position_m is not None
        true, _ = score.pose_at(truths[fix.vehicle], np.array([fix.time_s]))
        assert fix.covariance is not None
        sd = np.array([fix.sd(axis) for axis in "xyz"], float)
        assert (np.abs(fix.position_m - true[0]) < 6 * sd).all()


def test_two_microphones_give_the_heading(captures: Path) -> None:
    whole = read_recording(captures / "pair")
    recording = beginning(whole, 2.7)
    truths, steps = read_truth(captures / "pair"), list(run(recording))
    track = score.score_track(truths["agv"], score.track_columns(steps)["agv"])
    assert track is not None
    assert track.rmse_yaw_rad is not None
    assert track.rmse_yaw_rad < np.radians(0.2)
    assert track.rmse_xy_m < 2e-3
    assert all(len(step.ranges) == 2 * len(recording.site.coded_beacons) for step in steps)


def test_an_unknown_clock_is_found_and_its_offset_held(captures: Path) -> None:
    """A walk of 20 s, of which the first 4: later all beacons but one fall silent."""
    recording, truths = beginning(read_recording(captures / "walk"), 4.0), read_truth(captures / "walk")
    steps = list(run(recording))
    heard = [step for step in steps if len(step.ranges) >= 3]
    assert len(heard) >= 6
    figures = score.score_ranges(recording.site, truths, score.range_columns(steps), recording.site.sound_speed_mps)
    assert figures.used.count >= 6 * 6
    assert figures.used.beyond_5cm == 0
    assert figures.used.rms_m is not None
    assert figures.used.rms_m < 2e-3
    assert np.ptp([step.range_clock_offset_m[0] for step in heard if step.fixes[0].status == "ok"]) < 0.01
    track = score.score_track(truths["walker"], score.track_columns(heard)["walker"])
    assert track is not None
    assert track.rmse_xy_m < 5e-3


@pytest.mark.parametrize("name", ["air", "blocked", "echo", "fast", "jam", "rough", "survey", "team"])
def test_hard_recordings_run(captures: Path, name: str) -> None:
    """The first 1.3 s of each: a step an epoch, a fix a vehicle in each, and stated deviations that are finite."""
    recording = beginning(read_recording(captures / name), 1.3)
    steps = list(run(recording))
    assert recording.site.schedule is not None
    assert recording.site.schedule.period_s is not None
    assert len(steps) >= int((1.3 - 0.25) / recording.site.schedule.period_s)
    vehicles = {v.id for v in recording.site.vehicles}
    for step in steps:
        assert {fix.vehicle for fix in step.fixes} == vehicles
        assert len({(a, b) for a, b in zip(step.ranges.emitter, step.ranges.receiver, strict=True)}) == len(step.ranges)
        assert np.isfinite(step.ranges.range_m).all()
        assert (np.diag(step.ranges.covariance_m2) > 0).all()
        for fix in step.fixes:
            assert fix.status == "ok" or fix.remedy


@pytest.mark.parametrize("name", ["fast", "rough"])
def test_ranges_hold_where_it_is_fast_or_rough(captures: Path, name: str) -> None:
    recording, truths = beginning(read_recording(captures / name), 2.0), read_truth(captures / name)
    steps = list(run(recording))
    figures = score.score_ranges(recording.site, truths, score.range_columns(steps), recording.site.sound_speed_mps)
    assert figures.used.count >= 8 * 3
    assert figures.used.beyond_5cm == 0
    assert figures.used.rms_m is not None
    assert figures.used.rms_m < 5e-3


def test_smoothed_no_robot_is_missing(captures: Path) -> None:
    folder = captures / "team"
    recording, truths, steps = walked(folder)
    track = score.track_columns(smoothed(recording, steps))
    assert set(track) == set(truths)
    for vehicle, columns in track.items():
        assert len(columns.time_s) == len(steps)
        figures = score.score_track(truths[vehicle], columns)
        assert figures is not None
        assert figures.rmse_xy_m < 0.03
