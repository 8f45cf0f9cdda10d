"""Who moves next, and how far: strips tried ahead to the end of a course, by the covariance they would leave.

Wide strips bend less (the error across the course goes with the ranges' error over the width), long steps need fewer
leaps, and both are paid for with longer, weaker ranges. A plan is made for one leap and asked for anew after it, with
what is known by then (receding horizon): robots land beside where they should, and the strip that was best before may
no longer do, or may be finer than it need be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from sonofix.records import Floats
from sonofix.team.ahead import MOST_LEAPS, Course, Ranging, ahead
from sonofix.team.leapfrog import Formation

STEPS_M = (5.0, 7.5, 10.0, 12.5, 15.0, 20.0, 25.0, 30.0)
WIDTHS_M = (5.0, 7.5, 10.0, 12.5, 15.0, 20.0)


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """The next leap, and what the course would end with.

    Attributes
    ----------
    status : "ok", "beyond" (no plan ends as well as wanted: this one ends best), "unreachable" (none keeps in reach, or
        gets there in `MOST_LEAPS`)
    remedy : str
        Empty where ok; where beyond, it tells the best end error that can be reached.
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

    Every robot but the foremost, which has nobody to pass, is tried for the next leap, with every step and width; of
    plans of as many leaps the one that ends best is taken. To be asked again after each leap.

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
    if not wanted_sd_m > 0:
        raise ValueError(f"wanted_sd_m {wanted_sd_m:g}: it must be above 0")
    if course.arrived(formation.place_m):
        raise ValueError(f"a robot is at the end of the course of {course.length_m:g} m already; give a longer one")
    order = np.argsort(course.along_and_across(formation.place_m)[:, 0])
    choice = list(product(steps_m, widths_m, order[:-1].tolist()))
    step, width, first = (np.array(column) for column in zip(*choice, strict=True))
    tries = ahead(formation, course, ranging, way_sd, step, width, first)
    leaps, end_sd = tries.leaps, tries.end_sd_m
    kept = np.flatnonzero(np.isfinite(end_sd))
    if not len(kept):
        text = f"every strip takes robots beyond {ranging.reach_m:g} m of each other: bring them nearer together"
        if tries.leaps.max() >= MOST_LEAPS:
            text = f"a course of {course.length_m:g} m takes more than {MOST_LEAPS} leaps: plan it in parts"
        return Plan("unreachable", text, "", np.full(2, np.nan), np.nan, np.nan, 0, np.nan)
    enough = kept[end_sd[kept] <= wanted_sd_m]
    if len(enough):
        best, status, text = int(enough[np.lexsort((end_sd[enough], leaps[enough]))[0]]), "ok", ""
    else:
        best, status = int(kept[np.argmin(end_sd[kept])]), "beyond"
        text = (
            f"no plan ends within {wanted_sd_m:.3g} m, the best one with {end_sd[best]:.3g} m: "
            "range longer at each stop, or know the speed of sound better"
        )
    return Plan(
        status,
        text,
        formation.robots[int(first[best])],
        tries.place_m[best],
        float(step[best]),
        float(width[best]),
        int(leaps[best]),
        float(end_sd[best]),
    )
