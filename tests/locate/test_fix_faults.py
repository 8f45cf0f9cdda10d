"""Faulty rows, rows that disagree, too few rows, a vehicle at a beacon: a status with a remedy, no surprise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import BOUNDS, HALL, Drive, make_epoch, make_site, rows_of, shifted
from sonofix.locate.fix import fix

PLACE = (3.0, 5.5, 1.1)
MANY = (*HALL, (2.0, 8.0, 3.2), (8.0, 0.0, 3.0), (10.0, 4.0, 0.5), (0.0, 4.0, 1.9))


@pytest.mark.parametrize("row", range(6))
@pytest.mark.parametrize("by_m", [-0.4, 0.3, 5.0])
def test_one_gross_error_is_left_out(row: int, by_m: float, rng: np.random.Generator) -> None:
    site = make_site(HALL)
    found = fix(shifted(make_epoch(site, Drive(PLACE), rng=rng), row, by_m), site, "v")
    assert found.status == "ok"
    assert np.flatnonzero(~found.used).tolist() == [row]
    # still told, against the position that it does not touch: four sigma of this layout at most
    assert found.residual_m[row] == pytest.approx(by_m, abs=0.2)
    error_m = found.position_m - PLACE
    assert error_m @ np.linalg.solve(found.covariance, error_m) < 36


def test_one_gross_error_is_left_out_with_an_unknown_clock(rng: np.random.Generator) -> None:
    site = make_site(MANY)
    found = fix(shifted(make_epoch(site, Drive(PLACE), clock_m=60.0, rng=rng), 4, 0.5), site, "v")
    assert found.status == "ok"
    assert np.flatnonzero(~found.used).tolist() == [4]


@pytest.mark.parametrize("level_m", [None, 1.1], ids=["space", "level"])
@pytest.mark.parametrize("clock_m", [None, 60.0])
@pytest.mark.parametrize("by_m", [3.0, 30.0, 300.0])
@pytest.mark.parametrize("rate_sd_mps", [None, 0.01])
def test_one_range_off_by_far_is_left_out_of_precise_ones(
    level_m: float | None, clock_m: float | None, by_m: float, rate_sd_mps: float | None, rng: np.random.Generator
) -> None:
    # no descent with all of them comes to rest: the bend of a range that is so far off outweighs its slope
    site = make_site(MANY, level_m=level_m, bounds_m=BOUNDS)
    for row in range(len(MANY)):
        place = (*rng.uniform((1, 1), (9, 7)), 1.1)
        epoch = make_epoch(site, Drive(place), sd_m=0.001, rate_sd_mps=rate_sd_mps, clock_m=clock_m, rng=rng)
        found = fix(shifted(epoch, row, by_m), site, "v")
        assert found.status == "ok"
        assert np.flatnonzero(~found.used).tolist() == [row]
        error_m = (found.position_m - place)[: 2 if level_m else 3]
        covariance = found.covariance[: len(error_m), : len(error_m)]
        assert error_m @ np.linalg.solve(covariance, error_m) < 36


@pytest.mark.parametrize("level_m", [None, 1.1], ids=["space", "level"])
@pytest.mark.parametrize("clock_m", [None, 60.0])
@pytest.mark.parametrize("by_m", [3.0, 8.0, 30.0])
def test_circles_that_do_not_meet_are_no_place_though_none_is_to_spare(
    level_m: float | None, clock_m: float | None, by_m: float, rng: np.random.Generator
) -> None:
    needed = 3 + (level_m is None) + (clock_m is not None) - 1
    site = make_site(HALL[:needed], level_m=level_m, bounds_m=BOUNDS)
    for _ in range(20):
        place = (*rng.uniform((1, 1), (9, 7)), 1.1)
        epoch = make_epoch(site, Drive(place), sd_m=0.002, clock_m=clock_m, rng=rng)
        found = fix(shifted(epoch, int(rng.integers(needed)), by_m), site, "v")
        if found.status == "ok":  # they meet somewhere else: nothing can tell
            np.testing.assert_allclose(found.residual_m, 0.0, atol=0.02)


def test_a_wrong_choice_that_agrees_by_chance_is_gainsaid() -> None:
    # the wrong range (the last) drew all descents into the valley of another height, where leaving out another agrees
    anchors = ((9.36, 20.3, 1.21), (12.46, 8.29, 1.06), (4.55, 19.45, 1.07))
    anchors += ((24.28, 6.93, 1.32), (5.27, 0.82, 0.09), (2.77, 5.22, 0.07))
    site = make_site(anchors, bounds_m=((0.0, 0.0, 0.0), (32.0, 32.0, 1.4)))
    exact = make_epoch(site, Drive((28.48, 1.24, 0.25)), sd_m=0.0065)
    noise_m = np.array([-0.0021, 0.003, -0.0026, 0.0036, -0.0053, 0.0858])
    found = fix(replace(exact, range_m=exact.range_m + noise_m), site, "v")
    assert found.status == "inconsistent"
    assert np.flatnonzero(~found.used).tolist() == [5]


@pytest.mark.parametrize("by_m", [30.0, 300.0])
def test_far_ranges_that_cannot_be_told_apart_have_no_confident_place(by_m: float, rng: np.random.Generator) -> None:
    site = make_site(HALL, bounds_m=BOUNDS)
    epoch = make_epoch(site, Drive(PLACE), sd_m=0.001, rng=rng)
    for row, share in ((0, 1.0), (2, -1.3), (3, 0.7), (5, 1.6)):
        epoch = shifted(epoch, row, share * by_m)
    found = fix(epoch, site, "v")
    assert found.status in ("no-convergence", "inconsistent", "ambiguous")
    assert found.remedy


@pytest.mark.parametrize("faulty", [(1, 6), (0, 4, 9), (2, 3)])
def test_several_gross_errors_among_many_rows_are_left_out(faulty: tuple, rng: np.random.Generator) -> None:
    site = make_site(MANY)
    epoch = make_epoch(site, Drive(PLACE), rng=rng)
    for row, by_m in zip(faulty, (0.9, -0.5, 2.0), strict=False):
        epoch = shifted(epoch, row, by_m)
    found = fix(epoch, site, "v")
    assert found.status == "ok"
    assert tuple(np.flatnonzero(~found.used)) == faulty
    error_m = found.position_m - PLACE
    assert error_m @ np.linalg.solve(found.covariance, error_m) < 36


@pytest.mark.parametrize("rate_sd_mps", [None, 0.003, 0.05, 0.3])
@pytest.mark.parametrize("by_m", [0.1, -0.1, 0.2])
def test_a_fault_that_cannot_be_placed_is_told_however_loose_the_rates_are(
    by_m: float, rate_sd_mps: float | None
) -> None:
    # two beacons south, two east: one of the eastern pair is wrong, and either may be
    pairs, bounds = ((5.0, 0.0, 1.0), (5.1, -1.0, 1.0), (11.0, 4.0, 1.0), (12.0, 4.1, 1.0)), ((0, -5, 0), (15, 12, 3))
    site = make_site(pairs, level_m=1.0, bounds_m=bounds)
    epoch = make_epoch(site, Drive((5.0, 4.0, 1.0)), sd_m=0.003, rate_sd_mps=rate_sd_mps)
    found = fix(shifted(epoch, 2, by_m), site, "v")
    assert found.status == "inconsistent"
    assert "which cannot be told" in found.remedy
    assert found.hpl_m is None


def test_disagreement_without_a_culprit_is_told_and_widens_the_fix(rng: np.random.Generator) -> None:
    # ranges that all err by 20 cm while claiming 1 cm: no single row mends that
    site = make_site(MANY)
    wrong = make_epoch(site, Drive(PLACE), sd_m=0.2, rng=rng)
    claimed = replace(wrong, covariance_m2=0.01**2 * np.eye(len(MANY)))
    found = fix(claimed, site, "v")
    assert found.status == "inconsistent"
    assert "check" in found.remedy
    assert found.position_m is not None
    error_m = found.position_m - PLACE
    assert error_m @ np.linalg.solve(found.covariance, error_m) < 36
    assert found.sd("x") > 5 * fix(make_epoch(site, Drive(PLACE)), site, "v").sd("x")


# --- too little -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("level_m", "clock_m", "needed"), [(None, None, 3), (None, 5.0, 4), (1.1, None, 2), (1.1, 5.0, 3)]
)
def test_too_few_rows_say_how_many_are_needed(level_m: float | None, clock_m: float | None, needed: int) -> None:
    site = make_site(HALL, level_m=level_m)
    epoch = make_epoch(site, Drive(PLACE), clock_m=clock_m)
    for count in range(needed):
        found = fix(rows_of(epoch, np.arange(count)), site, "v")
        assert found.status == "too-few"
        assert f"{count} of {needed}" in found.remedy
        assert found.position_m is found.covariance is found.velocity_mps is None
        assert not found.used.any()
        assert len(found.residual_m) == count


def test_an_empty_epoch_is_a_status() -> None:
    site = make_site(HALL)
    empty = rows_of(make_epoch(site, Drive(PLACE)), np.zeros(0, int))
    found = fix(replace(empty, sync_s=7.25), site, "v")
    assert found.status == "too-few"
    assert found.time_s == 7.25


def test_a_vehicle_that_the_site_lacks_is_a_mistake() -> None:
    site = make_site(HALL)
    with pytest.raises(ValueError, match="w"):
        fix(make_epoch(site, Drive(PLACE)), site, "w")


@pytest.mark.parametrize("spread_s", [0.02, 0.1, 0.5])
def test_motion_that_no_rates_tell_of_is_allowed_for(spread_s: float, rng: np.random.Generator) -> None:
    # at a walk, rows half a second apart lie 60 cm apart: a fix that takes them for simultaneous must say so
    site = make_site(HALL)
    drive = Drive(PLACE, (1.0, 0.5, 0.0))
    for _ in range(20):
        times = rng.permutation(np.linspace(0.0, spread_s, len(HALL)))
        found = fix(make_epoch(site, drive, times, rng=rng), site, "v")
        assert found.status == "ok"
        error_m = found.position_m - drive.origin(found.time_s)
        assert error_m @ np.linalg.solve(found.covariance, error_m) < 36


# --- at a beacon ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level_m", [None, HALL[0][2]], ids=["space", "level"])
@pytest.mark.parametrize("clock_m", [None, 4.0])
def test_right_at_a_beacon(level_m: float | None, clock_m: float | None, rng: np.random.Generator) -> None:
    # there a range has a kink, and noise may make it negative
    site = make_site(HALL, level_m=level_m)
    good = 0
    for _ in range(20):
        found = fix(make_epoch(site, Drive(HALL[0]), clock_m=clock_m, rng=rng), site, "v")
        if found.status == "ok":
            good += 1
            assert np.linalg.norm(found.position_m - HALL[0]) < 0.3
    assert good >= 16
