"""Fixes by arrival-time differences: exact without noise, as certain as stated, and the receiver's own."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from sonofix.locate.fix import fix
from sonofix.records import RangeEpoch
from sonofix.studies import pedestrian, tdoa
from sonofix.studies.halls import hall

RISE_M, SPEED = 2.15, 343.64
OUTSIDE = 1e-6


def places(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform([1.0, 1.0], [11.0, 7.0], (count, 2))


def arrivals(where: np.ndarray, clock_s: float = 0.0) -> np.ndarray:
    return tdoa.slants(where, pedestrian.BEACONS_M, RISE_M) / SPEED + clock_s


def test_without_noise_the_place_is_exact_whatever_the_clock(rng: np.random.Generator) -> None:
    where = places(rng, 500)
    for clock_s in (0.0, -7.3):
        for reference in range(4):
            found, _, valid = tdoa.fixes(arrivals(where, clock_s), pedestrian.BEACONS_M, RISE_M, SPEED, 1e-4, reference)
            assert valid.all()
            np.testing.assert_allclose(found, where, atol=1e-6)


def test_the_reference_makes_no_difference_to_the_fix(rng: np.random.Generator) -> None:
    noisy = arrivals(places(rng, 50)) + 1e-4 * rng.standard_normal((50, 4))
    by = [tdoa.fixes(noisy, pedestrian.BEACONS_M, RISE_M, SPEED, 1e-4, reference) for reference in range(4)]
    for other in by[1:]:
        np.testing.assert_allclose(other[0], by[0][0], atol=1e-6)
        np.testing.assert_allclose(other[1], by[0][1], rtol=1e-5)


def test_covariance_is_as_stated(rng: np.random.Generator) -> None:
    where = places(rng, 2000)
    noisy = arrivals(where) + 1e-4 * rng.standard_normal((2000, 4))
    found, covariance, valid = tdoa.fixes(noisy, pedestrian.BEACONS_M, RISE_M, SPEED, 1e-4)
    assert valid.all()
    miss = found - where
    nees = np.sum(miss * np.linalg.solve(covariance, miss[..., None])[..., 0])
    low, high = chi2.ppf([OUTSIDE / 2, 1 - OUTSIDE / 2], 4000)
    assert low < nees < high


def test_it_is_the_fix_of_the_receiver_with_an_unknown_clock(rng: np.random.Generator) -> None:
    beacons = [(float(x), float(y), 3.0) for x, y in pedestrian.BEACONS_M]
    site = hall("h", (12.0, 8.0, 3.2), beacons, "walker", 0.85, synchronised=False)
    for where in places(rng, 5):
        noisy = arrivals(where, 0.004) + 1e-5 * rng.standard_normal(4)
        epoch = RangeEpoch(
            index=0,
            sync_s=0.0,
            emitter=("B1", "B2", "B3", "B4"),
            receiver=("M1",) * 4,
            time_s=np.full(4, 0.1),
            range_m=SPEED * noisy,
            covariance_m2=(SPEED * 1e-5) ** 2 * np.eye(4),
            range_rate_mps=None,
            range_rate_sd_mps=None,
            snr_db=np.full(4, 20.0),
            clock="common",
            sound_speed_mps=SPEED,
        )
        theirs = fix(epoch, site, "walker")
        assert theirs.status == "ok"
        assert theirs.position_m is not None
        assert theirs.covariance is not None
        ours, covariance, _ = tdoa.fixes(noisy, pedestrian.BEACONS_M, RISE_M, SPEED, 1e-5)
        np.testing.assert_allclose(ours, theirs.position_m[:2], atol=1e-5)
        np.testing.assert_allclose(covariance, theirs.covariance[:2, :2], rtol=1e-3)


def test_far_out_or_absurd_times_are_no_fix_rather_than_a_wrong_one() -> None:
    absurd = np.array([[0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
    found, _, valid = tdoa.fixes(absurd, pedestrian.BEACONS_M, RISE_M, SPEED, 1e-4)
    assert np.isnan(found[~valid]).all()
    assert valid[1]
    np.testing.assert_allclose(found[1], [6.0, 4.0], atol=1e-6)
