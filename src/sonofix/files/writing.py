"""What a run writes: ranges, fixes, track, events and TUM trajectories, row by row while it goes on."""

from __future__ import annotations

import csv
import heapq
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

import numpy as np
from numpy.typing import NDArray

from sonofix.attitude import quaternion
from sonofix.files.problem import Problem, RecordingError
from sonofix.files.results import plain_name
from sonofix.records import Estimate, Event, Exchange, Fix, RangeEpoch, Step
from sonofix.site import Site

COLUMNS = {
    "ranges.csv": "time_s,from,to,range_m,sd_m,range_rate_mps,range_rate_sd_mps,snr_db,clock_offset_m,used",
    "fixes.csv": "time_s,vehicle,status,x_m,y_m,z_m,yaw_rad,clock_offset_m,cxx_m2,cxy_m2,cyy_m2,czz_m2,"
    "hdop,vdop,hpl_m,vpl_m,heard,used,excluded",
    "track.csv": "time_s,vehicle,x_m,y_m,z_m,vx_mps,vy_mps,vz_mps,yaw_rad,sd_x_m,sd_y_m,sd_z_m,sd_yaw_rad,source",
    "events.csv": "time_s,vehicle,event,detail",
    "innovations.csv": "time_s,rows,nis",
}

EXCHANGE_COLUMNS = (
    *("from", "to", "sent_s", "heard_s", "reply_sent_s", "reply_heard_s"),
    *("heard_sd_s", "reply_heard_sd_s"),
)
"""What exchanges.csv has, which only sites with clocks of their own come with."""

TILT_COLUMNS = "roll_rad,pitch_rad,sd_roll_rad,sd_pitch_rad"
"""What fixes.csv and track.csv have behind these where a vehicle of the site tilts."""


def write_run(out: str | Path, steps: Iterable[Step], site: Site) -> None:
    """Write all steps of a run to the folder `out`; each row as soon as its step is there.

    Raises
    ------
    RecordingError
        Where the folder cannot be written to, or is itself a recording.
    """
    with RunWriter(out, site) as writer:
        for step in steps:
            writer.write(step)


def write_track(out: str | Path, steps: Iterable[Step], site: Site) -> None:
    """Write the track of a run anew, its other files left as they are; each file whole or not at all.

    Raises
    ------
    RecordingError
        Where it cannot be written.
    """
    found = sorted((estimate for step in steps for estimate in step.estimates), key=lambda estimate: estimate.time_s)

    def write(name: str, header: list[str] | None, separator: str, rows: list[tuple[float, list[str]]]) -> None:
        def make(path: Path) -> None:
            file = _RowFile(path, header, separator)
            try:
                file.add(rows)
                file.release(math.inf)
                file.close()
            finally:
                file.abandon()

        write_whole(Path(out) / name, make)

    tilts = _tilts(site)
    write("track.csv", _header("track.csv", tilts), ",", [(e.time_s, _track_row(e, tilts)) for e in found])
    for vehicle in site.vehicles:
        rows = [(e.time_s, _tum_row(e)) for e in found if e.vehicle == vehicle.id]
        write(_tum_name(site, vehicle.id), None, " ", rows)


