"""Where to put more beacons: greedy, then exchange, over candidate places (Fedorov's algorithm for exact designs).

V. V. Fedorov, Theory of Optimal Experiments, 1972; A. C. Atkinson, A. N. Donev and R. D. Tobias, Optimum Experimental
Designs, 2007, chapter 12. Every layout is judged on a sample of the floor, by the very figures that the map shows. That
no better layout exists is not proven.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sonofix.plan.judge import Judgement
from sonofix.plan.quality import Nodes, OnDone, Terms, detected_shifts, judge, weights
from sonofix.plan.walls import inside
from sonofix.records import Floats, Walls
from sonofix.site import Site

Goal = Literal["error", "faults"]

PERCENT = 95.0
"""Of the floor that the goal "error" speaks of."""

SAMPLE = 1200
"""Places that layouts are judged at; the map shows the rest."""

MOST_CANDIDATES = 320
SWEEPS = 6
"""Rounds of exchanges at most; two or three settle it."""

ENOUGH = 3000
"""Layouts judged, after which no other start is tried: a second or two."""

STARTS = 50
"""Starts at most: the greedy one, then random ones."""

CLEAR_M = 0.3
"""Two beacons nearer to each other tell the same."""

NO_FIX_M = 100.0
"""What a place without a fix counts as."""

GAIN = 1e-9
"""Of cost: what counts as better."""

BESIDE = 0.03
"""Weight of the mean over the floor beside the goal itself: it leads the way where the goal does not move yet."""


@dataclass(frozen=True, slots=True, eq=False)
class Improvement:
    """Where beacons go.

    Attributes
    ----------
    position_m : float64 (n, 3)
        Of the beacons moved, in their order, then of the added ones.
    cost_before, cost_after : float
        What was lowered; on the sample.
    tried : int
        Layouts judged.
    """

    position_m: Floats
    cost_before: float
    cost_after: float
    tried: int


def candidates_of(site: Site, walls: Walls, level_m: float) -> Floats:
    """Lay places where a beacon could be fastened: on the ceiling, and on the walls at two heights.

    Of ``bounds_m``, or else of the box of what is fixed; not inside an obstacle, not below the level of the map.

    Returns
    -------
    float64 (n, 3)
        At most some `MOST_CANDIDATES`.

    Raises
    ------
    ValueError
        Nothing lies above the level.
    """
    nodes = [n.position_m for n in (*site.beacons, *site.microphones) if n.position_m is not None]
    corners = np.array(site.bounds_m or nodes, float)
    low, high = corners.min(axis=0), corners.max(axis=0)
    if high[2] <= level_m:
        ends = "bounds_m ends" if site.bounds_m else "what is fixed, in place of bounds_m, ends"
        remedy = "correct bounds_m" if site.bounds_m else "state bounds_m"
        raise ValueError(
            f"{ends} at {high[2]:g} m, not above the map's level of {level_m:g} m: no wall nor ceiling to fasten"
            f" beacons to; {remedy}, or give --places"
        )
    size = high - low
    apart = max(np.sqrt(size[0] * size[1] / (0.6 * MOST_CANDIDATES)), (size[0] + size[1]) / (0.1 * MOST_CANDIDATES))
    steps = np.maximum(np.ceil(size[:2] / max(apart, 0.25)), 1).astype(int)
    x, y = (np.linspace(low[i], high[i], steps[i] + 1) for i in range(2))
    places = [(a, b, high[2]) for a in x for b in y]
    half_m = (level_m + high[2]) / 2
    edge = [(a, b) for a in x for b in (y[0], y[-1])] + [(a, b) for b in y[1:-1] for a in (x[0], x[-1])]
    places += [(a, b, half_m) for a, b in edge]
    found = np.array(places, float)
    return found[~inside(walls, found)]


def sample_of(places_m: Floats, most: int = SAMPLE) -> Floats:
    """Thin places (p, 3) evenly to ``most`` at most, by the golden ratio: no pattern of rows is favoured."""
    if len(places_m) <= most:
        return places_m
    order = np.argsort((np.arange(len(places_m)) * 0.6180339887498949) % 1.0, kind="stable")
    return places_m[np.sort(order[:most])]


def cost(got: Judgement, goal: Goal, fault_m: float, needed: int) -> float:
    """What a layout is worth; lower is better.

    "error": log₁₀ of the 95th percentile of the deviation over the floor. "faults": the share of the floor that lacks a
    fix, or where a fault of ``fault_m`` would go undetected. A little of the mean over the floor is added: of the same
    logarithm, and of how many beacons fewer than ``needed`` are heard.
    """
    sd = np.log10(np.minimum(np.where(np.isfinite(got.sd_m), got.sd_m, NO_FIX_M), NO_FIX_M))
    short = np.mean(np.maximum(needed - got.heard, 0)) / needed
    if goal == "error":
        main = float(np.percentile(sd, PERCENT))
    else:
        main = float(1.0 - np.mean(got.fault_m <= fault_m))
        sd = np.where(np.isfinite(got.fault_m), np.log10(np.minimum(got.fault_m, NO_FIX_M) + 1e-9), 2.0)
    return main + BESIDE * (float(np.mean(sd)) + float(short))


def improve(
    standing: Nodes,
    moving: Nodes,
    new: int,
    candidates_m: Floats,
    places_m: Floats,
    terms: Terms,
    goal: Goal = "error",
    fault_m: float = 0.5,
    on_done: OnDone | None = None,
) -> Improvement:
    """Place beacons so that a goal is met best.

    Parameters
    ----------
    standing : Nodes
        That stay where they are.
    moving : Nodes
        That may go to any candidate, or stay; the new ones are heard like the first of all.
    new : int
        How many to add.
    candidates_m : float64 (c, 3)
    places_m : float64 (p, 3)
        Of the floor; thinned to `SAMPLE`.
    terms : Terms
    goal : "error" or "faults"
    fault_m : float
        What is to be detected.
    on_done : callable, optional
        Told the share of the work that is done; it may end early.

    Raises
    ------
    ValueError
        There is nothing to place, or the candidates do not hold so many beacons.
    """
    count = len(moving) + new
    if not count:
        raise ValueError("nothing to place: ask for one beacon or more, or let some be moved")
    search = _Search(standing, moving, candidates_m, places_m, terms, goal, fault_m, count, on_done)
    if len(search.pool) < count:
        raise ValueError(f"{len(search.pool)} places for {count} beacons; give more places")
    before = search.cost(range(len(moving)))
    chosen: list[int] = []
    for _ in range(count):
        place, _ = search.best(chosen)
        if place < 0:
            raise ValueError(
                f"the places hold {len(chosen)} beacons {CLEAR_M:g} m apart from each other, and {count} are asked for;"
                " give more places"
            )
        chosen.append(place)
    chosen, value = search.exchanged(chosen)
    rng = np.random.default_rng(0)
    starts = [list(range(count))] if new == 0 else []  # what may move, where it is
    for _ in range(1, STARTS):
        if count == 1 or search.tried > ENOUGH:
            break
        start = starts.pop() if starts else search.drawn(rng)
        other, lower = search.exchanged(start)
        if len(start) == count and lower < value - GAIN:
            chosen, value = other, lower
    if new == 0 and before <= value + GAIN:
        chosen, value = list(range(count)), before
    if on_done is not None:
        on_done(1.0)
    return Improvement(search.assigned(chosen, len(moving)), before, value, search.tried)


class _Search:
    """Layouts made of what stands and some of a pool of places, judged by one goal; figures of places are kept."""

    def __init__(
        self,
        standing: Nodes,
        moving: Nodes,
        candidates_m: Floats,
        places_m: Floats,
        terms: Terms,
        goal: Goal,
        fault_m: float,
        count: int,
        on_done: OnDone | None,
    ) -> None:
        self.tried = 0
        self._places = sample_of(places_m)
        # a beacon may also stay where it is
        taken = np.concatenate([moving.position_m, candidates_m])
        clear = np.ones(len(taken), bool)
        for i in range(len(moving), len(taken)):
            others = np.concatenate([standing.position_m, moving.position_m])
            clear[i] = not len(others) or np.linalg.norm(others - taken[i], axis=1).min() > CLEAR_M
        self.pool = taken[clear]
        link = (moving if len(moving) else standing).links[0]
        ids = tuple(str(i) for i in range(len(self.pool)))
        pool = Nodes(ids, self.pool, np.zeros(len(self.pool)), (link,) * len(self.pool))
        self._pool_weight = weights(pool, self._places, terms)
        self._standing, self._terms, self._fault_m = standing, terms, fault_m
        self._goal: Goal = goal
        self._standing_weight = weights(standing, self._places, terms)
        self._shift = detected_shifts(len(standing) + count) if goal == "faults" else None
        self._needed = 2 + terms.free_level + terms.clock + (1 if goal == "faults" else 0)
        self._count = count
        self._on_done = on_done
        self._total = max(len(self.pool) * count * 3, ENOUGH)

    def cost(self, chosen: Sequence[int]) -> float:
        """Cost of a layout."""
        which = list(chosen)
        nodes = np.concatenate([self._standing.position_m, self.pool[which]])
        weight = np.concatenate([self._standing_weight, self._pool_weight[:, which]], axis=1)
        return self._judged(nodes, weight)

    def best(self, chosen: Sequence[int]) -> tuple[int, float]:
        """Place of the pool that, added to others, costs least, and what it costs; −1 where all are too close."""
        which = [*chosen, 0]
        nodes = np.concatenate([self._standing.position_m, self.pool[which]])
        weight = np.concatenate([self._standing_weight, self._pool_weight[:, which]], axis=1)
        found, least = -1, np.inf
        near = np.linalg.norm(self.pool[:, None] - self.pool[list(chosen)][None], axis=2) if len(chosen) else None
        for i in range(len(self.pool)):
            if near is not None and near[i].min() <= CLEAR_M:
                continue
            nodes[-1], weight[:, -1] = self.pool[i], self._pool_weight[:, i]
            value = self._judged(nodes, weight)
            if value < least:
                found, least = i, value
        return found, least

    def exchanged(self, chosen: list[int]) -> tuple[list[int], float]:
        """Move each in turn to where it costs least, until none gains; return places and cost."""
        value = self.cost(chosen)
        for _ in range(SWEEPS if len(chosen) > 1 else 0):
            settled = True
            for k in range(len(chosen)):
                place, lower = self.best(chosen[:k] + chosen[k + 1 :])
                if lower < value - GAIN:
                    chosen = [*chosen[:k], place, *chosen[k + 1 :]]
                    value, settled = lower, False
            if settled:
                break
        return chosen, value

    def drawn(self, rng: np.random.Generator) -> list[int]:
        """Draw a layout whose beacons are clear of each other, as far as there are places."""
        chosen: list[int] = []
        for i in rng.permutation(len(self.pool)).tolist():
            apart = np.linalg.norm(self.pool[chosen] - self.pool[i], axis=1)
            if len(chosen) < self._count and (not len(apart) or apart.min() > CLEAR_M):
                chosen.append(i)
        return chosen

    def assigned(self, chosen: Sequence[int], moving: int) -> Floats:
        """Give each moved beacon the nearest chosen place that is left, so that none travels farther than need be."""
        left = list(chosen)
        out = []
        for i in range(moving):
            k = min(left, key=lambda j: float(np.linalg.norm(self.pool[j] - self.pool[i])))
            left.remove(k)
            out.append(k)
        return self.pool[out + left]

    def _judged(self, nodes: Floats, weight: Floats) -> float:
        self.tried += 1
        if self._on_done is not None and self.tried % 64 == 0:
            self._on_done(min(self.tried / self._total, 0.99))
        got = judge(nodes, weight, self._places, self._terms, self._shift)
        return cost(got, self._goal, self._fault_m, self._needed)
