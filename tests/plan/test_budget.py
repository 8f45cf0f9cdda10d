"""The link budget: closed forms, beams, and what a chirp pays for looking alike when late and when moving."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.plan.budget import Budget, Link, farthest_m, level_for_snr, links_of, pattern, strength
from sonofix.records import Waveform
from sonofix.signals.codes import m_sequence
from sonofix.signals.waveform import chirp_waveform, keyed_waveform
from sonofix.site import ChirpCode, Signal

SPEED = 343.2
SIGNAL = Signal(carrier_hz=40e3, cycles_per_chip=10, bandwidth_hz=4e3)
BUDGET = Budget(level=0.5, noise_sd=0.01, rate_hz=192e3)


def burst(degree: int = 8, taps: tuple[int, ...] = (1, 2, 7)) -> Waveform:
    return keyed_waveform(m_sequence(degree, list(taps)), SIGNAL)


def link_of(waveform: Waveform, absorption: float = 0.0) -> Link:
    return links_of([waveform], BUDGET.rate_hz, SPEED, [absorption], 0.1, 2.0)[0]


def test_deviation_is_the_closed_form_where_that_holds() -> None:
    """1/Var = (2π)² B² 2E/N₀, B² the mean square bandwidth about the mean (Kay 1993, section 3.11)."""
    w = burst()
    power = np.abs(np.fft.fft(w.envelope)) ** 2
    offset_hz = np.fft.fftfreq(len(w.envelope), 1 / w.rate_hz)
    mean = np.sum(offset_hz * power) / np.sum(power)
    width = np.sum((offset_hz - mean) ** 2 * power) / np.sum(power)
    energy = (BUDGET.level / 3.0) ** 2 * np.sum(np.abs(w.envelope) ** 2) / w.rate_hz / 2
    sd_s = 1 / np.sqrt((2 * np.pi) ** 2 * width * 2 * energy / BUDGET.density)
    got = strength(link_of(w), BUDGET, np.array([3.0]), SPEED)
    assert got.sd_m[0] == pytest.approx(SPEED * sd_s, rel=0.03)


def test_a_chirp_pays_for_delay_and_rate_looking_alike() -> None:
    """Knowing the range rate would make a chirp's delay far better; a keyed code gains next to nothing."""
    sweep = chirp_waveform(ChirpCode(start_hz=38e3, stop_hz=42e3, duration_s=0.06), Signal(carrier_hz=40e3))

    def known_rate(w: Waveform) -> float:
        power = np.abs(np.fft.fft(w.envelope)) ** 2
        offset_hz = np.fft.fftfreq(len(w.envelope), 1 / w.rate_hz)
        mean = np.sum(offset_hz * power) / np.sum(power)
        width = np.sum((offset_hz - mean) ** 2 * power) / np.sum(power)
        return 4 * np.pi**2 * width * np.sum(np.abs(w.envelope) ** 2) / w.rate_hz

    assert link_of(burst()).by_delay > 0.95 * known_rate(burst())
    assert link_of(sweep).by_delay < 0.1 * known_rate(sweep)


def test_strength_falls_by_spreading_and_absorption() -> None:
    distance = np.array([1.0, 2.0, 4.0, 8.0])
    plain, lossy = (strength(link_of(burst(), a), BUDGET, distance, SPEED) for a in (0.0, 1.3))
    assert np.diff(plain.snr_db) == pytest.approx(-20 * np.log10(2), abs=1e-9)
    assert plain.snr_db - lossy.snr_db == pytest.approx(1.3 * distance)
    assert (np.diff(plain.sd_m) > 0).all()
    assert (lossy.sd_m > plain.sd_m).all()
    # nearer than a transducer is wide, nothing grows
    near = strength(link_of(burst()), BUDGET, np.array([0.0, 0.01]), SPEED)
    assert near.snr_db[0] == near.snr_db[1]


def test_twice_the_chips_halve_the_variance_and_reach_farther() -> None:
    short, long = link_of(burst()), link_of(burst(9, (4,)))
    distance = np.array([5.0])
    ratio = strength(short, BUDGET, distance, SPEED).sd_m / strength(long, BUDGET, distance, SPEED).sd_m
    assert ratio[0] == pytest.approx(np.sqrt(2), rel=0.03)
    assert farthest_m(long, BUDGET, SPEED) > 1.2 * farthest_m(short, BUDGET, SPEED)


def test_what_is_heard_ends_at_the_stated_distance() -> None:
    link = link_of(burst(), 1.3)
    end = farthest_m(link, BUDGET, SPEED)
    heard = strength(link, BUDGET, np.array([0.99, 1.01]) * end, SPEED).heard
    assert heard.tolist() == [True, False]
    assert farthest_m(link, Budget(1e-9, 0.1, 192e3), SPEED) == 0.0


def test_noise_counts_by_its_density() -> None:
    """Twice the rate with the same noise a sample is half the density: 3 dB, whatever the burst."""
    w, distance = burst(), np.array([4.0])
    slow, fast = (Budget(0.5, 0.01, rate) for rate in (192e3, 384e3))
    one, two = (strength(link_of(w), b, distance, SPEED) for b in (slow, fast))
    assert two.snr_db - one.snr_db == pytest.approx([10 * np.log10(2)])
    assert one.sd_m / two.sd_m == pytest.approx([np.sqrt(2)], rel=1e-3)


@pytest.mark.parametrize("width_deg", [30, 60, 120])
def test_a_beam_is_six_decibels_down_at_half_its_width(width_deg) -> None:
    half = np.deg2rad(width_deg / 2)
    got = pattern(2 * half, np.cos([0.0, half, np.pi / 2, np.pi]))
    assert got[0] == 1.0
    assert 20 * np.log10(got[1]) == pytest.approx(-6.0)
    assert got[2:] == pytest.approx(0.0, abs=1e-9)


def test_a_beam_of_half_a_turn_is_alike_all_round() -> None:
    assert (pattern(np.pi, np.array([1.0, 0.2, -1.0])) == 1.0).all()


def test_a_beam_without_angles_is_refused() -> None:
    with pytest.raises(ValueError, match="cos_off_axis is missing"):
        strength(link_of(burst()), Budget(0.5, 0.01, 192e3, beam_rad=1.0), np.ones(1), SPEED)


def test_level_comes_back_from_a_measured_snr() -> None:
    link = link_of(burst(), 1.3)
    snr_db = float(strength(link, BUDGET, np.array([5.2]), SPEED).snr_db[0])
    assert level_for_snr(snr_db, 5.2, link, BUDGET) == pytest.approx(BUDGET.level, rel=1e-9)
