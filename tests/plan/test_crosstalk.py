"""Cross-talk of bursts: against sums written out, against chips, and what motion does to it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from sonofix.plan.crosstalk import Bench, highest_power, level_db, make_grid, multiplied
from sonofix.records import Waveform
from sonofix.signals.codes import aperiodic_correlation, gold, m_sequence, primitive_taps
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SPEED_MPS = 343.0


def burst(chips: np.ndarray, modulation: str = "ask", bandwidth_hz: float | None = 4e3) -> Waveform:
    signal = {"carrier_hz": 40e3, "modulation": modulation, "cycles_per_chip": 10.0, "bandwidth_hz": bandwidth_hz}
    return keyed_waveform(chips, Signal.model_validate(signal))


def bursts(degree: int, count: int, **keyed) -> list[Waveform]:
    return [burst(m_sequence(degree, taps), **keyed) for taps in primitive_taps(degree)[:count]]


def written_out(
    sent: Waveform, listened: Waveform, difference_mps: float, delay_s: np.ndarray, stretch: bool = True
) -> np.ndarray:
    """|X(τ, δ)| over the peak, straight from the definition, on the waveforms' own dense tables."""
    t = listened.start_s + np.arange(len(listened.signature)) / listened.rate_hz
    beta = difference_mps / SPEED_MPS

    def heard(time_s: np.ndarray, w: Waveform, b: float) -> np.ndarray:
        u = time_s - w.duration_s / 2
        tau = w.duration_s / 2 + (1 - b * stretch) * u
        table_s = w.start_s + np.arange(len(w.envelope)) / w.rate_hz
        real, imaginary = (np.interp(tau, table_s, part, 0, 0) for part in (w.envelope.real, w.envelope.imag))
        return (real + 1j * imaginary) * np.exp(-2j * np.pi * w.carrier_hz * b * u)

    peak = np.abs(np.vdot(listened.signature, heard(t, listened, 0.0)))
    return np.array([np.abs(np.vdot(listened.signature, heard(t + d, sent, beta))) for d in delay_s]) / peak


@pytest.mark.parametrize("modulation", ["ask", "bpsk"])
def test_levels_are_those_of_the_sum_written_out(modulation):
    waves = [burst(gold(5, 3), modulation), burst(gold(5, 9), modulation)]
    grid = make_grid(waves, 0.5, 6.0, SPEED_MPS)
    bench = Bench(waves, grid)
    delay_s = np.arange(-0.5 / SPEED_MPS, 0.5 / SPEED_MPS, 1 / 40e3)
    for sent, listened in ((0, 1), (1, 0)):
        exact = np.array([written_out(waves[sent], waves[listened], d, delay_s) for d in grid.difference_mps])
        level = bench.levels([(sent, listened)])[0]
        # 0.2 dB may be lost between two delays of the grid; what lies beyond half the sample rate is 3e-3 of the peak
        assert -0.2 < level_db(level) - level_db(exact.max()) < 0.05
        surface, difference_mps, at_s = bench.surface(sent, listened)
        assert surface.max() == pytest.approx(level, rel=1e-5)
        row = int(np.argmax(surface.max(axis=1)))
        expected = written_out(waves[sent], waves[listened], difference_mps[row], at_s)
        np.testing.assert_allclose(surface[row], expected, atol=3e-3)


def test_bare_chips_at_rest_make_their_aperiodic_correlation():
    """Rectangular chips correlate in straight lines from chip to chip, so that their worst stands at a whole chip."""
    chips = [m_sequence(6, taps) for taps in primitive_taps(6)[:3]]
    waves = [burst(c, "bpsk", None) for c in chips]
    bench = Bench(waves, make_grid(waves, np.inf, 0.0, SPEED_MPS))
    for i, j in ((0, 1), (0, 2), (2, 1)):
        worst = np.abs(aperiodic_correlation(chips[i], chips[j])).max() / 63
        assert bench.levels([(i, j)])[0] == pytest.approx(worst, rel=0.04)
    own = np.abs(aperiodic_correlation(chips[0], chips[0]))
    own[62] = 0  # the peak
    assert bench.levels([(0, 0)])[0] == pytest.approx(own.max() / 63, rel=0.05)


def test_reach_limits_the_delays():
    waves = bursts(7, 2)
    far, near = (Bench(waves, make_grid(waves, reach, 0.0, SPEED_MPS)) for reach in (20.0, 0.5))
    level, _, delay_s = far.surface(0, 1)
    inside = np.abs(delay_s) <= 0.5 / SPEED_MPS
    assert near.levels([(0, 1)])[0] == pytest.approx(level[:, inside].max(), rel=0.02)
    assert near.levels([(0, 1)])[0] < 0.9 * far.levels([(0, 1)])[0]
    endless = make_grid(waves, np.inf, 0.0, SPEED_MPS)
    assert endless.span_s == pytest.approx(len(waves[0].envelope) / waves[0].rate_hz)
    assert Bench(waves, endless).levels([(0, 1)])[0] >= far.levels([(0, 1)])[0] * 0.999


