"""Calibrations written: what is there can be read back as the site file names it, whole or not at all."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile

from sonofix.files import RecordingError, read_recording, write_recording
from sonofix.files.calibration import (
    calibrated_beacon,
    read_for_calibration,
    reference_name,
    snippet,
    write_calibration,
)
from sonofix.records import Calibration
from sonofix.signals.waveform import waveform_of
from sonofix.survey.burst import calibrate
from survey.made_bench import bench, distorted, record


@pytest.fixture(scope="module")
def learnt() -> Calibration:
    return calibrate(record(distorted(), bench()), "B1", "M")


def test_reference_reads_back_as_it_was_learnt(tmp_path: Path, learnt: Calibration) -> None:
    site = bench()
    written = write_calibration(tmp_path / "out", site, learnt)
    assert [path.name for path in written] == ["B1.flac", "B1.toml", "B1.csv"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["B1.csv", "B1.flac", "B1.toml"]
    new = site.model_copy(update={"beacons": (calibrated_beacon(site, learnt),)})
    write_recording(tmp_path / "rec", record(distorted(), new, bursts=2))
    shutil.copy(written[0], tmp_path / "rec")
    recording = read_recording(tmp_path / "rec")
    assert recording.site.clock_known
    back = waveform_of(recording.site, recording.site.beacons[0], recording.references["B1"])
    assert (back.rate_hz, back.start_s) == (learnt.waveform.rate_hz, pytest.approx(learnt.waveform.start_s, abs=1e-9))
    # 24 bits of a peak of 0.9
    np.testing.assert_allclose(back.envelope, learnt.waveform.envelope, atol=3e-6)
    assert np.abs(recording.references["B1"].samples).max() == pytest.approx(0.9, abs=1e-6)


def test_snippet_stands_in_a_site_file(tmp_path: Path, learnt: Calibration) -> None:
    site = bench()
    text = snippet(site, learnt)
    assert text.startswith("# learnt from 16 bursts at microphone M, 1 m away\n")
    assert f"delay_s = {learnt.delay_s:.9f}" in text
    write_recording(tmp_path / "rec", record(distorted(), site, bursts=2))
    path = tmp_path / "rec" / "site.toml"
    head, tail = path.read_text("utf-8").split("[[beacon]]")
    path.write_text(head + text + "\n[[microphone]]" + tail.split("[[microphone]]")[1], "utf-8")
    write_calibration(tmp_path / "out", site, learnt)
    shutil.copy(tmp_path / "out" / "B1.flac", tmp_path / "rec")
    beacon = read_recording(tmp_path / "rec").site.beacons[0]
    assert beacon == calibrated_beacon(site, learnt)


def test_free_running_beacons_get_no_delay_and_no_distance() -> None:
    site = bench(synchronised=False)
    learnt = calibrate(record(distorted(synchronised=False), site, beacon_drift={"B1": 20e-6}), "B1", "M")
    beacon = calibrated_beacon(site, learnt)
    assert beacon.delay_s == 0.0
    assert beacon.code is not None
    assert beacon.code.model_dump(exclude_none=True) == {"reference": "B1.flac", "start_s": learnt.start_s}
    (line,) = [line for line in snippet(site, learnt).splitlines() if line.startswith("# measured: period_s = ")]
    assert float(line.split()[4]) == pytest.approx(0.1 * (1 + 20e-6), abs=2e-8)


def test_bursts_in_a_table(tmp_path: Path, learnt: Calibration) -> None:
    write_calibration(tmp_path, bench(), learnt)
    rows = np.genfromtxt(tmp_path / "B1.csv", delimiter=",", names=True)
    assert rows.dtype.names == ("due_s", "late_s", "residual_s", "used")
    np.testing.assert_allclose(rows["residual_s"], learnt.pace.residual_s, atol=1e-9)
    assert rows["used"].sum() == 16


def test_odd_ids_and_high_rates(tmp_path: Path, learnt: Calibration) -> None:
    odd = replace(learnt, beacon="north/east 1", burst=replace(learnt.burst, rate_hz=1e6))
    assert reference_name(odd) == "north_east_1.wav"
    site = bench()
    site = site.model_copy(update={"beacons": (site.beacons[0].model_copy(update={"id": "north/east 1"}),)})
    write_calibration(tmp_path, site, odd)
    assert soundfile.info(tmp_path / "north_east_1.wav").subtype == "PCM_24"


def test_a_recording_is_never_written_into(tmp_path: Path, learnt: Calibration) -> None:
    write_recording(tmp_path / "rec", record(bench(), bench(), bursts=2))
    before = {path.name: path.read_bytes() for path in (tmp_path / "rec").iterdir()}
    with pytest.raises(RecordingError, match="is a recording"):
        write_calibration(tmp_path / "rec", bench(), learnt)
    assert {path.name: path.read_bytes() for path in (tmp_path / "rec").iterdir()} == before
    (tmp_path / "file").write_text("mine")
    with pytest.raises(RecordingError, match="is a file; give a folder"):
        write_calibration(tmp_path / "file", bench(), learnt)


def test_a_full_disk_leaves_the_old_files(tmp_path: Path, learnt: Calibration) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    write_calibration(tmp_path, bench(), learnt)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    (tmp_path / "B1.toml.part").symlink_to("/dev/full")
    with pytest.raises(RecordingError, match=r"B1\.toml: cannot be written: No space left"):
        write_calibration(tmp_path, bench(), replace(learnt, delay_s=1.0))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_recordings_that_only_a_calibration_can_read(tmp_path: Path) -> None:
    """A beacon without a code, and one whose reference is still to be made."""
    for name, code in (("none", None), ("to-come", {"reference": "B1.flac"})):
        site = bench(code=code)
        write_recording(tmp_path / name, record(bench(), site, bursts=2))
        with pytest.raises(RecordingError):
            read_recording(tmp_path / name)
        read = read_for_calibration(tmp_path / name)
        assert read.site == site
        assert read.rate_hz == 192e3
        assert read.references == {}


def test_all_mistakes_at_once(tmp_path: Path) -> None:
    write_recording(tmp_path / "rec", record(bench(), bench(), bursts=2))
    (tmp_path / "rec" / "capture.wav").unlink()
    (tmp_path / "rec" / "sync.csv").write_text("time_s\nsoon\n")
    site = tmp_path / "rec" / "site.toml"
    site.write_text(site.read_text("utf-8").replace("[air]", "[air]\ncolour = 1"), "utf-8")
    with pytest.raises(RecordingError) as caught:
        read_for_calibration(tmp_path / "rec")
    told = [str(problem) for problem in caught.value.problems]
    assert len(told) == 3
    for word in ("colour", "capture.wav", "soon"):
        assert any(word in line for line in told)
    with pytest.raises(RecordingError, match="there is no such folder"):
        read_for_calibration(tmp_path / "nowhere")


def test_sync_commands_give_a_period(tmp_path: Path) -> None:
    recording = record(bench(), bench(), sync_jitter_s=1e-4)
    write_recording(tmp_path / "rec", recording)
    site = tmp_path / "rec" / "site.toml"
    text = site.read_text("utf-8")
    assert "period_s = 0.1\n" in text
    site.write_text(text.replace("period_s = 0.1\n", ""), "utf-8")
    read = read_for_calibration(tmp_path / "rec")
    assert read.site.schedule is not None
    assert read.site.schedule.period_s == pytest.approx(0.1, abs=1e-4)
    assert calibrate(read, "B1", "M").delay_s == pytest.approx(0.0, abs=2e-7)