class RunWriter:
    """The files of one run, as a context manager; `write` takes the steps in their order.

    Rows of one file stand in order of time: a row is held back only while a later epoch could still come before it, and
    leaving the context writes what is held, also after Ctrl-C. Unknown values are empty cells.

    Parameters
    ----------
    out : path
        Folder to write into; made where it does not exist. Earlier outputs there are replaced.
    site : Site
        Of the recording: it tells which ranges speak of which vehicle.

    Raises
    ------
    RecordingError
        Where the folder cannot be written to, or is itself a recording; `write` where the disk is full.
    """

    def __init__(self, out: str | Path, site: Site) -> None:
        self.out = Path(out)
        self._site = site
        self._rides = {
            "emitter": {beacon.id: beacon.vehicle for beacon in site.beacons},
            "receiver": {microphone.id: microphone.vehicle for microphone in site.microphones},
        }
        self._files: dict[str, _RowFile] = {}
        self._last_sync_s: float | None = None
        self._tilts = _tilts(site)

    def __enter__(self) -> Self:
        """Make the folder and its files, with their first lines."""
        if (self.out / "site.toml").exists():
            remedy = "is a recording, whose own files would be overwritten; write to another folder with -o"
            raise RecordingError([Problem(str(self.out), "", None, remedy)])
        if self.out.exists() and not self.out.is_dir():
            raise RecordingError([Problem(str(self.out), "", None, "is a file; give a folder with -o")])
        with told(self.out, ""):
            self.out.mkdir(parents=True, exist_ok=True)
        try:
            for name in COLUMNS:
                self._files[name] = _RowFile(self.out / name, _header(name, self._tilts), ",")
            if self._site.own_clocks:
                self._files["exchanges.csv"] = _RowFile(self.out / "exchanges.csv", [*EXCHANGE_COLUMNS], ",")
            for vehicle in self._site.vehicles:
                self._files[f"tum {vehicle.id}"] = _RowFile(self.out / _tum_name(self._site, vehicle.id), None, " ")
        except BaseException:
            self._abandon()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write what is held back, and close."""
        if isinstance(error, RecordingError):
            self._abandon()
            return
        try:
            for file in self._files.values():
                file.release(math.inf)
                file.close()
        finally:
            self._abandon()

    def write(self, step: Step) -> None:
        """Write what one epoch brought.

        Raises
        ------
        RecordingError
            Where it cannot be written, a full disk for example.
        """
        sync_s = step.ranges.sync_s
        self._files["ranges.csv"].add(_range_rows(step))
        self._files["fixes.csv"].add((fix.time_s, self._fix_row(fix, step.ranges)) for fix in step.fixes)
        self._files["track.csv"].add(
            (estimate.time_s, _track_row(estimate, self._tilts)) for estimate in step.estimates
        )
        if step.exchanges and "exchanges.csv" in self._files:
            self._files["exchanges.csv"].add((sync_s, _exchange_row(exchange)) for exchange in step.exchanges)
        self._files["innovations.csv"].add(
            (one.time_s, [_time(one.time_s), str(one.rows), _figure(one.nis)]) for one in step.innovations
        )
        self._files["events.csv"].add((event.time_s, _event_row(event)) for event in step.events)
        for estimate in step.estimates:
            key = f"tum {estimate.vehicle}"
            if key not in self._files:
                self._files[key] = _RowFile(self.out / _tum_name(self._site, estimate.vehicle), None, " ")
            self._files[key].add([(estimate.time_s, _tum_row(estimate))])
        # Sound that is heard after the next epoch began may come after that epoch's first rows.
        final_s = -math.inf if self._last_sync_s is None else 2 * sync_s - self._last_sync_s
        self._last_sync_s = sync_s
        for file in self._files.values():
            file.release(final_s)

    def _fix_row(self, fix: Fix, ranges: RangeEpoch) -> list[str]:
        heard = self._concerns(fix.vehicle, ranges)
        used = int(np.count_nonzero(fix.used))
        excluded = int(np.count_nonzero(heard)) - used if fix.position_m is not None else 0
        position = fix.position_m if fix.position_m is not None else (None, None, None)
        return [
            _time(fix.time_s),
            fix.vehicle,
            fix.status,
            *(_length(value) for value in position),
            _angle(fix.yaw_rad),
            _length(fix.clock_offset_m),
            *(_figure(_covariance(fix, a, b)) for a, b in ("xx", "xy", "yy", "zz")),
            *(_figure(value) for value in (fix.hdop, fix.vdop, fix.hpl_m, fix.vpl_m)),
            *map(str, (int(np.count_nonzero(heard)), used, excluded)),
            *(_tilt(fix) if self._tilts else ()),
        ]

    def _concerns(self, vehicle: str, ranges: RangeEpoch) -> NDArray[np.bool_]:
        """Say of each row whether one of its ends rides on the vehicle."""
        ends = zip(ranges.emitter, ranges.receiver, strict=True)
        rides = self._rides["emitter"], self._rides["receiver"]
        return np.array([vehicle in (rides[0].get(a), rides[1].get(b)) for a, b in ends], dtype=bool)

    def _abandon(self) -> None:
        for file in self._files.values():
            file.abandon()


def _tilts(site: Site) -> bool:
    """Whether a vehicle of the site tilts."""
    from sonofix.geometry import tilting

    return bool(tilting(site).any())


def _header(name: str, tilts: bool) -> list[str]:
    """Names of a file's columns."""
    behind = f",{TILT_COLUMNS}" if tilts and name in ("fixes.csv", "track.csv") else ""
    return f"{COLUMNS[name]}{behind}".split(",")


def _track_row(estimate: Estimate, tilts: bool) -> list[str]:
    return [
        _time(estimate.time_s),
        estimate.vehicle,
        *(_length(value) for value in estimate.position_m),
        *(_length(value) for value in estimate.velocity_mps),
        _angle(estimate.yaw_rad),
        *(_figure(estimate.sd(state)) for state in ("x", "y", "z", "yaw")),
        estimate.source,
        *(_tilt(estimate) if tilts else ()),
    ]


def _tilt(of: Fix | Estimate) -> list[str]:
    """Cells of `TILT_COLUMNS`."""
    return [_angle(of.roll_rad), _angle(of.pitch_rad), *(_figure(of.sd(state)) for state in ("roll", "pitch"))]


