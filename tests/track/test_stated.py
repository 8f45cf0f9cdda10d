"""Ranges that others state: errors they share are found, outliers do no harm, and the deviation told stays true."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from locate.made_epochs import HALL, Drive, make_epoch, make_site
from sonofix.records import Floats
from sonofix.street import Street
from sonofix.track import stated
from sonofix.track.update import GATE_SIGMA

SITE = make_site(HALL)
PAIRS = tuple((b.id, m.id) for b in SITE.beacons for m in SITE.microphones)
COUNT, PERIOD_S, SD_M = 240, 0.25, 0.05


def circle(time_s: float) -> tuple[float, float, float]:
    return 5.0 + 2.5 * np.sin(0.3 * time_s), 4.0 - 2.0 * np.cos(0.3 * time_s), 1.1


def walked(
    errors_m: Floats, rng: np.random.Generator, claimed_m: float = SD_M
) -> tuple[Street, Floats, Floats, Floats]:
    """Drive round and round with so much (epochs, pairs) added to ranges.

    Returns the street, misses (n, 3, 2) of the track, its deviations, and of each epoch's fix; NaN where there is none.
    """
    street, told = Street(SITE), np.full((COUNT, 3, 2), np.nan)
    street.sense({}, stated=PAIRS)
    for k in range(COUNT):
        time_s = PERIOD_S * k + 0.05
        epoch = make_epoch(SITE, Drive(circle(time_s)), sd_m=SD_M, rng=rng, stated=True)
        heard = replace(
            epoch,
            time_s=np.full(len(PAIRS), time_s),
            sync_s=time_s,
            range_m=epoch.range_m + errors_m[k],
            covariance_m2=claimed_m**2 * np.eye(len(PAIRS)),
        )
        step = street.walk(heard)
        for got in step.estimates:
            told[k, 0] = (got.position_m - circle(time_s))[:2]
            told[k, 1] = np.sqrt(np.diag(got.covariance)[:2])
        for found in step.fixes:
            if found.position_m is not None:
                told[k, 2] = (found.position_m - circle(time_s))[:2]
    return street, told[:, 0], told[:, 1], told[:, 2]


def rms(miss: Floats) -> float:
    return float(np.sqrt(np.nanmean(np.sum(miss**2, axis=1))))


def honest(miss: Floats, sd: Floats) -> bool:
    return bool(np.mean(np.all(np.abs(miss) < 2 * sd, axis=1)) > 0.75)


def test_the_bias_of_each_pair_is_found_while_driving(rng: np.random.Generator) -> None:
    bias = np.array([0.25, -0.1, 0.1, 0.0, 0.2, 0.15])
    street, miss, sd, fixed = walked(np.tile(bias, (COUNT, 1)), rng)
    belief = street.follower.belief
    assert belief.inputs is not None
    slot = belief.inputs.range_slot
    at = stated.places(slot, np.arange(6), 6)[0]
    # ranges of about 6 m hardly tell a scale from a bias that all share: what both make of them is what is known
    weigh = np.zeros((6, len(belief.mean)))
    weigh[:, slot], weigh[:, slot + 1], weigh[np.arange(6), at] = 6.0, 1.0, 1.0
    found, told = weigh @ belief.mean, np.sqrt(np.diag(weigh @ belief.covariance @ weigh.T))
    assert np.all(np.abs(found - bias) < 4 * told + 0.05)
    assert rms(miss[120:]) < 0.7 * rms(fixed[120:])
    assert honest(miss[120:], sd[120:])


def test_outliers_of_many_metres_do_no_harm(rng: np.random.Generator) -> None:
    late = np.where(rng.random((COUNT, 6)) < 0.1, rng.uniform(2.0, 15.0, (COUNT, 6)), 0.0)
    _, clean, _, _ = walked(np.zeros((COUNT, 6)), np.random.default_rng(5))
    _, miss, _, _ = walked(late, np.random.default_rng(5))
    # a tenth of the ranges is gone: 5 % of deviation; the rest is what learning noise costs
    assert rms(miss[60:]) < 1.5 * rms(clean[60:])


def test_a_bias_that_all_share_is_found(rng: np.random.Generator) -> None:
    _, miss, sd, fixed = walked(np.full((COUNT, 6), 0.3), rng)
    assert rms(miss[120:]) < 0.7 * rms(fixed[120:])
    assert honest(miss[120:], sd[120:])


def test_noise_is_learnt_where_ranges_claim_too_little(rng: np.random.Generator) -> None:
    # whether an error of one range is noise or passes within two seconds is hardly told; how large it is, is
    street, miss, sd, _ = walked(np.zeros((COUNT, 6)), rng, claimed_m=0.02)
    trust = street.follower.belief.trust
    assert trust is not None
    learnt_m2 = trust.extra(np.arange(6)) + trust.variance[1]
    assert 0.5 * SD_M**2 < learnt_m2.mean() < 4 * SD_M**2
    assert honest(miss[60:], sd[60:])


def jumped(misses: Floats) -> tuple[stated.Trust, list[int]]:
    """Let innovations (epochs, pairs), in deviations, be heard one a second; return epochs in which pair 0 jumped."""
    known, when = stated.trust(misses.shape[1]), []
    pair = np.arange(misses.shape[1])
    for k, miss in enumerate(misses):
        known, found = known.heard(pair, miss, np.ones(len(miss)), np.full(len(miss), float(k)))
        assert not found[1:].any()
        when += [k] if found[0] else []
    return known, when


def test_a_pair_that_keeps_to_one_side_while_others_do_not_has_jumped(rng: np.random.Generator) -> None:
    misses = rng.standard_normal((60, 5))
    misses[30:38, 0] = 6.0
    known, when = jumped(misses)
    # six counts as two and a half: after noise that fades, k such make 25 (1 - 0.9^k), and 10.3 is a jump
    assert len(when) == 1
    assert 31 <= when[0] <= 37
    watched_s = 5 * 59.0
    assert known.lasting_s == pytest.approx((stated.LASTING_S + watched_s) / 2)


def test_neither_an_outlier_nor_a_vehicle_that_moves_is_a_jump(rng: np.random.Generator) -> None:
    misses = rng.standard_normal((60, 5))
    misses[30, 0] = 40.0
    misses[45:55] = 6.0
    known, when = jumped(misses)
    assert not when
    assert known.jumps == 0


def test_noise_alone_is_no_jump(rng: np.random.Generator) -> None:
    street, _, _, _ = walked(np.zeros((COUNT, 6)), rng)
    assert street.follower.belief.trust is not None
    assert street.follower.belief.trust.jumps == 0


def test_errors_that_last_seconds_are_taken_as_such(rng: np.random.Generator) -> None:
    # multipath of 0.2 m, correlated over 2 s: white noise of that size would be averaged away far too soon
    fade = np.exp(-PERIOD_S / 2.0)
    error = np.zeros((COUNT, 6))
    for k in range(1, COUNT):
        error[k] = fade * error[k - 1] + 0.2 * np.sqrt(1 - fade**2) * rng.standard_normal(6)
    _, miss, sd, _ = walked(error, rng)
    assert honest(miss[60:], sd[60:])


def test_whom_nothing_moves_is_followed_calmly(rng: np.random.Generator) -> None:
    street = Street(SITE)
    street.sense({}, stated=PAIRS)
    free = street.follower.motion.acceleration_psd
    for k in range(150):
        epoch = make_epoch(SITE, Drive((3.0, 5.0, 1.1)), PERIOD_S * k, sd_m=0.2, rng=rng, stated=True)
        street.walk(epoch)
    assert street.follower.motion.acceleration_psd < free / 5


@pytest.mark.parametrize("freedom", stated.FREEDOM)
def test_the_tail_of_noise_weighs_less_and_less(freedom: float) -> None:
    surprise = np.linspace(0.0, GATE_SIGMA**2, 50)
    factor = stated.heavier(surprise, freedom)
    pull = np.sqrt(surprise) / factor
    assert np.argmax(pull) < 45 or freedom > GATE_SIGMA**2
    # the factor is that of the t density's score: d/dz log p = -z (ν + 1) / (ν + z²)
    fisher = (freedom + 1.0) / (freedom + 3.0)
    assert fisher * factor == pytest.approx((freedom + surprise) / (freedom + 1.0))


def test_densities_are_those_of_student() -> None:
    z, sd = np.linspace(-8.0, 8.0, 33), 0.3
    told = stated.log_likelihood(np.tile(z**2, (2, 1)), np.full((2, len(z)), sd**2))
    for row, freedom in zip(told, stated.FREEDOM, strict=True):
        expected = student.logpdf(sd * z, freedom, scale=sd)
        np.testing.assert_allclose(row - row[0], expected - expected[0], atol=1e-12)
    np.testing.assert_allclose(
        told[0] - told[1], student.logpdf(z, stated.HEAVY) - student.logpdf(z, stated.LIGHT), atol=1e-12
    )


@pytest.mark.parametrize("heavy", [False, True])
def test_ranges_tell_what_tails_their_noise_has(heavy: bool, rng: np.random.Generator) -> None:
    """Noise of 0.15 m, or one range in twelve ten times as far off; what is told of the way stays true."""
    shape = (COUNT, len(PAIRS))
    noise = 0.15 * rng.standard_normal(shape) * np.where(rng.random(shape) < heavy / 12, 10.0, 1.0)
    street, miss, sd, _ = walked(noise, rng)
    trust = street.follower.belief.trust
    assert trust is not None
    assert trust.sizes is None
    assert (trust.freedom < 6.0) == heavy
    assert honest(miss, sd)


def test_errors_age_to_what_is_known_of_their_variance() -> None:
    known = stated.trust(3)
    n = stated.size(3)
    mean, covariance, free = np.zeros(n), np.zeros((n, n)), np.zeros(n, bool)
    stated.begin(mean, covariance, free, 0, np.full(3, np.nan))
    mean[stated.COMMON :] = 1.0
    covariance[stated.COMMON :, stated.COMMON :] *= 0.1
    stated.wander(mean, covariance, 0, known, 1e6)
    assert mean[stated.COMMON :] == pytest.approx(0.0)
    assert np.diag(covariance)[stated.COMMON :] == pytest.approx(stated.BEGIN_SD_M**2)
    assert free.all()


@pytest.mark.parametrize("gap_s", [10.0, 30.0, 60.0])
def test_after_silence_the_track_is_where_ranges_say(gap_s: float, rng: np.random.Generator) -> None:
    street = Street(SITE)
    street.sense({}, stated=PAIRS)
    off = []
    for k in range(60):
        time_s = PERIOD_S * k + 0.05 + (gap_s if k >= 40 else 0.0)
        epoch = make_epoch(SITE, Drive(circle(time_s)), sd_m=0.02, rng=rng, stated=True)
        epoch = replace(epoch, time_s=np.full(len(PAIRS), time_s), sync_s=time_s)
        for got in street.walk(epoch).estimates:
            if k >= 40:
                off.append(np.hypot(*(got.position_m[:2] - circle(time_s)[:2])))
                assert off[-1] < 5 * np.hypot(got.sd("x") or 0.0, got.sd("y") or 0.0)
    assert len(off) > 15
    assert np.median(off) < 0.05


def test_rows_far_off_by_what_others_say_weigh_little(rng: np.random.Generator) -> None:
    """Four rows of a place known to 2 m: the one that is 5 m late passes by itself, and would take the place along."""
    known = stated.trust(4)
    ways = np.array([[1.0, 0.0], [0.0, 1.0], [0.7, 0.7], [0.7, -0.7]])
    noise = np.full(4, 0.1**2)
    expected = 2.0**2 * ways @ ways.T + np.diag(noise)
    for late in range(4):
        miss = ways @ [0.5, -1.0] + 0.1 * rng.standard_normal(4)
        miss[late] += 5.0
        alone = known.weighed(np.arange(4), miss, expected.diagonal(), noise)[1]
        larger = known.together(miss, expected, noise, alone)
        gain = np.linalg.solve(expected + np.diag((larger - 1.0) * noise), 2.0**2 * ways).T
        assert np.hypot(*(gain @ miss - [0.5, -1.0])) < 0.5
        assert np.argmax(larger) == late
        straight = np.linalg.solve(expected + np.diag((alone - 1.0) * noise), 2.0**2 * ways).T
        assert np.hypot(*(straight @ miss - [0.5, -1.0])) > 1.0


def test_rows_that_agree_weigh_as_by_themselves(rng: np.random.Generator) -> None:
    known, ways, noise = stated.trust(4), rng.standard_normal((4, 2)), np.full(4, 0.1**2)
    expected = 2.0**2 * ways @ ways.T + np.diag(noise)
    miss = ways @ [0.5, -1.0]
    alone = known.weighed(np.arange(4), miss, expected.diagonal(), noise)[1]
    np.testing.assert_allclose(known.together(miss, expected, noise, alone), alone, rtol=0.35)
