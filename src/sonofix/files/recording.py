"""A recording folder read: site, samples or ranges, sensor files; all mistakes in all files at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from sonofix.files.audio import Capture, find_capture, open_capture
from sonofix.files.problem import Problem, RecordingError
from sonofix.files.site_file import FILE_NAME, read_site
from sonofix.files.tables import LAYOUTS, read_table
from sonofix.records import Floats, RangeRows, Recording, ReferenceBurst, Table, Truth
from sonofix.site import ChirpCode, ReferenceCode, Site
from sonofix.two_way import replied

SENSOR_FILES = ("odometry", "steps", "compass", "imu", "temperature", "start", "bearings", "exchanges", "positions")
LONGEST_REFERENCE_S = 10.0

_T = TypeVar("_T")


def read_recording(folder: str | Path, *, to_run: bool = False) -> Recording:
    """Read a recording folder; samples stay in the file until `Recording.blocks` is asked for them.

    Times of flight become ranges with the site's sound speed. Where a sync file is given and the schedule states no
    period, the period is the median step between its rows.

    Parameters
    ----------
    folder : path
    to_run : bool
        Also ask for something to compute positions from: samples or ranges.

    Raises
    ------
    RecordingError
        With every mistake in every file.
    """
    folder = place = Path(folder)
    if not folder.is_dir():
        remedy = "is a file; give the folder that holds it" if folder.exists() else "there is no such folder"
        raise RecordingError([Problem(str(folder), "", None, remedy)])
    problems: list[Problem] = []

    def attempt(read: Callable[[], _T]) -> _T | None:
        try:
            return read()
        except RecordingError as error:
            problems.extend(error.problems)
            return None

    site = attempt(lambda: read_site(place / FILE_NAME))
    capture = attempt(lambda: find_capture(folder))
    tables = {
        stem: table
        for stem in ("sync", "ranges", *SENSOR_FILES)
        if (folder / f"{stem}.csv").exists()
        and (table := attempt(lambda stem=stem: read_table(place / f"{stem}.csv", LAYOUTS[stem], site))) is not None
    }
    problems += _start_problems(tables.get("start"))
    ranges = None
    references: dict[str, ReferenceBurst] = {}
    if site is not None:
        if "ranges" in tables:
            ranges = attempt(partial(_range_rows, tables["ranges"], site))
        if capture is not None:
            site = _with_period(site, tables.get("sync"))
            problems += _capture_problems(site, capture, "ranges" in tables)
        references = attempt(lambda: read_references(folder, site)) or {}
        if "exchanges" in tables:
            problems += _exchange_problems(tables["exchanges"], site)
        problems += _position_problems(tables.get("positions"), site)
        stated = ranges is not None or "exchanges" in tables or "positions" in tables
        if to_run and not problems and capture is None and not stated:
            remedy = "nothing to compute positions from; add capture.wav, capture.flac, ranges.csv, exchanges.csv"
            problems.append(Problem(str(folder), "", None, f"{remedy} or positions.csv"))
    if problems or site is None:
        raise RecordingError(problems)
    sync = tables.pop("sync", None)
    tables.pop("ranges", None)
    return Recording(
        site=site,
        rate_hz=capture.rate_hz if capture else None,
        sample_count=capture.sample_count if capture else None,
        blocks=capture.blocks if capture else None,
        sync_s=sync.columns["time_s"] if sync else None,
        ranges=ranges,
        tables=tables,
        references=references,
    )


def read_truth(folder: str | Path) -> dict[str, Truth]:
    """Read `truth.csv`: the truth of each vehicle, yaw unwrapped; empty where the recording has none.

    Raises
    ------
    RecordingError
        With every mistake in the file.
    """
    folder = Path(folder)
    if not (folder / "truth.csv").exists():
        return {}
    site = read_site(folder / FILE_NAME)
    table = read_table(folder / "truth.csv", LAYOUTS["truth"], site)
    if "vehicle" not in table.names:
        raise RecordingError([Problem("truth.csv", "", None, "the site has no [[vehicle]] whose truth this could be")])
    columns, vehicles = table.columns, np.array(table.names["vehicle"])
    position_m = np.column_stack([columns["x_m"], columns["y_m"], columns["z_m"]])
    truths = {}
    for vehicle in dict.fromkeys(table.names["vehicle"]):
        rows = vehicles == vehicle
        angles: list[Floats | None] = []
        for name in ("yaw_rad", "roll_rad", "pitch_rad"):
            angle = columns[name][rows] if name in columns else None
            angles.append(np.unwrap(angle) if angle is not None and np.all(np.isfinite(angle)) else None)
        truths[vehicle] = Truth(vehicle, columns["time_s"][rows], position_m[rows], *angles)
    return truths


def read_references(folder: str | Path, site: Site) -> dict[str, ReferenceBurst]:
    """Read the recorded bursts that the site's codes name, by beacon id.

    Raises
    ------
    RecordingError
        Where a file is missing, has several channels, is too long for one burst, or holds no sound.
    """
    problems: list[Problem] = []
    bursts: dict[str, ReferenceBurst] = {}
    for i, beacon in enumerate(site.beacons):
        if isinstance(beacon.code, ReferenceCode):
            name, field = beacon.code.reference, f'beacon {i + 1} "{beacon.id}" code.reference'
            path = Path(folder) / name
            if not path.exists():
                problems.append(Problem(FILE_NAME, field, name, "there is no such file in the recording's folder"))
                continue
            try:
                bursts[beacon.id] = _reference(path, beacon.code, site.signal_of(beacon).carrier_hz)
            except RecordingError as error:
                problems += error.problems
    if problems:
        raise RecordingError(problems)
    return bursts


def _reference(path: Path, code: ReferenceCode, carrier_hz: float) -> ReferenceBurst:
    sound = open_capture(path)
    if sound.channels != 1:
        raise RecordingError(
            [Problem(path.name, "channels", sound.channels, "a reference has one channel; export one")]
        )
    if sound.rate_hz <= 2 * carrier_hz:
        remedy = f"too slow for a carrier of {carrier_hz:g} Hz; more than {2 * carrier_hz:g} is needed"
        raise RecordingError([Problem(path.name, "sample rate", sound.rate_hz, remedy)])
    if sound.sample_count is None or sound.sample_count > LONGEST_REFERENCE_S * sound.rate_hz:
        remedy = f"a reference holds one burst, at most {LONGEST_REFERENCE_S:g} s; cut it"
        raise RecordingError([Problem(path.name, "samples", sound.sample_count, remedy)])
    samples = np.concatenate([block[:, 0] for block in sound.blocks(65536)]).astype(np.float64)
    after = samples[round((code.start_s or 0.0) * sound.rate_hz) :]
    if len(after) < 16:
        remedy = f"holds {len(samples)} samples, of which {len(after)} after start_s; a burst needs 16 at least"
        raise RecordingError([Problem(path.name, "samples", len(after), remedy)])
    if not np.all(np.isfinite(samples)):
        raise RecordingError([Problem(path.name, "samples", "NaN or infinite", "a reference needs sound throughout")])
    if not np.any(after):
        raise RecordingError([Problem(path.name, "samples", "all zero", "a reference needs a burst in it")])
    return ReferenceBurst(samples, sound.rate_hz)


def _range_rows(table: Table, site: Site) -> RangeRows:
    """Ranges as stated, or times of flight with the site's sound speed."""
    columns = table.columns
    if "range_m" in columns:
        range_m, column, speed_sd = columns["range_m"], "range_m", 0.0
    else:
        range_m, column = columns["time_of_flight_s"] * site.sound_speed_mps, "time_of_flight_s"
        speed_sd = site.sound_speed_sd_mps
    if site.schedule is None or site.schedule.synchronised:
        below = np.flatnonzero(range_m < 0)
        if len(below):
            value = float(columns[column][below[0]])
            remedy = f"{len(below)} rows are below 0, which only an unknown clock could explain (synchronised = false)"
            raise RecordingError([Problem("ranges.csv", column, value, remedy)])
    return RangeRows(columns["time_s"], table.names["from"], table.names["to"], range_m, columns.get("sd_m"), speed_sd)


