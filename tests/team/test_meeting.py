import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sonofix.team.meeting import Heard, Split, bends, judge, settle

STATES = 5
"""A pose and two errors of odometry that move it."""


def random_covariance(rng, n, scale=1.0):
    root = rng.normal(size=(n, n)) * scale
    return root @ root.T + 0.01 * scale**2 * np.eye(n)


class Fleet:
    """Robots of linear motion and measurements: what each believes, and the covariance that their errors truly have."""

    def __init__(self, rng, robots):
        self.rng, self.robots = rng, robots
        begun = [random_covariance(rng, STATES, 0.5) for _ in range(robots)]
        self.believed = [Split(whole, np.zeros_like(whole)) for whole in begun]
        self.true = np.zeros((robots * STATES, robots * STATES))
        for r, whole in enumerate(begun):
            self.true[self.at(r), self.at(r)] = whole

    def at(self, robot):
        return slice(STATES * robot, STATES * (robot + 1))

    def carry(self, robot, left, noise):
        """Let a robot's own error become ``left`` of itself and something new."""
        whole = np.eye(len(self.true))
        whole[self.at(robot), self.at(robot)] = left
        self.true = whole @ self.true @ whole.T
        self.true[self.at(robot), self.at(robot)] += noise
        was = self.believed[robot]
        self.believed[robot] = Split(left @ was.whole @ left.T + noise, left @ was.shared @ left.T)

    def drive(self, robot):
        left = np.eye(STATES)
        left[:3, 3:] = self.rng.normal(size=(3, STATES - 3))
        self.carry(robot, left, random_covariance(self.rng, STATES, 0.1))

    def hear_landmark(self, robot):
        row, variance = self.rng.normal(size=(1, STATES)), 0.05
        whole = self.believed[robot].whole
        gain = whole @ row.T / (row @ whole @ row.T + variance)
        self.carry(robot, np.eye(STATES) - gain @ row, variance * gain @ gain.T)

    def meet(self, one, other):
        rows = {r: self.rng.normal(size=(2, STATES)) for r in (one, other)}
        noise = self.rng.uniform(0.01, 0.1, 2)
        flat, nowhere = np.zeros((2, 2, 2)), Split(np.zeros((2, 2)), np.zeros((2, 2)))
        judged = {
            a: judge(
                self.believed[a], Heard(np.zeros(2), rows[a], self.believed[b].within(rows[b]), noise, flat, nowhere)
            )
            for a, b in ((one, other), (other, one))
        }
        change, of_noise = np.eye(len(self.true)), np.zeros((len(self.true), 2))
        after = {}
        for a, b in ((one, other), (other, one)):
            made, took = judged[a].corrected, judged[b].corrected is not None
            after[a] = settle(self.believed[a], made, took, rows[a])
            if made is None:
                continue
            whole = self.believed[a].whole
            # made.left is I − K H: the gain of rows that are of full rank
            gain = (np.eye(STATES) - made.left) @ np.linalg.pinv(rows[a])
            assert np.allclose(gain @ rows[a], np.eye(STATES) - made.left, atol=1e-8 * np.abs(whole).max())
            change[self.at(a), self.at(a)] = made.left
            change[self.at(a), self.at(b)] = -gain @ rows[b]
            of_noise[self.at(a)] = -gain
        self.true = change @ self.true @ change.T + of_noise @ np.diag(noise) @ of_noise.T
        for robot, split in after.items():
            self.believed[robot] = split

    def check(self):
        for r in range(self.robots):
            believed = self.believed[r]
            gap = believed.whole - self.true[self.at(r), self.at(r)]
            assert np.linalg.eigvalsh(gap).min() > -1e-9 * np.abs(believed.whole).max()
            assert np.linalg.eigvalsh(believed.whole - believed.shared).min() > -1e-9 * np.abs(believed.whole).max()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), robots=st.integers(2, 4))
def test_nobody_is_ever_surer_than_it_may_be(seed, robots):
    rng = np.random.default_rng(seed)
    fleet = Fleet(rng, robots)
    for _ in range(30):
        kind = rng.integers(4)
        robot = int(rng.integers(robots))
        if kind == 0:
            fleet.drive(robot)
        elif kind == 1:
            fleet.hear_landmark(robot)
        else:
            fleet.meet(robot, int((robot + rng.integers(1, robots)) % robots))
        fleet.check()


def test_what_was_told_is_no_more_a_robots_own_and_the_rest_is():
    rng = np.random.default_rng(1)
    whole = random_covariance(rng, STATES)
    rows = rng.normal(size=(2, STATES))
    told = Split(whole, np.zeros_like(whole)).told(rows)
    own = told.whole - told.shared
    np.testing.assert_allclose(rows @ own, 0.0, atol=1e-9)
    assert np.linalg.matrix_rank(own, tol=1e-9) == STATES - 2
    again = told.told(rows)
    np.testing.assert_allclose(again.shared, told.shared, atol=1e-9)


def test_bends_are_second_derivatives():
    x, y, step = 1.2, -0.7, 1e-4

    def shown(p):
        return np.array([np.hypot(*p), np.arctan2(p[1], p[0])])

    at, found = np.array([x, y]), np.zeros((2, 2, 2))
    for i, a in enumerate(step * np.eye(2)):
        for j, b in enumerate(step * np.eye(2)):
            found[:, i, j] = (
                (shown(at + a + b) - shown(at + a - b) - shown(at - a + b) + shown(at - a - b)) / 4 / step**2
            )
    np.testing.assert_allclose(bends(x, y), found, atol=1e-6)


def test_a_partner_too_near_for_its_doubt_corrects_less():
    error = Split(0.09 * np.eye(STATES), np.zeros((STATES, STATES)))
    place = Split(0.09 * np.eye(2), np.zeros((2, 2)))
    gained = []
    for far in (0.3, 3.0):
        rows = np.zeros((1, STATES))
        rows[0, 1], rows[0, 2] = 1.0 / far, -1.0
        partner = Split(np.array([[0.09 / far**2]]), np.zeros((1, 1)))
        heard = Heard(np.zeros(1), rows, partner, np.array([1e-4]), bends(far, 0.0)[1:], place)
        made = judge(error, heard)
        gained.append(made.taken[0])
    assert gained[0] > 100 * gained[1]
