"""Steady tones are found, followed and taken out; bursts and noise are not taken for tones."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix.acquire.baseband import band_limited, design_band
from sonofix.acquire.plan import acquire, make_plan
from sonofix.acquire.tones import find_tones, level_db, refit
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SPEED = 343.2
RATE_HZ = 16e3
COUNT = int(0.3 * RATE_HZ)
T = np.arange(COUNT) / RATE_HZ
SIGNAL = Signal(carrier_hz=15e3, cycles_per_chip=8, bandwidth_hz=3e3)
WAVEFORM = keyed_waveform(codes.m_sequence(7, [6]), SIGNAL)


def noise(rng: np.random.Generator, power: float) -> NDArray[np.complex128]:
    return np.sqrt(power / 2) * (rng.standard_normal(COUNT) + 1j * rng.standard_normal(COUNT))


def tone(offset_hz: float, amplitude: float, drift_hz_per_s: float = 0.0) -> NDArray[np.complex128]:
    return amplitude * np.exp(2j * np.pi * (offset_hz * T + drift_hz_per_s * T**2 / 2) + 0.4j)


def burst(amplitude: float) -> NDArray[np.complex128]:
    w = band_limited(WAVEFORM, design_band([WAVEFORM], 48e3))
    return amplitude * sample(w.envelope, w.rate_hz, w.start_s, T - 0.1)


@pytest.mark.parametrize("drift_hz_per_s", [0.0, 5.0, -5.0])
def test_a_tone_is_followed_through_the_epoch(drift_hz_per_s: float, rng: np.random.Generator) -> None:
    made = tone(713.0, 1.0, drift_hz_per_s)
    found = find_tones(made + noise(rng, 1e-4), RATE_HZ)
    assert len(found) == 1
    # six parameters of thousands of samples: what is left of it is far below the noise
    assert np.mean(np.abs(found[0].course - made) ** 2) < 1e-5
    assert level_db(found[0], noise(rng, 1e-4)) == pytest.approx(40.0, abs=0.5)


def test_several_tones_come_strongest_first(rng: np.random.Generator) -> None:
    found = find_tones(tone(713.0, 0.3) + tone(-1311.0, 1.0) + noise(rng, 1e-4), RATE_HZ)
    assert [round(t.offset_hz / 10) for t in found] == [-131, 71]


def test_neither_noise_nor_bursts_are_tones(rng: np.random.Generator) -> None:
    """An on-off code has a bare carrier in it, a line in the spectrum; but its margins are quiet."""
    for _ in range(20):
        assert find_tones(noise(rng, 1e-2), RATE_HZ) == []
        assert find_tones(burst(1.0) + noise(rng, 1e-4), RATE_HZ) == []
    assert find_tones(np.zeros(COUNT, complex), RATE_HZ) == []
    assert find_tones(np.zeros(0, complex), RATE_HZ) == []


def test_silence_before_the_recording_is_left_silent(rng: np.random.Generator) -> None:
    heard = tone(713.0, 1.0) + noise(rng, 1e-4)
    heard[:900] = 0.0
    (found,) = find_tones(heard, RATE_HZ)
    assert not found.course[:900].any()
    assert np.mean(np.abs((heard - found.course)[900:]) ** 2) < 2e-4


def test_without_the_bursts_a_tone_is_followed_better(rng: np.random.Generator) -> None:
    made, disturbed = tone(13.0, 1.0), burst(1.0)
    heard = made + disturbed + noise(rng, 1e-4)
    found = find_tones(heard, RATE_HZ)
    assert len(found) == 1
    (again,) = refit(found, heard - disturbed, RATE_HZ)
    before, after = (np.mean(np.abs(t.course - made) ** 2) for t in (found[0], again))
    assert after < 1e-5 < before


@pytest.mark.parametrize("louder_db", [20.0, 35.0])
def test_a_burst_under_a_tone_is_ranged(louder_db: float, rng: np.random.Generator) -> None:
    plan = make_plan({"A": WAVEFORM}, 48e3, SPEED)
    t = np.arange(int(0.3 * 48e3)) / 48e3
    tau = t - 0.08
    heard = np.real(
        sample(WAVEFORM.envelope, WAVEFORM.rate_hz, WAVEFORM.start_s, tau) * np.exp(2j * np.pi * 15e3 * tau)
    )
    tone_hz = 15_120.0
    heard = 0.02 * heard + 0.02 * 10 ** (louder_db / 20) * np.cos(2 * np.pi * tone_hz * t + 1.0)
    heard = heard + 1e-3 * rng.standard_normal(len(t))
    found, notes = acquire(plan, heard.astype(np.float32), 0, "M", {"A": (0.03, 0.15)})
    assert len(found) == 1
    error = found[0].arrival_s - 0.08 - WAVEFORM.duration_s / 2
    assert abs(error) < 5 * np.sqrt(found[0].covariance[0, 0])
    assert len(notes) == 1
    assert notes[0].startswith("a tone at 15.1")
