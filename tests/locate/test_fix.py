"""A fix from exact ranges is exact, in every arrangement that the site file can state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import BOUNDS, HALL, Drive, make_epoch, make_site, rows_of
from sonofix.locate.fix import OPEN_DIRECTION, OPEN_HEIGHT, fix
from sonofix.records import Fix, Floats
from sonofix.site import Site

PLACE = (3.0, 5.5, 1.1)
TWO_ARMS = ((0.35, 0.1, 0.5), (-0.3, -0.2, 0.5))
# a fix stops once a step is below 1e-4 sigma; sigma is 1 cm, and the last step was quadratically better than that
EXACT_M = 1e-6


def check_ok(found: Fix, place: Floats | tuple, within_m: float = EXACT_M) -> None:
    assert found.status == "ok", found.remedy
    assert found.remedy == ""
    assert found.position_m is not None
    np.testing.assert_allclose(found.position_m, place, atol=within_m)
    assert found.covariance is not None
    assert found.covariance.shape == (len(found.states),) * 2
    np.testing.assert_allclose(found.covariance, found.covariance.T, rtol=1e-9)
    assert np.linalg.eigvalsh(found.covariance).min() > 0


# --- exact ranges -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clock_m", [None, -30.0, 250.0])
@pytest.mark.parametrize("sounding", [False, True], ids=["listening", "sounding"])
@pytest.mark.parametrize("level_m", [None, 1.1], ids=["space", "level"])
def test_standing_vehicle(level_m: float | None, sounding: bool, clock_m: float | None) -> None:
    site = make_site(HALL, level_m=level_m, sounding=sounding)
    found = fix(make_epoch(site, Drive(PLACE), clock_m=clock_m), site, "v")
    check_ok(found, PLACE)
    assert found.states == (("x", "y") if level_m else ("x", "y", "z")) + (("clock",) if clock_m else ())
    assert found.used.all()
    np.testing.assert_allclose(found.residual_m, 0.0, atol=EXACT_M)
    assert (found.clock_offset_m is None) == (clock_m is None)
    if clock_m is not None:
        assert found.clock_offset_m == pytest.approx(clock_m, abs=EXACT_M)
    assert (found.vdop is None) == (level_m is not None)
    assert found.velocity_mps is None
    assert found.yaw_rad is None


@pytest.mark.parametrize("clock_m", [None, 42.0])
@pytest.mark.parametrize("sounding", [False, True], ids=["listening", "sounding"])
@pytest.mark.parametrize("level_m", [None, 1.1], ids=["space", "level"])
def test_driving_vehicle_heard_at_different_moments(
    level_m: float | None, sounding: bool, clock_m: float | None, rng: np.random.Generator
) -> None:
    # at 2 m/s, 90 ms apart, rows taken for simultaneous would be 18 cm apart
    drive = Drive(PLACE, (1.6, -1.2, 0.0 if level_m else 0.3))
    site = make_site(HALL, level_m=level_m, sounding=sounding)
    epoch = make_epoch(site, drive, rng.uniform(0.0, 0.09, len(HALL)), rate_sd_mps=0.02, clock_m=clock_m)
    found = fix(epoch, site, "v")
    # differences that make the rates here are good to 1e-7 m/s
    check_ok(found, drive.origin(found.time_s))
    assert found.velocity_mps is not None
    np.testing.assert_allclose(found.velocity_mps, drive.velocity_mps, atol=1e-5)


def test_instant_is_the_mean_of_the_moments_that_rows_speak_of() -> None:
    times = np.array([0.00, 0.01, 0.03, 0.04, 0.07, 0.09])
    listening, sounding = make_site(HALL), make_site(HALL, sounding=True)
    heard = make_epoch(listening, Drive(PLACE), times, rate_sd_mps=0.02)
    assert fix(heard, listening, "v").time_s == pytest.approx(times.mean(), abs=1e-12)
    sent = make_epoch(sounding, Drive(PLACE), times, rate_sd_mps=0.02)
    flight_s = sent.range_m / sent.sound_speed_mps
    assert fix(sent, sounding, "v").time_s == pytest.approx((times - flight_s).mean(), abs=1e-12)


@pytest.mark.parametrize("yaw_rad", [-3.0, -1.4, 0.0, 0.8, 2.2, 3.1])
@pytest.mark.parametrize("sounding", [False, True], ids=["listening", "sounding"])
@pytest.mark.parametrize("clock_m", [None, 9.0])
def test_two_ends_on_one_vehicle_show_where_it_looks(yaw_rad: float, sounding: bool, clock_m: float | None) -> None:
    site = make_site(HALL, arms_m=TWO_ARMS, sounding=sounding)
    found = fix(make_epoch(site, Drive(PLACE, yaw_rad=yaw_rad), clock_m=clock_m), site, "v")
    check_ok(found, PLACE, 1e-5)
    assert "yaw" in found.states
    assert found.yaw_rad is not None
    assert np.angle(np.exp(1j * (found.yaw_rad - yaw_rad))) == pytest.approx(0.0, abs=1e-4)


def test_two_ends_on_a_vehicle_that_drives_and_turns(rng: np.random.Generator) -> None:
    drive = Drive(PLACE, (1.0, 0.5, 0.0), yaw_rad=0.6, yaw_rate_radps=0.5)
    site = make_site(HALL, arms_m=TWO_ARMS, level_m=PLACE[2])
    found = fix(make_epoch(site, drive, rng.uniform(0.0, 0.06, 12), rate_sd_mps=0.02), site, "v")
    check_ok(found, drive.origin(found.time_s), 1e-5)
    assert found.yaw_rad == pytest.approx(drive.yaw(found.time_s), abs=1e-4)
    np.testing.assert_allclose(found.velocity_mps, drive.velocity_mps, atol=1e-4)


def test_a_lone_microphone_above_the_origin_needs_no_heading() -> None:
    site = make_site(HALL, arms_m=((0.0, 0.0, 0.7),))
    check_ok(fix(make_epoch(site, Drive(PLACE, yaw_rad=1.9)), site, "v"), PLACE)


def test_a_lone_microphone_off_the_axis_is_carried_the_way_the_vehicle_drives() -> None:
    # it drives where it looks: north-east
    drive = Drive(PLACE, (1.0, 1.0, 0.0), yaw_rad=np.pi / 4)
    site = make_site(HALL, arms_m=((0.4, -0.1, 0.5),), level_m=PLACE[2])
    found = fix(make_epoch(site, drive, rate_sd_mps=0.02), site, "v")
    check_ok(found, PLACE, 1e-4)


def test_a_lone_microphone_off_the_axis_of_a_standing_vehicle_leaves_its_arm_open() -> None:
    site = make_site(HALL, arms_m=((0.4, 0.0, 0.5),), level_m=PLACE[2])
    found = fix(make_epoch(site, Drive(PLACE, yaw_rad=2.0)), site, "v")
    assert found.status == "ok"
    assert found.position_m is not None
    off_m = float(np.hypot(*(found.position_m - PLACE)[:2]))
    assert off_m == pytest.approx(0.4, abs=1e-5)  # where the microphone is, as the heading is not known
    sd_x, sd_y = found.sd("x"), found.sd("y")
    assert sd_x is not None
    assert sd_y is not None
    assert off_m < 2 * np.hypot(sd_x, sd_y)


@pytest.mark.parametrize(
    ("level_m", "clock_m", "count"), [(None, None, 4), (None, 5.0, 5), (1.1, None, 3), (1.1, 5.0, 4)]
)
def test_one_row_more_than_unknowns_decides_alone(level_m: float | None, clock_m: float | None, count: int) -> None:
    site = make_site(HALL, level_m=level_m)
    epoch = rows_of(make_epoch(site, Drive(PLACE), clock_m=clock_m), np.arange(count))
    check_ok(fix(epoch, site, "v"), PLACE)


def test_exactly_determined_by_bounds() -> None:
    # three ranges in space: two mirror positions about the beacons' plane, one of them outside the room
    site = make_site(HALL, bounds_m=BOUNDS)
    epoch = rows_of(make_epoch(site, Drive(PLACE)), [0, 2, 3])
    found = fix(epoch, site, "v")
    check_ok(found, PLACE)
    np.testing.assert_allclose(found.residual_m, 0.0, atol=EXACT_M)
    assert found.mirror_m is not None


def test_rows_without_a_range_and_rows_of_others_are_left_alone() -> None:
    site = make_site(HALL)
    epoch = make_epoch(site, Drive(PLACE))
    range_m = epoch.range_m.copy()
    range_m[2] = np.nan
    found = fix(replace(epoch, range_m=range_m), site, "v")
    check_ok(found, PLACE)
    assert found.used.tolist() == [True, True, False, True, True, True]
    assert np.isnan(found.residual_m[2])


def test_ranges_between_vehicles_are_left_to_the_track() -> None:
    site = Site.model_validate(
        {
            "vehicle": [{"id": "v"}, {"id": "w"}],
            "beacon": [{"id": f"B{i}", "position_m": p} for i, p in enumerate(HALL)] + [{"id": "H", "vehicle": "w"}],
            "microphone": [{"id": "M0", "vehicle": "v"}, {"id": "N", "vehicle": "w"}],
        }
    )
    plain = make_epoch(make_site(HALL), Drive(PLACE))
    epoch = rows_of(plain, [0, 1, 2, 3, 4, 5, 5, 5])
    epoch = replace(epoch, emitter=(*epoch.emitter[:6], "H", "B0"), receiver=("M0",) * 7 + ("N",))
    found = fix(epoch, site, "v")
    check_ok(found, PLACE)
    assert found.used.tolist() == [True] * 6 + [False] * 2
    assert fix(epoch, site, "w").status == "too-few"


ON_A_LEVEL = [(0, 0, 1.04), (7, 0, 1.05), (7, 6, 1.04), (0, 6, 1.045), (3.5, 0, 1.04), (7, 3, 1.043)]


@pytest.mark.parametrize("clock_m", [None, 3.0])
def test_a_height_that_beacons_on_its_level_leave_open_asks_for_the_level(clock_m: float | None) -> None:
    place = (3.1, 2.2, 1.043)
    open_site = make_site(ON_A_LEVEL)
    found = fix(make_epoch(open_site, Drive(place), clock_m=clock_m, sd_m=0.07), open_site, "v")
    assert (found.status, found.remedy) == ("no-convergence", OPEN_HEIGHT)
    assert "z_m of its [[vehicle]]" in found.remedy
    # and that is what helps
    site = make_site(ON_A_LEVEL, level_m=place[2])
    check_ok(fix(make_epoch(site, Drive(place), clock_m=clock_m, sd_m=0.07), site, "v"), place)


def test_a_direction_on_the_level_that_is_open_asks_for_no_level() -> None:
    site = make_site([(1.0 + 2 * i, 3.0, 0.5 + 2 * (i % 2)) for i in range(6)])  # all on one wall
    found = fix(make_epoch(site, Drive((4.3, 3.0, 1.4)), sd_m=0.2), site, "v")
    assert (found.status, found.remedy) == ("no-convergence", OPEN_DIRECTION)
