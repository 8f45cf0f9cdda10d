"""Stretches of samples as slices of their spectrum: the band about the carrier, and nothing else.

All of a calibration happens on such slices: a delay is a phase ramp, an average a sum.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, Waveform
from sonofix.signals.interpolate import sample

Complexes = NDArray[np.complex128]

FULL_SCALE = 0.9995
"""At or above, a sample counts as clipped."""

LOUD, LEAST_ON_RAIL, RAIL_SHARE = 0.05, 20, 0.45
"""A level below which no rail is looked for; how many samples lie on one; their share of those in the upper fifth."""


@dataclass(frozen=True)
class Slice:
    """Which part of a spectrum: bins ``low`` to ``high`` (exclusive) of a transform of ``length`` samples."""

    rate_hz: float
    length: int
    carrier_hz: float
    low: int
    high: int

    @cached_property
    def offset_hz(self) -> Floats:
        """Frequencies of the bins less the carrier, (b,)."""
        return np.arange(self.low, self.high) * (self.rate_hz / self.length) - self.carrier_hz

    @property
    def course_count(self) -> int:
        """Points in time that `course` returns: twice as many as the band needs."""
        import scipy.fft

        return int(scipy.fft.next_fast_len(2 * (self.high - self.low)) or 0)

    @property
    def course_rate_hz(self) -> float:
        """Rate of those points."""
        return self.course_count * self.rate_hz / self.length

    def of(self, samples: NDArray[np.floating]) -> Complexes:
        """Slice of real samples (n ≤ length,), (b,)."""
        import scipy.fft

        return np.asarray(scipy.fft.rfft(samples, self.length))[self.low : self.high]

    def of_waveform(self, table: Complexes, waveform: Waveform) -> Complexes:
        """Slice of a burst whose time 0 is sample 0, (b,): ``table`` is its envelope or signature."""
        import scipy.fft

        # chips have edges: at four times the rate what folds back into the band is 12 dB less
        fine = 4
        rate_hz, count = fine * self.rate_hz, fine * self.length
        lead = int(np.ceil(max(0.0, -waveform.start_s) * rate_hz))
        tau = (np.arange(count) - lead) / rate_hz
        envelope = sample(table, waveform.rate_hz, waveform.start_s, tau)
        real = np.real(envelope * np.exp(2j * np.pi * self.carrier_hz * tau))
        spectrum: Complexes = np.asarray(scipy.fft.rfft(real), np.complex128)[self.low : self.high] / fine
        return self.delayed(spectrum, -lead / rate_hz)

    def delayed(self, spectrum: Complexes, delay_s: float | Floats) -> Complexes:
        """Envelope of a slice (…, b) delayed by ``delay_s`` (…); the carrier's phase stays with the envelope."""
        return spectrum * np.exp(-2j * np.pi * np.multiply.outer(np.asarray(delay_s), self.offset_hz))

    def course(self, spectrum: Complexes) -> Complexes:
        """Complex envelope over time of a slice (…, b), full scale 1: points at ``course_rate_hz`` from sample 0 on."""
        import scipy.fft

        count = self.course_count
        points = np.asarray(scipy.fft.ifft(spectrum, count, axis=-1)) * (2.0 * count / self.length)
        turn = 2j * np.pi * self.offset_hz[0] * np.arange(count) / self.course_rate_hz
        return points * np.exp(turn)

    def samples(self, spectrum: Complexes) -> Floats:
        """Real samples (length,) of a slice; the rest of the spectrum is silent."""
        import scipy.fft

        whole = np.zeros(self.length // 2 + 1, np.complex128)
        whole[self.low : self.high] = spectrum
        return np.asarray(scipy.fft.irfft(whole, self.length))


def make_slice(rate_hz: float, count: int, carrier_hz: float, half_width_hz: float) -> Slice:
    """Plan slices of stretches of at least ``count`` samples, ``half_width_hz`` to either side of the carrier.

    Raises
    ------
    ValueError
        If the carrier does not fit into the sample rate.
    """
    import scipy.fft

    if carrier_hz >= 0.48 * rate_hz:
        raise ValueError(
            f"a carrier of {carrier_hz:g} Hz needs samples faster than {carrier_hz / 0.48:.0f} Hz; these come at "
            f"{rate_hz:g} Hz: record faster, or correct carrier_hz"
        )
    half_width_hz = min(half_width_hz, 0.8 * carrier_hz, 0.95 * (rate_hz / 2 - carrier_hz))
    length = int(scipy.fft.next_fast_len(count, real=True) or 0)
    step_hz = rate_hz / length
    low, high = int(np.ceil((carrier_hz - half_width_hz) / step_hz)), int((carrier_hz + half_width_hz) / step_hz) + 1
    return Slice(rate_hz, length, carrier_hz, max(low, 1), min(high, length // 2))


def stretches(
    blocks: Callable[[int], Iterator[NDArray[np.float32]]], channel: int, hop: int, count: int
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Read one channel in overlapping stretches of ``count`` samples, ``hop`` apart; the last ones are shorter.

    Yields
    ------
    (first, samples) : index of the stretch's first sample, float32 (≤ count,); not finite becomes 0
    """
    held, first = np.zeros(0, np.float32), 0
    for block in blocks(max(hop, 1)):
        fresh = block[:, channel]
        held = np.concatenate([held, np.where(np.isfinite(fresh), fresh, np.float32(0))])
        while len(held) >= count:
            yield first, held[:count]
            held, first = held[hop:], first + hop
    while len(held):
        yield first, held[:count]
        held, first = held[hop:], first + hop


def is_clipped(samples: NDArray[np.float32]) -> bool:
    """Say whether samples were cut off: at full scale, or flat-topped below it."""
    if np.count_nonzero(np.abs(samples) >= FULL_SCALE) > 1:
        return True
    for side in (samples, -samples):
        top = float(side.max(initial=0.0))
        on_rail = int(np.count_nonzero(side == top))
        # a rail repeats one value; an even sine spreads over the fifth below its top
        if top > LOUD and on_rail >= LEAST_ON_RAIL and on_rail > RAIL_SHARE * np.count_nonzero(side > 0.8 * top):
            return True
    return False
