"""Whether what is heard of robots fits where they are stated to start, partner by partner."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.feed import SIGHTING, Feed
from sonofix.team.watch import DOUBTED

RUN = 3
"""Measurements of one partner, one after the other, that show whether it agrees."""

FITTED_S = 3.0
"""A start that all partners bore out for so long is likelier right than whatever comes then is its fault."""

SUMMED = 12
"""Latest squares that are summed: many that are each a little too large do not fit either."""

LOOSE = 5.0
"""How many deviations of χ² too large their sum must be."""


class Fits:
    """Judges robots by how what is heard of them fits, apart from what it then makes of them.

    ``stood``: those that fitted for `FITTED_S`; ``misfits``: those that did not, before they had stood; ``doubted``:
    those of them with which two partners disagreed at once, or as many as agreed.
    """

    def __init__(self, feed: Feed) -> None:
        robots = len(feed.robots)
        self.stood: set[int] = set()
        self.misfits: set[int] = set()
        self.doubted: set[int] = set()
        self._latest: list[dict[int, deque[bool]]] = [{} for _ in range(robots)]
        self._squares: list[deque[float]] = [deque(maxlen=SUMMED) for _ in range(robots)]
        self._since_s = np.full(robots, np.nan)

    @property
    def open(self) -> bool:
        """Whether somebody may be elsewhere than is stated: one disagreed till now, or latest."""
        latest = (run for robot, runs in enumerate(self._latest) if robot not in self.stood for run in runs.values())
        return bool(self.misfits) or any(not run[-1] for run in latest)

    def clear(self, robot: int) -> None:
        """Forget what was heard of a robot that was moved or lost; it has stood till then."""
        self._squares[robot].clear()
        for one, latest in enumerate(self._latest):
            if one == robot:
                latest.clear()
            latest.pop(robot, None)

    def see(self, feed: Feed, time_s: float, rows: tuple[int, int], used: NDArray[np.bool_], told: Floats) -> None:
        """Note how rows fitted, of which `hear.hear` tells ``used`` (rows, 2) and ``told`` (rows, 2, TOLD)."""
        robots = len(self._latest)
        heard: set[int] = set()
        for k, i in enumerate(range(*rows)):
            squares = told[k, :, 6]
            asked = np.isfinite(squares)
            if feed.kind[i] != SIGHTING or not asked.any():
                continue
            agrees = bool(used[k][asked].all() and squares[asked].max() <= DOUBTED)
            a, b = int(feed.listener[i]), int(feed.source[i])
            for robot, other in ((a, b), (b, a)):
                if robot >= 0:
                    partner = other if other >= 0 else robots + int(feed.pair[i])
                    self._latest[robot].setdefault(partner, deque(maxlen=RUN)).append(agrees)
                    heard.add(robot)
                    if other < 0:
                        self._squares[robot].extend(np.minimum(squares[asked], DOUBTED).tolist())
        for robot in heard:
            if robot not in self.stood and self._doubtful(robot):
                self.doubted.add(robot)
                self.misfits.add(robot)
            if self._refusing(robot):
                self._since_s[robot] = np.nan
                if robot not in self.stood:
                    self.misfits.add(robot)
            elif np.isnan(self._since_s[robot]) or not self._borne_out(robot):
                self._since_s[robot] = time_s
            elif time_s - self._since_s[robot] >= FITTED_S and robot not in self.misfits:
                self.stood.add(robot)

    def _refusing(self, robot: int) -> int:
        """Return how many partners a robot disagrees with now; at least one where many a little add up."""
        squares = self._squares[robot]
        too_large = len(squares) >= SUMMED // 2 and sum(squares) > len(squares) + LOOSE * np.sqrt(2.0 * len(squares))
        return max(self._partners(robot, lambda run: not any(run)), int(too_large))

    def _doubtful(self, robot: int) -> bool:
        """Whether two partners disagree, twice running, with where a robot is; or one for good, and as few agree."""
        twice = sum(len(run) >= 2 and not any(list(run)[-2:]) for run in self._latest[robot].values())
        off = self._partners(robot, lambda run: not any(run))
        return twice >= 2 or (off > 0 and off >= self._partners(robot, any))

    def _borne_out(self, robot: int) -> bool:
        """Whether two partners agree, one of which is fixed or has stood."""
        agree = [partner for partner, run in self._latest[robot].items() if len(run) == RUN and all(run)]
        return len(agree) >= 2 and any(one >= len(self._latest) or one in self.stood for one in agree)

    def _partners(self, robot: int, which: Callable[[deque[bool]], bool]) -> int:
        return sum(len(run) == RUN and which(run) for run in self._latest[robot].values())
