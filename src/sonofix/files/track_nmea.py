"""A track as NMEA 0183 sentences GGA and RMC, for what otherwise listens to a satellite receiver."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

from sonofix.files.geodesy import on_earth
from sonofix.files.problem import Problem, RecordingError
from sonofix.files.results import column
from sonofix.files.track_tables import positions, velocities
from sonofix.files.writing import write_whole
from sonofix.records import Floats, Table
from sonofix.site import Origin

KNOT_MPS = 1852 / 3600
SLOWEST_MPS = 0.05
"""Slower than this a course is mostly noise, and its field is left empty."""

MINUTE_DIGITS = 7
"""Decimals of minutes: 0.2 mm. With times to the millisecond a sentence stays within the standard's 82 characters."""


def write_nmea(path: Path, track: Table, fixes: Table | None, origin: Origin, zero_ns: int, talker: str = "IN") -> int:
    """Write one vehicle's track: a GGA and an RMC for each row; return the number of rows.

    Quality is 1 (RMC: mode A), and 6 (mode E, estimated) for rows that are `predicted`. In place of satellites stands
    the number of ranges used in the epoch's fix, with its HDOP. Heights are those of the ellipsoid, with a geoid
    separation of 0: their sum is right.

    Parameters
    ----------
    path : Path
    track : Table
        Of one vehicle.
    fixes : Table or None
        Of the same vehicle.
    origin : Origin
    zero_ns : int
        The instant of time 0, UTC, ns since 1970.
    talker : str
        Two letters; "IN" is integrated navigation.

    Raises
    ------
    RecordingError
        Where it cannot be written, or a time lies beyond the calendar.
    ValueError
        If the talker is none.
    """
    if not (len(talker) == 2 and talker.isascii() and talker.isalnum() and talker.isupper()):
        raise ValueError(f"talker {talker!r}: must be two capital letters, such as IN, GP or GN")
    place = positions(track)
    rows = np.flatnonzero(np.isfinite(place).all(axis=1))
    velocity = velocities(track)
    lat, lon, height, there = on_earth(origin, place[rows], velocity[rows])
    times = track.columns["time_s"][rows]
    used, hdop = _of_fixes(fixes, times)
    sources = track.names.get("source", ("",) * len(place))
    lines = []
    for i, row in enumerate(rows.tolist()):
        clock = _clock(path, zero_ns, float(times[i]))
        where = angle_field(lat[i], 2, "NS"), angle_field(lon[i], 3, "EW")
        predicted = sources[row] == "predicted"
        lines.append(
            sentence(
                f"{talker}GGA",
                f"{clock:%H%M%S}.{clock.microsecond // 1000:03d}",
                *where,
                "6" if predicted else "1",
                "" if np.isnan(used[i]) else f"{min(int(used[i]), 99):02d}",
                "" if np.isnan(hdop[i]) else f"{min(hdop[i], 99.9):.1f}",
                f"{height[i]:.3f}",
                "M",
                "0.0",
                "M",
                "",
                "",
            )
        )
        lines.append(
            sentence(
                f"{talker}RMC",
                f"{clock:%H%M%S}.{clock.microsecond // 1000:03d}",
                "A",
                *where,
                *_over_ground(there[i]),
                f"{clock:%d%m%y}",
                "",
                "",
                "E" if predicted else "A",
            )
        )
    write_whole(path, lambda part: part.write_bytes("".join(lines).encode("ascii")))
    return len(rows)


def sentence(*fields: str) -> str:
    """Return a sentence with its checksum (the exclusive or of all between $ and *) and its end of line."""
    text = ",".join(fields)
    return f"${text}*{reduce(xor, text.encode('ascii')):02X}\r\n"


def _clock(path: Path, zero_ns: int, time_s: float) -> datetime:
    """Return the time to the nearest millisecond."""
    milliseconds = round((zero_ns + round(time_s * 1e9)) / 1_000_000)
    try:
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(milliseconds=milliseconds)
    except OverflowError:
        remedy = "lies beyond the calendar; say with --start when time 0 was"
        raise RecordingError([Problem(path.name, "time_s", time_s, remedy)]) from None


def angle_field(degrees: float, width: int, signs: str) -> str:
    """Return an angle as degrees and minutes, rounded as a whole so that minutes stay below 60."""
    scale = 10**MINUTE_DIGITS
    whole, rest = divmod(round(abs(degrees) * 60 * scale), 60 * scale)
    minutes = f"{rest // scale:02d}.{rest % scale:0{MINUTE_DIGITS}d}"
    return f"{whole:0{width}d}{minutes},{signs[int(degrees < 0)]}"


def _over_ground(velocity_mps: Floats) -> tuple[str, str]:
    """Return speed in knots and course in degrees from north, clockwise; empty where they are not known."""
    speed = float(np.hypot(velocity_mps[0], velocity_mps[1]))
    if np.isnan(speed):
        return "", ""
    course = round(float(np.degrees(np.arctan2(velocity_mps[0], velocity_mps[1]))) % 360, 1) % 360
    return f"{speed / KNOT_MPS:.3f}", f"{course:.1f}" if speed >= SLOWEST_MPS else ""


def _of_fixes(fixes: Table | None, times: Floats) -> tuple[Floats, Floats]:
    """Return ranges used and HDOP of the last fix before each time, NaN where that is over an epoch and a half ago."""
    used, hdop = np.full(len(times), np.nan), np.full(len(times), np.nan)
    if fixes is None or not len(fixes.columns["time_s"]):
        return used, hdop
    order = np.argsort(fixes.columns["time_s"], kind="stable")
    at = fixes.columns["time_s"][order]
    period = float(np.median(np.diff(at))) if len(at) > 1 else np.inf
    last = np.searchsorted(at, times + 1e-6, side="right") - 1
    near = (last >= 0) & (times - at[last] <= 1.5 * period)
    used[near] = fixes.columns["used"][order][last[near]]
    hdop[near] = column(fixes, "hdop")[order][last[near]]
    return used, hdop
