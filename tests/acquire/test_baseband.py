"""Mixing, filtering and decimation in one kernel, against the same in three plain lines."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix.acquire.baseband import SHARE, STOPBAND_DB, Band, band_limited, design_band, downconvert
from sonofix.records import Waveform
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal


def burst_of(carrier_hz: float, cycles: float, bandwidth_hz: float | None, modulation: str = "ask") -> Waveform:
    signal = {
        "carrier_hz": carrier_hz,
        "cycles_per_chip": cycles,
        "bandwidth_hz": bandwidth_hz,
        "modulation": modulation,
    }
    return keyed_waveform(codes.m_sequence(5, [3]), Signal.model_validate(signal))


BANDS = {
    "40 kHz at 192 kHz": (burst_of(40e3, 10, 4e3), 192e3),
    "40 kHz at 96 kHz": (burst_of(40e3, 10, 4e3), 96e3),
    "15 kHz at 48 kHz": (burst_of(15e3, 8, 3e3, "bpsk"), 48e3),
    "wide": (burst_of(15e3, 3, 8e3), 48e3),
    "no transducer": (burst_of(20e3, 20, None), 96e3),
}


@pytest.fixture(params=list(BANDS))
def made(request: pytest.FixtureRequest) -> tuple[Waveform, Band]:
    waveform, rate_hz = BANDS[request.param]
    return waveform, design_band([waveform], rate_hz)


def plain(samples: NDArray[np.floating], first_sample: int, band: Band) -> NDArray[np.complex128]:
    """Twin: mix to zero by the recorder's clock, convolve, keep every n-th."""
    at = first_sample + np.arange(len(samples))
    mixed = samples.astype(float) * np.exp(-2j * np.pi * ((band.carrier_hz / band.sample_rate_hz * at) % 1.0))
    return np.convolve(mixed, band.taps.astype(float), "valid")[:: band.decimation]


