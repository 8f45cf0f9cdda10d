"""Band-pass, mixing and decimation in one kernel: real samples → complex base band around a carrier."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, Waveform

STOPBAND_DB = 70.0

TABLE_DENSITY = 8
"""Samples of a band-limited burst's table for one of the base band."""

SHARE = 0.97
"""Of the energy of a burst's derivative: that, not its energy, carries the delay. What is left out costs 1.5 %."""


@dataclass(frozen=True, eq=False)
class Band:
    """One slice of the spectrum, planned once.

    Attributes
    ----------
    carrier_hz : float
        What is mixed to zero.
    half_width_hz : float
        The pass band reaches this far to either side.
    sample_rate_hz : float
        Of the recording.
    decimation : int
    taps : float32 (n,), n odd
        Linear-phase low-pass; unit gain at the carrier. Analytic parts of a real input come out with amplitude 1
        (the factor 2 of Re → analytic is inside).
    """

    carrier_hz: float
    half_width_hz: float
    sample_rate_hz: float
    decimation: int
    taps: NDArray[np.float32]

    @property
    def rate_hz(self) -> float:
        """Sample rate of the base band."""
        return self.sample_rate_hz / self.decimation

    @cached_property
    def whiteness(self) -> float:
        """Power of noise that is white over the whole base band, over what it has behind the filter."""
        taps = self.taps / np.sum(self.taps)
        return float(1.0 / (self.decimation * np.sum(taps**2)))

    def response(self, offset_hz: Floats) -> Floats:
        """Gain of the filter at offsets from the carrier (real: its delay is accounted for)."""
        half = (len(self.taps) - 1) // 2
        # a fine grid by FFT, of the taps about their middle: linear interpolation is good to 1e-5 there
        size = 1 << int(np.ceil(np.log2(64 * len(self.taps))))
        centred = np.zeros(size)
        centred[: half + 1], centred[-half:] = self.taps[half:], self.taps[:half]
        value = np.fft.rfft(centred).real / np.sum(self.taps)
        grid = np.fft.rfftfreq(size, 1.0 / self.sample_rate_hz)
        return np.interp(np.abs(offset_hz), grid, value, right=0.0)


def design_band(waveforms: list[Waveform], sample_rate_hz: float) -> Band:
    """Plan the slice of spectrum that the bursts of one carrier fill.

    The pass band holds ``SHARE`` of the energy of the bursts' *derivative*.

    Raises
    ------
    ValueError
        If the recording's rate is too low for the carrier and this width.
    """
    carrier_hz = waveforms[0].carrier_hz
    half_width_hz = max(_half_width(w) for w in waveforms)
    half_width_hz = min(half_width_hz, 0.8 * carrier_hz)
    if carrier_hz >= sample_rate_hz / 2:
        raise ValueError(
            f"a carrier of {carrier_hz:g} Hz needs samples faster than {2 * carrier_hz:g} Hz; these come at "
            f"{sample_rate_hz:g} Hz: record faster, or correct carrier_hz"
        )
    half_width_hz = min(half_width_hz, 0.95 * (sample_rate_hz / 2 - carrier_hz))
    decimation = max(1, int(sample_rate_hz / (2.4 * half_width_hz)))
    transition_hz = sample_rate_hz / decimation - 2 * half_width_hz
    if decimation == 1:
        transition_hz = min(transition_hz, half_width_hz)
    # Kaiser's formulas for length and shape of a windowed-sinc low-pass
    count = 2 * int(np.ceil((STOPBAND_DB - 7.95) * sample_rate_hz / (14.36 * transition_hz) / 2)) + 1
    beta = 0.1102 * (STOPBAND_DB - 8.7)
    n = np.arange(count) - (count - 1) / 2
    cutoff = (half_width_hz + transition_hz / 2) / sample_rate_hz
    taps = np.kaiser(count, beta) * np.sinc(2 * cutoff * n)
    return Band(carrier_hz, half_width_hz, sample_rate_hz, decimation, (2.0 * taps / np.sum(taps)).astype(np.float32))


