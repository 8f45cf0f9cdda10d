"""What holds for any fix: exact from exact ranges, moved with the world, blind to order, never surely wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locate.made_epochs import BOUNDS, HALL, Drive, make_epoch, make_site, rows_of
from sonofix.locate.fix import fix
from sonofix.locate.start import starts
from sonofix.records import Fix, Floats

inside = st.tuples(st.floats(0.5, 9.5), st.floats(0.5, 7.5), st.floats(0.2, 3.0)).map(np.array)
speed = st.floats(-1.5, 1.5)
clocks = st.one_of(st.none(), st.floats(-300, 300))
seeds = st.integers(0, 2**32 - 1)
TWO_ARMS = ((0.4, 0.0, 0.5), (-0.4, 0.1, 0.5))

EXACT_M = 1e-5
"""A fix stops at a step of 1e-4 sigma of 1 cm; where geometry dilutes tenfold that is 1e-5 m."""


def error_in_sigmas(found: Fix, place: Floats) -> float:
    """Distance from the truth over the deviation in all axes together, curved uncertainties being no ellipsoids."""
    assert found.position_m is not None
    variance_m2 = sum((found.sd(axis) or 0.0) ** 2 for axis in "xyz")
    return float(np.linalg.norm(found.position_m - place) / np.sqrt(variance_m2))


@given(inside, clocks, st.booleans(), st.booleans())
def test_exact_ranges_give_the_exact_position(
    place: Floats, clock_m: float | None, level: bool, sounding: bool
) -> None:
    site = make_site(HALL, level_m=float(place[2]) if level else None, sounding=sounding)
    found = fix(make_epoch(site, Drive(place), clock_m=clock_m), site, "v")
    assert found.status in ("ok", "ambiguous"), found.remedy
    if found.status == "ok":
        np.testing.assert_allclose(found.position_m, place, atol=EXACT_M)
        assert found.used.all()


@given(inside, st.tuples(speed, speed, speed), st.booleans(), st.booleans(), seeds)
def test_exact_ranges_and_rates_give_the_exact_position_and_velocity(
    place: Floats, velocity: tuple, level: bool, sounding: bool, seed: int
) -> None:
    drive = Drive(place, (*velocity[:2], 0.0) if level else velocity)
    site = make_site(HALL, level_m=float(place[2]) if level else None, sounding=sounding)
    times = np.random.default_rng(seed).uniform(0.0, 0.09, len(HALL))
    found = fix(make_epoch(site, drive, times, rate_sd_mps=0.02), site, "v")
    assert found.status == "ok", found.remedy
    np.testing.assert_allclose(found.position_m, drive.origin(found.time_s), atol=EXACT_M)
    np.testing.assert_allclose(found.velocity_mps, drive.velocity_mps, atol=1e-4)


@given(inside, st.floats(-3.1, 3.1), clocks, st.booleans())
def test_exact_ranges_at_two_ends_give_the_exact_heading(
    place: Floats, yaw_rad: float, clock_m: float | None, sounding: bool
) -> None:
    site = make_site(HALL, arms_m=TWO_ARMS, level_m=float(place[2]), sounding=sounding)
    found = fix(make_epoch(site, Drive(place, yaw_rad=yaw_rad), clock_m=clock_m), site, "v")
    assert found.status == "ok", found.remedy
    np.testing.assert_allclose(found.position_m, place, atol=EXACT_M)
    assert abs(np.angle(np.exp(1j * (found.yaw_rad - yaw_rad)))) < 1e-4


@given(inside, st.tuples(speed, speed, speed), clocks, seeds, st.floats(-50, 50), st.floats(-50, 50))
def test_a_fix_moves_with_the_world(
    place: Floats, velocity: tuple, clock_m: float | None, seed: int, east_m: float, north_m: float
) -> None:
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    shift = np.array([east_m, north_m, 3.0])
    site, elsewhere = make_site(HALL), make_site(np.array(HALL) @ turn.T + shift)
    times = rng.uniform(0.0, 0.05, len(HALL))
    epoch = make_epoch(site, Drive(place, velocity), times, rate_sd_mps=0.05, clock_m=clock_m, rng=rng)
    here, there = fix(epoch, site, "v"), fix(epoch, elsewhere, "v")
    assert here.status == there.status
    if here.position_m is None:
        return
    np.testing.assert_allclose(there.position_m, here.position_m @ turn.T + shift, atol=EXACT_M)
    np.testing.assert_allclose(there.velocity_mps, here.velocity_mps @ turn.T, atol=1e-4)
    np.testing.assert_allclose(there.residual_m, here.residual_m, atol=EXACT_M)
    np.testing.assert_allclose(there.covariance[:3, :3], turn @ here.covariance[:3, :3] @ turn.T, rtol=1e-3, atol=1e-7)


@given(inside, clocks, st.booleans(), st.permutations(range(len(HALL))), seeds)
def test_the_order_of_rows_does_not_matter(
    place: Floats, clock_m: float | None, level: bool, order: list[int], seed: int
) -> None:
    site = make_site(HALL, level_m=float(place[2]) if level else None)
    epoch = make_epoch(site, Drive(place), clock_m=clock_m, rng=np.random.default_rng(seed))
    a, b = fix(epoch, site, "v"), fix(rows_of(epoch, order), site, "v")
    assert a.status == b.status
    np.testing.assert_array_equal(b.used, a.used[order])
    if a.position_m is not None:
        np.testing.assert_allclose(b.position_m, a.position_m, atol=EXACT_M)
        np.testing.assert_allclose(b.residual_m, a.residual_m[order], atol=EXACT_M)
        np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-3, atol=1e-8)


@given(inside, seeds, st.floats(0.1, 10.0))
def test_a_common_factor_of_all_deviations_scales_the_fix_and_moves_it_not(
    place: Floats, seed: int, factor: float
) -> None:
    site = make_site(HALL)
    epoch = make_epoch(site, Drive(place), sd_m=1e-3, rng=np.random.default_rng(seed))
    # small noise, larger claims: no row is ever doubted
    plain = replace(epoch, covariance_m2=0.01**2 * np.eye(len(HALL)))
    scaled = replace(epoch, covariance_m2=(0.01 * factor) ** 2 * np.eye(len(HALL)))
    a, b = fix(plain, site, "v"), fix(scaled, site, "v")
    assert a.status == b.status == "ok"
    np.testing.assert_allclose(b.position_m, a.position_m, atol=factor * EXACT_M)
    np.testing.assert_allclose(b.covariance, factor**2 * a.covariance, rtol=1e-2, atol=1e-9)


# --- poor geometry ----------------------------------------------------------------------------------------------------


def on_a_line(rng: np.random.Generator, n: int) -> Floats:
    return rng.uniform([1, 1, 1], [9, 7, 3]) + np.linspace(-1, 1, n)[:, None] * rng.uniform(-4, 4, 3)


def twice(rng: np.random.Generator, n: int) -> Floats:
    places = rng.uniform([0, 0, 0], [10, 8, 3], (n, 3))
    return places[np.arange(n) // 2]


LAYOUTS = {
    "in a room": lambda rng, n: rng.uniform([0, 0, 0], [10, 8, 3.2], (n, 3)),
    "in the ceiling": lambda rng, n: rng.uniform([0, 0, 3], [10, 8, 3], (n, 3)),
    "nearly in the ceiling": lambda rng, n: rng.uniform([0, 0, 3.0], [10, 8, 3.1], (n, 3)),
    "on a line": on_a_line,
    "nearly on a line": lambda rng, n: on_a_line(rng, n) + rng.normal(0, 0.02, (n, 3)),
    "at one point": lambda rng, n: np.tile(rng.uniform([0, 0, 0], [10, 8, 3]), (n, 1)),
    "two at each place": twice,
    "within a hand": lambda rng, n: np.array([5.0, 4.0, 2.0]) + rng.normal(0, 0.03, (n, 3)),
    "far away": lambda rng, n: np.array([3e3, 4e3, 0.0]) + rng.uniform(-2, 2, (n, 3)),
}


def check_honest(found: Fix, rows: int) -> None:
    """No number that is not one; a remedy with every failure; a positive covariance with every position."""
    assert len(found.used) == len(found.residual_m) == rows
    if found.status == "ok":
        assert found.remedy == ""
    else:
        assert len(found.remedy) > 20
    if found.status in ("ok", "inconsistent"):
        assert found.position_m is not None
        assert np.isfinite(found.position_m).all()
        assert np.isfinite(found.covariance).all()
        assert np.linalg.eigvalsh(found.covariance).min() > -1e-12 * np.trace(found.covariance)
        assert (np.diag(found.covariance) > 0).all()
    else:
        assert found.position_m is None
        assert not found.used.any()


@pytest.mark.parametrize("layout", LAYOUTS)
@settings(max_examples=60)
@given(
    seed=seeds,
    n=st.integers(0, 7),
    level=st.booleans(),
    clock=st.booleans(),
    bounded=st.booleans(),
    at_beacon=st.booleans(),
    noisy=st.booleans(),
)
def test_poor_geometry_raises_nothing_and_deceives_nobody(
    layout: str, seed: int, n: int, level: bool, clock: bool, bounded: bool, at_beacon: bool, noisy: bool
) -> None:
    rng = np.random.default_rng(seed)
    anchors = LAYOUTS[layout](rng, max(n, 1))
    place = anchors[0].copy() if at_beacon else rng.uniform([0.2, 0.2, 0.1], [9.8, 7.8, 3.0])
    holds_all = bounded and bool(np.all(place >= BOUNDS[0]) and np.all(place <= BOUNDS[1]))
    site = make_site(anchors, level_m=float(place[2]) if level else None, bounds_m=BOUNDS if holds_all else None)
    epoch = make_epoch(site, Drive(place), clock_m=12.0 if clock else None, rng=rng if noisy else None)
    epoch = rows_of(epoch, np.arange(n))
    found = fix(epoch, site, "v")
    check_honest(found, n)
    if found.status == "ok":
        assert error_in_sigmas(found, place) < 6.0


def fix_of_two_ends(layout: str, seed: int, n: int, level: bool, clock: bool) -> tuple[Fix, Floats]:
    rng = np.random.default_rng(seed)
    anchors = LAYOUTS[layout](rng, n)
    place = rng.uniform([0.5, 0.5, 0.1], [9.5, 7.5, 2.0])
    site = make_site(anchors, arms_m=TWO_ARMS, level_m=float(place[2]) if level else None, bounds_m=BOUNDS)
    drive = Drive(place, yaw_rad=float(rng.uniform(-3, 3)))
    found = fix(make_epoch(site, drive, clock_m=5.0 if clock else None, rng=rng), site, "v")
    check_honest(found, 2 * n)
    return found, place


@pytest.mark.parametrize("layout", ["in a room", "in the ceiling", "nearly in the ceiling", "at one point"])
@settings(max_examples=40)
@given(seed=seeds, n=st.integers(3, 6), level=st.booleans(), clock=st.booleans())
def test_two_ends_deceive_nobody(layout: str, seed: int, n: int, level: bool, clock: bool) -> None:
    found, place = fix_of_two_ends(layout, seed, n, level, clock)
    if found.status == "ok":
        assert error_in_sigmas(found, place) < 6.0


def test_two_ends_in_degenerate_layouts_deceive_rarely() -> None:
    # a pose with a free heading among beacons on a line has more solutions than there are starts: seldom, none is right
    wrong, trials = 0, 0
    for layout in ("on a line", "nearly on a line", "two at each place", "within a hand"):
        for seed in range(30):
            found, place = fix_of_two_ends(layout, seed, 3 + seed % 4, bool(seed & 4), bool(seed & 8))
            wrong += found.status == "ok" and error_in_sigmas(found, place) > 6.0
            trials += 1
    # 13 of 360 were seen; at that share, more than 9 of 120 happen once in a hundred draws
    assert wrong <= 9, f"{wrong} of {trials}"


@given(seeds, st.integers(1, 8), st.sampled_from([0.0, 1e-9, 1.0, 1e6]), clocks)
def test_nonsense_ranges_raise_nothing(seed: int, n: int, scale: float, clock_m: float | None) -> None:
    rng = np.random.default_rng(seed)
    site = make_site(rng.uniform(0, 9, (n, 3)))
    epoch = make_epoch(site, Drive((4.0, 4.0, 1.0)), clock_m=clock_m)
    found = fix(replace(epoch, range_m=scale * rng.standard_normal(n)), site, "v")
    check_honest(found, n)


@given(inside, clocks, st.integers(4, 6), st.booleans())
def test_one_start_is_the_position_itself(place: Floats, clock_m: float | None, n: int, level: bool) -> None:
    anchors = np.array(HALL)[:n]
    range_m = np.linalg.norm(place - anchors, axis=1) + (clock_m or 0.0)
    found = starts(anchors, range_m, float(place[2]) if level else None, clock_m is not None)
    assert found
    # two roots of a quadratic may meet: then rounding of 1e-13 in squared metres is its root in metres
    assert min(np.linalg.norm(s[:3] - place) for s in found) < 1e-4
