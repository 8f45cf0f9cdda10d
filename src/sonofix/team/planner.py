"""Who moves next, and how far: leaps tried ahead to the end of a course, by the covariance they would leave.

Leaps are of one kind: a robot goes past the foremost of those that stand, to the other side of the course, so that
three robots leave a strip of triangles behind. Wide strips bend less (the error across the course goes with the
ranges' error over the width), long steps need fewer leaps, and both are paid for with longer, weaker ranges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Literal

import numpy as np

from sonofix.records import Floats
from sonofix.team.leapfrog import Formation, Pair, foreseen

STEPS_M = (5.0, 7.5, 10.0, 12.5, 15.0, 20.0, 25.0, 30.0)
WIDTHS_M = (5.0, 7.5, 10.0, 12.5, 15.0, 20.0)

MOST_LEAPS = 1000


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

    def covariance_m2(self, distance_m: Floats) -> Floats:
        """Return the covariance (n, n) of ranges over distances (n,)."""
        d = np.asarray(distance_m, np.float64)
        weaker = d / self.at_m * 10 ** (self.absorption_db_per_m * (d - self.at_m) / 20)
        return np.diag((self.sd_m * weaker) ** 2)


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

    def place(self, along_m: float, across_m: float) -> Floats:
        """Return the place (2,) so far along and to the left."""
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        return self.start_m + np.array([cos * along_m - sin * across_m, sin * along_m + cos * across_m])


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """The next leap, and what the course would end with.

    Attributes
    ----------
    status : "ok", "beyond" (no plan ends as well as wanted: this one ends best), "unreachable" (none keeps in reach)
    remedy : str
        Empty where ok.
    robot : str
        Who moves next; empty where unreachable.
    place_m : float64 (2,)
        Where to.
    step_m, width_m : float
        Of the strip: how far along the course each robot goes at a time in the long run, and its width.
    leaps : int
        To the end of the course, this one included.
    end_sd_m : float
        √(σx² + σy²) of the robot that arrives.
    """

    status: Literal["ok", "beyond", "unreachable"]
    remedy: str
    robot: str
    place_m: Floats
    step_m: float
    width_m: float
    leaps: int
    end_sd_m: float


def landing(formation: Formation, robot: str, course: Course, step_m: float, width_m: float) -> Floats:
    """Return the place (2,) of a robot's next leap: past the foremost other, on the other side, not past the end."""
    others = [i for i, name in enumerate(formation.robots) if name != robot]
    placed = course.along_and_across(formation.place_m[others])
    foremost = placed[np.argmax(placed[:, 0])]
    along = min(float(foremost[0]) + step_m / len(formation.robots), course.length_m)
    return course.place(along, -np.copysign(width_m / 2, float(foremost[1])))


def hindmost(formation: Formation, course: Course) -> str:
    """Return the robot that is least far along: the one that leaps next in the long run."""
    return formation.robots[int(np.argmin(course.along_and_across(formation.place_m)[:, 0]))]


def ahead(
    formation: Formation,
    course: Course,
    ranging: Ranging,
    way_sd: float,
    step_m: float,
    width_m: float,
    first: str | None = None,
) -> tuple[list[tuple[str, Floats]], list[Formation]] | None:
    """Try leaps to the end of a course in thought.

    Parameters
    ----------
    way_sd : float
        Deviation of odometry, a share of the way.
    first : str, optional
        Who leaps first; then always the hindmost.

    Returns
    -------
    leaps : list of (robot, place)
    formations : list of Formation
        What would be known after each; or None where robots would be out of reach of each other.
    """
    leaps: list[tuple[str, Floats]] = []
    known: list[Formation] = []
    now = formation
    while len(leaps) < MOST_LEAPS:
        if course.along_and_across(now.place_m)[:, 0].max() >= course.length_m - 1e-6:
            return leaps, known
        robot = first if first is not None and not leaps else hindmost(now, course)
        to_m = landing(now, robot, course, step_m, width_m)
        way = to_m - now.place_m[now.index(robot)]
        pairs, distance = among(now, robot, to_m)
        if distance.max() > ranging.reach_m:
            return None
        noise = ranging.covariance_m2(distance)
        now = foreseen(now, robot, way, (way_sd * float(np.hypot(*way))) ** 2 * np.eye(2), pairs, noise)
        leaps.append((robot, to_m))
        known.append(now)
    return None


def among(formation: Formation, robot: str, to_m: Floats) -> tuple[list[Pair], Floats]:
    """All pairs of the team, and their distances (n,) once a robot stands elsewhere."""
    place = formation.place_m.copy()
    place[formation.index(robot)] = to_m
    ends = list(combinations(range(len(place)), 2))
    distance = np.array([np.hypot(*(place[b] - place[a])) for a, b in ends])
    return [(formation.robots[a], formation.robots[b]) for a, b in ends], distance


def plan(
    formation: Formation,
    course: Course,
    ranging: Ranging,
    wanted_sd_m: float,
    way_sd: float = 0.05,
    steps_m: Sequence[float] = STEPS_M,
    widths_m: Sequence[float] = WIDTHS_M,
) -> Plan:
    """Pick who moves next and how far, so that the course ends as well as wanted with the fewest leaps.

    Every robot is tried for the next leap, with every step and width; of plans of as many leaps the one that ends
    best is taken. To be asked again after each leap.

    Parameters
    ----------
    wanted_sd_m : float
        √(σx² + σy²) of the robot that arrives; what the scale's error makes is part of it.
    way_sd : float
        Deviation of odometry, a share of the way.
    steps_m, widths_m : sequence of float
        To choose from.

    Raises
    ------
    ValueError
        If the wanted deviation is not above 0, or the team has reached the end.
    """
    if wanted_sd_m <= 0:
        raise ValueError(f"wanted_sd_m {wanted_sd_m:g}: it must be above 0")
    if course.along_and_across(formation.place_m)[:, 0].max() >= course.length_m:
        raise ValueError(f"a robot is at the end of the course of {course.length_m:g} m already; give a longer one")
    tried: list[Plan] = []
    for step_m, width_m, first in product(steps_m, widths_m, formation.robots):
        found = ahead(formation, course, ranging, way_sd, step_m, width_m, first)
        if found is None or not np.isfinite(found[1][-1].covariance).all():
            continue
        leaps, known = found
        end_sd = known[-1].sd_m(leaps[-1][0])
        tried.append(Plan("ok", "", *leaps[0], step_m, width_m, len(leaps), end_sd))
    if not tried:
        text = f"every strip takes robots beyond {ranging.reach_m:g} m of each other: bring them nearer together"
        return Plan("unreachable", text, "", np.full(2, np.nan), np.nan, np.nan, 0, np.nan)
    enough = [p for p in tried if p.end_sd_m <= wanted_sd_m]
    if enough:
        return min(enough, key=lambda p: (p.leaps, p.end_sd_m))
    best = min(tried, key=lambda p: p.end_sd_m)
    text = f"no plan ends within {wanted_sd_m:.3g} m: range longer at each stop, or know the speed of sound better"
    return Plan("beyond", text, best.robot, best.place_m, best.step_m, best.width_m, best.leaps, best.end_sd_m)
