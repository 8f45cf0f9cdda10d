"""The team as it truly is: each robot keeps an estimate of itself alone, by its own sensors and what others tell it.

When a robot hears another, both send a `Message`; each then corrects itself. What they tell may rest on things that
both know already, so it is fused by split covariance intersection (Julier and Uhlmann 2001; Li and Nashashibi 2013):
the part of an error that was ever told, or came from others, may be shared to any degree and is widened by 1/w and
1/(1 − w); the part that grew since, by own odometry and landmarks, is a robot's own. After an exchange all of it has
been told. So estimates are never surer than they may be, whoever tells whom however often, joins or leaves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Event, Floats
from sonofix.team.feed import COMPASS, Feed
from sonofix.team.fleet import ASK_S, LEFT_S, START_SD, Belief, Moment, Watch, instants
from sonofix.team.hear import TOLD as HEARD
from sonofix.team.hear import age
from sonofix.team.message import SENT, Message, unpack
from sonofix.team.noise import BEARING, NEW, Noise, fade, noise, variance_of
from sonofix.team.placing import Placed, place
from sonofix.team.recent import Recent
from sonofix.team.rough import Rough
from sonofix.team.state import POSE, SIZE, SLIP_S, SPEED_SLIP, TURN_SLIP

SHARES = (0.3, 0.5, 0.7, 0.85, 0.95)
"""Weights w of a robot's own estimate that are tried; the one that leaves its place best known is taken."""

GAIN = 0.8
"""The determinant of a pose's covariance must fall to so much of itself, or nothing is changed."""

EVERY_S = 1.0
"""Two robots that meet tell each other no more often."""

SURE = (0.3, 0.2)
"""In m and rad: only a robot that knows its place so well may place another."""

UNSURE = (1.0, 0.35)
"""In m and rad: a robot that knows its place no better is to be placed anew, as corrections are no longer linear: of
headings that stray by σ, the way along their mean is exp(−σ²/2) of itself, 6 % less."""


