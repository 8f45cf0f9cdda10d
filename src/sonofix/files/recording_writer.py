"""A recording folder written: the site file, samples by blocks, and the tables beside them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import soundfile
from numpy.typing import NDArray

from sonofix.files.audio import CAPTURE_NAMES
from sonofix.files.problem import Problem, RecordingError
from sonofix.files.site_file import FILE_NAME, site_text
from sonofix.files.tables import LAYOUTS
from sonofix.files.writing import told
from sonofix.records import Floats, RangeRows, Recording, ReferenceBurst, Table, Truth
from sonofix.site import ReferenceCode

BLOCK = 65536
MOST_FLAC_CHANNELS = 8
LARGEST_WAV_BYTES = 2**32 - 2**16
"""Beyond this a WAV header cannot state the length, and the file is an RF64 one (still named capture.wav)."""

_BYTES = {"PCM_16": 2, "PCM_24": 3, "FLOAT": 4}


def write_recording(
    folder: str | Path,
    recording: Recording,
    truth: Mapping[str, Truth] | None = None,
    *,
    audio: Literal["wav", "flac"] = "wav",
    subtype: Literal["PCM_16", "PCM_24", "FLOAT"] = "PCM_16",
    references: Mapping[str, ReferenceBurst] | None = None,
    overwrite: bool = False,
    on_block: Callable[[int], None] | None = None,
) -> None:
    """Write a recording folder that `read_recording` reads back.

    Samples are taken and written block by block, so length costs no memory; beyond full scale they are clipped where
    the subtype is not FLOAT.

    Parameters
    ----------
    folder : path
        Made where it does not exist.
    recording : Recording
    truth : mapping from vehicle to Truth, optional
    audio, subtype : str
        A WAV is one that is readable when cut off; a FLAC is smaller and holds at most 8 channels.
    references : mapping from beacon id to ReferenceBurst, optional
        The recorded bursts that the site's codes name, which belong into the folder as well.
    overwrite : bool
        Replace a recording that is there already.
    on_block : callable, optional
        Told after each block how many samples were written.

    Raises
    ------
    RecordingError
        Where the folder holds a recording, the format cannot take the samples, or the disk is full.
    """
    folder = Path(folder)
    if (folder / FILE_NAME).exists() and not overwrite:
        raise RecordingError([Problem(str(folder), "", None, "is a recording already; choose another folder")])
    if folder.exists() and not folder.is_dir():
        raise RecordingError([Problem(str(folder), "", None, "is a file; give a folder")])
    with told(folder, ""):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / FILE_NAME).write_text(site_text(recording.site), encoding="utf-8")
    for beacon in recording.site.beacons:
        if isinstance(beacon.code, ReferenceCode) and references and beacon.id in references:
            _write_reference(folder / beacon.code.reference, references[beacon.id])
    if recording.sync_s is not None:
        write_table(folder / "sync.csv", Table({"time_s": recording.sync_s}), ("time_s",))
    if recording.ranges is not None:
        write_table(folder / "ranges.csv", _range_table(recording.ranges), ("time_s", "from", "to", "range_m", "sd_m"))
    for stem, table in recording.tables.items():
        layout = LAYOUTS[stem]
        columns = (*layout.required[:1], "vehicle", *layout.required[1:], *layout.optional)
        write_table(folder / f"{stem}.csv", table, columns)
    if truth:
        write_truth(folder / "truth.csv", truth)
    if recording.blocks is not None and recording.rate_hz is not None:
        _write_samples(folder, recording.blocks(BLOCK), recording, audio, subtype, on_block)


def write_truth(path: Path, truth: Mapping[str, Truth]) -> None:
    """Write `truth.csv`: all vehicles' poses in order of time; the column `vehicle` where there are several."""
    times = np.concatenate([t.time_s for t in truth.values()])
    order = np.argsort(times, kind="stable")
    position_m = np.concatenate([t.position_m for t in truth.values()])[order]
    columns: dict[str, Floats] = {"time_s": times[order]}
    columns |= {name: position_m[:, i] for i, name in enumerate(("x_m", "y_m", "z_m"))}
    for name in ("yaw_rad", "roll_rad", "pitch_rad"):
        angles = [getattr(t, name) for t in truth.values()]
        if any(angle is not None for angle in angles):
            known = [
                np.full(len(t.time_s), np.nan if a is None else a) for t, a in zip(truth.values(), angles, strict=True)
            ]
            columns[name] = np.concatenate(known)[order]
    vehicles = [vehicle for vehicle, t in truth.items() for _ in t.time_s]
    names = {"vehicle": tuple(vehicles[i] for i in order)} if len(truth) > 1 else {}
    write_table(
        path, Table(columns, names), ("time_s", "vehicle", "x_m", "y_m", "z_m", "yaw_rad", "roll_rad", "pitch_rad")
    )


