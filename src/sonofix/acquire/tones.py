"""Steady tones in the band: found, followed through the epoch, and taken out.

A burst's bare carrier is a line in the spectrum too, but it sounds no longer than the burst. What sounds alike in the
quiet margins before and after an epoch's bursts is a tone. Its phase is followed as a cubic and its amplitude as a
straight line through the epoch, so that a drifting source leaves little behind.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats

MARGIN_S = 0.02
"""Quiet time kept before and after an epoch's bursts."""

STANDS_OUT = 100.0
"""A line this many times the median power of the spectrum is looked at."""

MOST_TONES = 3

TOLD = re.compile(r"a tone at (?P<khz>[\d.]+) kHz, (?P<db>\d+) dB (?P<way>over|below) all else in the band")
"""What `told` writes."""

Complexes = NDArray[np.complexfloating]


@dataclass(frozen=True, slots=True, eq=False)
class Tone:
    """A tone: offset from the carrier at the stretch's middle, and its course (n,) in the base band."""

    offset_hz: float
    course: Complexes


def find_tones(baseband: Complexes, rate_hz: float) -> list[Tone]:
    """Tones that sound through all of a stretch, strongest first.

    Parameters
    ----------
    baseband : complex128 (n,)
        A whole epoch with ``MARGIN_S`` of quiet at both ends (where the recording had begun and not yet ended).
    """
    import scipy.fft

    tones: list[Tone] = []
    left = baseband
    edge = int(MARGIN_S * rate_hz)
    sounding = np.flatnonzero(baseband != 0)
    if len(sounding) < 8 * edge:
        return tones
    stretch = slice(sounding[0], sounding[-1] + 1)
    ends = [slice(sounding[0], sounding[0] + edge), slice(sounding[-1] + 1 - edge, sounding[-1] + 1)]
    window = np.hanning(stretch.stop - stretch.start)
    size = int(scipy.fft.next_fast_len(2 * len(window)) or 0)
    for _ in range(MOST_TONES):
        heard = left[stretch]
        spectrum = np.abs(np.asarray(scipy.fft.fft((heard * window).astype(np.complex64), size))) ** 2
        peak = int(np.argmax(spectrum))
        if spectrum[peak] < STANDS_OUT * np.median(spectrum):
            break
        offset_hz = float(np.fft.fftfreq(size, 1.0 / rate_hz)[peak])
        level = float(np.sqrt(spectrum[peak])) / float(np.sum(window))
        if any(_level(left[end], rate_hz, offset_hz) < 0.3 * level for end in ends):
            break
        course = np.zeros_like(left)
        course[stretch] = _follow(heard, rate_hz, offset_hz)
        if not all(_alike(left[end], course[end]) for end in ends):
            break
        tones.append(Tone(offset_hz, course))
        left = left - course
    return tones


def refit(tones: list[Tone], heard: Complexes, rate_hz: float) -> list[Tone]:
    """Follow known tones again, each in what is left by the others; ``heard`` (n,) is without the bursts."""
    out = list(tones)
    sounding = np.flatnonzero(heard != 0)
    stretch = slice(sounding[0], sounding[-1] + 1)
    for i, tone in enumerate(out):
        others = sum((other.course for j, other in enumerate(out) if j != i), np.zeros_like(heard))
        course = np.zeros_like(heard)
        course[stretch] = _follow((heard - others)[stretch], rate_hz, tone.offset_hz)
        out[i] = Tone(tone.offset_hz, course)
    return out


def _follow(heard: Complexes, rate_hz: float, offset_hz: float, rounds: int = 6) -> Complexes:
    """Least squares in cubic phase and linear amplitude, by Gauss–Newton from a steady tone."""
    u = np.linspace(-1.0, 1.0, len(heard))
    mixer = np.exp(2j * np.pi * offset_hz / rate_hz * np.arange(len(heard)))
    slow = heard * np.conj(mixer)
    powers = np.stack([np.ones_like(u), u, u**2, u**3])
    phase = np.zeros(4)
    phase[0] = np.angle(slow.mean())
    level = np.array([abs(slow.mean()), 0.0])
    for _ in range(rounds):
        carrier = np.exp(1j * (phase @ powers))
        size = level @ powers[:2]
        columns = np.concatenate([1j * size * powers, powers[:2].astype(complex)])
        miss = slow * np.conj(carrier) - size
        normal = np.einsum("in,jn->ij", np.conj(columns), columns).real
        step = np.linalg.lstsq(normal, np.einsum("in,n->i", np.conj(columns), miss).real, rcond=None)[0]
        phase = phase + np.clip(step[:4], -1.0, 1.0)
        level = level + step[4:]
    return np.asarray((level @ powers[:2]) * np.exp(1j * (phase @ powers)) * mixer, np.complex128)


def _level(heard: Complexes, rate_hz: float, offset_hz: float) -> float:
    """Amplitude of a stretch's part at a frequency."""
    return abs(complex(np.mean(heard * np.exp(-2j * np.pi * offset_hz / rate_hz * np.arange(len(heard))))))


def _alike(heard: Complexes, course: Complexes) -> bool:
    """Whether a tone sounds in a stretch as its course through the whole says, within a factor of two."""
    scale = np.sum(np.conj(course) * heard) / max(float(np.sum(np.abs(course) ** 2)), 1e-300)
    return bool(0.5 < abs(scale) < 2.0 and abs(np.angle(scale)) < 1.0)


def level_db(tone: Tone, left: Floats | Complexes) -> float:
    """Power of a tone over that of what is left, dB."""
    power = float(np.mean(np.abs(tone.course) ** 2))
    return 10 * float(np.log10(max(power, 1e-30) / max(float(np.mean(np.abs(left) ** 2)), 1e-30)))


def told(frequency_hz: float, level_db: float) -> str:
    """Word a tone that was taken out."""
    way = "below" if round(level_db) < 0 else "over"
    level = f"{abs(level_db):.0f} dB {way} all else in the band"
    return f"a tone at {frequency_hz / 1e3:.3f} kHz, {level}, was taken out"
