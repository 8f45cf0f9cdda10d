"""The bank of replicas: dense enough in range rate, of unit energy, and each stretched as its rate says."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.acquire.bank import LOSS_DB, Bank, make_bank, velocity_step_mps
from sonofix.acquire.baseband import Band, band_limited, design_band
from sonofix.records import Floats
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SPEED = 343.2
SIGNALS = {
    "511 chips at 40 kHz": (9, [4], {"carrier_hz": 40e3, "cycles_per_chip": 10, "bandwidth_hz": 4e3}, 192e3),
    "127 chips, wide": (7, [6], {"carrier_hz": 15e3, "cycles_per_chip": 3, "bandwidth_hz": 8e3}, 48e3),
    "63 chips, bpsk": (6, [5], {"carrier_hz": 15e3, "cycles_per_chip": 8, "modulation": "bpsk"}, 48e3),
}


@pytest.fixture(params=list(SIGNALS))
def made(request: pytest.FixtureRequest) -> tuple[Bank, Band]:
    degree, taps, signal, rate_hz = SIGNALS[request.param]
    waveform = keyed_waveform(codes.m_sequence(degree, taps), Signal.model_validate(signal))
    band = design_band([waveform], rate_hz)
    return make_bank("A", band_limited(waveform, band), band, 3.0, SPEED), band


def heard(bank: Bank, band: Band, range_rate_mps: float) -> np.ndarray:
    """A burst of this range rate on the replicas' own sample grid."""
    w = bank.waveform
    u = np.arange(bank.replicas.shape[1]) / band.rate_hz - bank.lead_s - w.duration_s / 2
    beta = range_rate_mps / SPEED
    tau = w.duration_s / 2 + (1 - beta) * u
    values = sample(w.signature, w.rate_hz, w.start_s, tau) * np.exp(-2j * np.pi * w.carrier_hz * beta * u)
    return values / np.linalg.norm(values)


def loss_db(bank: Bank, band: Band, rates: Floats) -> Floats:
    """Loss of correlation power against the best replica, the arrival known."""
    matches = [np.abs(np.conj(bank.replicas) @ heard(bank, band, rate)).max() for rate in rates]
    return -20 * np.log10(np.array(matches))


def test_no_range_rate_loses_more_than_stated(made: tuple[Bank, Band]) -> None:
    bank, band = made
    loss = loss_db(bank, band, np.linspace(-3.0, 3.0, 301))
    assert loss.max() <= LOSS_DB
    # nor is the bank much denser than that needs
    assert len(bank.range_rate_mps) == 1 or loss.max() > 0.8 * LOSS_DB


def test_replicas_are_bursts_at_their_own_rates(made: tuple[Bank, Band]) -> None:
    bank, band = made
    assert loss_db(bank, band, bank.range_rate_mps).max() < 1e-5
    np.testing.assert_allclose(np.linalg.norm(bank.replicas, axis=1), 1.0, rtol=1e-5)
    assert (np.diff(bank.range_rate_mps) > 0).all()
    assert bank.range_rate_mps[len(bank.range_rate_mps) // 2] == 0.0
    assert bank.range_rate_mps[-1] + velocity_step_mps(bank.waveform, SPEED) / 2 >= 3.0


def test_energy_is_that_of_base_band_samples(made: tuple[Bank, Band]) -> None:
    bank, band = made
    w = bank.waveform
    tau = np.arange(bank.replicas.shape[1]) / band.rate_hz - bank.lead_s
    values = sample(w.signature, w.rate_hz, w.start_s, tau)
    assert bank.energy == pytest.approx(float(np.sum(np.abs(values) ** 2)), rel=1e-3)


def test_a_standing_source_needs_one_replica(made: tuple[Bank, Band]) -> None:
    bank, band = made
    assert make_bank("A", bank.waveform, band, 0.0, SPEED).range_rate_mps.tolist() == [0.0]


@pytest.mark.parametrize("made", ["511 chips at 40 kHz"], indirect=True)
def test_envelope_must_be_stretched(made: tuple[Bank, Band]) -> None:
    """At 3 m/s a replica that is shifted in frequency alone misses chips: 4 of 511, which costs the search dearly."""
    bank, band = made
    w = bank.waveform
    u = np.arange(bank.replicas.shape[1]) / band.rate_hz - bank.lead_s - w.duration_s / 2
    shifted = sample(w.signature, w.rate_hz, w.start_s, u + w.duration_s / 2)
    shifted = shifted * np.exp(-2j * np.pi * w.carrier_hz * 3.0 / SPEED * u) / np.linalg.norm(shifted)
    assert np.abs(np.vdot(shifted, heard(bank, band, 3.0))) ** 2 < 0.5


def test_spectra_are_those_of_the_replicas(made: tuple[Bank, Band]) -> None:
    bank, _ = made
    length = 2 * bank.replicas.shape[1]
    expected = np.conj(np.fft.fft(bank.replicas, length, axis=-1))
    np.testing.assert_allclose(bank.spectra(length), expected, atol=1e-4)
    assert bank.spectra(length) is bank.spectra(length)
