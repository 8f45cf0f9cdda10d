"""Laws of leap-frog: noiseless recovery, no preferred frame, covariances that are first-order propagation."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sonofix.records import Floats
from sonofix.team.leapfrog import begin, leapt

ROBOTS = ("K", "R2", "R1")
PAIRS = (("K", "R2"), ("K", "R1"), ("R2", "R1"))
SD_M = 0.001

coordinate = st.floats(-10.0, 10.0)
place = st.tuples(coordinate, coordinate)


def distances(place_m: Floats) -> Floats:
    return np.array([np.hypot(*(place_m[ROBOTS.index(b)] - place_m[ROBOTS.index(a)])) for a, b in PAIRS])


def sound(place_m: Floats) -> bool:
    """Whether a triangle has sides of a metre and angles of a tenth at least."""
    a, b = place_m[1] - place_m[0], place_m[2] - place_m[0]
    sides = distances(place_m)
    return bool(sides.min() > 1.0 and abs(a[0] * b[1] - a[1] * b[0]) > 0.1 * sides.max() ** 2)


def team(start: list[tuple[float, float]], to: tuple[float, float]) -> tuple[Floats, Floats]:
    first = np.array(start)
    then = first.copy()
    then[0] = to
    assume(sound(first) and sound(then))
    return first, then


@settings(max_examples=60, deadline=None)
@given(st.lists(place, min_size=3, max_size=3), place, st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_exact_ranges_give_exact_places(
    start: list[tuple[float, float]], to: tuple[float, float], east: float, north: float
) -> None:
    first, then = team(start, to)
    begun = begin(ROBOTS, first, PAIRS, distances(first), SD_M**2 * np.eye(3), 0.0).formation
    told = then[0] - first[0] + [east, north]
    leap = leapt(begun, "K", told, 0.2**2 * np.eye(2), PAIRS, distances(then), SD_M**2 * np.eye(3))
    assume(leap.status == "ok")
    # odometry off by 0.3 m weighs (1 mm over 0.2 m)² at a good corner, and the angle's sine is 0.05 at worst
    np.testing.assert_allclose(leap.formation.place_m, then, atol=0.3 * (SD_M / 0.05 / 0.2) ** 2)


@settings(max_examples=40, deadline=None)
@given(st.lists(place, min_size=3, max_size=3), place, st.floats(-3.0, 3.0), place)
def test_no_frame_is_preferred(
    start: list[tuple[float, float]], to: tuple[float, float], angle: float, shift: tuple[float, float]
) -> None:
    first, then = team(start, to)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    found = []
    for rotate, move in ((np.eye(2), np.zeros(2)), (turn, np.array(shift))):
        here, there = first @ rotate.T + move, then @ rotate.T + move
        begun = begin(ROBOTS, here, PAIRS, distances(here), SD_M**2 * np.eye(3), 5e-4).formation
        leap = leapt(begun, "K", there[0] - here[0], 0.2**2 * np.eye(2), PAIRS, distances(there), SD_M**2 * np.eye(3))
        found.append((leap.status, leap.formation))
    (status, plain), (again, turned) = found
    assert status == again
    whole = np.kron(np.eye(4), turn)[:7, :7]
    whole[6, 6] = 1.0
    scale = np.abs(plain.covariance).max()
    np.testing.assert_allclose(turned.covariance, whole @ plain.covariance @ whole.T, atol=1e-6 * scale)
    np.testing.assert_allclose(turned.place_m, plain.place_m @ turn.T + shift, atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(st.lists(place, min_size=3, max_size=3), place, st.floats(-0.02, 0.02))
def test_a_wrong_speed_of_sound_draws_all_to_another_scale(
    start: list[tuple[float, float]], to: tuple[float, float], share: float
) -> None:
    first, then = team(start, to)
    begun = begin(ROBOTS, first, PAIRS, (1 + share) * distances(first), SD_M**2 * np.eye(3), 0.0).formation
    told = (1 + share) * (then[0] - first[0])
    leap = leapt(begun, "K", told, np.eye(2), PAIRS, (1 + share) * distances(then), SD_M**2 * np.eye(3))
    assume(leap.status == "ok")
    # the frame's origin is where the first robot stood at the start
    np.testing.assert_allclose(leap.formation.place_m, first[0] + (1 + share) * (then - first[0]), atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(st.lists(place, min_size=3, max_size=3))
def test_the_start_covariance_is_that_of_its_derivative(start: list[tuple[float, float]]) -> None:
    first = np.array(start)
    assume(sound(first))
    noise, step = SD_M**2 * np.diag([1.0, 4.0, 9.0]), 1e-5
    begun = begin(ROBOTS, first, PAIRS, distances(first), noise, 0.0).formation
    columns = []
    for k in range(3):
        ends = [
            begin(ROBOTS, first, PAIRS, distances(first) + sign * step * np.eye(3)[k], noise, 0.0).formation.place_m
            for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]).ravel() / (2 * step))
    derivative = np.array(columns).T
    expected = derivative @ noise @ derivative.T
    np.testing.assert_allclose(begun.covariance[:6, :6], expected, atol=1e-5 * np.abs(expected).max())