def _half_width(waveform: Waveform) -> float:
    """Offset from the carrier below which ``SHARE`` of the energy of the envelope's derivative lies."""
    offset_hz = np.fft.fftfreq(len(waveform.signature), 1.0 / waveform.rate_hz)
    energy = np.abs(np.fft.fft(waveform.signature)) ** 2 * offset_hz**2
    order = np.argsort(np.abs(offset_hz))
    share = np.cumsum(energy[order])
    return float(np.abs(offset_hz[order])[np.searchsorted(share, SHARE * share[-1])])


@numba.njit(cache=True, fastmath=True)
def _mix_filter(samples: NDArray[np.float32], taps_re, taps_im, decimation: int, out: NDArray[np.complex128]) -> None:
    count = taps_re.shape[0]
    for m in range(out.shape[0]):
        re = np.float32(0.0)
        im = np.float32(0.0)
        start = m * decimation
        for k in range(count):
            x = samples[start + k]
            re += taps_re[k] * x
            im += taps_im[k] * x
        out[m] = complex(re, im)


def downconvert(samples: NDArray[np.float32], first_sample: int, band: Band) -> tuple[NDArray[np.complex128], float]:
    """Base band of a stretch of samples.

    Parameters
    ----------
    samples : float32 (n,)
    first_sample : int
        Index of ``samples[0]`` in the recording: phases refer to the recorder's time 0.
    band : Band

    Returns
    -------
    baseband : complex128 (m,)
        ``m = (n − taps) // decimation + 1``, empty where ``n < taps``.
    start_s : float
        Time of ``baseband[0]`` on the recorder's clock; the rest follow at ``band.rate_hz``.
    """
    taps = len(band.taps)
    count = max(0, (len(samples) - taps) // band.decimation + 1)
    out = np.empty(count, np.complex128)
    step = band.carrier_hz / band.sample_rate_hz
    half = (taps - 1) // 2
    # the mixer sits inside the taps, centred; what is left is one rotation for each output sample
    rotation: NDArray[np.complex128] = np.exp(-2j * np.pi * step * (np.arange(taps) - half))
    _mix_filter(
        np.ascontiguousarray(samples, np.float32),
        (band.taps * rotation.real).astype(np.float32),
        (band.taps * rotation.imag).astype(np.float32),
        band.decimation,
        out,
    )
    centre = first_sample + half
    turns = (step * (centre + band.decimation * np.arange(count))) % 1.0
    return out * np.exp(-2j * np.pi * turns), centre / band.sample_rate_hz


def band_limited(waveform: Waveform, band: Band) -> Waveform:
    """Return the burst as it stands in the base band: its tables passed through the same filter.

    Tables a few times as dense as the base band's samples are enough for what is left, and stay in the cache.
    """
    import scipy.fft

    fold = max(1, int(waveform.rate_hz / (TABLE_DENSITY * band.rate_hz)))
    pad = fold * (int(np.ceil(len(band.taps) / band.sample_rate_hz * waveform.rate_hz / 2 / fold)) + 4)
    short = int(scipy.fft.next_fast_len(-(-(len(waveform.envelope) + 2 * pad) // fold)) or 0)
    gain = band.response(np.fft.fftfreq(short * fold, 1.0 / waveform.rate_hz))
    kept = np.rint(np.fft.fftfreq(short, 1.0 / short)).astype(int)

    def filtered(table: NDArray[np.complex128]) -> NDArray[np.complex128]:
        padded = np.zeros(short * fold, complex)
        padded[pad : pad + len(table)] = table
        return np.asarray(scipy.fft.ifft((np.asarray(scipy.fft.fft(padded)) * gain)[kept] / fold))

    envelope = filtered(waveform.envelope)
    signature = envelope if waveform.signature is waveform.envelope else filtered(waveform.signature)
    return Waveform(
        envelope,
        signature,
        waveform.rate_hz / fold,
        waveform.start_s - pad / waveform.rate_hz,
        waveform.carrier_hz,
        waveform.duration_s,
    )
