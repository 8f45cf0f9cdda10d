"""Track figures against numbers worked out by hand, and NEES against its distribution."""

from dataclasses import replace

import numpy as np
import pytest

from sonofix.records import Truth
from sonofix.score import TrackColumns, score_track

SPAN = np.linspace(0.0, 10.0, 1001)


def circle(time: np.ndarray) -> np.ndarray:
    return np.column_stack([3 * np.cos(time / 2), 3 * np.sin(time / 2), np.full(np.shape(time), 0.4)])


TRUTH = Truth("agv", SPAN, circle(SPAN), SPAN / 2 + np.pi / 2)


def exact(time: np.ndarray, sd_m: float = 0.01) -> TrackColumns:
    """The truth's own rows."""
    velocity = np.column_stack([-1.5 * np.sin(time / 2), 1.5 * np.cos(time / 2), 0 * time])
    covariance = np.tile(np.eye(3) * sd_m**2, (len(time), 1, 1))
    return TrackColumns(time, circle(time), velocity, time / 2 + np.pi / 2, covariance)


def test_a_perfect_track_has_no_error():
    found = score_track(TRUTH, exact(SPAN[::50]))
    assert found is not None
    assert found.rows == 21
    assert found.rmse_xy_m == found.max_xy_m == 0.0
    assert found.rmse_yaw_rad == pytest.approx(0.0, abs=1e-12)
    assert found.inside_2sd == 1.0
    assert found.nees_xy == 0.0
    assert found.longest_gap_s == pytest.approx(0.5)
    # of a chord against the tangent at the truth's two ends, where the difference is one-sided
    assert found.velocity_rms_mps is not None
    assert found.velocity_rms_mps < 0.4


def test_known_errors_come_back():
    track = exact(SPAN[100:900:50])
    shifted = replace(track, position_m=track.position_m + [0.03, -0.04, 0.02], velocity_mps=track.velocity_mps + 0.1)
    found = score_track(TRUTH, shifted)
    assert found is not None
    assert found.rmse_xy_m == pytest.approx(0.05)
    assert found.median_xy_m == pytest.approx(0.05)
    assert found.p95_xy_m == pytest.approx(0.05)
    assert found.rmse_z_m == pytest.approx(0.02)
    assert found.velocity_rms_mps == pytest.approx(0.1 * np.sqrt(2), rel=1e-3)
    assert found.inside_2sd == 0.0
    assert found.nees_xy == pytest.approx(25.0)


def test_heading_is_compared_round_the_circle():
    track = exact(SPAN[::50])
    found = score_track(TRUTH, replace(track, yaw_rad=track.yaw_rad + 4 * np.pi + 0.01))
    assert found is not None
    assert found.rmse_yaw_rad == pytest.approx(0.01)
    unknown = score_track(replace(TRUTH, yaw_rad=None), track)
    assert unknown is not None
    assert unknown.rmse_yaw_rad is None


def test_gap_counts_from_the_ends_of_the_truth_and_rows_outside_are_left_out():
    late = exact(np.array([-3.0, 4.0, 5.0, 6.0, 14.0]))
    found = score_track(TRUTH, late)
    assert found is not None
    assert found.rows == 3
    assert found.longest_gap_s == pytest.approx(4.0)
    assert score_track(TRUTH, exact(np.array([12.0, 13.0]))) is None


def test_a_truth_of_one_row_holds_for_ever():
    one = Truth("agv", np.zeros(1), np.array([[1.0, 2.0, 0.0]]), None)
    place = np.array([[1.0, 2.0, 0.0], [1.0, 2.1, 0.0]])
    none = np.full((2, 3), np.nan)
    found = score_track(one, TrackColumns(np.array([5.0, 500.0]), place, none, none[:, 0], np.full((2, 3, 3), np.nan)))
    assert found is not None
    assert found.rows == 2
    assert found.max_xy_m == pytest.approx(0.1)
    assert (found.velocity_rms_mps, found.inside_2sd, found.nees_xy, found.longest_gap_s) == (None, None, None, 0.0)


def test_nees_and_shares_have_their_expectations(rng):
    """Of 4000 draws the mean of a chi-square with 2 degrees is 2 with sd 2/sqrt(4000); the share is binomial."""
    count, time = 4000, np.linspace(1.0, 9.0, 4000)
    covariance = np.diag([4e-4, 1e-4, 9e-4])
    covariance[0, 1] = covariance[1, 0] = 1.2e-4
    noise = rng.multivariate_normal(np.zeros(3), covariance, size=count)
    # the truth is piecewise linear: err about it, not about the circle
    base = np.column_stack([np.interp(time, SPAN, TRUTH.position_m[:, k]) for k in range(3)])
    track = replace(
        exact(time), position_m=base + noise, covariance_m2=np.broadcast_to(covariance, (count, 3, 3)).copy()
    )
    found = score_track(TRUTH, track)
    assert found is not None
    assert found.nees_xy == pytest.approx(2.0, abs=5 * 2 / np.sqrt(count))
    independent = replace(track, covariance_m2=np.tile(np.diag(np.diag(covariance)), (count, 1, 1)))
    diagonal = score_track(TRUTH, independent)
    assert diagonal is not None
    # correlation changes the spread of the sum but not its mean
    assert diagonal.nees_xy == pytest.approx(2.0, abs=5 * 2.5 / np.sqrt(count))
    assert found.inside_2sd == pytest.approx(0.92, abs=0.03)
