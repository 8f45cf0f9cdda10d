"""Whether robots start as is stated: judged by a team that was not told.

Beside the team's filter runs another that knows no start pose: robots join it by what is heard and by their odometry.
A start, carried on by odometry, is a claim of where a robot is now; once the other filter has it settled, both are
compared. What agrees is proven. What does not is gainsaid, and the other filter, which no wrong start ever touched, is
the team's from then on. Until a start was borne out by what is heard (`fits`) no push of its robot is sought.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonofix.records import Event, Floats
from sonofix.team.belief import START_SD, Belief, Moment
from sonofix.team.feed import SIGHTING, Feed
from sonofix.team.joint import Team, placed_text
from sonofix.team.kernel import STRAYS, drive, strayed, turned_by
from sonofix.team.placing import Placed
from sonofix.team.recent import lasting
from sonofix.team.state import POSE, SIZE, SPEED_SLIP, TURN_SLIP, YAW, prior

SETTLED_S = 3.0
"""A robot that joined the other filter, and agrees with what is heard for so long, is where that has it."""

GAINSAID = 25.0
"""Square, over its variance, at which a start is gainsaid: by chance one in 10⁵ is (χ² of three)."""

TURNS = 10
"""Linearisations at most: of ways whose turns are known to a tenth, ends lie on a bow."""

STANDS_S = 30.0
"""A start that nothing heard has decided on for so long is taken as stated, where none disagreed with others."""

OPEN_SD = (3.0, 3.0, 1.5)
"""By how much, in m and rad, poses are open that start as stated, once what was heard disagreed."""


class Proof:
    """Judges the stated starts of a feed; ``starts`` are those of robots that it has not judged yet."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        # where no fixed end is heard nothing could gainsay them
        self.starts = set(feed.starts) if feed.of_fixed.any() else set()
        self._other = Team(feed.without(self.starts, ()))
        self._reckoned = Belief.blank(feed)
        for robot, start in feed.starts.items():
            self._reckoned.put(robot, Placed(np.array(start), np.diag(np.square(START_SD)), {}))
        self._heard_s, self._settled_s = np.full(len(feed.robots), np.nan), np.full(len(feed.robots), np.nan)
        self._joined: dict[int, tuple[float, Floats, Floats]] = {}
        self._begin_s = self._now_s = np.nan
        self._doubted: set[int] = set()

    @property
    def unmoved(self) -> Belief:
        """What no stated start has touched."""
        return self._other.belief

    def believe(self, feed: Feed) -> None:
        """Go on by another part of the same recording."""
        self._other.believe(feed)

    def step(self, team: Team, time_s: float, rows: tuple[int, int]) -> tuple[Moment, Team]:
        """Carry a team on to an instant, and judge where it started; return the team that goes on."""
        first = team is not self._other
        unproven = self.starts - team.fits.stood if first else set[int]()
        moment = team.step(time_s, rows, unproven)
        if np.isnan(self._now_s):
            self._begin_s = self._now_s = time_s
        self._reckoned.drive(self._feed, self._now_s, time_s)
        self._now_s = time_s
        if first:
            self._other.step(time_s, rows)
            # where it started no longer matters of one that left, nor of one that was pushed or lost after it had stood
            self.starts -= {push.robot for push in moment.pushes} | set(np.flatnonzero(~team.belief.placed).tolist())
            self._doubted |= team.fits.doubted
            # they may come to fit, wrong as they are, and one that starts wrong drags others along
            for robot in self.starts if team.fits.open else ():
                moment.covariance[robot] += np.diag(np.square(OPEN_SD))
        self._note(rows)
        wrong, events = self._judge(team)
        if wrong and first:
            events += self._instead(team)
            team = self._other
            told = team.belief.moment(time_s, rows, moment.used, (*moment.events, *events))
            return replace(told, gainsaid=wrong, anew=True), team
        if first and unproven and not self.starts:
            team.belief.noise.take_over(self._other.belief.noise)
        return replace(moment, events=(*moment.events, *events), gainsaid=wrong), team

    def _instead(self, team: Team) -> list[Event]:
        """Tell of robots that have a place in only one of a team and the other, which goes on instead."""
        had, has, names = team.belief.placed, self._other.belief.placed, self._feed.robots
        why = "its place rested on starts that are gainsaid: to be placed anew"
        lost = [Event(self._now_s, names[r], "lost", why) for r in np.flatnonzero(had & ~has).tolist()]
        mean = self._other.belief.mean
        joined = [
            Event(self._now_s, names[r], "joined", placed_text(mean[self._other.belief.at(r)]))
            for r in np.flatnonzero(has & ~had).tolist()
        ]
        return lost + joined

    def _note(self, rows: tuple[int, int]) -> None:
        """Note who was heard, and who is where the other filter has it."""
        feed, placed = self._feed, self._other.belief.placed
        for i in range(*rows):
            for end in (int(feed.listener[i]), int(feed.source[i])):
                if end >= 0 and feed.kind[i] == SIGHTING and np.isnan(self._heard_s[end]):
                    self._heard_s[end] = self._now_s
        for robot in range(len(feed.robots)):
            if not placed[robot] or self._other.watch.disagrees(robot):
                self._settled_s[robot] = np.nan
            elif np.isnan(self._settled_s[robot]):
                self._settled_s[robot] = self._now_s
                at = self._other.belief.at(robot)
                there = self._other.belief.mean[at].copy(), self._other.belief.covariance[at, at].copy()
                self._joined[robot] = self._now_s, *there

    def _judge(self, team: Team) -> tuple[tuple[int, ...], list[Event]]:
        """Compare starts with where the other filter has robots; return those gainsaid.

        Where the other is the team already, one that is taken as stated is put where it leads to.
        """
        wrong: list[int] = []
        events: list[Event] = []
        other, reckoned, stands = self._other.belief, self._reckoned, team is not self._other
        for robot in sorted(self.starts):
            at = other.at(robot)
            if not self._now_s - self._settled_s[robot] >= SETTLED_S:
                heard_s = self._heard_s[robot]
                since_s = heard_s if np.isfinite(heard_s) else self._begin_s
                # while the team goes by starts, one that is wrong may draw others to where they are not
                if self._now_s - since_s > STANDS_S and not (stands and self._doubted & self.starts):
                    self.starts.discard(robot)
                    if not stands and not other.placed[robot] and robot not in self._doubted:
                        other.put(robot, Placed(reckoned.mean[at].copy(), reckoned.covariance[at, at].copy(), {}))
                        told = placed_text(other.mean[at])
                        events.append(Event(self._now_s, self._feed.robots[robot], "joined", told))
                continue
            self.starts.discard(robot)
            off = reckoned.mean[at] - other.mean[at]
            off[YAW] = turned_by(off[YAW])
            now = self._now_s, other.mean[at], other.covariance[at, at]
            # as it joined less was driven; now more is known of where it is
            far = max(unlikely(self._feed, robot, self._begin_s, *then) for then in (self._joined[robot], now))
            if far > GAINSAID and stands and not team.fits.misfits and not self._meet(team, robot):
                # all fits as it is, and the other may have joined at a mirror image
                if self._now_s - self._heard_s[robot] <= STANDS_S:
                    self.starts.add(robot)
                continue
            if far > GAINSAID:
                wrong.append(robot)
                text = (
                    f"what is heard gainsays how it was stated to start, by {np.hypot(*off[:2]):.2f} m and "
                    f"{abs(np.degrees(off[YAW])):.0f}° by now: placed by what is heard; "
                    "is start.csv right, or was it pushed soon after?"
                )
                events.append(Event(self._now_s, self._feed.robots[robot], "reset", text))
        return tuple(wrong), events

    def _meet(self, team: Team, robot: int) -> bool:
        """Whether a team has a robot by now where the other filter has it: then it is the start that is off."""
        at = team.belief.at(robot)
        off = team.belief.mean[at] - self._other.belief.mean[at]
        off[YAW] = turned_by(off[YAW])
        known = self._other.belief.covariance[at, at] + team.belief.covariance[at, at]
        return float(off @ np.linalg.solve(known, off)) < GAINSAID


