"""The recording's CSV files: strict columns, finite numbers, time in order, ids that the site knows."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sonofix.files.problem import Problem, RecordingError, did_you_mean
from sonofix.files.site_file import read_text
from sonofix.records import Floats, Table
from sonofix.site import Site

MOST_PROBLEMS = 5
"""Told for each file; the rest is counted."""

TEXT_COLUMNS = ("from", "to", "vehicle")

LATEST_S, FARTHEST_M, FASTEST_MPS, FASTEST_RADPS = 1e10, 1e8, 1e3, 1e2
"""No value of a table is larger: year 2286 since 1970, twice the way around the earth, what gyros measure at most (35
rad/s). Beyond is another unit, or a slip."""

TURN_RAD = 6.3
"""A direction is told within one turn, either way and rounded; what is beyond is degrees. Headings that follow one
another may go on beyond where a vehicle turns and turns, but not by more than that from one row to the next."""

TIME = {"time_s": (-LATEST_S, LATEST_S, "s")}


@dataclass(frozen=True, slots=True)
class Layout:
    """What a CSV file holds.

    Attributes
    ----------
    required, optional : tuple of str
        Column names; `vehicle` is added where `per_vehicle`.
    given : tuple of str
        Number columns that no row may leave empty.
    one_of : tuple of str
        Exactly one of these columns must be there, and is `given`.
    order : str or None
        The column that must not go backwards for one `key`.
    key : str or None
        A text column; None: all rows together.
    bounds : mapping from column to (lowest, highest, unit)
    winds : str or None
        A column of angles, rad, that may go on beyond a turn.
    """

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    given: tuple[str, ...] = ("time_s",)
    one_of: tuple[str, ...] = ()
    per_vehicle: bool = False
    order: str | None = "time_s"
    key: str | None = None
    strictly: bool = False
    bounds: Mapping[str, tuple[float, float, str]] | None = None
    winds: str | None = None


LAYOUTS = {
    "sync": Layout(("time_s",), strictly=True, bounds=TIME),
    "ranges": Layout(
        ("time_s", "from", "to"),
        ("sd_m",),
        one_of=("range_m", "time_of_flight_s"),
        key="to",
        bounds={
            **TIME,
            "sd_m": (1e-9, FARTHEST_M, "m"),
            # with an unknown clock, its offset too
            "range_m": (-1e4 * FARTHEST_M, 1e4 * FARTHEST_M, "m"),
            "time_of_flight_s": (-LATEST_S, LATEST_S, "s"),
        },
    ),
    "bearings": Layout(
        ("time_s", "from", "to", "bearing_rad"),
        given=("time_s", "bearing_rad"),
        key="to",
        bounds={"bearing_rad": (-TURN_RAD, TURN_RAD, "rad, not degrees")},
    ),
    "exchanges": Layout(
        ("from", "to", "sent_s", "heard_s", "reply_sent_s", "reply_heard_s"),
        ("heard_sd_s", "reply_heard_sd_s"),
        given=("sent_s", "heard_s", "reply_sent_s", "reply_heard_s"),
        order="sent_s",
        key="from",
        bounds={"heard_sd_s": (1e-12, np.inf, "s"), "reply_heard_sd_s": (1e-12, np.inf, "s")},
    ),
    "odometry": Layout(
        ("time_s", "v_mps", "yaw_rate_radps"),
        per_vehicle=True,
        key="vehicle",
        bounds={
            **TIME,
            "v_mps": (-FASTEST_MPS, FASTEST_MPS, "m/s"),
            "yaw_rate_radps": (-FASTEST_RADPS, FASTEST_RADPS, "rad/s"),
        },
    ),
    "steps": Layout(
        ("time_s", "length_m", "heading_rad"),
        per_vehicle=True,
        key="vehicle",
        bounds={**TIME, "length_m": (0.0, 100.0, "m")},
        winds="heading_rad",
    ),
    "compass": Layout(("time_s", "heading_rad"), per_vehicle=True, key="vehicle", bounds=TIME, winds="heading_rad"),
    "imu": Layout(
        ("time_s", "gx_radps", "gy_radps", "gz_radps", "ax_mps2", "ay_mps2", "az_mps2"),
        per_vehicle=True,
        key="vehicle",
        bounds={**TIME, **{f"g{axis}_radps": (-FASTEST_RADPS, FASTEST_RADPS, "rad/s") for axis in "xyz"}},
    ),
    "positions": Layout(
        ("time_s", "x_m", "y_m"),
        ("z_m", "sd_m"),
        given=("time_s", "x_m", "y_m"),
        per_vehicle=True,
        key="vehicle",
        bounds={
            **TIME,
            **{f"{axis}_m": (-FARTHEST_M, FARTHEST_M, "m") for axis in "xyz"},
            "sd_m": (1e-9, FARTHEST_M, "m"),
        },
    ),
    "temperature": Layout(("time_s", "temperature_c"), bounds={**TIME, "temperature_c": (-40.0, 60.0, "°C")}),
    "start": Layout(
        ("x_m", "y_m", "yaw_rad"),
        ("z_m",),
        given=("x_m", "y_m"),
        per_vehicle=True,
        order=None,
        bounds={
            **{f"{axis}_m": (-FARTHEST_M, FARTHEST_M, "m") for axis in "xyz"},
            "yaw_rad": (-TURN_RAD, TURN_RAD, "rad, not degrees"),
        },
    ),
    "truth": Layout(
        ("time_s", "x_m", "y_m", "z_m"),
        ("yaw_rad", "roll_rad", "pitch_rad"),
        given=("time_s", "x_m", "y_m", "z_m"),
        per_vehicle=True,
        key="vehicle",
    ),
}


class Sheet:
    """One CSV file while it is judged: its cells, its columns so far, and what is wrong with it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.problems: list[Problem] = []
        self.more = 0

    def tell(self, field: str, value: object, remedy: str) -> None:
        """Note a mistake; beyond `MOST_PROBLEMS` they are counted."""
        if len(self.problems) < MOST_PROBLEMS:
            self.problems.append(Problem(self.name, field, value, remedy))
        else:
            self.more += 1

    def check(self) -> None:
        """Raise RecordingError where something is wrong."""
        if self.more:
            self.problems.append(Problem(self.name, "", None, f"and {self.more} more mistakes like these"))
        if self.problems:
            raise RecordingError(self.problems)


