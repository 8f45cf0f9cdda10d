"""Files that a run wrote, read back to score and to export them: ranges, fixes, the track."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sonofix.files.problem import Problem, RecordingError, did_you_mean
from sonofix.files.tables import Sheet
from sonofix.records import Floats, Table
from sonofix.site import Site

_TEXT = ("vehicle", "source", "status", "from", "to")
_NEEDED = {
    "track.csv": ("time_s", "x_m", "y_m", "z_m"),
    "fixes.csv": ("time_s", "used"),
    "ranges.csv": ("time_s", "from", "to", "range_m"),
    "innovations.csv": ("time_s", "rows", "nis"),
}


def read_track(path: Path, site: Site) -> Table:
    """Read a track: its columns in the file's order, ``vehicle`` filled in where the site has one only.

    Raises
    ------
    RecordingError
        Where it is not there or holds mistakes, a vehicle that the site lacks for example.
    """
    table = _read(path, _NEEDED["track.csv"])
    ids = [vehicle.id for vehicle in site.vehicles]
    if "vehicle" not in table.names and len(ids) == 1:
        table = Table(table.columns, {**table.names, "vehicle": (ids[0],) * len(table.columns["time_s"])})
    for vehicle in dict.fromkeys(table.names.get("vehicle", ("",))):
        if vehicle not in ids:
            near = did_you_mean(vehicle, ids) if ids else "it has none"
            raise RecordingError([Problem(str(path), "vehicle", vehicle, f"no vehicle of the site; {near}")])
    return table


def read_ranges(path: Path) -> Table | None:
    """Read the ranges of a run; None where there is no such file. Errors as `read_fixes`."""
    return _read(path, _NEEDED["ranges.csv"]) if path.exists() else None


def read_fixes(path: Path) -> Table | None:
    """Read the fixes of a run, of which there may be none; None where there is no such file.

    Raises
    ------
    RecordingError
        Where it holds mistakes.
    """
    return _read(path, _NEEDED["fixes.csv"]) if path.exists() else None


def read_innovations(path: Path) -> Table | None:
    """Read the innovations of a run; None where there is no such file. Errors as `read_fixes`."""
    if not path.exists():
        return None
    table, sheet = _read(path, _NEEDED["innovations.csv"]), Sheet(str(path))
    for line, (rows, nis) in enumerate(zip(table.columns["rows"], table.columns["nis"], strict=True), 2):
        if not (rows >= 1 and rows % 1 == 0):
            sheet.tell(f"line {line}, rows", f"{rows:g}", "must be a whole number from 1 on")
        if not nis >= 0:
            sheet.tell(f"line {line}, nis", f"{nis:g}", "must be 0 or more")
    sheet.check()
    return table


def by_vehicle(table: Table) -> Iterator[tuple[str, Table]]:
    """Yield each vehicle's rows."""
    vehicles = np.array(table.names["vehicle"])
    for vehicle in dict.fromkeys(table.names["vehicle"]):
        rows = np.flatnonzero(vehicles == vehicle)
        names = {name: tuple(texts[i] for i in rows) for name, texts in table.names.items()}
        yield vehicle, Table({name: values[rows] for name, values in table.columns.items()}, names)


def column(table: Table, name: str) -> Floats:
    """Return a column; NaN throughout where the table lacks it."""
    return table.columns.get(name, np.full(len(table.columns["time_s"]), np.nan))


def plain_name(text: str) -> str:
    """Return an id as a part of a file's name."""
    return re.sub(r"[^\w.-]", "_", text)


def _read(path: Path, needed: tuple[str, ...]) -> Table:
    sheet = Sheet(str(path))
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            header, *rows = list(csv.reader(file, strict=True)) or [[]]
    except FileNotFoundError:
        raise RecordingError([Problem(str(path), "", None, "there is no such file; first: sonofix run")]) from None
    except OSError as error:
        raise RecordingError([Problem(str(path), "", None, f"cannot be read: {error.strerror or error}")]) from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise RecordingError([Problem(str(path), "", None, f"is no CSV text: {error}")]) from None
    for name in needed:
        if name not in header:
            sheet.tell("line 1", ",".join(header), f"column {name} is missing; is this a file of sonofix run?")
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            sheet.tell(f"line {line}", ",".join(row), f"has {len(row)} cells where line 1 names {len(header)} columns")
    sheet.check()
    columns: dict[str, Floats] = {}
    names: dict[str, tuple[str, ...]] = {}
    by_column = zip(*rows, strict=True) if rows else ((),) * len(header)
    for name, cells in zip(header, by_column, strict=True):
        if name in _TEXT:
            names[name] = cells
        else:
            columns[name] = _numbers(cells, name, sheet)
    sheet.check()
    for line in np.flatnonzero(~np.isfinite(columns["time_s"])):
        sheet.tell(f"line {line + 2}, time_s", "", "no row may leave this empty")
    sheet.check()
    return Table(columns, names)


def _numbers(cells: tuple[str, ...], name: str, sheet: Sheet) -> Floats:
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        try:
            values[i] = float(cell) if cell.strip() else np.nan
        except ValueError:
            sheet.tell(f"line {i + 2}, {name}", cell, "must be a number")
    return values
