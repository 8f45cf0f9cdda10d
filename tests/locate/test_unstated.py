"""Ranges without a stated deviation: what they leave over tells how good they are, and whether neighbours err alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import Drive, make_epoch, make_site
from sonofix.locate.fix import fix
from sonofix.locate.unstated import fix_by_residuals
from sonofix.ranging import flights_m
from sonofix.records import Fix, Floats, RangeEpoch
from sonofix.site import Site

PLACE = (3.0, 5.5, 1.1)
GROUPS = ((0, 0, 3.0), (10, 0, 2.4), (10, 8, 3.0), (0, 8, 2.4), (5, 0, 1.0), (5, 8, 0.2))
ANCHORS = tuple((x + 0.05 * k, y + 0.03 * k, z) for x, y, z in GROUPS for k in range(4))
SITE = make_site(ANCHORS)


def found(error_m: Floats, stated: bool = False, site: Site = SITE) -> Fix:
    def solve(epoch: RangeEpoch) -> tuple[Fix, ...]:
        return (fix(epoch, site, "v"),)

    epoch = make_epoch(site, Drive(PLACE), sd_m=0.1, stated=True)
    return fix_by_residuals(replace(epoch, range_m=epoch.range_m + error_m, sd_stated=stated), site, solve)[0]


def squares(got: Fix) -> float:
    assert got.position_m is not None
    assert got.covariance is not None
    miss = got.position_m - PLACE
    return float(miss @ np.linalg.solve(got.covariance[:3, :3], miss)) / 3


def test_a_deviation_that_is_stated_stays(rng: np.random.Generator) -> None:
    error = 0.01 * rng.standard_normal(24)
    loose, tight = found(error, stated=True), found(error)
    assert loose.sd("x") == pytest.approx(found(0 * error, stated=True).sd("x"), rel=0.01)
    assert (tight.sd("x") or 1.0) < 0.3 * (loose.sd("x") or 0.0)


def test_noise_that_rows_have_alone_is_found(rng: np.random.Generator) -> None:
    ratios = [squares(found(0.01 * rng.standard_normal(24))) for _ in range(60)]
    # F of 3 and 21 degrees: 21/19 in the mean, three deviations of 60 such beyond; chance correlation only widens
    assert 0.5 < np.mean(ratios) < 21 / 19 + 3 * 0.95 / np.sqrt(60)


def test_neighbours_that_err_alike_count_less(rng: np.random.Generator) -> None:
    ratios = [squares(found(np.repeat(0.02 * rng.standard_normal(6), 4))) for _ in range(60)]
    # six errors for three unknowns: F of 3 and 3 degrees, whose median is 1 (its mean has no bound); by rows it is 7
    assert 0.3 < np.median(ratios) < 2.0


@pytest.mark.parametrize("clock_m", [0.0, 35.0, 1700.0])
def test_a_clock_that_is_unknown_adds_no_doubt_of_the_sound_speed(clock_m: float, rng: np.random.Generator) -> None:
    site = make_site(ANCHORS, bounds_m=((-1.0, -1.0, 0.0), (11.0, 9.0, 4.0)))

    def solve(epoch: RangeEpoch) -> tuple[Fix, ...]:
        return (fix(epoch, site, "v"),)

    ratios = []
    for _ in range(20):
        epoch = make_epoch(site, Drive(PLACE), sd_m=0.1, stated=True, clock_m=clock_m, rng=None)
        flight_m = flights_m(epoch.range_m, True)
        epoch = replace(
            epoch,
            range_m=epoch.range_m + 0.01 * rng.standard_normal(24),
            covariance_m2=epoch.covariance_m2 + 0.01**2 * np.outer(flight_m, flight_m),
            sound_speed_sd_mps=0.01 * epoch.sound_speed_mps,
            sd_stated=False,
        )
        ratios.append(squares(fix_by_residuals(epoch, site, solve)[0]))
    assert 0.05 < np.mean(ratios) < 2.5