def _exchange_problems(table: Table, site: Site) -> list[Problem]:
    """Tell ends that cannot exchange, once each."""
    problems = []
    for ends in dict.fromkeys(zip(table.names["from"], table.names["to"], strict=True)):
        try:
            replied(site, *ends)
        except ValueError as error:
            problems.append(Problem("exchanges.csv", "from, to", ", ".join(ends), str(error)))
    return problems


def _position_problems(table: Table | None, site: Site) -> list[Problem]:
    """Tell positions of nobody, two of one vehicle at one time, and those without the height that nothing states."""
    if table is None or not len(table.columns["time_s"]):
        return []
    if not site.vehicles:
        return [Problem("positions.csv", "", None, "the site has no [[vehicle]] whose positions these could be")]
    whose = table.names.get("vehicle") or (site.vehicles[0].id,) * len(table.columns["time_s"])
    height_m = table.columns.get("z_m", np.full(len(whose), np.nan))
    open_ones = {v.id for v in site.vehicles if v.z_m is None}
    bare = sorted({name for name, z in zip(whose, height_m, strict=True) if name in open_ones and np.isnan(z)})
    remedy = "has rows without z_m; give it, or state the level z_m of the [[vehicle]] in site.toml"
    problems = [Problem("positions.csv", "vehicle", name, remedy) for name in bare]
    first: dict[tuple[str, float], int] = {}
    for row, at in enumerate(zip(whose, table.columns["time_s"].tolist(), strict=True), 1):
        if first.setdefault(at, row) != row:
            remedy = f"row {first[at]} tells of {at[0]!r} at the same time; keep one of them, or give each its own time"
            return [*problems, Problem("positions.csv", f"row {row}, time_s", at[1], remedy)]
    return problems


