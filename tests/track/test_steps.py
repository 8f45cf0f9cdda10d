"""Walkers carried by steps: the update by its plain twin, dead reckoning over many runs, walks with a blind zone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.stats import chi2

from sonofix.files import read_recording, read_truth
from sonofix.flow import run
from sonofix.geometry import SIZE
from sonofix.records import Estimate, Floats, Table
from sonofix.street import Street
from sonofix.track import steps
from sonofix.track.belief import Belief, Motion, blank, estimate, predict
from sonofix.track.follow import Follower
from sonofix.track.inputs import gather
from track.made_walks import LEVEL_M, PERIOD_S, SITE, Walk, epoch_of, steps_of

OUTSIDE = 1e-6
SLOT, AT = SIZE, np.array([0, 1])


def told(*rows: tuple[float, float, float]) -> dict[str, Table]:
    time_s, length_m, heading_rad = (np.array(c, float) for c in zip(*rows, strict=True))
    return {"steps": Table({"time_s": time_s, "length_m": length_m, "heading_rad": heading_rad})}


def errors(got: Estimate, walk: Walk) -> tuple[float, float]:
    """Distance from the truth, and NEES of x and y."""
    miss = (got.position_m - walk.place(got.time_s))[:2]
    return float(np.hypot(*miss)), float(miss @ np.linalg.solve(got.covariance[:2, :2], miss))


def random_belief(rng: np.random.Generator) -> tuple[Floats, Floats]:
    n = SIZE + 4 + 2
    half = 0.1 * rng.standard_normal((n, n))
    return 0.1 * rng.standard_normal(n), half @ half.T


def test_a_step_is_the_textbook_update_by_numerical_derivatives(rng: np.random.Generator) -> None:
    for _ in range(10):
        mean, covariance = random_belief(rng)
        length, heading = rng.uniform(0.1, 1.0), rng.uniform(-np.pi, np.pi)

        def disagreement(x: Floats, length: float = length, heading: float = heading) -> Floats:
            chord = length * (1 - x[SLOT + 2])
            angle = heading - x[SLOT + 3]
            return x[AT] - x[SLOT + AT] - chord * np.array([np.cos(angle), np.sin(angle)])

        h = approx_fprime(mean, disagreement, 1e-7)
        s = h @ covariance @ h.T + steps.STEP_SD_M**2 * np.eye(2)
        gain = covariance @ h.T @ np.linalg.inv(s)
        wanted = mean - gain @ disagreement(mean), (np.eye(SIZE + 6) - gain @ h) @ covariance
        if disagreement(mean) @ np.linalg.solve(s, disagreement(mean)) > steps.UNLIKELY:
            wanted = mean, covariance
        got, after = mean.copy(), covariance.copy()
        steps.take(got, after, np.ones(SIZE + 6, bool), 0, SLOT, length, heading)
        np.testing.assert_allclose(got[:8], wanted[0][:8], atol=1e-6)
        np.testing.assert_allclose(got[SLOT + 2 :], wanted[0][SLOT + 2 :], atol=1e-6)
        np.testing.assert_allclose(after[:8, :8], wanted[1][:8, :8], atol=1e-6)
        # the anchor is where the step ended: the same place, with the same certainty
        np.testing.assert_array_equal(got[SLOT + AT], got[AT])
        np.testing.assert_array_equal(after[SLOT + AT], after[AT])


def test_step_errors_forget_themselves_in_their_correlation_time() -> None:
    mean, covariance, free = np.zeros(SIZE + 6), np.zeros((SIZE + 6, SIZE + 6)), np.zeros(SIZE + 6, bool)
    steps.begin(covariance, free, SLOT)
    np.testing.assert_array_equal(np.flatnonzero(free), [SLOT + 2, SLOT + 3])
    mean[SLOT + 2 : SLOT + 4], stationary = [0.1, 0.05], covariance.copy()
    covariance[SLOT + 2, SLOT + 2] = 0.0
    for _ in range(200):
        steps.wander(mean, covariance, 0, SLOT, steps.CORRELATED_S / 200, placed=False)
    np.testing.assert_allclose(mean[SLOT + 2 : SLOT + 4], np.array([0.1, 0.05]) / np.e)
    assert covariance[SLOT + 2, SLOT + 2] == pytest.approx(steps.LENGTH_SD**2 * (1 - np.exp(-2)))
    assert covariance[SLOT + 3, SLOT + 3] == pytest.approx(stationary[SLOT + 3, SLOT + 3])


def reckoned(run_: int, count: int) -> tuple[float, float]:
    """Error and NEES of a walk by steps alone, from a stated start; errors of steps drawn as the filter has them."""
    rng = np.random.default_rng([7, run_])
    fade = np.exp(-0.5 / steps.CORRELATED_S)
    length, angle = np.array([steps.LENGTH_SD, steps.HEADING_SD_RAD]) * rng.standard_normal(2)
    place, rows, heading = np.array([2.0, 2.0]), [], rng.uniform(-np.pi, np.pi)
    start = place + 0.05 * rng.standard_normal(2)
    for k in range(count):
        chord = 0.25 * np.array([np.cos(heading), np.sin(heading)])
        noisy = chord + steps.STEP_SD_M * rng.standard_normal(2) if k else np.zeros(2)
        place = place + (chord if k else 0.0)
        rows.append((0.5 * k, np.hypot(*noisy) / (1 - length), np.arctan2(noisy[1], noisy[0]) + angle))
        drawn = np.sqrt(1 - fade**2) * rng.standard_normal(2)
        length = fade * length + steps.LENGTH_SD * drawn[0]
        angle = fade * angle + steps.HEADING_SD_RAD * drawn[1]
        heading += 0.2 * rng.standard_normal()
    follower = Follower(SITE, inputs=gather(SITE, told(*rows)))
    follower.start("v", -0.01, np.append(start, LEVEL_M), 0.0)
    got = estimate(predict(follower.belief, rows[-1][0], Motion()), SITE, 0, "predicted")
    miss = (got.position_m - np.append(place, LEVEL_M))[:2]
    return float(np.hypot(*miss)), float(miss @ np.linalg.solve(got.covariance[:2, :2], miss))


def test_dead_reckoning_is_as_good_as_it_says() -> None:
    runs = 200
    found = np.array([reckoned(k, 30) for k in range(runs)])
    low, high = chi2.ppf([OUTSIDE / 2, 1 - OUTSIDE / 2], 2 * runs) / runs
    assert low < found[:, 1].mean() < high
    # seven metres walked: decimetres, where constant velocity alone would be metres off
    assert np.sqrt(np.mean(found[:, 0] ** 2)) < 1.0


def test_steps_to_come_are_not_looked_at() -> None:
    rows = [(0.5 * k, 0.5, 0.0) for k in range(10)]
    beliefs = []
    for known in (rows, rows[:5]):
        follower = Follower(SITE, inputs=gather(SITE, told(*known)))
        follower.start("v", 0.1, np.array([2.0, 2.0, LEVEL_M]), 0.0)
        beliefs.append(predict(follower.belief, 2.2, Motion()))
    np.testing.assert_array_equal(beliefs[0].mean, beliefs[1].mean)
    np.testing.assert_array_equal(beliefs[0].covariance, beliefs[1].covariance)


@pytest.mark.parametrize(
    "odd", [(float("nan"), 0.0), (0.5, float("nan")), (500.0, 0.0)], ids=["no length", "no heading", "500 m"]
)
def test_a_step_without_sense_is_left_out_and_the_next_starts_from_there(odd: tuple[float, float]) -> None:
    rows = [(0.5 * k, 0.5, 0.0) for k in range(6)]
    rows[3] = (1.5, *odd)
    follower = Follower(SITE, inputs=gather(SITE, told(*rows)))
    follower.start("v", 0.0, np.array([2.0, 2.0, LEVEL_M]), 0.0)
    before = predict(follower.belief, 1.45, Motion())
    after = predict(before, 1.55, Motion())
    assert abs(after.mean[0] - before.mean[0]) < 0.2
    assert after.free[SLOT]
    later = predict(after, 2.5, Motion())
    assert later.mean[0] == pytest.approx(4.5, abs=0.3)


def test_placing_a_walker_anew_forgets_where_his_step_began(rng: np.random.Generator) -> None:
    walk = Walk()
    street = Street(SITE)
    street.sense({"steps": steps_of(walk, 5.0, rng)})
    for k in range(4):
        street.walk(epoch_of(walk, 0.1 + PERIOD_S * k, rng))
    assert street.follower.belief.free[SLOT]
    # carried off: ten metres along the path at once
    events = [e.event for e in street.walk(epoch_of(Walk(begin_m=10.0), 2.1, rng)).events]
    assert events == ["reset"]
    belief = street.follower.belief
    assert not belief.free[SLOT : SLOT + 2].any()
    assert not belief.covariance[SLOT].any()
    assert belief.free[SLOT + 2 : SLOT + 4].all()


def blind_walk(seed: int) -> tuple[list[float], list[float], Belief]:
    """Errors and NEES by epoch of a walk of 20 s whose beacons but one are silent from 8 s to 13 s."""
    rng = np.random.default_rng([11, seed])
    walk, street = Walk(), Street(SITE)
    street.sense({"steps": steps_of(walk, 20.0, rng)})
    seen = []
    for k in range(36):
        time_s = 0.1 + PERIOD_S * k
        step = street.walk(epoch_of(walk, time_s, rng, heard=(0,) if 8 <= time_s < 13 else (0, 1, 2, 3, 4, 5)))
        assert [e.event for e in step.events] == ([] if k else ["start"])
        seen.append(errors(step.estimates[0], walk))
    return [e for e, _ in seen], [n for _, n in seen], street.follower.belief


def test_walks_through_a_blind_zone_with_one_beacon_heard() -> None:
    runs = 25
    walks = [blind_walk(k) for k in range(runs)]
    error, nees = np.array([w[0] for w in walks]), np.array([w[1] for w in walks])
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert rms[:16].max() < 0.03
    assert rms[25] < 0.1
    assert error[:, 25].max() < 0.3
    assert rms[26:].max() < 0.03
    low, high = chi2.ppf([OUTSIDE / 2, 1 - OUTSIDE / 2], 2 * runs * 12) / (runs * 12)
    assert low < nees[:, 3:15].mean() < high
    # a walker keeps his pace better than the filter trusts him to, so that it may be better than it says, never worse
    assert nees[:, 16:26].mean() < chi2.ppf(1 - OUTSIDE, 2 * runs) / runs
    for _, _, belief in walks:
        assert np.linalg.eigvalsh(belief.covariance).min() > -1e-15


def test_without_steps_a_blind_zone_is_lost(rng: np.random.Generator) -> None:
    # the same walk, and its steps are what carries it
    walk, street = Walk(), Street(SITE)
    for k in range(26):
        heard = (0,) if k > 15 else (0, 1, 2, 3, 4, 5)
        step = street.walk(epoch_of(walk, 0.1 + PERIOD_S * k, rng, heard=heard))
    assert errors(step.estimates[0], walk)[0] > 0.5


def test_estimates_at_a_rate_follow_each_step(rng: np.random.Generator) -> None:
    walk, street = Walk(), Street(SITE, rate_hz=20.0)
    street.sense({"steps": steps_of(walk, 9.0, rng)})
    last = 0.0
    for k in range(16):
        heard = (0,) if k > 11 else (0, 1, 2, 3, 4, 5)
        for got in street.walk(epoch_of(walk, 0.1 + PERIOD_S * k, rng, heard=heard)).estimates:
            assert got.time_s - last == pytest.approx(0.05) or not last
            last = got.time_s
            if last > 2.0:
                assert errors(got, walk)[1] < 40


def test_no_table_no_states() -> None:
    assert gather(SITE, {}) is None
    assert len(blank(SITE).mean) == SIZE + 2
    assert len(blank(SITE, gather(SITE, told((0.5, 0.6, 0.0)))).mean) == SIZE + 6


def test_the_walk_among_the_captures(captures: Path) -> None:
    truth = read_truth(captures / "walk")["walker"]
    seen = [s.estimates[0] for s in run(read_recording(captures / "walk", to_run=True)) if s.estimates]
    seen = [e for e in seen if truth.time_s[0] <= e.time_s <= truth.time_s[-1]]
    at = np.array([e.time_s for e in seen])
    places = np.column_stack([np.interp(at, truth.time_s, truth.position_m[:, i]) for i in range(2)])
    miss = np.array([e.position_m[:2] for e in seen]) - places
    distance = np.hypot(*miss.T)
    blind = (at > 8.0) & (at < 13.0)
    assert np.sqrt(np.mean(distance[~blind] ** 2)) < 0.005
    assert distance[blind].max() < 0.15
    sd = np.array([[e.sd("x"), e.sd("y")] for e in seen], float)
    assert np.mean(np.all(np.abs(miss) < 2 * sd, axis=1)) >= 0.75
