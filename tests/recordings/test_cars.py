"""Real recordings: model cars that sound in a field of wall microphones; and folders of stated ranges."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonofix import score
from sonofix.files import read_recording, read_truth
from sonofix.flow import run
from sonofix.records import Floats, RangeRows, Recording, Step


def place_of(steps: list[Step]) -> Floats:
    """Median of the sound fixes, x and y."""
    fixes = [f.position_m for step in steps for f in step.fixes if f.status == "ok" and f.position_m is not None]
    assert fixes, [f.status for step in steps for f in step.fixes]
    return np.median(np.array(fixes)[:, :2], axis=0)


def nominal(folder: Path) -> Floats:
    with (folder / "nominal.csv").open(newline="") as file:
        row = next(csv.DictReader(file))
    return np.array([float(row["x_m"]), float(row["y_m"])])


@pytest.mark.parametrize(("take", "within_m"), [(1, 0.10), (2, 0.4), (3, 0.4), (4, 0.4), (5, 0.4), (6, 0.4)])
def test_the_car_of_2019_stands_where_it_was_put(data: Path, take: int, within_m: float) -> None:
    """Real rooms, real echoes; take 1 on the centre mark, the others parked 0.1 to 0.35 m from a microphone."""
    folder = data / "car-2019-5k_15k" / f"take{take:02d}"
    place = place_of(list(run(read_recording(folder))))
    assert np.linalg.norm(place - nominal(folder)) < within_m


@pytest.mark.parametrize("number", [6, 7])
def test_the_car_of_2014_stands_on_its_mark(data: Path, number: int) -> None:
    """Its code is not known: a burst recorded close by is the replica."""
    folder = data / "car-2014" / f"run{number}"
    steps = list(run(read_recording(folder)))
    (truth,) = read_truth(folder).values()
    assert np.linalg.norm(place_of(steps) - truth.position_m[0, :2]) < 0.10
    assert sum(len(step.ranges) for step in steps) >= 3 * 4


@pytest.mark.parametrize("name", ["car-2019-5k_15k/take07", "car-2014/run1", "car-2014/run5"])
def test_hard_takes_run(data: Path, name: str) -> None:
    steps = list(run(read_recording(data / name)))
    assert steps
    assert all(fix.status == "ok" or fix.remedy for step in steps for fix in step.fixes)


def first_rows(rows: RangeRows, until_s: float) -> RangeRows:
    keep = np.flatnonzero(rows.time_s - rows.time_s.min() <= until_s)
    return RangeRows(
        rows.time_s[keep],
        tuple(rows.emitter[i] for i in keep),
        tuple(rows.receiver[i] for i in keep),
        rows.range_m[keep],
        None if rows.sd_m is None else rows.sd_m[keep],
    )


# what it should stay within: least squares a sweep reaches 0.06 and 0.11 (3-D), 0.19, 0.18, 3.9 and 4.8 m on them;
# None: ranges are too few for a position without odometry, which is not used yet, so that only sense is asked for
STATED = [
    ("room-source1", None, 0.10),
    ("room-source3", None, 0.15),
    ("labyrinth", None, 0.30),
    ("table-fast", 3.0, 0.40),
    ("carpark-513", 60.0, 12.0),
    ("plaza1", 30.0, None),
    ("robots6", 10.0, None),
]


@pytest.mark.parametrize(("name", "until_s", "within_m"), STATED)
def test_stated_ranges_give_a_sane_track(data: Path, name: str, until_s: float | None, within_m: float | None) -> None:
    recording: Recording = read_recording(data / name)
    assert recording.ranges is not None
    if until_s is not None:
        recording = replace(recording, ranges=first_rows(recording.ranges, until_s))
    steps = list(run(recording))
    truths = read_truth(data / name)
    assert steps
    times = np.array([step.ranges.sync_s for step in steps])
    assert (np.diff(times) >= 0).all()
    tracks = score.track_columns(steps)
    for vehicle, track in tracks.items():
        assert np.isfinite(track.position_m).all()
        assert np.isfinite(track.velocity_mps).all()
        figures = score.score_track(truths[vehicle], track) if vehicle in truths else None
        if within_m is not None:
            assert figures is not None
            assert figures.median_xy_m < within_m
    if within_m is not None:
        assert tracks
        (truth,) = truths.values()
        fixes = [(f.time_s, f.position_m) for step in steps for f in step.fixes if f.status == "ok"]
        true, _ = score.pose_at(truth, np.array([time_s for time_s, _ in fixes]))
        away = np.array([place for _, place in fixes])[:, :2] - true[:, :2]
        assert np.median(np.linalg.norm(away, axis=1)) < min(within_m, 4.0)
