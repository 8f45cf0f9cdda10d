"""What one chip sounds like: a known code taken out of a learnt burst again.

Whatever lies between the keyed chips and the samples (driver, two transducers, microphone, the room) is linear and
short, so that the burst's slice is the product of the bare code's and one response, known at far more frequencies than
the response has unknowns. Late in it stand the room's echoes, which do not belong into a reference: they are cut off
there, as a loudspeaker is measured in an ordinary room.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonofix.records import Floats, Path
from sonofix.signals.waveform import chips_of
from sonofix.site import Beacon, ChirpCode, Signal
from sonofix.survey.slices import Complexes, Slice

BEFORE_S = 1e-3
FADE_S = 3e-4
FAINTEST_DB = -30.0


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """Taps (r,) at ``time_s`` after the start of a chip, and the slice (b,) that they make of the code."""

    time_s: Floats
    taps: Complexes
    made: Complexes


def bare_code(beacon: Beacon, signal: Signal, part: Slice, stretch: float = 0.0) -> Complexes | None:
    """Slice (b,) of a beacon's code before any transducer: an impulse a chip, or the plain chirp; None if unknown.

    ``stretch`` is the relative excess of the beacon's clock: chips come faster by it, on a higher carrier.
    """
    scale = 1.0 + stretch
    if isinstance(beacon.code, ChirpCode):
        code = beacon.code
        fine = 4
        tau = np.arange(int(code.duration_s / scale * fine * part.rate_hz)) / (fine * part.rate_hz) * scale
        turns = code.start_hz * tau + (code.stop_hz - code.start_hz) * tau**2 / (2 * code.duration_s)
        spectrum = np.fft.rfft(np.cos(2 * np.pi * turns), fine * part.length)
        return spectrum[part.low : part.high] / fine
    chips = chips_of(beacon)
    if chips is None or signal.cycles_per_chip is None:
        return None
    chip_s = signal.cycles_per_chip / signal.carrier_hz / scale
    levels = chips.astype(float) if signal.modulation == "ask" else 2.0 * chips - 1.0
    time_s = chip_s * np.arange(len(levels))
    turned = levels * np.exp(2j * np.pi * stretch * signal.carrier_hz * time_s)
    sums = np.zeros(len(part.offset_hz), np.complex128)
    for begin in range(0, len(levels), 64):
        some = slice(begin, begin + 64)
        sums += turned[some] @ np.exp(-2j * np.pi * np.multiply.outer(time_s[some], part.offset_hz))
    return sums


def chip_response(burst: Complexes, noise: Floats, code: Complexes, part: Slice, until_s: float) -> Response:
    """Least-squares response from `BEFORE_S` before a chip's start until ``until_s`` after it.

    Parameters
    ----------
    burst : complex128 (b,)
        Slice of the learnt burst, its time 0 at sample 0.
    noise : float64 (b,)
        Of one burst, up to a factor.
    code : complex128 (b,)
    """
    from scipy.linalg import solve_toeplitz

    step_s = part.length / part.rate_hz / (part.high - part.low)
    lags = np.arange(-int(np.ceil(BEFORE_S / step_s)), int(np.ceil(until_s / step_s)) + 1)
    weight = 1.0 / noise
    turn = 2j * np.pi * part.offset_hz * step_s
    ahead = np.arange(len(lags))
    both = weight * np.abs(code) ** 2
    first = np.exp(np.multiply.outer(ahead, turn)) @ both
    right = np.exp(np.multiply.outer(lags, turn)) @ (weight * np.conj(code) * burst)
    first[0] *= 1.0 + 1e-6
    taps: Complexes = np.asarray(solve_toeplitz((first, np.conj(first)), right), np.complex128)
    return Response(lags * step_s, taps, code * (taps @ np.exp(-np.multiply.outer(lags, turn))))


def gated(response: Response, code: Complexes, part: Slice, gate_s: float) -> Complexes:
    """Slice (b,) of the burst without what comes later than ``gate_s``."""
    fade = np.clip((gate_s + FADE_S - response.time_s) / FADE_S, 0.0, 1.0)
    taps = response.taps * np.sin(0.5 * np.pi * fade) ** 2
    return code * (taps @ np.exp(-2j * np.pi * np.multiply.outer(response.time_s, part.offset_hz)))


def echoes_in(response: Response, gate_s: float, noise_power: float, most: int = 3) -> tuple[Path, ...]:
    """Peaks of the response later than the gate, strongest first: no fainter than -30 dB, and above the noise."""
    size = np.abs(response.taps)
    top = int(np.argmax(size * (response.time_s <= gate_s)))
    peaks = (size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:])
    at = 1 + np.flatnonzero(peaks & (response.time_s[1:-1] > gate_s))
    floor = max(10 ** (FAINTEST_DB / 20) * float(size[top]), 4.0 * np.sqrt(noise_power))
    at = at[size[at] > floor]
    at = at[np.argsort(-size[at])][:most]
    return tuple(
        Path(float(response.time_s[i] - response.time_s[top]), float(20 * np.log10(size[i] / size[top]))) for i in at
    )


def foreign_share(left: Complexes, whole: Complexes, other: Complexes, noise: Floats, part: Slice) -> float:
    """Share of a burst's power that another beacon's code explains, at its best delay; 0 where noise would do.

    ``left`` is what the own code does not explain of ``whole``, ``noise`` its noise, ``other`` the other's slice.
    """
    power = np.abs(part.course(left * np.conj(other) / noise)) ** 2
    level = float(np.median(power)) / np.log(2.0)
    if power.max() < 3.0 * np.log(len(power)) * level:
        return 0.0
    best = float(np.max(np.abs(part.course(left * np.conj(other))))) * part.length / 2.0
    return best**2 / float(np.sum(np.abs(other) ** 2)) / float(np.sum(np.abs(whole) ** 2))
