from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile

from sonofix.files import RecordingError, read_recording, read_references, read_truth, write_recording
from sonofix.records import RangeRows, Recording, ReferenceBurst, Table, Truth
from sonofix.site import Beacon, ChipsCode, Microphone, ReferenceCode, Schedule, Signal, Site, Vehicle

RATE_HZ = 48000.0


def site(channels: int = 2, **beacon) -> Site:
    return Site(
        name="made up",
        schedule=Schedule(period_s=0.1),
        signal=Signal(carrier_hz=12000, cycles_per_chip=6),
        vehicles=(Vehicle(id="agv", z_m=0.0), Vehicle(id="van")),
        beacons=(Beacon(id="B1", position_m=(0, 0, 3), **(beacon or {"code": ChipsCode(chips="0110")})),),
        microphones=tuple(Microphone(id=f"M{i}", channel=i, vehicle="agv") for i in range(channels)),
    )


def recording(samples: np.ndarray, known_length: bool = True, **parts) -> Recording:
    def blocks(length: int):
        return (samples[i : i + length] for i in range(0, len(samples), length))

    return Recording(
        parts.pop("site", None) or site(samples.shape[1]),
        RATE_HZ,
        len(samples) if known_length else None,
        blocks,
        **parts,
    )


@pytest.fixture
def noise(rng) -> np.ndarray:
    return (rng.integers(-30000, 30000, (100_000, 2)) / 32768).astype(np.float32)


@pytest.mark.parametrize(
    ("audio", "subtype"), [("wav", "PCM_16"), ("wav", "FLOAT"), ("flac", "PCM_16"), ("flac", "PCM_24")]
)
def test_what_is_written_is_read_back(tmp_path, noise, audio, subtype):
    t = np.array([0.0, 0.1, 0.2])
    truth = {
        "agv": Truth("agv", t, np.arange(9.0).reshape(3, 3), np.array([3.0, 3.2, 3.4])),
        "van": Truth("van", t, -np.arange(9.0).reshape(3, 3), np.zeros(3)),
    }
    odometry = Table(
        {"time_s": t, "v_mps": np.array([1.0, np.nan, 2.0]), "yaw_rate_radps": np.zeros(3)}, {"vehicle": ("agv",) * 3}
    )
    original = recording(noise, sync_s=np.array([0.0, 0.101]), tables={"odometry": odometry})
    write_recording(tmp_path / "new", original, truth, audio=audio, subtype=subtype)
    found = read_recording(tmp_path / "new")
    assert found.site == original.site
    assert (found.rate_hz, found.sample_count) == (RATE_HZ, len(noise))
    np.testing.assert_array_equal(np.concatenate(list(found.blocks(30000))), noise)
    np.testing.assert_array_equal(found.sync_s, original.sync_s)
    np.testing.assert_array_equal(found.tables["odometry"].columns["v_mps"], [1.0, np.nan, 2.0])
    back = read_truth(tmp_path / "new")
    for vehicle, pose in truth.items():
        np.testing.assert_allclose(back[vehicle].position_m, pose.position_m)
        np.testing.assert_allclose(back[vehicle].yaw_rad, pose.yaw_rad)


def test_ranges_are_written_too(tmp_path):
    rows = RangeRows(np.array([0.0, 0.5]), ("B1", "B1"), ("M0", "M1"), np.array([1.5, 2.5]), np.array([0.1, np.nan]))
    write_recording(tmp_path / "new", Recording(site(), ranges=rows))
    found = read_recording(tmp_path / "new").ranges
    assert found.receiver == ("M0", "M1")
    np.testing.assert_array_equal(found.range_m, rows.range_m)
    np.testing.assert_array_equal(found.sd_m, rows.sd_m)


def test_references_go_along(tmp_path, noise):
    burst = ReferenceBurst(np.round(8000 * np.sin(np.arange(500.0))) / 32768, 96000.0)
    plan = site(code=ReferenceCode(reference="bursts/b1.flac"))
    write_recording(tmp_path / "new", recording(noise, site=plan), references={"B1": burst})
    back = read_references(tmp_path / "new", read_recording(tmp_path / "new").site)["B1"]
    assert back.rate_hz == burst.rate_hz
    np.testing.assert_allclose(back.samples, burst.samples, atol=1e-6)


def test_beyond_full_scale_is_clipped_not_wrapped(tmp_path):
    loud = np.array([[2.0], [-2.0], [1.0], [0.25]], np.float32)
    write_recording(tmp_path / "new", recording(loud))
    read = next(read_recording(tmp_path / "new").blocks(10))
    np.testing.assert_allclose(read, [[1.0], [-1.0], [1.0], [0.25]], atol=2**-15)


def test_samples_are_asked_for_once_and_in_blocks(tmp_path):
    """A long recording must not be held: at most one block is alive at a time."""
    asked: list[int] = []
    told: list[int] = []

    def blocks(length: int):
        asked.append(length)
        for i in range(20):
            yield np.full((length, 1), i / 20, np.float32)

    count = None
    made = Recording(site(1), RATE_HZ, count, blocks)
    write_recording(tmp_path / "new", made, on_block=told.append)
    assert len(asked) == 1
    assert told == [asked[0] * (i + 1) for i in range(20)]


def test_an_unknown_length_is_written_as_rf64(tmp_path, noise):
    """The header of a plain WAV could not state what comes."""
    write_recording(tmp_path / "new", recording(noise, known_length=False))
    assert soundfile.info(tmp_path / "new" / "capture.wav").format == "RF64"
    assert read_recording(tmp_path / "new").sample_count == len(noise)


def test_a_recording_is_not_replaced_unasked(tmp_path, noise):
    write_recording(tmp_path / "new", recording(noise))
    before = (tmp_path / "new" / "capture.wav").read_bytes()
    with pytest.raises(RecordingError, match="is a recording already"):
        write_recording(tmp_path / "new", recording(noise[:10]))
    assert (tmp_path / "new" / "capture.wav").read_bytes() == before


def test_a_recording_can_be_rewritten_from_its_own_file(tmp_path, noise):
    write_recording(tmp_path / "new", recording(noise))
    found = read_recording(tmp_path / "new")
    write_recording(tmp_path / "new", found, audio="flac", overwrite=True)
    assert not (tmp_path / "new" / "capture.wav").exists()
    np.testing.assert_array_equal(np.concatenate(list(read_recording(tmp_path / "new").blocks(1 << 16))), noise)


def test_nine_channels_do_not_fit_a_flac(tmp_path):
    nine = recording(np.zeros((100, 9), np.float32))
    with pytest.raises(RecordingError, match="at most 8 channels"):
        write_recording(tmp_path / "new", nine, audio="flac")
    write_recording(tmp_path / "new", nine, overwrite=True)
    assert read_recording(tmp_path / "new").rate_hz == RATE_HZ


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("name", ["capture.wav.part", "truth.csv", "site.toml"])
def test_a_full_disk_is_one_clear_line(tmp_path, noise, name):
    (tmp_path / name).symlink_to("/dev/full")
    truth = {"agv": Truth("agv", np.zeros(1), np.zeros((1, 3)), None)}
    with pytest.raises(RecordingError) as caught:
        write_recording(tmp_path, recording(noise), truth, overwrite=True)
    assert len(caught.value.problems) == 1
    assert "cannot be written" in str(caught.value)
