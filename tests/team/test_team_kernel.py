from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonofix.team.kernel import STRAYS, drive, expect
from sonofix.team.state import DRIFT, LAG, POSE, SIZE, SPEED, SPEED_SLIP, TURN, TURN_SLIP

TIME = np.array([0.0, 0.4, 0.9, 1.3, 2.0])
TOLD = np.array([[0.5, 0.2, 0.0], [0.3, -0.8, 0.0], [0.0, 0.0, 0.0], [0.6, 1.0, 0.0], [0.4, 0.1, 0.0]])

states = st.tuples(
    *(st.floats(-3, 3) for _ in range(3)),
    *(st.floats(-0.2, 0.2) for _ in range(2)),
    st.floats(-0.05, 0.05),
    st.floats(0.0, 0.15),
    *(st.floats(-0.1, 0.1) for _ in range(5)),
).map(np.array)


def driven(own, from_s, until_s):
    pose, by, stray = np.empty(POSE), np.empty((POSE, SIZE)), np.empty(STRAYS)
    drive(own, TIME, TOLD, from_s, until_s, np.ones(4), pose, by, stray)
    return pose, by, stray


def plain(own, from_s, until_s, steps=20000):
    """Small straight steps along what is told."""
    x, y, yaw = own[:3]
    times = np.linspace(from_s - own[LAG], until_s - own[LAG], steps + 1)
    dt = times[1] - times[0]
    for t in (times[:-1] + times[1:]) / 2:
        i = np.searchsorted(TIME, t, side="right") - 1
        v, w = (0.0, 0.0) if i < 0 else TOLD[i, :2]
        rate = 0.0 if i < 0 else (1 - own[TURN] - own[TURN_SLIP]) * w - own[DRIFT]
        yaw += rate * dt / 2
        speed = (1 - own[SPEED] - own[SPEED_SLIP]) * v
        x, y = x + speed * np.cos(yaw) * dt, y + speed * np.sin(yaw) * dt
        yaw += rate * dt / 2
    return np.array([x, y, yaw])


def test_driving_is_what_small_steps_make():
    own = np.array([1.0, -2.0, 0.7, 0.1, -0.05, 0.02, 0.13, 0.0, 0.0, 0.0, 0.04, -0.03])
    # rows that begin within a small step leave that much
    np.testing.assert_allclose(driven(own, 0.05, 2.6)[0], plain(own, 0.05, 2.6), atol=3e-4)


@settings(max_examples=40, deadline=None)
@given(states)
def test_derivatives_of_driving_are_finite_differences(own):
    _, by, _ = driven(own, 0.31, 1.71)
    for j in range(SIZE):
        # lag moves both ends within their rows only
        h = 1e-6
        up, down = own.copy(), own.copy()
        up[j] += h
        down[j] -= h
        told = (driven(up, 0.31, 1.71)[0] - driven(down, 0.31, 1.71)[0]) / (2 * h)
        edges = np.abs(np.subtract.outer([0.31 - own[LAG], 1.71 - own[LAG]], TIME)).min()
        if j != LAG or edges > 1e-4:
            # an error of the yaw rate turns each piece at its middle, exact to its square
            np.testing.assert_allclose(by[:, j], told, atol=2e-2 if j in (TURN, DRIFT, TURN_SLIP) else 1e-5)


@settings(max_examples=40, deadline=None)
@given(states, states, st.sampled_from([(0, 1), (0, -1), (-1, 1)]), st.booleans(), st.sampled_from([0.0, 1.0]))
def test_derivatives_of_what_is_heard_are_finite_differences(first, second, ends, common, told_mps):
    about = np.concatenate([first, second + np.array([5, 5] + [0] * (SIZE - 2))])
    arms = np.array([0.2, 0.1, 0.3]), np.array([-0.1, 0.3, 1.0])
    rows, scratch = np.empty((2, 2 * SIZE)), np.empty((2, 2 * SIZE))

    def shown(state, into):
        # a source that drives was elsewhere when it sent
        rest = 1 - state.reshape(2, SIZE)[:, SPEED] - state.reshape(2, SIZE)[:, SPEED_SLIP]
        return expect(state, *ends, *arms, 1 / 343, told_mps * rest, common, into)

    shown(about, rows)
    for j in range(2 * SIZE):
        h = 1e-6
        told = [shown(about + sign * h * np.eye(2 * SIZE)[j], scratch) for sign in (1, -1)]
        difference = (np.array(told[0][:2]) - told[1][:2]) / (2 * h)
        if abs(difference[1]) > 1e3:  # the direction jumps by a turn here
            continue
        assert rows[0, j] == pytest.approx(difference[0], abs=5e-3)
        if ends[0] >= 0:
            assert rows[1, j] == pytest.approx(difference[1], abs=5e-3)


def test_silent_odometry_leaves_much_open():
    own = np.zeros(SIZE)
    told, silent = driven(own, 0.0, 1.0)[2], driven(own, 5.0, 6.0)[2]
    assert silent[0] > 10 * told[0]
    np.testing.assert_array_equal(driven(own, 5.0, 6.0)[0], own[:3])


def test_a_turn_unseen_opens_the_heading_once():
    own = np.zeros(SIZE)
    told = TOLD.copy()
    told[3, 2] = 0.04
    pose, by = np.empty(POSE), np.empty((POSE, SIZE))

    def heading(rows, from_s, until_s):
        stray = np.empty(STRAYS)
        drive(own, TIME, rows, from_s, until_s, np.ones(4), pose, by, stray)
        return stray[1]

    more = [heading(told, a, b) - heading(TOLD, a, b) for a, b in ((0.0, 1.2), (1.2, 1.3), (1.3, 1.7))]
    # it happens where that row begins, in whichever piece that is
    np.testing.assert_allclose(sum(more), 0.04, atol=1e-12)
    assert max(more) == pytest.approx(0.04)


@pytest.mark.parametrize("edges", [(0.2, 0.4, 0.9, 1.1), (0.2, 0.3, 1.0, 1.1), (0.2, 0.6, 0.6, 1.1)])
def test_drives_in_a_row_know_of_the_lag_what_one_does(edges):
    own = np.array([0.0, 0.0, 0.3, *np.zeros(SIZE - 3)])
    whole = driven(own, edges[0], edges[-1])[1][:, LAG]
    chained = np.zeros(POSE)
    # wherever they are cut: at 0.4 and 0.9 rows begin, and what is told changes just where one drive ends
    for from_s, until_s in pairwise(edges):
        own[:POSE], by, _ = driven(own, from_s, until_s)
        chained = by[:, :POSE] @ chained + by[:, LAG]
    np.testing.assert_allclose(chained, whole, atol=1e-12)
