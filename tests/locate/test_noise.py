"""What rows are uncertain by: their own, the beacon's place, and the vehicle's manoeuvres within an epoch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from locate.made_epochs import Drive, make_epoch, make_site
from sonofix.geometry import link
from sonofix.locate.noise import MANOEUVRE_MPS2, TYPICAL_SPEED_MPS, row_noise

BEACONS = ((0.0, 0.0, 3.0), (9.0, 0.0, 3.0), (5.0, 7.0, 3.0))
ARMS = ((0.2, 0.0, 0.0), (-0.2, 0.0, 0.0))


def test_rows_heard_at_the_reference_instant_keep_their_own_covariance(rng: np.random.Generator) -> None:
    site = make_site(BEACONS)
    epoch = make_epoch(site, Drive((4.0, 3.0, 1.0)), rate_sd_mps=0.05)
    full = rng.standard_normal((3, 3))
    epoch = replace(epoch, covariance_m2=full @ full.T)
    links = link(site, epoch.emitter, epoch.receiver)
    rows = np.array([2, 0])
    covariance = row_noise(epoch, links, rows, np.zeros(2))
    np.testing.assert_allclose(covariance[:2, :2], epoch.covariance_m2[np.ix_(rows, rows)])
    np.testing.assert_allclose(covariance[2:, 2:], 0.05**2 * np.eye(2))
    assert not covariance[:2, 2:].any()
    assert not covariance[2:, :2].any()


def test_an_acceleration_grows_with_time_for_rates_and_its_square_for_ranges() -> None:
    site = make_site(BEACONS)
    epoch = make_epoch(site, Drive((4.0, 3.0, 1.0)), sd_m=0.01, rate_sd_mps=0.05)
    links = link(site, epoch.emitter, epoch.receiver)
    dt = np.array([-0.2, 0.0, 0.1])
    covariance = row_noise(epoch, links, np.arange(3), dt)
    np.testing.assert_allclose(np.diag(covariance[:3, :3]), 0.01**2 + (MANOEUVRE_MPS2 * dt**2 / 2) ** 2)
    np.testing.assert_allclose(covariance[3:, 3:], np.diag(0.05**2 + (MANOEUVRE_MPS2 * dt) ** 2))
    steady = row_noise(epoch, links, np.arange(3), dt, agile_mps2=0.0)
    np.testing.assert_allclose(steady, np.diag(np.repeat([0.01**2, 0.05**2], 3)))


def test_a_misplaced_beacon_errs_alike_for_all_who_hear_it() -> None:
    site = make_site(BEACONS, arms_m=ARMS, position_sd_m=0.03)
    epoch = make_epoch(site, Drive((4.0, 3.0, 1.0)), sd_m=0.01)
    assert epoch.emitter == ("B0", "B0", "B1", "B1", "B2", "B2")
    links = link(site, epoch.emitter, epoch.receiver)
    covariance = row_noise(epoch, links, np.arange(6), np.zeros(6))
    expected = 0.01**2 * np.eye(6) + 0.03**2 * np.kron(np.eye(3), np.ones((2, 2)))
    np.testing.assert_allclose(covariance, expected)


def test_kernel_matches_its_plain_twin(rng: np.random.Generator) -> None:
    site = make_site(BEACONS, arms_m=ARMS, position_sd_m=0.03)
    epoch = make_epoch(site, Drive((4.0, 3.0, 1.0)), rate_sd_mps=0.05)
    full = rng.standard_normal((6, 6))
    epoch = replace(epoch, covariance_m2=full @ full.T, range_rate_sd_mps=rng.uniform(0.01, 0.1, 6))
    links = link(site, epoch.emitter, epoch.receiver)
    rows, dt = np.array([5, 0, 1, 3]), rng.uniform(-0.1, 0.1, 4)
    emitter = np.array(epoch.emitter)[rows]
    ranges = epoch.covariance_m2[np.ix_(rows, rows)] + np.where(emitter[:, None] == emitter, 0.03**2, 0.0)
    ranges += np.diag((MANOEUVRE_MPS2 * dt**2 / 2) ** 2 + (1.2 * dt) ** 2)
    turned = TYPICAL_SPEED_MPS * 0.03 / np.maximum(epoch.range_m[rows], 1.0)
    rates = np.diag(epoch.range_rate_sd_mps[rows] ** 2 + (MANOEUVRE_MPS2 * dt) ** 2 + turned**2) + 0.04**2
    zero = np.zeros((4, 4))
    got = row_noise(epoch, links, rows, dt, speed_sd_mps=1.2, clock_sd_mps=0.04)
    np.testing.assert_allclose(got, np.block([[ranges, zero], [zero, rates]]), rtol=1e-13)
