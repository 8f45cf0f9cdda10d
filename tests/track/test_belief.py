"""How a belief ages and begins: against numerical integrals of the same motion, and by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from locate.made_epochs import HALL, Drive, make_epoch, make_site
from sonofix.geometry import SIZE, YAW
from sonofix.locate.fix import fix
from sonofix.records import Floats
from sonofix.track.belief import Belief, Motion, age, blank, estimate, place, predict, start_at

PACE, TILT_SD_RAD = 1.7, 0.25
MOTION = Motion(acceleration_psd=0.7, climb_psd=0.03, turn_psd=0.2, clock_psd=3e-6, tilt_pace_radps=PACE)
PLACE = (3.0, 5.5, 1.1)
NO_ARM = np.zeros(2)
TWO_ARMS = ((0.35, 0.1, 0.5), (-0.3, -0.2, 0.5))


def full_belief(rng: np.random.Generator, vehicles: int = 1) -> Belief:
    """Everything estimated, correlated at random."""
    n = SIZE * vehicles + 2
    half = rng.standard_normal((n, n))
    tilts = np.full(vehicles, TILT_SD_RAD)
    placed = np.ones(vehicles, bool)
    return Belief(2.0, rng.standard_normal(n), half @ half.T, np.ones(n, bool), placed, tilt_sd_rad=tilts)


def dynamics(vehicles: int) -> tuple[Floats, Floats]:
    """F and Q of ẋ = F x + w by hand: places are driven by speeds, speeds by white noise."""
    n = SIZE * vehicles + 2
    drift, psd = np.zeros((n, n)), np.zeros(n)
    for v in range(vehicles):
        for i in range(4):
            drift[SIZE * v + i, SIZE * v + 4 + i] = 1.0
        psds = MOTION.acceleration_psd, MOTION.acceleration_psd, MOTION.climb_psd, MOTION.turn_psd
        psd[SIZE * v + 4 : SIZE * v + 8] = psds
        for i in (8, 9):
            # a body that comes back upright: critically damped, of variance σ² for ever
            drift[SIZE * v + i, SIZE * v + 2 + i] = 1.0
            drift[SIZE * v + 2 + i, SIZE * v + i] = -(PACE**2)
            drift[SIZE * v + 2 + i, SIZE * v + 2 + i] = -2 * PACE
            psd[SIZE * v + 2 + i] = 4 * PACE**3 * TILT_SD_RAD**2
    drift[-2, -1], psd[-1] = 1.0, MOTION.clock_psd
    return drift, np.diag(psd)


@pytest.mark.parametrize("dt_s", [0.02, 0.5, 3.0])
@pytest.mark.parametrize("vehicles", [1, 2])
def test_prediction_equals_van_loans_integral(dt_s: float, vehicles: int, rng: np.random.Generator) -> None:
    # Van Loan, IEEE Trans. Automatic Control 23(3), 1978: one matrix exponential holds transition and noise
    belief = full_belief(rng, vehicles)
    drift, psd = dynamics(vehicles)
    n = len(drift)
    block = expm(np.block([[-drift, psd], [np.zeros((n, n)), drift.T]]) * dt_s)
    transition = block[n:, n:].T
    noise = transition @ block[:n, n:]
    aged = predict(belief, belief.time_s + dt_s, MOTION)
    np.testing.assert_allclose(aged.mean, transition @ belief.mean, atol=1e-12)
    np.testing.assert_allclose(aged.covariance, transition @ belief.covariance @ transition.T + noise, atol=1e-10)
    assert aged.time_s == belief.time_s + dt_s


def test_prediction_equals_many_small_random_steps(rng: np.random.Generator) -> None:
    # the noise is what white acceleration, summed in small steps, does to 4000 vehicles
    steps, runs, dt = 200, 4000, 1.0 / 200
    kick = np.sqrt(MOTION.acceleration_psd * dt) * rng.standard_normal((steps, runs))
    speed = np.cumsum(kick, axis=0)
    place_m = np.sum(speed - kick / 2, axis=0) * dt
    sample = np.cov(np.vstack([place_m, speed[-1]]))
    belief = full_belief(rng)
    still = replace(belief, mean=0 * belief.mean, covariance=0 * belief.covariance)
    aged = predict(still, belief.time_s + 1.0, MOTION)
    # a variance from 4000 samples is good to √(2/4000) = 2.2 %: four of those
    np.testing.assert_allclose(sample, aged.covariance[np.ix_([0, 4], [0, 4])], rtol=0.09)


def test_two_short_predictions_equal_one_long(rng: np.random.Generator) -> None:
    belief = full_belief(rng, 2)
    once = predict(belief, 3.1, MOTION)
    twice = predict(predict(belief, 2.4, MOTION), 3.1, MOTION)
    np.testing.assert_allclose(twice.mean, once.mean, atol=1e-12)
    np.testing.assert_allclose(twice.covariance, once.covariance, atol=1e-10)


def test_no_time_changes_nothing(rng: np.random.Generator) -> None:
    belief = full_belief(rng)
    same = predict(belief, belief.time_s, MOTION)
    np.testing.assert_array_equal(same.mean, belief.mean)
    np.testing.assert_array_equal(same.covariance, belief.covariance)


def test_looking_back_also_costs_certainty(rng: np.random.Generator) -> None:
    belief = full_belief(rng)
    back = predict(belief, belief.time_s - 0.3, MOTION)
    there_and_back = predict(back, belief.time_s, MOTION)
    # a body that tilts comes upright again both ways in time: of its tilt nothing is kept for ever
    kept = np.r_[0:8, SIZE : SIZE + 2]
    np.testing.assert_allclose(there_and_back.mean[kept], belief.mean[kept], atol=1e-12)
    gained = np.linalg.eigvalsh((there_and_back.covariance - belief.covariance)[np.ix_(kept, kept)])
    assert gained.min() > -1e-12
    assert gained.max() > 0


@pytest.mark.parametrize("dt_s", [60.0, -60.0])
def test_a_tilt_that_nothing_tells_of_ends_as_it_began(dt_s: float, rng: np.random.Generator) -> None:
    belief = full_belief(rng)
    aged = predict(belief, belief.time_s + dt_s, MOTION)
    np.testing.assert_allclose(aged.mean[8:SIZE], 0.0, atol=1e-12)
    settled = np.diag([TILT_SD_RAD**2] * 2 + [(PACE * TILT_SD_RAD) ** 2] * 2)
    np.testing.assert_allclose(aged.covariance[8:SIZE, 8:SIZE], settled, atol=1e-12)


def test_a_known_level_never_becomes_uncertain() -> None:
    site = make_site(HALL, level_m=1.1)
    belief = place(blank(site), 0, fix(make_epoch(site, Drive(PLACE)), site, "v"), NO_ARM)
    aged = predict(belief, 60.0, MOTION)
    assert aged.mean[2] == 1.1
    for i in (2, 3, 6, 7):
        assert not aged.covariance[i].any()
        assert not aged.covariance[:, i].any()


def test_nothing_is_believed_before_anything_is_heard() -> None:
    site = make_site(HALL, level_m=1.1)
    belief = predict(blank(site), 5.0, MOTION)
    assert belief.time_s == 5.0
    assert not belief.placed.any()
    assert not belief.free.any()
    assert belief.pose()[0, 2] == 1.1


@pytest.mark.parametrize("clock_m", [None, 20.0])
@pytest.mark.parametrize("rate_sd_mps", [None, 0.05])
def test_a_fix_is_taken_over_as_it_is(clock_m: float | None, rate_sd_mps: float | None) -> None:
    site = make_site(HALL, arms_m=TWO_ARMS)
    drive = Drive(PLACE, (0.4, -0.2, 0.1) if rate_sd_mps else (0.0, 0.0, 0.0), yaw_rad=0.7)
    found = fix(make_epoch(site, drive, clock_m=clock_m, rate_sd_mps=rate_sd_mps), site, "v")
    assert found.status == "ok"
    got = estimate(place(blank(site), 0, found, NO_ARM), site, 0, "fix")
    np.testing.assert_array_equal(got.position_m, found.position_m)
    assert got.yaw_rad == pytest.approx(0.7, abs=1e-4)
    for state in ("x", "y", "z", "yaw", *(("clock",) if clock_m else ()), *(("vx", "vy", "vz") if rate_sd_mps else ())):
        assert got.sd(state) == pytest.approx(found.sd(state), rel=1e-12), state
    if rate_sd_mps is None:
        # unknown speeds start at rest, good to 1 m/s
        np.testing.assert_array_equal(got.velocity_mps, 0.0)
        assert [got.sd(s) for s in ("vx", "vy", "vz")] == [1.0] * 3
    assert (got.clock_offset_m is None) == (clock_m is None)
    assert got.source == "fix"
    assert got.vehicle == "v"


def test_placing_forgets_what_was_believed_of_that_vehicle_alone(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    found = fix(make_epoch(site, Drive(PLACE)), site, "v")
    belief = full_belief(rng, 2)
    placed = place(belief, 0, found, NO_ARM)
    np.testing.assert_array_equal(placed.mean[SIZE:], belief.mean[SIZE:])
    np.testing.assert_array_equal(placed.covariance[SIZE:, SIZE:], belief.covariance[SIZE:, SIZE:])
    assert not placed.covariance[:8, 8:].any()
    assert np.linalg.eigvalsh(placed.covariance).min() > -1e-9


def test_a_fix_without_a_position_cannot_place() -> None:
    site = make_site(HALL[:2])
    found = fix(make_epoch(site, Drive(PLACE)), site, "v")
    with pytest.raises(ValueError, match="too-few"):
        place(blank(site), 0, found, NO_ARM)


def test_an_open_arm_is_followed_at_its_end_and_told_at_the_origin() -> None:
    # one microphone 40 cm ahead of the origin, driving north: it is followed there, and the origin lies south of it
    site = make_site(HALL, arms_m=((0.4, 0.0, 0.5),))
    drive = Drive(PLACE, (0.0, 0.8, 0.0), yaw_rad=np.pi / 2)
    found = fix(make_epoch(site, drive, rate_sd_mps=0.01), site, "v")
    belief = place(blank(site), 0, found, np.array([0.4, 0.0]))
    np.testing.assert_allclose(belief.mean[:3], np.array(PLACE) + [0.0, 0.4, 0.0], atol=1e-4)
    got = estimate(belief, site, 0, "fix")
    np.testing.assert_allclose(got.position_m, PLACE, atol=1e-4)
    # 0.1 rad of heading at 40 cm
    assert got.sd("x") > 0.04


@pytest.mark.parametrize("turns", [True, False])
@pytest.mark.parametrize("level_known", [True, False])
def test_a_stated_start_is_good_to_five_centimetres(level_known: bool, turns: bool) -> None:
    site = make_site(HALL, level_m=1.1 if level_known else None)
    got = estimate(start_at(blank(site), 0, np.array(PLACE), 0.5, level_known, turns), site, 0, "predicted")
    np.testing.assert_array_equal(got.position_m, PLACE)
    assert got.sd("x") == got.sd("y") == pytest.approx(0.05)
    assert got.sd("z") == (None if level_known else pytest.approx(0.05))
    assert got.sd("vx") == pytest.approx(0.5)
    assert got.sd("yaw") == (pytest.approx(0.1) if turns else None)
    assert got.yaw_rad == (pytest.approx(0.5) if turns else None)


def test_an_estimates_heading_lies_between_minus_pi_and_pi(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    belief = full_belief(rng)
    mean = belief.mean.copy()
    mean[3] = 7.0
    assert estimate(replace(belief, mean=mean), site, 0, "fused").yaw_rad == pytest.approx(7.0 - 2 * np.pi)


# --- the plain twin of the kernel -------------------------------------------------------------------------------------


def test_ageing_matches_its_plain_twin(rng: np.random.Generator) -> None:
    # F P Fᵀ + Q with whole matrices, pair by pair of a place and its rate
    motion = Motion(0.5, 0.01, 0.3, 1e-6)
    for dt in (0.4, -0.2, 3.0):
        n = 3 * SIZE + 2
        half = rng.standard_normal((n, n))
        free = rng.random(n) < 0.7
        free[[SIZE * v + k for v in range(3) for k in range(8, SIZE)]] = False
        placed = np.array([True, False, True])
        belief = Belief(1.0, rng.standard_normal(n), half @ half.T, free, placed)
        step, noise = np.eye(n), np.zeros((n, n))
        pairs = [(SIZE * v + k, SIZE * v + 4 + k, psd) for v in (0, 2) for k, psd in enumerate((0.5, 0.5, 0.01, 0.3))]
        for at, rate, psd in [*pairs, (n - 2, n - 1, 1e-6)]:
            # a course turns without a heading
            if not free[rate] or (at % SIZE == YAW and at < n - 2 and not free[at]):
                continue
            step[at, rate] = dt
            noise[rate, rate] = psd * abs(dt)
            if free[at]:
                noise[at, at] = psd * abs(dt) ** 3 / 3
                noise[at, rate] = noise[rate, at] = psd * dt * abs(dt) / 2
        aged = predict(belief, 1.0 + dt, motion)
        np.testing.assert_allclose(aged.mean, step @ belief.mean, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(aged.covariance, step @ belief.covariance @ step.T + noise, rtol=1e-11, atol=1e-12)
        assert aged.time_s == 1.0 + dt
    assert len(age.signatures) == 1
