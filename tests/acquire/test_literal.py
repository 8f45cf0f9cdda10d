"""The first seed's search, as printed: right where nothing moves, and what it loses where something does."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix.acquire.bank import Bank, make_bank
from sonofix.acquire.baseband import Band, band_limited, design_band, downconvert
from sonofix.acquire.literal import Cell, analytic, column, row, search_literally, spectrum_of, window_of
from sonofix.acquire.search import Peak, search
from sonofix.records import Floats, Waveform
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SPEED = 343.2
RATE_HZ = 96e3
SIGNAL = Signal(carrier_hz=30e3, cycles_per_chip=10, bandwidth_hz=4e3)
TAPS = codes.primitive_taps(9)
WAVEFORMS = [keyed_waveform(codes.m_sequence(9, list(taps)), SIGNAL) for taps in TAPS[:3]]
WAVEFORM = WAVEFORMS[0]
WINDOW = window_of(WAVEFORM, RATE_HZ)
BURST_S = WAVEFORM.duration_s
DELAYS = int(0.04 * RATE_HZ)
STEP_HZ = 0.25 / BURST_S


def heard(bursts: list[tuple[Waveform, float, float, complex]], noise_sd: float, rng: np.random.Generator) -> Floats:
    """Samples with bursts whose first chip is heard at ``begins_s`` if they rest; their middle stays where it is."""
    time_s = np.arange(DELAYS + len(WINDOW) + 500) / RATE_HZ
    out: Floats = noise_sd * rng.standard_normal(len(time_s))
    for w, begins_s, rate_mps, gain in bursts:
        tau = w.duration_s / 2 + (1 - rate_mps / SPEED) * (time_s - begins_s - w.duration_s / 2)
        out += np.real(gain * sample(w.envelope, w.rate_hz, w.start_s, tau) * np.exp(2j * np.pi * 30e3 * tau))
    return out


def frequencies(max_rate_mps: float = 2.7) -> NDArray[np.float64]:
    half = int(np.ceil(30e3 * max_rate_mps / SPEED / STEP_HZ))
    return np.linspace(30e3 - half * STEP_HZ, 30e3 + half * STEP_HZ, 2 * half + 1)


def literally(samples: Floats, window: NDArray[np.complex128] = WINDOW) -> Cell:
    return search_literally(samples, RATE_HZ, window, frequencies(), DELAYS)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_beacon_at_rest_is_found_to_a_sample(which: int, rng: np.random.Generator) -> None:
    w, begins_s = WAVEFORMS[which], rng.uniform(0.01, 0.03)
    samples = heard([(w, begins_s, 0.0, 0.1 * np.exp(2j * np.pi * rng.uniform()))], 0.01, rng)
    cell = search_literally(samples, RATE_HZ, window_of(w, RATE_HZ), frequencies(0.3), DELAYS)
    assert abs(cell.delay - begins_s * RATE_HZ) <= 1.0
    assert abs(cell.frequency_hz - 30e3) <= STEP_HZ


def test_rows_and_columns_are_the_printed_sum(rng: np.random.Generator) -> None:
    samples = rng.standard_normal(2000)
    positive, window = analytic(samples), WINDOW[3000:4500]
    np.testing.assert_allclose(positive.real, samples, atol=1e-12)
    length = 2048
    frequency_hz = 700 * RATE_HZ / length
    n = np.arange(len(samples))
    plain = [
        abs(np.sum((positive * np.exp(-2j * np.pi * frequency_hz / RATE_HZ * n))[m : m + 1500] * np.conj(window)))
        for m in range(400)
    ]
    np.testing.assert_allclose(row(positive, spectrum_of(window, 400), frequency_hz, RATE_HZ, 400), plain, rtol=1e-9)
    np.testing.assert_allclose([column(positive, window, m, length)[700] for m in range(0, 400, 50)], plain[::50])
    # past the end of the samples there is silence
    assert row(positive, spectrum_of(window, 1999), frequency_hz, RATE_HZ, 1999)[-1] == pytest.approx(
        abs(np.sum(positive[1998:] * np.exp(-2j * np.pi * frequency_hz / RATE_HZ * n[1998:]) * np.conj(window[:2])))
    )


def planned(w: Waveform) -> tuple[Bank, Band]:
    band = design_band([w], RATE_HZ)
    return make_bank("A", band_limited(w, band), band, 2.6, SPEED), band


def stretched_search(samples: Floats, w: Waveform) -> Peak:
    bank, band = planned(w)
    baseband, start_s = downconvert(samples.astype(np.float32), 0, band)
    peak = search(baseband, start_s, bank, band, 0.005, 0.035, [], 1e-4)
    assert peak is not None
    return peak


def test_positive_frequencies_alone_are_left() -> None:
    n = np.arange(1001)
    for count in (1000, 1001):
        tone = np.cos(2 * np.pi * 100 / count * n[:count] + 0.3)
        expected = np.exp(1j * (2 * np.pi * 100 / count * n[:count] + 0.3))
        np.testing.assert_allclose(analytic(tone), expected, atol=1e-9)


def slipped(window: NDArray[np.complex128], rate_mps: float) -> float:
    """Height that a window without stretch keeps, by hand: its autocorrelation, averaged over the slip in a burst.

    At the moment u after the middle the envelope has slipped by β u; the slips of a burst of length T fill
    [−βT/2, βT/2] evenly.
    """
    power = np.abs(np.fft.fft(window, 2 * len(window))) ** 2
    auto = np.fft.fftshift(np.fft.ifft(power).real)
    lag_s = (np.arange(len(auto)) - len(window)) / RATE_HZ
    reach_s = abs(rate_mps) / SPEED * BURST_S / 2
    slip_s = np.linspace(-reach_s, reach_s, 501)
    return float(np.mean(np.interp(slip_s, lag_s, auto)) / auto.max())


@pytest.mark.parametrize(
    ("modulation", "rate_mps", "loss_db"),
    [
        # by the code's slip: 1.5 chips of 511 at 1 m/s, 3 at 2 m/s
        ("bpsk", 0.0, 0.0),
        ("bpsk", -0.5, 0.4),
        ("bpsk", 1.0, 1.9),
        ("bpsk", -2.0, 6.0),
        # half of an on-off code is bare carrier, whose broad triangle keeps height but tells no delay
        ("ask", 0.0, 0.0),
        ("ask", 1.0, 0.7),
        ("ask", -2.0, 1.9),
        ("ask", 2.5, 2.3),
    ],
)
def test_a_moving_beacon_loses_height_as_its_code_slips(
    modulation: Literal["ask", "bpsk"], rate_mps: float, loss_db: float, rng: np.random.Generator
) -> None:
    """Against one at rest, at the true delay and frequency; the stretched search keeps all but 1 dB."""
    signal = Signal(carrier_hz=30e3, cycles_per_chip=10, bandwidth_hz=4e3, modulation=modulation)
    w = keyed_waveform(codes.m_sequence(9, list(TAPS[0])), signal)
    window, begins_s = window_of(w, RATE_HZ), 0.02
    samples = heard([(w, begins_s, rate_mps, 0.1)], 1e-4, rng)
    doppler_hz = 30e3 * (1 - rate_mps / SPEED)
    height = row(analytic(samples), spectrum_of(window, DELAYS), doppler_hz, RATE_HZ, DELAYS)[round(begins_s * RATE_HZ)]
    kept = height / (0.1 * float(np.sum(np.abs(window) ** 2)))
    # the average by hand takes the code for even in time, which m-sequences are to some hundredths
    assert kept == pytest.approx(slipped(window, rate_mps), abs=0.03)
    assert -20 * np.log10(kept) == pytest.approx(loss_db, abs=0.2)
    # a quarter of a frequency bin between cells costs 0.22 dB at worst
    best = literally(samples, window)
    assert best.height >= 10 ** (-0.23 / 20) * height
    ours = stretched_search(samples, w)
    # 1 dB of velocity, and a delay between two samples of the base band
    bank, band = planned(w)
    between_db = -20 * np.log10(np.sinc(band.half_width_hz / band.rate_hz / np.sqrt(3)))
    assert 10 * np.log10(ours.power / (0.01 * bank.energy)) > -1.0 - between_db
    assert abs(ours.start_s - begins_s) < 1.0 / band.rate_hz


@pytest.mark.parametrize("rate_mps", [2.5, -2.5])
def test_a_fast_beacon_is_misplaced_where_the_stretched_search_finds_it(
    rate_mps: float, rng: np.random.Generator
) -> None:
    begins_s = rng.uniform(0.01, 0.03)
    samples = heard([(WAVEFORM, begins_s, rate_mps, 0.1)], 1e-3, rng)
    # more than the 5 cm which the seed allows a moving vehicle
    assert SPEED * abs(literally(samples).delay / RATE_HZ - begins_s) > 0.05
    assert SPEED * abs(stretched_search(samples, WAVEFORM).start_s - begins_s) < 0.02


def test_nothing_to_search_is_refused() -> None:
    samples = np.zeros(100)
    with pytest.raises(ValueError, match="0 delays, 1 frequencies"):
        search_literally(samples, RATE_HZ, WINDOW, np.array([30e3]), 0)
    with pytest.raises(ValueError, match="5 delays, 0 frequencies"):
        search_literally(samples, RATE_HZ, WINDOW, np.array([]), 5)
