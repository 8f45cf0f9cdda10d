"""Sound from one emitter to one microphone, both possibly moving: retarded time solved for every sample.

What a microphone hears at t left the emitter δ earlier, with ``c δ = |p_mic(t) − p_emitter(t − δ)|``; the burst's own
time is then ``τ = (t − δ − s) / stretch`` for a burst started at s. Doppler shift, stretch of the envelope and their
change during the burst all follow from that one equation; no narrow-band approximation is made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from sonofix.records import Floats, Waveform
from sonofix.signals.interpolate import read

KNOT_S = 1e-3
"""Spacing of the knots in a `PoseTable`."""

NEAREST_M = 0.01
"""Distance below which spreading grows no further: no transducer is a point."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable:
    """Where one emitter or microphone is: knots at ``(first_knot + i) * KNOT_S``, cubic Hermite between them.

    ``position_m``, ``velocity_mps``: float64 (k, 3), k ≥ 2, C-contiguous. Where the acceleration jumps by a, the curve
    is off by less than a · KNOT_S² / 16 (0.5 µm at 8 m/s²); elsewhere by far less.
    """

    first_knot: int
    position_m: Floats
    velocity_mps: Floats


# The helpers below are compiled into their callers: Numba gives their arguments types.
@numba.njit(cache=True, inline="always")
def _place(position, velocity, where):
    """Position at ``where`` knots after the table's first; beyond the table, its end is held."""
    last = position.shape[0] - 1
    where = min(max(where, 0.0), float(last))
    i = min(int(where), last - 1)
    x = where - i
    y = 1.0 - x
    a, b = (1.0 + 2.0 * x) * y * y, x * x * (3.0 - 2.0 * x)
    m, n = x * y * y * KNOT_S, -x * x * y * KNOT_S
    px = a * position[i, 0] + b * position[i + 1, 0] + m * velocity[i, 0] + n * velocity[i + 1, 0]
    py = a * position[i, 1] + b * position[i + 1, 1] + m * velocity[i, 1] + n * velocity[i + 1, 1]
    pz = a * position[i, 2] + b * position[i + 1, 2] + m * velocity[i, 2] + n * velocity[i + 1, 2]
    return px, py, pz


@numba.njit(cache=True)
def _delay(time_s, guess_s, mic_knot, mic_p, mic_v, emit_knot, emit_p, emit_v, sound_speed_mps):
    """Solve ``c δ = |p_mic(t) − p_emitter(t − δ)|`` by Newton's method; return (δ, distance).

    The slope takes the emitter's velocity at the nearest knot; that it is not exact costs a step, not accuracy. From
    the sample before, two steps suffice. A step below 1e-14 s ends it: rounding of t leaves more after 100 s.
    """
    mx, my, mz = _place(mic_p, mic_v, time_s / KNOT_S - mic_knot)
    delay_s = guess_s
    distance_m = 0.0
    for _ in range(50):
        where = (time_s - delay_s) / KNOT_S - emit_knot
        ex, ey, ez = _place(emit_p, emit_v, where)
        dx, dy, dz = mx - ex, my - ey, mz - ez
        distance_m = np.sqrt(dx * dx + dy * dy + dz * dz)
        i = min(max(int(where + 0.5), 0), emit_p.shape[0] - 1)
        closing = (dx * emit_v[i, 0] + dy * emit_v[i, 1] + dz * emit_v[i, 2]) / max(distance_m, 1e-9)
        step = (distance_m / sound_speed_mps - delay_s) / (1.0 - closing / sound_speed_mps)
        delay_s += step
        if abs(step) < 1e-14:
            break
    return delay_s, distance_m


@numba.njit(cache=True)
def _delays(time_s, mic_knot, mic_p, mic_v, emit_knot, emit_p, emit_v, sound_speed_mps):
    out = np.empty(time_s.shape[0])
    guess_s = 0.0
    for n in range(time_s.shape[0]):
        guess_s, _ = _delay(time_s[n], guess_s, mic_knot, mic_p, mic_v, emit_knot, emit_p, emit_v, sound_speed_mps)
        out[n] = guess_s
    return out