def read_table(path: Path, layout: Layout, site: Site | None) -> Table:
    """Read one CSV file, rows in time order.

    `vehicle` is always among the names of a per-vehicle file: a site's only vehicle is filled in. `site` None (it could
    not be read itself) skips what needs the site.

    Raises
    ------
    RecordingError
        With the file's mistakes, each with row (line of the file) and column.
    """
    sheet = Sheet(path.name)
    cells, lines = _cells(path, layout, site, sheet)
    sheet.check()
    columns: dict[str, Floats] = {}
    names: dict[str, tuple[str, ...]] = {}
    given = (*layout.given, *layout.one_of)
    for column, texts in cells.items():
        if column in TEXT_COLUMNS:
            names[column] = tuple(texts)
            for line, text in zip(lines, texts, strict=True):
                if not text:
                    sheet.tell(f"line {line}, {column}", "", "no row may leave this empty")
        else:
            columns[column] = _numbers(texts, lines, column, column in given, sheet)
    for column, (low, high, unit) in (layout.bounds or {}).items():
        values = columns.get(column, np.zeros(0))
        for i in np.flatnonzero((values < low) | (values > high)):
            limit = f"at least {low:g}" if high == np.inf else f"from {low:g} to {high:g}"
            sheet.tell(f"line {lines[i]}, {column}", float(values[i]), f"must be {limit} {unit}")
    if layout.winds in columns:
        _winding(columns[layout.winds], names.get(layout.key or ""), lines, layout.winds, sheet)
    if site is not None:
        _known_ids(names, lines, site, sheet)
        if layout.per_vehicle and "vehicle" not in names and len(site.vehicles) == 1:
            names["vehicle"] = (site.vehicles[0].id,) * len(lines)
    if layout.order and layout.order in columns:
        _in_order(columns[layout.order], names.get(layout.key or ""), lines, layout, sheet)
    sheet.check()
    return _sorted(columns, names, layout.order)


def _cells(path: Path, layout: Layout, site: Site | None, sheet: Sheet) -> tuple[dict[str, Sequence[str]], list[int]]:
    """Return the file's columns as text and the line of each row; mistakes of shape are told to the sheet."""
    reader = csv.reader(io.StringIO(read_text(path, path.name), newline=""), strict=True)
    try:
        rows = [(reader.line_num, row) for row in reader if row]
    except csv.Error as error:
        sheet.tell(f"line {reader.line_num}", None, f"not CSV: {error}")
        return {}, []
    allowed = (*layout.required, *layout.optional, *layout.one_of, *(("vehicle",) if layout.per_vehicle else ()))
    if not rows:
        sheet.tell("", None, f"is empty; the first line names the columns: {','.join(layout.required)}")
        return {}, []
    header = [cell.strip() for cell in rows[0][1]]
    if len(header) == 1 and len(layout.required) > 1 and (";" in header[0] or "\t" in header[0]):
        sheet.tell("line 1", header[0], "columns are separated by commas")
        return {}, []
    for i, column in enumerate(header):
        if column in header[:i]:
            sheet.tell("line 1", column, "this column stands there twice; remove one")
        elif column not in allowed:
            sheet.tell("line 1", column, f"unknown column; {did_you_mean(column, allowed)}")
    needed = (*layout.required, *(("vehicle",) if layout.per_vehicle and site and len(site.vehicles) > 1 else ()))
    for column in needed:
        if column not in header:
            why = " (the site has several vehicles)" if column == "vehicle" else ""
            sheet.tell("line 1", ",".join(header), f"column {column} is missing; add it{why}")
    choices = [column for column in layout.one_of if column in header]
    if layout.one_of and len(choices) != 1:
        sheet.tell("line 1", ",".join(header), f"exactly one of the columns {' and '.join(layout.one_of)} belongs here")
    if len(rows) == 1:
        sheet.tell("", None, "has no rows below its first line; add them or remove the file")
    for line, row in rows[1:]:
        if len(row) != len(header):
            sheet.tell(f"line {line}", ",".join(row), f"has {len(row)} cells where line 1 names {len(header)} columns")
    if sheet.problems:
        return {}, []
    columns = zip(*(row for _, row in rows[1:]), strict=True)
    return dict(zip(header, ([cell.strip() for cell in column] for column in columns), strict=True)), [
        line for line, _ in rows[1:]
    ]


