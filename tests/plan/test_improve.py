"""Where more beacons go: the best place where all can be tried, and never worse than before."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from made_sites import CORNERS, ROOM, made, ready

from sonofix.plan.coverage import grid
from sonofix.plan.extend import extended, free_ids, rounded, unused_codes
from sonofix.plan.improve import CLEAR_M, candidates_of, cost, improve, sample_of
from sonofix.plan.quality import Nodes, detected_shifts, judge, quality, weights
from sonofix.records import Walls
from sonofix.signals.waveform import chips_of

LEVEL_M = 0.4


def floor(site, spacing_m: float = 0.7):
    x, y = grid(site, spacing_m, 0.0)
    return np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x)), np.full(len(x) * len(y), LEVEL_M)])


def column() -> Walls:
    corners = np.array([(6.0, 3.0), (8.0, 3.0), (8.0, 6.0), (6.0, 6.0), (6.0, 3.0)])
    return Walls(corners[:-1], corners[1:], np.full(4, np.inf), np.zeros(4, np.int64))


def placed(nodes, terms, places, position_m, goal, fault_m=0.5):
    """Cost of a layout, worked out anew."""
    count = len(position_m)
    new = Nodes(tuple(map(str, range(count))), position_m, np.zeros(count), nodes.links[:1] * count)
    all_of_them = nodes.joined(new)
    shift = detected_shifts(len(all_of_them)) if goal == "faults" else None
    got = judge(all_of_them.position_m, weights(all_of_them, places, terms), places, terms, shift)
    return cost(got, goal, fault_m, 3 if goal == "faults" else 2)


@pytest.mark.parametrize("goal", ["error", "faults"])
def test_one_beacon_goes_to_the_best_of_all_places(goal) -> None:
    site = made(CORNERS[:3])
    nodes, terms = ready(site, walls=column())
    places = floor(site)
    candidates = np.random.default_rng(1).uniform([0, 0, 2], [14, 9, 4], (60, 3))
    got = improve(nodes, nodes.pick([]), 1, candidates, places, terms, goal)
    costs = [placed(nodes, terms, places, c[None], goal) for c in candidates]
    np.testing.assert_array_equal(got.position_m[0], candidates[int(np.argmin(costs))])
    assert got.cost_after == pytest.approx(min(costs), abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("goal", ["error", "faults"])
def test_a_pair_is_the_best_of_all_pairs(goal, seed) -> None:
    site = made(CORNERS[:2])
    nodes, terms = ready(site, walls=column())
    places = floor(site, 1.0)
    candidates = np.random.default_rng(seed).uniform([0, 0, 2], [14, 9, 4], (20, 3))
    got = improve(nodes, nodes.pick([]), 2, candidates, places, terms, goal)
    costs = [placed(nodes, terms, places, candidates[[i, j]], goal) for i, j in combinations(range(20), 2)]
    assert got.cost_after == pytest.approx(min(costs), abs=1e-9)


@pytest.mark.parametrize("goal", ["error", "faults"])
def test_more_beacons_better_the_map(goal) -> None:
    site = made(CORNERS[:3])
    nodes, terms = ready(site, walls=column(), speed_sd=2e-3)
    before = quality(site, nodes, terms, LEVEL_M, 0.5)
    candidates = candidates_of(site, terms.walls, LEVEL_M)
    got = improve(nodes, nodes.pick([]), 2, candidates, floor(site), terms, goal)
    new = extended(site, {}, dict(zip(free_ids(site, 2), got.position_m, strict=True)))
    after = quality(new, *ready(new, walls=column(), speed_sd=2e-3), LEVEL_M, 0.5)
    if goal == "error":
        assert after.over_floor(after.sd_m, 95) < 0.9 * before.over_floor(before.sd_m, 95)
    else:
        assert after.share(after.fault_m <= 0.5) > before.share(before.fault_m <= 0.5) + 0.1
    assert got.cost_after < got.cost_before


def test_a_beacon_that_may_move_leaves_a_bad_place_and_keeps_a_good_one() -> None:
    cramped = made([*CORNERS[:3], (13.0, 8.4, 3.5)])
    nodes, terms = ready(cramped)
    places, candidates = floor(cramped), candidates_of(cramped, terms.walls, LEVEL_M)
    got = improve(nodes.pick([0, 1, 2]), nodes.pick([3]), 0, candidates, places, terms)
    assert np.linalg.norm(got.position_m[0] - nodes.position_m[3]) > 3.0
    assert got.cost_after < got.cost_before
    # once there, it stays: nothing is better
    again = made([*CORNERS[:3], tuple(got.position_m[0])])
    nodes, terms = ready(again)
    stays = improve(nodes.pick([0, 1, 2]), nodes.pick([3]), 0, candidates, places, terms)
    np.testing.assert_allclose(stays.position_m[0], got.position_m[0])


def test_places_are_on_ceiling_and_walls_above_the_level_and_not_in_obstacles() -> None:
    site = made()
    places = candidates_of(site, column(), LEVEL_M)
    low, high = np.array(ROOM)
    assert 50 < len(places) < 400
    assert (places >= low).all()
    assert (places <= high).all()
    on_wall = (places[:, :2] == low[:2]).any(axis=1) | (places[:, :2] == high[:2]).any(axis=1)
    assert (on_wall | (places[:, 2] == high[2])).all()
    assert on_wall.any()
    assert (places[:, 2] > LEVEL_M).all()
    within = (np.abs(places[:, 0] - 7) < 1) & (np.abs(places[:, 1] - 4.5) < 1.5)
    assert not within.any()
    with pytest.raises(ValueError, match="ends at 4 m, not above the map's level of 5 m"):
        candidates_of(site, column(), 5.0)


def test_beacons_keep_clear_of_each_other() -> None:
    site = made(CORNERS[:2])
    nodes, terms = ready(site)
    close = np.array([[7.0, 8.9, 3.9], [7.1, 8.9, 3.9], [0.5, 0.5, 3.7], [2.0, 8.0, 3.0]])
    got = improve(nodes, nodes.pick([]), 2, close, floor(site, 1.0), terms)
    apart = np.linalg.norm(got.position_m[0] - got.position_m[1])
    assert apart > CLEAR_M
    assert not (got.position_m == close[2]).all(axis=1).any()  # beside B1


def test_too_few_places_are_refused() -> None:
    site = made()
    nodes, terms = ready(site)
    with pytest.raises(ValueError, match="1 places for 2 beacons"):
        improve(nodes, nodes.pick([]), 2, np.array([[7.0, 4.0, 4.0]]), floor(site), terms)
    side_by_side = np.array([[7.0, 4.0, 4.0], [7.1, 4.0, 4.0]])
    with pytest.raises(ValueError, match=r"hold 1 beacons 0\.3 m apart from each other, and 2 are asked for"):
        improve(nodes, nodes.pick([]), 2, side_by_side, floor(site), terms)
    with pytest.raises(ValueError, match="nothing to place"):
        improve(nodes, nodes.pick([]), 0, np.array([[7.0, 4.0, 4.0]]), floor(site), terms)


def test_a_sample_of_places_is_spread_over_all() -> None:
    places = floor(made(), 0.1)
    some = sample_of(places, 500)
    assert len(some) == 500
    assert len(np.unique(some, axis=0)) == 500
    quarters, _, _ = np.histogram2d(some[:, 0], some[:, 1], bins=4, range=[[0, 14], [0, 9]])
    assert quarters.min() > 0.7 * 500 / 16
    assert sample_of(some, 500) is some


def test_new_beacons_get_free_ids_and_codes() -> None:
    site = made([*CORNERS, (7.0, 4.0, 4.0)], degree=5)  # one of six m-sequences is left
    assert free_ids(site, 3) == ["B6", "B7", "B8"]
    new = extended(site, {}, {name: np.array([3.0, k, 4.0]) for k, name in enumerate(free_ids(site, 3))})
    assert [b.code.family for b in new.beacons[5:] if b.code] == ["m-sequence", "gold", "gold"]
    chips = {chips.tobytes() for b in new.beacons if (chips := chips_of(b)) is not None}
    assert len(chips) == 8
    assert len(list(unused_codes(made(degree=7), made(degree=7).beacons[0]))) > 100


def test_a_moved_beacon_is_a_guess_no_more() -> None:
    site = made()
    loose = site.model_copy(
        update={"beacons": (site.beacons[0].model_copy(update={"position_sd_m": 2.0}), *site.beacons[1:])}
    )
    new = extended(loose, {"B1": np.array([1.0, 2.0, 3.0])}, {})
    assert new.beacons[0].position_m == (1.0, 2.0, 3.0)
    assert new.beacons[0].position_sd_m == 0.0
    assert new.beacons[1:] == loose.beacons[1:]


def test_places_are_rounded_to_the_centimetre() -> None:
    np.testing.assert_array_equal(rounded(np.array([1.23456, 2.0, 0.005001])), [1.23, 2.0, 0.01])
