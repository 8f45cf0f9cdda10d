"""Whether a burst could be learnt: at rest, alone, and the right one. What rules it out raises, the rest is flagged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sonofix.records import Floats, Waveform
from sonofix.signals.waveform import waveform_of
from sonofix.site import ReferenceCode
from sonofix.survey.align import CHUNK, leavings
from sonofix.survey.chip import chip_response, foreign_share
from sonofix.survey.form import ECHO_SPAN_S, Form, Learnt, code_of
from sonofix.survey.slices import Complexes, Slice

REST_M, MOVED_M = 1e-3, 1e-2
"""Change of distance over a recording beyond which it is mentioned, and refused."""

STEADY_MPS, SHAKEN_MPS = 2e-3, 2e-2
"""The same for how much the bursts' own speeds differ."""

HINT_OF_OVERLAP, OVERLAP = 3e-3, 0.1
"""Share of the power that another beacon may have: the same again."""

UNEVEN_S = 3e-5
POOR_MATCH = 0.8
FAR_OFF = 2e-4
"""Of the carrier: no quartz is that far off."""


def check_rest(learnt: Learnt) -> list[str]:
    """Judge by the bursts' times whether the distance stayed the same."""
    pace, c = learnt.pace, learnt.recording.site.sound_speed_mps
    schedule = learnt.recording.site.schedule
    span_s = float(np.ptp(learnt.due_s))
    if schedule is None or not schedule.synchronised:
        if pace.jitter_s > UNEVEN_S:
            off = f"{1e6 * pace.jitter_s:.0f} µs"
            return [f"bursts come {off} rms off an even pace: an uneven clock, or something moved"]
        return []
    moved_m, moved_sd = c * pace.rate * span_s, c * pace.rate_sd * span_s
    bent_m = 0.0 if pace.drift_per_s is None else c * abs(pace.drift_per_s) * span_s**2 / 8
    wander_m = max(abs(moved_m), bent_m)
    if wander_m > MOVED_M and (abs(moved_m) > 6 * moved_sd or bent_m > abs(moved_m)):
        raise ValueError(
            f"beacon {learnt.beacon.id}: over {span_s:.3g} s the bursts came {1e6 * pace.rate * span_s:+.0f} µs later, "
            f"{wander_m:.3f} m of way: something moved, or the recorder's clock is not that of the sync commands; "
            "record at rest, and with sync.csv (or state synchronised = false)"
        )
    if wander_m > REST_M and (abs(moved_m) > 4 * moved_sd or bent_m > abs(moved_m)):
        way = f"{1e3 * wander_m:.1f} mm"
        return [f"the distance seems to change by {way} over the recording: motion, air, or a clock's drift"]
    return []


def likeness(part: Slice, mean: Complexes, waveform: Waveform) -> float:
    """Correlation of a burst with what a waveform does not share with others, at its best delay; 1 at most."""
    theirs = part.of_waveform(waveform.signature, waveform)
    best = float(np.max(np.abs(part.course(mean * np.conj(theirs))))) * part.length / 2.0
    return best / float(np.linalg.norm(mean)) / float(np.linalg.norm(theirs))


def check_code(learnt: Learnt, form: Form) -> list[str]:
    """Judge whether the burst is the one that the site file names."""
    if form.match is None or learnt.nominal is None:
        return []
    own = likeness(learnt.part, form.mean, learnt.nominal)
    for name, waveform in _others(learnt):
        theirs = likeness(learnt.part, form.mean, waveform)
        if theirs > 1.5 * own:
            raise ValueError(
                f"beacon {learnt.beacon.id}: what bursts there is the code of beacon {name} (likeness {theirs:.2f}; "
                f"its own {own:.2f}); name that one, or correct the codes in site.toml"
            )
    flags = []
    if form.match < POOR_MATCH:
        flags.append(
            f"the burst is not much like the nominal one (likeness {form.match:.2f}): another code or signal than the "
            "site file's, a poor transducer, or echoes all over it; compare the picture"
        )
    stretch, stretch_sd = form.stretch or 0.0, form.stretch_sd or 0.0
    if abs(stretch) > max(FAR_OFF, 5 * stretch_sd):
        speed = -stretch * learnt.recording.site.sound_speed_mps
        flags.append(
            f"the carrier lies {1e6 * stretch:+.0f} ppm from the nominal one: a clock that is off, or a motion of "
            f"{speed:+.2f} m/s"
        )
    return flags


def _others(learnt: Learnt) -> Iterator[tuple[str, Waveform]]:
    """Yield the site's other beacons on this carrier whose burst fits into a window."""
    site, part = learnt.recording.site, learnt.part
    for other in site.coded_beacons:
        if other.id == learnt.beacon.id or isinstance(other.code, ReferenceCode):
            continue
        waveform = waveform_of(site, other)
        if waveform.carrier_hz == part.carrier_hz and waveform.duration_s <= part.length / part.rate_hz:
            yield other.id, waveform


