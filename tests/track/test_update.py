"""One update against textbook filters, and what it leaves out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site, rows_of, shifted
from sonofix.geometry import SIZE, Links, link
from sonofix.locate.noise import MANOEUVRE_MPS2, row_noise
from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site
from sonofix.track.belief import Belief, Motion, blank, predict
from sonofix.track.update import GATE_SIGMA, MANOEUVRE_RADPS2, expect, noise_of, update

PLACE = (3.0, 5.5, 1.1)
FREE = np.array([0, 1, 2, 4, 5, 6])
# beacons a hundred thousand kilometres off: a metre's move bends a range by 5e-9 m, so ranges are linear in position
FAR_M = 1e8
FAR = np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0]]]) * FAR_M


def believed(site: Site, mean: Floats, covariance: Floats, time_s: float = 0.0, clock: bool = False) -> Belief:
    """A belief over x, y, z, vx, vy, vz (and the clock) of the site's only vehicle."""
    index = np.append(FREE, [SIZE, SIZE + 1]) if clock else FREE
    empty = blank(site)
    whole, full, free = empty.mean.copy(), empty.covariance.copy(), empty.free.copy()
    whole[index], full[np.ix_(index, index)], free[index] = mean, covariance, True
    return Belief(time_s, whole, full, free, np.ones(1, bool))


def random_covariance(rng: np.random.Generator, n: int, size: float) -> Floats:
    half = size * rng.standard_normal((n, n))
    return half @ half.T + size**2 * np.eye(n)


def everything(epoch: RangeEpoch, site: Site) -> tuple[Links, Floats]:
    return link(site, epoch.emitter, epoch.receiver), np.ones(len(epoch), bool)


def test_linear_rows_give_the_textbook_kalman_filter(rng: np.random.Generator) -> None:
    # S = H P Hᵀ + R, K = P Hᵀ S⁻¹, x + K y, (I − K H) P: over twenty epochs, ageing by x ← F x, P ← F P Fᵀ + Q between
    site = make_site(FAR)
    motion = Motion(acceleration_psd=0.5, climb_psd=0.5)
    mean, covariance = np.zeros(6), random_covariance(rng, 6, 0.2)
    belief = believed(site, mean, covariance)
    dt, sd = 0.5, 0.05
    step = np.eye(6) + dt * np.eye(6, k=3)
    noise = 0.5 * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(3))
    h = np.hstack([-FAR / FAR_M, np.zeros((7, 3))])
    place, velocity = np.array([0.1, -0.2, 0.1]), np.array([0.3, 0.2, -0.1])
    for k in range(20):
        time_s = dt * (k + 1)
        place = place + velocity * dt
        epoch = make_epoch(site, Drive(place), time_s, sd_m=sd)
        epoch = replace(epoch, range_m=FAR_M + h[:, :3] @ place + sd * rng.standard_normal(7))
        belief = predict(belief, time_s, motion)
        belief, used, _, innovation = update(belief, epoch, *everything(epoch, site))
        assert used.all()
        mean, covariance = step @ mean, step @ covariance @ step.T + noise
        expected, miss = h @ covariance @ h.T + sd**2 * np.eye(7), epoch.range_m - FAR_M - h @ mean
        assert innovation is not None
        assert (innovation.time_s, innovation.rows) == (time_s, 7)
        assert innovation.nis == pytest.approx(miss @ np.linalg.solve(expected, miss), rel=1e-4)
        gain = covariance @ h.T @ np.linalg.inv(expected)
        mean = mean + gain @ miss
        covariance = (np.eye(6) - gain @ h) @ covariance
        # at 1e8 m a double resolves 1.5e-8 m
        np.testing.assert_allclose(belief.mean[FREE], mean, atol=2e-7)
        np.testing.assert_allclose(belief.covariance[np.ix_(FREE, FREE)], covariance, atol=1e-8)


def test_rates_and_an_unknown_clock_in_the_textbook_filter(rng: np.random.Generator) -> None:
    site = make_site(FAR)
    covariance = random_covariance(rng, 8, 0.2)
    mean = 0.1 * rng.standard_normal(8)
    epoch = make_epoch(site, Drive((0.0, 0.0, 0.0)), sd_m=0.05, clock_m=0.3)
    place, velocity = rng.standard_normal((2, 3)) * 0.1
    unit = -FAR / FAR_M
    epoch = replace(
        epoch,
        range_m=FAR_M + unit @ place + 0.3,
        range_rate_mps=unit @ velocity + 0.02,
        range_rate_sd_mps=np.full(7, 0.04),
    )
    got, used, *_ = update(believed(site, mean, covariance, clock=True), epoch, *everything(epoch, site))
    assert used.all()
    zero, one = np.zeros((7, 3)), np.ones((7, 1))
    # the clock's offset is in every range, its speed in every rate
    h = np.block([[unit, zero, one, 0 * one], [zero, unit, 0 * one, one]])
    r = np.diag(np.repeat([0.05**2, 0.04**2], 7))
    gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + r)
    miss = np.concatenate([epoch.range_m - FAR_M, epoch.range_rate_mps]) - h @ mean
    index = np.append(FREE, [SIZE, SIZE + 1])
    np.testing.assert_allclose(got.mean[index], mean + gain @ miss, atol=2e-7)
    np.testing.assert_allclose(got.covariance[np.ix_(index, index)], (np.eye(8) - gain @ h) @ covariance, atol=1e-8)


