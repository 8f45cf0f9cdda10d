import numpy as np
import pytest

from sonofix.team.smooth import smooth
from team.faults import followed, told, with_compass, with_start
from team.made_fleet import errors, fleet, nees, without_bearings


@pytest.mark.parametrize("started", [False, True])
@pytest.mark.parametrize("from_north", [("R1",), ("R0", "R1", "R2")])
def test_compasses_that_count_from_north_are_left_out(started, from_north):
    recording, truth = fleet(seconds=30, seed=701)
    recording = with_compass(without_bearings(recording), truth, from_north)
    if started:
        recording = with_start(recording, truth, {})
    moments, means, belief, feed = followed(recording)
    assert sorted(told(moments)) == [("excluded", name) for name in from_north]
    assert all("its compass" in e.detail for m in moments for e in m.events if e.event == "excluded")
    assert nees(*errors(moments, truth)) < 4.0
    assert np.sqrt(np.mean(np.sum(errors(moments, truth, after_s=15)[0] ** 2, axis=1))) < 0.12
    assert nees(*errors(smooth(feed, moments, belief, means), truth)) < 4.0


def test_compasses_that_are_right_are_heard():
    spread = []
    for heard in (True, False):
        recording, truth = fleet(seconds=30, seed=702)
        recording = without_bearings(recording)
        moments, *_ = followed(with_compass(recording, truth, ()) if heard else recording)
        assert told(moments) == []
        assert nees(*errors(moments, truth)) < 4.0
        spread.append(np.mean([moment.covariance[:, 2, 2] for moment in moments[-10:]]))
    assert spread[0] < 0.5 * spread[1]
