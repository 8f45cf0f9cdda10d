"""The team as one: a joint filter over all robots, with every measurement taken in at its own time, exactly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sonofix.team.belief import Belief, Moment
from sonofix.team.compasses import Compasses
from sonofix.team.feed import Feed
from sonofix.team.instants import instants
from sonofix.team.joint import Team
from sonofix.team.landmarks import Landmarks
from sonofix.team.proof import Proof
from sonofix.team.recent import GATHER_S


def follow(feed: Feed, until_placed: bool = False) -> Iterator[tuple[Moment, Belief]]:
    """Run the joint filter over a feed, causally.

    Parameters
    ----------
    feed : Feed
    until_placed : bool
        A robot listens until it is placed, then drives by its odometry alone: what odometry is worth.

    Yields
    ------
    Moment, one an instant, and the belief behind it, which goes on changing; where something stated is gainsaid
    another takes its place
    """
    if until_placed:
        team = Team(feed, until_placed)
        for time_s, first, last in instants(feed):
            yield team.step(time_s, (first, last)), team.belief
        return
    steps = instants(feed)
    told, landmarks = _Told(feed), Landmarks(feed)
    wrong: set[int] = set()
    gainsaid: set[int] = set()
    for k, (time_s, first, last) in enumerate(steps):
        moment = told.step(time_s, (first, last))
        wrong |= set(moment.unheard)
        gainsaid |= set(moment.gainsaid)
        pairs, events = landmarks.judge(told.sure, time_s, (first, last))
        if pairs:
            wrong |= pairs
            since = next(i for i, step in enumerate(steps) if time_s - step[0] <= GATHER_S)
            before = moment
            left = feed.without(gainsaid if since == 0 else feed.starts, wrong)
            moment, told = _again(left, steps[since : k + 1], before)
            wrong |= set(moment.unheard)
            gainsaid |= set(moment.gainsaid)
            moment = replace(
                moment,
                events=(*before.events, *events, *moment.events),
                gainsaid=(*before.gainsaid, *moment.gainsaid),
                unheard=(*before.unheard, *moment.unheard, *pairs),
                anew=True,
            )
        yield moment, told.team.belief


class _Told:
    """A team that is told where it starts, and how it heads, and believes what is borne out."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._compasses = Compasses(feed)
        believed = feed.without((), self._compasses.unheard)
        self.team, self._proof = Team(believed), Proof(believed)

    @property
    def sure(self) -> Belief:
        """What rests on nothing that is not borne out yet."""
        return self._proof.unmoved if self._proof.starts else self.team.belief

    def step(self, time_s: float, rows: tuple[int, int]) -> Moment:
        """Carry it on to an instant."""
        if self._proof.starts:
            moment, self.team = self._proof.step(self.team, time_s, rows)
        else:
            moment = self.team.step(time_s, rows)
        before = len(self._compasses.unheard)
        wrong, events = self._compasses.judge(self.team.belief, rows, self._proof.starts)
        if len(self._compasses.unheard) < before:
            believed = self._feed.without((), self._compasses.unheard)
            self.team.believe(believed)
            self._proof.believe(believed)
        return replace(moment, events=(*moment.events, *events), unheard=tuple(wrong))


def _again(feed: Feed, steps: list[tuple[float, int, int]], before: Moment) -> tuple[Moment, _Told]:
    """Hear again what was heard at some instants; return the last moment, with what was found wrong on the way.

    ``before``: what was believed at the last of them till now; robots that had a place then do not join once more.
    """
    told = _Told(feed)
    moments = [told.step(time_s, (first, last)) for time_s, first, last in steps]
    had = {feed.robots[robot] for robot in np.flatnonzero(before.placed).tolist()}
    events = [
        replace(event, time_s=before.time_s)
        for moment in moments
        for event in moment.events
        if event.event in ("reset", "excluded") or (event.event == "joined" and event.vehicle not in had)
    ]
    gainsaid = tuple(robot for moment in moments for robot in moment.gainsaid)
    unheard = tuple(pair for moment in moments for pair in moment.unheard)
    return replace(moments[-1], gainsaid=gainsaid, unheard=unheard, events=tuple(events)), told
