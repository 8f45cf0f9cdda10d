"""The table reader: exact on cubics, as accurate as it claims on bursts, silent outside."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from sonofix.acquire.baseband import band_limited, design_band
from sonofix.signals.interpolate import read, read_slope, sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

CHIPS = np.array([1, 1, 1, 1, 1, 0, 0, 1, 1, 0, 1, 0, 0, 1, 0, 0], np.int8)


def lagrange(table: np.ndarray, position: float) -> complex:
    """Plain twin: four-point Lagrange, by its definition."""
    i = int(np.floor(position))
    nodes = np.arange(i - 1, i + 3)
    return sum(
        table[a] * np.prod([(position - b) / (a - b) for b in nodes if b != a]) for a in nodes if 0 <= a < len(table)
    )


def test_reader_is_its_plain_twin(rng: np.random.Generator) -> None:
    table = rng.standard_normal(40) + 1j * rng.standard_normal(40)
    for position in rng.uniform(1.0, 37.0, 200):
        assert read(table, position) == pytest.approx(lagrange(table, position), abs=1e-12)
        step = 1e-6
        # one cubic holds from node to node
        if np.floor(position - step) == np.floor(position + step):
            slope = (read(table, position + step) - read(table, position - step)) / (2 * step)
            assert read_slope(table, position) == pytest.approx(slope, abs=1e-7)


def test_cubics_are_read_exactly(rng: np.random.Generator) -> None:
    cubic = Polynomial([1.0, -0.3, 0.02, 1e-3]) * (1 + 0.5j)
    table = cubic(np.arange(30.0))
    for position in rng.uniform(1.0, 27.0, 100):
        assert read(table, position) == pytest.approx(cubic(position), rel=1e-12)
        assert read_slope(table, position) == pytest.approx(cubic.deriv()(position), rel=1e-12)


def test_nodes_are_read_as_they_stand(rng: np.random.Generator) -> None:
    table = rng.standard_normal(20) + 0j
    values = sample(table, 10.0, -0.5, -0.5 + np.arange(2, 17) / 10.0)
    np.testing.assert_allclose(values, table[2:17], atol=1e-12)


def test_outside_the_table_is_silence() -> None:
    table = np.ones(10, complex)
    tau = np.array([-1e9, -1.0, 0.5, 8.5, 9.0, 10.0, 1e9])
    assert not sample(table, 1.0, 0.0, tau).any()
    assert all(read_slope(table, t) == 0 for t in tau)
    assert sample(table, 1.0, 0.0, np.array([1.0, 4.5, 7.9])).real == pytest.approx([1.0, 1.0, 1.0])


@pytest.mark.parametrize("modulation", ["ask", "bpsk"])
def test_error_inside_the_band_is_as_stated(modulation: str) -> None:
    """Against the table's own band-limited curve (its Fourier series), at places between the nodes."""
    signal = Signal.model_validate(
        {"carrier_hz": 40e3, "modulation": modulation, "cycles_per_chip": 10, "bandwidth_hz": 4e3}
    )
    w = keyed_waveform(CHIPS, signal)
    w = band_limited(w, design_band([w], 192e3))
    n = len(w.envelope)
    spectrum, order = np.fft.fft(w.envelope), np.fft.fftfreq(n) * n
    for shift in (0.25, 0.5, 0.8):
        exact = np.fft.ifft(spectrum * np.exp(2j * np.pi * order * shift / n))
        found = sample(w.envelope, w.rate_hz, w.start_s, w.start_s + (np.arange(n) + shift) / w.rate_hz)
        inside = slice(8, n - 8)
        assert np.linalg.norm((found - exact)[inside]) <= 1e-5 * np.linalg.norm(exact)
        np.testing.assert_allclose(found[inside], exact[inside], rtol=0, atol=1e-5 * np.abs(exact).max())
