from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonofix.plan.coverage import Coverage, coverage
from sonofix.site import Site

SQUARE = [(-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0)]


def listening_site(
    beacons: list[tuple[float, float]] | np.ndarray,
    height_m: float = 0.0,
    synchronised: bool = True,
    bounds_m: tuple | None = ((-4.0, -4.0, 0.0), (4.0, 4.0, 3.0)),
) -> Site:
    return Site.model_validate(
        {
            "name": "hall",
            "bounds_m": bounds_m,
            "schedule": {"period_s": 0.5, "synchronised": synchronised},
            "vehicle": [{"id": "agv"}],
            "microphone": [{"id": "M1", "vehicle": "agv"}],
            "beacon": [
                {"id": f"B{i}", "position_m": (float(x), float(y), height_m)} for i, (x, y) in enumerate(beacons)
            ],
        }
    )


def at(result: Coverage, x: float, y: float) -> float:
    i, j = np.argmin(abs(result.x_m - x)), np.argmin(abs(result.y_m - y))
    assert result.x_m[i] == pytest.approx(x)
    assert result.y_m[j] == pytest.approx(y)
    return float(result.hdop[j, i])


@pytest.mark.parametrize("synchronised", [True, False])
def test_centre_of_a_square_has_hdop_one(synchronised: bool) -> None:
    # Directions (±1, ±1)/√2: the normal matrix is 2 I, HDOP = √(1/2 + 1/2); their mean is 0: the clock costs nothing.
    result = coverage(listening_site(SQUARE, synchronised=synchronised), level_m=0.0)
    assert at(result, 0.0, 0.0) == pytest.approx(1.0, abs=1e-12)


def test_beacons_overhead_dilute_by_slant_over_horizontal() -> None:
    # At the centre the horizontal parts of the unit vectors shrink by √18/√(18 + 2.5²), so HDOP grows by the inverse.
    result = coverage(listening_site(SQUARE, height_m=3.0), level_m=0.5)
    assert at(result, 0.0, 0.0) == pytest.approx(math.sqrt((18.0 + 2.5**2) / 18.0), abs=1e-12)


def test_unknown_clock_enlarges_a_lopsided_layout() -> None:
    # West, east, north: Σuuᵀ = diag(2, 1), HDOP² = 1/2 + 1. Less the mean (0, −1/3): diag(2, 2/3), HDOP² = 1/2 + 3/2.
    layout = [(-3.0, 0.0), (3.0, 0.0), (0.0, 3.0)]
    assert at(coverage(listening_site(layout), 0.0), 0.0, 0.0) == pytest.approx(math.sqrt(1.5), abs=1e-12)
    unknown = coverage(listening_site(layout, synchronised=False), 0.0)
    assert at(unknown, 0.0, 0.0) == pytest.approx(math.sqrt(2.0), abs=1e-12)


def test_two_beacons_fix_with_a_known_clock_and_not_without() -> None:
    layout = [(3.0, 0.0), (0.0, 3.0)]
    assert at(coverage(listening_site(layout), 0.0), 0.0, 0.0) == pytest.approx(math.sqrt(2.0), abs=1e-12)
    unknown = coverage(listening_site(layout, synchronised=False), 0.0)
    assert np.isnan(unknown.hdop).all()
    assert unknown.share_covered == 0.0
    assert (unknown.count == 2).all()


def test_one_beacon_never_fixes() -> None:
    result = coverage(listening_site([(0.0, 0.0)]), 0.0)
    assert np.isnan(result.hdop).all()
    assert result.share_covered == 0.0


def test_on_the_line_of_all_beacons_there_is_no_fix() -> None:
    result = coverage(listening_site([(-3.0, 0.0), (0.0, 0.0), (3.0, 0.0)]), 0.0)
    assert np.isnan(at(result, 1.0, 0.0))
    assert np.isfinite(at(result, 1.0, 1.0))
    np.testing.assert_array_equal(np.isnan(result.hdop).any(axis=1), result.y_m == 0.0)
    assert result.share_covered == pytest.approx(16 / 17)


def test_reach_is_a_slant_range() -> None:
    result = coverage(listening_site([(0.0, 0.0)], height_m=3.0), level_m=0.0, reach_m=5.0)
    x, y = np.meshgrid(result.x_m, result.y_m)
    np.testing.assert_array_equal(result.count, (np.hypot(x, y) <= 4.0).astype(int))


def test_beacons_out_of_reach_take_no_part() -> None:
    near = coverage(listening_site(SQUARE[:2]), 0.0)
    both = coverage(listening_site([*SQUARE[:2], (500.0, 0.0), (0.0, 700.0)]), 0.0, reach_m=100.0)
    np.testing.assert_array_equal(near.hdop, both.hdop)


def test_point_at_a_beacon_takes_the_others_directions() -> None:
    # At (3, 3) two beacons lie along the axes and one on the diagonal: Σuuᵀ = [[1.5, 0.5], [0.5, 1.5]], HDOP² = 3/2.
    result = coverage(listening_site(SQUARE), 0.0)
    assert at(result, 3.0, 3.0) == pytest.approx(math.sqrt(1.5), abs=1e-12)
    assert result.count.min() == 4


def test_fixed_microphones_serve_where_the_vehicle_sounds() -> None:
    sounding = Site.model_validate(
        {
            "bounds_m": ((-4.0, -4.0, 0.0), (4.0, 4.0, 3.0)),
            "schedule": {"period_s": 0.5},
            "vehicle": [{"id": "car"}],
            "beacon": [{"id": "B", "vehicle": "car"}],
            "microphone": [{"id": f"M{i}", "position_m": (x, y, 0.0)} for i, (x, y) in enumerate(SQUARE)],
        }
    )
    np.testing.assert_array_equal(coverage(sounding, 0.5).hdop, coverage(listening_site(SQUARE), 0.5).hdop)