def _numbers(texts: Sequence[str], lines: Sequence[int], column: str, given: bool, sheet: Sheet) -> Floats:
    """Return a column as float64, NaN where a cell is empty."""
    try:
        values = np.array(texts, dtype=np.float64)
        # Python reads 1_000 as a number; a file that holds it holds a slip.
        if np.all(np.isfinite(values)) and not any("_" in text for text in texts):
            return values
    except ValueError:
        pass
    values = np.full(len(texts), np.nan)
    for i, text in enumerate(texts):
        if not text:
            if given:
                sheet.tell(f"line {lines[i]}, {column}", "", "no row may leave this empty")
            continue
        try:
            value = float(text) if "_" not in text else None
        except ValueError:
            value = None
        if value is None:
            sheet.tell(f"line {lines[i]}, {column}", text, "must be a number with a decimal point")
        elif not np.isfinite(value):
            sheet.tell(f"line {lines[i]}, {column}", text, "must be finite; leave the cell empty where it is not known")
        else:
            values[i] = value
    return values


def _known_ids(names: Mapping[str, Sequence[str]], lines: Sequence[int], site: Site, sheet: Sheet) -> None:
    """Tell ids that the site lacks, once each, and pairs that cannot hear each other."""
    kinds = {
        "from": ("beacon", site.beacons),
        "to": ("microphone", site.microphones),
        "vehicle": ("vehicle", site.vehicles),
    }
    for column, found in names.items():
        kind, nodes = kinds[column]
        known = [node.id for node in nodes]
        for node_id in dict.fromkeys(found):
            if node_id and node_id not in known:
                line = lines[found.index(node_id)]
                near = did_you_mean(node_id, known) if known else "it has none"
                sheet.tell(f"line {line}, {column}", node_id, f"the site has no [[{kind}]] of this id; {near}")
    rides = {
        kind: {node.id: node.vehicle for node in nodes if node.vehicle} for kind, nodes in (kinds["from"], kinds["to"])
    }
    if "from" in names and "to" in names:
        pairs = list(zip(names["from"], names["to"], strict=True))
        for emitter, receiver in dict.fromkeys(pairs):
            if rides["beacon"].get(emitter, 1) == rides["microphone"].get(receiver, 2):
                line = lines[pairs.index((emitter, receiver))]
                sheet.tell(
                    f"line {line}, to",
                    receiver,
                    "rides on the same vehicle as the beacon; a robot does not hear itself",
                )


def _in_order(times: Floats, keys: Sequence[str] | None, lines: Sequence[int], layout: Layout, sheet: Sheet) -> None:
    """Tell where time goes backwards (or stands, where it must not) for one key."""
    kinds, which = np.unique(np.array(keys or [""] * len(times)), return_inverse=True)
    for kind, key in enumerate(kinds.tolist()):
        rows = np.flatnonzero((which == kind) & ~np.isnan(times))
        steps = np.diff(times[rows])
        for i in np.flatnonzero((steps < 0) | (steps == 0 if layout.strictly else False)):
            whose = f" of {key}" if key else ""
            remedy = f"the row{whose} before has {times[rows[i]]:.9g}; time must not go backwards, so sort the rows"
            if steps[i] == 0:
                remedy = "the row before has the same time; every epoch has one row"
            sheet.tell(f"line {lines[rows[i + 1]]}, {layout.order}", float(times[rows[i + 1]]), remedy)


def _winding(values: Floats, keys: Sequence[str] | None, lines: Sequence[int], column: str, sheet: Sheet) -> None:
    """Tell angles beyond a turn to which none before leads."""
    before: dict[str, float] = {}
    for i in np.flatnonzero(~np.isnan(values)).tolist():
        key, value = keys[i] if keys else "", float(values[i])
        if abs(value) > TURN_RAD and abs(value - before.get(key, np.inf)) > TURN_RAD:
            remedy = f"must be from {-TURN_RAD:g} to {TURN_RAD:g} rad, not degrees, or go on from the row before"
            sheet.tell(f"line {lines[i]}, {column}", value, remedy)
            continue
        before[key] = value


def _sorted(columns: dict[str, Floats], names: dict[str, tuple[str, ...]], order: str | None) -> Table:
    """Return the rows of all vehicles in one order of time."""
    if order and order in columns and np.any(np.diff(columns[order]) < 0):
        rows: NDArray[np.intp] = np.argsort(columns[order], kind="stable")
        columns = {name: values[rows] for name, values in columns.items()}
        names = {name: tuple(texts[i] for i in rows) for name, texts in names.items()}
    return Table(columns, names)
