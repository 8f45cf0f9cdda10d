"""Who moves next and how far: promises kept, wishes weighed, and what cannot be is told."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from sonofix.studies import robots_strip as study
from sonofix.team.leapfrog import Formation, begin
from sonofix.team.planner import Course, Ranging, ahead, hindmost, landing, plan

RANGING = Ranging(0.0015, 10.0, 1.32, 18.0)
COURSE = Course(np.array([2.0, 1.0]), 0.5, 60.0)
CHOICE = {"steps_m": (7.5, 15.0, 22.5), "widths_m": (7.5, 12.5)}


def formation(scale_sd: float = 0.0, course: Course = COURSE) -> Formation:
    robots = ("K", "R2", "R1")
    place = np.array([course.place(i * 10 / 3, (-5.0, 5.0, -5.0)[i]) for i in range(3)])
    pairs = list(combinations(robots, 2))
    distance = np.array([np.hypot(*(place[robots.index(b)] - place[robots.index(a)])) for a, b in pairs])
    return begin(robots, place, pairs, distance, RANGING.covariance_m2(distance), scale_sd).formation


def test_ranges_grow_worse_with_the_sound_that_is_lost() -> None:
    """Deviation goes with one over the amplitude: twice as far is 6 dB and 13.2 dB less."""
    variance = np.diag(RANGING.covariance_m2(np.array([10.0, 20.0])))
    np.testing.assert_allclose(np.sqrt(variance), [0.0015, 0.0015 * 2 * 10 ** (13.2 / 20)])


def test_places_are_told_along_the_course_and_to_its_left() -> None:
    place = COURSE.place(7.0, -2.0)
    np.testing.assert_allclose(COURSE.along_and_across(place[None]), [[7.0, -2.0]], atol=1e-12)
    left = COURSE.place(0.0, 1.0) - COURSE.start_m
    np.testing.assert_allclose(left, [-np.sin(0.5), np.cos(0.5)])


def test_the_hindmost_goes_past_the_foremost_to_the_other_side() -> None:
    team = formation()
    assert hindmost(team, COURSE) == "K"
    to = COURSE.along_and_across(landing(team, "K", COURSE, 12.0, 8.0)[None])[0]
    np.testing.assert_allclose(to, [20 / 3 + 4.0, 4.0])
    short = Course(COURSE.start_m, COURSE.heading_rad, 8.0)
    assert short.along_and_across(landing(team, "K", short, 12.0, 8.0)[None])[0, 0] == pytest.approx(8.0)


def test_looser_wishes_need_fewer_leaps() -> None:
    team = formation(3e-4)
    plans = [plan(team, COURSE, RANGING, wanted, **CHOICE) for wanted in (0.2, 0.03, 0.025)]
    assert [p.status for p in plans] == ["ok"] * 3
    assert plans[0].leaps < plans[1].leaps <= plans[2].leaps
    for p, wanted in zip(plans, (0.2, 0.03, 0.025), strict=True):
        assert p.end_sd_m <= wanted
        assert p.robot == "K"
    best = plan(team, COURSE, RANGING, 0.001, **CHOICE)
    assert best.status == "beyond"
    assert best.end_sd_m <= plans[-1].end_sd_m
    # the speed of sound alone costs 3e-4 of the way
    assert best.end_sd_m > 3e-4 * 50.0


def test_a_plan_is_what_leaps_tried_ahead_give() -> None:
    team = formation()
    found = plan(team, COURSE, RANGING, 0.05, **CHOICE)
    tried = ahead(team, COURSE, RANGING, 0.05, found.step_m, found.width_m, found.robot)
    assert tried is not None
    leaps, known = tried
    assert len(leaps) == found.leaps
    np.testing.assert_array_equal(leaps[0][1], found.place_m)
    assert known[-1].sd_m(leaps[-1][0]) == found.end_sd_m
    # roles rotate, and each leap leaves two standing
    assert {robot for robot, _ in leaps} == {"K", "R2", "R1"}
    assert all(a[0] != b[0] for a, b in pairwise(leaps))


def test_what_was_foreseen_is_found() -> None:
    """The root mean square of 2 n normal errors scatters by at most 1 / √(2 n) where one direction holds them all."""
    n = 80
    case = study.Case("as planned", 0.0, None, 15.0, 12.5)
    runs = []
    for k in range(n):
        rng = np.random.default_rng([3, k])
        runs.append(study.drive(case, study.stated(RANGING, rng), rng))
    start = study.START_M
    pairs = list(combinations(study.ROBOTS, 2))
    distance = np.array([np.hypot(*(start[study.ROBOTS.index(b)] - start[study.ROBOTS.index(a)])) for a, b in pairs])
    team = begin(study.ROBOTS, start, pairs, distance, RANGING.covariance_m2(distance), 0.0).formation
    tried = ahead(team, study.COURSE, RANGING, study.WAY_SD, 15.0, 12.5)
    assert tried is not None
    foreseen = tried[1][-1].sd_m(tried[0][-1][0])
    found = np.sqrt(np.mean([run.miss_m[-1] @ run.miss_m[-1] for run in runs]))
    # robots land where wheels take them, not where they should: a tenth more or less
    assert abs(found / foreseen - 1.0) < 0.1 + 4 / np.sqrt(2 * n)


def test_what_cannot_be_is_told() -> None:
    near = Ranging(0.0015, 10.0, 1.32, 5.0)
    found = plan(formation(), COURSE, near, 0.1, **CHOICE)
    assert (found.status, found.robot) == ("unreachable", "")
    assert "beyond 5 m of each other" in found.remedy
    with pytest.raises(ValueError, match="above 0"):
        plan(formation(), COURSE, RANGING, 0.0)
    with pytest.raises(ValueError, match="at the end"):
        plan(formation(), Course(COURSE.start_m, COURSE.heading_rad, 3.0), RANGING, 0.1)
