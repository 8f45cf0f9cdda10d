"""A bag read into the tables of a recording: odometry, inertial sensors, ranges, and what else is asked for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sonofix.files.bag import Bag, Decoder, Topic
from sonofix.files.bag_map import BY_DEFAULT, USES, TopicMap
from sonofix.files.bag_messages import DAY_NS, Clock, Heard, Timed, seconds, timed
from sonofix.files.bag_rows import MAKE, judge_odometry
from sonofix.files.problem import Problem, RecordingError
from sonofix.records import Floats, RangeRows, Table, Truth
from sonofix.site import Site

LAG_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class TopicReport:
    """What became of a topic: its messages, rows by file stem, and messages left out by reason."""

    name: str
    kind: str
    messages: int
    rows: Mapping[str, int]
    left_out: Mapping[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """What a bag holds of a recording.

    Attributes
    ----------
    source : str
        Name of the bag.
    ranges : RangeRows or None
    tables : mapping from file stem to Table
    truth : mapping from vehicle to Truth
    zero_ns : int
        The instant that is time 0, nanoseconds since 1970 by the bag's clock.
    topics : tuple of TopicReport
    notes : tuple of str
        What is odd, a sentence each.
    """

    source: str
    ranges: RangeRows | None
    tables: Mapping[str, Table]
    truth: Mapping[str, Truth]
    zero_ns: int
    topics: tuple[TopicReport, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """Rows of one file from one topic and frame: whose they are, when (ns), and their columns."""

    topic: str
    stem: str
    whose: tuple[str, ...]
    time_ns: NDArray[np.int64]
    columns: Mapping[str, Floats]


def read_bag(
    path: str | Path,
    site: Site,
    topics: TopicMap | None = None,
    *,
    clock: Clock = "stamp",
    zero_ns: int | None = None,
    on_message: Callable[[int], None] | None = None,
) -> Imported:
    """Read a bag: messages of known types become rows, at the times of their header stamps.

    Frames are those of REP 103, which are ours: body axes forward, left, up; world axes east, north, up.

    Parameters
    ----------
    path : path
        A rosbag2 folder, or a .mcap or .db3 file.
    site : Site
        Names the vehicles, beacons and microphones that topics and frames speak of.
    topics : TopicMap, optional
        What the rules of names do not tell.
    clock : "stamp" or "received"
        Whether rows stand at header stamps, or at the times the recorder received the messages.
    zero_ns : int, optional
        The instant that becomes time 0, in ns since 1970; that of the earliest message taken unless given.
    on_message : callable, optional
        Told after each message taken how many there were.

    Returns
    -------
    Imported

    Raises
    ------
    RecordingError
        With the mistakes found: a bag that cannot be read, nothing in it to take, a topic of which it cannot be told
        whose it is, two topics for one file, clocks that do not fit each other, a time 0 over a day from all messages.
    ValueError
        If rosbags and mcap are not installed.
    """
    topics = topics or TopicMap(site)
    bag = Bag(path)
    file = bag.path.name
    heard = _heard(bag, file, topics, on_message)
    absent = topics.absent(bag.counts)
    if absent:
        raise RecordingError(absent)
    taken = [one for one in heard.values() if one.rows]
    if not taken:
        raise RecordingError([Problem(str(bag.path), "", None, _nothing(bag))])
    times = [timed(file, one, clock) for one in taken]
    notes = [*bag.notes, *(note for time in times for note in time.notes)]
    notes += [f"{one.topic.name} has no messages" for one in heard.values() if not one.rows]
    notes += _one_clock(file, taken, times)
    first_ns = min(int(time.time_ns[time.keep].min()) for time in times)
    if zero_ns is None:
        zero_ns = first_ns
    _near_zero(file, zero_ns, first_ns, max(int(time.time_ns[time.keep].max()) for time in times))
    problems: list[Problem] = []
    reports: dict[Topic, TopicReport] = {}
    pieces: list[_Piece] = []
    for one, time in zip(taken, times, strict=True):
        left_out: Counter[str] = Counter()
        if not np.all(time.keep):
            left_out["wrong stamp"] = int(np.count_nonzero(~time.keep))
        found = list(_pieces(file, one, time, topics, left_out, notes, problems))
        rows = Counter({piece.stem: 0 for piece in found})
        for piece in found:
            rows[piece.stem] += len(piece.time_ns)
        reports[one.topic] = TopicReport(one.topic.name, one.topic.kind, len(one.rows), rows, left_out)
        pieces += found
    problems += _twice(file, pieces)
    if problems:
        raise RecordingError(problems)
    if not any(len(piece.time_ns) for piece in pieces):
        why = "; ".join(f"{r.name}: {_counts(r.left_out)}" for r in reports.values() if r.left_out)
        raise RecordingError([Problem(str(bag.path), "", None, f"no message of it can be used ({why})")])
    tables = {stem: _table(stem, pieces, zero_ns, notes) for stem in dict.fromkeys(p.stem for p in pieces)}
    tables = {stem: table for stem, table in tables.items() if len(table.columns["time_s"])}
    ranges, truth = tables.pop("ranges", None), tables.pop("truth", None)
    untouched = (TopicReport(t.name, t.kind, count, {}, {}) for t, count in bag.counts.items() if t not in reports)
    return Imported(
        source=file,
        ranges=None if ranges is None else _range_rows(ranges),
        tables=tables,
        truth={} if truth is None else _truths(truth),
        zero_ns=zero_ns,
        topics=tuple(sorted((*reports.values(), *untouched), key=lambda report: report.name)),
        notes=tuple(notes),
    )


def _heard(bag: Bag, file: str, topics: TopicMap, on_message: Callable[[int], None] | None) -> dict[Topic, Heard]:
    heard: dict[Topic, Heard] = {}
    decoders: dict[Topic, Decoder] = {}

    def wanted(topic: Topic) -> bool:
        if not topics.uses(topic):
            return False
        heard.setdefault(topic, Heard(topic))
        return True

    for count, (topic, received_ns, data) in enumerate(bag.messages(wanted), 1):
        if topic not in decoders:
            decoders[topic] = Decoder(file, topic)
        heard[topic].take(file, received_ns, decoders[topic].decode(data))
        if on_message is not None:
            on_message(count)
    return heard


def _nothing(bag: Bag) -> str:
    kinds = ", ".join(kind for kind, uses in USES.items() if set(uses) & set(BY_DEFAULT))
    there = ", ".join(f"{count} {topic.name} ({topic.kind})" for topic, count in bag.counts.items())
    return f"holds nothing to take; its messages are {there or 'none'}; read are {kinds}, and others by a --map"


def _one_clock(file: str, taken: list[Heard], times: list[Timed]) -> Iterator[str]:
    """Refuse topics whose stamps are of different clocks; note those that are received unlike late."""
    middle = [int(np.median(time.time_ns[time.keep])) for time in times]
    span = max(int(np.ptp(np.array(one.received_ns, np.int64))) for one in taken)
    low, high = int(np.argmin(middle)), int(np.argmax(middle))
    if middle[high] - middle[low] > DAY_NS + 10 * span:
        remedy = (
            f"and {taken[low].topic.name} is stamped around {seconds(middle[low])}: two clocks; "
            "leave one out by a --map, or take times of receipt with --clock received"
        )
        field = f"{taken[high].topic.name}, header.stamp"
        raise RecordingError([Problem(file, field, seconds(middle[high]), remedy)])
    early, late = (choose(range(len(times)), key=lambda i: times[i].lag_ns) for choose in (min, max))
    if times[late].lag_ns - times[early].lag_ns > LAG_NS:
        lags = [f"{taken[i].topic.name} {times[i].lag_ns / 1e9:.3f} s" for i in (late, early)]
        yield f"messages come {' and '.join(lags)} after their stamps: are both of one clock?"


def _near_zero(file: str, zero_ns: int, first_ns: int, last_ns: int) -> None:
    """Refuse a time 0 further than a day from all messages, or one that is no int64."""
    near = first_ns - DAY_NS <= zero_ns <= last_ns + DAY_NS
    if near and abs(zero_ns) < 2**63:
        return
    remedy = (
        f"lies over a day from the messages, the earliest of which is of {seconds(first_ns)} s; say when time 0 was by "
        "their clock, in s since 1970; where the folder's import.toml holds it, import to a new folder"
    )
    raise RecordingError([Problem(file, "--zero", str(Decimal(zero_ns) / 1_000_000_000), remedy)])


def _pieces(
    file: str,
    heard: Heard,
    time: Timed,
    topics: TopicMap,
    left_out: Counter[str],
    notes: list[str],
    problems: list[Problem],
) -> Iterator[_Piece]:
    """Yield a topic's rows, by frame and file."""
    columns, topic = heard.columns(), heard.topic
    frames = np.array(heard.frames)
    for frame in dict.fromkeys(heard.frames):
        mine = time.keep & (frames == frame)
        for stem in topics.uses_of(topic, frame):
            whose = _whose(file, topic, frame, stem, topics, problems)
            if whose is None:
                continue
            here = {name: values[mine] for name, values in columns.items()}
            made, keep = MAKE[stem](topics.site, here, left_out)
            if stem == "odometry":
                judge_odometry(file, topic.name, here, notes, problems)
            kept = {name: values[keep] for name, values in made.items()}
            yield _Piece(topic.name, stem, whose, time.time_ns[mine][keep], kept)


