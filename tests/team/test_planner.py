"""Who moves next and how far: promises kept, wishes weighed, and what cannot be is told."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from sonofix.records import Floats
from sonofix.studies import robots_strip as study
from sonofix.team.ahead import Course, Ranging
from sonofix.team.leapfrog import Formation, begin
from sonofix.team.planner import Plan, plan

RANGING = Ranging(0.0015, 10.0, 1.32, 18.0)
COURSE = Course(np.array([2.0, 1.0]), 0.5, 60.0)
CHOICE = {"steps_m": (7.5, 15.0, 22.5), "widths_m": (7.5, 12.5)}


def formation(scale_sd: float = 0.0, course: Course = COURSE) -> Formation:
    robots = ("K", "R2", "R1")
    place = course.place(np.array([[i * 10 / 3, (-5.0, 5.0, -5.0)[i]] for i in range(3)]))
    return begun(robots, place, scale_sd)


def begun(robots: tuple[str, ...], place: Floats, scale_sd: float = 0.0) -> Formation:
    pairs = list(combinations(robots, 2))
    distance = np.array([np.hypot(*(place[robots.index(b)] - place[robots.index(a)])) for a, b in pairs])
    return begin(robots, place, pairs, distance, RANGING.covariance_m2(distance), scale_sd).formation


def test_looser_wishes_need_fewer_leaps() -> None:
    team = formation(3e-4)
    plans = [plan(team, COURSE, RANGING, wanted, **CHOICE) for wanted in (0.2, 0.03, 0.026)]
    assert [p.status for p in plans] == ["ok"] * 3
    assert plans[0].leaps < plans[1].leaps <= plans[2].leaps
    for p, wanted in zip(plans, (0.2, 0.03, 0.026), strict=True):
        assert p.end_sd_m <= wanted


def test_a_wish_out_of_reach_is_answered_by_the_best_there_is() -> None:
    team = formation(3e-4)
    best = plan(team, COURSE, RANGING, 0.001, **CHOICE)
    assert best.status == "beyond"
    # the speed of sound alone costs 3e-4 of the way
    assert best.end_sd_m > 3e-4 * 50.0
    assert f"best one with {best.end_sd_m:.3g} m" in best.remedy
    # that much is reached when it is asked for, and not a tenth less
    assert plan(team, COURSE, RANGING, 1.001 * best.end_sd_m, **CHOICE).status == "ok"
    assert plan(team, COURSE, RANGING, 0.9 * best.end_sd_m, **CHOICE).status == "beyond"


def test_the_foremost_never_goes_and_the_one_that_goes_passes_it() -> None:
    """Whatever is wanted: else a robot might be ranged anew for ever, each time a little better."""
    for wanted in (0.2, 0.02, 0.001):
        for turned in range(3):
            place = COURSE.place(np.array([[0.0, -5.0], [3.0, 5.0], [6.0, -5.0]])[[turned, turned - 1, turned - 2]])
            found = plan(begun(("A", "B", "C"), place), COURSE, RANGING, wanted, **CHOICE)
            along = COURSE.along_and_across(place)[:, 0]
            assert found.robot != ("A", "B", "C")[int(np.argmax(along))]
            assert COURSE.along_and_across(found.place_m)[0] > along.max() + 2.0


@pytest.mark.parametrize("wanted", [0.06, 0.03])
def test_plans_asked_anew_after_each_leap_reach_what_is_wanted(wanted: float) -> None:
    """What is stated of the end hardly scatters; what is found does, by 1 / √(2 n) where one direction holds it all."""
    n = 12
    runs = []
    for k in range(n):
        rng = np.random.default_rng([3, k])
        ears = study.stated(RANGING, rng)

        def ask(now: Formation, wanted: float = wanted) -> Plan:
            return plan(now, study.COURSE, RANGING, wanted, study.WAY_SD)

        runs.append(study.drive(study.Case("planned", 0.0), ears, rng, ask))
    stated = np.sqrt([np.trace(run.covariance_m2[-1]) for run in runs])
    # the last leap may land beside what was foreseen of it, which a twentieth covers
    assert stated.max() < 1.05 * wanted
    assert 0.75 * wanted < np.sqrt(np.mean(stated**2)) <= wanted
    found = np.sqrt(np.mean([run.miss_m[-1] @ run.miss_m[-1] for run in runs]))
    assert found < wanted * (1 + 4 / np.sqrt(2 * n))
    assert all(len(run.plans) == len(run.robots) for run in runs)
    # all were told to stay within reach of each other, whatever odometry does
    assert max(run.farthest_m.max() for run in runs) <= RANGING.reach_m


def test_what_cannot_be_is_told() -> None:
    near = Ranging(0.0015, 10.0, 1.32, 5.0)
    found = plan(formation(), COURSE, near, 0.1, **CHOICE)
    assert (found.status, found.robot) == ("unreachable", "")
    assert "beyond 5 m of each other" in found.remedy
    far = plan(formation(), Course(COURSE.start_m, COURSE.heading_rad, 12e3), RANGING, 5.0, **CHOICE)
    assert far.status == "unreachable"
    assert "1000 leaps" in far.remedy
    for wrong in (0.0, np.nan):
        with pytest.raises(ValueError, match="above 0"):
            plan(formation(), COURSE, RANGING, wrong)
    with pytest.raises(ValueError, match="at the end"):
        plan(formation(), Course(COURSE.start_m, COURSE.heading_rad, 3.0), RANGING, 0.1)
