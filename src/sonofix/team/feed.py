"""What a team's filter takes in: a recording's odometry, ranges, bearings and compasses as arrays."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.ranging import pair_biases
from sonofix.records import Floats, RangeRows, Recording, Table
from sonofix.site import Site
from sonofix.track.wheels import STANDING_MPS, UNSEEN_RAD

SIGHTING, COMPASS, UNHEARD = range(3)

BESIDE_M = 0.3
"""Fixed ends that stand nearer to one another are seen the same way: less than what stands in between is wide."""


@dataclass(frozen=True, slots=True, eq=False)
class Feed:
    """All that a team's robots told, of V robots.

    Attributes
    ----------
    robots : tuple of str
    level_m : float64 (V,)
        Height of each robot's origin.
    first : int64 (V + 1,)
        Where each robot's rows of odometry begin.
    odometry_s, odometry : float64 (k,), (k, 3)
        Their times; speed (m/s) and yaw rate (rad/s), held until the robot's next row; and the variance (rad²) of what
        it may have turned unseen before that: one that drives off from rest, where a compass tells its heading.
    time_s : float64 (n,)
        When each row was heard, in order.
    kind : int64 (n,)
        `SIGHTING`, `COMPASS` (``bearing_rad`` then is the listener's heading), or `UNHEARD`: not to be believed.
    listener, source : int64 (n,)
        Robots; −1: fixed in place.
    listener_point, source_point : float64 (n, 3)
        Place of a fixed end, lever arm (forward, left) and height in the frame of a mounted one.
    range_m, range_sd_m, bearing_rad : float64 (n,)
        NaN where not measured, or not stated.
    pair : int64 (n,)
        Number of its pair of ends.
    view : int64 (n,)
        Number of its view: pairs of which one end is the same and the others are fixed within `BESIDE_M` share one.
    ends : tuple of (emitter, receiver), length n
        Ids, as the recording has them.
    own_ranges : bool
        Ranges are this receiver's own, whose deviations are to be believed.
    sound_speed_mps : float
    starts : mapping from robot index to (x, y, yaw)
    scale_sd : float
        Deviation of the share by which all own ranges may be too long at once, as the sound speed is off;
        ``range_sd_m`` does not hold it.
    """

    robots: tuple[str, ...]
    level_m: Floats
    first: NDArray[np.int64]
    odometry_s: Floats
    odometry: Floats
    time_s: Floats
    kind: NDArray[np.int64]
    listener: NDArray[np.int64]
    source: NDArray[np.int64]
    listener_point: Floats
    source_point: Floats
    range_m: Floats
    range_sd_m: Floats
    bearing_rad: Floats
    pair: NDArray[np.int64]
    view: NDArray[np.int64]
    ends: tuple[tuple[str, str], ...]
    own_ranges: bool
    sound_speed_mps: float
    starts: dict[int, tuple[float, float, float]]
    scale_sd: float = 0.0

    @property
    def views(self) -> int:
        """How many views there are."""
        return int(self.view.max()) + 1 if len(self.view) else 0

    @property
    def of_fixed(self) -> NDArray[np.bool_]:
        """Which rows are sightings with a fixed end."""
        return (self.kind == SIGHTING) & ((self.listener < 0) | (self.source < 0))

    @property
    def stated_sd_m(self) -> float:
        """The median deviation that ranges state; NaN where one of them states none."""
        sd_m = self.range_sd_m[np.isfinite(self.range_m)]
        return float(np.median(sd_m)) if len(sd_m) and np.isfinite(sd_m).all() else np.nan

    def keep(self, rows: NDArray[np.bool_]) -> Feed:
        """Return the feed with some of its rows alone."""
        cut = {
            name: getattr(self, name)[rows]
            for name in (
                "time_s",
                "kind",
                "listener",
                "source",
                "listener_point",
                "source_point",
                "range_m",
                "range_sd_m",
                "bearing_rad",
                "pair",
                "view",
            )
        }
        return replace(self, **cut, ends=tuple(e for e, kept in zip(self.ends, rows.tolist(), strict=True) if kept))

    def without(self, starts: Collection[int], pairs: Collection[int]) -> Feed:
        """Return the feed without the stated starts of some robots, and with what came of some pairs unheard."""
        kind = np.where(np.isin(self.pair, list(pairs)), UNHEARD, self.kind)
        left = {robot: start for robot, start in self.starts.items() if robot not in starts}
        return replace(self, kind=kind, starts=left)


def gather(recording: Recording, ranges: RangeRows | None = None, own_ranges: bool = False) -> Feed:
    """Bring a recording of several robots into arrays.

    Parameters
    ----------
    recording : Recording
    ranges : RangeRows or None
        In place of the recording's own, which it may lack; what the site states of pairs' biases is off already.
    own_ranges : bool
        See `Feed`.

    Raises
    ------
    ValueError
        If no robot has odometry, nothing was heard, or all of one was before all of the other.
    """
    site = recording.site
    robots = tuple(vehicle.id for vehicle in site.vehicles)
    level = np.array([vehicle.z_m or 0.0 for vehicle in site.vehicles])
    compass = recording.tables.get("compass")
    headed = () if compass is None else compass.names.get("vehicle") or robots[:1]
    first, odometry_s, odometry = _odometry(recording.tables.get("odometry"), robots, frozenset(headed))
    if not len(odometry_s):
        raise ValueError("odometry.csv: a team is carried by the odometry of its robots, and there is none")
    heard = ranges if ranges is not None or recording.ranges is None else _unbiased(recording.ranges, site)
    rows = _sightings(heard, recording.tables.get("bearings"))
    if not rows:
        raise ValueError("ranges.csv, bearings.csv: neither has a row, so no robot can be placed")
    _check_times(recording, ranges is not None, odometry_s, np.array([row[0] for row in rows]))
    if compass is not None:
        whose = compass.names.get("vehicle") or (robots[0],) * len(compass.columns["time_s"])
        told = compass.columns
        rows += [
            (float(t), COMPASS, name, name, np.nan, np.nan, float(heading))
            for t, name, heading in zip(told["time_s"], whose, told["heading_rad"], strict=True)
            if np.isfinite(heading)
        ]
    rows.sort(key=lambda row: row[0])
    ends = tuple((row[2], row[3]) for row in rows)
    numbers = {end: i for i, end in enumerate(dict.fromkeys(ends))}
    place = {end: _ends(site, robots, level, end) for end in numbers}
    kind = np.array([row[1] for row in rows], np.int64)
    listener = np.array(
        [place[end][0] if k == SIGHTING else robots.index(end[1]) for end, k in zip(ends, kind, strict=True)]
    )
    return Feed(
        robots=robots,
        level_m=level,
        first=first,
        odometry_s=odometry_s,
        odometry=odometry,
        time_s=np.array([row[0] for row in rows]),
        kind=kind,
        listener=listener.astype(np.int64),
        source=np.array([place[end][1] for end in ends], np.int64),
        listener_point=np.array([place[end][2] for end in ends]),
        source_point=np.array([place[end][3] for end in ends]),
        range_m=np.array([row[4] for row in rows]),
        range_sd_m=np.array([row[5] for row in rows]),
        bearing_rad=np.array([row[6] for row in rows]),
        pair=np.array([numbers[end] for end in ends], np.int64),
        view=_views(ends, place),
        ends=ends,
        own_ranges=own_ranges,
        sound_speed_mps=site.sound_speed_mps,
        starts=_starts(recording.tables.get("start"), robots),
        scale_sd=ranges.speed_sd_mps / site.sound_speed_mps if own_ranges and ranges is not None else 0.0,
    )


def heard_by(feed: Feed, landmarks_of: Iterable[str] | None = None, peers: bool = True) -> Feed:
    """Return the feed without landmarks that some robots shall not hear, and without peers where asked.

    ``landmarks_of``: the robots that hear fixed beacons (or are heard by fixed microphones); None: all do.
    """
    keep = np.ones(len(feed.time_s), bool)
    fixed = (feed.kind == SIGHTING) & ((feed.source < 0) | (feed.listener < 0))
    if landmarks_of is not None:
        robot = np.maximum(feed.listener, feed.source)
        keep &= ~fixed | np.isin(robot, [feed.robots.index(name) for name in landmarks_of])
    if not peers:
        keep &= fixed | (feed.kind == COMPASS)
    return feed.keep(keep)


def _unbiased(rows: RangeRows, site: Site) -> RangeRows:
    """Take off stated ranges what the site states of their pairs' biases; where it doubts these, so do deviations.

    A deviation that nobody stated is judged by what ranges show: what remains is how far the bias is known.
    """
    bias_m, bias_sd_m = pair_biases(site, rows.emitter, rows.receiver)
    sd_m = np.full(len(rows.time_s), np.nan) if rows.sd_m is None else rows.sd_m
    sd_m = np.where(bias_sd_m > 0, np.hypot(np.nan_to_num(sd_m, nan=0.0), bias_sd_m), sd_m)
    return replace(rows, range_m=rows.range_m - bias_m, sd_m=sd_m)


def _check_times(recording: Recording, made: bool, odometry_s: Floats, heard_s: Floats) -> None:
    """Raise ValueError where odometry and what is heard have no time in common; ``made``: ranges are no file's."""
    if odometry_s.min() <= heard_s.max() and odometry_s.max() >= heard_s.min():
        return
    names = ["the capture" if recording.blocks is not None else "exchanges.csv"] if made else []
    names += ["ranges.csv"] if not made and recording.ranges is not None else []
    names += ["bearings.csv"] if "bearings" in recording.tables else []
    raise ValueError(
        f"odometry.csv (time_s from {odometry_s.min():.9g} to {odometry_s.max():.9g} s) tells nothing of the time of "
        f"what is heard ({', '.join(names)}: from {heard_s.min():.9g} to {heard_s.max():.9g} s); "
        "bring both to one clock"
    )


def _odometry(
    table: Table | None, robots: tuple[str, ...], headed: frozenset[str]
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Rows of odometry, robot by robot; ``headed``: those of which a compass tells the heading."""
    if table is None:
        return np.zeros(len(robots) + 1, np.int64), np.zeros(0), np.zeros((0, 3))
    time_s = table.columns["time_s"]
    whose = np.array(table.names.get("vehicle") or (robots[0],) * len(time_s))
    told = np.column_stack([table.columns["v_mps"], table.columns["yaw_rate_radps"], np.zeros(len(time_s))])
    parts = [np.flatnonzero(whose == robot) for robot in robots]
    parts = [rows[np.argsort(time_s[rows], kind="stable")] for rows in parts]
    for robot, rows in zip(robots, parts, strict=True):
        stands = np.abs(told[rows, 0]) < STANDING_MPS
        if robot in headed:
            told[rows[1:], 2] = np.where(stands[:-1] & ~stands[1:], UNSEEN_RAD**2, 0.0)
    order = np.concatenate(parts)
    first = np.concatenate([[0], np.cumsum([len(rows) for rows in parts])]).astype(np.int64)
    return first, np.ascontiguousarray(time_s[order]), np.ascontiguousarray(told[order])


_Row = tuple[float, int, str, str, float, float, float]


def _sightings(ranges: RangeRows | None, bearings: Table | None) -> list[_Row]:
    """Ranges and bearings, one row for both where the same ends have both at the same instant."""
    found: dict[tuple[float, str, str, int], _Row] = {}
    if ranges is not None:
        sd = np.full(len(ranges.time_s), np.nan) if ranges.sd_m is None else ranges.sd_m
        told = zip(
            ranges.time_s.tolist(), ranges.emitter, ranges.receiver, ranges.range_m.tolist(), sd.tolist(), strict=True
        )
        for i, (t, emitter, receiver, r, s) in enumerate(told):
            if np.isfinite(r):
                again = i if (t, emitter, receiver, -1) in found else -1
                found[t, emitter, receiver, again] = (t, SIGHTING, emitter, receiver, r, s, np.nan)
    if bearings is not None:
        told = zip(
            bearings.columns["time_s"].tolist(),
            bearings.names["from"],
            bearings.names["to"],
            bearings.columns["bearing_rad"].tolist(),
            strict=True,
        )
        for i, (t, emitter, receiver, bearing) in enumerate(told):
            if not np.isfinite(bearing):
                continue
            key = (t, emitter, receiver, -1)
            row = found.get(key)
            if row is not None and not np.isfinite(row[6]):
                found[key] = (*row[:6], bearing)
            else:
                found[(t, emitter, receiver, -2 - i) if row is not None else key] = (
                    t,
                    SIGHTING,
                    emitter,
                    receiver,
                    np.nan,
                    np.nan,
                    bearing,
                )
    return list(found.values())


def _ends(
    site: Site, robots: tuple[str, ...], level_m: Floats, end: tuple[str, str]
) -> tuple[int, int, Floats, Floats]:
    """Robots (−1: none) and points of a row's listener and source."""
    emitter, receiver = end
    beacons, microphones = {b.id: b for b in site.beacons}, {m.id: m for m in site.microphones}
    out: list[tuple[int, Floats]] = []
    for name, nodes in ((receiver, microphones), (emitter, beacons)):
        node = nodes.get(name)
        if node is None:
            out.append((robots.index(name) if name in robots else -1, np.zeros(3)))
        elif node.vehicle is None:
            out.append((-1, np.array(node.position_m)))
        else:
            who = robots.index(node.vehicle)
            out.append((who, np.array(node.lever_arm_m) + [0.0, 0.0, level_m[who]]))
    return out[0][0], out[1][0], out[0][1], out[1][1]


def _views(
    ends: tuple[tuple[str, str], ...], place: dict[tuple[str, str], tuple[int, int, Floats, Floats]]
) -> NDArray[np.int64]:
    """Number the views of rows: single linkage of fixed ends that stand beside one another."""
    first: dict[tuple[str, str], tuple[str, str]] = {}
    for end, (listener, source, listener_point, source_point) in place.items():
        first[end] = end
        for other, (its_listener, its_source, its_listener_point, its_source_point) in place.items():
            if other == end:
                break
            heard = source < 0 and its_source < 0 and listener >= 0 and end[1] == other[1]
            hears = listener < 0 and its_listener < 0 and source >= 0 and end[0] == other[0]
            gap = source_point - its_source_point if heard else listener_point - its_listener_point
            if (heard or hears) and np.linalg.norm(gap) < BESIDE_M:
                old, new = first[end], first[other]
                first = {name: new if root == old else root for name, root in first.items()}
    numbers = {root: i for i, root in enumerate(dict.fromkeys(first[end] for end in ends))}
    return np.array([numbers[first[end]] for end in ends], np.int64)


def _starts(table: Table | None, robots: tuple[str, ...]) -> dict[int, tuple[float, float, float]]:
    """Start poses that are stated whole."""
    if table is None:
        return {}
    whose = table.names.get("vehicle") or (robots[0],) * len(table.columns["x_m"])
    told = zip(whose, table.columns["x_m"], table.columns["y_m"], table.columns["yaw_rad"], strict=True)
    return {robots.index(who): (float(x), float(y), float(yaw)) for who, x, y, yaw in told if np.isfinite(x + y + yaw)}
