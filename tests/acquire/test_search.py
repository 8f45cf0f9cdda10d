"""The search finds the true cell, where it is told to look, and rates it against the noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix.acquire.bank import Bank, make_bank, velocity_step_mps
from sonofix.acquire.baseband import Band, band_limited, design_band
from sonofix.acquire.search import Peak, mean_near, near, profile, search, search_near
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SPEED = 343.2
RATE_HZ = 48e3
SIGNAL = Signal(carrier_hz=15e3, cycles_per_chip=8, bandwidth_hz=3e3)
WAVEFORM = keyed_waveform(codes.m_sequence(7, [6]), SIGNAL)
BAND = design_band([WAVEFORM], RATE_HZ)
BANK = make_bank("A", band_limited(WAVEFORM, BAND), BAND, 3.0, SPEED)
OTHER = make_bank("B", band_limited(keyed_waveform(codes.m_sequence(7, [4]), SIGNAL), BAND), BAND, 3.0, SPEED)
COUNT = int(0.25 * BAND.rate_hz)
STEP_MPS = velocity_step_mps(BANK.waveform, SPEED)


def heard(bank: Bank, band: Band, begins_s: float, rate_mps: float, gain: complex = 1.0) -> NDArray[np.complex128]:
    """A burst in the base band whose first chip is heard at ``begins_s`` after sample 0 of it."""
    w, beta = bank.waveform, rate_mps / SPEED
    u = np.arange(COUNT) / band.rate_hz - begins_s - w.duration_s / 2
    tau = w.duration_s / 2 + (1 - beta) * u
    return gain * sample(w.envelope, w.rate_hz, w.start_s, tau) * np.exp(-2j * np.pi * w.carrier_hz * beta * u)


def look(baseband: NDArray[np.complex128], **how: object) -> Peak | None:
    arguments = {"opens_s": 0.0, "closes_s": 0.15, "known_s": [], "false_alarm_rate": 1e-4} | how
    which = search_near if "rates" in how else search
    return which(baseband, 0.0, BANK, BAND, **arguments)  # type: ignore[operator]


def found(baseband: NDArray[np.complex128], **how: object) -> Peak:
    peak = look(baseband, **how)
    assert peak is not None
    return peak


def noise(rng: np.random.Generator, power: float = 1.0) -> NDArray[np.complex128]:
    return np.sqrt(power / 2) * (rng.standard_normal(COUNT) + 1j * rng.standard_normal(COUNT))


def test_true_cell_is_found(rng: np.random.Generator) -> None:
    for _ in range(20):
        begins_s, rate = rng.uniform(5e-3, 0.13), rng.uniform(-3.0, 3.0)
        phase = np.exp(2j * np.pi * rng.uniform())
        peak = found(heard(BANK, BAND, begins_s, rate, 0.02 * phase) + noise(rng, 1e-5))
        assert abs(peak.range_rate_mps - rate) <= STEP_MPS / 2 * 1.2
        # between two cells of rate the middle stays, the first chip shifts by the rest of the stretch
        assert abs(peak.start_s - begins_s) <= 1.0 / BAND.rate_hz
        assert peak.power / peak.noise > peak.threshold


def test_burst_power_is_that_of_its_correlation() -> None:
    at = round(0.05 * BAND.rate_hz) / BAND.rate_hz
    peak = found(heard(BANK, BAND, at, 0.0, 0.3))
    # the replica is the signature, the burst all of it: their correlation is the signature's energy
    assert peak.power == pytest.approx(0.09 * BANK.energy, rel=0.03)
    assert peak.start_s == pytest.approx(at, abs=0.5 / BAND.rate_hz)


def test_only_the_interval_asked_for_is_searched(rng: np.random.Generator) -> None:
    both = heard(BANK, BAND, 0.03, 0.0) + heard(BANK, BAND, 0.10, 0.0, 0.2) + noise(rng, 1e-6)
    assert found(both).start_s == pytest.approx(0.03, abs=1e-4)
    assert found(both, opens_s=0.08).start_s == pytest.approx(0.10, abs=1e-4)
    assert found(both, opens_s=0.09, closes_s=0.11).start_s == pytest.approx(0.10, abs=1e-4)


def test_known_paths_are_passed_over(rng: np.random.Generator) -> None:
    both = heard(BANK, BAND, 0.03, 0.0) + heard(BANK, BAND, 0.10, 0.0, 0.7) + noise(rng, 1e-6)
    assert found(both, known_s=[0.03]).start_s == pytest.approx(0.10, abs=1e-4)
    assert found(both, known_s=[0.10]).start_s == pytest.approx(0.03, abs=1e-4)


def test_only_the_rates_asked_for_are_searched(rng: np.random.Generator) -> None:
    fast = heard(BANK, BAND, 0.05, 2.5) + noise(rng, 1e-6)
    assert found(fast).range_rate_mps == pytest.approx(2.5, abs=STEP_MPS * 0.6)
    assert found(fast, rates=(2.3, 2.7)).range_rate_mps == pytest.approx(2.5, abs=STEP_MPS * 0.6)
    assert found(fast, rates=(-1.0, 0.0)).range_rate_mps <= STEP_MPS
    assert found(fast, rates=(-1.0, 0.0)).power < 0.3 * found(fast, rates=(2.3, 2.7)).power
    # beyond the bank its last row is all there is
    assert found(fast, rates=(9.0, 10.0)).range_rate_mps == BANK.range_rate_mps[-1]


def test_profile_is_the_highest_of_plain_correlations(rng: np.random.Generator) -> None:
    stretch = heard(BANK, BAND, 0.05, 1.0, 0.1)[:900] + noise(rng, 1e-3)[:900]
    count = len(stretch) - BANK.replicas.shape[1] + 1
    best, row, _ = profile(stretch, BANK, count)
    windows = np.lib.stride_tricks.sliding_window_view(stretch, BANK.replicas.shape[1])
    plain = np.abs(np.conj(BANK.replicas) @ windows.T) ** 2
    np.testing.assert_allclose(best, plain.max(axis=0), rtol=1e-3)
    np.testing.assert_allclose(plain[row, np.arange(count)], plain.max(axis=0), rtol=1e-3)


@pytest.mark.parametrize("rate", [-2.0, 0.1, 2.6])
def test_near_search_finds_what_the_whole_search_finds(rate: float, rng: np.random.Generator) -> None:
    samples = heard(BANK, BAND, 0.0503, rate, 0.1) + noise(rng, 1e-4)
    whole = found(samples)
    part = found(samples, opens_s=0.048, closes_s=0.052, rates=(rate - 0.5, rate + 0.5))
    assert part.start_s == pytest.approx(whole.start_s, abs=1.1 / BAND.rate_hz)
    assert abs(part.range_rate_mps - whole.range_rate_mps) <= 1.1 * STEP_MPS
    assert 0.8 * whole.power < part.power < 1.05 * whole.power


@pytest.mark.parametrize("rows", [(0, 9), (20, 21), (14, 40)])
def test_parts_put_together_are_the_plain_correlations(rows: tuple[int, int], rng: np.random.Generator) -> None:
    low, high = min(rows[0], len(BANK.replicas) - 2), min(rows[1], len(BANK.replicas))
    rate = float(np.mean(BANK.range_rate_mps[low:high])) + 0.3 * STEP_MPS
    samples = heard(BANK, BAND, 0.05, rate, 0.1) + noise(rng, 1e-5)
    first, count, length = round(0.045 * BAND.rate_hz), 60, BANK.replicas.shape[1]
    best, row = near(samples, first, count, BANK, low, high, BAND.rate_hz)
    windows = np.lib.stride_tricks.sliding_window_view(samples[first : first + count + length - 1], length)
    plain = np.abs(np.conj(BANK.replicas[low:high]) @ windows.T) ** 2
    top = plain.max()
    np.testing.assert_allclose(best, plain.max(axis=0), rtol=0.2, atol=0.02 * top)
    column = int(np.argmax(plain.max(axis=0)))
    assert int(np.argmax(best)) == column
    assert plain[row[column] - low, column] > 0.9 * top


def test_noise_is_told_from_its_median(rng: np.random.Generator) -> None:
    """Also where a burst stands in it: noise of power p has correlation power p against a unit replica."""
    band_noise = noise(rng, 0.01)
    for samples in (band_noise, band_noise + heard(BANK, BAND, 0.05, 0.0, 0.03)):
        # a few hundred independent cells tell the median to some percent
        assert found(samples).noise == pytest.approx(0.01, rel=0.3)


def test_threshold_is_that_of_exponential_power() -> None:
    """Of n cells none exceeds x by noise alone with probability 1 − n exp(−x): x = ln(n / p)."""
    samples = np.ones(COUNT, complex)
    sure, unsure = found(samples, false_alarm_rate=1e-6), found(samples, false_alarm_rate=1e-2)
    assert sure.threshold - unsure.threshold == pytest.approx(np.log(1e4))
    cells = np.exp(found(samples, false_alarm_rate=1.0).threshold)
    assert cells == pytest.approx(0.15 * BAND.rate_hz * len(BANK.range_rate_mps), rel=0.02)


def test_another_code_does_not_pass_for_this_one(rng: np.random.Generator) -> None:
    ours = found(heard(BANK, BAND, 0.05, 0.0) + noise(rng, 1e-6)).power
    theirs = found(heard(OTHER, BAND, 0.05, 0.0) + noise(rng, 1e-6)).power
    assert theirs < 10 ** (-6 / 10) * ours


def test_nothing_to_search_gives_nothing() -> None:
    samples = np.zeros(COUNT, complex)
    assert look(samples, opens_s=5.0, closes_s=6.0) is None
    assert look(samples, opens_s=-2.0, closes_s=-1.0) is None
    assert found(samples).power == 0.0


def test_power_as_a_code_hears_it(rng: np.random.Generator) -> None:
    """Noise has its own power; faint echoes of the code round a burst have more than their power tells."""
    quiet = noise(rng, 1e-3)
    around = (0.06, 0.0, 8e-3)
    # a hundred or so independent cells
    assert mean_near(quiet, 0.0, BANK, BAND, *around) == pytest.approx(1e-3, rel=0.4)
    echoes = quiet + sum(heard(BANK, BAND, 0.06 + delay, 0.0, 0.02) for delay in (2e-3, -3e-3, 5e-3))
    left = float(np.mean(np.abs(echoes) ** 2))
    assert mean_near(echoes, 0.0, BANK, BAND, *around) > 3 * left
