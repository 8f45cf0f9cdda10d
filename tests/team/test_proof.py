from dataclasses import replace

import numpy as np
import pytest

from sonofix.records import RangeRows, Table
from sonofix.team.feed import gather
from sonofix.team.proof import unlikely
from sonofix.team.smooth import smooth
from team.faults import followed, told, with_start
from team.made_fleet import LANDMARKS, errors, fleet, nees, without_bearings

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


def standing(push: tuple[float, float] | None, off: dict[int, tuple[float, float, float]], seconds: float):
    """Return three robots that stand, with starts, some ``off``, of which R1 is pushed at 15 s; and the truth."""
    rng, time = np.random.default_rng(5), np.arange(0.0, seconds, 0.1)
    made, _ = fleet(seconds=2, seed=1)
    truth = {}
    for robot, pose in enumerate([(2.0, 2.0, 0.3), (3.5, 3.0, 1.0), (5.0, 2.0, -2.0)]):
        rows = np.column_stack([time, np.tile(pose, (len(time), 1))])
        if push is not None and robot == 1:
            rows[time >= 15.0, 1:3] += push
        truth[f"R{robot}"] = rows
    ends = {f"L{i}": np.tile(place, (len(time), 1)) for i, place in enumerate(LANDMARKS)}
    ends |= {name: rows[:, 1:3] for name, rows in truth.items()}
    heard = [
        (time[k], source, to, np.hypot(*(truth[to][k, 1:3] - ends[source][k])) + rng.normal(0, 0.05))
        for k in range(0, len(time), 4)
        for to in truth
        for source in ends
        if source != to
    ]
    time_s, emitter, receiver, range_m = zip(*heard, strict=True)
    still = np.zeros(3 * len(time))
    columns = {"time_s": np.tile(time, 3), "v_mps": still, "yaw_rate_radps": still}
    odometry = Table(columns, {"vehicle": tuple(np.repeat(list(truth), len(time)).tolist())})
    ranges = RangeRows(np.array(time_s), emitter, receiver, np.array(range_m), None)
    return with_start(replace(made, ranges=ranges, tables={"odometry": odometry}), truth, off), truth


@pytest.mark.parametrize("push", [(1.2, -0.3), (0.2, 1.3)])
def test_a_push_of_a_robot_whose_start_was_borne_out_is_found_at_once(push):
    recording, truth = standing(push, {}, 22.0)
    moments, *_ = followed(recording)
    assert told(moments) == [("slip", "R1")]
    assert np.max(np.hypot(*errors(moments, truth, after_s=16.5)[0].T)) < 0.1
    assert nees(*errors(moments, truth)) < 4.0


@pytest.mark.parametrize("off", [{0: (-1.2, 0.7, 0.0)}, {robot: (1.5, -0.4 * robot, 0.0) for robot in range(3)}])
def test_starts_that_disagree_are_not_taken_as_stated_where_nothing_else_can_tell(off):
    recording, truth = standing(None, off, 36.0)
    moments, *_ = followed(recording)
    assert told(moments) == []
    assert nees(*errors(moments, truth)) < 4.0


def test_a_robot_that_left_unheard_keeps_no_push_of_others_from_being_found():
    recording, truth = fleet(seconds=18, seed=53, silent={2: (0.0, 40.0)}, pushed=((0, 15.0, 3.0, 1.0),))
    moments, *_ = followed(with_start(without_bearings(recording), truth, {}))
    assert told(moments) == [("left", "R2"), ("slip", "R0")]


def test_a_team_that_fits_what_it_hears_is_not_given_up_for_another():
    # the other filter, which hears landmarks through one robot alone, joins others at a wrong place
    recording, truth = fleet(seconds=30, seed=21, hears=(0,))
    moments, *_ = followed(with_start(without_bearings(recording), truth, {}))
    assert told(moments) == []
    assert nees(*errors(moments, truth)) < 4.0


def test_robots_off_alike_are_told_as_unsure_from_the_first_row_on():
    recording, truth = fleet(seconds=12, seed=41)
    moments, *_ = followed(with_start(without_bearings(recording), truth, dict.fromkeys(range(3), (1.0, 0.5, 0.0))))
    assert sorted(told(moments)) == [("reset", f"R{robot}") for robot in range(3)]
    assert nees(*errors(moments, truth)) < 4.0


def test_who_has_no_place_in_the_filter_that_takes_over_is_told_lost():
    recording, truth = fleet(seconds=30, seed=42, silent={2: (0.0, 20.0)})
    moments, *_ = followed(with_start(without_bearings(recording), truth, {1: (2.0, 0.0, 0.0)}))
    assert told(moments) == [("reset", "R1"), ("lost", "R2")]
    assert [e.vehicle for m in moments for e in m.events if e.event == "joined"] == ["R2"]
