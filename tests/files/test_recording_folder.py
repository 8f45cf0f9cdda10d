from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile

from sonofix import air
from sonofix.files import RecordingError, read_recording, read_references, read_truth, site_text
from sonofix.files.site_file import parse_site

SHARED = Path(__file__).parents[2].parent / "shared"
FOLDERS = sorted(path.parent for part in ("captures", "data") for path in (SHARED / part).glob("**/site.toml"))


def test_what_is_there_is_read(lab, lab_samples):
    (lab / "sync.csv").write_text("time_s\n0.0\n0.1\n")
    (lab / "odometry.csv").write_text("time_s,v_mps,yaw_rate_radps\n0,1,0\n0.1,,0\n")
    recording = read_recording(lab)
    assert (recording.rate_hz, recording.sample_count) == (48000, len(lab_samples))
    np.testing.assert_array_equal(recording.sync_s, [0.0, 0.1])
    assert set(recording.tables) == {"odometry"}
    assert recording.ranges is None
    read = np.concatenate(list(recording.blocks(1000)))
    np.testing.assert_allclose(read, lab_samples, atol=2**-15)


def test_a_site_alone_is_a_recording_but_nothing_to_run(lab):
    (lab / "capture.wav").unlink()
    recording = read_recording(lab)
    assert recording.blocks is None
    assert recording.rate_hz is None
    with pytest.raises(RecordingError, match="nothing to compute positions from"):
        read_recording(lab, to_run=True)


def test_truth_is_not_part_of_a_recording(lab):
    """Only scoring may see it: a broken truth must not even be noticed here."""
    (lab / "truth.csv").write_text("nonsense")
    (lab / "beacons_truth.csv").write_text("nonsense")
    (lab / "nominal.csv").write_text("nonsense")
    assert not any("truth" in stem for stem in read_recording(lab).tables)


@pytest.mark.parametrize("stated", [None, 340.0])
def test_times_of_flight_become_ranges_with_the_sites_sound_speed(lab, stated):
    (lab / "capture.wav").unlink()
    text = (lab / "site.toml").read_text()
    new = f"sound_speed_mps = {stated}" if stated else "humidity = 0.7\npressure_kpa = 95.0"
    (lab / "site.toml").write_text(text.replace("sound_speed_mps = 343.2", new))
    (lab / "ranges.csv").write_text("time_s,from,to,time_of_flight_s\n0,B1,M1,0.01\n")
    speed = stated or float(air.sound_speed_mps(20.0, 0.7, 95.0))
    assert read_recording(lab).ranges.range_m == pytest.approx([0.01 * speed], rel=1e-12)


def test_pseudo_ranges_may_be_negative(lab):
    (lab / "capture.wav").unlink()
    text = (lab / "site.toml").read_text()
    (lab / "site.toml").write_text(text.replace("synchronised = true", "synchronised = false"))
    (lab / "ranges.csv").write_text("time_s,from,to,range_m\n0,B1,M1,-4.5\n")
    assert read_recording(lab).ranges.range_m.tolist() == [-4.5]


def test_a_period_left_to_the_sync_file_is_taken_from_it(lab):
    text = (lab / "site.toml").read_text()
    (lab / "site.toml").write_text(text.replace("period_s = 0.1\n", ""))
    (lab / "sync.csv").write_text("time_s\n0.0\n0.1\n0.21\n0.3\n")
    assert read_recording(lab).site.schedule.period_s == pytest.approx(0.1)


def test_truth_by_vehicle_with_unwrapped_yaw(lab):
    site = (lab / "site.toml").read_text() + '\n[[vehicle]]\nid = "van"\n'
    (lab / "site.toml").write_text(site)
    rows = "0,van,1,2,3,\n0,agv,0,0,0,3.1\n1,agv,1,0,0,-3.1\n2,agv,2,0,0,-3.0\n"
    (lab / "truth.csv").write_text("time_s,vehicle,x_m,y_m,z_m,yaw_rad\n" + rows)
    truth = read_truth(lab)
    np.testing.assert_allclose(truth["agv"].yaw_rad, [3.1, 2 * np.pi - 3.1, 2 * np.pi - 3.0])
    np.testing.assert_array_equal(truth["agv"].position_m, [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert truth["van"].yaw_rad is None


def test_no_truth_is_empty(lab):
    (lab / "truth.csv").unlink()
    assert read_truth(lab) == {}


def test_references_come_whole_with_their_rate(lab):
    text = (lab / "site.toml").read_text()
    old = 'code = { family = "m-sequence", degree = 6, taps = [1] }'
    (lab / "site.toml").write_text(text.replace(old, 'code = { reference = "burst.wav", start_s = 0.001 }'))
    burst = np.round(9000 * np.sin(np.arange(400))) / 32768
    soundfile.write(lab / "burst.wav", burst, 96000, subtype="PCM_16")
    references = read_references(lab, read_recording(lab).site)
    assert list(references) == ["B1"]
    assert references["B1"].rate_hz == 96000
    np.testing.assert_array_equal(references["B1"].samples, burst)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(SHARED)))
def test_real_folders_read_without_a_problem(folder):
    recording = read_recording(folder, to_run=True)
    read_truth(folder)
    assert parse_site(site_text(recording.site)) == recording.site
    if recording.blocks is not None:
        assert sum(len(block) for block in recording.blocks(1 << 17)) == recording.sample_count
