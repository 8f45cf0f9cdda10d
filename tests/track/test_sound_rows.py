"""Rows that may each be true but not together: never a wrong place with a small covariance."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locate.made_epochs import HALL, Drive, make_epoch, make_site, rows_of, shifted
from sonofix.geometry import link
from sonofix.locate.fix import fix
from sonofix.records import Estimate, Floats, RangeEpoch
from sonofix.site import Site
from sonofix.track.belief import Belief, Nominal, blank
from sonofix.track.follow import Follower
from sonofix.track.sound_rows import Hypothesis, Peak, likely, limit, mixed, odd
from sonofix.track.update import GATE_SIGMA, update

PLACE = np.array([3.0, 5.5, 1.1])
FREE = np.array([0, 1, 2, 4, 5, 6])
PERIOD_S = 0.5
# what half a second of white acceleration leaves of a place: decimetres on the level, centimetres in height
PRIOR = np.diag([0.14, 0.14, 0.02, 0.5, 0.5, 0.07]) ** 2
FOUR = np.array([0, 1, 3, 4])


def believed(site: Site, mean: Floats, covariance: Floats = PRIOR) -> Belief:
    empty = blank(site)
    whole, full, free = empty.mean.copy(), empty.covariance.copy(), empty.free.copy()
    whole[FREE], full[np.ix_(FREE, FREE)], free[FREE] = np.append(mean, np.zeros(3)), covariance, True
    return Belief(0.0, whole, full, free, np.ones(1, bool))


def corrected(belief: Belief, epoch: RangeEpoch, site: Site) -> tuple[Belief, list[bool], Floats]:
    after, used, surprise, _ = update(
        belief, epoch, link(site, epoch.emitter, epoch.receiver), np.ones(len(epoch), bool)
    )
    return after, used.tolist(), surprise


def sigmas(belief: Belief, place: Floats = PLACE) -> float:
    miss = belief.mean[:3] - place
    return float(np.sqrt(miss @ np.linalg.solve(belief.covariance[:3, :3], miss)))


def four_heard(late_m: float, row: int, rng: np.random.Generator | None = None) -> tuple[Site, RangeEpoch]:
    """Four beacons of a hall, ranges of 2 mm, one of them late."""
    site = make_site(HALL)
    return site, shifted(rows_of(make_epoch(site, Drive(PLACE), sd_m=0.002, rng=rng), FOUR), row, late_m)


@pytest.mark.parametrize("row", range(4))
def test_an_echo_that_passes_alone_is_left_out_by_all_together(row: int, rng: np.random.Generator) -> None:
    site, epoch = four_heard(0.35, row, rng)
    before = believed(site, PLACE + [0.02, -0.03, 0.005])
    after, used, surprise = corrected(before, epoch, site)
    assert (surprise < GATE_SIGMA**2).all()
    assert used == [i != row for i in range(4)]
    without, _, _ = corrected(before, rows_of(epoch, np.delete(np.arange(4), row)), site)
    np.testing.assert_allclose(after.mean, without.mean, atol=1e-9)
    np.testing.assert_allclose(after.covariance, without.covariance, atol=1e-12)
    assert sigmas(after) < 4


def test_rows_that_may_all_be_true_enter_as_ever(rng: np.random.Generator) -> None:
    # twenty epochs of sound rows: the cost is chi-squared of as many degrees as there are rows, and none is doubted
    site = make_site(HALL)
    for _ in range(20):
        epoch = make_epoch(site, Drive(PLACE), sd_m=0.002, rng=rng)
        _, used, _ = corrected(believed(site, PLACE + 0.5 * np.sqrt(PRIOR.diagonal()[:3])), epoch, site)
        assert all(used)


def test_a_pushed_vehicle_is_believed_where_its_ranges_agree() -> None:
    # pushed along the wall by half a metre, three and a half deviations: no row is wrong, the prediction is
    site = make_site(HALL)
    epoch = make_epoch(site, Drive(PLACE), sd_m=0.002)
    after, used, surprise = corrected(believed(site, PLACE + [0.45, 0.3, 0.0]), epoch, site)
    assert (surprise < GATE_SIGMA**2).all()
    assert all(used)
    np.testing.assert_allclose(after.mean[:3], PLACE, atol=2e-3)


def test_what_cannot_be_decided_is_told_as_uncertain() -> None:
    # an open prediction and one row more than unknowns: each of four rows may be the wrong one
    site, epoch = four_heard(0.35, 1)
    after, _, _ = corrected(believed(site, PLACE + [0.02, -0.03, 0.01], PRIOR * 10), epoch, site)
    assert np.sqrt(np.trace(after.covariance[:3, :3])) > 0.05
    assert sigmas(after) < 3.5


def test_rows_that_gainsay_each_other_all_over_err_by_as_much_as_they_do(rng: np.random.Generator) -> None:
    # beacons put down by hand to 3 cm, and ranges that claim 1 mm
    hall = rng.uniform([0, 0, 0], [10, 8, 3.2], (12, 3))
    site = make_site(hall)
    epoch = make_epoch(make_site(hall + 0.03 * rng.standard_normal((12, 3))), Drive(PLACE), sd_m=0.001)
    after, used, _ = corrected(believed(site, PLACE), epoch, site)
    assert all(used)
    assert np.sqrt(after.covariance[0, 0]) > 0.005
    assert sigmas(after) < 4


def test_an_echo_comes_late_rather_than_another_row_early() -> None:
    # two rows by one line: that the one is late or the other early explains them alike
    site = make_site([(0.0, 0.0, 1.1), (10.0, 0.0, 1.1)], level_m=1.1)
    place = np.array([5.0, 0.001, 1.1])
    epoch = make_epoch(site, Drive(place), sd_m=0.002)
    before = replace(believed(site, place, np.diag([0.14, 0.001, 0.0, 0.0, 0.0, 0.0]) ** 2))
    heard = shifted(epoch, 0, 0.4)
    peaks = {}
    for kept in ((True, False), (False, True)):
        one = rows_of(heard, np.flatnonzero(kept))
        peaks[kept] = corrected(before, one, site)[0].mean[0]
    # left out: the late row puts the vehicle at 5.0, the sound one would put it at 5.4
    assert peaks[False, True] == pytest.approx(5.0, abs=1e-3)
    assert peaks[True, False] == pytest.approx(5.4, abs=1e-3)
    after, used, _ = corrected(before, heard, site)
    assert used == [False, True]
    assert abs(after.mean[0] - 5.0) < 0.1


def test_where_a_nominal_is_known_the_same_rows_are_believed() -> None:
    site, epoch = four_heard(0.35, 2)
    before = believed(site, PLACE + [0.02, -0.03, 0.005])
    first, used, _ = corrected(before, epoch, site)
    about = Nominal(np.zeros((0, len(first.mean))), np.where(first.free, first.mean, np.nan))
    again, same, _ = corrected(replace(before, about=about), epoch, site)
    assert same == used
    np.testing.assert_allclose(again.mean, first.mean, atol=1e-5)


# --- what hypotheses weigh --------------------------------------------------------------------------------------------


def linear_peak(
    rng: np.random.Generator, fault: Floats, pushed: float = 0.0
) -> tuple[Peak, Floats, Floats, Floats, Floats]:
    """A peak by five linear rows of three states about 0, with their derivative, noise and what they measured.

    ``pushed`` is how many deviations off all three states are.
    """
    half = rng.standard_normal((3, 3))
    before, derivative, noise = half @ half.T + np.eye(3), rng.standard_normal((5, 3)), np.diag([1e-4] * 5)
    state = np.linalg.cholesky(before) @ (rng.standard_normal(3) + pushed)
    measured = derivative @ state + 1e-2 * rng.standard_normal(5) + fault
    return solved(before, derivative, noise, measured), before, derivative, noise, measured


def solved(before: Floats, derivative: Floats, noise: Floats, measured: Floats) -> Peak:
    expected = derivative @ before @ derivative.T + noise
    gain = np.linalg.solve(expected, derivative @ before).T
    return Peak(gain @ measured, derivative, measured, expected, noise, gain)


def test_cost_is_what_a_state_costs_against_prediction_and_measurements(rng: np.random.Generator) -> None:
    peak, before, derivative, noise, measured = linear_peak(rng, np.zeros(5))
    left = measured - derivative @ peak.mean
    own = left @ np.linalg.solve(noise, left)
    assert peak.misfit[0] == pytest.approx(own, rel=1e-6)
    assert peak.misfit[1] == pytest.approx(5 - 3, abs=0.01)
    assert peak.cost == pytest.approx(own + peak.mean @ np.linalg.solve(before, peak.mean), rel=1e-6)


def test_cost_is_chi_squared_of_as_many_degrees_as_measurements(rng: np.random.Generator) -> None:
    costs = np.array([linear_peak(rng, np.zeros(5))[0].cost for _ in range(2000)])
    # mean 5 and variance 10, of 2000: five deviations
    assert costs.mean() == pytest.approx(5.0, abs=5 * np.sqrt(10 / 2000))
    assert np.count_nonzero([odd(linear_peak(rng, np.zeros(5))[0]) for _ in range(2000)]) == 0
    assert limit(5) == pytest.approx(35.9, abs=0.1)  # the 1 - 1e-6 quantile of chi-squared, 5 degrees


@pytest.mark.parametrize("wrong", [(), *combinations(range(5), 1)], ids=str)
def test_the_row_at_fault_or_the_prediction_is_found_among_linear_ones(
    wrong: tuple[int, ...], rng: np.random.Generator
) -> None:
    fault = np.zeros(5)
    fault[list(wrong)] = 0.7
    peak, before, derivative, noise, measured = linear_peak(rng, fault, 0.0 if wrong else 5.0)
    assert odd(peak)

    def solve(kept: Floats) -> Peak:
        return solved(before, derivative[kept], noise[np.ix_(kept, kept)], measured[kept])

    def look(mean: Floats) -> tuple[Floats, Floats, Floats]:
        return measured - derivative @ mean, derivative, noise.diagonal()

    found = likely(peak, 5, before, solve, look)
    assert np.flatnonzero(~found[0].kept).tolist() == list(wrong)


def test_mixed_hypotheses_hold_each_of_them(rng: np.random.Generator) -> None:
    # of two at the edge of what is undecided, the less likely is not left out by more than three and a half deviations
    peak, before, *_ = linear_peak(rng, np.zeros(5))
    other = replace(peak, mean=peak.mean + [1.0, 0.0, 0.0])
    pair = [Hypothesis(np.ones(5, bool), peak, 0.0), Hypothesis(np.ones(5, bool), other, 9.2)]
    mean, covariance = mixed(pair, before)
    for one in pair:
        off = one.peak.mean - mean
        assert off @ np.linalg.solve(covariance, off) < 3.5**2
    alone, own = mixed(pair[:1], before)
    np.testing.assert_allclose(alone, peak.mean)
    np.testing.assert_allclose(own, before - peak.gain @ peak.expected @ peak.gain.T, atol=1e-10)


# --- laws of whole tracks ---------------------------------------------------------------------------------------------


def off(got: Estimate, place: Floats) -> float:
    index = [got.states.index(s) for s in "xyz" if s in got.states]
    miss = (got.position_m - place)[: len(index)]
    return float(np.sqrt(miss @ np.linalg.solve(got.covariance[np.ix_(index, index)], miss)))


def heard(site: Site, drive: Drive, k: int, rates: bool, rng: np.random.Generator) -> RangeEpoch:
    times = PERIOD_S * k + 0.03 * rng.random(len(site.beacons))
    return make_epoch(site, drive, times, sd_m=0.002, rate_sd_mps=0.01 if rates else None, rng=rng)


@settings(max_examples=25)
@given(
    st.sampled_from([(4, True), (5, True), (5, False), (6, False)]),
    st.booleans(),
    st.floats(0.1, 3.0),
    st.integers(0, 2**32 - 1),
)
def test_a_track_is_never_surely_wrong_by_one_late_row(
    how: tuple[int, bool], rates: bool, late_m: float, seed: int
) -> None:
    (count, level), rng = how, np.random.default_rng(seed)
    place, angle = rng.uniform([3, 3, 0.3], [7, 5, 2]), rng.uniform(0, 2 * np.pi)
    fixed = np.array(HALL)[rng.permutation(6)[:count]] + rng.normal(0, 0.2, (count, 3))
    bounds = ((-1, -1, 0), (11, 9, 3.5))
    site = make_site(fixed, level_m=float(place[2]) if level else None, bounds_m=bounds)
    drive, follower, row = (
        Drive(place, (0.7 * np.cos(angle), 0.7 * np.sin(angle), 0.0)),
        Follower(site),
        rng.choice(count),
    )
    for k in range(8):
        epoch = heard(site, drive, k, rates, rng)
        if k >= 4:
            epoch = shifted(epoch, row, late_m)
        told, _, _ = follower.step(epoch, (fix(epoch, site, "v"),))
        assert k < 4 or all(off(one, drive.origin(one.time_s)) < 5 for one in told)


@pytest.mark.parametrize("pushed_m", [0.2, 0.4])
@pytest.mark.parametrize(("count", "level"), [(4, True), (6, True), (6, False)])
@pytest.mark.parametrize("rates", [False, True])
def test_a_pushed_vehicle_is_found_at_once(
    rates: bool, count: int, level: bool, pushed_m: float, rng: np.random.Generator
) -> None:
    site = make_site(HALL[:count], level_m=1.1 if level else None)
    for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        follower, velocity = Follower(site), (0.4, 0.3, 0.0)
        aside = pushed_m * np.array([np.cos(angle), np.sin(angle), 0.0])
        for k in range(7):
            drive = Drive(PLACE + [0, -1.5, 0] + aside * (k >= 4), velocity)
            epoch = heard(site, drive, k, rates, rng)
            (told,), used, events = follower.step(epoch, (fix(epoch, site, "v"),))
            if k >= 4:
                assert used.all()
                assert not events
                assert np.linalg.norm(told.position_m - drive.origin(told.time_s)) < 0.05
