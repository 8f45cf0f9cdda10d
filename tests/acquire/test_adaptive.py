"""Adaptive filters against their plain twins and their closed forms; amplitude matching and the comparator."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.acquire.adaptive import Announced, Filtered, desired, listen, lms, mean_magnitude, nlms, rises_at, rls
from sonofix.records import Floats

RATE_HZ, SPEED = 192e3, 343.2


def windows(heard: Floats, taps: int) -> Floats:
    """Samples in the filter at each instant (n, taps), latest first, nothing before the first."""
    return np.lib.stride_tricks.sliding_window_view(np.concatenate([np.zeros(taps - 1), heard]), taps)[:, ::-1]


def plain_lms(heard: Floats, wanted: Floats, step: float, taps: int, floor: float | None = None) -> Filtered:
    """Equations 3 and 4 as printed; with a floor, normalised."""
    h, output, error = np.zeros(taps), np.zeros(len(heard)), np.zeros(len(heard))
    for n, x in enumerate(windows(heard, taps)):
        output[n] = h @ x
        error[n] = wanted[n] - output[n]
        h = h + step * error[n] * x / (1.0 if floor is None else floor + x @ x)
    return Filtered(output, error, h)


def plain_rls(heard: Floats, wanted: Floats, taps: int, forgetting: float, start: float) -> Filtered:
    h, inverse = np.zeros(taps), start * np.eye(taps)
    output, error = np.zeros(len(heard)), np.zeros(len(heard))
    for n, x in enumerate(windows(heard, taps)):
        output[n] = h @ x
        error[n] = wanted[n] - output[n]
        gain = inverse @ x / (forgetting + x @ inverse @ x)
        h = h + gain * error[n]
        inverse = (inverse - np.outer(gain, x @ inverse)) / forgetting
    return Filtered(output, error, h)


def same(one: Filtered, other: Filtered) -> None:
    np.testing.assert_allclose(one.output, other.output, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.error, other.error, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.taps, other.taps, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("taps", [1, 7, 8, 32])
def test_kernels_are_their_plain_twins(taps: int, rng: np.random.Generator) -> None:
    heard, wanted = rng.standard_normal(400), rng.standard_normal(400)
    same(lms(heard, wanted, 0.01, taps), plain_lms(heard, wanted, 0.01, taps))
    same(nlms(heard, wanted, 0.3, taps, 1e-3), plain_lms(heard, wanted, 0.3, taps, 1e-3))
    same(rls(heard, wanted, taps, 0.98, 5.0), plain_rls(heard, wanted, taps, 0.98, 5.0))


def test_taps_go_on_where_they_were_left(rng: np.random.Generator) -> None:
    heard, wanted = rng.standard_normal(300), rng.standard_normal(300)
    whole = lms(heard, wanted, 0.01, 1)
    half = lms(heard[:150], wanted[:150], 0.01, 1)
    rest = lms(heard[150:], wanted[150:], 0.01, half.taps)
    np.testing.assert_allclose(rest.output, whole.output[150:], rtol=1e-12)
    np.testing.assert_allclose(half.taps, lms(heard[:150], wanted[:150], 0.01, np.zeros(1)).taps, rtol=1e-12)


def test_a_filter_without_noise_is_found_by_all(rng: np.random.Generator) -> None:
    true = np.array([0.5, -1.0, 0.25, 0.1])
    heard = rng.standard_normal(4000)
    wanted = windows(heard, 4) @ true
    for found in (lms(heard, wanted, 0.02, 4), nlms(heard, wanted, 0.5, 4), rls(heard, wanted, 4)):
        np.testing.assert_allclose(found.taps, true, atol=1e-4)


def test_rls_is_the_least_squares_fit_of_all_samples(rng: np.random.Generator) -> None:
    heard, wanted = rng.standard_normal(200), rng.standard_normal(200)
    rows, start = windows(heard, 5), 3.0
    # its start is a prior of zero taps with that variance
    fit = np.linalg.solve(rows.T @ rows + np.eye(5) / start, rows.T @ wanted)
    np.testing.assert_allclose(rls(heard, wanted, 5, 1.0, start).taps, fit, rtol=1e-9)


def test_rls_stays_finite_over_many_samples_that_tell_little(rng: np.random.Generator) -> None:
    time_s = np.arange(200_000) / RATE_HZ
    heard = np.sin(2 * np.pi * 40e3 * time_s) + 1e-3 * rng.standard_normal(len(time_s))
    found = rls(heard, desired(Announced(40e3, 5.0), 1.0, time_s), 8, 0.999)
    assert not found.diverged
    assert np.abs(found.output).max() < 10.0


def test_mean_error_of_lms_fades_as_its_eigenvalues_say(rng: np.random.Generator) -> None:
    """White input of power σ²: E[h* − h(n)] = (1 − Δ σ²)ⁿ h* (Haykin, section 5.4), averaged over runs."""
    step, power, steps, runs = 0.02, 1.0, 50, 3000
    left = np.zeros(2)
    for _ in range(runs):
        heard = rng.standard_normal(steps)
        left += 1.0 - lms(heard, windows(heard, 2) @ np.ones(2), step, 2).taps
    # the second tap sees its first sample one later
    expected = (1 - step * power) ** np.array([steps, steps - 1])
    # taps scatter by less than √(steps) Δ σ² about their mean
    np.testing.assert_allclose(left / runs, expected, atol=5 * step * np.sqrt(steps) / np.sqrt(runs))


def test_too_large_a_step_is_told_and_not_believed(rng: np.random.Generator) -> None:
    heard = 10 * rng.standard_normal(3000)
    found = lms(heard, heard, 1.0, 8)
    assert found.diverged
    verdict = listen(heard, found, 5.0, RATE_HZ, SPEED)
    assert verdict.status == "overflow"
    assert "smaller step" in verdict.remedy


def test_the_desired_signal_is_what_was_announced() -> None:
    time_s = np.arange(400) / 4e8
    square = desired(Announced(1e6, 10.0, "square", 0.5), 2.0, time_s)
    assert set(square.tolist()) == {10.0, -10.0}
    assert mean_magnitude(square) == pytest.approx(10.0)
    np.testing.assert_array_equal(square[:200], 10.0)
    sine = desired(Announced(1e6, 10.0, "sine", 0.5), 2.0, time_s)
    np.testing.assert_allclose(sine, 10.0 * np.sin(2 * np.pi * 1e6 * time_s), atol=1e-12)


def test_detector_hears_a_burst_and_times_it(rng: np.random.Generator) -> None:
    """Without a tone: 10 m away the burst begins 29 ms after the radio message, and the comparator rises with it."""
    time_s = np.arange(int(0.06 * RATE_HZ)) / RATE_HZ
    wanted = desired(Announced(40e3, 5.0, "sine"), 1.0, time_s)
    samples = np.where(time_s >= 10.0 / SPEED, wanted, 0.0) + 0.05 * rng.standard_normal(len(time_s))
    began = int(np.ceil(10.0 / SPEED * RATE_HZ))
    found = lms(samples[began:], wanted[began:], 1e-3, 8)
    verdict = listen(samples, found, mean_magnitude(wanted), RATE_HZ, SPEED)
    assert verdict.status == "heard"
    assert verdict.range_m == pytest.approx(10.0, abs=2 * SPEED / RATE_HZ)
    assert verdict.range_m == SPEED * (verdict.time_s or 0.0)


def test_detector_waits_where_nothing_matches_or_rises(rng: np.random.Generator) -> None:
    time_s = np.arange(2000) / RATE_HZ
    wanted = desired(Announced(40e3, 5.0, "sine"), 1.0, time_s)
    noise = 0.01 * rng.standard_normal(2000)
    none = listen(noise, lms(noise, wanted, 1e-3, 8), mean_magnitude(wanted), RATE_HZ, SPEED)
    assert (none.status, none.time_s, none.range_m) == ("overflow", None, None)
    assert "wait for a burst" in none.remedy
    # an output that matches, but samples too faint for the comparator
    faint = listen(noise, lms(wanted, wanted, 1e-3, 8), 3.0, RATE_HZ, SPEED)
    assert faint.status == "overflow"
    assert "comparator" in faint.remedy
    # samples in which the comparator would rise count for nothing where the amplitude does not match
    loud = listen(wanted, lms(noise, wanted, 1e-3, 8), mean_magnitude(wanted), RATE_HZ, SPEED)
    assert loud.status == "overflow"


def test_the_comparator_rises_at_either_sign_and_may_never() -> None:
    assert rises_at(np.array([0.1, -0.4, -0.6, 0.9])) == 2
    assert rises_at(np.array([0.5, -0.5])) is None
    assert rises_at(np.array([])) is None


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda x: lms(x, x[:-1], 0.1, 4), r"heard has shape \(50,\) and wanted \(49,\)"),
        (lambda x: lms(x, x, 0.0, 4), r"step = 0.0; it must be positive"),
        (lambda x: nlms(x, x, 0.1, 0), r"taps = 0; at least 1 is needed"),
        (lambda x: nlms(x, x, 0.1, 4, 0.0), r"floor = 0.0; it must be positive"),
        (lambda x: rls(x, x, 4, 1.1), r"forgetting = 1.1; it must lie above 0"),
        (lambda x: rls(x, x, 4, 1.0, -1.0), r"start = -1.0; it must be positive"),
        (lambda x: lms(x, x, 0.1, np.zeros((2, 2))), r"taps has shape \(2, 2\)"),
    ],
)
def test_misuse_is_told(call, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call(np.ones(50))
