"""`sonofix export`: the track of a run in the form that other programs read."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import Stopped, counted, speaker

if TYPE_CHECKING:
    from sonofix.records import Table
    from sonofix.site import Origin, Site


_YEAR_2000_NS = 946_684_800_000_000_000


class Form(StrEnum):
    """What a track can be written as."""

    tum = "tum"
    mcap = "mcap"
    parquet = "parquet"
    nmea = "nmea"


def export(
    recording: Annotated[Path, typer.Argument(help="Recording folder: its site.toml names vehicles and origin.")],
    form: Annotated[Form, typer.Option("--as", help="What to write.")],
    track: Annotated[
        Path | None,
        typer.Argument(help="Folder that `sonofix run` wrote, or a track.csv. [default: out/ in the recording]"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="File to write. [default: beside the track, named like it]")
    ] = None,
    vehicle: Annotated[str | None, typer.Option(help="This vehicle alone.")] = None,
    start: Annotated[
        str | None,
        typer.Option(help="When time 0 was, UTC: 2026-01-31T12:00:00Z. [default: what `sonofix import` noted]"),
    ] = None,
    frame: Annotated[str, typer.Option(help="MCAP: the frame_id of the site's frame.")] = "map",
    talker: Annotated[str, typer.Option(help="NMEA: the two letters that sentences begin with.")] = "IN",
    force: Annotated[bool, typer.Option("--force", help="Replace a file named by -o that is there already.")] = False,
) -> None:
    """Write a track as TUM, MCAP, Parquet or NMEA.

    TUM and NMEA know no names: of several vehicles each has its file, track-ID.nmea. For example:

    sonofix export hall --as mcap

    sonofix export hall --as nmea --start 2026-01-31T12:00:00Z

    sonofix export hall smooth/track.csv --as parquet -o lap.parquet

    MCAP needs the extra robotics, Parquet the extra parquet: pip install 'sonofix[robotics,parquet]'. NMEA needs an
    [origin] in the site file, and to know when time 0 was.
    """
    from sonofix import files
    from sonofix.files.results import by_vehicle, read_track

    site = files.read_site(recording / "site.toml")
    source = _track_file(recording, track)
    table = read_track(source, site)
    if not len(table.columns["time_s"]):
        raise files.RecordingError([files.Problem(str(source), "", None, "has no rows below its first line")])
    tracks = dict(by_vehicle(table))
    if vehicle is not None:
        if vehicle not in tracks:
            raise ValueError(f"--vehicle {vehicle}: {source} has no row of it; it has {', '.join(tracks)}")
        table, tracks = tracks[vehicle], {vehicle: tracks[vehicle]}
    alone = len(site.vehicles) < 2 or (out is not None and len(tracks) == 1)
    single = form in (Form.mcap, Form.parquet) or alone
    if out is not None and not single:
        raise ValueError(
            f"-o {out}: {form.value} holds one vehicle a file; choose one with --vehicle, or leave -o away"
        )
    target = out or source.with_suffix(f".{form.value}")
    parts = {target: table}
    if not single:
        names = _file_names([one.id for one in site.vehicles])
        parts = {target.with_stem(f"{target.stem}-{names[name]}"): rows for name, rows in tracks.items()}
    for path in parts:
        if out is not None and path.exists() and not force:
            remedy = "is a folder; name a file" if path.is_dir() else "is there already; give --force to replace it"
            raise files.RecordingError([files.Problem(str(path), "", None, remedy)])
    zero_ns = _zero_ns(recording, start)
    if form is Form.nmea:
        _nmea_needs(site, recording, zero_ns, start)
    try:
        for path, rows in parts.items():
            count, what = _write(form, path, rows, source, site, recording, zero_ns, frame, talker)
            speaker().print(f"{path}: {counted(count, what)}")
    except KeyboardInterrupt:
        raise Stopped("stopped; files that are there are whole") from None


def _track_file(recording: Path, track: Path | None) -> Path:
    place = track or recording / "out"
    return place / "track.csv" if place.is_dir() or not place.suffix else place


def _file_names(vehicles: list[str]) -> dict[str, str]:
    """Return each vehicle's part of file names, no two alike."""
    from sonofix.files.results import plain_name

    names: dict[str, str] = {}
    for vehicle in vehicles:
        name = plain_name(vehicle)
        while name in names.values():
            name += "_"
        names[vehicle] = name
    return names


def _zero_ns(recording: Path, start: str | None) -> int | None:
    """Return when time 0 was, ns since 1970, as given or as an import noted."""
    from datetime import UTC, datetime, timedelta

    from sonofix.files.import_writing import read_zero

    if start is None:
        return read_zero(recording)
    try:
        moment = datetime.fromisoformat(start)
    except ValueError:
        raise ValueError(f"--start {start}: must be a time such as 2026-01-31T12:00:00Z") from None
    if moment.tzinfo is None:
        raise ValueError(f"--start {start}: end it with Z where it is UTC, or with its offset from UTC, such as +01:00")
    return (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


def _nmea_needs(site: Site, recording: Path, zero_ns: int | None, start: str | None = None) -> tuple[Origin, int]:
    """Return the site's origin and when time 0 was, without which there is no NMEA."""
    from sonofix import files

    if site.origin is None:
        remedy = "is missing; NMEA needs to know where on Earth the site lies: latitude_deg, longitude_deg"
        raise files.RecordingError([files.Problem(str(recording / "site.toml"), "origin", None, remedy)])
    if zero_ns is None:
        raise ValueError("NMEA states the time of day: say with --start when time 0 was, such as 2026-01-31T12:00:00Z")
    if zero_ns < _YEAR_2000_NS and start is not None:
        raise ValueError(f"--start {start}: NMEA states years by two digits, from 2000 on; say when time 0 really was")
    if zero_ns < _YEAR_2000_NS:
        remedy = "is no time of day, but a clock that began near 0 (a simulation's?); say with --start when time 0 was"
        raise files.RecordingError([files.Problem(str(recording / "import.toml"), "zero_ns", zero_ns, remedy)])
    return site.origin, zero_ns


def _write(
    form: Form,
    path: Path,
    track: Table,
    source: Path,
    site: Site,
    recording: Path,
    zero_ns: int | None,
    frame: str,
    talker: str,
) -> tuple[int, str]:
    """Write one file; return how many of what it holds."""
    match form:
        case Form.tum:
            from sonofix.files.track_tables import write_tum

            return write_tum(path, track), "row"
        case Form.parquet:
            from sonofix.files.track_tables import write_parquet

            return write_parquet(path, track, zero_ns), "row"
        case Form.mcap:
            from sonofix.files.track_mcap import write_mcap

            return write_mcap(path, track, zero_ns or 0, frame), "message"
        case Form.nmea:
            from sonofix.files.results import by_vehicle, read_fixes
            from sonofix.files.track_nmea import write_nmea

            fixes = read_fixes(source.with_name("fixes.csv"))
            if fixes is not None and "vehicle" in fixes.names:
                fixes = dict(by_vehicle(fixes)).get(track.names["vehicle"][0])
            origin, zero_ns = _nmea_needs(site, recording, zero_ns)
            return write_nmea(path, track, fixes, origin, zero_ns, talker), "position"