@pytest.mark.parametrize("first_sample", [0, 12345, -77, 120_000_000])
def test_kernel_is_its_plain_twin(made: tuple[Waveform, Band], first_sample: int, rng: np.random.Generator) -> None:
    band = made[1]
    samples = rng.uniform(-1, 1, 5000).astype(np.float32)
    baseband, start_s = downconvert(samples, first_sample, band)
    expected = plain(samples, first_sample, band)
    assert baseband.shape == expected.shape == ((5000 - len(band.taps)) // band.decimation + 1,)
    assert start_s == pytest.approx((first_sample + (len(band.taps) - 1) / 2) / band.sample_rate_hz, abs=1e-12)
    # single precision: sums of some hundred products of 2⁻²⁴ each
    np.testing.assert_allclose(baseband, expected, rtol=0, atol=2e-6)


def test_too_few_samples_give_nothing(made: tuple[Waveform, Band]) -> None:
    band = made[1]
    for count in (0, 1, len(band.taps) - 1):
        assert len(downconvert(np.zeros(count, np.float32), 0, band)[0]) == 0
    assert len(downconvert(np.zeros(len(band.taps), np.float32), 0, band)[0]) == 1


def gain(band: Band, offset_hz: NDArray[np.floating]) -> NDArray[np.floating]:
    """Direct Fourier sum of the taps, unit at the carrier."""
    n = np.arange(len(band.taps)) - (len(band.taps) - 1) / 2
    taps = band.taps.astype(float) / band.taps.astype(float).sum()
    return np.cos(2 * np.pi * offset_hz[:, None] / band.sample_rate_hz * n) @ taps


def test_what_would_fold_into_the_pass_band_is_stopped(made: tuple[Waveform, Band]) -> None:
    band = made[1]
    assert band.half_width_hz < band.rate_hz / 2
    if band.decimation > 1:
        folding = np.linspace(band.rate_hz - band.half_width_hz, band.sample_rate_hz / 2, 3000)
        # Kaiser's formulas keep to what they are asked within 2 dB
        assert 20 * np.log10(np.abs(gain(band, folding)).max()) <= -STOPBAND_DB + 2.0
    passing = gain(band, np.linspace(-band.half_width_hz, band.half_width_hz, 2001))
    assert np.abs(20 * np.log10(np.abs(passing))).max() < 0.05


def test_response_is_that_of_the_taps(made: tuple[Waveform, Band], rng: np.random.Generator) -> None:
    band = made[1]
    offset_hz = rng.uniform(-band.sample_rate_hz / 2, band.sample_rate_hz / 2, 500)
    # the lobes are some hundred hertz wide, and the grid is finer than 50
    np.testing.assert_allclose(band.response(offset_hz), gain(band, offset_hz), atol=1e-3)


def test_pass_band_holds_the_energy_of_the_derivative(made: tuple[Waveform, Band]) -> None:
    waveform, band = made
    slope = np.gradient(waveform.signature, 1 / waveform.rate_hz)
    offset_hz = np.fft.fftfreq(len(slope), 1 / waveform.rate_hz)
    power = np.abs(np.fft.fft(slope)) ** 2
    share = power[np.abs(offset_hz) <= band.half_width_hz].sum() / power.sum()
    capped = 0.94 * min(0.8 * band.carrier_hz, band.sample_rate_hz / 2 - band.carrier_hz)
    assert share > SHARE - 0.005 or band.half_width_hz > capped


def test_a_tone_comes_out_with_its_amplitude_and_phase(made: tuple[Waveform, Band]) -> None:
    band = made[1]
    t = np.arange(4000) / band.sample_rate_hz
    offset_hz = 0.4 * band.half_width_hz
    tone = 0.3 * np.cos(2 * np.pi * (band.carrier_hz + offset_hz) * t + 0.7)
    baseband, start_s = downconvert(tone.astype(np.float32), 0, band)
    at = start_s + np.arange(len(baseband)) / band.rate_hz
    # and its mirror image, by what the filter leaves of that
    own, image = gain(band, np.array([offset_hz, -2 * band.carrier_hz - offset_hz]))
    mirrored_hz = -2 * band.carrier_hz - offset_hz
    expected = 0.3 * own * np.exp(1j * (2 * np.pi * offset_hz * at + 0.7))
    expected += 0.3 * image * np.exp(1j * (2 * np.pi * mirrored_hz * at - 0.7))
    np.testing.assert_allclose(baseband, expected, atol=1e-5)
    assert own == pytest.approx(1.0, abs=1e-3)


def test_whiteness_is_that_of_filtered_noise(made: tuple[Waveform, Band], rng: np.random.Generator) -> None:
    """White noise of variance 1 has 4 / decimation a base-band sample, were the base band white all over."""
    band = made[1]
    noise = rng.standard_normal(400_000).astype(np.float32)
    baseband, _ = downconvert(noise, 0, band)
    white = band.whiteness * np.mean(np.abs(baseband) ** 2)
    # of n nearly independent complex samples the mean power scatters by 1/sqrt(n)
    assert white == pytest.approx(4.0 / band.decimation, rel=5 / np.sqrt(len(baseband)))
    assert band.whiteness >= 1.0


def test_band_limited_burst_is_what_the_kernel_makes_of_it(made: tuple[Waveform, Band]) -> None:
    waveform, band = made
    begins_s = 3.21e-3
    t = np.arange(int(30e-3 * band.sample_rate_hz)) / band.sample_rate_hz
    tau = t - begins_s
    heard = np.real(
        sample(waveform.envelope, waveform.rate_hz, waveform.start_s, tau)
        * np.exp(2j * np.pi * waveform.carrier_hz * tau)
    )
    baseband, start_s = downconvert(heard.astype(np.float32), 0, band)
    limited = band_limited(waveform, band)
    tau = start_s + np.arange(len(baseband)) / band.rate_hz - begins_s
    expected = sample(limited.envelope, limited.rate_hz, limited.start_s, tau)
    expected *= np.exp(-2j * np.pi * waveform.carrier_hz * begins_s)
    # what the burst has beyond half the sample rate folds: more where chips are short or their edges sharp
    narrow = band.half_width_hz < 0.5 * band.carrier_hz
    assert np.linalg.norm(baseband - expected) < (0.01 if narrow else 0.05) * np.linalg.norm(expected)
    assert (limited.carrier_hz, limited.duration_s) == (waveform.carrier_hz, waveform.duration_s)


def test_too_slow_samples_are_refused() -> None:
    with pytest.raises(ValueError, match=r"40000 Hz needs samples faster than 80000 Hz; these come at 48000"):
        design_band([burst_of(40e3, 10, 4e3)], 48e3)
