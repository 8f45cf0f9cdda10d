"""Leaps tried in thought to the end of a course: many strips at once, by the covariance that they would leave.

Leaps are of one kind: a robot goes past the foremost of those that stand, to the other side of the course, so that
three robots leave a strip of triangles behind. Robots land beside where they should, as their odometry errs, and the
strip bends more for it: a strip is tried with several such courses, the same for all strips, and its error is the root
mean square over them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.leapfrog import Formation

Ints = NDArray[np.int64]

MOST_LEAPS = 1000

TRIED = 4
"""Courses a strip, of landings beside the mark: two, and their mirror images."""

ROOM_SD = 3.0
"""Deviations by which the next leap may land beside its mark and still be within reach."""

ARRIVED_M = 1e-6
"""So near to its end a course is done."""


@dataclass(frozen=True, slots=True)
class Ranging:
    """How well two robots that stand range each other.

    Attributes
    ----------
    sd_m, at_m : float
        Deviation of the range that all epochs of one stop make together, at one distance.
    absorption_db_per_m : float
        Elsewhere sound is weaker by spreading and absorption, and ranges are worse in proportion to its amplitude.
    reach_m : float
        No burst is heard from farther away.
    """

    sd_m: float
    at_m: float
    absorption_db_per_m: float
    reach_m: float

    def variance_m2(self, distance_m: Floats) -> Floats:
        """Return the variance of each range over distances of any shape."""
        d = np.asarray(distance_m, np.float64)
        weaker = d / self.at_m * 10 ** (self.absorption_db_per_m * (d - self.at_m) / 20)
        return (self.sd_m * weaker) ** 2

    def covariance_m2(self, distance_m: Floats) -> Floats:
        """Return the covariance (n, n) of ranges over distances (n,)."""
        return np.diag(self.variance_m2(distance_m))


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Where the team goes: from ``start_m`` (2,) so far, straight on by ``heading_rad``."""

    start_m: Floats
    heading_rad: float
    length_m: float

    def along_and_across(self, place_m: Floats) -> Floats:
        """Places (…, 2) along the course and to its left."""
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        return (place_m - self.start_m) @ np.array([[cos, -sin], [sin, cos]])

    def place(self, along_and_across_m: Floats) -> Floats:
        """Return places (…, 2) that are so far along and to the left."""
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        return self.start_m + along_and_across_m @ np.array([[cos, sin], [-sin, cos]])

    def arrived(self, place_m: Floats) -> bool:
        """Whether one of places (…, 2) is at the end."""
        return bool((self.along_and_across(place_m)[..., 0] >= self.length_m - ARRIVED_M).any())


@dataclass(frozen=True, slots=True, eq=False)
class Tries:
    """What came of strips tried ahead, a strip a row.

    Attributes
    ----------
    place_m : float64 (n, 2)
        Where the first leap goes.
    leaps : int64 (n,)
        To the end of the course, the mean rounded.
    end_sd_m : float64 (n,)
        √(σx² + σy²) of the robot that arrives; NaN where robots would be sent out of reach of each other on the way.
    """

    place_m: Floats
    leaps: Ints
    end_sd_m: Floats


def hindmost(formation: Formation, course: Course) -> str:
    """Return the robot that is least far along: the one that leaps next in the long run."""
    return formation.robots[int(np.argmin(course.along_and_across(formation.place_m)[:, 0]))]


def landing(place_m: Floats, who: Ints, course: Course, step_m: Floats, width_m: Floats) -> Floats:
    """Return where leaps go: past the foremost of the others, on the other side, not past the end.

    Parameters
    ----------
    place_m : float64 (n, N, 2)
        Of all robots, a team a row.
    who : int64 (n,)
        The robot of each that leaps.
    step_m, width_m : float64 (n,)
        Of the strip: how far each robot goes along at a time in the long run, and its width.

    Returns
    -------
    float64 (n, 2)
    """
    row = np.arange(len(place_m))
    along, across = np.moveaxis(course.along_and_across(place_m), -1, 0)
    along = along.copy()
    along[row, who] = -np.inf
    foremost = np.argmax(along, axis=1)
    to = np.minimum(along[row, foremost] + np.asarray(step_m) / place_m.shape[1], course.length_m)
    return course.place(np.stack([to, -np.copysign(np.asarray(width_m) / 2, across[row, foremost])], axis=-1))


