"""Where a robot is that was pushed, and since when: what was heard just before and after is heard anew, many ways.

A push takes a while, and what is heard meanwhile belongs to neither place. So what was heard of the robot since
shortly before that began is left out, and its place is opened for the latest, as much as tells a place and whether it
fits. Others that may have been pushed too can be left out as well. It is sought in all directions; where two places
would do, such as mirror images in the line of two others, and neither is much nearer, it is not found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.feed import SIGHTING, Feed
from sonofix.team.hear import REFUSED
from sonofix.team.state import POSE
from sonofix.track.wheels import ROBUST

if TYPE_CHECKING:
    from sonofix.team.belief import Belief
    from sonofix.team.rough import Learnt

SLIPPED = (3.0, 3.0, 0.5)
"""How far aside a robot may be found that was pushed, in m and rad."""

ITERATED = 8

SETTLED = 1e-3
"""In m and rad: a place that moved less from one linearisation to the next is found."""

SPARE = 2
"""Measurements that must fit beyond those that a pose takes: as many as are sought always do."""

SPAN_S = 0.3
"""What is heard within less may all be of a push that goes on."""

UNEXPLAINED = 1 / 3
"""The share of what was heard of others meanwhile that may be refused: else it was one of them that was pushed."""

LOOSE = 3.0
"""How many deviations more than is right their squares, over their variances, may come to in all."""

BEFORE = 3
"""So many times before the first that was refused, what was heard of it may be of the push already."""

DIRECTIONS = 8
"""In which it is sought besides."""

FARTHER = 2.0
"""What a place is taken to cost by each metre that it is off: pushes over a metre are e times rarer."""

RIVALS = 9.0
"""How much more another place must cost."""


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """A belief as it was before what was heard at an instant, and what was learnt of odometry until then.

    Of robots that were being pushed then, ``away`` (V,), nothing is heard anew; after that their places open.
    """

    time_s: float
    rows: tuple[int, int]
    mean: Floats
    covariance: Floats
    last: Floats
    rough: Floats
    learnt: Learnt
    away: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What hearing anew led to.

    Attributes
    ----------
    mean, covariance, last : float64 (n,), (n, n), (W, 2)
        Of the belief.
    past : sequence of Before
        What came since, as it was heard anew.
    shift : float64 (POSE,)
        How far aside the robot is from where its odometry has it.
    cost : float
        Squares, over their variances, of what the latest measurements of the robot left, and its distance.
    fits : bool
        Whether all these were taken, and fit together, and so does what was heard of others.
    missed_m : float
        The most by which a range of these was off.
    """

    mean: Floats
    covariance: Floats
    last: Floats
    past: Sequence[Before]
    shift: Floats
    cost: float
    fits: bool
    missed_m: float


@dataclass(frozen=True, slots=True)
class Push:
    """A robot was pushed some time after ``after_s``, when it was still where its track had it, and by ``until_s``."""

    robot: int
    after_s: float
    until_s: float


def search(
    belief: Belief, feed: Feed, robot: int, first: int, past: Sequence[Before], doubtful: Sequence[int] = ()
) -> tuple[Found, Push] | None:
    """Find a robot that was pushed.

    Parameters
    ----------
    belief : Belief
        Is left as it was.
    feed : Feed
    robot : int
    first : int
        The first row of it that was refused.
    past : sequence of Before
        Instants until now.
    doubtful : sequence of int
        Others of which nothing is to be heard.

    Returns
    -------
    Found and Push, or None
        None: too little was heard since to tell, nothing explains it, or more places than one do.
    """
    out = np.isin(np.arange(len(feed.robots)), doubtful)
    own = [k for k, before in enumerate(past) if any(_of(feed, robot, i, out) for i in range(*before.rows))]
    refused = next((k for k, before in enumerate(past) if before.rows[1] > first), len(past))
    before = [k for k in own if k < refused][-BEFORE:]
    begin = before[0] if before else 0
    over = next((k for k in reversed(own) if k >= refused and _told(feed, robot, past[k:], out)), None)
    if over is None:
        return None
    kept = belief.mean.copy(), belief.covariance.copy(), belief.last.copy(), belief.rough.copy()
    since = [replace(one, away=one.away | out) for one in past[begin:]]
    for k, one in enumerate(since):
        one.away[robot] = begin + k < over
    # what the push has taught of odometry is not so
    belief.rough[:] = since[0].rough
    near = _settled(belief, feed, robot, since, over - begin, np.zeros(POSE))
    turns = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    aside = near.missed_m * np.column_stack([np.cos(turns), np.sin(turns), np.zeros(DIRECTIONS)])
    found = [near, *(_settled(belief, feed, robot, since, over - begin, one) for one in aside)]
    belief.mean[:], belief.covariance[:], belief.last[:], belief.rough[:] = kept
    found = sorted((one for one in found if one.fits), key=lambda one: one.cost)
    at = belief.at(robot)
    for one in found[1:]:
        spread = np.trace(found[0].covariance[at, at][:2, :2])
        if one.cost - found[0].cost < RIVALS and np.sum((one.shift - found[0].shift)[:2] ** 2) > REFUSED * spread:
            return None
    if not found:
        return None
    return found[0], Push(robot, still_s(belief, feed, robot, first, past), past[over].time_s)