class Apart:
    """V robots' estimates of themselves, side by side; none looks into another's.

    ``belief`` holds them in one vector with no covariance between them; ``dependent`` (SIZE V, SIZE V) is the part of
    each covariance that others may share; each robot learns noise of its own. ``told`` counts messages.
    """

    def __init__(self, feed: Feed) -> None:
        self.feed = feed
        self.belief = Belief.blank(feed)
        self.dependent = np.zeros_like(self.belief.covariance)
        self._noise: list[Noise] = [noise(len(feed.robots), feed.views, feed.own_ranges) for _ in feed.robots]
        self.rough = Rough(feed)
        robots = len(feed.robots)
        owner = np.full(0 if feed.own_ranges else feed.views, -1)
        if len(owner):
            owner[feed.view] = np.where(feed.listener >= 0, feed.listener, feed.source)
        self._own = [
            np.concatenate([np.arange(SIZE * r, SIZE * (r + 1)), SIZE * robots + np.flatnonzero(owner == r)])
            for r in range(robots)
        ]
        self._last_s: dict[tuple[int, int], float] = {}
        self.told = 0

    def own(self, robot: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where a robot's states stand in a covariance: its own, and the errors of what it hears of each."""
        at = self._own[robot]
        return np.ix_(at, at)  # pyright: ignore[reportReturnType]

    def drive(self, from_s: float, until_s: float) -> None:
        """Carry every robot on by its own odometry."""
        self.belief.drive(self.feed, from_s, until_s)
        for robot in np.flatnonzero(self.belief.placed).tolist():
            carry = np.eye(len(self._own[robot]))
            carry[SPEED_SLIP, SPEED_SLIP] = carry[TURN_SLIP, TURN_SLIP] = np.exp(-(until_s - from_s) / SLIP_S)
            carry[:POSE, :SIZE] = self.belief.by[robot]
            at = self.own(robot)
            self.dependent[at] = carry @ self.dependent[at] @ carry.T

    def hear(self, row: int) -> tuple[NDArray[np.bool_], Floats]:
        """Take one row in, at both its ends; return what `Belief.hear` does of it."""
        feed = self.feed
        ends = [robot for robot in (int(feed.listener[row]), int(feed.source[row])) if robot >= 0]
        told = self._noise[ends[0]]
        if len(ends) == 1 or feed.kind[row] == COMPASS:
            return self._alone(row, ends[0], told)
        time_s = float(feed.time_s[row])
        meeting = (min(ends), max(ends))
        often = time_s - self._last_s.get(meeting, -np.inf) < EVERY_S
        if often or not all(self.belief.placed[end] for end in ends):
            return np.zeros((1, 2), bool), np.full((1, 2, HEARD), np.nan)
        self._last_s[meeting] = time_s
        return self._exchange(row, ends[0], ends[1], told)

    def _alone(self, row: int, robot: int, told: Noise) -> tuple[NDArray[np.bool_], Floats]:
        """Correct a robot by what nobody else knows of."""
        at, belief, rows = self.own(robot), replace_noise(self.belief, told), (row, row + 1)
        time_s = float(self.feed.time_s[row])
        self.rough.take(self.feed, belief, told, rows, robot, time_s)
        renewed = self._age(row, told)
        before = belief.covariance[at].copy()
        used, found = belief.hear(self.feed, rows)
        found[:, 0, 5] = renewed
        belief.learn(self.feed, rows, used, found)
        self.rough.slipped(belief, robot, time_s)
        if used.any():
            # all corrections together are x' = A x + K z with A P = P'; states that are known have no part in it
            kept = belief.covariance[at] @ np.linalg.pinv(before, hermitian=True)
            self.dependent[at] = kept @ self.dependent[at] @ kept.T
        return used, found

    def _age(self, row: int, told: Noise) -> float:
        """Let a pair's error fade until now, in all that is known of it; return how much of it is new."""
        feed, belief = self.feed, self.belief
        if told.believed or feed.kind[row] == COMPASS or not np.isfinite(feed.range_m[row]):
            return 0.0
        view, time_s, range_m = int(feed.view[row]), float(feed.time_s[row]), float(feed.range_m[row])
        left = float(fade(time_s - belief.last[view, 0], range_m, belief.last[view, 1], told.fading))
        at = SIZE * len(feed.robots) + view
        age(belief.mean, belief.covariance, at, left)
        self.dependent[at, :] *= left
        self.dependent[:, at] *= left
        belief.last[view] = time_s, range_m
        return 1.0 - left**2

    def _exchange(self, row: int, listener: int, source: int, told: Noise) -> tuple[NDArray[np.bool_], Floats]:
        """Let two robots that meet tell each other, and correct themselves by it."""
        time_s = float(self.feed.time_s[row])
        measured = np.full(4, np.nan)
        measured[:2] = self.feed.range_m[row], self.feed.bearing_rad[row]
        if np.isfinite(measured[0]):
            measured[2] = variance_of(told.known, listener, NEW, measured[0]) * told.swell[listener, 0]
        measured[3] = variance_of(told.known, listener, BEARING, measured[0]) * told.swell[listener, 1]
        for end in (listener, source):
            self.rough.take(self.feed, self.belief, told, (row, row + 1), end, time_s)
        self._age(row, told)
        pair = None if told.believed else SIZE * len(self.feed.robots) + int(self.feed.view[row])
        said = {
            listener: unpack(self._say(listener, time_s, measured, pair)),
            source: unpack(self._say(source, time_s, np.full(4, np.nan), None)),
        }
        self.told += 2
        mean, covariance = self.belief.mean.copy(), self.belief.covariance.copy()
        result = np.zeros((1, 2), bool), np.full((1, 2, HEARD), np.nan)
        corrected: dict[int, tuple[Floats, Floats]] = {}
        heard = result
        for robot, other in ((listener, source), (source, listener)):
            best: tuple[float, Floats, Floats] | None = None
            for share in SHARES:
                bound = self._bound(mean, covariance, robot, said[other], share, pair if other == listener else None)
                heard = bound.hear_with(self.feed, row, told)
                at = self.own(robot)
                size = float(np.linalg.det(bound.belief.covariance[at][:POSE, :POSE]))
                if heard[0].any() and (best is None or size < best[0]):
                    best = size, bound.belief.mean[self._own[robot]], bound.belief.covariance[at]
                    if robot == listener:
                        result = heard
            now = float(np.linalg.det(covariance[self.own(robot)][:POSE, :POSE]))
            if best is not None and best[0] < GAIN * now:
                corrected[robot] = best[1], best[2]
            if robot == listener and best is None:
                result = heard
        for robot in (listener, source):
            at = self.own(robot)
            if robot in corrected:
                self.belief.mean[self._own[robot]], self.belief.covariance[at] = corrected[robot]
            self.dependent[at] = self.belief.covariance[at]
            self.rough.slipped(self.belief, robot, time_s)
        return result

    def _say(self, robot: int, time_s: float, measured: Floats, pair: int | None) -> bytes:
        """Return a robot's message; ``pair``: where the error of what it measured stands."""
        at = np.append(np.array(SENT) + SIZE * robot, 0 if pair is None else pair)
        mean, both = self.belief.mean[at], np.ix_(at, at)
        covariance, dependent = self.belief.covariance[both], self.dependent[both]
        if pair is None:
            mean[-1] = 0.0
            for square in (covariance, dependent):
                square[-1, :] = square[:, -1] = 0.0
        return Message(robot, time_s, mean, covariance, dependent, measured).pack()

    def _bound(
        self, mean: Floats, covariance: Floats, robot: int, other: Message, share: float, pair: int | None
    ) -> _Bound:
        """Return a belief of a robot and one that it hears of, which holds whatever they share."""
        bound = np.zeros_like(covariance)
        at = self.own(robot)
        bound[at] = covariance[at] + (1.0 / share - 1.0) * self.dependent[at]
        of = np.array(SENT) + SIZE * other.sender
        told = slice(len(of) + (pair is not None))
        of = of if pair is None else np.append(of, pair)
        widened = other.covariance + (1.0 / (1.0 - share) - 1.0) * other.dependent
        bound[np.ix_(of, of)] = widened[told, told]
        about = mean.copy()
        about[of] = other.mean[told]
        return _Bound(replace(self.belief, mean=about, covariance=bound, last=self.belief.last.copy()))


class _Bound:
    """A belief made for one correction."""

    def __init__(self, belief: Belief) -> None:
        self.belief = belief

    def hear_with(self, feed: Feed, row: int, told: Noise) -> tuple[NDArray[np.bool_], Floats]:
        """Take a row in, with what its listener knows of its noise."""
        return replace_noise(self.belief, told).hear(feed, (row, row + 1))


def replace_noise(belief: Belief, told: Noise) -> Belief:
    """Return the same belief, changed in place alike, with the noise that one robot has learnt."""
    return replace(belief, noise=told)


def follow_apart(feed: Feed) -> Iterator[tuple[Moment, Apart]]:
    """Run every robot's own filter over a feed, causally.

    Yields
    ------
    Moment, one an instant, and the robots behind it, which go on changing
    """
    team = Apart(feed)
    belief, watch, recent = team.belief, Watch(len(feed.robots)), Recent(feed)
    for robot, start in feed.starts.items():
        belief.put(robot, Placed(np.array(start), np.diag(np.square(START_SD)), {}))
    now: float | None = None
    asked_s = -np.inf
    for time_s, first, last in instants(feed):
        events: list[Event] = []
        team.drive(time_s if now is None else now, time_s)
        now = time_s
        used, told = np.zeros((last - first, 2), bool), np.full((last - first, 2, HEARD), np.nan)
        for i in range(first, last):
            used[i - first], told[i - first] = (part[0] for part in team.hear(i))
        watch.see(feed, (first, last), used, told)
        found = watch.astray()
        if found is not None:
            robot = found[0]
            watch.clear(robot)
            _lift(team, recent, robot)
            text = "what is heard disagrees with its track: to be placed anew"
            events.append(Event(time_s, feed.robots[robot], "lost", text))
        recent.add(belief.mean, belief.placed, (first, last), _sure(belief))
        if time_s - asked_s >= ASK_S:
            asked_s = time_s
            for robot in range(len(feed.robots)):
                if belief.placed[robot] and time_s - recent.told_s(robot, time_s) > LEFT_S:
                    _lift(team, recent, robot)
                    events.append(Event(time_s, feed.robots[robot], "left", f"nothing came of it for {LEFT_S:g} s"))
                elif belief.placed[robot] and _unsure(belief, robot):
                    _lift(team, recent, robot)
                    events.append(Event(time_s, feed.robots[robot], "lost", "it hardly knows where it is"))
                elif not belief.placed[robot]:
                    _join(team, recent, robot, time_s, events)
        yield belief.moment(time_s, (first, last), used, events), team


def _unsure(belief: Belief, robot: int) -> bool:
    return not _within(belief, robot, UNSURE)


def _within(belief: Belief, robot: int, sd: tuple[float, float]) -> bool:
    variance = np.diag(belief.covariance)[belief.at(robot)]
    return bool(max(variance[0], variance[1]) <= sd[0] ** 2 and variance[2] <= sd[1] ** 2)


def _sure(belief: Belief) -> NDArray[np.bool_]:
    """Return which robots may place others."""
    return belief.placed & [_within(belief, robot, SURE) for robot in range(len(belief.placed))]


def _lift(team: Apart, recent: Recent, robot: int) -> None:
    at = team.belief.at(robot)
    team.belief.lift(robot)
    team.dependent[at, :] = team.dependent[:, at] = 0.0
    team.rough.forget(robot)
    recent.forget(robot)


def _join(team: Apart, recent: Recent, robot: int, time_s: float, events: list[Event]) -> None:
    """Place a robot by landmarks and by what others said of themselves, whose errors may all be shared."""
    belief = team.belief
    clues = recent.clues(robot, time_s, _sure(belief))
    found = None if clues is None else place(clues, belief.mean[belief.at(robot)])
    if found is None:
        return
    covariance = found.covariance.copy()
    for who, by in found.by.items():
        covariance += len(found.by) * by @ belief.covariance[belief.at(who), belief.at(who)] @ by.T
    belief.put(robot, Placed(found.pose, covariance, {}))
    for who in (robot, *found.by):
        team.dependent[team.own(who)] = belief.covariance[team.own(who)]
    x, y, yaw = found.pose
    text = f"placed at ({x:.3f}, {y:.3f}) m, heading {np.degrees(yaw) % 360:.0f}°"
    events.append(Event(time_s, team.feed.robots[robot], "joined", text))
