import numpy as np
import pytest

from sonofix.team.smooth import smooth
from team.faults import followed, told, with_longer, with_start
from team.made_fleet import errors, fleet, nees, without_bearings


@pytest.mark.parametrize("started", [False, True])
@pytest.mark.parametrize("bearings", [False, True])
def test_a_landmark_whose_ranges_are_metres_too_long_is_left_out_once(started, bearings):
    recording, truth = fleet(seconds=30, seed=703)
    recording = with_longer(recording if bearings else without_bearings(recording), "L1", 2.0)
    if started:
        recording = with_start(recording, truth, {})
    moments, means, belief, feed = followed(recording)
    assert told(moments) == [("excluded", "")]
    found = next(e for m in moments for e in m.events if e.event == "excluded")
    assert found.detail.startswith("L1: ")
    assert not any(sign.isdigit() for sign in found.detail[3:])  # by how much is not known: it has bent all places
    assert found.time_s < 12.0
    assert nees(*errors(moments, truth, after_s=found.time_s)) < 4.0
    heard = [i for m in moments for i in range(*m.rows) if feed.ends[i][0] == "L1" and m.time_s > found.time_s]
    used = np.concatenate([m.used for m in moments])
    assert len(heard) > 20
    assert not used[heard].any()
    smoothed = smooth(feed, moments, belief, means)
    assert nees(*errors(smoothed, truth)) < 4.0
    assert np.sqrt(np.mean(np.sum(errors(smoothed, truth)[0] ** 2, axis=1))) < 0.12


@pytest.mark.parametrize("seed", [704, 705])
def test_landmarks_that_err_by_decimetres_are_all_heard(seed):
    recording, _ = fleet(seconds=20, seed=seed, staying_m=0.2)
    for heard in (recording, without_bearings(recording)):
        moments, *_ = followed(heard)
        assert told(moments) == []
