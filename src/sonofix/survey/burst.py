"""A beacon's burst learnt from a recording at rest: found, laid upon each other, averaged, timed.

The first seed's calibration, eqs 4 to 6 (a reference envelope recorded at a known distance), from many bursts instead
of one. `calibrate` is the whole of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Calibration, Floats, Recording, Waveform
from sonofix.signals.waveform import chips_of, waveform_of
from sonofix.site import Beacon, ChirpCode, ReferenceCode
from sonofix.survey.align import align
from sonofix.survey.find import Found, Template, find_bursts, rate_heard, unknown_burst
from sonofix.survey.pace import fit_pace, number_bursts
from sonofix.survey.result import Learnt, conclude
from sonofix.survey.slices import Slice, is_clipped, make_slice, stretches

GATE_S = 2e-3
LEAD_S = 4e-3
RING_S = 15e-3
MOST_KEPT = 6_000_000
"""Values of all bursts together that are held in memory, 8 bytes each."""


def calibrate(
    recording: Recording,
    beacon_id: str,
    microphone_id: str,
    *,
    distance_m: float | None = None,
    distance_sd_m: float = 1e-3,
    gate_s: float | None = GATE_S,
    length_s: float | None = None,
) -> Calibration:
    """Learn what a beacon sends, when, and how evenly, from what a microphone at rest heard of it.

    Parameters
    ----------
    recording : Recording
        With samples. ``blocks`` is read twice, three times where the beacon's code is not known.
    beacon_id, microphone_id : str
    distance_m : float, optional
        From beacon to microphone; where the site file places both, its distance unless given. Without any, and without
        a sync command, there is no delay.
    distance_sd_m : float
    gate_s : float or None
        Known codes: what a chip sounds like later than this (after its end) is taken for the room's and left out of the
        burst. None: the plain average.
    length_s : float, optional
        Unknown codes: the burst's length, where the samples do not tell it well.

    Raises
    ------
    ValueError
        Saying what is wrong and what would help: no burst heard, too few, clipped, in motion, another beacon's code,
        two beacons at once.
    """
    site = recording.site
    beacon, microphone = site.beacon(beacon_id), site.microphone(microphone_id)
    if recording.blocks is None or recording.rate_hz is None:
        raise ValueError("the recording holds no samples (capture.wav, capture.flac) to learn a burst from")
    if microphone.channel is None:
        raise ValueError(f"microphone {microphone_id} names no channel of the capture: add channel = 0, 1, …")
    rate_hz, blocks, channel = recording.rate_hz, recording.blocks, microphone.channel
    signal = site.signal_of(beacon)
    period_s = site.schedule.period_s if site.schedule else None
    nominal = nominal_waveform(recording, beacon)
    if distance_m is None:
        distance_m = placed_distance_m(recording, beacon_id, microphone_id)
    half_width_hz = half_width(nominal, beacon, signal.carrier_hz)
    if nominal is not None:
        template, duration_s = _template(nominal, rate_hz), nominal.duration_s
    else:
        template, duration_s = _listen(recording, channel, signal.carrier_hz, half_width_hz, period_s)
        duration_s = length_s or duration_s
    if period_s is not None and duration_s + LEAD_S >= period_s:
        raise ValueError(
            f"a burst of {duration_s:.4g} s does not fit into the period of {period_s:g} s; correct schedule.period_s"
        )
    spacing_s = 0.6 * period_s if period_s is not None else 1.2 * duration_s
    found = find_bursts(blocks, channel, rate_hz, template, signal.carrier_hz, half_width_hz, spacing_s)
    if len(found.time_s) < 3:
        rate = rate_heard(blocks, channel, rate_hz, template, signal.carrier_hz, half_width_hz, site.sound_speed_mps)
        raise ValueError(_unheard(beacon_id, microphone_id, len(found.time_s), rate))
    number, true_period_s = number_bursts(found.time_s, period_s or float(np.median(np.diff(found.time_s))))
    part = make_slice(
        rate_hz,
        round((LEAD_S + duration_s + min(RING_S, 0.9 * (true_period_s - duration_s - LEAD_S))) * rate_hz),
        signal.carrier_hz,
        half_width_hz,
    )
    stride = max(1, -(-len(found.time_s) * (part.high - part.low) // MOST_KEPT))
    windows = _cut(recording, channel, part, Found(found.time_s[::stride], found.power[::stride]))
    first = None
    if nominal is not None:
        first = part.delayed(part.of_waveform(nominal.envelope, nominal), LEAD_S)
    clipped = windows.clipped
    if np.mean(clipped) > 0.5:
        raise ValueError(
            f"{np.count_nonzero(clipped)} of {len(clipped)} bursts are clipped; lower the gain, or listen from farther"
        )
    reasons = ["clipped" if c else "" for c in clipped]
    due_s = _due(recording, beacon, microphone.delay_s, distance_m, windows.first_s + LEAD_S, true_period_s, period_s)
    while True:
        aligned = align(windows.slices, part.offset_hz, first, reasons)
        heard_s = windows.first_s + LEAD_S + aligned.delay_s
        pace = fit_pace(due_s, heard_s, aligned.delay_sd_s, aligned.used, period_s or true_period_s)
        late = aligned.used & ~pace.used
        if not late.any():
            break
        reasons = ["out of time" if wild else why for wild, why in zip(late, aligned.reason, strict=True)]
    left_out = Counter(why for why in aligned.reason if why)
    thinned = len(found.time_s[::stride])
    for why, count in (("not whole", thinned - len(windows.first_s)), ("not needed", len(found.time_s) - thinned)):
        if count:
            left_out[why] = count
    learnt = Learnt(
        recording=recording,
        beacon=beacon,
        microphone=microphone,
        nominal=nominal,
        part=part,
        slices=windows.slices,
        first_s=windows.first_s,
        aligned=aligned,
        due_s=due_s,
        pace=pace,
        heard=len(found.time_s),
        missed=int(number[-1]) + 1 - len(number),
        stride=stride,
        left_out=left_out,
        period_s=period_s or true_period_s,
        duration_s=duration_s,
        length_s=length_s,
        distance_m=distance_m,
        distance_sd_m=distance_sd_m,
        sound_speed_sd_mps=site.sound_speed_sd_mps,
        lead_s=LEAD_S,
        gate_s=gate_s,
    )
    return conclude(learnt)


def nominal_waveform(recording: Recording, beacon: Beacon) -> Waveform | None:
    """Return what the site file says a beacon sends, None where its code, or the reference it names, is not there."""
    if beacon.code is None or (isinstance(beacon.code, ReferenceCode) and beacon.id not in recording.references):
        return None
    return waveform_of(recording.site, beacon, recording.references.get(beacon.id))


def placed_distance_m(recording: Recording, beacon_id: str, microphone_id: str) -> float | None:
    """Distance between beacon and microphone by the site file: both fixed, or both on one vehicle; else None."""
    beacon, microphone = recording.site.beacon(beacon_id), recording.site.microphone(microphone_id)
    if beacon.position_m is not None and microphone.position_m is not None:
        return float(np.linalg.norm(np.subtract(beacon.position_m, microphone.position_m)))
    if beacon.vehicle is not None and beacon.vehicle == microphone.vehicle:
        return float(np.linalg.norm(np.subtract(beacon.lever_arm_m, microphone.lever_arm_m)))
    return None


def half_width(nominal: Waveform | None, beacon: Beacon, carrier_hz: float) -> float:
    """How far from the carrier to listen: three chip rates, a sweep and half, or a third of the carrier."""
    chips = chips_of(beacon)
    if isinstance(beacon.code, ChirpCode):
        farthest = max(abs(f - carrier_hz) for f in (beacon.code.start_hz, beacon.code.stop_hz))
        return 1.5 * farthest + 20.0 / beacon.code.duration_s
    if nominal is not None and chips is not None:
        return 3.0 * len(chips) / nominal.duration_s
    return 0.35 * carrier_hz


def _template(nominal: Waveform, rate_hz: float) -> Template:
    """Samples of a nominal burst, without the bare carrier that all on-off codes share."""
    from sonofix.signals.interpolate import sample

    first = int(np.floor(max(nominal.start_s, -1e-3) * rate_hz))
    last = int(np.ceil((nominal.start_s + len(nominal.envelope) / nominal.rate_hz) * rate_hz))
    tau = np.arange(first, last) / rate_hz
    envelope = sample(nominal.signature, nominal.rate_hz, nominal.start_s, tau)
    return Template(np.real(envelope * np.exp(2j * np.pi * nominal.carrier_hz * tau)), -first / rate_hz)


def _listen(
    recording: Recording, channel: int, carrier_hz: float, half_width_hz: float, period_s: float | None
) -> tuple[Template, float]:
    """Learn from the first periods what to look for, where no code tells it."""
    assert recording.blocks is not None
    assert recording.rate_hz is not None
    if period_s is None:
        raise ValueError("neither the beacon's code nor schedule.period_s is known; state one of them in site.toml")
    count = round(max(8.2 * period_s, 0.3) * recording.rate_hz)
    _, samples = next(stretches(recording.blocks, channel, count, count), (0, np.zeros(0, np.float32)))
    if len(samples) < 2.0 * period_s * recording.rate_hz:
        raise ValueError(
            f"the recording of {len(samples) / recording.rate_hz:.3g} s holds no two periods of {period_s:g} s; record "
            "longer"
        )
    return unknown_burst(samples, make_slice(recording.rate_hz, len(samples), carrier_hz, half_width_hz), period_s)


def _unheard(beacon_id: str, microphone_id: str, count: int, rate_mps: float | None) -> str:
    where = f"beacon {beacon_id} at microphone {microphone_id}"
    if rate_mps is not None:
        speed = f"{abs(rate_mps):.2f} m/s"
        return f"{where}: heard moving at some {speed}; a burst is learnt at rest: fasten both and record again"
    if not count:
        return (
            f"{where}: silent; no burst of this code stands out of the noise. Is it switched on, the code right, the "
            "microphone's channel the one that was recorded, and both at rest?"
        )
    return f"{where}: {count} burst{'s' * (count > 1)} heard; at least 3 are needed: record longer, or nearer"


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """Slices (k, b) of whole bursts, the time of each first sample (k,), and which are clipped (k,)."""

    slices: NDArray[np.complex64]
    first_s: Floats
    clipped: NDArray[np.bool_]


def _cut(recording: Recording, channel: int, part: Slice, found: Found) -> _Windows:
    """Cut a window round every burst that the recording holds whole; its edges are faded."""
    assert recording.blocks is not None
    lead = round(LEAD_S * part.rate_hz)
    starts = np.round(found.time_s * part.rate_hz).astype(np.int64)  # in samples that begin a lead before the first
    blocks = recording.blocks

    def led(length: int) -> Iterator[NDArray[np.float32]]:
        """Put silence before the recording: its first burst may come at once."""
        for i, block in enumerate(blocks(length)):
            yield np.concatenate([np.zeros((0 if i else lead, block.shape[1]), np.float32), block])

    fade = np.ones(part.length)
    edge = int(5e-4 * part.rate_hz)
    fade[:edge] = np.sin(0.5 * np.pi * (np.arange(edge) + 0.5) / edge) ** 2
    fade[-edge:] = fade[:edge][::-1]
    hop = max(round(part.rate_hz), part.length)
    slices: list[NDArray[np.complex64]] = []
    kept: list[int] = []
    clipped: list[bool] = []
    for first, samples in stretches(led, channel, hop, hop + part.length):
        for start in starts[(starts >= first) & (starts < first + hop)]:
            window = samples[start - first : start - first + part.length]
            if len(window) == part.length:
                slices.append(part.of(window * fade).astype(np.complex64))
                kept.append(int(start))
                clipped.append(is_clipped(window))
    if len(kept) < 3:
        raise ValueError(f"{len(kept)} whole bursts in the recording; at least 3 are needed: record longer")
    return _Windows(np.stack(slices), (np.array(kept) - lead) / part.rate_hz, np.array(clipped))


def _due(
    recording: Recording,
    beacon: Beacon,
    microphone_delay_s: float,
    distance_m: float | None,
    heard_s: Floats,
    true_period_s: float,
    period_s: float | None,
) -> Floats:
    """When each burst was due at the microphone without any delay of its own, (k,).

    Where nothing synchronises: multiples of the nominal period.
    """
    site = recording.site
    if site.schedule is None or not site.schedule.synchronised:
        return number_bursts(heard_s, true_period_s)[0] * (period_s or true_period_s)
    lag_s = beacon.offset_s + microphone_delay_s + (distance_m or 0.0) / site.sound_speed_mps
    # a delay is mostly positive; a quarter of a period early is still this epoch's
    since = heard_s - lag_s + 0.25 * true_period_s
    if recording.sync_s is None:
        return np.floor(since / true_period_s) * (period_s or true_period_s) + lag_s
    which = np.searchsorted(recording.sync_s, since, side="right") - 1
    return recording.sync_s[np.maximum(which, 0)] + lag_s


__all__ = ["calibrate", "nominal_waveform", "placed_distance_m"]