class _RowFile:
    """A text file of rows in order of time; every released row is on its way to the disk when `release` returns."""

    def __init__(self, path: Path, header: list[str] | None, separator: str) -> None:
        self._path = path
        self._held: list[tuple[float, int, list[str]]] = []
        self._count = 0
        with told(path.parent, path.name):
            self._file: TextIO = path.open("w", newline="", encoding="utf-8")
        self._rows = csv.writer(self._file, delimiter=separator, lineterminator="\n")
        try:
            if header:
                with told(path.parent, path.name):
                    self._rows.writerow(header)
                    self._file.flush()
        except RecordingError:
            self.abandon()
            raise

    def add(self, rows: Iterable[tuple[float, list[str]]]) -> None:
        """Take rows with their times; equal times keep the order they came in."""
        for time_s, row in rows:
            heapq.heappush(self._held, (time_s, self._count, row))
            self._count += 1

    def release(self, before_s: float) -> None:
        """Write the rows that stand before a time."""
        with told(self._path.parent, self._path.name):
            wrote = False
            while self._held and self._held[0][0] < before_s:
                self._rows.writerow(heapq.heappop(self._held)[2])
                wrote = True
            if wrote:
                self._file.flush()

    def close(self) -> None:
        """Close the file; a disk that is full shows here at the latest."""
        with told(self._path.parent, self._path.name):
            self._file.close()

    def abandon(self) -> None:
        """Close the file whatever may come of it."""
        with suppress(OSError):
            self._file.close()


def results_folder(out: str | Path) -> Path:
    """Make the folder that a command's results go to.

    Raises
    ------
    RecordingError
        Where it is a recording itself, or a file, or cannot be made.
    """
    out = Path(out)
    if (out / "site.toml").exists():
        remedy = "is a recording, whose own files might be overwritten; write to another folder with -o"
        raise RecordingError([Problem(str(out), "", None, remedy)])
    if out.exists() and not out.is_dir():
        raise RecordingError([Problem(str(out), "", None, "is a file; give a folder with -o")])
    with told(out, ""):
        out.mkdir(parents=True, exist_ok=True)
    return out


def write_whole(path: Path, make: Callable[[Path], object]) -> None:
    """Let ``make`` write a file under another name, then give it its own: it is there whole or not at all.

    Raises
    ------
    RecordingError
        Where it cannot be written.
    """
    with told(path.parent, path.name):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{path.name}.part")
        try:
            make(part)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file by `write_whole`."""
    write_whole(path, lambda part: part.write_text(text, encoding="utf-8"))


@contextmanager
def told(folder: Path, name: str) -> Iterator[None]:
    """Turn an error of the operating system into one line for the user."""
    try:
        yield
    except OSError as error:
        where = str(folder / name) if name else str(folder)
        remedy = f"cannot be written: {error.strerror or error}; make room or choose another folder with -o"
        raise RecordingError([Problem(where, "", None, remedy)]) from None


def _range_rows(step: Step) -> Iterator[tuple[float, list[str]]]:
    ranges = step.ranges
    sd_m = np.sqrt(np.diag(ranges.covariance_m2)) if len(ranges) else np.zeros(0)
    for i in range(len(ranges)):
        rates = (ranges.range_rate_mps, ranges.range_rate_sd_mps, ranges.snr_db)
        yield (
            float(ranges.time_s[i]),
            [
                _time(ranges.time_s[i]),
                ranges.emitter[i],
                ranges.receiver[i],
                _length(ranges.range_m[i]),
                _figure(sd_m[i]),
                *(_figure(None if values is None else values[i]) for values in rates),
                _length(step.range_clock_offset_m[i]),
                str(int(step.range_used[i])),
            ],
        )


def _exchange_row(exchange: Exchange) -> list[str]:
    e = exchange
    stamps = (e.sent_s, e.heard_s, e.reply_sent_s, e.reply_heard_s)
    return [e.emitter, e.receiver, *map(_time, stamps), *map(_figure, (e.heard_sd_s, e.reply_heard_sd_s))]


def _tum_row(estimate: Estimate) -> list[str]:
    turned = quaternion(estimate.roll_rad or 0.0, estimate.pitch_rad or 0.0, estimate.yaw_rad or 0.0)
    return tum_row(estimate.time_s, estimate.position_m, turned)


def tum_row(time_s: float, place_m: Iterable[float], turned: Iterable[float]) -> list[str]:
    """Return `timestamp tx ty tz qx qy qz qw`; an angle that is not known is written as none turned."""
    place = (format(float(value), ".6f") for value in place_m)
    return [_time(time_s), *place, *(format(float(part), ".9f") if part else "0" for part in turned)]


def _event_row(event: Event) -> list[str]:
    return [_time(event.time_s), event.vehicle, event.event, " ".join(event.detail.split())]


def _covariance(fix: Fix, a: str, b: str) -> float | None:
    if fix.covariance is None or a not in fix.states or b not in fix.states:
        return None
    return float(fix.covariance[fix.states.index(a), fix.states.index(b)])


def _tum_name(site: Site, vehicle: str) -> str:
    return "track.tum" if len(site.vehicles) < 2 else f"track-{plain_name(vehicle)}.tum"


def _cell(value: float | None, form: str) -> str:
    return "" if value is None or not math.isfinite(value) else format(float(value), form)


def _time(value: float) -> str:
    return _cell(value, ".9f")


def _length(value: float | None) -> str:
    return _cell(value, ".6f")


def _angle(value: float | None) -> str:
    return _cell(value, ".6f")


def _figure(value: float | None) -> str:
    return _cell(value, ".6g")