def test_motion_makes_codes_disturb_more():
    """A difference of range rate turns the carrier under the code: zeros of the correlation at rest are none then."""
    waves = bursts(7, 4)
    pairs = [(i, j) for i in range(4) for j in range(4)]
    levels = [Bench(waves, make_grid(waves, 15.0, v, SPEED_MPS)).levels(pairs) for v in (0.0, 2.0, 4.0)]
    for slow, fast in pairwise(levels):
        # steps between rates are as fine as 0.2 dB
        assert (level_db(fast) > level_db(slow) - 0.2).all()
    assert np.mean(level_db(levels[2]) - level_db(levels[0])) > 2.0


def test_the_envelope_is_stretched_with_the_carrier():
    waves = bursts(9, 2)
    grid = make_grid(waves, 2.0, 4.0, SPEED_MPS)
    surface, difference_mps, delay_s = Bench(waves, grid).surface(0, 1)
    row = len(difference_mps) - 1
    few = slice(0, len(delay_s), 9)
    stretched = written_out(waves[0], waves[1], difference_mps[row], delay_s[few])
    shifted = written_out(waves[0], waves[1], difference_mps[row], delay_s[few], stretch=False)
    np.testing.assert_allclose(surface[row, few], stretched, atol=1e-3)
    assert np.abs(surface[row, few] - shifted).max() > 0.03


def test_main_lobe_is_no_side_lobe():
    waves = bursts(8, 1)
    for v in (0.0, 1.0, 4.0):
        bench = Bench(waves, make_grid(waves, 15.0, v, SPEED_MPS))
        level, _, _ = bench.surface(0, 0)
        assert level.max() == pytest.approx(1.0, abs=0.01)
        assert bench.levels([(0, 0)])[0] < 0.5


def test_coarse_levels_are_a_little_low():
    waves = bursts(8, 6)
    bench = Bench(waves, make_grid(waves, 15.0, 2.0, SPEED_MPS))
    pairs = [(i, j) for i in range(6) for j in range(6) if i != j]
    low = level_db(bench.levels(pairs)) - level_db(bench.levels(pairs, coarse=True))
    assert low.min() > -0.05
    assert low.max() < 1.5
    assert 0.0 < low.mean() < 0.5


def test_progress_runs_from_above_zero_to_one():
    waves, seen = bursts(5, 2), []
    Bench(waves, make_grid(waves, 1.0, 8.0, SPEED_MPS)).levels([(0, 1)], on_done=seen.append)
    assert seen == sorted(seen)
    assert seen[0] > 0
    assert seen[-1] == 1.0


@pytest.mark.parametrize(
    ("reach_m", "difference_mps", "words"),
    [
        (0.0, 1.0, "reach_m = 0; it must be above 0"),
        (np.nan, 1.0, "reach_m = nan"),
        (1.0, -1.0, "max_difference_mps = -1"),
        (1.0, 40.0, "from 0 to 34.3"),
        (1.0, np.nan, "max_difference_mps = nan"),
    ],
)
def test_misuse_is_named(reach_m, difference_mps, words):
    with pytest.raises(ValueError, match=words):
        make_grid(bursts(5, 1), reach_m, difference_mps, SPEED_MPS)


def test_no_burst_is_misuse():
    with pytest.raises(ValueError, match="waveforms is empty"):
        make_grid([], 1.0, 1.0, SPEED_MPS)


def test_kernels_do_as_plain_numpy(rng):
    left, right = (
        (rng.standard_normal((4, 30)) + 1j * rng.standard_normal((4, 30))).astype(np.complex64) for _ in range(2)
    )
    a, b = np.array([0, 3, 3]), np.array([2, 2, 1])
    out = multiplied(left, a, right, b, np.empty((5, 30), np.complex64))
    np.testing.assert_allclose(out, left[a] * right[b], rtol=1e-6)
    for last in (0, 7, 15):
        lag = np.arange(-last, last + 1)
        skip = np.array([-1, 0, 3])
        plain = [
            max((np.abs(row[lag[np.abs(lag) > s]]) ** 2).tolist(), default=0.0)
            for row, s in zip(out, skip, strict=True)
        ]
        np.testing.assert_allclose(highest_power(out, last, skip), plain, rtol=1e-5)