def ahead(
    formation: Formation,
    course: Course,
    ranging: Ranging,
    way_sd: float,
    step_m: Floats,
    width_m: Floats,
    first: Ints | None = None,
) -> Tries:
    """Try leaps to the end of a course in thought; all range each other after each.

    Parameters
    ----------
    way_sd : float
        Deviation of odometry, a share of the way.
    step_m, width_m : float64 (n,)
        Of the strips, as in `landing`.
    first : int64 (n,), optional
        The robot that leaps first; then always the hindmost.
    """
    strips = len(step_m)
    step, width = np.repeat(np.asarray(step_m, np.float64), TRIED), np.repeat(np.asarray(width_m, np.float64), TRIED)
    live, tried = np.arange(strips * TRIED), np.tile(np.arange(TRIED), strips)
    beside = _beside()
    place = np.repeat(formation.place_m[None], len(live), axis=0)
    covariance = np.repeat(formation.covariance[None], len(live), axis=0)
    goal, leaps, variance = np.full((len(live), 2), np.nan), np.zeros(len(live)), np.full(len(live), np.nan)
    for count in range(MOST_LEAPS):
        if not len(live):
            break
        row = np.arange(len(live))
        who = np.argmin(course.along_and_across(place)[..., 0], axis=1)
        if count == 0 and first is not None:
            who = np.repeat(np.asarray(first), TRIED)
        to = landing(place, who, course, step[live], width[live])
        if count == 0:
            goal = to
        way_m = np.hypot(*(to - place[row, who]).T)
        place[row, who] = to
        room_m = 0.0 if count else ROOM_SD * way_sd * way_m
        heard = _farthest_m(place, who) + room_m <= ranging.reach_m
        place[row, who] += way_sd * way_m[:, None] * beside[count, tried[live]]
        covariance = _ranged(place, covariance, formation.scale, ranging, who, (way_sd * way_m) ** 2)
        reached_m = np.maximum(*(course.along_and_across(p)[:, 0] for p in (to, place[row, who])))
        done = reached_m >= course.length_m - ARRIVED_M  # meant to be there, or past it by chance
        own_m2 = covariance[row, 2 * who, 2 * who] + covariance[row, 2 * who + 1, 2 * who + 1]
        leaps[live], variance[live] = count + 1, np.where(done & heard, own_m2, np.nan)
        going = heard & ~done
        live, place, covariance = live[going], place[going], covariance[going]
    mean_m2, mean = (value.reshape(strips, TRIED).mean(axis=1) for value in (variance, leaps))
    return Tries(goal[::TRIED], np.rint(mean).astype(np.int64), np.sqrt(mean_m2))


@cache
def _beside() -> Floats:
    """Where robots land beside their marks (leaps, courses, 2), in deviations: one pattern for good."""
    half = np.random.default_rng(1).standard_normal((MOST_LEAPS, TRIED // 2, 2))
    return np.concatenate([half, -half], axis=1)


def _farthest_m(place: Floats, who: Ints) -> Floats:
    """Distance (n,) from a robot of each team (n, N, 2) to the farthest of the others."""
    apart = place - place[np.arange(len(place)), who][:, None]
    return np.hypot(apart[..., 0], apart[..., 1]).max(axis=1)


def _ranged(place: Floats, covariance: Floats, scale: float, ranging: Ranging, who: Ints, moved_m2: Floats) -> Floats:
    """Covariances (n, S, S) of teams at places (n, N, 2) once a robot of each has moved and all range each other.

    As `leapfrog.leapt` leaves them; ``moved_m2`` (n,) is the variance of the way on either axis.
    """
    row, robots = np.arange(len(place)), place.shape[1]
    opened = covariance.copy()
    for axis in (0, 1):
        opened[row, 2 * who + axis, 2 * who + axis] += moved_m2
    one, other = np.array(list(combinations(range(robots), 2))).T
    apart = place[:, other] - place[:, one]
    distance = np.maximum(np.hypot(apart[..., 0], apart[..., 1]), 1e-9)
    unit = (1.0 + scale) * apart / distance[..., None]
    derivative = np.zeros((len(place), len(one), 2 * robots + 1))
    pair = np.arange(len(one))
    for axis in (0, 1):
        derivative[:, pair, 2 * other + axis] = unit[..., axis]
        derivative[:, pair, 2 * one + axis] = -unit[..., axis]
    derivative[..., -1] = distance
    noise = ranging.variance_m2(distance)
    crossed = derivative @ opened
    spread = crossed @ derivative.swapaxes(1, 2)
    spread[:, pair, pair] += noise
    gain = np.linalg.solve(spread, crossed).swapaxes(1, 2)
    # Joseph form
    kept = np.eye(2 * robots + 1) - gain @ derivative
    return kept @ opened @ kept.swapaxes(1, 2) + (gain * noise[:, None]) @ gain.swapaxes(1, 2)
