"""Leaps tried in thought: courses, ranges by distance, and the covariance that real leaps leave."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from sonofix.records import Floats
from sonofix.team import ahead as rooms
from sonofix.team.ahead import Course, Ranging, ahead, hindmost, landing
from sonofix.team.leapfrog import Formation, begin, leapt

RANGING = Ranging(0.0015, 10.0, 1.32, 30.0)
COURSE = Course(np.array([2.0, 1.0]), 0.5, 45.0)
ROBOTS = ("K", "R2", "R1")
PAIRS = list(combinations(ROBOTS, 2))


def distances(place: Floats) -> Floats:
    return np.array([np.hypot(*(place[ROBOTS.index(b)] - place[ROBOTS.index(a)])) for a, b in PAIRS])


def team(scale_sd: float = 0.0) -> Formation:
    place = COURSE.place(np.array([[i * 10 / 3, (-5.0, 5.0, -5.0)[i]] for i in range(3)]))
    heard = distances(place)
    return begin(ROBOTS, place, PAIRS, heard, RANGING.covariance_m2(heard), scale_sd).formation


def test_ranges_grow_worse_with_the_sound_that_is_lost() -> None:
    """Deviation goes with one over the amplitude: twice as far is 6 dB and 13.2 dB less."""
    variance = np.diag(RANGING.covariance_m2(np.array([10.0, 20.0])))
    np.testing.assert_allclose(np.sqrt(variance), [0.0015, 0.0015 * 2 * 10 ** (13.2 / 20)])


def test_places_are_told_along_the_course_and_to_its_left() -> None:
    place = COURSE.place(np.array([7.0, -2.0]))
    np.testing.assert_allclose(COURSE.along_and_across(place[None]), [[7.0, -2.0]], atol=1e-12)
    left = COURSE.place(np.array([0.0, 1.0])) - COURSE.start_m
    np.testing.assert_allclose(left, [-np.sin(0.5), np.cos(0.5)])
    assert not COURSE.arrived(place)
    assert COURSE.arrived(COURSE.place(np.array([[1.0, 0.0], [45.0, 3.0]])))


def test_the_hindmost_goes_past_the_foremost_to_the_other_side() -> None:
    now = team()
    assert hindmost(now, COURSE) == "K"
    short = Course(COURSE.start_m, COURSE.heading_rad, 8.0)
    for course, along in ((COURSE, 20 / 3 + 4.0), (short, 8.0)):
        to = landing(now.place_m[None], np.array([0]), course, np.array([12.0]), np.array([8.0]))
        np.testing.assert_allclose(course.along_and_across(to), [[along, 4.0]])


def test_what_is_foreseen_is_what_leaps_leave() -> None:
    """Its plain twin: the same courses leap by leap, with ranges that happen to be right."""
    step, width, way_sd = np.array([12.0, 9.0]), np.array([8.0, 11.0]), 0.05
    first = np.array([1, 0])
    tries = ahead(team(5e-4), COURSE, RANGING, way_sd, step, width, first)
    for k in range(2):
        variance, leaps = [], []
        for course in range(rooms.TRIED):
            now, count, arrived, robot = team(5e-4), 0, False, ROBOTS[first[k]]
            while not arrived:
                robot = ROBOTS[first[k]] if count == 0 else hindmost(now, COURSE)
                who = ROBOTS.index(robot)
                (to,) = landing(now.place_m[None], np.array([who]), COURSE, step[k : k + 1], width[k : k + 1])
                if count == 0:
                    np.testing.assert_allclose(tries.place_m[k], to)
                sd = way_sd * np.hypot(*(to - now.place_m[who]))
                true = now.place_m.copy()
                true[who] = to + sd * rooms._beside()[count, course]
                heard = distances(true)
                moved = true[who] - now.place_m[who]
                leap = leapt(now, robot, moved, sd**2 * np.eye(2), PAIRS, heard, RANGING.covariance_m2(heard))
                assert leap.status == "ok"
                now, count = leap.formation, count + 1
                arrived = COURSE.arrived(to) or COURSE.arrived(true)
            variance.append(np.trace(now.covariance_m2(robot)))
            leaps.append(count)
        assert tries.leaps[k] == round(np.mean(leaps))
        assert tries.end_sd_m[k] == pytest.approx(np.sqrt(np.mean(variance)), rel=1e-4)


def test_strips_out_of_reach_are_none_and_the_first_leap_leaves_room() -> None:
    """K goes to (20 / 3 + 4, 4): 11.6 m from R1, 7.4 m from R2, a way of 13.95 m."""
    far = float(np.hypot(4.0, 9.0))
    step, width = np.array([12.0]), np.array([8.0])
    way = float(np.hypot(20 / 3 + 4.0, 9.0))
    for sd, reach, within in ((0.0, far + 0.01, True), (0.0, far - 0.01, False)):
        told = ahead(team(), _short(), Ranging(0.0015, 10.0, 1.32, reach), sd, step, width)
        assert np.isfinite(told.end_sd_m[0]) == within
    for room, within in ((3.01, True), (2.99, False)):
        reach = far + room * 0.02 * way
        told = ahead(team(), _short(), Ranging(0.0015, 10.0, 1.32, reach), 0.02, step, width)
        assert np.isfinite(told.end_sd_m[0]) == within


def _short() -> Course:
    """One leap long."""
    return Course(COURSE.start_m, COURSE.heading_rad, 20 / 3 + 4.0)
