"""When a team's filter looks: at what is heard, now and then in silences, and until all have left."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Event, Floats
from sonofix.team.feed import Feed

if TYPE_CHECKING:
    from sonofix.team.recent import Recent

FILL_S = 1.0
"""Where nothing is heard for longer, a row tells how the doubt grows."""

LEFT_S = 10.0
"""A robot of which nothing comes for so long has left."""


def instants(feed: Feed) -> list[tuple[float, int, int]]:
    """Return the instants of a feed with their rows (first, last); empty ones fill silences of `FILL_S`.

    Where no odometry comes either, they end once all have left, and begin again as long before something comes.
    """
    changes = np.flatnonzero(np.diff(feed.time_s) > 0) + 1
    edges = [0, *changes.tolist(), len(feed.time_s)] if len(feed.time_s) else [0]
    begin, end = float(feed.odometry_s.min()), float(feed.odometry_s.max())
    out: list[tuple[float, int, int]] = []
    told_s = np.sort(feed.odometry_s)
    last = min(begin, float(feed.time_s[0])) if len(feed.time_s) else begin
    for a, b in pairwise(edges):
        time = float(feed.time_s[a])
        out += [(t, a, a) for t in _between(last, time, told_s)]
        out.append((time, a, b))
        last = time
    return out + [(t, len(feed.time_s), len(feed.time_s)) for t in _between(last, end + 1e-9, told_s)]


def _between(after_s: float, before_s: float, told_s: Floats) -> list[float]:
    """Return instants between two, but none far from both and from those at which odometry told something."""
    count = int(np.ceil((before_s - after_s) / FILL_S)) - 1
    between = told_s[np.searchsorted(told_s, after_s) : np.searchsorted(told_s, before_s)]
    near = np.concatenate([[after_s], between, [before_s]])
    # who leaves is told at the second instant after that at the latest
    reach_s = LEFT_S + 2 * FILL_S
    gaps = np.flatnonzero(np.diff(near) > 2 * reach_s)
    first = [1, *np.ceil((near[gaps + 1] - reach_s - after_s) / FILL_S).astype(int).tolist()]
    last = [*np.floor((near[gaps] + reach_s - after_s) / FILL_S).astype(int).tolist(), count]
    return [after_s + FILL_S * i for a, b in zip(first, last, strict=True) for i in range(max(a, 1), min(b, count) + 1)]


def leave(
    feed: Feed, placed: NDArray[np.bool_], recent: Recent, time_s: float, since_s: float, events: list[Event]
) -> list[int]:
    """Return the placed robots of which nothing came for `LEFT_S`, and tell of them.

    A robot that has no odometry is with the others as long as it is heard, or hears. ``since_s``: how long ago all
    began, as nobody has left before anybody could be heard.
    """
    gone = [
        robot
        for robot in np.flatnonzero(placed).tolist()
        if min(time_s - recent.told_s(robot, time_s), since_s) > LEFT_S
    ]
    for robot in gone:
        recent.forget(robot)
        events.append(Event(time_s, feed.robots[robot], "left", f"nothing came of it for {LEFT_S:g} s"))
    return gone
