"""`capture.flac` and `capture.wav`: samples block by block, and what a damaged file still holds."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile
from numpy.typing import NDArray

from sonofix.files.problem import Problem, RecordingError

CAPTURE_NAMES = ("capture.flac", "capture.wav")
FORMATS = ("FLAC", "WAV", "WAVEX", "RF64", "W64")

_UNKNOWN_COUNT = 2**62
# A damaged FLAC loses the read call in which the damage lies: read no more at a time than its own usual block.
_READ_FRAMES = 4096


class _Stream(soundfile.SoundFile):
    """A sound file read from front to back.

    soundfile seeks after every read of a seekable file; at the end of a FLAC whose header states another length, or
    none, that seek fails and takes the last samples with it. A stream is never asked to seek.
    """

    def seekable(self) -> bool:
        """Return False: samples come in order."""
        return False


@dataclass(frozen=True, slots=True)
class Capture:
    """A capture file.

    Attributes
    ----------
    path : Path
    rate_hz : float
    channels : int
    sample_count : int or None
        As the header states; None where it states none (a FLAC that was streamed).
    format : str
        For example "FLAC PCM_16".
    """

    path: Path
    rate_hz: float
    channels: int
    sample_count: int | None
    format: str

    def blocks(self, length: int) -> Iterator[NDArray[np.float32]]:
        """Iterate over the samples from the start, float32 (≤ length, channels), full scale ±1.

        Ends where the readable samples end. A file that is cut off or damaged holds fewer than `sample_count`: that
        shortfall is how a reader knows. Memory does not grow with the file's length.

        Raises
        ------
        RecordingError
            Where the file can no longer be opened.
        ValueError
            Where `length` is not positive.
        """
        if length < 1:
            raise ValueError(f"block length {length}; give 1 or more samples")
        try:
            stream = _Stream(str(self.path))
        except (soundfile.SoundFileError, OSError) as error:
            raise RecordingError([_unreadable(self.path, error)]) from None
        with stream:
            yield from _assemble(stream, length, self.channels)


def _assemble(stream: soundfile.SoundFile, length: int, channels: int) -> Iterator[NDArray[np.float32]]:
    """Yield blocks of `length` from small reads; what was read before an error is yielded, then it ends."""
    block, filled = np.empty((length, channels), np.float32), 0
    while True:
        try:
            got = len(stream.read(dtype="float32", always_2d=True, out=block[filled : filled + _READ_FRAMES]))
        except soundfile.SoundFileError:
            got = 0
        filled += got
        if filled == length or (not got and filled):
            yield block[:filled]
            block, filled = np.empty((length, channels), np.float32), 0
        if not got:
            return


def find_capture(folder: Path) -> Capture | None:
    """Open the recording's capture; None where it has none.

    Raises
    ------
    RecordingError
        Where there are two, or the file holds no samples that can be read.
    """
    paths = [folder / name for name in CAPTURE_NAMES if (folder / name).exists()]
    if not paths:
        return None
    if len(paths) > 1:
        raise RecordingError(
            [Problem(paths[1].name, "", None, f"{paths[0].name} is there as well; keep one of the two")]
        )
    return open_capture(paths[0])


def open_capture(path: Path) -> Capture:
    """Read a sound file's header.

    Raises
    ------
    RecordingError
        Where it is no sound file, or holds no samples.
    """
    name = path.name
    try:
        with _Stream(str(path)) as stream:
            rate, channels, frames = float(stream.samplerate), stream.channels, stream.frames
            kind = f"{stream.format} {stream.subtype}"
            some = len(stream.read(1, dtype="float32", always_2d=True))
    except (soundfile.SoundFileError, OSError) as error:
        raise RecordingError([_unreadable(path, error)]) from None
    if not kind.startswith(FORMATS):
        raise RecordingError([Problem(name, "format", kind, "must be FLAC or WAV; export it again")])
    count = None if frames >= _UNKNOWN_COUNT else int(frames)
    stated, held = _wav_counts(path) if kind.startswith(("WAV", "RF64")) else (None, None)
    if not some:
        remedy = "no sample can be read; record again, or repair the header"
        if held and not stated:
            remedy = f"the header states no samples although {held} follow: the recorder did not finish it; repair it"
        elif stated:
            remedy = f"the header states {stated} samples but none follow; copy the file again"
        raise RecordingError([Problem(name, "samples", 0, remedy)])
    if count is not None and stated is not None:
        count = max(count, stated)
    return Capture(path, rate, channels, count, kind)


def _unreadable(path: Path, error: Exception) -> Problem:
    if path.is_dir():
        return Problem(path.name, "", None, "is a folder; a sound file belongs here")
    size = path.stat().st_size if path.exists() else None
    reason = getattr(error, "error_string", None) or getattr(error, "strerror", None) or str(error)
    remedy = f"cannot be read as FLAC or WAV ({str(reason).rstrip('.')}); export it again"
    return Problem(path.name, "size", f"{size} bytes" if size is not None else None, remedy)


def _wav_counts(path: Path) -> tuple[int | None, int | None]:
    """Return how many frames a WAV's header states (None: unknown, as a recorder leaves it) and how many follow."""
    with path.open("rb") as file:
        if file.read(4) not in (b"RIFF", b"RF64") or len(file.read(8)) < 8:
            return None, None
        frame_bytes = long_size = 0
        while len(head := file.read(8)) == 8:
            kind, size = head[:4], struct.unpack("<I", head[4:])[0]
            if kind == b"fmt ":
                frame_bytes = struct.unpack("<H", file.read(size)[12:14])[0]
            elif kind == b"ds64":  # EBU Tech 3306: where RF64 keeps sizes beyond 32 bits
                long_size = struct.unpack("<Q", file.read(size)[8:16])[0]
            elif kind == b"data":
                follow = path.stat().st_size - file.tell()
                stated = {0: None, 0xFFFFFFFF: long_size or None}.get(size, size)
                return (stated // frame_bytes if stated and frame_bytes else stated), follow // max(frame_bytes, 1)
            else:
                file.seek(size + size % 2, 1)
    return None, None
