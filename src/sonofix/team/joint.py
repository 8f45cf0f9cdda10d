"""The joint filter of a team as it lives on: what is believed, what was heard latest, and what is done about it."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Event, Floats, Innovation
from sonofix.team.belief import START_SD, Belief, Moment
from sonofix.team.feed import SIGHTING, Feed
from sonofix.team.fits import Fits
from sonofix.team.hear import TOLD
from sonofix.team.instants import leave
from sonofix.team.placing import Placed, place
from sonofix.team.pushed import SLIPPED, Before, Push, search, still_s
from sonofix.team.recent import Recent
from sonofix.team.rough import Rough
from sonofix.team.watch import Odds, Watch

ASK_S = 1.0
"""How often it is tried to place a robot."""

WAITED_S = 2.0
"""One that was pushed and is not found by then is lost."""

REWOUND_S = 4.0
"""A push is looked for so far back."""


class Team:
    """A joint filter over a feed, causally, instant by instant.

    ``belief`` goes on changing; ``feed`` is what is believed of the recording's, which may come to be less.
    ``until_placed``: a robot listens until it is placed, then drives by its odometry alone.
    """

    def __init__(self, feed: Feed, until_placed: bool = False) -> None:
        self.feed = feed
        self.belief = Belief.blank(feed)
        for robot, start in feed.starts.items():
            self.belief.put(robot, Placed(np.array(start), np.diag(np.square(START_SD)), {}))
        self.watch, self._recent, self._rough = Watch(len(feed.robots)), Recent(feed), Rough(feed)
        self.fits = Fits(feed)
        self._until_placed = until_placed
        self._past: deque[Before] = deque()
        self._begin_s = self._now_s = np.nan
        self._asked_s = self._left_s = -np.inf
        self._told_of: set[tuple[int, int]] = set()

    def believe(self, feed: Feed) -> None:
        """Go on by another part of the same recording."""
        self.feed = feed
        self._recent.believe(feed)

    def step(self, time_s: float, rows: tuple[int, int], unproven: Collection[int] = ()) -> Moment:
        """Carry all on to an instant, and take in what was heard then.

        ``unproven``: robots that are not sought where they are not where their tracks have them; while there are any,
        nothing is learnt of noise from how what is heard fits.
        """
        feed, belief = self.feed, self.belief
        events: list[Event] = []
        pushes: list[Push] = []
        if np.isnan(self._now_s):
            self._begin_s = self._now_s = time_s
        belief.drive(feed, self._now_s, time_s)
        self._now_s = time_s
        if time_s - self._left_s >= ASK_S:
            self._left_s = time_s
            since_s = time_s - self._begin_s
            for robot in leave(feed, belief.placed, self._recent, time_s, since_s, events):
                belief.lift(robot)
                self.watch.clear(robot)
                self.fits.clear(robot)
        frozen = self._until_placed and belief.placed.all()
        count = rows[1] - rows[0]
        used, told = np.zeros((count, 2), bool), np.full((count, 2, TOLD), np.nan)
        if count and not self._until_placed:
            before = belief.mean.copy(), belief.covariance.copy(), belief.last.copy(), belief.rough.copy()
            self._past.append(Before(time_s, rows, *before, self._rough.learnt(), np.zeros(len(feed.robots), bool)))
            while time_s - self._past[0].time_s > REWOUND_S:
                self._past.popleft()
            ends = {int(end) for i in range(*rows) for end in (feed.listener[i], feed.source[i])} - {-1}
            for robot in ends:
                self._rough.take(feed, belief, belief.noise, rows, robot, time_s)
            used, told = belief.hear(feed, rows)
            for robot in ends:
                self._rough.slipped(belief, robot, time_s)
            self.watch.see(feed, rows, used, told)
            if feed.starts:  # of nothing else is it asked
                self.fits.see(feed, time_s, rows, used, told)
            if (feed.kind[slice(*rows)] == SIGHTING).any():
                self._seek(unproven, events, pushes)
            if not unproven:
                belief.learn(feed, rows, used, told)
        if not frozen:
            self._recent.add(belief.mean, belief.placed, rows)
            if not belief.placed.all() and time_s - self._asked_s >= ASK_S:
                self._asked_s = time_s
                self._place(events)
        if any(event.event in ("joined", "left", "lost") for event in events):
            self._past.clear()  # it was before that
        odds = tuple(one for one in self.watch.at_odds() if not set(one.robots) & set(unproven))
        events += [event for one in odds if one.robots not in self._told_of for event in _odd(feed, one, time_s)]
        self._told_of = {one.robots for one in odds}
        moment = belief.moment(time_s, rows, used, events, pushes)
        moment = replace(moment, odds=odds, innovation=_innovation(time_s, used, told))
        for one in odds:
            moment.covariance[list(one.robots), :2, :2] += one.variance_m2 * np.eye(2)
        for robot, _ in self.watch.astray():
            # moved aside, and nobody knows yet where to
            moment.covariance[robot] += np.diag(np.square(SLIPPED))
        return moment

    def _place(self, events: list[Event]) -> None:
        """Place the robots that now can be."""
        belief = self.belief
        for robot in np.flatnonzero(~belief.placed).tolist():
            clues = self._recent.clues(robot, self._now_s, belief.placed)
            found = None if clues is None else place(clues, belief.mean[belief.at(robot)])
            if found is not None:
                belief.put(robot, found)
                events.append(Event(self._now_s, self.feed.robots[robot], "joined", placed_text(found.pose)))

    def _seek(self, unproven: Collection[int], events: list[Event], pushes: list[Push]) -> None:
        """Find robots that are not where their tracks have them, or take away their places; none of ``unproven``."""
        for _ in self.feed.robots:
            astray = self.watch.astray()
            for robot, first in astray:
                if robot in unproven:
                    continue
                others = [other for other, _ in astray if other != robot]
                if self._reopen(robot, first, others, events, pushes):
                    break
            else:
                return

    def _reopen(self, robot: int, first: int, others: Sequence[int], events: list[Event], pushes: list[Push]) -> bool:
        """Find a robot, first as if it alone were astray, or take its place away; return whether that is decided."""
        belief, feed, past = self.belief, self.feed, self._past
        now_s, name = past[-1].time_s, feed.robots[robot]
        told = None
        # it alone, it and one more, or all
        for doubtful in dict.fromkeys([(), *((other,) for other in others), tuple(others)]):
            told = search(belief, feed, robot, first, list(past), doubtful)
            if told is not None:
                break
        if told is None:
            if now_s - feed.time_s[first] < WAITED_S:
                return False
            if not self.watch.refused(robot):
                # measurements are worse than they were, and no other place explains them
                self.watch.clear(robot)
                return False
            was = next((one for one in past if one.rows[1] > first), past[-1])
            pushes.append(Push(robot, still_s(belief, feed, robot, first, list(past)), now_s))
            belief.lift(robot)
            self._recent.forget(robot)
            events.append(Event(now_s, name, "lost", "what is heard disagrees with its track: to be placed anew"))
        else:
            found, push = told
            was = found.past[0]
            pushes.append(push)
            belief.mean[:], belief.covariance[:], belief.last[:] = found.mean, found.covariance, found.last
            for _ in found.past:
                past.pop()
            past.extend(found.past)
            apart = float(np.hypot(*found.shift[:2]))
            text = f"what is heard disagrees with its odometry: {apart:.2f} m from where that had it"
            events.append(Event(now_s, name, "slip", text))
        for one in (robot, *others):
            self._rough.unlearn(belief, one, was.learnt, was.rough)
        self.watch.clear(robot)
        self.fits.clear(robot)
        return True


def _innovation(time_s: float, used: NDArray[np.bool_], told: Floats) -> Innovation | None:
    """Sum what `hear.hear` told of ranges and bearings; a compass is no part of it."""
    square = told[..., 6][used & np.isfinite(told[..., 6])]
    return Innovation(time_s, len(square), float(square.sum())) if len(square) else None


def placed_text(pose: np.ndarray) -> str:
    """Say where a robot is placed, (3,)."""
    x, y, yaw = pose
    return f"placed at ({x:.3f}, {y:.3f}) m, heading {np.degrees(yaw) % 360:.0f}°"


def _odd(feed: Feed, odds: Odds, time_s: float) -> list[Event]:
    if odds.refused:
        whose = " and ".join(feed.robots[robot] for robot in odds.refused)
        why = f"and most of what else is heard of {whose} is refused: are start poses right, and ranges in metres?"
    elif odds.alone:
        why = "and little else is heard of them: one of them is elsewhere"
    else:
        why = "while all else agrees: one of them is elsewhere"
    names = [feed.robots[robot] for robot in odds.robots]
    return [
        Event(time_s, name, "excluded", f"its ranges with {other} are off by {odds.miss_m:.2f} m, {why}")
        for name, other in zip(names, names[::-1], strict=True)
    ]
