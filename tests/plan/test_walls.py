"""Lines of sight across a floor plan, against the same found by walking along each line."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sonofix.plan.walls import in_sight, inside
from sonofix.records import Walls


def ring(corners, height_m: float = np.inf, number: int = 0) -> Walls:
    points = np.array([*corners, corners[0]], float)
    count = len(corners)
    return Walls(points[:-1], points[1:], np.full(count, height_m), np.full(count, number))


def line(start, end, height_m: float = np.inf) -> Walls:
    return Walls(np.array([start], float), np.array([end], float), np.array([height_m]), np.array([-1]))


def sees(walls: Walls, node, place) -> bool:
    return bool(in_sight(walls, np.array([node], float), np.array([place], float))[0, 0])


def test_a_wall_to_the_ceiling_hides_what_is_behind_and_nothing_else() -> None:
    wall = line((5, 0), (5, 4))
    assert not sees(wall, (0, 2, 3), (10, 2, 0))
    assert sees(wall, (0, 2, 3), (4.9, 2, 0))
    assert sees(wall, (0, 5, 3), (10, 5, 0))
    assert sees(wall, (0, 2, 3), (10, 7, 0))  # passes the end of the wall at y = 4.5
    assert not sees(wall, (0, 2, 3), (10, 5.9, 0))


def test_over_a_low_wall_the_line_counts_where_it_crosses() -> None:
    # from 4 m down to 0 over 8 m; half way it is at 2 m
    assert sees(line((4, -1), (4, 1), 1.99), (0, 0, 4), (8, 0, 0))
    assert not sees(line((4, -1), (4, 1), 2.01), (0, 0, 4), (8, 0, 0))


def test_no_sound_passes_where_two_pieces_meet() -> None:
    corner = Walls(np.array([[5.0, -3], [5.0, 0]]), np.array([[5.0, 0], [8.0, 3]]), np.full(2, np.inf), np.full(2, -1))
    assert not sees(corner, (0, 0, 3), (10, 0, 0))


def test_a_beacon_on_the_face_of_an_obstacle_hears_its_own_side_only() -> None:
    column = ring([(4, 4), (5, 4), (5, 5), (4, 5)])
    face = (4.0, 4.5, 3.0)
    assert sees(column, face, (1, 4.5, 0))
    assert not sees(column, face, (8, 4.5, 0))


def test_without_walls_all_is_in_sight() -> None:
    nodes, places = np.random.default_rng(0).uniform(0, 9, (2, 20, 3))
    assert in_sight(Walls.none(), nodes, places).all()
    assert not inside(Walls.none(), places).any()


@given(
    st.lists(st.tuples(*[st.floats(0, 10)] * 4, st.sampled_from([1.0, 2.0, np.inf])), min_size=1, max_size=6),
    st.tuples(*[st.floats(0, 10)] * 4),
    st.floats(2.5, 5),
)
def test_sight_is_what_a_walk_along_the_line_finds(pieces, ends, height_m) -> None:
    table = np.array(pieces)
    walls = Walls(table[:, :2], table[:, 2:4], table[:, 4], np.full(len(table), -1))
    node, place = np.array([*ends[:2], height_m]), np.array([*ends[2:], 0.3])
    way = place - node
    assume(np.hypot(*way[:2]) > 0.5)
    blocked = False
    for start, end, top in zip(walls.start_m, walls.end_m, walls.height_m, strict=True):
        along = np.linspace(0, 1, 20001)[:, None]
        points = node + along * way
        side = (end - start)[0] * (points[:, 1] - start[1]) - (end - start)[1] * (points[:, 0] - start[0])
        crossing = np.flatnonzero(np.diff(np.sign(side)))
        for k in crossing:
            length = max(float(np.hypot(*(end - start))), 1e-9)
            share = float((points[k, :2] - start) @ (end - start)) / length**2
            distance = np.hypot(*(points[k] - node)[:2])
            # what is nearer than the walk's step to an end, a top or the node is not decided by a walk
            step = 1e-3 * (1 + 10 / length)
            assume(min(abs(share), abs(share - 1)) > step and abs(points[k, 2] - top) > 1e-3)
            assume(abs(distance - 0.01) > 2e-3 and 0.0005 < along[k, 0] < 0.9995)
            blocked |= 0 < share < 1 and points[k, 2] < top and distance > 0.01
    assert sees(walls, node, place) != blocked


def test_inside_is_within_the_outline_outside_the_hole_below_the_top() -> None:
    outer, hole = ring([(0, 0), (10, 0), (10, 10), (0, 10)], 2.0), ring([(4, 4), (6, 4), (6, 6), (4, 6)], 2.0)
    both = Walls(
        *(np.concatenate([getattr(outer, f), getattr(hole, f)]) for f in ("start_m", "end_m", "height_m", "solid"))
    )
    places = np.array([[1, 1, 0.5], [5, 5, 0.5], [11, 5, 0.5], [1, 1, 2.5], [3.9, 5, 1.0]])
    assert inside(both, places).tolist() == [True, False, False, False, True]


def test_a_line_is_no_obstacle_to_stand_in() -> None:
    assert not inside(line((0, 0), (0, 9)), np.array([[0.0, 4.0, 0.1]])).any()


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.1])
def test_turning_and_moving_everything_changes_nothing(turn) -> None:
    rng = np.random.default_rng(3)
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, -sin], [sin, cos]])
    start, end = rng.uniform(0, 20, (2, 12, 2))
    walls = Walls(start, end, rng.uniform(1, 4, 12), np.full(12, -1))
    moved = Walls(start @ rotation.T + 7, end @ rotation.T + 7, walls.height_m, walls.solid)
    nodes, places = rng.uniform(0, 20, (2, 40, 3))
    nodes[:, 2], places[:, 2] = 4.0, 0.3

    def carried(points):
        return np.column_stack([points[:, :2] @ rotation.T + 7, points[:, 2]])

    seen = in_sight(walls, nodes, places)
    assert 0.05 < seen.mean() < 0.95
    np.testing.assert_array_equal(seen, in_sight(moved, carried(nodes), carried(places)))
