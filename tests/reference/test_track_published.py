"""The constant-velocity filter against published closed forms: Bar-Shalom, Li, Kirubarajan, Estimation (2001)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from locate.made_epochs import Drive, make_epoch, make_site
from sonofix.geometry import link
from sonofix.track.belief import Belief, Motion, blank, predict
from sonofix.track.update import update

FAR_M = 1e7


def still(covariance: np.ndarray) -> Belief:
    """A vehicle believed at the origin, moving along x alone: what a filter of one axis sees."""
    empty = blank(make_site([(FAR_M, 0.0, 0.0)], level_m=0.0))
    full, free = empty.covariance.copy(), empty.free.copy()
    full[np.ix_([0, 4], [0, 4])] = covariance
    free[[0, 4]] = True
    return replace(empty, covariance=full, free=free, placed=np.ones(1, bool))


@pytest.mark.parametrize("period_s", [0.1, 0.5, 2.0])
def test_process_noise_of_discretised_white_acceleration(period_s: float) -> None:
    # eq 6.2.2-12: Q = q̃ [[T³/3, T²/2], [T²/2, T]]
    aged = predict(still(np.zeros((2, 2))), period_s, Motion(acceleration_psd=0.3))
    published = 0.3 * np.array([[period_s**3 / 3, period_s**2 / 2], [period_s**2 / 2, period_s]])
    np.testing.assert_allclose(aged.covariance[np.ix_([0, 4], [0, 4])], published, rtol=1e-12)


@pytest.mark.parametrize("index", [0.01, 0.1, 1.0, 5.0])
def test_steady_state_gains_are_those_of_the_alpha_beta_filter(index: float) -> None:
    # section 6.5.3: with λ² = q̃ T³ / σ², the steady gains (α, β / T) fulfil λ² = β² / (1 − α), α = √(2β + β²/12) − β/2
    period_s, sd_m = 0.5, 0.1
    motion = Motion(acceleration_psd=index**2 * sd_m**2 / period_s**3)

    def alpha_of(beta: float) -> float:
        return float(np.sqrt(2 * beta + beta**2 / 12) - beta / 2)

    # λ² grows with β from 0 to infinity, where α reaches 1: β = 3 − √3 there
    beta = brentq(lambda b: b**2 - index**2 * (1 - alpha_of(b)), 1e-9, 3 - np.sqrt(3) - 1e-12, xtol=1e-15)
    site = make_site([(FAR_M, 0.0, 0.0)], level_m=0.0)
    belief = still(np.eye(2))
    for k in range(1, 400):
        epoch = make_epoch(site, Drive((0.0, 0.0, 0.0)), k * period_s, sd_m=sd_m)
        belief = predict(belief, k * period_s, motion)
        belief, used, *_ = update(belief, epoch, link(site, epoch.emitter, epoch.receiver), np.ones(1, bool))
        assert used.all()
    # the gain is P⁺ Hᵀ / σ²
    gain = belief.covariance[[0, 4], 0] / sd_m**2
    np.testing.assert_allclose(gain, [alpha_of(beta), beta / period_s], rtol=1e-6)