def test_iterations_find_the_most_likely_place(rng: np.random.Generator) -> None:
    # half a metre of prior at two metres' range: the posterior's peak, by Gauss–Newton on prior and ranges together
    site = make_site(HALL)
    mean, covariance = np.array([3.4, 5.1, 1.5, 0, 0, 0]), np.diag([0.5**2] * 3 + [0.1**2] * 3)
    epoch = make_epoch(site, Drive(PLACE), rng=rng)
    got, *_ = update(believed(site, mean, covariance), epoch, *everything(epoch, site), iterations=20)
    x = mean.copy()
    for _ in range(50):
        away = x[:3] - np.array(HALL)
        distance = np.linalg.norm(away, axis=1)
        h = np.hstack([away / distance[:, None], np.zeros((6, 3))])
        weight = np.linalg.inv(covariance)
        normal = h.T @ h / 0.01**2 + weight
        x = x + np.linalg.solve(normal, h.T @ (epoch.range_m - distance) / 0.01**2 - weight @ (x - mean))
    np.testing.assert_allclose(got.mean[FREE], x, atol=1e-5)


def test_one_beacon_alone_still_helps_along_its_direction() -> None:
    site = make_site(HALL)
    belief = believed(site, np.array([*PLACE, 0, 0, 0]), np.diag([0.1**2] * 6))
    epoch = rows_of(make_epoch(site, Drive(PLACE), sd_m=0.001), [0])
    got, used, *_ = update(belief, epoch, *everything(epoch, site))
    assert used.tolist() == [True]
    unit = np.array(PLACE) - np.array(HALL[0])
    unit /= np.linalg.norm(unit)
    own = got.covariance[:3, :3]
    assert np.sqrt(unit @ own @ unit) == pytest.approx(0.001, rel=1e-3)
    across = np.linalg.svd(unit[None])[2][1:]
    np.testing.assert_allclose(across @ own @ across.T, 0.1**2 * np.eye(2), atol=1e-9)


