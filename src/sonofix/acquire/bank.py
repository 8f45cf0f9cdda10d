"""The bank of stretched replicas: planned once, run often.

A receding source stretches the burst: heard at range rate v its time runs at the scale 1 − v/c. At 2 m/s a
511-chip code slips by three chips, so the replica is stretched and not only shifted in frequency.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.baseband import Band
from sonofix.records import Floats, Waveform
from sonofix.signals.interpolate import read

LOSS_DB = 1.0
"""Of correlation power at the edge of a velocity cell, at worst."""

MOST_KEPT = 3
"""Transform lengths whose spectra are kept: of a whole search, of one for the clock, and of one cut short."""


@dataclass(frozen=True, slots=True, eq=False)
class Bank:
    """Replicas of one emitter at a row of range rates.

    Attributes
    ----------
    emitter : str
    waveform : Waveform
        As it stands in the base band.
    range_rate_mps : float64 (m,)
        Ascending.
    replicas : complex64 (m, n)
        Unit energy, sampled at the base band's rate; sample 0 stands ``lead_s`` before the burst's start.
    lead_s : float
    sound_speed_mps : float
    energy : float
        Of the signature at unit gain, in base-band samples.
    kept : dict
        Spectra by transform length, filled by `spectra`.
    """

    emitter: str
    waveform: Waveform
    range_rate_mps: Floats
    replicas: NDArray[np.complex64]
    lead_s: float
    sound_speed_mps: float
    energy: float
    kept: dict[int, NDArray[np.complex64]] = field(default_factory=dict, repr=False)

    @property
    def step_mps(self) -> float:
        """Between two range rates, m/s; 0 where there is but one."""
        return float(self.range_rate_mps[1] - self.range_rate_mps[0]) if len(self.range_rate_mps) > 1 else 0.0

    def length(self, delays: int) -> int:
        """Transform length that holds so many delays of the replicas."""
        import scipy.fft

        return int(scipy.fft.next_fast_len(self.replicas.shape[1] + delays) or 0)

    def spectra(self, length: int) -> NDArray[np.complex64]:
        """Conjugate spectra (m, length) of the replicas, ready to multiply with a spectrum of samples.

        Kept once computed: a plan searches a few lengths, over and over.
        """
        import scipy.fft

        if length not in self.kept:
            if len(self.kept) >= MOST_KEPT:
                self.kept.pop(next(iter(self.kept)))
            self.kept[length] = np.conj(np.asarray(scipy.fft.fft(self.replicas, length, axis=-1)))
        return self.kept[length]


def velocity_step_mps(waveform: Waveform, sound_speed_mps: float) -> float:
    """Spacing of range rates at which the worst loss, half a step away, is ``LOSS_DB``.

    A range rate off by δ turns each frequency of a burst of length T by 2π f δ/c T, so that the correlation falls as
    sinc(f δ T / c) with f² the burst's mean square frequency: the carrier's, and a little for its width.
    """
    x = np.linspace(0.0, 1.0, 4001)
    allowed = x[np.searchsorted(-(np.sinc(x) ** 2), -(10 ** (-LOSS_DB / 10)))]
    spectrum = np.abs(np.fft.fft(waveform.signature)) ** 2
    offset_hz = np.fft.fftfreq(len(spectrum), 1.0 / waveform.rate_hz)
    frequency_hz = np.sqrt(waveform.carrier_hz**2 + np.sum(spectrum * offset_hz**2) / np.sum(spectrum))
    # the envelope is strong at some times and weak at others, which sinc takes as even: 5 % in hand
    return float(0.95 * 2.0 * allowed * sound_speed_mps / (frequency_hz * waveform.duration_s))


@numba.njit(cache=True)
def stretched(
    table: NDArray[np.complex128],
    table_rate_hz: float,
    table_start_s: float,
    half_s: float,
    carrier_hz: float,
    betas: Floats,
    rate_hz: float,
    lead_s: float,
    count: int,
) -> NDArray[np.complex64]:
    """Unit-energy replicas (m, count) at range rates ``betas`` (m,) over c.

    Stretched about the burst's middle, so that a delay means the same moment at every rate.
    """
    out = np.zeros((betas.shape[0], count), np.complex64)
    for row in range(betas.shape[0]):
        energy = 0.0
        turn = -2.0 * np.pi * carrier_hz * betas[row]
        ahead = complex(np.cos(turn / rate_hz), np.sin(turn / rate_hz))
        carrier = 1.0 + 0.0j
        for n in range(count):
            u = n / rate_hz - lead_s - half_s
            if n % 256 == 0:
                carrier = complex(np.cos(turn * u), np.sin(turn * u))
            else:
                carrier *= ahead
            position = (half_s + (1.0 - betas[row]) * u - table_start_s) * table_rate_hz
            if position < 1.0 or position > table.shape[0] - 3.0:
                continue
            value = read(table, position) * carrier
            out[row, n] = value
            energy += value.real**2 + value.imag**2
        for n in range(count):
            out[row, n] /= np.sqrt(energy)
    return out


def make_bank(emitter: str, waveform: Waveform, band: Band, max_rate_mps: float, sound_speed_mps: float) -> Bank:
    """Plan the replicas of one emitter for range rates within ±``max_rate_mps``.

    ``waveform`` is the band-limited burst.
    """
    step = velocity_step_mps(waveform, sound_speed_mps)
    half = int(np.ceil(max_rate_mps / step - 0.5)) if max_rate_mps > step / 2 else 0
    rates = step * np.arange(-half, half + 1)
    lead_s = -waveform.start_s
    slowest = 1.0 - max(0.0, float(rates[-1])) / sound_speed_mps
    end_s = waveform.start_s + len(waveform.signature) / waveform.rate_hz
    count = int(np.ceil((end_s / slowest + lead_s / slowest) * band.rate_hz)) + 1
    replicas = stretched(
        waveform.signature,
        waveform.rate_hz,
        waveform.start_s,
        waveform.duration_s / 2,
        waveform.carrier_hz,
        rates / sound_speed_mps,
        band.rate_hz,
        lead_s,
        count,
    )
    energy = float(np.sum(np.abs(waveform.signature) ** 2)) * band.rate_hz / waveform.rate_hz
    return Bank(emitter, waveform, rates, replicas, lead_s, sound_speed_mps, energy)