def still_s(belief: Belief, feed: Feed, robot: int, first: int, past: Sequence[Before]) -> float:
    """Return when a robot was last where its track had it, as two partners agree: round one alone it may be pushed.

    Arguments as `search` has them.
    """
    nobody = np.zeros(len(feed.robots), bool)
    before = [
        one for one in past if one.rows[1] <= first and any(_of(feed, robot, i, nobody) for i in range(*one.rows))
    ]
    kept = belief.mean.copy(), belief.covariance.copy(), belief.last.copy()
    agreed: set[tuple[int, int]] = set()
    found_s = float(np.nextafter((before or past)[0].time_s, -np.inf))
    for step in reversed(before):
        belief.mean[:], belief.covariance[:], belief.last[:] = step.mean, step.covariance, step.last
        _, told = _hear(belief, feed, step)
        for k, i in enumerate(range(*step.rows)):
            if not _of(feed, robot, i, step.away) or np.isnan(told[k, :, 0]).all():
                continue
            if np.any(told[k, :, 0] ** 2 > ROBUST**2 * (told[k, :, 1] + told[k, :, 3])):
                agreed.clear()
                break
            agreed.add(_partner(feed, robot, i))
        if len(agreed) >= 2:
            found_s = step.time_s
            break
    belief.mean[:], belief.covariance[:], belief.last[:] = kept
    return found_s


def _partner(feed: Feed, robot: int, row: int) -> tuple[int, int]:
    """Who is at a row's other end: a robot, or −1 and the number of the pair that a fixed end is told apart by."""
    other = int(feed.source[row] if feed.listener[row] == robot else feed.listener[row])
    return other, -1 if other >= 0 else int(feed.pair[row])


def _told(feed: Feed, robot: int, steps: Sequence[Before], out: NDArray[np.bool_]) -> bool:
    """Whether what was heard of a robot tells its pose, and whether it fits."""
    rows = [i for before in steps for i in range(*before.rows) if _of(feed, robot, i, out)]
    partners = {_partner(feed, robot, i) for i in rows}
    ranges, bearings = (int(np.isfinite(column[rows]).sum()) for column in (feed.range_m, feed.bearing_rad))
    if not rows or feed.time_s[rows[-1]] - feed.time_s[rows[0]] < SPAN_S:
        return False
    return len(partners) >= 2 and ranges + bearings >= 2 + bool(bearings) + SPARE


def _of(feed: Feed, robot: int, row: int, out: NDArray[np.bool_]) -> bool:
    """Whether a row is a sighting by a robot, or of it, and not of one that is ``out`` (V,)."""
    other, _ = _partner(feed, robot, row)
    ours = robot in (feed.listener[row], feed.source[row])
    return bool(feed.kind[row] == SIGHTING and ours and (other < 0 or not out[other]))


def _hear(belief: Belief, feed: Feed, step: Before, about: Floats | None = None) -> tuple[NDArray[np.bool_], Floats]:
    """Hear what came at an instant, as `Belief.hear` does, but nothing of robots that were away."""
    placed = belief.placed.copy()
    belief.placed &= ~step.away
    heard = belief.hear(feed, step.rows, about)
    belief.placed[:] = placed
    return heard


def _settled(belief: Belief, feed: Feed, robot: int, since: Sequence[Before], over: int, shift: Floats) -> Found:
    """Hear anew about what it leads to, until that stays (Bell and Cathey 1993)."""
    found = _again(belief, feed, robot, since, over, shift)
    for _ in range(ITERATED - 1):
        if np.max(np.abs(found.shift - shift)) < SETTLED:
            break
        shift = found.shift
        found = _again(belief, feed, robot, since, over, shift)
    return found


def _again(belief: Belief, feed: Feed, robot: int, since: Sequence[Before], over: int, shift: Floats) -> Found:
    """Hear what came ``since``; the robot is away until instant ``over``."""
    at, cost, count, fits, missed_m = belief.at(robot), 0.0, 0, True, 0.0
    heard = refused = 0
    belief.mean[:], belief.covariance[:], belief.last[:] = since[0].mean, since[0].covariance, since[0].last
    track, past = belief.mean.copy(), []
    for k, step in enumerate(since):
        back = np.arange(len(step.away)) == robot if k == over == 0 else np.zeros(len(step.away), bool)
        if k:
            own, shared = belief.mean.copy(), belief.covariance.copy()
            belief.mean[:] = track
            belief.drive(feed, since[k - 1].time_s, step.time_s)
            track = belief.mean.copy()
            belief.mean[:], belief.covariance[:] = own, shared
            belief.drive(feed, since[k - 1].time_s, step.time_s)
            back = since[k - 1].away & ~step.away
        for one in np.flatnonzero(back).tolist():
            belief.loosen(one, SLIPPED)
        past.append(
            replace(step, mean=belief.mean.copy(), covariance=belief.covariance.copy(), last=belief.last.copy())
        )
        about = belief.mean.copy()
        about[at] = track[at] + shift
        used, told = _hear(belief, feed, step, about)
        if k < over:
            continue
        mine = np.array([_of(feed, robot, i, step.away) for i in range(*step.rows)], bool)
        asked = np.isfinite(told[:, :, 2]) & np.isfinite(told[:, :, 0])
        heard += int(np.sum(asked[~mine]))
        refused += int(np.sum(asked[~mine] & ~used[~mine]))
        asked &= mine[:, None]
        cost += float(np.sum(told[asked][:, 0] ** 2 / (told[asked][:, 1] + told[asked][:, 3])))
        fits &= bool(used[asked].all())
        count += int(asked.sum())
        missed_m = max([missed_m, *np.abs(told[asked[:, 0], 0, 0]).tolist()])
    found = belief.mean[at] - track[at]
    fits &= cost <= count + LOOSE * np.sqrt(2.0 * count) and refused <= UNEXPLAINED * heard
    cost += FARTHER * float(np.hypot(*found[:2]))
    now = belief.mean.copy(), belief.covariance.copy(), belief.last.copy()
    return Found(*now, past, found, cost, fits, missed_m)
