"""Least biases that a fix notices, against the linear model, closed forms and the test itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import ncx2

from locate.made_epochs import BOUNDS, HALL, Drive, make_epoch, make_site, shifted
from locate.made_tilts import CORNERS, Flight
from sonofix.locate.curved import tail
from sonofix.locate.detectable import detectable_biases
from sonofix.locate.fix import fix
from sonofix.locate.integrity import minimum_detectable_bias, noncentrality, threshold
from sonofix.records import Floats

PLACE = (3.0, 5.5, 1.1)


def unit(anchors: Floats, place: tuple[float, ...]) -> Floats:
    away = np.array(place) - anchors
    return away / np.linalg.norm(away, axis=1)[:, None]


@pytest.mark.parametrize("degrees", [1, 2, 6, 20])
@pytest.mark.parametrize("square", [50.0, 90.0])
def test_the_lower_tail_is_that_of_noncentral_chi2(degrees: int, square: float) -> None:
    want = ncx2.cdf(threshold(degrees), degrees, square)
    assert tail(threshold(degrees), degrees, square, np.zeros(2)) == pytest.approx(want, rel=0.03)


def test_the_lower_tail_with_bends_is_that_of_simulation(rng: np.random.Generator) -> None:
    trials, bends = 1_000_000, np.array([-0.6, 0.3])
    normal = rng.standard_normal((trials, 3))
    hits = np.count_nonzero((normal[:, 0] + np.sqrt(45.0)) ** 2 + normal[:, 1:] ** 2 @ bends < 16.0)
    # a count of 3000 to 6000 is good to five of its deviations, and the saddlepoint to a few parts in a hundred
    assert hits > 3000
    assert tail(16.0, 1, 45.0, bends) * trials == pytest.approx(hits, rel=0.03 + 5 / np.sqrt(hits))


def test_a_limit_above_the_mean_misses_all() -> None:
    assert tail(30.0, 2, 5.0, np.zeros(2)) == 1.0


def test_precise_ranges_are_as_good_as_straight() -> None:
    # the bend shrinks with the deviation: at 10 µm nothing is left of it
    site, sd_m = make_site(HALL, level_m=PLACE[2]), 1e-5
    epoch = make_epoch(site, Drive(PLACE), sd_m=sd_m)
    least_m, sure_m = detectable_biases(epoch, site, fix(epoch, site, "v"))
    straight_m = minimum_detectable_bias(unit(np.array(HALL), PLACE)[:, :2], epoch.covariance_m2)
    np.testing.assert_allclose(least_m, straight_m, rtol=5e-3)
    np.testing.assert_array_equal(least_m, sure_m)


def test_a_bias_to_the_other_crossing_hides() -> None:
    site = make_site(HALL[:3], level_m=PLACE[2])
    epoch = make_epoch(site, Drive(PLACE))
    found = fix(epoch, site, "v")
    least_m, sure_m = detectable_biases(epoch, site, found)
    # the mirror image in the line through the first two beacons, y = 0, on which the third is not
    mirror = np.array([PLACE[0], -PLACE[1], PLACE[2]])
    by_m = np.linalg.norm(mirror - HALL[2]) - epoch.range_m[2]
    assert least_m[2] < by_m <= sure_m[2] < by_m + 1.0
    hidden = fix(shifted(epoch, 2, by_m), site, "v")
    assert hidden.status == "ok"
    assert hidden.used.all()
    for bias_m in (1.001 * sure_m[2], (least_m[2] + by_m) / 2):
        assert fix(shifted(epoch, 2, bias_m), site, "v").status == "inconsistent"


def test_larger_biases_are_seldom_missed_and_smaller_ones_hide_more_often() -> None:
    site = make_site(HALL[:5])
    epoch = make_epoch(site, Drive(PLACE))
    found = fix(epoch, site, "v")
    rates = [1e-2, 5e-4, 1e-6]
    least = [detectable_biases(epoch, site, found, rate)[0] for rate in rates]
    assert (least[0] < least[1]).all()
    assert (least[1] < least[2]).all()


def test_rows_that_a_fix_leaves_out_have_none_and_the_rest_less_to_check_by(rng: np.random.Generator) -> None:
    site = make_site(HALL, bounds_m=BOUNDS)
    good = make_epoch(site, Drive(PLACE), rng=rng)
    bad = shifted(good, 3, 2.0)
    whole, part = (detectable_biases(e, site, fix(e, site, "v"))[0] for e in (good, bad))
    assert np.isnan(part[3])
    rest = np.arange(6) != 3
    # each shows less among fewer, though a test of two degrees of freedom asks for a little less than one of three
    asked = np.sqrt(noncentrality(2) / noncentrality(3))
    assert (part[rest] > 0.99 * asked * whole[rest]).all()
    assert part[0] > 1.5 * whole[0]


def test_without_a_range_to_spare_any_bias_hides() -> None:
    site = make_site(HALL[:3], bounds_m=((0, 0, 0), (10, 8, 2.5)))
    epoch = make_epoch(site, Drive(PLACE))
    found = fix(epoch, site, "v")
    assert found.position_m is not None
    assert np.isinf(detectable_biases(epoch, site, found)).all()


def test_bodies_that_tilt_and_rates_are_told_of_too(rng: np.random.Generator) -> None:
    site = make_site(HALL, arms_m=CORNERS)
    epoch = make_epoch(site, Flight(PLACE), sd_m=0.002, rng=rng)
    least_m, _ = detectable_biases(epoch, site, fix(epoch, site, "v"))
    assert ((least_m > 7 * 0.002) & (least_m < 0.1)).all()
    level = make_site(HALL[:4], level_m=PLACE[2])
    epoch = make_epoch(level, Drive(PLACE), rate_sd_mps=0.05)
    least_m, _ = detectable_biases(epoch, level, fix(epoch, level, "v"))
    assert ((least_m > 0.07) & (least_m < 0.3)).all()


def test_what_cannot_be_told_is_said() -> None:
    site = make_site(HALL)
    epoch = make_epoch(site, Drive(PLACE))
    found = fix(epoch, site, "v")
    with pytest.raises(ValueError, match="missed_rate 0"):
        detectable_biases(epoch, site, found, 0.0)
    with pytest.raises(ValueError, match="'too-few'"):
        detectable_biases(epoch, site, replace(found, status="too-few", position_m=None))