def write_table(path: Path, table: Table, order: Sequence[str]) -> None:
    """Write a CSV file; columns that the table lacks are left out, NaN makes an empty cell.

    Raises
    ------
    RecordingError
        Where it cannot be written.
    """
    names = [name for name in order if name in table.columns or name in table.names]
    texts = [table.names[name] if name in table.names else _cells(table.columns[name]) for name in names]
    with told(path.parent, path.name), path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(names)
        rows.writerows(zip(*texts, strict=True))


def _cells(values: Floats) -> list[str]:
    return ["" if np.isnan(value) else format(value, ".9f") for value in values.tolist()]


def _range_table(ranges: RangeRows) -> Table:
    columns = {"time_s": ranges.time_s, "range_m": ranges.range_m}
    if ranges.sd_m is not None:
        columns["sd_m"] = ranges.sd_m
    return Table(columns, {"from": ranges.emitter, "to": ranges.receiver})


def _write_reference(path: Path, burst: ReferenceBurst) -> None:
    kind = "FLAC" if path.suffix.lower() == ".flac" else "WAV"
    with told(path.parent, path.name):
        path.parent.mkdir(parents=True, exist_ok=True)
    _written(path, round(burst.rate_hz), 1, kind, "PCM_24", iter([burst.samples.astype(np.float32)[:, None]]), None)


def _write_samples(
    folder: Path,
    blocks: Iterator[NDArray[np.float32]],
    recording: Recording,
    audio: Literal["wav", "flac"],
    subtype: Literal["PCM_16", "PCM_24", "FLOAT"],
    on_block: Callable[[int], None] | None,
) -> None:
    path, rate = folder / f"capture.{audio}", round(recording.rate_hz or 0)
    first = next(blocks, None)
    if first is None:
        raise RecordingError([Problem(path.name, "samples", 0, "there is nothing to write")])
    channels = first.shape[1]
    if rate != recording.rate_hz:
        raise RecordingError([Problem(path.name, "sample rate", recording.rate_hz, "a file's rate is a whole number")])
    if audio == "flac" and (channels > MOST_FLAC_CHANNELS or subtype == "FLOAT"):
        remedy = f"FLAC holds at most {MOST_FLAC_CHANNELS} channels of whole numbers; write WAV"
        raise RecordingError([Problem(path.name, "format", f"{channels} channels, {subtype}", remedy)])
    size = None if recording.sample_count is None else recording.sample_count * channels * _BYTES[subtype]
    wav = "RF64" if size is None or size > LARGEST_WAV_BYTES else "WAV"
    kind = "FLAC" if audio == "flac" else wav

    def all_blocks() -> Iterator[NDArray[np.float32]]:
        yield first
        yield from blocks

    # Under another name until it is whole: the samples may come from the very file that is to be replaced.
    part = path.with_name(f"{path.name}.part")
    _written(part, rate, channels, kind, subtype, all_blocks(), on_block)
    with told(folder, path.name):
        for name in CAPTURE_NAMES:
            (folder / name).unlink(missing_ok=True)
        part.replace(path)


def _written(
    path: Path,
    rate: int,
    channels: int,
    kind: str,
    subtype: str,
    blocks: Iterator[NDArray[np.float32]],
    on_block: Callable[[int], None] | None,
) -> None:
    """Stream blocks into a sound file; where the disk is full, say so."""
    count = 0
    try:
        with soundfile.SoundFile(str(path), "w", rate, channels, subtype=subtype, format=kind) as file:
            for block in blocks:
                file.write(block)
                count += len(block)
                if on_block is not None:
                    on_block(count)
    except (soundfile.SoundFileError, AssertionError) as error:
        # soundfile states a short write (a full disk) as an assertion on the number of frames.
        reason = getattr(error, "error_string", None) or f"stopped after {count} samples"
        remedy = f"cannot be written ({str(reason).rstrip('.')}); make room or choose another folder"
        raise RecordingError([Problem(str(path), "", None, remedy)]) from None
