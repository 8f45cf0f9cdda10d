"""A track as a TUM trajectory and as a Parquet table."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from sonofix.attitude import quaternion
from sonofix.files.results import column
from sonofix.files.writing import tum_row, write_whole
from sonofix.records import Floats, Table

NO_PARQUET = "writing Parquet needs pyarrow; pip install 'sonofix[parquet]'"


def quaternions(track: Table) -> Floats:
    """Return attitudes as quaternions x, y, z, w, (n, 4); an angle that is not known counts as 0."""
    angles = [np.nan_to_num(column(track, name), nan=0.0) for name in ("roll_rad", "pitch_rad", "yaw_rad")]
    return quaternion(*angles).T


def positions(track: Table) -> Floats:
    """Return positions, (n, 3); NaN where they are not known."""
    return np.column_stack([track.columns[f"{axis}_m"] for axis in "xyz"])


def velocities(track: Table) -> Floats:
    """Return velocities, (n, 3); NaN where they are not known, but a vertical speed that is not known counts as 0."""
    vx, vy, vz = (column(track, f"v{axis}_mps") for axis in "xyz")
    return np.column_stack([vx, vy, np.where(np.isnan(vz), 0.0, vz)])


def write_tum(path: Path, track: Table) -> int:
    """Write one vehicle's track as `time x y z qx qy qz qw`; return the number of rows.

    Raises
    ------
    RecordingError
        Where it cannot be written.
    """
    rows = np.flatnonzero(np.isfinite(positions(track)).all(axis=1))
    time_s, place, turned = track.columns["time_s"], positions(track), quaternions(track)

    def make(part: Path) -> None:
        with part.open("w", newline="", encoding="utf-8") as file:
            lines = csv.writer(file, delimiter=" ", lineterminator="\n")
            lines.writerows(tum_row(time_s[i], place[i], turned[i]) for i in rows)

    write_whole(path, make)
    return len(rows)


def write_parquet(path: Path, track: Table, zero_ns: int | None) -> int:
    """Write a track with all its columns, null where a cell is empty; return the number of rows.

    The file's metadata hold the instant of time 0, where it is known, as `sonofix.zero_ns`.

    Raises
    ------
    RecordingError
        Where it cannot be written.
    ValueError
        If pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("pyarrow"):
            raise
        raise ValueError(NO_PARQUET) from None
    arrays = {"time_s": pa.array(track.columns["time_s"])}
    arrays |= {name: pa.array(texts).dictionary_encode() for name, texts in track.names.items() if name == "vehicle"}
    for name, values in track.columns.items():
        arrays.setdefault(name, pa.array(values, mask=np.isnan(values)))
    for name, texts in track.names.items():
        arrays.setdefault(name, pa.array(texts).dictionary_encode())
    meta = {"sonofix.frame": "east, north, up; SI units; angles counter-clockwise from the x axis"}
    if zero_ns is not None:
        meta["sonofix.zero_ns"] = str(zero_ns)
    table = pa.table(arrays).replace_schema_metadata(meta)
    write_whole(path, lambda part: pq.write_table(table, part))
    return table.num_rows