def _whose(
    file: str, topic: Topic, frame: str, stem: str, topics: TopicMap, problems: list[Problem]
) -> tuple[str, ...] | None:
    """Return the vehicle or the pair that rows are of; where it cannot be told note the problem and return None."""
    if stem == "temperature":
        return ()
    if stem == "ranges":
        pair = topics.pair(topic, frame)
        key, ask, say = "header.frame_id", "beacon and which microphone", 'from = "…"  to = "…"'
        ids = [*(b.id for b in topics.site.beacons), *(m.id for m in topics.site.microphones)]
    else:
        vehicle = topics.vehicle(topic, frame)
        pair = None if vehicle is None else (vehicle,)
        key = "child_frame_id" if topic.kind.endswith("/Odometry") else "header.frame_id"
        ask, say = "vehicle", 'vehicle = "…"'
        ids = [v.id for v in topics.site.vehicles]
    if pair is None:
        known = f"the site has {', '.join(ids[:8])}{', …' if len(ids) > 8 else ''}" if ids else "the site has none"
        told = f'[[topic]]  name = "{topic.name}"  frame = "{frame}"  {say}, or as = [] to leave it out'
        remedy = f"of which {ask} does this tell? {known}; say so in a --map: {told}"
        problems.append(Problem(file, f"{topic.name}, {key}", frame, remedy))
    return pair


