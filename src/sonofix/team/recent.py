"""What was heard of each robot within the last seconds, from which one that has no place may be placed."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.feed import COMPASS, Feed
from sonofix.team.placing import Clues
from sonofix.team.state import SIZE, YAW

GATHER_S = 30.0
"""Clues are gathered for so long."""

APART_S = 2.0
"""Clues of one pair that are closer tell the same."""


class Recent:
    """The latest measurements of robots without a place, with where everybody was."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._kept: list[deque[tuple[int, Floats, Floats]]] = [deque() for _ in feed.robots]
        self._last_s: dict[tuple[int, int], float] = {}
        self._heard_s = np.full(len(feed.robots), -np.inf)

    def add(
        self, mean: Floats, placed: NDArray[np.bool_], rows: tuple[int, int], sure: NDArray[np.bool_] | None = None
    ) -> None:
        """Note rows that were heard just now, of robots where a mean has them; V poses, SIZE each.

        ``sure``: those that others may go by; None: all that are placed.
        """
        feed, sure = self._feed, placed if sure is None else sure
        for i in range(*rows):
            time_s = float(feed.time_s[i])
            for robot, other in (
                (int(feed.listener[i]), int(feed.source[i])),
                (int(feed.source[i]), int(feed.listener[i])),
            ):
                if robot < 0:
                    continue
                self._heard_s[robot] = time_s
                key = (int(feed.pair[i]), robot)
                known = other < 0 or sure[other]
                if placed[robot] or not known or time_s - self._last_s.get(key, -np.inf) < APART_S:
                    continue
                self._last_s[key] = time_s
                own = mean[SIZE * robot : SIZE * robot + 3].copy()
                self._kept[robot].append((i, own, mean[SIZE * other : SIZE * other + 3].copy() if other >= 0 else own))
                while time_s - feed.time_s[self._kept[robot][0][0]] > GATHER_S:
                    self._kept[robot].popleft()

    def forget(self, robot: int) -> None:
        """Forget all of a robot: its frame is another now."""
        self._kept[robot].clear()

    def told_s(self, robot: int, now_s: float) -> float:
        """When something last came of a robot."""
        feed = self._feed
        own = feed.odometry_s[feed.first[robot] : feed.first[robot + 1]]
        i = int(np.searchsorted(own, now_s, side="right")) - 1
        return max(float(own[i]) if i >= 0 else -np.inf, float(self._heard_s[robot]))

    def clues(self, robot: int, now_s: float, placed: NDArray[np.bool_]) -> Clues | None:
        """Return what may place a robot now; None where nothing was heard of it."""
        feed = self._feed
        kept = [
            row
            for row in self._kept[robot]
            if now_s - feed.time_s[row[0]] <= GATHER_S
            and (self._other(robot, row[0]) < 0 or placed[self._other(robot, row[0])])
        ]
        if not kept:
            return None
        rows = np.array([row[0] for row in kept])
        listens = feed.listener[rows] == robot
        anchor = np.where(listens, feed.source[rows], feed.listener[rows])
        compass = feed.kind[rows] == COMPASS
        anchor[compass] = -1
        listens |= compass
        own_point = np.where(listens[:, None], feed.listener_point[rows], feed.source_point[rows])
        other_point = np.where(listens[:, None], feed.source_point[rows], feed.listener_point[rows])
        other = np.column_stack([other_point[:, :2], np.zeros(len(rows))])
        for k, (_, _, pose) in enumerate(kept):
            if anchor[k] >= 0:
                cos, sin = np.cos(pose[YAW]), np.sin(pose[YAW])
                x, y = other_point[k, :2]
                other[k] = pose + [cos * x - sin * y, sin * x + cos * y, 0.0]
        return Clues(
            own=np.array([row[1] for row in kept]),
            other=other,
            anchor=anchor,
            listens=listens,
            arm=np.column_stack([own_point[:, :2], other_point[:, 2] - own_point[:, 2]]),
            range_m=np.where(compass, np.nan, feed.range_m[rows]),
            bearing_rad=feed.bearing_rad[rows],
            compass=compass,
        )

    def _other(self, robot: int, row: int) -> int:
        feed = self._feed
        if feed.kind[row] == COMPASS:
            return -1
        return int(feed.source[row] if feed.listener[row] == robot else feed.listener[row])