def test_a_row_far_from_what_is_expected_is_left_out_and_no_other(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    belief = believed(site, np.array([*PLACE, 0, 0, 0]), np.diag([0.02**2] * 6))
    epoch = make_epoch(site, Drive(PLACE), rng=rng)
    plain, *_ = update(belief, rows_of(epoch, [0, 1, 3, 4, 5]), *everything(rows_of(epoch, [0, 1, 3, 4, 5]), site))
    faulty = shifted(epoch, 2, 0.5)
    got, used, surprise, _ = update(belief, faulty, *everything(faulty, site))
    assert used.tolist() == [True, True, False, True, True, True]
    np.testing.assert_allclose(got.mean, plain.mean, atol=1e-12)
    np.testing.assert_allclose(got.covariance, plain.covariance, atol=1e-15)
    assert surprise[2] > GATE_SIGMA**2
    assert (np.delete(surprise, 2) < GATE_SIGMA**2).all()


def test_a_rate_far_from_what_is_expected_condemns_its_row() -> None:
    site = make_site(HALL)
    belief = believed(site, np.array([*PLACE, 0, 0, 0]), np.diag([0.02**2] * 6))
    epoch = make_epoch(site, Drive(PLACE), rate_sd_mps=0.05)
    rate = epoch.range_rate_mps.copy()
    rate[4] += 2.0
    epoch = replace(epoch, range_rate_mps=rate)
    _, used, *_ = update(belief, epoch, *everything(epoch, site))
    assert used.tolist() == [True] * 4 + [False, True]


def test_rows_that_are_not_candidates_do_not_enter() -> None:
    site = make_site(HALL)
    belief = believed(site, np.array([*PLACE, 0, 0, 0]), np.diag([0.02**2] * 6))
    epoch = make_epoch(site, Drive(PLACE))
    links, _ = everything(epoch, site)
    asked = np.array([False, True, False, True, False, False])
    _, used, surprise, _ = update(belief, epoch, links, asked)
    assert used.tolist() == asked.tolist()
    assert len(surprise) == 2


@pytest.mark.parametrize("why", ["no rows", "none asked", "nobody placed", "clock unknown"])
def test_nothing_to_go_by_changes_nothing(why: str) -> None:
    site = make_site(HALL)
    belief = believed(site, np.array([*PLACE, 0, 0, 0]), np.diag([0.02**2] * 6))
    epoch = make_epoch(site, Drive(PLACE), clock_m=3.0 if why == "clock unknown" else None)
    if why == "no rows":
        epoch = rows_of(epoch, np.zeros(0, int))
    if why == "nobody placed":
        belief = replace(belief, placed=np.zeros(1, bool))
    links, asked = everything(epoch, site)
    got, used, surprise, _ = update(belief, epoch, links, asked & (why != "none asked"))
    assert got is belief
    assert not used.any()
    assert len(used) == len(epoch)
    assert len(surprise) == 0


def test_rows_are_taken_at_their_own_moments() -> None:
    # exact rows of a driving vehicle, heard up to 40 ms either side: taken as simultaneous they would pull it 6 cm off
    site = make_site(HALL)
    drive = Drive(PLACE, (1.2, -0.9, 0.2))
    times = np.array([-0.04, 0.04, -0.02, 0.02, 0.03, -0.03])
    belief = believed(site, np.array([*PLACE, *drive.velocity_mps]), np.diag([0.1**2] * 3 + [0.01**2] * 3))
    epoch = make_epoch(site, drive, times, sd_m=0.001)
    got, used, *_ = update(belief, epoch, *everything(epoch, site))
    assert used.all()
    np.testing.assert_allclose(got.mean[:3], PLACE, atol=1e-6)


def test_a_covariance_stays_positive_through_updates_of_any_precision(rng: np.random.Generator) -> None:
    # a micrometre after a metre: (I − K H) P by itself would go negative
    site = make_site(HALL)
    belief = believed(site, np.array([*PLACE, 0, 0, 0]), random_covariance(rng, 6, 1.0))
    for sd in (1e-6, 1.0, 1e-4, 1e-6, 1e-6):
        epoch = make_epoch(site, Drive(PLACE), sd_m=sd)
        belief, *_ = update(belief, epoch, *everything(epoch, site))
        own = belief.covariance[np.ix_(FREE, FREE)]
        np.testing.assert_array_equal(own, own.T)
        assert np.linalg.eigvalsh(own).min() > 0


@pytest.mark.parametrize("sounding", [False, True])
def test_rows_of_an_epoch_share_one_acceleration(sounding: bool) -> None:
    # each row, solved for its own moment of hearing and of sending, on the way that one deviation of each axis bends
    arms = ((0.0, 0.0, 0.0),) if sounding else ((0.2, 0.0, 0.0), (-0.2, 0.1, 0.0))
    site = make_site(HALL, arms_m=arms, sounding=sounding)
    velocity = np.array([0.8, -0.4, 0.0, 0.2])

    class Bent(Drive):
        bend = np.zeros(4)

        def moved(self, time_s: float) -> Floats:
            return velocity * time_s + self.bend * time_s**2 / 2

        def origin(self, time_s: float) -> Floats:
            return np.array(PLACE) + self.moved(time_s)[:3]

        def yaw(self, time_s: float) -> float:
            return 0.7 + self.moved(time_s)[3]

    def epoch_of(bend: Floats) -> RangeEpoch:
        drive = Bent(PLACE)
        drive.bend = bend
        return make_epoch(site, drive, np.linspace(-0.04, 0.06, count), sd_m=0.002, rate_sd_mps=0.003)

    count, axes = len(HALL) * len(arms), [0, 1] if sounding else [0, 1, 3]
    epoch = epoch_of(np.zeros(4))
    links, rows = link(site, epoch.emitter, epoch.receiver), np.arange(len(epoch))
    empty = blank(site)
    mean, free = empty.mean.copy(), empty.free.copy()
    mean[:8] = [*PLACE, 0.7, *velocity]
    free[axes + [axis + 4 for axis in axes]] = True
    belief = replace(empty, mean=mean, free=free, placed=np.ones(1, bool))
    pair, small = np.zeros(0, np.int64), 1e-3

    def told(bend: Floats) -> Floats:
        seen = epoch_of(bend)
        assert seen.range_rate_mps is not None
        return np.concatenate([seen.range_m, seen.range_rate_mps])

    plain = row_noise(epoch, links, rows, epoch.time_s, agile_mps2=0.0)
    expected = plain.copy()
    for axis in axes:
        sd = MANOEUVRE_RADPS2 if axis == 3 else MANOEUVRE_MPS2
        slope = (told(small * np.eye(4)[axis]) - told(-small * np.eye(4)[axis])) / (2 * small)
        expected += sd**2 * np.outer(slope, slope)
    shown, derivative = expect(links, belief, mean, epoch.time_s, epoch, pair)
    np.testing.assert_allclose(shown, told(np.zeros(4)), atol=1e-6)
    got = noise_of(belief, epoch, links, rows, epoch.time_s, pair, derivative)
    # but for v / c, by which a sender's own delay changes with its velocity
    np.testing.assert_allclose(got, expected, atol=1e-2 * float(expected.max()))
    assert got.diagonal().max() > 20 * plain.diagonal().max()
