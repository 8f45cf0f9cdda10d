"""Knots tied to each other: a chain smoothed backwards is the least-squares solution of all at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from locate.made_epochs import HALL, make_site
from sonofix.geometry import POSE
from sonofix.records import Floats
from sonofix.track.anchor import correct
from sonofix.track.belief import Belief, Motion, blank, predict, reopen, start_at
from sonofix.track.chain import Chain, copied, parted, tie

SITE = make_site(HALL, level_m=1.1)
MOTION = Motion(acceleration_psd=0.3)
OWN = [POSE.index(name) for name in ("x", "y", "vx", "vy")]
"""Where x, y and their velocities stand."""

NOISE_M = 0.1


def begun() -> Belief:
    return start_at(blank(SITE), 0, np.array([1.0, 2.0, 1.1]), 0.0, True, False)


def measured(belief: Belief, place: Floats) -> Belief:
    mean, covariance = belief.mean.copy(), belief.covariance.copy()
    derivative = np.zeros((2, len(mean)))
    derivative[0, 0] = derivative[1, 1] = 1.0
    correct(mean, covariance, place - mean[:2], derivative, NOISE_M**2 * np.eye(2), np.inf)
    return replace(belief, mean=mean, covariance=covariance)


def all_at_once(
    first: Floats, first_covariance: Floats, times: Floats, places: dict[int, Floats], kicks: dict[int, Floats]
) -> tuple[Floats, Floats]:
    """States (n, 4) and their covariance (4 n, 4 n) by the normal equations of all knots together."""
    n = len(times)
    normal, right = np.zeros((4 * n, 4 * n)), np.zeros(4 * n)

    def add(rows: Floats, value: Floats, covariance: Floats) -> None:
        weight = np.linalg.inv(covariance)
        normal[:] += rows.T @ weight @ rows
        right[:] += rows.T @ weight @ value

    def at(k: int) -> Floats:
        return np.eye(4 * n)[4 * k : 4 * k + 4]

    add(at(0), first, first_covariance)
    for k in range(1, n):
        dt = times[k] - times[k - 1]
        step, one = np.eye(4), np.eye(2)
        step[:2, 2:] = dt * one
        noise = MOTION.acceleration_psd * np.block([[dt**3 / 3 * one, dt**2 / 2 * one], [dt**2 / 2 * one, dt * one]])
        add(at(k) - step @ at(k - 1), np.zeros(4), noise + kicks.get(k, np.zeros((4, 4))))
    for k, place in places.items():
        add(at(k)[:2], place, NOISE_M**2 * np.eye(2))
    covariance = np.linalg.inv(normal)
    return (covariance @ right).reshape(n, 4), covariance


def test_a_chain_is_the_least_squares_solution_of_all_at_once(rng: np.random.Generator) -> None:
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.05, 1.0, 25))])
    places = {k: np.array([1.0 + times[k], 2.0]) + rng.standard_normal(2) for k in range(1, 26) if k % 3}
    kicks = {13: np.diag([4.0, 4.0, 1.0, 1.0])}
    belief, chain = begun(), Chain()
    first, first_covariance = belief.mean[OWN], belief.covariance[np.ix_(OWN, OWN)]
    belief = chain.knot(belief)
    for k in range(1, 26):
        belief = predict(belief, float(times[k]), MOTION)
        if k == 13:  # a push: noise like any other
            belief = reopen(belief, 0, 2.0)
        if k in places:
            belief = measured(belief, places[k])
        belief = chain.knot(belief)
    mean, covariance = all_at_once(first, first_covariance, times, places, kicks)
    smoothed = list(chain.back())[::-1]
    assert len(smoothed) == 26
    for k, one in enumerate(smoothed):
        np.testing.assert_allclose(one.mean[OWN], mean[k], rtol=0, atol=1e-9)
        own = slice(4 * k, 4 * k + 4)
        np.testing.assert_allclose(one.covariance[np.ix_(OWN, OWN)], covariance[own, own], rtol=0, atol=1e-9)
        assert one.time_s == times[k]
        assert len(one.mean) == len(POSE) + 2


def test_a_copy_changes_nothing_of_what_is_believed(rng: np.random.Generator) -> None:
    plain, chain = begun(), Chain()
    carried = chain.knot(plain)
    for k in range(1, 6):
        place = np.array([1.0 + k, 2.0]) + rng.standard_normal(2)
        plain, carried = (measured(predict(b, float(k), MOTION), place) for b in (plain, carried))
        if k == 3:
            carried = chain.knot(carried)
    kept, *_ = parted(carried, 4)
    np.testing.assert_allclose(kept.mean, plain.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(kept.covariance, plain.covariance, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(kept.free, plain.free)


def test_parted_is_what_was_copied() -> None:
    belief = begun()
    kept, mean, covariance, crossed = parted(copied(belief), 4)
    np.testing.assert_array_equal(kept.covariance, belief.covariance)
    np.testing.assert_array_equal(mean, belief.mean[OWN])
    np.testing.assert_array_equal(covariance, belief.covariance[np.ix_(OWN, OWN)])
    np.testing.assert_array_equal(crossed, belief.covariance[OWN])


@pytest.mark.parametrize("twice", [False, True])
def test_a_tie_is_the_conditional_of_a_joint_gaussian(twice: bool, rng: np.random.Generator) -> None:
    # later states may be copies of each other, as an anchor is of a pose: then one of them says it all
    half = rng.standard_normal((5, 5))
    joint = half @ half.T
    pick = [0, 1, 2, 3, 4, 4, 3] if twice else [0, 1, 2, 3, 4]
    whole = joint[np.ix_(pick, pick)]
    got = tie(np.zeros(2), whole[:2, :2], whole[:2, 2:], np.ones(len(pick) - 2), whole[2:, 2:])
    later = rng.standard_normal(3)
    density = multivariate_normal(np.concatenate([np.zeros(2), np.ones(3)]), joint)
    best = got.offset + got.gain @ later[[0, 1, 2, 2, 1] if twice else [0, 1, 2]]
    for axis in range(2):
        step = 1e-4 * np.eye(2)[axis]
        up, down = (density.logpdf(np.concatenate([best + s, later])) for s in (step, -step))
        assert up == pytest.approx(down, abs=1e-6)
    np.testing.assert_allclose(got.rest, np.linalg.inv(np.linalg.inv(joint)[:2, :2]), atol=1e-8)


def test_what_is_placed_anew_is_not_tied_to_before() -> None:
    belief, chain = begun(), Chain()
    for k in range(4):
        belief = predict(belief, float(k), MOTION)
        if k != 2:
            belief = measured(belief, np.array([1.0, 2.0]))
        else:  # as `place` does
            mean, covariance = belief.mean.copy(), belief.covariance.copy()
            own = slice(0, len(POSE))
            covariance[own, :] = covariance[:, own] = 0.0
            mean[:2] = 9.0
            covariance[OWN, OWN] = 0.01
            belief = replace(belief, mean=mean, covariance=covariance)
        belief = chain.knot(belief)
    smoothed = list(chain.back())[::-1]
    filtered = chain.knots[1].belief
    np.testing.assert_allclose(smoothed[1].mean, filtered.mean, atol=1e-12)
    np.testing.assert_allclose(smoothed[1].covariance, filtered.covariance, atol=1e-12)
    assert smoothed[2].mean[0] != filtered.mean[0]
