"""Where a beacon's bursts stand in a recording: roughly, by correlation with what is known of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.survey.slices import Complexes, Slice, make_slice, stretches

FALSE_ALARM_RATE = 1e-4
LEAST_LIKENESS = 0.03
"""Share of a stretch's power that a burst must explain: 15 dB below the noise of the whole band."""

LIKENESS_IN_MOTION = 0.15
"""The same where a carrier shifted at will may make another beacon's code look like this one."""

FASTEST_MPS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Bursts in order: when their time 0 is heard (s, to some 10 µs), and how strongly (correlation power)."""

    time_s: Floats
    power: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """What to look for: real samples (n,) of a burst; its time 0 stands ``start_s`` after the first."""

    samples: Floats
    start_s: float


def find_bursts(
    blocks: Callable[[int], Iterator[NDArray[np.float32]]],
    channel: int,
    rate_hz: float,
    template: Template,
    carrier_hz: float,
    half_width_hz: float,
    spacing_s: float,
) -> Found:
    """Find bursts no closer than ``spacing_s``; where two are, the stronger one counts.

    A burst must stand out of the noise of its stretch (false alarms at 1e-4 a stretch) and look like the template.
    """
    count = len(template.samples)
    hop = max(round(rate_hz), 3 * count)
    part = make_slice(rate_hz, hop + count, carrier_hz, half_width_hz)
    replica = part.of(template.samples)
    times: list[float] = []
    powers: list[float] = []
    for first, samples in stretches(blocks, channel, hop, hop + count):
        if len(samples) < count // 2:
            continue
        for lag_s, power in _peaks(part, part.of(samples), replica, min(len(samples), hop), count, spacing_s):
            times.append(first / rate_hz + lag_s + template.start_s)
            powers.append(power)
    return _thinned(np.array(times), np.array(powers), spacing_s)


def _peaks(
    part: Slice,
    heard: Complexes,
    replica: Complexes,
    lags: int,
    count: int,
    spacing_s: float,
    likeness: float = LEAST_LIKENESS,
) -> list[tuple[float, float]]:
    """Lags (s) and powers of what correlates, strongest first."""
    rate_hz = part.course_rate_hz
    most = int(lags / part.rate_hz * rate_hz) + 1
    power = np.abs(part.course(heard * np.conj(replica)))[:most] ** 2
    # Cauchy–Schwarz: no correlation exceeds the product of both energies
    energy = np.concatenate([[0.0], np.cumsum(np.abs(part.course(heard)) ** 2)])
    width = int(count / part.rate_hz * rate_hz)
    within = energy[np.minimum(np.arange(most) + width, len(energy) - 1)] - energy[:most]
    limit = within * float(np.sum(np.abs(replica) ** 2)) / part.course_count
    noise = float(np.median(power)) / np.log(2.0)
    threshold = np.log(max(len(power), 2) / FALSE_ALARM_RATE) * noise
    left = np.where(power > np.maximum(threshold, likeness * limit), power, 0.0)
    radius = max(1, int(spacing_s * rate_hz))
    peaks: list[tuple[float, float]] = []
    while (top := float(left.max(initial=0.0))) > 0.0:
        at = int(np.argmax(left))
        peaks.append((at / rate_hz, top))
        left[max(0, at - radius) : at + radius + 1] = 0.0
    return peaks


def _thinned(time_s: Floats, power: Floats, spacing_s: float) -> Found:
    """Sort; of bursts too close keep the stronger; drop what is far fainter than most."""
    order = np.argsort(time_s)
    kept: list[int] = []
    for i in order:
        if kept and time_s[i] - time_s[kept[-1]] < spacing_s:
            if power[i] > power[kept[-1]]:
                kept[-1] = int(i)
        else:
            kept.append(int(i))
    at = np.array(kept, int)
    if len(at):
        at = at[power[at] > 0.02 * np.median(power[at])]
    return Found(time_s[at], power[at])


def rate_heard(
    blocks: Callable[[int], Iterator[NDArray[np.float32]]],
    channel: int,
    rate_hz: float,
    template: Template,
    carrier_hz: float,
    half_width_hz: float,
    sound_speed_mps: float,
) -> float | None:
    """Range rate (m/s) at which the first seconds hold a burst after all; None where at none, or at rest.

    Only the carrier is shifted, which for telling motion from silence is near enough.
    """
    count = len(template.samples)
    hop = max(round(rate_hz), 3 * count)
    part = make_slice(rate_hz, hop + count, carrier_hz, half_width_hz)
    replica = part.of(template.samples)
    step_hz = rate_hz / part.length
    widest = int(FASTEST_MPS / sound_speed_mps * carrier_hz / step_hz)
    stride = max(1, int(0.5 * rate_hz / count / step_hz))
    best: tuple[float, int] | None = None
    for i, (_, samples) in enumerate(stretches(blocks, channel, hop, hop + count)):
        if i == 2 or len(samples) < count:
            break
        heard = part.of(samples)
        for shift in range(-widest, widest + 1, stride):
            turned = np.roll(replica, shift)
            for _, power in _peaks(part, heard, turned, hop, count, hop / rate_hz, LIKENESS_IN_MOTION)[:1]:
                if best is None or power > best[0]:
                    best = power, shift
    if best is None or abs(best[1]) * step_hz < 0.5 * rate_hz / count:
        return None  # a short burst does not tell slow motion from rest
    return -best[1] * step_hz / carrier_hz * sound_speed_mps


def unknown_burst(samples: NDArray[np.float32], part: Slice, period_s: float) -> tuple[Template, float]:
    """Find a burst of unknown code in the first periods of a recording, by its power alone.

    Parameters
    ----------
    samples : float32 (n,)
        At least two periods.
    part : Slice
        Of as many samples.

    Returns
    -------
    template : Template
        The strongest burst as it was heard, time 0 at its onset.
    duration_s : float

    Raises
    ------
    ValueError
        If nothing stands out every period.
    """
    power = np.abs(part.course(part.of(samples))) ** 2
    cell_s = max(2.5e-4, period_s / 4000)
    per_cell = max(1, round(cell_s * part.course_rate_hz))
    cell_s = per_cell / part.course_rate_hz
    cells = power[: len(power) // per_cell * per_cell].reshape(-1, per_cell).mean(axis=1)
    cells = cells[: int(len(samples) / part.rate_hz / cell_s)]
    wide = int(period_s / cell_s)
    epochs = int(len(samples) / part.rate_hz / period_s)
    rows = np.stack([cells[round(k * period_s / cell_s) :][:wide] for k in range(epochs) if
                     round(k * period_s / cell_s) + wide <= len(cells)])  # fmt: skip
    folded = np.median(rows, axis=0)
    quiet, peak = float(np.quantile(folded, 0.2)), float(folded.max())
    if peak < 6.0 * max(quiet, 1e-30):
        raise ValueError(
            f"no burst stands out of the noise every {period_s:g} s; is the beacon on, the right microphone chosen, "
            "and schedule.period_s right?"
        )
    loud = folded > quiet + 0.03 * (peak - quiet)
    # gaps between chips are no end of the burst
    gap = max(1, round(4e-3 / cell_s))
    turned = np.roll(loud, -int(np.argmax(folded)))
    begin = end = 0
    silent = 0
    for i in range(1, wide):
        silent = 0 if turned[i] else silent + 1
        if silent > gap:
            break
        end = i if turned[i] else end
    silent = 0
    for i in range(1, wide - end):
        silent = 0 if turned[-i] else silent + 1
        if silent > gap:
            break
        begin = -i if turned[-i] else begin
    if (end - begin) * cell_s > 0.85 * period_s:
        raise ValueError(
            f"sound all through the period of {period_s:g} s: no burst of its own can be told; lower the gain, keep "
            "other beacons quiet, or give the beacon its code"
        )
    centre = int(np.argmax(folded))
    starts = [round(k * period_s / cell_s) + centre + begin for k in range(len(rows))]
    starts = [s for s in starts if s >= 0 and (s + end - begin + 1) * per_cell <= len(power)]
    energy = [float(cells[s : s + end - begin + 1].sum()) for s in starts]
    if not starts:
        raise ValueError("the recording is too short to hold a whole burst; record ten periods or more")
    start_s = starts[int(np.argsort(energy)[len(energy) // 2])] * cell_s
    duration_s = (end - begin + 1) * cell_s
    first = max(0, round((start_s - cell_s) * part.rate_hz))
    last = round((start_s + duration_s + cell_s) * part.rate_hz)
    cut = samples[first:last].astype(np.float64)
    return Template(cut, start_s - first / part.rate_hz), duration_s
