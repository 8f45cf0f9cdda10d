"""What rows are uncertain by: their own, the beacon's place, and the vehicle's manoeuvres within an epoch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from locate.made_epochs import Drive, make_epoch, make_site
from sonofix.geometry import link
from sonofix.locate.noise import MANOEUVRE_MPS2, row_noise

BEACONS = ((0.0, 0.0, 3.0), (9.0, 0.0, 3.0), (5.0, 7.0, 3.0))
ARMS = ((0.2, 0.0, 0.0), (-0.2, 0.0, 0.0))


def test_rows_heard_at_the_reference_instant_keep_their_own_covariance(rng: np.random.Generator) -> None:
    site = make_site(BEACONS)
    epoch = make_epoch(site, Drive((4.0, 3.0, 1.0)), rate_sd_mps=0.05)
    full = rng.standard_normal((3, 3))
    epoch = replace(epoch, covariance_m2=full @ full.T)
    links = link(site, epoch.emitter, epoch.receiver)
    rows = np.array([2, 0])
    covariance, rates = row_noise(epoch, links, rows, np.zeros(2))
    np.testing.assert_allclose(covariance, epoch.covariance_m2[np.ix_(rows, rows)])
    np.testing.assert_allclose(rates, 0.05**2 * np.eye(2))


def test_an_acceleration_grows_with_time_for_rates_and_its_square_for_ranges() -> None:
    site = make_site(BEACONS)
    epoch = make_epoch(site, Drive((4.0, 3.0, 1.0)), sd_m=0.01, rate_sd_mps=0.05)
    links = link(site, epoch.emitter, epoch.receiver)
    dt = np.array([-0.2, 0.0, 0.1])
    covariance, rates = row_noise(epoch, links, np.arange(3), dt)
    np.testing.assert_allclose(np.diag(covariance), 0.01**2 + (MANOEUVRE_MPS2 * dt**2 / 2) ** 2)
    np.testing.assert_allclose(rates, np.diag(0.05**2 + (MANOEUVRE_MPS2 * dt) ** 2))


def test_a_misplaced_beacon_errs_alike_for_all_who_hear_it() -> None:
    site = make_site(BEACONS, arms_m=ARMS, position_sd_m=0.03)
    epoch = make_epoch(site, Drive((4.0, 3.0, 1.0)), sd_m=0.01)
    assert epoch.emitter == ("B0", "B0", "B1", "B1", "B2", "B2")
    links = link(site, epoch.emitter, epoch.receiver)
    covariance, rates = row_noise(epoch, links, np.arange(6), np.zeros(6))
    expected = 0.01**2 * np.eye(6) + 0.03**2 * np.kron(np.eye(3), np.ones((2, 2)))
    np.testing.assert_allclose(covariance, expected)
    assert rates is None
