"""The search of the first seed as it is printed: full rate, no stretch, delay × frequency. A reference, not a receiver.

Tests and benchmarks hold `search` against it. What it leaves out shows: the envelope of a moving source is stretched,
and a window that is not loses height and, with it, the delay. The plane of equation 6 can be had a `row` at a time
(one frequency, all delays) or, as a short-time Fourier transform is printed, a `column` (one delay, all frequencies);
rows take far less time, so the search goes by rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, Waveform
from sonofix.signals.interpolate import sample

Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Cell:
    """The highest cell of the plane, eq 5: delay N̂ in samples, frequency ω̂ in Hz, and the modulus there."""

    delay: int
    frequency_hz: float
    height: float


def window_of(waveform: Waveform, rate_hz: float) -> Complexes:
    """Return the burst's envelope a(n) at the recording's rate, (m,): the seed's calibration, with D0 = 0.

    Sample 0 is the start of the first chip; the ring after the last chip is kept.
    """
    end_s = waveform.start_s + (len(waveform.envelope) - 3) / waveform.rate_hz
    tau = np.arange(int(end_s * rate_hz)) / rate_hz
    return sample(waveform.envelope, waveform.rate_hz, waveform.start_s, tau)


def analytic(samples: Floats | NDArray[np.float32]) -> Complexes:
    """Return the positive-frequency part r⁺ of real samples (n,): ``Re r⁺ = r``."""
    import scipy.fft

    count = len(samples)
    spectrum = np.asarray(scipy.fft.fft(np.asarray(samples, np.float64)))
    spectrum[1 : (count + 1) // 2] *= 2.0
    spectrum[count // 2 + 1 :] = 0.0
    return np.asarray(scipy.fft.ifft(spectrum))


def spectrum_of(window: Complexes, delays: int) -> Complexes:
    """Conjugate spectrum of a window, long enough that so many delays do not wrap round."""
    import scipy.fft

    length = int(scipy.fft.next_fast_len(delays - 1 + len(window)) or 0)
    return np.conj(np.asarray(scipy.fft.fft(window, length)))


def row(positive: Complexes, spectrum: Complexes, frequency_hz: float, rate_hz: float, delays: int) -> Floats:
    """Modulus of eq 6 at the delays 0 … ``delays`` − 1 of one frequency, (delays,).

    ``|Σ_n r⁺(n) exp(−iωn) a*(n − m)|`` by one fast convolution; ``spectrum`` is the window's, by `spectrum_of`.
    """
    import scipy.fft

    heard = positive[: len(spectrum)]
    mixed = heard * np.exp(-2j * np.pi * frequency_hz / rate_hz * np.arange(len(heard)))
    correlation: Complexes = np.asarray(scipy.fft.ifft(np.asarray(scipy.fft.fft(mixed, len(spectrum))) * spectrum))
    return np.abs(correlation[:delays])


def column(positive: Complexes, window: Complexes, delay: int, length: int) -> Floats:
    """Modulus of eq 6 at one delay, at the frequencies ``k rate_hz / length``, (length,).

    One transform of the stretch under the window: what the seed calls the short-time Fourier transform.
    """
    import scipy.fft

    under = positive[delay : delay + len(window)]
    spectrum: Complexes = np.asarray(scipy.fft.fft(under * np.conj(window[: len(under)]), length))
    return np.abs(spectrum)


def search_literally(
    samples: Floats | NDArray[np.float32], rate_hz: float, window: Complexes, frequencies_hz: Floats, delays: int
) -> Cell:
    """Find delay and frequency of one beacon's burst, first seed, eqs 4–6.

    Equation 5 maximises equation 6 over the plane of delays m = 0 … ``delays`` − 1 and ``frequencies_hz``; equation 4
    turns the delay into the range ``D0 + c N̂ / rate_hz``, with D0 = 0 for a `window_of` a waveform.

    Parameters
    ----------
    samples : float (n,)
        One channel at the full rate.
    rate_hz : float
    window : complex128 (m,)
        The beacon's envelope at that rate.
    frequencies_hz : float64 (k,)
        Where the Doppler-shifted carrier is looked for.
    delays : int
        In samples; a burst may begin at any of the first so many.

    Raises
    ------
    ValueError
        If there is no delay or no frequency to search.
    """
    if delays < 1 or not len(frequencies_hz):
        raise ValueError(
            f"nothing to search: {delays} delays, {len(frequencies_hz)} frequencies; at least one of each is needed"
        )
    positive, spectrum = analytic(samples), spectrum_of(window, delays)
    best = Cell(0, float(frequencies_hz[0]), -1.0)
    for frequency_hz in frequencies_hz:
        height = row(positive, spectrum, float(frequency_hz), rate_hz, delays)
        at = int(np.argmax(height))
        if height[at] > best.height:
            best = Cell(at, float(frequency_hz), float(height[at]))
    return best
