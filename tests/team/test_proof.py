import numpy as np
import pytest

from sonofix.team.feed import gather
from sonofix.team.proof import unlikely
from sonofix.team.smooth import smooth
from team.faults import followed, told, with_start
from team.made_fleet import errors, fleet, nees, without_bearings

ALL_WRONG = {0: (3.0, 0.0, 0.0), 1: (0.0, 2.0, 3.0), 2: (-1.0, -2.0, 0.0)}


@pytest.mark.parametrize("seed", [701, 702])
@pytest.mark.parametrize("off", [{1: (2.0, 0.0, 0.0)}, {1: (0.0, 0.0, np.pi)}, ALL_WRONG])
def test_starts_that_are_wrong_are_gainsaid_and_never_told_as_sure(seed, off):
    recording, truth = fleet(seconds=30, seed=seed)
    moments, means, belief, feed = followed(with_start(without_bearings(recording), truth, off))
    assert sorted(told(moments)) == [("reset", f"R{robot}") for robot in off]
    # 2 where deviations are right; all of it is of a few seconds that err alike
    assert nees(*errors(moments, truth)) < 4.0
    assert np.sqrt(np.mean(np.sum(errors(moments, truth, after_s=15)[0] ** 2, axis=1))) < 0.12
    smoothed = smooth(feed, moments, belief, means)
    assert nees(*errors(smoothed, truth)) < 4.0
    assert np.sqrt(np.mean(np.sum(errors(smoothed, truth)[0] ** 2, axis=1))) < 0.12


@pytest.mark.parametrize("seed", range(804, 810))
def test_starts_that_are_right_stand(seed):
    recording, truth = fleet(seconds=20, seed=seed)
    for heard in (recording, without_bearings(recording)):
        moments, *_ = followed(with_start(heard, truth, {}))
        assert told(moments) == []
        assert nees(*errors(moments, truth)) < 4.0
        # from the first row on, and no surer than that
        assert all(moment.placed.all() for moment in moments)


def test_where_no_landmark_is_heard_starts_are_all_there_is():
    recording, truth = fleet(seconds=15, seed=5, hears=())
    moments, *_ = followed(with_start(recording, truth, {}))
    assert told(moments) == []
    assert nees(*errors(moments, truth)) < 6.0


def test_a_way_whose_turns_are_known_to_a_tenth_ends_on_a_bow():
    recording, truth = fleet(seconds=20, seed=3)
    feed = gather(with_start(recording, truth, {}))
    known = np.diag(np.square([0.1, 0.1, 0.2]))
    for robot, rows in enumerate(truth.values()):
        for k in (30, 90, 180):
            right = unlikely(feed, robot, 0.0, rows[k, 0], rows[k, 1:], known)
            wrong = unlikely(feed, robot, 0.0, rows[k, 0], rows[k, 1:] + [2.5, 0.0, 0.0], known)
            assert right < 12.0 < wrong
