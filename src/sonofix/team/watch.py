"""Whether robots are where their tracks have them, judged by what was heard of them latest."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.feed import SIGHTING, Feed

JUDGED = 6
"""Latest measurements by which it is judged whether a robot is where its track has it."""

ASTRAY = 0.6
"""The share of these that must not agree with that."""

DOUBTED = 9.0
"""Squared miss, over its variance, beyond which a measurement does not agree, be it believed or not."""

AT_ODDS = 8
"""Ranges of two robots, refused one after the other while the rest agrees, that show that one of them is elsewhere."""


@dataclass(frozen=True, slots=True)
class Odds:
    """Two robots whose ranges contradict where both are, since they last agreed (−∞: they never did), and by how much.

    ``refused``: those of them of which most else that is heard is refused too; ``alone``: nothing else is.
    Nothing tells which of them is elsewhere, nor by what it was turned round the others: ``variance_m2`` allows for
    twice as much, either way.
    """

    robots: tuple[int, int]
    agreed_s: float
    miss_m: float
    refused: tuple[int, ...] = ()
    alone: bool = False

    @property
    def variance_m2(self) -> float:
        """Of both places, along each axis."""
        return (2.0 * self.miss_m) ** 2


class Watch:
    """Judges whether robots are where their tracks have them, by which of their latest measurements were refused."""

    def __init__(self, robots: int) -> None:
        self._latest: list[deque[tuple[int, int, bool, bool]]] = [deque(maxlen=JUDGED) for _ in range(robots)]
        self._first: dict[int, int] = {}
        self._odds: dict[tuple[int, int], list[float]] = {}
        self._agreed_s: dict[tuple[int, int], float] = {}

    def clear(self, robot: int) -> None:
        """Forget what was refused of a robot, by others too: they are not to blame."""
        self._latest[robot].clear()
        self._first.clear()
        self._odds = {pair: misses for pair, misses in self._odds.items() if robot not in pair}
        for latest in self._latest:
            kept = [one for one in latest if one[1] != robot]
            latest.clear()
            latest.extend(kept)

    def see(self, feed: Feed, rows: tuple[int, int], used: NDArray[np.bool_], told: Floats) -> None:
        """Note what became of some measurements."""
        for k, i in enumerate(range(*rows)):
            asked = np.isfinite(told[k, :, 0])
            if feed.kind[i] != SIGHTING or not asked.any():
                continue
            ends = int(feed.listener[i]), int(feed.source[i])
            taken = bool(np.all(used[k][asked]))
            agrees = taken and not np.any(told[k, :, 6] > DOUBTED)
            for robot, other in (ends, ends[::-1]):
                if robot >= 0:
                    # fixed ends are told apart by their pair
                    partner = other if other >= 0 else len(self._latest) + int(feed.pair[i])
                    self._latest[robot].append((i, partner, bool(agrees), taken))
            if min(ends) >= 0 and asked[0]:
                misses = self._odds.setdefault((min(ends), max(ends)), [])
                misses.append(abs(float(told[k, 0, 0])))
                if used[k, 0]:
                    misses.clear()
                    self._agreed_s[min(ends), max(ends)] = float(feed.time_s[i])

    def astray(self) -> list[tuple[int, int]]:
        """Return the robots that have surely been moved without odometry noticing, and the first row that shows it.

        That of which most disagrees comes first. None are told of which one partner alone tells so.
        """
        found: list[tuple[float, int, int]] = []
        for robot, latest in enumerate(self._latest):
            refused: dict[int, int] = {}
            for row, partner, ok, _ in latest:
                if not ok:
                    refused.setdefault(partner, row)
            share = sum(not ok for _, _, ok, _ in latest) / max(len(latest), 4)
            if len(refused) < 2 or share < ASTRAY:
                self._first.pop(robot, None)
            else:
                found.append((-share, robot, self._first.setdefault(robot, min(refused.values()))))
        return [(robot, first) for _, robot, first in sorted(found)]

    def disagrees(self, robot: int) -> bool:
        """Whether most of what was heard of a robot latest does not agree with where it is."""
        latest = self._latest[robot]
        return sum(not agrees for _, _, agrees, _ in latest) >= ASTRAY * max(len(latest), 4)

    def refused(self, robot: int) -> bool:
        """Whether most of what was heard of a robot latest was not even believed."""
        latest = self._latest[robot]
        return sum(not taken for *_, taken in latest) >= ASTRAY * max(len(latest), 4)

    def at_odds(self) -> tuple[Odds, ...]:
        """Return pairs of robots whose ranges are refused again and again."""
        return tuple(
            self._odd(pair, float(np.median(misses[-AT_ODDS:])))
            for pair, misses in self._odds.items()
            if len(misses) >= AT_ODDS
        )

    def _odd(self, pair: tuple[int, int], miss_m: float) -> Odds:
        """Return two robots that contradict each other, with what became of what else was heard of them latest."""
        else_taken = [
            [taken for _, partner, _, taken in self._latest[robot] if partner != other]
            for robot, other in (pair, pair[::-1])
        ]
        refused = [robot for robot, taken in zip(pair, else_taken, strict=True) if 2 * sum(taken) < len(taken)]
        agreed_s = self._agreed_s.get(pair, -np.inf)
        return Odds(pair, agreed_s, miss_m, tuple(refused), not all(else_taken))
