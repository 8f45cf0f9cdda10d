"""Power of samples by time and by frequency, in decibels: what `explain` shows of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats

SMOOTHED_S = 1e-3
"""Of the power by time."""

SEGMENT_S = 0.02
"""Of the spectra: lines 75 Hz wide, and enough of them to average."""

DEPTH = 1e-3
"""Of the quiet margins' power: what is less counts as this."""


def recorded(values: NDArray) -> tuple[int, int]:
    """First and last + 1 of the samples that were recorded: before the recording stand zeros."""
    there = np.flatnonzero(values)
    return (int(there[0]), int(there[-1]) + 1) if len(there) else (0, len(values))


def power_of(values: NDArray[np.complexfloating]) -> Floats:
    """Power of each sample, full scale² of the analytic sound."""
    return values.real**2 + values.imag**2


def decibels(power: NDArray) -> NDArray:
    """Decibels of powers (or power ratios), −300 at the least."""
    return 10 * np.log10(np.maximum(power, 1e-30))


def smoothed_db(values: NDArray[np.complex128], rate_hz: float, unit: float) -> Floats:
    """Power by time, smoothed over ``SMOOTHED_S``, dB over ``unit``; no less than ``DEPTH`` of it."""
    width = max(1, round(SMOOTHED_S * rate_hz))
    smooth = np.convolve(power_of(values), np.ones(width) / width, "same")[: len(values)]
    return decibels(np.maximum(smooth / unit, DEPTH))


def density_of(values: NDArray, rate_hz: float) -> tuple[Floats, Floats]:
    """Power density by frequency (Welch 1967), full scale² per Hz of the real sound; frequencies ascending.

    Of a complex base band, whose amplitudes are those of the sound, around its carrier.
    """
    size = min(max(16, round(SEGMENT_S * rate_hz)), len(values))
    if size < 2:
        return np.zeros(0), np.zeros(0)
    window = np.hanning(size + 2)[1:-1]
    begins = np.arange(0, len(values) - size + 1, max(1, size // 2))
    total = np.zeros(size)
    for begin in begins:
        total += np.abs(np.fft.fft(values[begin : begin + size] * window)) ** 2
    power = total / (len(begins) * rate_hz * np.sum(window**2))
    frequency_hz = np.fft.fftfreq(size, 1.0 / rate_hz)
    if np.iscomplexobj(values):
        return np.fft.fftshift(frequency_hz), np.fft.fftshift(power) / 2
    half = size // 2
    return frequency_hz[:half], 2 * power[:half]
