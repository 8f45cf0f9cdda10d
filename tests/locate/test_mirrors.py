"""Where geometry leaves two positions: both told, and one chosen only by what the site states."""

from __future__ import annotations

import numpy as np
import pytest

from locate.made_epochs import BOUNDS, Drive, make_epoch, make_site, rows_of
from sonofix.locate.fix import fix

CEILING = ((0.0, 0.0, 3.2), (10.0, 0.0, 3.2), (10.0, 8.0, 3.2), (0.0, 8.0, 3.2), (4.0, 3.0, 3.2))
PLACE = np.array([3.0, 5.5, 1.1])
ABOVE = np.array([3.0, 5.5, 5.3])
WALL = ((0.0, 0.0, 2.0), (0.0, 3.0, 2.5), (0.0, 7.0, 2.0), (0.0, 8.0, 1.0))
OUTSIDE = np.array([-3.0, 5.5, 1.1])


@pytest.mark.parametrize("clock_m", [None, 11.0])
@pytest.mark.parametrize("rate_sd_mps", [None, 0.05])
def test_beacons_in_the_ceiling_leave_two_positions(clock_m: float | None, rate_sd_mps: float | None) -> None:
    site = make_site(CEILING)
    found = fix(make_epoch(site, Drive(PLACE), clock_m=clock_m, rate_sd_mps=rate_sd_mps), site, "v")
    assert found.status == "ambiguous"
    assert found.position_m is found.covariance is None
    assert found.mirror_m is not None
    assert min(np.linalg.norm(found.mirror_m - p) for p in (PLACE, ABOVE)) < 1e-5
    for word in ("bounds_m", "z_m"):
        assert word in found.remedy


@pytest.mark.parametrize("clock_m", [None, 11.0])
def test_bounds_of_the_room_choose(clock_m: float | None, rng: np.random.Generator) -> None:
    site = make_site(CEILING, bounds_m=BOUNDS)
    found = fix(make_epoch(site, Drive(PLACE), clock_m=clock_m, rng=rng), site, "v")
    assert found.status == "ok"
    error_m = found.position_m - PLACE
    index = [found.states.index(s) for s in "xyz"]
    assert error_m @ np.linalg.solve(found.covariance[np.ix_(index, index)], error_m) < 36
    assert found.mirror_m is not None
    # the mirror of what was found, about the ceiling
    np.testing.assert_allclose(found.mirror_m, found.position_m * [1, 1, -1] + [0, 0, 6.4], atol=1e-5)


def test_bounds_that_hold_both_choose_neither() -> None:
    site = make_site(CEILING, bounds_m=((0.0, 0.0, 0.0), (10.0, 8.0, 6.0)))
    found = fix(make_epoch(site, Drive(PLACE)), site, "v")
    assert found.status == "ambiguous"
    assert found.position_m is None


def test_a_known_level_leaves_no_mirror() -> None:
    site = make_site(CEILING, level_m=PLACE[2])
    found = fix(make_epoch(site, Drive(PLACE)), site, "v")
    assert found.status == "ok"
    assert found.mirror_m is None
    np.testing.assert_allclose(found.position_m, PLACE, atol=1e-6)


@pytest.mark.parametrize("clock_m", [None, 11.0])
def test_beacons_along_one_wall_mirror_the_vehicle_through_it(clock_m: float | None) -> None:
    site = make_site(WALL, level_m=PLACE[2])
    epoch = make_epoch(site, Drive(PLACE), clock_m=clock_m)
    found = fix(epoch, site, "v")
    assert found.status == "ambiguous"
    assert min(np.linalg.norm(found.mirror_m - p) for p in (PLACE, OUTSIDE)) < 1e-5
    room = make_site(WALL, level_m=PLACE[2], bounds_m=BOUNDS)
    found = fix(epoch, room, "v")
    assert found.status == "ok"
    np.testing.assert_allclose(found.position_m, PLACE, atol=1e-5)
    np.testing.assert_allclose(found.mirror_m, OUTSIDE, atol=1e-5)


def test_two_ranges_on_a_level_cross_twice() -> None:
    site = make_site(CEILING, level_m=PLACE[2])
    epoch = rows_of(make_epoch(site, Drive(PLACE)), [0, 1])
    assert fix(epoch, site, "v").status == "ambiguous"
    # beacons 0 and 1 stand on the south wall: the mirror is south of it
    room = make_site(CEILING, level_m=PLACE[2], bounds_m=BOUNDS)
    found = fix(epoch, room, "v")
    assert found.status == "ok"
    np.testing.assert_allclose(found.position_m, PLACE, atol=1e-5)
    np.testing.assert_allclose(found.mirror_m, PLACE * [1, -1, 1], atol=1e-5)


def test_beacons_on_one_line_leave_a_circle_in_space() -> None:
    # every place on a circle about the line fits: no bounds of a room can choose
    line = np.column_stack([np.linspace(1, 9, 5), np.full(5, 4.0), np.full(5, 3.0)])
    for bounds in (None, BOUNDS):
        found = fix(make_epoch(site := make_site(line, bounds_m=bounds), Drive(PLACE)), site, "v")
        assert found.status in ("ambiguous", "no-convergence")
        assert found.remedy
        assert found.position_m is None


def test_beacons_at_one_point_leave_a_sphere() -> None:
    for bounds in (None, BOUNDS):
        site = make_site([(5.0, 4.0, 3.0)] * 5, bounds_m=bounds)
        found = fix(make_epoch(site, Drive(PLACE)), site, "v")
        assert found.status in ("ambiguous", "no-convergence")
        assert found.remedy
        assert found.position_m is None


def test_a_beacon_lifted_out_of_the_plane_decides(rng: np.random.Generator) -> None:
    # 60 cm out of the plane tells 4.2 m of mirror by 29 cm in its range: 20 sigma
    lifted = (*CEILING[:4], (4.0, 3.0, 2.6))
    site = make_site(lifted)
    found = fix(make_epoch(site, Drive(PLACE), rng=rng), site, "v")
    assert found.status == "ok"
    assert found.mirror_m is None
    assert np.linalg.norm(found.position_m - PLACE) < 0.1


def test_a_beacon_hardly_out_of_the_plane_does_not_decide(rng: np.random.Generator) -> None:
    # 2 cm out of the plane tells the mirror by 1 cm: noise
    lifted = (*CEILING[:4], (4.0, 3.0, 3.18))
    site = make_site(lifted)
    found = fix(make_epoch(site, Drive(PLACE), rng=rng), site, "v")
    assert found.status == "ambiguous"


@pytest.mark.parametrize("rate_sd_mps", [None, 0.05])
def test_mirrors_beside_each_other_on_a_known_level_are_not_two_heights(rate_sd_mps: float | None) -> None:
    # 7 mm beside the line of all beacons: the other solution is 14 mm away, on the same level
    line = np.column_stack([np.linspace(0, 9, 4), np.full(4, 4.0), np.full(4, 2.5)])
    site = make_site(line, level_m=1.0)
    place = np.array([3.1, 4.007, 1.0])
    epoch = make_epoch(site, Drive(place, (0.5, 0.0, 0.0)), sd_m=1e-4, rate_sd_mps=rate_sd_mps)
    found = fix(epoch, site, "v")
    assert found.status == "ok"
    both = sorted([found.position_m.tolist(), found.mirror_m.tolist()])
    np.testing.assert_allclose(both, [place * [1, 0, 1] + [0, 3.993, 0], place], atol=1e-6)
    # whichever is told, the deviation reaches to the other
    assert found.sd("y") > 0.014
    assert np.linalg.eigvalsh(found.covariance).min() > 0