def unlikely(feed: Feed, robot: int, begin_s: float, now_s: float, pose: Floats, covariance: Floats) -> float:
    """Return how unlikely it is that a robot came from its start to a pose (3,), known to (3, 3), as χ² of three.

    By the likeliest start and errors of odometry that lead there: an iterated Kalman correction (Bell and Cathey 1993).
    """
    told = slice(feed.first[robot], feed.first[robot + 1])
    begin, known = np.zeros(SIZE), prior(1, feed.own_ranges, feed.scale_sd)
    begin[:POSE] = feed.starts[robot]
    known[:POSE, :POSE] = np.diag(np.square(START_SD))
    slips = np.arange(SIZE)[[SPEED_SLIP, TURN_SLIP]]
    known[slips, slips] *= lasting(now_s - begin_s)
    free = np.flatnonzero(np.diag(known) > 0)
    own, end, by = begin.copy(), np.empty(POSE), np.empty((POSE, SIZE))
    stray, noise, plain = np.empty(STRAYS), np.empty((POSE, POSE)), np.ones(4)
    least = np.inf
    for _ in range(TURNS):
        drive(own, feed.odometry_s[told], feed.odometry[told], begin_s, now_s, plain, end, by, stray)
        strayed(by, stray, noise)
        off = pose - end
        off[YAW] = turned_by(off[YAW])
        left = noise + covariance
        # of any way there this is a bound, of the likeliest it is what is sought
        least = min(
            least, float(np.sum((own - begin)[free] ** 2 / known[free, free]) + off @ np.linalg.solve(left, off))
        )
        gain = np.linalg.solve(by @ known @ by.T + left, off - by @ (begin - own))
        moved = begin + known @ by.T @ gain - own
        own += moved
        if np.max(np.abs(moved)) < 1e-4:
            break
    return least
