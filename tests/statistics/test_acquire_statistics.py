"""Does the receiver keep its statistical promises? Fisher's bound, stated deviations, near and far, false alarms.

Each trial draws delay, phase and range rate anew. Intervals hold with a probability of 0.9999 for the number of
trials; `test_acquire_tables` runs the long versions, for `make prove`.
"""

from __future__ import annotations

import numpy as np
import pytest
from made_bursts import ACCELERATION_SD_MPS2, RATE_HZ, Case, Sound, bound, many, model, noise_for, waveforms
from scipy.stats import binom, chi2

from sonofix.acquire.baseband import SHARE

MISS = 1e-4
"""Probability that a sound receiver fails one of these."""

LOST = 1.005 / np.sqrt(SHARE)
"""By the standard deviation: the pass band holds this share of what carries the delay; a little more folds."""

SPREAD_30_DB = tuple(np.linspace(0.0, 30.0, 6).tolist())
WARM_M = 0.1
INSIDE = {1: 0.6827, 2: 0.9545, 3: 0.9973}
"""Share of normal errors within so many deviations."""


def rms_interval(count: int) -> tuple[float, float]:
    """Within which the rms of so many standard normal errors lies, but for `MISS`: from χ² of ``count`` degrees."""
    low, high = chi2.ppf([MISS / 2, 1 - MISS / 2], count)
    return float(np.sqrt(low / count)), float(np.sqrt(high / count))


def most(count: int, probability: float) -> int:
    """Number that is exceeded with probability `MISS` at most where each of ``count`` happens with ``probability``."""
    return int(binom.ppf(1 - MISS, count, probability))


def fewest(count: int, probability: float) -> int:
    return int(binom.ppf(MISS, count, probability))


@pytest.mark.parametrize("degree", [8, 9])
def test_bound_is_the_closed_form_where_that_holds(degree: int) -> None:
    """Delay of a burst at rest, by its mean square bandwidth B² about its mean frequency (Kay 1993, section 3.11).

    With real noise σ² a sample, E the energy of the real samples and an unknown phase: 1 / Var = (2π)² B² E / σ². Range
    rate and acceleration turn the carrier, and hardly touch the delay that the code tells.
    """
    w = waveforms(degree)["A"]
    noise_sd = noise_for(degree, 10.0)
    time_s = np.arange(int((w.duration_s + 0.02) * RATE_HZ)) / RATE_HZ
    heard = model(degree, Sound("A", w.duration_s / 2 + 0.008, 0.0, 0.0, 1.0), time_s)
    energy = float(np.sum(heard.real**2))
    offset_hz = np.fft.fftfreq(len(w.envelope), 1 / w.rate_hz)
    power = np.abs(np.fft.fft(w.envelope)) ** 2
    mean_hz = np.sum(offset_hz * power) / np.sum(power)
    width_hz2 = np.sum((offset_hz - mean_hz) ** 2 * power) / np.sum(power)
    variance = noise_sd**2 / ((2 * np.pi) ** 2 * width_hz2 * energy)
    assert bound(degree, "A", 0.0, noise_sd)[0, 0] == pytest.approx(variance, rel=0.03)


@pytest.mark.parametrize(
    "case",
    [
        Case(8, 0.0),
        Case(8, -4.0, expected_m=WARM_M),
        Case(9, 0.0),
        Case(9, 30.0, rate_mps=3.0),
        Case(9, -4.0, expected_m=WARM_M),
    ],
    ids=lambda case: f"{case.degree}, {case.snr_db:g} dB, {'cold' if case.expected_m is None else 'warm'}",
)
def test_errors_reach_the_bound_and_are_stated_truly(case: Case) -> None:
    count = 140
    outcome = many(case, count, 1)
    found = int(outcome.found.sum())
    assert found >= fewest(count, 0.99)
    assert not outcome.wrong.any()
    low, high = rms_interval(found)
    over, deviations = outcome.over_bound(), outcome.over_stated()
    assert (over > low).all()
    assert (over < high * LOST).all()
    stated = np.sqrt(np.mean(deviations**2, axis=0))
    assert (stated > low).all()
    assert (stated < high).all()
    for within, share in INSIDE.items():
        inside = np.sum(np.abs(deviations) < within, axis=0)
        assert (inside >= fewest(found, share)).all()
        assert (inside <= most(found, share)).all()
    # the mean of n errors over their deviations is normal of deviation 1/sqrt(n)
    assert (np.abs(deviations.mean(axis=0)) < 4.0 / np.sqrt(found)).all()
    # both together, their correlation included: squared Mahalanobis distance of two degrees of freedom
    error, covariance = outcome.error[outcome.found], outcome.stated[outcome.found]
    whole = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    low, high = rms_interval(2 * found)
    assert low**2 < whole.mean() / 2 < high**2


@pytest.mark.parametrize("degree", [8, 9])
@pytest.mark.parametrize("expected_m", [None, WARM_M], ids=["cold", "warm"])
def test_six_beacons_thirty_decibels_apart(degree: int, expected_m: float | None) -> None:
    """Against each alone; two more of the plan are silent."""
    count = 32
    outcome = many(Case(degree, 0.0, SPREAD_30_DB, planned=8, expected_m=expected_m), count, 2)
    assert outcome.found.sum() >= fewest(6 * count, 0.99)
    assert not outcome.wrong.any()
    assert outcome.over_bound()[0] < 1.1 * rms_interval(6 * count)[1]
    assert outcome.alarms.sum() <= most(2 * count, 1e-3)


@pytest.mark.parametrize("stated", [1e-4, 1e-2])
def test_noise_alone_is_reported_no_oftener_than_stated(stated: float) -> None:
    count = 40
    cold = many(Case(8, 0.0, (), planned=4, false_alarm_rate=stated), count, 3)
    warm = many(Case(8, 0.0, (), planned=4, expected_m=WARM_M, false_alarm_rate=stated), count, 3)
    assert cold.alarms.sum() <= most(4 * count, stated)
    # a warm search that finds nothing looks everywhere, so it may be wrong twice
    assert warm.alarms.sum() <= most(4 * count, 2 * stated)


def test_warm_search_takes_no_cross_talk_for_a_silent_beacon() -> None:
    """Four others sound, 30 dB apart: there is cross-talk where the silent four are expected, until it is gone."""
    count = 60
    outcome = many(Case(8, 0.0, (0.0, 10.0, 20.0, 30.0), planned=8, expected_m=WARM_M), count, 6)
    assert outcome.alarms.sum() <= most(4 * count, 1e-3)
    assert outcome.wrong.sum() <= most(4 * count, 1e-3)


def test_what_is_found_below_threshold_is_the_burst() -> None:
    """Most go unheard at −8 dB with 255 chips; what is reported is what sounded, within 5 cm."""
    count = 100
    outcome = many(Case(8, -8.0), count, 4)
    assert 0 < outcome.found.sum() < count
    assert outcome.wrong.sum() <= most(count, 1e-3)


def test_acceleration_is_taken_for_what_the_receiver_allows() -> None:
    """A burst of 255 chips (64 ms) bent by one deviation of its prior is fitted as well as a straight one."""
    count = 60
    outcome = many(Case(8, 10.0, acceleration_mps2=ACCELERATION_SD_MPS2), count, 5)
    assert outcome.found.all()
    assert (outcome.over_bound() < 1.1 * rms_interval(count)[1]).all()