def test_beacons_without_a_code_take_no_part_where_others_have_one() -> None:
    site = Site.model_validate(
        {
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10.0},
            "schedule": {"period_s": 0.5},
            "beacon": [
                {"id": "B1", "position_m": (0.0, 0.0, 3.0), "code": {"family": "gold", "degree": 7, "index": 0}},
                {"id": "B2", "position_m": (4.0, 0.0, 3.0), "code": {"family": "gold", "degree": 7, "index": 1}},
                {"id": "B3", "position_m": (4.0, 9.0, 3.0)},
            ],
        }
    )
    assert coverage(site, 0.0).count.max() == 2


def test_grid_spans_the_bounds_or_else_the_box_of_the_beacons() -> None:
    inside = coverage(listening_site(SQUARE), 0.0, spacing_m=1.0)
    assert (inside.x_m[0], inside.x_m[-1], inside.x_m.size) == (-4.0, 4.0, 9)
    box = coverage(listening_site(SQUARE, bounds_m=None), 0.0, spacing_m=0.1)
    assert (box.y_m[0], box.y_m[-1], box.y_m.size) == pytest.approx((-3.0, 3.0, 61))
    assert box.hdop.shape == box.count.shape == (box.y_m.size, box.x_m.size)


def test_margin_shrinks_and_negative_margin_widens() -> None:
    site = listening_site(SQUARE, bounds_m=None)
    assert coverage(site, 0.0, margin_m=1.0).x_m[[0, -1]].tolist() == [-2.0, 2.0]
    assert coverage(site, 0.0, margin_m=-1.0).x_m[[0, -1]].tolist() == [-4.0, 4.0]


def test_a_grid_that_does_not_divide_the_area_is_centred() -> None:
    result = coverage(listening_site(SQUARE), 0.0, spacing_m=3.0)
    assert result.x_m.tolist() == [-3.0, 0.0, 3.0]


def test_site_without_a_schedule_has_a_known_clock() -> None:
    site = listening_site(SQUARE)
    free = site.model_copy(update={"schedule": None})
    np.testing.assert_array_equal(coverage(free, 0.0).hdop, coverage(site, 0.0).hdop)


@given(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=3, max_size=9, unique=True),
    st.floats(0.5, 6.0),
    st.booleans(),
)
def test_equals_the_inverse_of_the_full_normal_matrix(
    beacons: list[tuple[float, float]], height_m: float, synchronised: bool
) -> None:
    site = listening_site(beacons, height_m, synchronised)
    result = coverage(site, 0.0, spacing_m=4.0)
    nodes = np.array([(x, y, height_m) for x, y in beacons])
    for j, y in enumerate(result.y_m):
        for i, x in enumerate(result.x_m):
            difference = np.array([x, y, 0.0]) - nodes
            rows = difference[:, :2] / np.linalg.norm(difference, axis=1)[:, None]
            rows = rows if synchronised else np.column_stack([rows, np.ones(len(rows))])
            if np.linalg.cond(rows) < 1e4:
                inverse = np.linalg.inv(rows.T @ rows)
                assert result.hdop[j, i] == pytest.approx(math.sqrt(inverse[0, 0] + inverse[1, 1]), rel=1e-5)
            elif np.linalg.cond(rows) > 1e9:
                assert np.isnan(result.hdop[j, i])


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=1, max_size=6))
def test_an_unknown_clock_never_helps(beacons: list[tuple[float, float]]) -> None:
    known = coverage(listening_site(beacons, 3.0, synchronised=True), 0.0, spacing_m=2.0)
    unknown = coverage(listening_site(beacons, 3.0, synchronised=False), 0.0, spacing_m=2.0)
    fix = np.isfinite(unknown.hdop)
    assert np.isfinite(known.hdop[fix]).all()
    assert (unknown.hdop[fix] >= known.hdop[fix] * (1 - 1e-9)).all()


def test_site_with_nothing_fixed_is_refused() -> None:
    team = Site.model_validate(
        {
            "schedule": {"period_s": 0.5},
            "vehicle": [{"id": "K"}],
            "beacon": [{"id": "B", "vehicle": "K"}],
            "microphone": [{"id": "M", "vehicle": "K"}],
        }
    )
    with pytest.raises(ValueError, match=r"no fixed node.*position_m"):
        coverage(team, 0.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"level_m": math.nan}, r"level_m = nan.*finite"),
        ({"level_m": 0.0, "spacing_m": 0.0}, r"spacing_m = 0.*above 0"),
        ({"level_m": 0.0, "spacing_m": math.nan}, r"spacing_m = nan"),
        ({"level_m": 0.0, "reach_m": -1.0}, r"reach_m = -1.*above 0"),
        ({"level_m": 0.0, "margin_m": math.inf}, r"margin_m = inf.*finite"),
        ({"level_m": 0.0, "margin_m": 5.0}, r"margin_m = 5 leaves nothing of 8 m by 8 m"),
        ({"level_m": 0.0, "spacing_m": 0.001}, r"spacing_m = 0.001 makes 6.4e\+07 points.*at least 0.004 m"),
    ],
)
def test_arguments_out_of_range_are_named(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        coverage(listening_site(SQUARE), **arguments)
