"""Steps laid out as columns."""

import numpy as np

from sonofix.records import Estimate, RangeEpoch, Step
from sonofix.score import range_columns, track_columns


def step(index: int, estimates: tuple[Estimate, ...], rate: bool) -> Step:
    time = np.array([index + 0.1, index + 0.2])
    epoch = RangeEpoch(
        index, float(index), ("B1", "B2"), ("M", "M"), time, np.array([3.0, 4.0]), np.diag([1e-4, 4e-4]),
        np.array([0.1, -0.1]) if rate else None, None, None, "known", 343.0,
    )  # fmt: skip
    return Step(epoch, (), estimates, (), np.array([True, False]), np.array([0.0, np.nan]))


def estimate(time_s: float, vehicle: str) -> Estimate:
    covariance = np.arange(16.0).reshape(4, 4) + 100 * np.eye(4)
    place = np.array([time_s, 2.0, 0.0])
    return Estimate(time_s, vehicle, ("clock", "y", "x", "vx"), place, np.zeros(3), None, None, covariance, "fused")


def test_ranges_of_all_steps_in_order():
    columns = range_columns([step(0, (), True), step(1, (), False)])
    assert columns.emitter == ("B1", "B2", "B1", "B2")
    np.testing.assert_array_equal(columns.time_s, [0.1, 0.2, 1.1, 1.2])
    np.testing.assert_allclose(columns.sd_m, [0.01, 0.02, 0.01, 0.02])
    np.testing.assert_array_equal(columns.range_rate_mps, [0.1, -0.1, np.nan, np.nan])
    np.testing.assert_array_equal(columns.used, [True, False, True, False])
    assert range_columns([]).time_s.shape == (0,)


def test_tracks_by_vehicle_with_covariance_of_what_is_estimated():
    tracks = track_columns(
        [step(0, (estimate(2.0, "a"), estimate(0.5, "b")), True), step(1, (estimate(1.0, "a"),), True)]
    )
    assert list(tracks) == ["a", "b"]
    np.testing.assert_array_equal(tracks["a"].time_s, [1.0, 2.0])
    # x is row 2 and y row 1 of the estimate's covariance; z is not estimated
    np.testing.assert_array_equal(tracks["a"].covariance_m2[0, :2, :2], [[110.0, 9.0], [6.0, 105.0]])
    assert np.isnan(tracks["a"].covariance_m2[0, 2]).all()
    assert np.isnan(tracks["a"].yaw_rad).all()
