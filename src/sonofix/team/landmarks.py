"""Fixed ends that all hear wrong: one whose ranges are metres too long, or that stands elsewhere than is stated.

What each robot heard of fixed ends within the last half minute is laid on its odometry's way, as it is when a robot is
placed; then again with one fixed end left out after the other. Where it is one that does not go with the rest, leaving
that out mends all robots' ways, and leaving out any other does not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonofix.records import Event
from sonofix.team.belief import Belief
from sonofix.team.feed import Feed
from sonofix.team.placing import LIMIT, Clues, doubt_of, residuals, settle
from sonofix.team.recent import GATHER_S, Recent

ASK_S = 1.0
"""How often it is judged in the first half minute after a robot was placed."""

LATER_S = 10.0
"""How often it is judged then."""

LEAST = 8
"""Ranges and bearings of one fixed end that may show it wrong; of the others there must be twice as many."""

MISSES = 4.0
"""A square of a wrong end's, over its variance; none counts for more than an outlier's, 9."""

MENDS = 5.0
"""By how many times the others' squares without it, it must be larger."""

RIVALS = 9.0
"""How much more leaving out any other must cost."""


class Landmarks:
    """Judges the fixed ends of a feed by what the last half minute told of them."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._recent = Recent(feed)
        fixed = np.flatnonzero(feed.of_fixed)
        self._name = {int(feed.pair[i]): feed.ends[i][0 if feed.source[i] < 0 else 1] for i in fixed.tolist()}
        self._nobody = np.zeros(len(feed.robots), bool)
        self._first_s = self._asked_s = np.nan

    def judge(self, belief: Belief, time_s: float, rows: tuple[int, int]) -> tuple[set[int], list[Event]]:
        """Take in what was heard now; return the pairs of a fixed end that is found wrong, and events."""
        self._recent.add(belief.mean, self._nobody, rows, self._nobody)
        if not belief.placed.any():
            return set(), []
        if np.isnan(self._first_s):
            self._first_s = self._asked_s = time_s
        if time_s - self._asked_s < (ASK_S if time_s - self._first_s < GATHER_S else LATER_S):
            return set(), []
        self._asked_s = time_s
        name = self._wrong(belief, time_s)
        if name is None:
            return set(), []
        pairs = {pair for pair, its in self._name.items() if its == name}
        self._feed = self._feed.without((), pairs)
        self._recent.believe(self._feed)
        text = "it misses what all else tells, and is left out: are its position_m, delay_s and code right?"
        return pairs, [Event(time_s, "", "excluded", f"{name}: {text}")]

    def _wrong(self, belief: Belief, time_s: float) -> str | None:
        """Return the fixed end that does not go with the rest."""
        whole = 0.0
        costs: dict[str, float] = {}  # by how much leaving it out mends
        counts: dict[str, int] = {}
        count = 0
        for robot in np.flatnonzero(belief.placed).tolist():
            clues = self._recent.clues(robot, time_s, self._nobody, belief)
            if clues is None:
                continue
            clues = clues.keep(~clues.compass)
            clues = replace(clues, doubt=doubt_of(clues, belief.mean[belief.at(robot)]))
            names = np.array([self._name[pair] for pair in clues.pair.tolist()])
            frame = settle(clues, np.zeros(3))
            all_cost, number = _cost(clues, frame)
            apart: dict[str, tuple[float, int]] = {}
            for name in np.unique(names).tolist():
                left = clues.keep(names != name)
                without = settle(left, frame)
                apart[name] = _cost(left, without)
                all_cost = min(all_cost, _cost(clues, without)[0])
            whole, count = whole + all_cost, count + number
            for name, (cost, rest) in apart.items():
                costs[name] = costs.get(name, 0.0) + all_cost - cost
                counts[name] = counts.get(name, 0) + number - rest
        if len(costs) < 2:
            return None
        by_gain = sorted(costs, key=lambda name: costs[name], reverse=True)
        worst, second = by_gain[:2]
        kept, own, rest = whole - costs[worst], counts[worst], count - counts[worst]
        if own < LEAST or rest < 2 * LEAST or costs[worst] - costs[second] < RIVALS:
            return None
        if costs[worst] / own < max(MISSES, MENDS * kept / rest):
            return None
        return worst


def _cost(clues: Clues, frame: np.ndarray) -> tuple[float, int]:
    """Return the sum of squares, none of which counts more than an outlier's, and how many they are."""
    missed = residuals(clues, frame).residual
    return float(np.sum(np.minimum(missed**2, LIMIT**2))), len(missed)