def _with_period(site: Site, sync: Table | None) -> Site:
    """Fill in a period that the schedule leaves to the sync file."""
    if site.schedule is None or site.schedule.period_s is not None or sync is None:
        return site
    times: Floats = sync.columns["time_s"]
    if len(times) < 2:
        return site
    schedule = site.schedule.model_copy(update={"period_s": float(np.median(np.diff(times)))})
    return site.model_copy(update={"schedule": schedule})


def _start_problems(start: Table | None) -> list[Problem]:
    vehicles = list(start.names.get("vehicle", ())) if start else []
    twice = sorted({vehicle for vehicle in vehicles if vehicles.count(vehicle) > 1})
    return [Problem("start.csv", "vehicle", vehicle, "has two start poses; keep one row") for vehicle in twice]


def _capture_problems(site: Site, capture: Capture, has_ranges: bool) -> list[Problem]:
    """Judge the capture against the site: channels, codes, schedule, rate."""
    problems: list[Problem] = []
    name = capture.path.name
    for i, microphone in enumerate(site.microphones):
        field = f'microphone {i + 1} "{microphone.id}" channel'
        last = capture.channels - 1
        there = f"{name} has channel 0 only" if not last else f"{name} has channels 0 to {last}"
        if microphone.channel is not None and microphone.channel > last:
            problems.append(Problem(FILE_NAME, field, microphone.channel, there))
        elif microphone.channel is None and not has_ranges:
            problems.append(Problem(FILE_NAME, field, None, f"is missing; {there}"))
    if not site.microphones:
        problems.append(Problem(FILE_NAME, "microphone", None, f"nothing listens to {name}; add a [[microphone]]"))
    if not site.coded_beacons and not has_ranges:
        problems.append(Problem(FILE_NAME, "beacon", None, f"no beacon has a code to look for in {name}; add code"))
    if site.coded_beacons and site.schedule is not None and site.schedule.period_s is None:
        remedy = "is missing; state the time from one epoch to the next, or give two sync instants in sync.csv"
        problems.append(Problem(FILE_NAME, "schedule.period_s", None, remedy))
    needed = 0.0
    for beacon in site.coded_beacons:
        highest = site.signal_of(beacon).carrier_hz
        if isinstance(beacon.code, ChirpCode):
            highest = max(beacon.code.start_hz, beacon.code.stop_hz)
        needed = max(needed, 2 * highest)
    if capture.rate_hz <= needed:
        remedy = f"too slow for sound of {needed / 2:g} Hz; more than {needed:g} is needed"
        problems.append(Problem(name, "sample rate", capture.rate_hz, remedy))
    return problems


__all__ = ["read_recording", "read_references", "read_truth"]
