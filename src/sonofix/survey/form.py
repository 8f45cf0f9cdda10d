"""The form of a learnt burst: where it begins, how its carrier lies, and what of it is the beacon's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, Pace, Recording, Waveform
from sonofix.signals.waveform import chips_of
from sonofix.site import Beacon, Microphone, Signal
from sonofix.survey.align import Aligned, align_one
from sonofix.survey.chip import Response, bare_code, chip_response, gated
from sonofix.survey.slices import Complexes, Slice

USUAL_GATE_S = 2e-3
ECHO_SPAN_S, ECHO_SHARE = 12e-3, 0.7
"""How long after a chip's start echoes are looked for; and of the burst's length, or the response could be anything."""

ONSET, SUNK = 0.1, 0.03
"""Of the peak: where a burst of unknown code begins and ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Learnt:
    """All that was found out about the bursts of one beacon, before conclusions are drawn; see `burst.calibrate`."""

    recording: Recording
    beacon: Beacon
    microphone: Microphone
    nominal: Waveform | None
    part: Slice
    slices: NDArray[np.complex64]
    first_s: Floats
    aligned: Aligned
    due_s: Floats
    pace: Pace
    heard: int
    missed: int
    stride: int
    left_out: Mapping[str, int]
    period_s: float
    duration_s: float
    length_s: float | None
    distance_m: float | None
    distance_sd_m: float
    sound_speed_sd_mps: float
    lead_s: float
    gate_s: float | None

    @property
    def signal(self) -> Signal:
        """What the beacon keys its code on."""
        return self.recording.site.signal_of(self.beacon)

    @property
    def strength(self) -> float:
        """By how much averaging took the noise's power down."""
        return float(np.sum(np.abs(self.aligned.gain[self.aligned.used]) ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class Form:
    """The common burst with its time 0 at sample 0, and how it was told."""

    mean: Complexes
    clean: Complexes
    start_s: float
    match: float | None
    stretch: float | None
    stretch_sd: float | None
    response: Response | None
    gate_s: float | None
    end_s: float


def form_of(learnt: Learnt) -> Form:
    """Tell where the burst begins and, where its code is known, clean it of what comes late."""
    part, mean, noise = learnt.part, learnt.aligned.mean, learnt.aligned.noise
    quiet = noise / learnt.strength
    if learnt.nominal is None:
        return _unknown_form(learnt, quiet)
    nominal = part.of_waveform(learnt.nominal.envelope, learnt.nominal)
    moved = part.delayed(mean, -learnt.lead_s)
    start_s = learnt.lead_s + align_one(moved, nominal, noise, part.offset_hz)
    mean = part.delayed(mean, -start_s)
    if bare_code(learnt.beacon, learnt.signal, part) is None:
        end_s = learnt.duration_s + 2e-3
        return Form(mean, _gained(mean, quiet), start_s, _match(mean, nominal), None, None, None, None, end_s)
    gate_s = learnt.gate_s if learnt.gate_s is not None else USUAL_GATE_S
    until_s = ring_s(learnt, gate_s)
    stretch, stretch_sd = _stretch(learnt, mean, nominal, quiet)
    response, clean = _cleaned(learnt, mean, stretch, until_s)
    if stretch is not None:
        # echoes turned the phase a little: look again, with them in the model
        more, stretch_sd = _stretch(learnt, mean, response.made, quiet)
        stretch += more or 0.0
        response, clean = _cleaned(learnt, mean, stretch, until_s)
    if learnt.gate_s is None:
        end_s = learnt.duration_s + 4e-3
        match = _match(mean, nominal)
        return Form(mean, _gained(mean, quiet), start_s, match, stretch, stretch_sd, response, None, end_s)
    # the echoes gone, the nominal burst may lie a little better elsewhere
    moved_s = align_one(clean, nominal, noise, part.offset_hz)
    response = Response(response.time_s - moved_s, response.taps, part.delayed(response.made, -moved_s))
    clean, mean = part.delayed(clean, -moved_s), part.delayed(mean, -moved_s)
    end_s = learnt.duration_s + gate_s + 5e-4
    match = _match(clean, nominal)
    return Form(mean, clean, start_s + moved_s, match, stretch, stretch_sd, response, until_s, end_s)


def _cleaned(learnt: Learnt, mean: Complexes, stretch: float | None, until_s: float) -> tuple[Response, Complexes]:
    """Response of a chip, and the burst that it makes of the code with all later than ``until_s`` left out."""
    code = code_of(learnt, stretch)
    span_s = max(min(ECHO_SPAN_S, ECHO_SHARE * learnt.duration_s), until_s + 1e-3)
    response = chip_response(mean, learnt.aligned.noise, code, learnt.part, span_s)
    return response, gated(response, code, learnt.part, until_s)


def code_of(learnt: Learnt, stretch: float | None) -> Complexes:
    """Slice (b,) of the beacon's bare code."""
    code = bare_code(learnt.beacon, learnt.signal, learnt.part, stretch or 0.0)
    assert code is not None
    return code


def ring_s(learnt: Learnt, gate_s: float) -> float:
    """Until when after its start a chip may ring: its own length and what is allowed after it."""
    chips = chips_of(learnt.beacon)
    return gate_s + (learnt.duration_s / len(chips) if chips is not None else 0.0)


def _unknown_form(learnt: Learnt, noise: Floats) -> Form:
    """Begin the burst where its envelope first reaches a tenth of its peak; end it where it has sunk for good."""
    part, mean = learnt.part, learnt.aligned.mean
    clean = _gained(mean, noise)
    size = np.abs(part.course(clean))
    peak = float(size.max())
    first = int(np.flatnonzero(size > ONSET * peak)[0])
    before = float(size[first - 1]) if first else 0.0
    start_s = (first - (size[first] - ONSET * peak) / max(size[first] - before, 1e-30)) / part.course_rate_hz
    lasting = np.flatnonzero(size > SUNK * peak)
    end_s = learnt.length_s or float(lasting[-1]) / part.course_rate_hz - start_s
    mean, clean = part.delayed(mean, -start_s), part.delayed(clean, -start_s)
    return Form(mean, clean, start_s, None, None, None, None, None, end_s)


def _gained(mean: Complexes, noise: Floats) -> Complexes:
    """Take down the bins in which the average is mostly noise still (Wiener, on smoothed power)."""
    width = min(31, len(mean))
    power = np.pad(np.abs(mean) ** 2, width // 2, mode="reflect")
    power = np.convolve(power, np.full(width, 1.0 / width), "valid")[: len(mean)]
    return mean * np.clip(1.0 - noise / np.maximum(power, 1e-300), 0.0, 1.0)


def _match(a: Complexes, b: Complexes) -> float:
    return float(np.abs(np.vdot(a, b)) / np.linalg.norm(a) / np.linalg.norm(b))


def _stretch(learnt: Learnt, mean: Complexes, model: Complexes, noise: Floats) -> tuple[float | None, float | None]:
    """Carrier against a model's, as a share of it, from how its phase turns over the burst; and its deviation.

    None for chirps, whose shift in frequency and delay cannot be told apart.
    """
    part = learnt.part
    if chips_of(learnt.beacon) is None:
        return None, None
    ours, theirs = part.course(mean), part.course(model)
    time_s = np.arange(len(ours)) / part.course_rate_hz
    inside = time_s < learnt.duration_s
    product, time_s = (ours * np.conj(theirs))[inside], time_s[inside]
    count = 1 << int(np.ceil(np.log2(16 * len(product))))
    spectrum = np.abs(np.fft.fft(product, count))
    offsets = np.fft.fftfreq(count, 1.0 / part.course_rate_hz)
    spectrum[np.abs(offsets) > 3e-3 * part.carrier_hz] = 0.0
    top = int(np.argmax(spectrum))
    left, middle, right = spectrum[top - 1], spectrum[top], spectrum[(top + 1) % count]
    bend = left - 2 * middle + right
    fine = 0.5 * (left - right) / bend if bend < 0 else 0.0
    offset_hz = offsets[top] + fine * part.course_rate_hz / count
    weight = np.abs(ours[inside]) ** 2
    centre = float(np.sum(weight * time_s) / np.sum(weight))
    # per point: twice as many points as the band holds, so each carries half the noise
    noise_power = float(np.sum(noise)) * (2.0 / part.length) ** 2 * 2.0
    curve = float(np.sum(weight * (2 * np.pi * (time_s - centre)) ** 2))
    return float(offset_hz / part.carrier_hz), float(np.sqrt(noise_power / (2 * curve)) / part.carrier_hz)
