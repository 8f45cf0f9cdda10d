"""What was heard of each robot within the last seconds, from which one that has no place may be placed."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.feed import COMPASS, UNHEARD, Feed
from sonofix.team.kernel import STRAYS, drive, strayed
from sonofix.team.placing import Clues, Shared
from sonofix.team.state import POSE, SIZE, SLIP_S, SPEED_SLIP, TURN_SLIP, YAW

if TYPE_CHECKING:
    from sonofix.team.belief import Belief

GATHER_S = 30.0
"""Clues are gathered for so long."""

APART_S = 2.0
"""Clues of one pair that are closer tell the same."""


def lasting(span_s: float) -> float:
    """Return which share of its variance the mean of a slip has over so long (Gauss-Markov)."""
    span_s = max(span_s, 1e-9)
    return 2.0 * SLIP_S / span_s * (1.0 - SLIP_S / span_s * -np.expm1(-span_s / SLIP_S))


class Recent:
    """The latest measurements of robots without a place, with where everybody was."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._kept: list[deque[tuple[int, Floats, Floats, Floats]]] = [deque() for _ in feed.robots]
        self._last_s: dict[tuple[int, int], float] = {}
        self._heard_s = np.full(len(feed.robots), -np.inf)

    def add(
        self,
        mean: Floats,
        placed: NDArray[np.bool_],
        rows: tuple[int, int],
        sure: NDArray[np.bool_] | None = None,
        covariance: Floats | None = None,
    ) -> set[int]:
        """Note rows that were heard just now, of robots where a mean has them; V poses, SIZE each.

        ``sure``: those that others may go by; None: all that are placed. ``covariance``: of the mean, where what others
        knew of themselves just then is to be remembered. Returns the robots whose poses were noted.
        """
        feed, sure = self._feed, placed if sure is None else sure
        told: set[int] = set()
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
                known = feed.kind[i] != UNHEARD and (other < 0 or sure[other])
                if placed[robot] or not known or time_s - self._last_s.get(key, -np.inf) < APART_S:
                    continue
                self._last_s[key] = time_s
                own = mean[SIZE * robot : SIZE * robot + 3].copy()
                pose, spread = own, np.zeros((3, 3))
                if other >= 0:
                    at = slice(SIZE * other, SIZE * other + 3)
                    pose = mean[at].copy()
                    spread = spread if covariance is None else covariance[at, at].copy()
                    told.add(other)
                self._kept[robot].append((i, own, pose, spread))
                while time_s - feed.time_s[self._kept[robot][0][0]] > GATHER_S:
                    self._kept[robot].popleft()
        return told

    def believe(self, feed: Feed) -> None:
        """Go on by another part of the same recording."""
        self._feed = feed

    def forget(self, robot: int) -> None:
        """Forget all of a robot: its odometry does not join what was heard to what will be."""
        self._kept[robot].clear()

    def told_s(self, robot: int, now_s: float) -> float:
        """When something last came of a robot."""
        feed = self._feed
        own = feed.odometry_s[feed.first[robot] : feed.first[robot + 1]]
        i = int(np.searchsorted(own, now_s, side="right")) - 1
        return max(float(own[i]) if i >= 0 else -np.inf, float(self._heard_s[robot]))

    def clues(self, robot: int, now_s: float, placed: NDArray[np.bool_], belief: Belief | None = None) -> Clues | None:
        """Return what may place a robot now; None where nothing was heard of it.

        With a ``belief``, which tells how well its odometry is known: with errors that clues may share.
        """
        feed = self._feed
        kept = [
            row
            for row in self._kept[robot]
            if now_s - feed.time_s[row[0]] <= GATHER_S
            and feed.kind[row[0]] != UNHEARD
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
        spread = np.zeros((len(rows), 3, 3))
        for k, (_, _, pose, doubt) in enumerate(kept):
            if anchor[k] >= 0:
                cos, sin = np.cos(pose[YAW]), np.sin(pose[YAW])
                x, y = other_point[k, :2]
                arm = np.array([cos * x - sin * y, sin * x + cos * y, 0.0])
                other[k] = pose + arm
                by = np.eye(3)
                by[:2, 2] = -arm[1], arm[0]
                spread[k] = by @ doubt @ by.T
        own, shared = np.array([row[1] for row in kept]), None
        if belief is not None:
            own, astray, stray = self._ways(robot, feed.time_s[rows], now_s, belief)
            shared = Shared(spread, astray, stray)
        return Clues(
            own=own,
            other=other,
            anchor=anchor,
            listens=listens,
            arm=np.column_stack([own_point[:, :2], other_point[:, 2] - own_point[:, 2]]),
            range_m=np.where(compass, np.nan, feed.range_m[rows]),
            bearing_rad=feed.bearing_rad[rows],
            compass=compass,
            pair=feed.pair[rows],
            shared=shared,
        )

    def _ways(self, robot: int, then_s: Floats, now_s: float, belief: Belief) -> tuple[Floats, Floats, Floats]:
        """Return a robot's poses (m, 3) at some times as odometry has them from where it is now, and how they may err.

        By errors of odometry of unit variance (m, 3, q), and by what no such error explains (m, 3, 3). A slip counts
        as one that lasts for all the way, but no more of it than what of slips does not average out.
        """
        feed, at = self._feed, SIZE * robot
        own = belief.mean[at : at + SIZE].copy()
        now = own[:POSE].copy()
        a, b = feed.first[robot], feed.first[robot + 1]
        told = feed.odometry_s[a:b], feed.odometry[a:b]
        errors = belief.covariance[at + POSE : at + SIZE, at + POSE : at + SIZE]
        values, vectors = np.linalg.eigh(errors)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        pose, by, strays, noise = np.zeros(POSE), np.zeros((POSE, SIZE)), np.zeros(STRAYS), np.zeros((POSE, POSE))
        poses, astray, left = np.empty((len(then_s), POSE)), np.empty((len(then_s), POSE, len(root))), []
        for k, time_s in enumerate(then_s.tolist()):
            own[:POSE] = 0.0
            drive(own, *told, time_s, now_s, belief.rough[robot], pose, by, strays)
            own[YAW] = now[YAW] - pose[YAW]
            drive(own, *told, time_s, now_s, belief.rough[robot], pose, by, strays)
            strayed(by, strays, noise)
            poses[k] = now - pose
            poses[k, YAW] = own[YAW]
            by[:, [SPEED_SLIP, TURN_SLIP]] *= np.sqrt(lasting(now_s - time_s))
            back = np.linalg.inv(by[:, :POSE])
            astray[k] = back @ by[:, POSE:] @ root
            left.append(back @ noise @ back.T)
        return poses, astray, np.array(left)

    def _other(self, robot: int, row: int) -> int:
        feed = self._feed
        if feed.kind[row] == COMPASS:
            return -1
        return int(feed.source[row] if feed.listener[row] == robot else feed.listener[row])
