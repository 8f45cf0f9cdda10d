"""Closed-form starts: exact positions from exact ranges, both mirrors where there are two, by as few rows as can be."""

from __future__ import annotations

import numpy as np
import pytest

from locate.made_epochs import HALL
from sonofix.locate.start import starts
from sonofix.records import Floats

PLACE = np.array([3.0, 5.5, 1.1])
CEILING = np.array([[0.0, 0.0, 3.0], [10.0, 0.0, 3.0], [10.0, 8.0, 3.0], [0.0, 8.0, 3.0], [4.0, 3.0, 3.0]])
WALL = np.array([[0.0, 0.0, 2.0], [0.0, 3.0, 2.0], [0.0, 7.0, 2.0], [0.0, 9.0, 2.0]])


def ranges(anchors: Floats, place: Floats, clock_m: float = 0.0) -> Floats:
    return np.linalg.norm(place - anchors, axis=1) + clock_m


def nearest(found: list[Floats], place: Floats, clock_m: float = 0.0) -> float:
    assert found, "no start at all"
    return min(float(np.linalg.norm(s - np.append(place, clock_m))) for s in found)


@pytest.mark.parametrize("count", [4, 5, 6])
def test_in_space_with_a_known_clock(count: int) -> None:
    anchors = np.array(HALL)[:count]
    assert nearest(starts(anchors, ranges(anchors, PLACE), None, False), PLACE) < 1e-9


@pytest.mark.parametrize("count", [4, 5, 6])
@pytest.mark.parametrize("clock_m", [-40.0, 0.0, 1234.5])
def test_in_space_with_an_unknown_clock(count: int, clock_m: float) -> None:
    # four rows for four unknowns leave a quadratic, one root of which is right
    anchors = np.array(HALL)[:count]
    assert nearest(starts(anchors, ranges(anchors, PLACE, clock_m), None, True), PLACE, clock_m) < 1e-8


@pytest.mark.parametrize("count", [3, 4, 6])
def test_on_a_known_level_with_a_known_clock(count: int) -> None:
    anchors = np.array(HALL)[:count]
    assert nearest(starts(anchors, ranges(anchors, PLACE), PLACE[2], False), PLACE) < 1e-9


@pytest.mark.parametrize("count", [3, 4, 6])
def test_on_a_known_level_with_an_unknown_clock(count: int) -> None:
    anchors = np.array(HALL)[:count]
    assert nearest(starts(anchors, ranges(anchors, PLACE, 17.0), PLACE[2], True), PLACE, 17.0) < 1e-8


@pytest.mark.parametrize("count", [3, 4, 5])
def test_anchors_in_a_plane_leave_both_mirrors(count: int) -> None:
    anchors = CEILING[:count]
    found = starts(anchors, ranges(anchors, PLACE), None, False)
    above = PLACE * [1.0, 1.0, -1.0] + [0.0, 0.0, 6.0]
    assert nearest(found, PLACE) < 1e-9
    assert nearest(found, above) < 1e-9


@pytest.mark.parametrize("count", [4, 5])
def test_anchors_in_a_plane_leave_both_mirrors_with_an_unknown_clock(count: int) -> None:
    anchors = CEILING[[0, 1, 2, 4, 3][:count]]
    found = starts(anchors, ranges(anchors, PLACE, -3.0), None, True)
    above = PLACE * [1.0, 1.0, -1.0] + [0.0, 0.0, 6.0]
    assert nearest(found, PLACE, -3.0) < 1e-8
    assert nearest(found, above, -3.0) < 1e-8


def test_a_slanted_plane_mirrors_about_itself(rng: np.random.Generator) -> None:
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    anchors = CEILING @ turn.T
    found = starts(anchors, ranges(anchors, PLACE @ turn.T), None, False)
    assert nearest(found, PLACE @ turn.T) < 1e-9
    assert nearest(found, (PLACE * [1.0, 1.0, -1.0] + [0.0, 0.0, 6.0]) @ turn.T) < 1e-9


@pytest.mark.parametrize("count", [2, 3, 4])
def test_anchors_on_a_line_leave_both_mirrors_on_a_known_level(count: int) -> None:
    anchors = WALL[:count]
    found = starts(anchors, ranges(anchors, PLACE), PLACE[2], False)
    assert nearest(found, PLACE) < 1e-9
    assert nearest(found, PLACE * [-1.0, 1.0, 1.0]) < 1e-9


@pytest.mark.parametrize("count", [3, 4])
def test_anchors_on_a_line_leave_both_mirrors_with_an_unknown_clock(count: int) -> None:
    anchors = WALL[:count]
    found = starts(anchors, ranges(anchors, PLACE, 6.0), PLACE[2], True)
    assert nearest(found, PLACE, 6.0) < 1e-8
    assert nearest(found, PLACE * [-1.0, 1.0, 1.0], 6.0) < 1e-8


def test_a_position_in_the_plane_of_the_anchors_is_its_own_mirror() -> None:
    place = np.array([3.0, 5.5, 3.0])
    found = starts(CEILING, ranges(CEILING, place), None, False)
    # the height comes by a square root: 1e-16 of rounding in squared metres is 1e-7 m
    assert all(np.linalg.norm(s[:3] - place) < 1e-6 for s in found)


def test_nearly_flat_anchors_give_starts_on_both_sides(rng: np.random.Generator) -> None:
    # 1 cm of unevenness in 10 m would have to be trusted below the noise of the ranges: treated as a plane instead
    anchors = CEILING + [0.0, 0.0, 1.0] * rng.uniform(-0.01, 0.01, (5, 1))
    found = starts(anchors, ranges(anchors, PLACE), None, False)
    assert nearest(found, PLACE) < 0.1
    assert nearest(found, PLACE * [1.0, 1.0, -1.0] + [0.0, 0.0, 6.0]) < 0.1


@pytest.mark.parametrize(
    ("anchors", "level_m", "clock"),
    [
        (CEILING[:2], None, True),
        (CEILING[:1], None, True),
        (CEILING[:1], 1.1, True),
    ],
)
def test_too_few_rows_give_no_start(anchors: Floats, level_m: float | None, clock: bool) -> None:
    assert starts(anchors, ranges(anchors, PLACE), level_m, clock) == []


@pytest.mark.parametrize("level_m", [None, 1.1])
@pytest.mark.parametrize("clock", [False, True])
def test_starts_are_finite_for_ranges_that_no_place_fits(level_m: float | None, clock: bool) -> None:
    anchors = np.array(HALL)
    for range_m in (np.zeros(6), np.full(6, 1.0), np.array([1e3, 0.1, 0.1, 0.1, 0.1, 1e3]), -np.arange(6.0)):
        for found in starts(anchors, range_m, level_m, clock):
            assert np.isfinite(found).all()
