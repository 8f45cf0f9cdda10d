"""Integrity against closed forms, plain NumPy, and simulation of the linear model it is about."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import binom, ncx2

from locate.made_epochs import BOUNDS, HALL, Drive, make_epoch, make_site, rows_of, shifted
from sonofix.locate.fix import fix
from sonofix.locate.integrity import (
    FALSE_ALARM,
    minimum_detectable_bias,
    noncentrality,
    protection_levels,
    slopes,
    threshold,
)
from sonofix.locate.many import fix_many
from sonofix.records import Floats

PLACE = (3.0, 5.5, 1.1)


def model(rng: np.random.Generator, m: int = 9, k: int = 3) -> tuple[Floats, Floats]:
    """A Jacobian and a full covariance."""
    root = rng.standard_normal((m, m))
    return rng.standard_normal((m, k)), 1e-4 * (root @ root.T / m + 0.3 * np.eye(m))


def plain(jacobian: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """A and P as the formulas have them."""
    weight = np.linalg.inv(covariance)
    gain = np.linalg.solve(jacobian.T @ weight @ jacobian, jacobian.T @ weight)
    return gain, weight - weight @ jacobian @ gain


@pytest.mark.parametrize("degrees", [1, 2, 6, 20])
@pytest.mark.parametrize("missed", [1e-3, 1e-7])
def test_the_noncentrality_misses_as_often_as_asked(degrees: int, missed: float) -> None:
    found = noncentrality(degrees, 1e-5, missed)
    assert ncx2.cdf(threshold(degrees, 1e-5), degrees, found) == pytest.approx(missed, rel=1e-6)


def test_a_mean_of_two_is_a_closed_form() -> None:
    # one unknown seen twice: P = ((1, −1), (−1, 1)) / 2σ², so that λ = b² / 2σ², and half a bias enters the mean
    sd = 0.02
    least = minimum_detectable_bias(np.ones((2, 1)), sd**2 * np.eye(2))
    np.testing.assert_allclose(least, sd * np.sqrt(2 * noncentrality(1)), rtol=1e-9)
    np.testing.assert_allclose(slopes(np.ones((2, 1)), sd**2 * np.eye(2), [0]), sd / np.sqrt(2), rtol=1e-9)


def test_slopes_and_least_biases_match_plain_algebra(rng: np.random.Generator) -> None:
    jacobian, covariance = model(rng)
    gain, seen = plain(jacobian, covariance)
    np.testing.assert_allclose(
        minimum_detectable_bias(jacobian, covariance), np.sqrt(noncentrality(6) / np.diag(seen)), rtol=1e-7
    )
    want = np.linalg.norm(gain[:2], axis=0) / np.sqrt(np.diag(seen))
    np.testing.assert_allclose(slopes(jacobian, covariance, [0, 1]), want, rtol=1e-7)


@pytest.mark.parametrize("faults", [1, 2])
@pytest.mark.parametrize("together", [1, 2])
def test_no_bias_whatever_beats_the_level(faults: int, together: int, rng: np.random.Generator) -> None:
    jacobian, covariance = model(rng, 10)
    gain, seen = plain(jacobian, covariance)
    groups = np.arange(10).reshape(together, -1).T
    risk = 1e-3
    hpl, vpl = protection_levels(jacobian, covariance, (0, 1), 2, risk=risk, groups=groups, faults=faults)
    sd = np.sqrt(np.linalg.eigvalsh((gain @ covariance @ gain.T)[:2, :2])[-1])
    limit, worst = threshold(7), 0.0
    for chosen in combinations(groups.tolist(), faults):
        rows = np.concatenate(chosen)
        for _ in range(20):
            bias = np.zeros(10)
            bias[rows] = rng.standard_normal(len(rows))
            away = np.linalg.norm(gain[:2] @ bias) / np.sqrt(bias @ seen @ bias)
            for root in np.linspace(0.0, 12.0, 60):
                passes = ncx2.cdf(limit, 7, root**2) if root else 1.0
                left = (hpl - away * root) / sd
                beyond = 1.0 if left <= 0 else np.exp(-(left**2) / 2)
                worst = max(worst, passes * beyond)
    assert worst <= risk
    assert vpl is not None
    assert vpl > 0


def test_levels_widen_with_less_risk_more_faults_and_more_choices(rng: np.random.Generator) -> None:
    jacobian, covariance = model(rng)

    def hpl(**asked: float) -> float:
        return protection_levels(jacobian, covariance, (0, 1), **asked)[0]  # type: ignore[arg-type]

    assert hpl() < hpl(faults=2)
    assert hpl(risk=1e-5) < hpl() < hpl(selections=40)
    assert hpl(fault_probability=0.0) < hpl(fault_probability=1e-4) < hpl()
    # nothing but noise: the longer axis of the ellipse at its quantile
    gain, _ = plain(jacobian, covariance)
    sd = np.sqrt(np.linalg.eigvalsh((gain @ covariance @ gain.T)[:2, :2])[-1])
    assert hpl(fault_probability=0.0) == pytest.approx(sd * np.sqrt(-2 * np.log(1e-7)), rel=1e-6)


def test_levels_do_not_change_with_units_or_the_order_of_rows(rng: np.random.Generator) -> None:
    jacobian, covariance = model(rng)
    hpl, vpl = protection_levels(jacobian, covariance, (0, 1), 2)
    order = rng.permutation(len(jacobian))
    again = protection_levels(jacobian[order], covariance[np.ix_(order, order)], (0, 1), 2)
    np.testing.assert_allclose(again, (hpl, vpl), rtol=1e-8)
    scale = np.diag(rng.uniform(0.1, 10.0, len(jacobian)))
    again = protection_levels(scale @ jacobian, scale @ covariance @ scale, (0, 1), 2)
    np.testing.assert_allclose(again, (hpl, vpl), rtol=1e-7)


def test_what_cannot_be_checked_is_infinite() -> None:
    two = np.eye(2)
    assert np.isinf(minimum_detectable_bias(two, np.eye(2))).all()
    assert protection_levels(two, np.eye(2), (0, 1)) == (np.inf, None)
    # the third row alone tells of y: its bias never shows, those of the others do
    lone = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert np.isfinite(minimum_detectable_bias(lone, np.eye(3))).tolist() == [True, True, False]
    assert protection_levels(lone, np.eye(3), (0, 1))[0] == np.inf
    # an unknown that no row tells of
    assert protection_levels(np.ones((4, 2)), np.eye(4), (0, 1))[0] == np.inf


@pytest.mark.parametrize(
    ("asked", "word"),
    [({"risk": 0.0}, "risk"), ({"fault_probability": 2.0}, "fault_prob"), ({"false_alarm_rate": 1.0}, "false")],
)
def test_what_is_no_probability_is_named(asked: dict, word: str, rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match=word):
        protection_levels(*model(rng), (0, 1), **asked)
    with pytest.raises(ValueError, match="missed"):
        minimum_detectable_bias(*model(rng), missed_rate=0.0)
    with pytest.raises(np.linalg.LinAlgError, match="positive"):
        minimum_detectable_bias(np.ones((2, 1)), np.zeros((2, 2)))


# --- in a fix ---------------------------------------------------------------------------------------------------------


def test_a_fix_tells_its_levels() -> None:
    site = make_site(HALL)
    found = fix(make_epoch(site, Drive(PLACE)), site, "v")
    anchors = np.array(HALL)
    unit = (np.array(PLACE) - anchors) / np.linalg.norm(np.array(PLACE) - anchors, axis=1)[:, None]
    hpl, vpl = protection_levels(unit, 1e-4 * np.eye(6), (0, 1), 2, selections=2)
    assert found.hpl_m == pytest.approx(hpl, rel=1e-6)
    assert found.vpl_m == pytest.approx(vpl, rel=1e-6)
    level = make_site(HALL, level_m=PLACE[2])
    found = fix(make_epoch(level, Drive(PLACE)), level, "v")
    assert found.vpl_m is None
    assert 4 * found.sd("x") < found.hpl_m < 1.0


def test_levels_grow_by_what_was_left_out(rng: np.random.Generator) -> None:
    site = make_site((*HALL, (0.0, 4.0, 1.5), (10.0, 4.0, 2.9)))
    good = make_epoch(site, Drive(PLACE), rng=rng)
    levels = [
        fix(epoch, site, "v").hpl_m for epoch in (good, shifted(good, 1, 2.0), shifted(shifted(good, 1, 2.0), 4, 3))
    ]
    assert levels[0] < levels[1] < levels[2]


def test_nothing_left_to_check_by_has_no_level() -> None:
    site = make_site(HALL, bounds_m=BOUNDS)
    found = fix(rows_of(make_epoch(site, Drive(PLACE)), [0, 1, 2]), site, "v")
    assert found.status == "ok"
    assert found.hpl_m is found.vpl_m is None


def test_a_level_holds_the_mirror_that_one_wrong_range_could_choose() -> None:
    # three beacons along the south wall and one off it: without that one, north and south of the wall look alike
    site = make_site([(1.0, 2.0, 3.0), (5.0, 2.0, 2.0), (9.0, 2.0, 3.0), (5.0, 8.0, 2.5)], level_m=1.0, bounds_m=BOUNDS)
    found = fix(make_epoch(site, Drive((4.0, 3.2, 1.0))), site, "v")
    assert found.status == "ok"
    assert 2.4 < found.hpl_m < 3.0
    # a wrong range of just that much does choose it, and nothing tells
    wrong = make_epoch(site, Drive((4.0, 3.2, 1.0)))
    off = np.linalg.norm((4.0, 0.8 - 8.0, 1.0 - 2.5) - np.array([5.0, 0.0, 0.0]))
    wrong = replace(wrong, range_m=np.append(wrong.range_m[:3], off))
    found = fix(wrong, site, "v")
    assert found.status == "ok"
    assert found.position_m[1] == pytest.approx(0.8, abs=0.01)
    assert found.hpl_m > 2.4


def test_ranges_without_fault_alarm_as_seldom_as_stated(rng: np.random.Generator) -> None:
    epochs, sd_m, asked = 100_000, 0.01, 1e-3
    places = np.column_stack([rng.uniform((0.5, 0.5), (9.5, 7.5), (epochs, 2)), np.full(epochs, PLACE[2])])
    ranges = np.linalg.norm(places[:, None] - np.array(HALL), axis=2) + sd_m * rng.standard_normal((epochs, 6))
    found = fix_many(HALL, ranges, np.full(6, sd_m**2), level_m=PLACE[2])
    alarms = np.count_nonzero((found.status != 0) | ~found.used.all(axis=1))
    assert alarms <= binom.ppf(1 - 1e-6, epochs, FALSE_ALARM) < asked * epochs


@pytest.mark.parametrize(("beacons", "level_given"), [(20, True), (40, False)])
def test_too_many_ways_to_be_wrong_give_no_level(beacons: int, level_given: bool, rng: np.random.Generator) -> None:
    # three wrong ranges left out: 680 ways for three more among 17, 7770 among 37
    site = make_site(rng.uniform((0, 0, 0), (10, 8, 3.2), (beacons, 3)), level_m=PLACE[2])
    epoch = make_epoch(site, Drive(PLACE), rng=rng)
    for row, by_m in ((2, 1.0), (7, 4.0), (11, -2.0)):
        epoch = shifted(epoch, row, by_m)
    found = fix(epoch, site, "v")
    assert found.status == "ok"
    assert np.flatnonzero(~found.used).tolist() == [2, 7, 11]
    assert (found.hpl_m is not None) == level_given


def test_more_ways_than_are_looked_at_are_not_listed(rng: np.random.Generator) -> None:
    jacobian = rng.standard_normal((60, 3))
    # 60 over 30 is 1e17: only a count can tell
    assert protection_levels(jacobian, np.eye(60), (0, 1), 2, faults=30) == (np.inf, np.inf)
    # where there is no fault, there is nothing to choose
    assert protection_levels(jacobian, np.eye(60), (0, 1), faults=30, fault_probability=0.0)[0] < np.inf
