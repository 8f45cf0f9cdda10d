"""Compasses are not taken at their word: each is heard once how its robot heads bears it out."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

import numpy as np

from sonofix.records import Event
from sonofix.team.belief import Belief
from sonofix.team.feed import COMPASS, Feed
from sonofix.team.kernel import turned_by
from sonofix.team.state import SIZE, YAW
from sonofix.track.wheels import COMPASS_SD_RAD

EVERY_S = 1.0
"""Readings of a compass that are closer tell the same: steel nearby, or a heading that errs."""

READINGS = 8
"""So many of a compass judge it."""

DOUBTED = 9.0
"""A reading's squared distance from the heading, over its variance, beyond which it disagrees."""

MOST = 0.75
"""Share of a compass's readings that must agree, or disagree."""

HEADED_RAD = 0.3
"""A heading that is known no better judges no compass."""

STANDS_S = 30.0
"""A compass that nothing has judged for so long is heard as it is."""


class Compasses:
    """Which robots' compasses are proven: ``unheard`` are the pairs of those that are not, or are gainsaid.

    Where no fixed end is heard all are taken as they are: nothing else may tell headings.
    """

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        told = np.flatnonzero((feed.kind == COMPASS) & np.isfinite(feed.bearing_rad))
        self._open = {int(feed.listener[i]): int(feed.pair[i]) for i in told} if feed.of_fixed.any() else {}
        self._first_s: dict[int, float] = {}
        self._kept: dict[int, deque[tuple[float, float, bool]]] = {r: deque(maxlen=READINGS) for r in self._open}
        self.unheard = set(self._open.values())

    def judge(self, belief: Belief, rows: tuple[int, int], unsure: Collection[int]) -> tuple[set[int], list[Event]]:
        """Compare what compasses told now with how robots head by all else, but of those that are ``unsure``.

        Returns the pairs gainsaid now, and events; proven ones are no longer ``unheard``.
        """
        feed = self._feed
        wrong: set[int] = set()
        events: list[Event] = []
        for i in range(*rows):
            robot = int(feed.listener[i])
            if feed.kind[i] != COMPASS or robot not in self._open or not np.isfinite(feed.bearing_rad[i]):
                continue
            time_s, kept, at = float(feed.time_s[i]), self._kept[robot], SIZE * robot + YAW
            variance = float(belief.covariance[at, at])
            known = belief.placed[robot] and robot not in unsure and variance < HEADED_RAD**2
            if known and not (kept and time_s - kept[-1][0] < EVERY_S):
                off = turned_by(feed.bearing_rad[i] - belief.mean[at])
                kept.append((time_s, abs(off), off**2 > DOUBTED * (variance + COMPASS_SD_RAD**2)))
            share = float(np.mean([gainsays for *_, gainsays in kept])) if len(kept) == READINGS else 0.5
            stands = time_s - self._first_s.setdefault(robot, time_s) > STANDS_S
            if not (share >= MOST or share <= 1.0 - MOST or stands):
                continue
            pair = self._open.pop(robot)
            if share < MOST:
                self.unheard.discard(pair)
                continue
            wrong.add(pair)
            text = (
                f"its compass is off by {np.degrees(np.median([miss for _, miss, _ in kept])):.0f}° (median) from how "
                "it heads by all else, and is left out: does it count in radians, anticlockwise from east?"
            )
            events.append(Event(time_s, feed.robots[robot], "excluded", text))
        return wrong, events
