"""What a fix says of its own quality, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site
from sonofix.locate.fix import fix

PLACE = (3.0, 5.5, 1.1)
TETRAHEDRON = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]) * 5.0


@pytest.mark.parametrize("clock_m", [None, 3.0])
def test_dilution_at_the_middle_of_a_tetrahedron(clock_m: float | None) -> None:
    # Σ uuᵀ = 4/3 I and Σ u = 0, so the clock costs nothing: HDOP² = 2 · 3/4, VDOP² = 3/4
    site = make_site(np.vstack([TETRAHEDRON, -TETRAHEDRON]))
    found = fix(make_epoch(site, Drive((0.0, 0.0, 0.0)), clock_m=clock_m), site, "v")
    np.testing.assert_allclose(found.position_m, 0.0, atol=1e-6)
    assert found.hdop == pytest.approx(np.sqrt(2 * 3 / 8), rel=1e-6)
    assert found.vdop == pytest.approx(np.sqrt(3 / 8), rel=1e-6)
    assert found.sd("x") == pytest.approx(0.01 * np.sqrt(3 / 8), rel=1e-6)
    assert found.sd("yaw") is None
    if clock_m is not None:
        assert found.sd("clock") == pytest.approx(0.01 / np.sqrt(8), rel=1e-6)


def test_dilution_is_that_of_ranges_alone_whatever_their_deviations() -> None:
    site = make_site(HALL)
    plain = make_epoch(site, Drive(PLACE), rate_sd_mps=0.02)
    rough = replace(plain, covariance_m2=np.diag(np.linspace(0.01, 0.3, 6) ** 2))
    a, b = fix(plain, site, "v"), fix(rough, site, "v")
    assert a.hdop == pytest.approx(b.hdop, rel=1e-6)
    assert a.vdop == pytest.approx(b.vdop, rel=1e-6)


def test_covariance_is_that_of_weighted_least_squares() -> None:
    site = make_site(HALL)
    sd = np.linspace(0.005, 0.03, 6)
    epoch = replace(make_epoch(site, Drive(PLACE)), covariance_m2=np.diag(sd**2))
    found = fix(epoch, site, "v")
    away = np.array(PLACE) - np.array(HALL)
    unit = away / np.linalg.norm(away, axis=1)[:, None] / sd[:, None]
    np.testing.assert_allclose(found.covariance, np.linalg.inv(unit.T @ unit), rtol=1e-5, atol=1e-9)


def test_a_guessed_beacon_place_widens_the_fix() -> None:
    # all ranges and all beacon places alike: variances add
    sure, guessed = make_site(HALL), make_site(HALL, position_sd_m=0.03)
    epoch = make_epoch(sure, Drive(PLACE), sd_m=0.04)
    wider = fix(epoch, guessed, "v")
    assert wider.status == "ok"
    expected = fix(replace(epoch, covariance_m2=0.05**2 * np.eye(6)), sure, "v").covariance
    np.testing.assert_allclose(wider.covariance, expected, rtol=1e-5)


def test_a_speed_error_that_all_ranges_share_widens_the_fix() -> None:
    # 1 % of every range together is one unknown scale: with it, sd must exceed that of independent rows
    site = make_site(HALL)
    epoch = make_epoch(site, Drive(PLACE))
    shared = epoch.covariance_m2 + 0.01**2 * np.outer(epoch.range_m, epoch.range_m)
    wide, plain = fix(replace(epoch, covariance_m2=shared), site, "v"), fix(epoch, site, "v")
    assert wide.status == plain.status == "ok"
    assert all((wide.sd(s) or 0) > (plain.sd(s) or 9) for s in "xyz")