def check_others(learnt: Learnt, form: Form) -> list[str]:
    """Look for other beacons' codes in what the own one does not explain."""
    part = learnt.part
    if form.response is None:
        return []
    noise = learnt.aligned.noise / learnt.strength
    # a response as long as the burst would explain another's code as well
    code, span_s = code_of(learnt, form.stretch), min(ECHO_SPAN_S, learnt.duration_s / 3)
    left = form.mean - chip_response(form.mean, learnt.aligned.noise, code, part, span_s).made
    flags: list[str] = []
    for name, waveform in _others(learnt):
        theirs = part.of_waveform(waveform.signature, waveform)
        share = foreign_share(left, form.mean, theirs, noise, part)
        # the signature is what is looked for, the whole envelope what sounds
        share *= float(np.sum(np.abs(waveform.envelope) ** 2) / np.sum(np.abs(waveform.signature) ** 2))
        level = f"{-10 * np.log10(max(share, 1e-12)):.0f} dB below it" if share < 1 else "as loud"
        if share > OVERLAP:
            raise ValueError(
                f"beacons {learnt.beacon.id} and {name} sound at once (the latter {level}); keep all but one silent, "
                "or let them take turns (offset_s)"
            )
        if share > HINT_OF_OVERLAP:
            flags.append(f"beacon {name} sounds at the same time ({level}); better keep it silent")
    return flags


@dataclass(frozen=True, slots=True, eq=False)
class Leavings:
    """What single bursts leave beside the mean.

    ``rms`` (m,) over burst time ``time_s`` (m,), and before the burst (``quiet_rms``); how much the bursts' own range
    rates differ (``speed_rms_mps``), and how much they would by noise alone (``speed_sd_mps``).
    """

    time_s: Floats
    rms: Floats
    quiet_rms: float
    speed_rms_mps: float
    speed_sd_mps: float


def leavings_of(learnt: Learnt, form: Form) -> Leavings:
    """Take the mean out of up to 300 bursts; compare how the carrier of each turned between its halves."""
    part, aligned = learnt.part, learnt.aligned
    used = np.flatnonzero(aligned.used)
    rows = used[:: max(1, len(used) // 300)]
    time_s = np.arange(part.course_count) / part.course_rate_hz - form.start_s
    burst = part.course(part.delayed(form.mean, form.start_s))
    half_s = 0.5 * min(learnt.duration_s, form.end_s)
    halves = (time_s > 0) & (time_s < half_s), (time_s >= half_s) & (time_s < 2 * half_s)
    total = np.zeros(len(time_s))
    turns: list[Floats] = []
    for begin in range(0, len(rows), CHUNK):
        at = rows[begin : begin + CHUNK]
        gain = aligned.gain[at]
        left = part.course(leavings(learnt.slices[at], part.offset_hz, aligned.mean, aligned.delay_s[at], gain))
        total += np.sum(np.abs(left) ** 2, axis=0)
        whole = left + gain[:, None] * burst
        early, late = (np.sum(whole[:, half] * np.conj(burst[half]), axis=1) for half in halves)
        turns.append(np.angle(late * np.conj(early)))
    # of each burst a share went into the mean; a modulus counts twice what a real sample holds
    rms = np.sqrt(total / max(len(rows) - 1, 1) / 2.0)
    lead = (time_s > -form.start_s + 8e-4) & (time_s < -1e-3)
    turned_to_mps = learnt.recording.site.sound_speed_mps / (2 * np.pi * part.carrier_hz * half_s)
    noise_power = float(np.sum(aligned.noise)) * (2.0 / part.length) ** 2 * 2.0
    energies = [float(np.sum(np.abs(burst[half]) ** 2)) for half in halves]
    inside = (time_s > -2e-3) & (time_s < form.end_s + 3e-3)
    return Leavings(
        time_s=time_s[inside],
        rms=rms[inside],
        quiet_rms=float(np.sqrt(np.mean(rms[lead] ** 2))) if lead.any() else 0.0,
        speed_rms_mps=turned_to_mps * float(np.std(np.concatenate(turns))),
        speed_sd_mps=turned_to_mps * float(np.sqrt(sum(noise_power / 2 / max(e, 1e-30) for e in energies))),
    )


def check_alike(learnt: Learnt, left: Leavings, amplitude: float) -> list[str]:
    """Judge whether the bursts are all alike: at one speed, and with nothing else among them."""
    flags = []
    speed, by_noise = left.speed_rms_mps, left.speed_sd_mps
    if speed > max(SHAKEN_MPS, 5.0 * by_noise):
        raise ValueError(
            f"beacon {learnt.beacon.id}: the bursts are heard at speeds that differ by {speed:.2f} m/s (rms); a burst "
            "is learnt at rest: fasten beacon and microphone and record again"
        )
    if speed > max(STEADY_MPS, 3.0 * by_noise):
        flags.append(
            f"the bursts' speeds differ by {1e3 * speed:.1f} mm/s (rms): moving air, or something not fastened"
        )
    loud = float(np.median(left.rms))
    if loud > max(3.0 * left.quiet_rms, 0.02 * amplitude) and left.quiet_rms > 0:
        flags.append(
            f"bursts differ from each other {20 * np.log10(loud / left.quiet_rms):.0f} dB more than the quiet before "
            "them: something else sounds with them, or moves"
        )
    return flags
