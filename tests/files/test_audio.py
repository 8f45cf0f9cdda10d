from __future__ import annotations

import struct
import tracemalloc

import numpy as np
import pytest
import soundfile

from sonofix.files import RecordingError
from sonofix.files.audio import find_capture, open_capture

RATE_HZ = 48000


@pytest.fixture
def noise(rng) -> np.ndarray:
    """Two channels, a whole number of 16-bit levels, so that every format returns exactly these."""
    return (rng.integers(-9000, 9000, (30011, 2)) / 32768).astype(np.float32)


@pytest.mark.parametrize("length", [1, 7, 1023, 1024, 1025, 30011, 10**6])
@pytest.mark.parametrize(
    ("name", "kind", "subtype"),
    [
        ("capture.flac", "FLAC", "PCM_16"),
        ("capture.flac", "FLAC", "PCM_24"),
        ("capture.wav", "WAV", "PCM_16"),
        ("capture.wav", "WAV", "FLOAT"),
        ("capture.wav", "RF64", "PCM_16"),
    ],
)
def test_blocks_hold_the_samples_in_order(tmp_path, noise, name, kind, subtype, length):
    values = noise[:2011] if length == 1 else noise
    soundfile.write(tmp_path / name, values, RATE_HZ, format=kind, subtype=subtype)
    capture = find_capture(tmp_path)
    assert (capture.rate_hz, capture.channels, capture.sample_count) == (RATE_HZ, 2, len(values))
    blocks = list(capture.blocks(length))
    assert all(len(block) == length for block in blocks[:-1])
    assert all(block.dtype == np.float32 for block in blocks)
    np.testing.assert_array_equal(np.concatenate(blocks), values)


def test_each_reading_starts_anew(tmp_path, noise):
    soundfile.write(tmp_path / "capture.wav", noise, RATE_HZ)
    capture = find_capture(tmp_path)
    first = next(capture.blocks(100))
    np.testing.assert_array_equal(next(capture.blocks(100)), first)


def test_blocks_are_not_overwritten(tmp_path, noise):
    """A receiver keeps blocks; a reused buffer would change under it."""
    soundfile.write(tmp_path / "capture.wav", noise, RATE_HZ)
    blocks = list(find_capture(tmp_path).blocks(10000))
    np.testing.assert_array_equal(blocks[0], noise[:10000])


def test_a_cut_wav_reads_to_its_end(tmp_path, noise):
    path = tmp_path / "capture.wav"
    soundfile.write(path, noise, RATE_HZ)
    path.write_bytes(path.read_bytes()[: 44 + 4 * 20000 + 3])
    capture = find_capture(tmp_path)
    assert capture.sample_count == len(noise)
    np.testing.assert_array_equal(np.concatenate(list(capture.blocks(4096))), noise[:20000])


def test_a_cut_rf64_reads_to_its_end(tmp_path, noise):
    path = tmp_path / "capture.wav"
    soundfile.write(path, noise, RATE_HZ, format="RF64")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - 4 * 10000])
    capture = find_capture(tmp_path)
    assert capture.sample_count == len(noise)
    read = np.concatenate(list(capture.blocks(4096)))
    np.testing.assert_array_equal(read, noise[: len(read)])
    assert len(read) == len(noise) - 10000


def test_other_formats_are_refused(tmp_path, noise):
    soundfile.write(tmp_path / "capture.wav", noise, RATE_HZ, format="OGG", subtype="VORBIS")
    with pytest.raises(RecordingError, match="must be FLAC or WAV"):
        find_capture(tmp_path)


def test_a_cut_flac_reads_nearly_to_its_end(tmp_path, noise):
    """All whole frames (4096 samples) but what shares a read of 1024 with the cut."""
    path = tmp_path / "capture.flac"
    soundfile.write(path, noise, RATE_HZ)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    capture = find_capture(tmp_path)
    read = np.concatenate(list(capture.blocks(5000)))
    assert capture.sample_count == len(noise)
    assert len(noise) / 2 - 4096 - 1024 <= len(read) <= len(noise) / 2
    np.testing.assert_array_equal(read, noise[: len(read)])


@pytest.mark.parametrize("stated", [0, 10**6])
def test_a_flac_whose_header_lies_reads_whole(tmp_path, noise, stated):
    """0: a streamed FLAC whose length was never filled in."""
    path = tmp_path / "capture.flac"
    soundfile.write(path, noise, RATE_HZ)
    flac = path.read_bytes()
    word = int.from_bytes(flac[18:26], "big") >> 36 << 36 | stated
    path.write_bytes(flac[:18] + word.to_bytes(8, "big") + flac[26:])
    capture = find_capture(tmp_path)
    assert capture.sample_count == (stated or None)
    np.testing.assert_array_equal(np.concatenate(list(capture.blocks(8192))), noise)


@pytest.mark.parametrize(("size", "count"), [(0xFFFFFFFF, 30011), (4 * 10**6, 10**6), (4 * 1000, 1000)])
def test_a_wav_whose_header_lies(tmp_path, noise, size, count):
    """0xFFFFFFFF is what a recorder writes before it knows the length."""
    path = tmp_path / "capture.wav"
    soundfile.write(path, noise, RATE_HZ)
    wav = path.read_bytes()
    at = wav.index(b"data") + 4
    path.write_bytes(wav[:at] + struct.pack("<I", size) + wav[at + 4 :])
    capture = find_capture(tmp_path)
    assert capture.sample_count == count
    read = np.concatenate(list(capture.blocks(8192)))
    np.testing.assert_array_equal(read, noise[:count])


def test_nan_and_infinity_come_through(tmp_path, noise):
    noise[5], noise[6, 1] = np.nan, -np.inf
    soundfile.write(tmp_path / "capture.wav", noise, RATE_HZ, subtype="FLOAT")
    np.testing.assert_array_equal(next(find_capture(tmp_path).blocks(100)), noise[:100])


def test_memory_does_not_grow_with_length(tmp_path, rng):
    second = (0.1 * rng.standard_normal((RATE_HZ, 1))).astype(np.float32)
    with soundfile.SoundFile(str(tmp_path / "capture.wav"), "w", RATE_HZ, 1) as file:
        for _ in range(120):
            file.write(second)
    tracemalloc.start()
    count = sum(len(block) for block in find_capture(tmp_path).blocks(RATE_HZ))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 120 * RATE_HZ
    assert peak < 5 * RATE_HZ * 4


def test_no_capture_is_none(tmp_path):
    assert find_capture(tmp_path) is None


def test_a_file_that_vanishes_is_told(tmp_path, noise):
    soundfile.write(tmp_path / "capture.wav", noise, RATE_HZ)
    capture = find_capture(tmp_path)
    (tmp_path / "capture.wav").unlink()
    with pytest.raises(RecordingError, match=r"capture\.wav"):
        next(capture.blocks(100))


def test_block_length_must_be_positive(tmp_path, noise):
    soundfile.write(tmp_path / "capture.wav", noise, RATE_HZ)
    with pytest.raises(ValueError, match="0"):
        next(open_capture(tmp_path / "capture.wav").blocks(0))
