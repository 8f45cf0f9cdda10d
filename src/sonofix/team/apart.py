"""The team as it truly is: each robot keeps an estimate of itself alone, by its own sensors and what others tell it.

When a robot hears another, both send a `Message`; each then corrects itself. What they tell may rest on things that
both know already, so it is fused by split covariance intersection (Julier and Uhlmann 2001; Li and Nashashibi 2013):
the part of an error that was ever told, or came from others, may be shared to any degree and is widened by 1/w and
1/(1 − w); the rest is a robot's own (`meeting`). So estimates are never surer than they may be, whoever tells whom
however often, joins or leaves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Event, Floats
from sonofix.team.belief import START_SD, Belief, Moment
from sonofix.team.feed import COMPASS, Feed
from sonofix.team.hear import TOLD as HEARD
from sonofix.team.hear import age
from sonofix.team.instants import instants, leave
from sonofix.team.joint import ASK_S
from sonofix.team.kernel import expect, turned_by
from sonofix.team.meeting import GAIN, Heard, Split, bends, judge, settle
from sonofix.team.message import SENT, TOLD, Message, unpack
from sonofix.team.noise import BEARING, NEW, STAYING, Noise, fade, noise, variance_of
from sonofix.team.placing import Placed, place
from sonofix.team.recent import Recent
from sonofix.team.rough import Rough
from sonofix.team.state import POSE, SCALE, SIZE, SLIP_S, SPEED_SLIP, TURN_SLIP, X, Y
from sonofix.team.watch import Watch

EVERY_S = 1.0
"""Two robots that meet tell each other no more often."""

SURE = (0.5, 0.3)
"""In m and rad: only a robot that knows its place so well may place another."""

UNSURE = (1.5, 0.6)
"""In m and rad: a robot that knows its place no better is to be placed anew, as corrections are no longer linear: of
headings that stray by σ, the way along their mean is exp(−σ²/2) of itself, a sixth less."""

PLACED_SD = (1.0, 0.5)
"""In m and rad: clues that tell no better place nobody."""


class Apart:
    """V robots' estimates of themselves, side by side; none looks into another's.

    ``belief`` holds them in one vector with no covariance between them; ``dependent`` (SIZE V, SIZE V) is the part of
    each covariance that others may share; each robot learns noise of its own. ``told`` counts messages.
    """

    def __init__(self, feed: Feed) -> None:
        self.feed = feed
        self.belief = Belief.blank(feed)
        self.dependent = np.zeros_like(self.belief.covariance)
        if feed.own_ranges:
            # nobody sees that the others' ranges err by the same share, but all know that they may
            scales = np.arange(SCALE, SIZE * len(feed.robots), SIZE)
            self.belief.covariance[np.ix_(scales, scales)] = np.diag(np.full(len(scales), feed.scale_sd**2))
            self.dependent[scales, scales] = feed.scale_sd**2
        told = len(feed.robots), feed.views, feed.own_ranges, feed.stated_sd_m
        self._noise: list[Noise] = [noise(*told) for _ in feed.robots]
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
            open_ = np.flatnonzero(np.diag(before) > 0)
            some = np.ix_(self._own[robot][open_], self._own[robot][open_])
            kept = np.linalg.solve(before[np.ix_(open_, open_)], belief.covariance[some]).T
            self.dependent[some] = kept @ self.dependent[some] @ kept.T
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
        time_s, stays = float(self.feed.time_s[row]), 0.0
        measured = np.full(4, np.nan)
        range_m = float(self.feed.range_m[row])
        measured[:2] = range_m, self.feed.bearing_rad[row]
        stated = self.feed.range_sd_m[row] ** 2 if np.isfinite(self.feed.range_sd_m[row]) else 0.0
        measured[2] = stated
        measured[3] = variance_of(told.known, listener, BEARING, range_m)
        if not told.believed:
            measured[2] += variance_of(told.known, listener, NEW, range_m) * told.swell[listener, 0]
            measured[3] *= told.swell[listener, 1]
            stays = float(np.sqrt(variance_of(told.known, listener, STAYING, range_m)))
        for end in (listener, source):
            self.rough.take(self.feed, self.belief, told, (row, row + 1), end, time_s)
        self._age(row, told)
        said = {
            listener: unpack(self._say(listener, time_s, measured, self._pair(row), stays)),
            source: unpack(self._say(source, time_s, np.full(4, np.nan), None, 0.0)),
        }
        self.told += 2
        heard = {
            robot: self._hear_of(row, robot == listener, said[other], measured, stays)
            for robot, other in ((listener, source), (source, listener))
        }
        used, found = np.zeros((1, 2), bool), np.full((1, 2, HEARD), np.nan)
        if not heard[listener].off.size:
            return used, found
        error = {robot: self._error(robot) for robot in heard}
        judged = {robot: judge(error[robot], heard[robot]) for robot in heard}
        for robot, other in ((listener, source), (source, listener)):
            corrected = judged[robot].corrected
            took = judged[other].corrected is not None
            left = settle(error[robot], corrected, took, heard[robot].rows)
            self.belief.covariance[self.own(robot)], self.dependent[self.own(robot)] = left.whole, left.shared
            if corrected is not None:
                self.belief.mean[self._own[robot]] += corrected.moved
            self.rough.slipped(self.belief, robot, time_s)
        said_of = judged[listener]
        at = np.flatnonzero(np.isfinite(measured[:2]))
        used[0, at] = said_of.used
        found[0, at, 0], found[0, at, 1] = heard[listener].off, said_of.expected
        found[0, at, 2] = found[0, at, 3] = said_of.taken
        return used, found

    def _pair(self, row: int) -> int | None:
        """Where the error of the pair stands that a row was heard by."""
        own = self.feed.own_ranges or not np.isfinite(self.feed.range_m[row])
        return None if own else SIZE * len(self.feed.robots) + int(self.feed.view[row])

    def _hear_of(self, row: int, listens: bool, other: Message, measured: Floats, stays: float) -> Heard:
        """Return what a row says of one of its ends, the other of which told of itself."""
        feed = self.feed
        robot = int(feed.listener[row] if listens else feed.source[row])
        here, there = (0, SIZE) if listens else (SIZE, 0)
        about, by, speed = np.zeros(2 * SIZE), np.zeros((2, 2 * SIZE)), np.zeros(2)
        about[here : here + SIZE] = self.belief.mean[SIZE * robot : SIZE * (robot + 1)]
        about[there + np.array(SENT)] = other.mean[: len(SENT)]
        speed[1] = self.belief.speed[feed.source[row]]
        shown, direction, _ = expect(
            about, 0, 1, feed.listener_point[row], feed.source_point[row], 1.0 / feed.sound_speed_mps, speed,
            feed.own_ranges, by,
        )  # fmt: skip
        own = self._own[robot]
        rows, others = np.zeros((2, len(own))), np.zeros((2, TOLD))
        rows[:, :SIZE], others[:, : len(SENT)] = by[:, here : here + SIZE], by[:, there + np.array(SENT)]
        pair = self._pair(row)
        if pair is not None and listens:
            rows[0, np.flatnonzero(own == pair)] = stays
            shown += stays * self.belief.mean[pair]
        elif not listens:
            others[0, -1] = 1.0
            shown += other.mean[-1]
        off = np.array([measured[0] - shown, turned_by(measured[1] - direction)])
        at = np.flatnonzero(np.isfinite(off))
        dx, dy = about[SIZE + X] - about[X], about[SIZE + Y] - about[Y]
        error = Split(other.covariance, other.dependent)
        place = Split(error.whole[:2, :2], error.shared[:2, :2])
        return Heard(off[at], rows[at], error.within(others[at]), measured[2:][at], bends(dx, dy)[at], place)

    def tell(self, robot: int) -> None:
        """Tell others a robot's pose."""
        told = self._error(robot).told(np.eye(POSE, len(self._own[robot])))
        self.dependent[self.own(robot)] = told.shared

    def _error(self, robot: int) -> Split:
        at = self.own(robot)
        return Split(self.belief.covariance[at], self.dependent[at])

    def _say(self, robot: int, time_s: float, measured: Floats, pair: int | None, stays: float) -> bytes:
        """Return a robot's message; ``pair``: where the error of what it measured stands, ``stays``: its metres."""
        at = np.append(np.array(SENT) + SIZE * robot, 0 if pair is None else pair)
        mean, both = self.belief.mean[at], np.ix_(at, at)
        covariance, dependent = self.belief.covariance[both], self.dependent[both]
        in_m = 0.0 if pair is None else stays
        mean[-1] *= in_m
        for square in (covariance, dependent):
            square[-1, :] *= in_m
            square[:, -1] *= in_m
        return Message(robot, time_s, mean, covariance, dependent, measured).pack()


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
    steps = instants(feed)
    for time_s, first, last in steps:
        events: list[Event] = []
        team.drive(time_s if now is None else now, time_s)
        now = time_s
        used, told = np.zeros((last - first, 2), bool), np.full((last - first, 2, HEARD), np.nan)
        for i in range(first, last):
            used[i - first], told[i - first] = (part[0] for part in team.hear(i))
        watch.see(feed, (first, last), used, told)
        while astray := watch.astray():
            robot = astray[0][0]
            watch.clear(robot)
            _lift(team, robot)
            recent.forget(robot)
            text = "what is heard disagrees with its track: to be placed anew"
            events.append(Event(time_s, feed.robots[robot], "lost", text))
        sure = _sure(belief)
        for robot in recent.add(belief.mean, sure, (first, last), sure, belief.covariance):
            team.tell(robot)
        if time_s - asked_s >= ASK_S:
            asked_s = time_s
            gone = leave(feed, belief.placed, recent, time_s, time_s - steps[0][0], events)
            for robot in gone:
                _lift(team, robot)
                watch.clear(robot)
            for robot in range(len(feed.robots)):
                if robot in gone:
                    continue
                if belief.placed[robot] and _unsure(belief, robot):
                    _lift(team, robot)
                    events.append(Event(time_s, feed.robots[robot], "lost", "it hardly knows where it is"))
                elif not sure[robot]:
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


def _lift(team: Apart, robot: int) -> None:
    at = team.belief.at(robot)
    team.belief.lift(robot)
    team.dependent[at, :] = team.dependent[:, at] = 0.0
    team.rough.forget(robot)


def _join(team: Apart, recent: Recent, robot: int, time_s: float, events: list[Event]) -> None:
    """Place a robot by landmarks and by what others said of themselves, whose errors may all be shared."""
    belief = team.belief
    clues = recent.clues(robot, time_s, _sure(belief), belief)
    found = None if clues is None else place(clues, belief.mean[belief.at(robot)], PLACED_SD)
    if found is None:
        return
    at = belief.at(robot)
    if belief.placed[robot]:
        if np.linalg.det(found.covariance) > GAIN * np.linalg.det(belief.covariance[at, at]):
            return
        event, text = "placed", "placed anew, as that is surer,"
        _lift(team, robot)
    else:
        event, text = "joined", "placed"
    belief.put(robot, Placed(found.pose, found.covariance, {}))
    team.dependent[at, at] = found.covariance
    x, y, yaw = found.pose
    text += f" at ({x:.3f}, {y:.3f}) m, heading {np.degrees(yaw) % 360:.0f}°"
    events.append(Event(time_s, team.feed.robots[robot], event, text))