@numba.njit(cache=True)
def _add(
    out,
    first_sample,
    rate_hz,
    mic_delay_s,
    mic_knot,
    mic_p,
    mic_v,
    emit_knot,
    emit_p,
    emit_v,
    sound_speed_mps,
    starts_s,
    stretch,
    envelope,
    envelope_hz,
    envelope_start_s,
    carrier_hz,
    gain,
    absorption_per_m,
):
    count = out.shape[0]
    last_s = envelope_start_s + (envelope.shape[0] - 1) / envelope_hz
    for k in range(starts_s.shape[0]):
        begin_s = starts_s[k] + envelope_start_s * stretch
        end_s = starts_s[k] + last_s * stretch
        # emission times grow with the sample number: halve intervals to find the first sample that hears the burst
        low, high = 0, count
        guess_s = 0.0
        while low < high:
            n = (low + high) // 2
            t = (first_sample + n) / rate_hz - mic_delay_s
            guess_s, _ = _delay(t, guess_s, mic_knot, mic_p, mic_v, emit_knot, emit_p, emit_v, sound_speed_mps)
            if t - guess_s < begin_s:
                low = n + 1
            else:
                high = n
        for n in range(low, count):
            t = (first_sample + n) / rate_hz - mic_delay_s
            guess_s, d = _delay(t, guess_s, mic_knot, mic_p, mic_v, emit_knot, emit_p, emit_v, sound_speed_mps)
            if t - guess_s > end_s:
                break
            tau = (t - starts_s[k] - guess_s) / stretch
            value = read(envelope, (tau - envelope_start_s) * envelope_hz)
            phase = 2.0 * np.pi * carrier_hz * tau
            sound = value.real * np.cos(phase) - value.imag * np.sin(phase)
            out[n] += gain * np.exp(-absorption_per_m * d) / max(d, NEAREST_M) * sound


def emission_delay_s(time_s: Floats, microphone: PoseTable, emitter: PoseTable, sound_speed_mps: float) -> Floats:
    """How long before ``time_s`` (n,) the sound heard then was sent, seconds (n,)."""
    return _delays(
        np.ascontiguousarray(time_s, dtype=np.float64),
        microphone.first_knot,
        microphone.position_m,
        microphone.velocity_mps,
        emitter.first_knot,
        emitter.position_m,
        emitter.velocity_mps,
        sound_speed_mps,
    )


def add_sound(
    out: Floats,
    first_sample: int,
    rate_hz: float,
    microphone: PoseTable,
    emitter: PoseTable,
    waveform: Waveform,
    starts_s: Floats,
    *,
    sound_speed_mps: float,
    gain: float,
    absorption_db_per_m: float,
    stretch: float = 1.0,
    microphone_delay_s: float = 0.0,
) -> None:
    """Add to ``out`` what a microphone hears of one emitter's bursts.

    Parameters
    ----------
    out : float64 (n,), changed in place
        Sample i stands at ``(first_sample + i) / rate_hz`` on the recorder's clock and holds the sound that
        reached the microphone ``microphone_delay_s`` before.
    first_sample : int
    rate_hz : float
    microphone, emitter : PoseTable
        Must cover the samples' times, and the emitter's also the travel time before them. Slower than sound.
    waveform : Waveform
    starts_s : float64 (k,)
        When the bursts leave the emitter, recorder's clock.
    sound_speed_mps : float
    gain : float
        Amplitude that an envelope of 1 would have at 1 m without absorption.
    absorption_db_per_m : float
    stretch : float
        Recorder's seconds for each second of the beacon's clock.
    microphone_delay_s : float
    """
    _add(
        out,
        first_sample,
        float(rate_hz),
        float(microphone_delay_s),
        microphone.first_knot,
        microphone.position_m,
        microphone.velocity_mps,
        emitter.first_knot,
        emitter.position_m,
        emitter.velocity_mps,
        float(sound_speed_mps),
        np.ascontiguousarray(starts_s, dtype=np.float64),
        float(stretch),
        np.ascontiguousarray(waveform.envelope, dtype=np.complex128),
        float(waveform.rate_hz),
        float(waveform.start_s),
        float(waveform.carrier_hz),
        float(gain),
        float(absorption_db_per_m) * np.log(10.0) / 20.0,
    )
