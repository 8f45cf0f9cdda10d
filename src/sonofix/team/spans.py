"""When a robot takes part in what is smoothed, where its way may have jumped, and how it went at first sight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.belief import START_SD, Moment
from sonofix.team.feed import Feed
from sonofix.team.kernel import STRAYS, drive
from sonofix.team.pushed import SLIPPED, Push
from sonofix.team.recent import GATHER_S
from sonofix.team.state import POSE, SIZE, YAW

OPEN_SD = (10.0, 10.0, np.pi)
"""Of a pose of which nothing is known but the track so far, in m and rad."""


def spans(feed: Feed, moments: Sequence[Moment]) -> tuple[NDArray[np.bool_], Floats]:
    """Return which robots take part at each moment (k, V), and by what variances (k, V, POSE) their poses open then."""
    robots = len(feed.robots)
    placed = _placed(moments)
    active, opened = placed.copy(), np.zeros((len(moments), robots, POSE))
    times = np.array([moment.time_s for moment in moments])
    for r in range(robots):
        told = feed.odometry_s[feed.first[r] : feed.first[r + 1]]
        at = np.flatnonzero(placed[:, r])
        if not len(at) or not len(told):
            active[:, r] = False
            continue
        begin = min(int(np.searchsorted(times, told[0])), int(at[0]))
        active[begin : at[0], r] = True
        opened[begin, r] = np.square(START_SD if r in feed.starts and begin == 0 else OPEN_SD)
        again = at[1:][np.diff(at) > 1]
        opened[again, r] = np.square(OPEN_SD)
    for moment in moments:
        for push in moment.pushes:
            within = _within(push, times)
            # nobody knows when in that time, so as far and as likely in each part of it as the part is long
            share = np.diff(np.append(push.after_s, times[within])) / (push.until_s - push.after_s)
            opened[within, push.robot] += share[:, None] * np.square(SLIPPED)
    return active, opened


def _placed(moments: Sequence[Moment]) -> NDArray[np.bool_]:
    """Return which robots have a place at each moment (k, V), but for what was believed until all began anew.

    Later than clues are gathered for, that is nearer to where they were than odometry run backwards.
    """
    placed = np.array([moment.placed for moment in moments])
    for k, moment in enumerate(moments):
        if moment.anew and moment.time_s - moments[0].time_s <= GATHER_S:
            placed[:k, placed[k:].any(axis=0)] = False
    return placed


def contradicted(moments: Sequence[Moment], robots: int) -> Floats:
    """Return variances (k, V) by which places are open, as two contradict each other, since they last agreed."""
    variance = np.zeros((len(moments), robots))
    times = np.array([moment.time_s for moment in moments])
    for k, moment in enumerate(moments):
        for odds in moment.odds:
            since = slice(int(np.searchsorted(times, odds.agreed_s, side="right")), k + 1)
            for robot in odds.robots:
                variance[since, robot] = np.maximum(variance[since, robot], odds.variance_m2)
    return variance


def _within(push: Push, times: Floats) -> slice:
    """Return the moments at which a robot may have come to be elsewhere."""
    return slice(*np.searchsorted(times, (push.after_s, push.until_s), side="right").tolist())


def whole(feed: Feed, moments: Sequence[Moment], means: Floats, active: NDArray[np.bool_]) -> Floats:
    """Return means that reach back to each robot's first odometry, and from where pushes were found out to these.

    Before it was placed a robot's odometry is run backwards, and from where it was found to where it was pushed.
    """
    nominal = means.copy()
    times = np.array([moment.time_s for moment in moments])
    for r, placed in enumerate(_placed(moments).T):
        if placed.any():
            _backwards(feed, nominal, times, active, r, int(np.argmax(placed)), 0)
    for k, moment in enumerate(moments):
        for push in moment.pushes:
            within = _within(push, times)
            _backwards(feed, nominal, times, active, push.robot, k, within.stop - 1)
            own = slice(SIZE * push.robot, SIZE * push.robot + POSE)
            begin, end = nominal[max(within.start - 1, 0), own], nominal[within.stop - 1, own]
            gone = (times[within] - push.after_s) / (push.until_s - push.after_s)
            nominal[within, own] = begin + gone[:, None] * (end - begin)
    return nominal


def _backwards(
    feed: Feed, nominal: Floats, times: Floats, active: NDArray[np.bool_], robot: int, last: int, first: int
) -> None:
    """Run a robot's odometry backwards from one moment to another, in place."""
    own = slice(SIZE * robot, SIZE * (robot + 1))
    told = slice(feed.first[robot], feed.first[robot + 1])
    pose, by, stray, smooth_way = np.empty(POSE), np.empty((POSE, SIZE)), np.empty(STRAYS), np.ones(4)
    for k in range(last - 1, first - 1, -1):
        nominal[k, own] = nominal[k + 1, own]
        if not active[k, robot]:
            continue
        origin = np.concatenate([np.zeros(POSE), nominal[k + 1, own][POSE:]])
        drive(origin, feed.odometry_s[told], feed.odometry[told], times[k], times[k + 1], smooth_way, pose, by, stray)
        yaw = nominal[k + 1, own][YAW] - pose[2]
        cos, sin = np.cos(yaw), np.sin(yaw)
        back = np.array([cos * pose[0] - sin * pose[1], sin * pose[0] + cos * pose[1]])
        nominal[k, own][:2] = nominal[k + 1, own][:2] - back
        nominal[k, own][YAW] = yaw
