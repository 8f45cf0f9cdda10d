"""An epoch looked into is the epoch of the run: same predictions, same detections, same ranges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recordings.test_captures import beginning
from sonofix.files import read_recording
from sonofix.flow import explain, run
from sonofix.records import Insight, RangeRows, Recording, Step
from test_flow import made, same, site_of


def agree(told: Insight, step: Step) -> None:
    """Whether an insight's paths are the ranges of a step, bit by bit where the numbers are the same."""
    ranges = step.ranges
    own = [i for i, name in enumerate(ranges.receiver) if name == told.microphone]
    shown = {b.beacon: b for band in told.bands for b in band.beacons}
    assert told.sync_s == ranges.sync_s
    assert {d.emitter for d in told.detections} == {ranges.emitter[i] for i in own}
    assert {n for n, b in shown.items() if b.reported is not None} == {ranges.emitter[i] for i in own}
    found = {d.emitter: d for d in told.detections}
    assert ranges.range_rate_mps is not None
    assert ranges.snr_db is not None
    for i in own:
        beacon = shown[ranges.emitter[i]]
        path, detection = beacon.reported, found[beacon.beacon]
        assert path is not None
        assert detection.snr_db == ranges.snr_db[i]
        assert path.range_m == pytest.approx(ranges.range_m[i], abs=1e-9)
        assert path.range_rate_mps == pytest.approx(ranges.range_rate_mps[i], abs=1e-9)
        kept = [p.range_m for p in beacon.paths if not p.dropped]
        ways = [path.range_m + told.sound_speed_mps * p.delay_s for p in detection.paths]
        assert sorted(kept) == pytest.approx(sorted(ways), abs=1e-6)
        assert told.used[beacon.beacon] == step.range_used[i]
    for name, beacon in shown.items():
        assert (name in found) == (beacon.verdict == "")


@pytest.mark.parametrize("synchronised", [True, False])
def test_every_epoch_and_microphone_is_that_of_the_run(synchronised: bool) -> None:
    recording, _ = made(site_of(2, synchronised), 1.1, clock_offset_s=0.0 if synchronised else 0.093)
    steps = list(run(recording))
    assert len(steps) >= 4
    searches = set()
    for epoch, step in enumerate(steps):
        for microphone in ("M0", "M1"):
            told = explain(recording, epoch, microphone)
            assert (told.epoch, told.microphone, told.clock) == (epoch, microphone, step.ranges.clock)
            assert told.events == step.events or same(told.events, step.events)
            agree(told, step)
            searches.add(told.search.split(":")[0])
    assert searches == {"cold", "warm"}
    assert explain(recording, 0).microphone == "M0"


def test_a_warm_epoch_shows_what_was_expected() -> None:
    recording, _ = made(site_of())
    assert all(b.predicted is None for b in explain(recording, 0).bands[0].beacons)
    for beacon in explain(recording, 3).bands[0].beacons:
        path = beacon.reported
        assert path is not None
        assert beacon.predicted is not None
        (near_m, far_m), (slow, fast) = beacon.predicted
        assert near_m < path.range_m < far_m
        assert slow < path.range_rate_mps < fast


def test_what_cannot_be_looked_into_is_said() -> None:
    recording, _ = made(site_of(), 0.7)
    count = len(list(run(recording)))
    with pytest.raises(ValueError, match=f"epoch {count}: the recording has epochs 0 to {count - 1}"):
        explain(recording, count)
    with pytest.raises(ValueError, match="epochs count from 0"):
        explain(recording, -1)
    with pytest.raises(ValueError, match=r"microphone Q: .*: M0"):
        explain(recording, 0, "Q")
    stated = RangeRows(np.zeros(1), ("B0",), ("M0",), np.ones(1), None)
    with pytest.raises(ValueError, match="has no samples"):
        explain(Recording(recording.site, ranges=stated), 0)
    short = replace(recording, blocks=lambda _: iter([np.zeros((10, 1), np.float32)]), sample_count=10)
    with pytest.raises(ValueError, match="no whole epoch"):
        explain(short, 0)


@pytest.mark.parametrize(
    ("name", "epoch"), [("drive", 2), ("jam", 2), ("rough", 2), ("echo", 0), ("blocked", 0)]
)  # fmt: skip
def test_captures_are_shown_as_they_are_run(captures: Path, name: str, epoch: int) -> None:
    recording = beginning(read_recording(captures / name), 0.5 * epoch + 0.4)
    told, steps = explain(recording, epoch), list(run(recording))
    agree(told, steps[epoch])
    (band,) = told.bands
    levels = [stage.left_db for stage in band.stages]
    assert levels[-1] < levels[0] - 10
    text = " ".join(told.notes)
    assert bool(band.tones_hz) == ("was taken out" in text) == (name == "jam")
    assert band.aside.any() == ("left out" in text)
    if name in ("echo", "blocked"):
        assert sum(not p.dropped for b in band.beacons for p in b.paths) > len(band.beacons)
    else:
        assert abs(levels[-1]) < 3
