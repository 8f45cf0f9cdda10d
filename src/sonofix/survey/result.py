"""From aligned bursts to a calibration: conclusions drawn, the burst as samples, its delay."""

from __future__ import annotations

import numpy as np

from sonofix.records import Calibration, Path, ReferenceBurst
from sonofix.signals.waveform import reference_waveform
from sonofix.survey import judge
from sonofix.survey.chip import echoes_in
from sonofix.survey.form import USUAL_GATE_S, Form, Learnt, code_of, form_of, ring_s

FLIGHT_M = 1e-3
"""That is left in a written burst: a site file can state no distance of 0."""

PEAK = 0.9
FEW = 10


def conclude(learnt: Learnt) -> Calibration:
    """Draw the conclusions; raise ValueError where the recording cannot be learnt from."""
    part, aligned, site = learnt.part, learnt.aligned, learnt.recording.site
    form = form_of(learnt)
    amplitude = float(np.abs(part.course(form.clean)).max())
    flags = judge.check_rest(learnt) + judge.check_code(learnt, form) + judge.check_others(learnt, form)
    left = judge.leavings_of(learnt, form)
    flags += judge.check_alike(learnt, left, amplitude)
    burst, start_s = _export(learnt, form)
    delay_s, delay_sd_s, delay_total_sd_s = _delay(learnt, form)
    used = aligned.used
    share = part.length / part.rate_hz / max(form.end_s, 1e-4)
    snr = float(np.sum(np.abs(form.clean) ** 2) / np.sum(aligned.noise)) * share
    echoes: tuple[Path, ...] = ()
    if form.response is not None:
        code_power = float(np.mean(np.abs(code_of(learnt, form.stretch)) ** 2))
        from_s = form.gate_s if form.gate_s is not None else ring_s(learnt, USUAL_GATE_S)
        echoes = echoes_in(form.response, from_s, float(np.mean(aligned.noise)) / learnt.strength / code_power)
    if np.count_nonzero(used) < FEW:
        flags.append(f"only {np.count_nonzero(used)} bursts: record half a minute or more")
    if learnt.missed > 0.1 * learnt.heard:
        flags.append(f"{learnt.missed} of {learnt.missed + learnt.heard} bursts were not heard")
    if learnt.stride > 1:
        flags.append(f"a long recording: one burst in {learnt.stride} was taken, over its whole length")
    return Calibration(
        beacon=learnt.beacon.id,
        microphone=learnt.microphone.id,
        burst=burst,
        start_s=start_s,
        flight_m=FLIGHT_M,
        waveform=reference_waveform(burst, learnt.signal, site.sound_speed_mps, FLIGHT_M, start_s),
        nominal=learnt.nominal,
        heard=learnt.heard,
        left_out=dict(learnt.left_out),
        amplitude=amplitude,
        amplitude_sd=amplitude * float(np.std(np.abs(aligned.gain[used]), ddof=1)),
        snr_db=float(10 * np.log10(max(snr, 1e-30))),
        snr_gain_db=float(10 * np.log10(learnt.strength)),
        band_hz=(float(part.carrier_hz + part.offset_hz[0]), float(part.carrier_hz + part.offset_hz[-1])),
        match=form.match,
        stretch=form.stretch,
        stretch_sd=form.stretch_sd,
        delay_s=delay_s,
        delay_sd_s=delay_sd_s,
        delay_total_sd_s=delay_total_sd_s,
        distance_m=learnt.distance_m,
        distance_sd_m=learnt.distance_sd_m,
        sound_speed_mps=site.sound_speed_mps,
        period_s=learnt.period_s,
        pace=learnt.pace,
        response_s=None if form.response is None else form.response.time_s,
        response=None if form.response is None else form.response.taps,
        gate_s=form.gate_s,
        echoes=echoes,
        residual_s=left.time_s,
        residual_rms=left.rms,
        noise_rms=left.quiet_rms,
        flags=tuple(flags),
    )


def _delay(learnt: Learnt, form: Form) -> tuple[float | None, float | None, float | None]:
    """Delay, its deviation by noise and jitter, and that with the doubt about the flight."""
    schedule, c = learnt.recording.site.schedule, learnt.recording.site.sound_speed_mps
    if schedule is None or not schedule.synchronised or learnt.distance_m is None:
        return None, None, None
    used = learnt.pace.used
    late = (learnt.first_s + form.start_s + learnt.aligned.delay_s - learnt.due_s)[used]
    bound = 1.0 / float(np.sum(1.0 / learnt.aligned.delay_sd_s[used] ** 2))
    own = max(float(np.var(late, ddof=1)) / len(late), bound)
    flight = (learnt.distance_sd_m / c) ** 2 + (learnt.distance_m * learnt.sound_speed_sd_mps / c**2) ** 2
    return float(np.mean(late)), float(np.sqrt(own)), float(np.sqrt(own + flight))


def _export(learnt: Learnt, form: Form) -> tuple[ReferenceBurst, float]:
    """Write the burst as samples: its time 0 on a whole sample but for the reference distance, its ends faded."""
    part = learnt.part
    edge = max(1, int(0.04 * (part.high - part.low)))
    taper = np.ones(part.high - part.low)
    taper[:edge] = np.sin(0.5 * np.pi * (np.arange(edge) + 0.5) / edge) ** 2
    taper[-edge:] = taper[:edge][::-1]
    lead = round(2.5e-3 * part.rate_hz)
    flight_s = FLIGHT_M / learnt.recording.site.sound_speed_mps
    whole = part.samples(part.delayed(form.clean * taper, lead / part.rate_hz + flight_s))
    samples = whole[: min(part.length, lead + int(np.ceil((form.end_s + 1e-3) * part.rate_hz)))]
    fade = np.ones(len(samples))
    fall = round(1e-3 * part.rate_hz)
    fade[:fall] = np.sin(0.5 * np.pi * (np.arange(fall) + 0.5) / fall) ** 2
    fade[-fall:] = fade[:fall][::-1]
    samples = samples * fade
    return ReferenceBurst(samples * (PEAK / np.abs(samples).max()), part.rate_hz), lead / part.rate_hz
