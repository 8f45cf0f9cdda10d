"""Steps and the error-state filter: its matrices by derivatives, errors as stated, and what blind zones do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.stats import chi2

from sonofix.studies import pedestrian, reckoning

OUTSIDE = 1e-6


def test_a_step_moves_the_errors_as_its_derivatives_say(rng: np.random.Generator) -> None:
    kept = np.exp(-0.5 / 20)  # two steps a second, 20 s
    for _ in range(20):
        length, heading = rng.uniform(0.3, 0.9), rng.uniform(-np.pi, np.pi)

        def after(error: np.ndarray, length: float = length, heading: float = heading) -> np.ndarray:
            # reckoned less true place, when the true step is what is believed
            l_error, h_error = kept * error[2], kept * error[3]
            told = (length + l_error) * np.array([np.cos(heading + h_error), np.sin(heading + h_error)])
            true = length * np.array([np.cos(heading), np.sin(heading)])
            return np.concatenate([error[:2] + told - true, [l_error, h_error]])

        wanted = approx_fprime(np.zeros(4), after, 1e-7)
        np.testing.assert_allclose(reckoning.step_transition(length, heading), wanted, atol=1e-6)


def test_noise_of_a_step_keeps_the_printed_variances() -> None:
    noise = reckoning.step_noise(0.6, 0.3)
    kept = np.exp(-0.5 / 20)
    np.testing.assert_allclose(noise[2, 2] + kept**2 * 0.05**2, 0.05**2)
    np.testing.assert_allclose(noise[3, 3] + kept**2 * np.radians(2) ** 2, np.radians(2) ** 2)
    # what is new in length lies along the step, what is new in heading across it
    along, across = np.array([np.cos(0.3), np.sin(0.3)]), np.array([-np.sin(0.3), np.cos(0.3)])
    new = 1 - kept**2
    assert along @ noise[:2, :2] @ along == pytest.approx(new * 0.05**2)
    assert across @ noise[:2, :2] @ across == pytest.approx(new * (0.6 * np.radians(2)) ** 2)
    assert along @ noise[:2, :2] @ across == pytest.approx(0.0, abs=1e-12)


def test_step_errors_are_stationary_and_fade_in_their_correlation_time() -> None:
    drawn = np.array([reckoning.markov(np.random.default_rng([5, k]), 60) for k in range(4000)])
    # a sample variance of 4000 is off by √(2/4000) = 2.2 %, one sigma; a product of two by 1.6 to 2.2 %
    assert np.abs(drawn[:, [0, 30, 59]].var(axis=0) - 1).max() < 0.11
    assert np.mean(drawn[:, 10] * drawn[:, 50]) == pytest.approx(np.exp(-1.0), abs=0.09)


def test_steps_without_errors_walk_the_walk() -> None:
    places = pedestrian.walked(0.5 * np.arange(401))
    chords = np.diff(places, axis=0)
    np.testing.assert_allclose(places[0], [2, 2])
    np.testing.assert_allclose(places[40], [2, 2], atol=1e-9)  # 24 m at 1.2 m/s: a lap is 40 steps
    assert places[:, 0].max() <= 10
    assert places[:, 1].max() <= 6
    lengths = np.hypot(*chords.T)
    assert np.median(lengths) == pytest.approx(0.6)
    reckoned = reckoning.reckoned(places[0], lengths, np.arctan2(chords[:, 1], chords[:, 0]))
    np.testing.assert_allclose(reckoned, places[1:], atol=1e-9)


def walks(runs: int, steps: int, sd_m: float, blind: slice = slice(0, 0)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (runs, steps, 2) of both together and of steps alone, and stated covariances; a fix every second step."""
    places = pedestrian.walked(0.5 * np.arange(steps + 1))
    rng = np.random.default_rng(12)
    told = [reckoning.told_steps(np.diff(places, axis=0), rng) for _ in range(runs)]
    lengths, headings = (np.array(part) for part in zip(*told, strict=True))
    fixes = np.full((runs, steps, 2), np.nan)
    fixes[:, 1::2] = places[2::2] + sd_m * rng.standard_normal((runs, steps // 2, 2))
    fixes[:, blind] = np.nan
    covariance = np.broadcast_to(sd_m**2 * np.eye(2), (runs, steps, 2, 2))
    both, spread = reckoning.integrated(places[0], lengths, headings, fixes, covariance)
    alone = reckoning.reckoned(places[0], lengths, headings)
    return both - places[1:], alone - places[1:], spread


def test_the_filter_is_as_good_as_it_says_in_the_blind_zone_too() -> None:
    runs = 400
    miss, _, spread = walks(runs, 60, 0.02, slice(40, 60))
    for step in (9, 39, 45, 59):
        nees = np.sum(miss[:, step] * np.linalg.solve(spread[:, step, :2, :2], miss[:, step, :, None])[..., 0])
        low, high = chi2.ppf([OUTSIDE / 2, 1 - OUTSIDE / 2], 2 * runs)
        assert low < nees < high, step
    assert np.linalg.eigvalsh(spread[:, 39]).min() > 0


def test_what_was_learnt_of_steps_goes_on_in_the_blind_zone() -> None:
    miss, alone, _ = walks(200, 60, 0.01, slice(40, 60))
    # ten metres walked blind: with what was learnt before a third of what fresh steps would be off by
    blind = miss[:, 59] - miss[:, 39]
    fresh = alone[:, 19]  # the first ten metres
    assert np.sqrt(np.mean(blind**2)) < 0.75 * np.sqrt(np.mean(fresh**2))


def test_without_any_fix_it_is_dead_reckoning() -> None:
    miss, alone, _ = walks(3, 10, 0.01, slice(0, 10))
    np.testing.assert_allclose(miss, alone, atol=1e-12)
