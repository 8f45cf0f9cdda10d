"""The parts of a calibration one by one, on inputs whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.records import Floats
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import waveforms_of
from sonofix.survey.align import align, align_one
from sonofix.survey.chip import bare_code, chip_response, echoes_in, gated
from sonofix.survey.pace import fit_pace, number_bursts
from sonofix.survey.slices import Slice, is_clipped, make_slice, stretches
from survey.made_bench import bench

RATE_HZ = 192e3


def part_of(count: int = 6000) -> Slice:
    return make_slice(RATE_HZ, count, 40e3, 12e3)


def many(rng: np.random.Generator, count: int, noise_sd: float) -> tuple[np.ndarray, Floats, np.ndarray, Slice]:
    """Slices of one burst at many delays (s), strengths and phases, in white noise."""
    part = part_of()
    w = waveforms_of(bench())["B1"]
    burst = part.delayed(part.of_waveform(w.envelope, w), 4e-3)
    delay = rng.uniform(-2e-5, 2e-5, count)
    gain = rng.uniform(0.95, 1.05, count) * np.exp(2j * np.pi * rng.uniform(size=count))
    noise = rng.standard_normal((count, part.length)) * noise_sd
    made = [g * part.delayed(burst, d) + part.of(n) for d, g, n in zip(delay, gain, noise, strict=True)]
    return np.array(made), delay, gain, part


def test_slices_hold_a_waveform_where_it_stands() -> None:
    part, w = part_of(), waveforms_of(bench())["B1"]
    spectrum = part.delayed(part.of_waveform(w.envelope, w), 3e-3)
    time_s = np.arange(part.course_count) / part.course_rate_hz
    expected = sample(w.envelope, w.rate_hz, w.start_s, time_s - 3e-3)
    # edges of chips reach beyond the 12 kHz that the slice holds
    ours = part.course(spectrum)
    turn = np.vdot(expected, ours) / np.vdot(expected, expected)
    assert abs(turn) == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(ours, turn * expected, atol=0.02)
    back = part.of(part.samples(spectrum))
    np.testing.assert_allclose(back, spectrum, atol=1e-9 * np.abs(spectrum).max())


@pytest.mark.parametrize("block", [7, 100, 5000])
def test_stretches_overlap_and_leave_nothing_out(block: int, rng: np.random.Generator) -> None:
    samples = rng.standard_normal((1003, 2)).astype(np.float32)
    samples[5, 1] = np.nan

    def blocks(length: int):
        del length
        for i in range(0, len(samples), block):
            yield samples[i : i + block]

    clean = np.nan_to_num(samples[:, 1])
    seen = 0
    for first, stretch in stretches(blocks, 1, 50, 80):
        assert first == seen
        np.testing.assert_array_equal(stretch, clean[first : first + 80])
        seen += 50
    assert seen >= len(samples)


def test_clipping_is_told_from_loudness() -> None:
    sine = 0.6 * np.sin(2 * np.pi * 40e3 / RATE_HZ * np.arange(8000) + 0.2)
    whole = np.round(sine * 32768) / 32768
    assert not is_clipped(whole.astype(np.float32))
    assert is_clipped(np.clip(sine, -0.4, 0.4).astype(np.float32))
    assert is_clipped(np.clip(2 * sine, -1, 1).astype(np.float32))
    assert not is_clipped((np.round(sine * 20) / 32768).astype(np.float32))


def test_aligned_bursts_without_noise(rng: np.random.Generator) -> None:
    bursts, delay, gain, part = many(rng, 9, 0.0)
    found = align(bursts.astype(np.complex64), part.offset_hz)
    np.testing.assert_allclose(found.delay_s, delay - delay.mean(), atol=1e-9)
    ratio = found.gain / gain
    np.testing.assert_allclose(ratio / ratio[0], 1.0, atol=1e-5)
    assert found.used.all()
    assert align_one(bursts[0], bursts[1], found.noise, part.offset_hz) == pytest.approx(delay[0] - delay[1], abs=1e-9)


def test_aligned_bursts_scatter_as_stated(rng: np.random.Generator) -> None:
    """The squares of 60 errors over their deviations: chi-square with 59 degrees of freedom, 99.9 % band."""
    bursts, delay, _, part = many(rng, 60, 0.05)
    found = align(bursts.astype(np.complex64), part.offset_hz)
    error = found.delay_s - (delay - delay.mean())
    assert 27.0 < np.sum((error / found.delay_sd_s) ** 2) < 98.0
    # and the mean is the better for it: of the noise's power a sixtieth is left
    clean = many(np.random.default_rng(0), 1, 0.0)[0][0]
    shift = align_one(found.mean, clean, found.noise, part.offset_hz)
    laid = part.delayed(found.mean, -shift)
    laid = laid * np.vdot(laid, clean) / np.vdot(laid, laid)
    gain_db = 10 * np.log10(np.mean(found.noise) / np.mean(np.abs(laid - clean) ** 2))
    assert gain_db == pytest.approx(10 * np.log10(60), abs=1.0)


def test_bursts_that_do_not_fit_are_named(rng: np.random.Generator) -> None:
    bursts, _, _, part = many(rng, 20, 0.01)
    bursts[4] += part.of(0.3 * rng.standard_normal(part.length))
    bursts[7] *= 0.6
    reasons = ["clipped" if i == 11 else "" for i in range(20)]
    found = align(bursts.astype(np.complex64), part.offset_hz, reasons=reasons)
    named = {i: why for i, why in enumerate(found.reason) if why}
    assert named == {4: "disturbed", 7: "of another strength", 11: "clipped"}
    with pytest.raises(ValueError, match=r"of 4 bursts 2 can be used \(2 clipped\); at least 3"):
        align(bursts[:4].astype(np.complex64), part.offset_hz, reasons=["clipped", "", "clipped", ""])


def test_a_response_is_taken_out_of_the_code(rng: np.random.Generator) -> None:
    site = bench(bandwidth_hz=3e3)
    beacon, part = site.beacons[0], part_of()
    code = bare_code(beacon, site.signal_of(beacon), part)
    assert code is not None
    w = waveforms_of(site)["B1"]
    direct = part.of_waveform(w.envelope, w)
    burst = direct + part.delayed(0.2 * np.exp(1.1j) * direct, 4e-3)
    found = chip_response(burst, np.ones(len(burst)), code, part, 9e-3)
    echo = echoes_in(found, 2.2e-3, 0.0)[0]
    assert echo.delay_s == pytest.approx(4e-3, abs=2e-5)
    assert echo.gain_db == pytest.approx(20 * np.log10(0.2), abs=0.7)
    clean = gated(found, code, part, 2.2e-3)
    assert np.linalg.norm(clean - direct) < 0.02 * np.linalg.norm(direct)
    assert echoes_in(chip_response(direct, np.ones(len(burst)), code, part, 9e-3), 3e-3, 0.0) == ()


@pytest.mark.parametrize("drift_per_s", [0.0, 4e-9])
def test_pace_of_a_clock(drift_per_s: float, rng: np.random.Generator) -> None:
    number = np.setdiff1d(np.arange(400), [5, 6, 90, 200, 201, 202])
    due = 0.5 * number
    sd = np.full(len(due), 2e-7)
    heard = due * (1 + 12e-6) + 0.5 * drift_per_s * (due - 100.0) ** 2 + rng.normal(0, 2e-7, len(due)) + 7.7
    heard[30] += 4e-5
    found = fit_pace(due, heard, sd, np.ones(len(due), bool), 0.5)
    assert np.flatnonzero(~found.used).tolist() == [30]
    # at the middle of the recording a symmetric parabola has no slope
    assert found.rate == pytest.approx(12e-6, abs=5 * found.rate_sd + 0.3 * drift_per_s)
    assert found.rate_sd == pytest.approx(2e-7 / np.sqrt(np.sum((due - due.mean()) ** 2)), rel=0.15)
    assert found.jitter_s == pytest.approx(2e-7, rel=0.15)
    if drift_per_s:
        assert found.drift_per_s == pytest.approx(drift_per_s, abs=5 * (found.drift_sd_per_s or 0.0))
    else:
        assert found.drift_per_s is None
    # white time errors: sqrt(3) sd / tau, IEEE 1139
    assert found.allan_tau_s[:3].tolist() == [0.5, 1.0, 2.0]
    if not drift_per_s:
        np.testing.assert_allclose(found.allan[:4], np.sqrt(3) * 2e-7 / found.allan_tau_s[:4], rtol=0.2)


def test_bursts_are_numbered_over_gaps(rng: np.random.Generator) -> None:
    number = np.sort(rng.choice(2000, 700, replace=False))
    heard = 3.3 + number * 0.1 * (1 + 90e-6) + rng.normal(0, 5e-6, 700)
    found, period_s = number_bursts(heard, 0.1)
    np.testing.assert_array_equal(found, number - number[0])
    assert period_s == pytest.approx(0.1 * (1 + 90e-6), rel=1e-6)
    assert number_bursts(heard[:1], 0.1)[0].tolist() == [0]
