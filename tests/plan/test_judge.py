"""Places judged in one kernel, against full matrices, and against the receiver's own integrity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sonofix.locate.integrity import minimum_detectable_bias
from sonofix.locate.many import STATUSES, fix_many
from sonofix.plan.judge import WEAK, judged
from sonofix.plan.quality import detected_shifts

POINTS = st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(2, 6))


def full_model(place, nodes, sd, free_level: bool, clock: bool, speed_sd: float):
    """Jacobian (n, k) and full covariance (n, n) of the ranges at a place."""
    way = place - nodes
    distance = np.linalg.norm(way, axis=1)
    jacobian = (way / distance[:, None])[:, : 3 if free_level else 2]
    if clock:
        jacobian = np.column_stack([jacobian, np.ones(len(nodes))])
    return jacobian, np.diag(sd**2) + speed_sd**2 * np.outer(distance, distance)


@given(
    st.lists(POINTS, min_size=2, max_size=9),
    st.integers(0, 2**31),
    st.booleans(),
    st.booleans(),
    st.sampled_from([0.0, 2e-3]),
)
def test_deviation_and_fault_are_those_of_full_matrices(nodes, seed, free_level, clock, speed_sd) -> None:
    nodes, place = np.array(nodes), np.array([[0.3, -0.2, 0.4]])
    sd = np.exp(np.random.default_rng(seed).uniform(np.log(1e-3), np.log(0.3), len(nodes)))
    jacobian, covariance = full_model(place[0], nodes, sd, free_level, clock, speed_sd)
    assume(len(nodes) >= jacobian.shape[1] and np.linalg.cond(jacobian) < 1e3)
    got = judged(
        place,
        nodes,
        1 / sd[None] ** 2,
        free_level=free_level,
        clock=clock,
        speed_sd=speed_sd,
        shift=detected_shifts(len(nodes)),
    )
    information = jacobian.T @ np.linalg.solve(covariance, jacobian)
    expected, plain = np.linalg.inv(information), np.linalg.inv(jacobian.T @ jacobian)
    assert got.heard[0] == len(nodes)
    assert got.hdop[0] == pytest.approx(np.sqrt(np.trace(plain[:2, :2])), rel=1e-6)
    assert got.sd_m[0] == pytest.approx(np.sqrt(np.trace(expected[:2, :2])), rel=1e-5)
    if free_level:
        assert got.vdop[0] == pytest.approx(np.sqrt(plain[2, 2]), rel=1e-6)
        assert got.sd_z_m[0] == pytest.approx(np.sqrt(expected[2, 2]), rel=1e-5)
    worst = minimum_detectable_bias(jacobian, covariance).max()
    if worst < 1e3:  # beyond, rounding decides which fault shows at all
        assert got.fault_m[0] == pytest.approx(worst, rel=1e-4)
    elif np.isinf(worst):
        assert got.fault_m[0] > 1e2


@given(st.lists(POINTS, min_size=4, max_size=9, unique=True), POINTS, st.booleans())
def test_one_more_range_never_makes_a_position_worse(nodes, extra, clock) -> None:
    place = np.array([[0.3, -0.2, 0.4]])
    few, many = np.array(nodes), np.array([*nodes, extra])
    asked = {"free_level": True, "clock": clock, "speed_sd": 1e-3}
    before = judged(place, few, np.full((1, len(few)), 1e4), **asked)
    after = judged(place, many, np.full((1, len(many)), 1e4), **asked)
    if np.isfinite(before.sd_m[0]):
        assert after.sd_m[0] <= before.sd_m[0] * (1 + 1e-6)
        assert after.hdop[0] ** 2 + after.vdop[0] ** 2 <= (before.hdop[0] ** 2 + before.vdop[0] ** 2) * (1 + 1e-6)


def test_unheard_ranges_take_no_part() -> None:
    place = np.array([[1.0, 2.0, 0.0]])
    nodes = np.array([[0, 0, 3], [5, 0, 3], [0, 5, 3], [5, 5, 3.0]])
    weight = np.array([[1e4, 1e4, 0.0, 2e4]])
    some, three = judged(place, nodes, weight), judged(place, nodes[[0, 1, 3]], weight[:, [0, 1, 3]])
    assert some.heard[0] == three.heard[0] == 3
    assert some.sd_m[0] == three.sd_m[0]
    assert np.isnan(some.fault_m[0])  # nothing was asked of faults


def test_without_a_range_to_spare_no_fault_is_detected() -> None:
    nodes = np.array([[0, 0, 3], [5, 0, 3], [0, 5, 3.0]])
    place, shift = np.array([[1.0, 2.0, 0.0]]), detected_shifts(3)
    assert np.isinf(judged(place, nodes[:2], np.full((1, 2), 1e4), shift=shift).fault_m[0])
    assert np.isfinite(judged(place, nodes, np.full((1, 3), 1e4), shift=shift).fault_m[0])
    assert np.isinf(judged(place, nodes, np.full((1, 3), 1e4), clock=True, shift=shift).fault_m[0])


def test_two_beacons_fix_only_where_the_room_rules_out_the_mirror() -> None:
    wall, middle = np.array([[1.0, 0, 3], [9, 0, 3]]), np.array([[1.0, 4, 3], [9, 4, 3]])
    box, place, weight = np.array([[0.0, 0, 0], [10, 8, 4]]), np.array([[4.0, 3.0, 0.5]]), np.full((1, 2), 1e6)
    assert np.isfinite(judged(place, wall, weight, mirrors=True, bounds_m=box).sd_m[0])
    assert np.isnan(judged(place, middle, weight, mirrors=True, bounds_m=box).sd_m[0])
    assert np.isnan(judged(place, wall, weight, mirrors=True).sd_m[0])  # nothing is known of a room
    assert np.isfinite(judged(place, wall, weight).sd_m[0])  # nor was a mirror image asked for
    third = np.array([*middle, [5.0, 6, 3]])
    assert np.isfinite(judged(place, third, np.full((1, 3), 1e6), mirrors=True).sd_m[0])


FLAT = [(0, 0, 3), (10, 0, 3), (10, 8, 3), (0, 8, 3), (5, 4, 3)]
UNEVEN = [(0, 0, 3), (10, 0, 3.3), (10, 8, 2.8), (0, 8, 3.1), (5, 4, 2.9)]
LINE = [(1, 4, 3), (9, 4, 3), (5, 4, 3), (3, 4, 2)]
WALL = [(1, 0.2, 3), (9, 0.2, 3)]
NEAR_LINE = [(1, 4, 3), (9, 4, 3), (5, 4.3, 3)]
LOW = [(x, y, 0.5) for x, y, _ in FLAT]
ROOM = ((0, 0, 0), (10, 8, 4))
TALL = ((0, 0, 0), (10, 8, 8))


@pytest.mark.parametrize("bounds", [None, ROOM, TALL], ids=["open", "room", "tall"])
@pytest.mark.parametrize(
    ("nodes", "free_level", "clock", "sd"),
    [
        (FLAT, True, False, 1e-3),
        (FLAT, True, True, 1e-3),
        (FLAT[:3], True, False, 1e-3),
        (FLAT, False, False, 1e-3),
        (UNEVEN, True, False, 1e-3),
        (UNEVEN, True, True, 0.03),
        (UNEVEN, True, False, 0.1),
        (LINE, False, False, 1e-3),
        (LINE, False, True, 1e-3),
        (WALL, False, False, 1e-3),
        (NEAR_LINE, False, False, 0.03),
        (LOW, True, False, 0.01),
    ],
)
def test_a_fix_is_promised_where_the_receiver_has_one(nodes, free_level, clock, sd, bounds) -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0.2, 9.8, 13), np.linspace(0.3, 7.6, 11)))
    places, nodes = np.column_stack([x, y, np.full(len(x), 0.4)]), np.array(nodes, float)
    ranges = np.linalg.norm(places[:, None] - nodes, axis=2)
    got = judged(
        places,
        nodes,
        np.full(ranges.shape, sd**-2),
        free_level=free_level,
        clock=clock,
        mirrors=True,
        bounds_m=None if bounds is None else np.array(bounds, float),
        weak=WEAK,
    )
    fixes = fix_many(
        nodes,
        ranges + (5.0 if clock else 0.0),
        np.full(len(nodes), sd**2),
        level_m=None if free_level else 0.4,
        clock=clock,
        bounds_m=bounds,
    )
    np.testing.assert_array_equal(np.isfinite(got.sd_m), [STATUSES[s] == "ok" for s in fixes.status])


def test_a_deviation_as_large_as_the_nearest_range_is_no_fix() -> None:
    nodes, place = np.array([[0, 0, 1.0], [4, 0, 1.0], [0, 4, 1.0]]), np.array([[1.0, 1.0, 0.0]])
    nearest = np.sqrt(3.0)
    sd = np.linspace(0.2, 2.0, 19)[:, None]
    got = judged(np.repeat(place, 19, 0), nodes, np.repeat(1 / sd**2, 3, 1), weak=WEAK)
    free = judged(np.repeat(place, 19, 0), nodes, np.repeat(1 / sd**2, 3, 1))
    rows = (place - nodes)[:, :2] / np.linalg.norm(place - nodes, axis=1)[:, None]
    worst = sd[:, 0] * np.sqrt(np.linalg.inv(rows.T @ rows).diagonal().max())
    np.testing.assert_array_equal(np.isfinite(got.sd_m), worst <= WEAK * nearest)
    assert np.isfinite(free.sd_m).all()


def test_weights_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"weight has shape \(1, 2\); 1 places and 3 nodes"):
        judged(np.zeros((1, 3)), np.zeros((3, 3)), np.ones((1, 2)))