def _twice(file: str, pieces: list[_Piece]) -> Iterator[Problem]:
    """Yield a problem for each file and vehicle (or pair) of which two topics tell."""
    first: dict[tuple[str, tuple[str, ...]], str] = {}
    told: set[tuple[str, str, str]] = set()
    for piece in pieces:
        other = first.setdefault((piece.stem, piece.whose), piece.topic)
        if other != piece.topic and (piece.stem, other, piece.topic) not in told:
            told.add((piece.stem, other, piece.topic))
            of = f" of {' to '.join(piece.whose)}" if piece.whose else ""
            remedy = f"{piece.topic} tells {piece.stem}.csv{of} as well; leave one out by a --map (as = [])"
            yield Problem(file, other, None, remedy)


def _table(stem: str, pieces: list[_Piece], zero_ns: int, notes: list[str]) -> Table:
    """Join the pieces of one file in order of time; of rows with one time and owner the first stays."""
    mine = [piece for piece in pieces if piece.stem == stem]
    time_ns = np.concatenate([piece.time_ns for piece in mine])
    whose = list(chain.from_iterable([piece.whose] * len(piece.time_ns) for piece in mine))
    order = np.argsort(time_ns, kind="stable")
    seen: set[tuple[int, tuple[str, ...]]] = set()
    rows = []
    for i in order.tolist():
        key = int(time_ns[i]), whose[i]
        if key not in seen:
            seen.add(key)
            rows.append(i)
    if len(rows) < len(order):
        notes.append(
            f"{stem}: {len(order) - len(rows)} of {len(order)} messages had the time of another and are left out"
        )
    columns: dict[str, Floats] = {"time_s": (time_ns[rows] - zero_ns) / 1e9}
    columns |= {name: np.concatenate([piece.columns[name] for piece in mine])[rows] for name in mine[0].columns}
    keys = {"ranges": ("from", "to"), "temperature": ()}.get(stem, ("vehicle",))
    return Table(columns, {key: tuple(whose[i][k] for i in rows) for k, key in enumerate(keys)})


def _range_rows(table: Table) -> RangeRows:
    sd_m = table.columns["sd_m"]
    known = bool(np.any(np.isfinite(sd_m)))
    names = table.names
    return RangeRows(
        table.columns["time_s"], names["from"], names["to"], table.columns["range_m"], sd_m if known else None
    )


def _truths(table: Table) -> dict[str, Truth]:
    columns, vehicles = table.columns, np.array(table.names["vehicle"])
    truths = {}
    for vehicle in dict.fromkeys(table.names["vehicle"]):
        rows = vehicles == vehicle
        yaw = columns["yaw_rad"][rows]
        place = np.column_stack([columns[axis][rows] for axis in ("x_m", "y_m", "z_m")])
        known = bool(np.all(np.isfinite(yaw)))
        truths[vehicle] = Truth(vehicle, columns["time_s"][rows], place, np.unwrap(yaw) if known else None)
    return truths


def _counts(left_out: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in left_out.items())
