"""Steps laid out for drawing."""

from dataclasses import replace

import numpy as np

from sonofix.draw.series import gather


def test_lanes_are_what_tells_rows_apart(driving, sounding, team):
    assert gather(driving.steps).lane_kind == "beacon"
    assert gather(driving.steps).lanes == ("B1", "B2", "B3", "B4", "B5", "B6")
    assert gather(sounding.steps).lane_kind == "microphone"
    assert gather(sounding.steps).lanes == ("M1", "M2", "M3", "M4", "M5")
    series = gather(team.steps)
    assert series.lane_kind == "pair"
    assert len(series.lanes) == 18


def test_lanes_sort_by_number(driving):
    step = driving.steps[0]
    names = ("B10", "B9", "B1", "tag", "A", "B2")[: len(step.ranges)]
    renamed = replace(step, ranges=replace(step.ranges, emitter=names))
    assert gather([renamed]).lanes == tuple(sorted(names, key=("A", "B1", "B2", "B9", "B10", "tag").index))


def test_rows_keep_their_residual_and_use(driving):
    series = gather(driving.steps)
    fixes = [fix for step in driving.steps for fix in step.fixes]
    np.testing.assert_array_equal(series.ranges.residual_m, np.concatenate([fix.residual_m for fix in fixes]))
    np.testing.assert_array_equal(series.ranges.used, np.concatenate([step.range_used for step in driving.steps]))


def test_each_vehicle_judges_its_own_rows(team):
    """A row's residual is that of the one fix that has it; no row of three vehicles is lost."""
    step = team.steps[3]
    series = gather([step])
    own = np.array([fix.residual_m for fix in step.fixes])
    assert (np.isfinite(own).sum(axis=0) == 1).all()
    np.testing.assert_array_equal(series.ranges.residual_m, np.nansum(own, axis=0))


def test_track_holds_pose_and_covariance_in_order_of_time(driving):
    backwards = driving.steps[::-1]
    track = gather(backwards).tracks["agv"]
    assert (np.diff(track.time_s) > 0).all()
    last = driving.steps[-1].estimates[0]
    np.testing.assert_array_equal(track.position_m[-1], last.position_m)
    np.testing.assert_array_equal(track.covariance_m2[-1], last.covariance)


def test_axes_that_are_not_estimated_have_no_covariance(sounding):
    track = gather(sounding.steps).tracks["car"]
    assert np.isfinite(track.covariance_m2[:, :2, :2]).all()
    assert np.isnan(track.covariance_m2[:, 2]).all()


def test_a_grid_of_predictions_is_no_blind_stretch(driving):
    predicted = [
        replace(step, estimates=tuple(replace(e, source="predicted") for e in step.estimates)) for step in driving.steps
    ]
    assert not gather(predicted).tracks["agv"].predicted.any()
    assert gather(predicted[:5] + driving.steps[5:]).tracks["agv"].predicted.sum() == 5
