"""What the receiver saw: the work of `acquire` on one epoch, done again and watched.

Nothing here searches by itself: it is `plan.taken_apart` that runs, and what it says of each step is written down.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.bank import Bank
from sonofix.acquire.baseband import Band
from sonofix.acquire.plan import Plan, taken_apart
from sonofix.acquire.search import correlations, delays, search
from sonofix.acquire.separate import Deed, Separation
from sonofix.acquire.spectrum import DEPTH, decibels, density_of, power_of, recorded, smoothed_db
from sonofix.records import BandInsight, BeaconInsight, Detection, Floats, Insight, PathInsight, Prediction, Stage


@dataclass(frozen=True, slots=True, eq=False)
class Hearing:
    """What one microphone's epoch was searched for: the arguments of `acquire`, and what else is known of it.

    Attributes
    ----------
    plan, receiver, samples, first_sample, windows, predictions
        As for `acquire`.
    sent_s : mapping from emitter id to float
        When a burst that had no way to go would begin to be heard, recorder's clock.
    notes : tuple of str
        What was odd about the samples.
    why_cold : str
        Empty where there are predictions.
    """

    plan: Plan
    receiver: str
    samples: NDArray[np.float32]
    first_sample: int
    windows: Mapping[str, tuple[float, float]]
    predictions: Mapping[str, Prediction]
    sent_s: Mapping[str, float]
    notes: tuple[str, ...] = ()
    why_cold: str = ""


@dataclass(slots=True, eq=False)
class _Diary:
    """What a separation said: power left (n,) after each deed, and the paths that it dropped."""

    hearing: Hearing
    entries: list[tuple[str, tuple[str, ...], Floats | None]] = field(default_factory=list)
    dropped: dict[str, list[PathInsight]] = field(default_factory=dict)
    unpredicted: bool = False

    def note(self, job: Separation, deed: Deed, which: Sequence[int]) -> None:
        """Write down one deed; what a drop leaves shows at the next."""
        self.close(job)
        if deed == "unpredicted":
            self.unpredicted = True
            return
        beacons = tuple(job.sounds[i].bank.emitter for i in which)
        if deed == "taken":
            had = {s.bank.emitter for s in job.sounds[: min(which)]}
            name = "echo" if had.issuperset(beacons) else "burst"
            self.entries.append((name, beacons, power_of(job.joint.residual)))
        elif deed == "aside":
            self.entries.append(("clicks", (), power_of(job.joint.residual)))
        else:
            self.entries.append(("dropped", beacons, None))
            for i, path in zip(which, _paths(job, self.hearing, which, deed), strict=True):
                self.dropped.setdefault(job.sounds[i].bank.emitter, []).append(path)

    def close(self, job: Separation) -> None:
        """Fill in what the last deed left, where that was not known yet."""
        if self.entries and self.entries[-1][2] is None:
            self.entries[-1] = (*self.entries[-1][:2], power_of(job.joint.residual))


def insight(hearing: Hearing, epoch: int, sync_s: float, clock: Literal["known", "common"]) -> Insight:
    """Do the work of `acquire` on one microphone's epoch, and tell what was seen.

    Parameters
    ----------
    hearing : Hearing
    epoch, sync_s, clock
        As in `Insight`.
    """
    bands: list[BandInsight] = []
    found: list[Detection] = []
    notes = list(hearing.notes)
    search_text = f"cold: {hearing.why_cold}" if hearing.why_cold else "warm"
    diaries = [_Diary(hearing)]
    for job in taken_apart(
        hearing.plan,
        hearing.samples,
        hearing.first_sample,
        hearing.windows,
        hearing.predictions,
        lambda job, deed, which: diaries[-1].note(job, deed, which),
    ):
        diary = diaries[-1]
        diary.close(job)
        detections = job.detections(hearing.receiver)
        bands.append(_band(job, hearing, diary, {d.emitter: d for d in detections}))
        notes += job.notes
        found += detections
        if diary.unpredicted:
            search_text = "cold: no burst came as predicted"
        diaries.append(_Diary(hearing))
    stretch = hearing.samples[slice(*recorded(hearing.samples))]
    frequency_hz, density = density_of(stretch.astype(np.float64), hearing.plan.sample_rate_hz)
    found.sort(key=lambda detection: -detection.amplitude)
    return Insight(
        epoch=epoch,
        sync_s=sync_s,
        microphone=hearing.receiver,
        search=search_text,
        sound_speed_mps=hearing.plan.sound_speed_mps,
        clock=clock,
        frequency_hz=frequency_hz,
        spectrum_db=decibels(density),
        bands=tuple(bands),
        detections=tuple(found),
        notes=tuple(notes),
        used={},
        events=(),
    )


def _band(job: Separation, hearing: Hearing, diary: _Diary, detections: Mapping[str, Detection]) -> BandInsight:
    """Tell of one band, from its spectrum to its beacons."""
    band, heard = job.band, job.baseband
    clean = heard - sum((tone.course for tone in job.tones), np.zeros_like(heard))
    left = job.joint.residual
    first, last = recorded(heard)
    aside = ~job.joint.counted
    kept = np.where(aside, 0.0, clean)
    offset_hz, heard_density = density_of(heard[first:last], band.rate_hz)
    inside = np.abs(offset_hz) <= band.half_width_hz
    densities = [heard_density] + [density_of(x[first:last], band.rate_hz)[1] for x in (kept, left)]
    floor = job.floor
    unit = floor if floor > 0 else max(float(np.mean(power_of(left))), 1e-30)
    quiet = decibels(np.array([floor * band.whiteness / band.rate_hz / 2]))[0] if floor > 0 else None
    return BandInsight(
        carrier_hz=band.carrier_hz,
        edges_hz=(band.carrier_hz - band.half_width_hz, band.carrier_hz + band.half_width_hz),
        frequency_hz=band.carrier_hz + offset_hz[inside],
        heard_db=decibels(densities[0][inside]),
        clean_db=decibels(densities[1][inside]),
        left_db=decibels(densities[2][inside]),
        quiet_db=None if quiet is None else float(quiet),
        tones_hz=tuple(band.carrier_hz + tone.offset_hz for tone in job.tones),
        time_s=job.start_s + np.arange(len(heard)) / band.rate_hz,
        heard_power_db=smoothed_db(heard, band.rate_hz, unit),
        left_power_db=smoothed_db(left, band.rate_hz, unit),
        aside=aside,
        stages=_stages(job, diary, clean, unit),
        beacons=tuple(
            _beacon(job, hearing, bank, detections.get(bank.emitter), diary.dropped.get(bank.emitter, []))
            for bank in job.banks
        ),
    )


def _stages(job: Separation, diary: _Diary, clean: NDArray[np.complex128], unit: float) -> tuple[Stage, ...]:
    """Mean power left after each stage, over the stretch in which any burst of the final model sounds."""
    first, last = job.sounding()
    entries: list[tuple[str, tuple[str, ...], Floats | None]] = [("as heard", (), power_of(job.baseband))]
    if job.tones:
        entries.append(("tones", (), power_of(clean)))
    entries += [*diary.entries, ("refined", (), power_of(job.joint.residual))]
    out = []
    for deed, beacons, power in entries:
        assert power is not None
        level = float(np.mean(power[first:last])) if last > first else 0.0
        out.append(Stage(deed, beacons, float(decibels(np.array([max(level / unit, DEPTH)]))[0])))
    return tuple(out)


def _beacon(
    job: Separation, hearing: Hearing, bank: Bank, detection: Detection | None, dropped: list[PathInsight]
) -> BeaconInsight:
    """Tell of one beacon: its surfaces, its paths, and why it has no range where it has none."""
    joint, emitter, sent_s = job.joint, bank.emitter, hearing.sent_s[bank.emitter]
    own = [i for i, s in enumerate(job.sounds) if s.bank is bank]
    alone = joint.residual + sum((joint.residual_with(i) - joint.residual for i in own), np.zeros_like(joint.residual))
    opens_s, closes_s = hearing.windows[emitter]
    at_s, alone_power = surface(alone, job.start_s, bank, job.band, opens_s, closes_s)
    _, heard_power = surface(job.baseband, job.start_s, bank, job.band, opens_s, closes_s)
    if own:
        reported = [i for i in own if detection is not None and joint.bursts[i].arrival_s == detection.arrival_s]
        noise, threshold = float(joint.noise()[(reported or own)[0]]), job.sounds[own[0]].threshold
    else:
        noise = float(np.median(alone_power)) / np.log(2.0) if alone_power.size else 0.0
        threshold = np.log(max(alone_power.size, 1) / hearing.plan.false_alarm_rate)
    noise = max(noise, 1e-30)
    kept = _paths(job, hearing, own, None, detection)
    return BeaconInsight(
        beacon=emitter,
        range_m=hearing.plan.sound_speed_mps * (at_s - sent_s),
        range_rate_mps=bank.range_rate_mps,
        heard_db=decibels(heard_power / np.float32(noise)),
        alone_db=decibels(alone_power / np.float32(noise)),
        threshold_db=float(10 * np.log10(threshold)),
        predicted=_predicted(job, hearing, bank),
        paths=tuple(sorted([*kept, *dropped], key=lambda path: path.range_m)),
        verdict="" if detection is not None else _verdict(job, bank, own, alone, dropped),
    )


def surface(
    baseband: NDArray[np.complex128], start_s: float, bank: Bank, band: Band, opens_s: float, closes_s: float
) -> tuple[Floats, NDArray[np.float32]]:
    """Correlation power of a bank's replicas with samples, for bursts that begin within [opens_s, closes_s].

    Returns
    -------
    begins_s : float64 (d,)
    power : float32 (m, d)
        A row a replica, as `search.profile` boils it down.
    """
    first, count = delays(baseband, start_s, bank, band, opens_s, closes_s)
    count = max(0, count)
    begins_s = start_s + (first + np.arange(count)) / band.rate_hz + bank.lead_s
    power = np.zeros((len(bank.replicas), count), np.float32)
    if count:
        stretch = baseband[first : first + count - 1 + bank.replicas.shape[1]]
        for low, part in correlations(stretch, bank, count):
            power[low : low + len(part)] = part.real**2 + part.imag**2
    return begins_s, power


def _predicted(job: Separation, hearing: Hearing, bank: Bank) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Ways and range rates that a warm search looks through."""
    expected = job.predictions.get(bank.emitter)
    if expected is None:
        return None
    c = hearing.plan.sound_speed_mps
    way_m = c * (expected.arrival_s - bank.waveform.duration_s / 2 - hearing.sent_s[bank.emitter])
    reach_m, reach_mps = c * job.reach_s(expected), 5 * expected.range_rate_sd_mps
    return (
        (float(way_m - reach_m), float(way_m + reach_m)),
        (expected.range_rate_mps - reach_mps, expected.range_rate_mps + reach_mps),
    )


def _paths(
    job: Separation,
    hearing: Hearing,
    which: Sequence[int],
    deed: Literal["merged", "weak", "alike"] | None,
    detection: Detection | None = None,
) -> list[PathInsight]:
    """Tell of some of the paths: as they are, or as they are about to be dropped for a reason."""
    c, joint = hearing.plan.sound_speed_mps, job.joint
    noise = joint.noise()
    covariances = joint.covariances(noise) if which and deed is None else None
    out = []
    for i in which:
        sound, burst = job.sounds[i], joint.bursts[i]
        over = job.energy(i) / noise[i]
        dropped = ""
        if deed == "merged":
            dropped = "fell onto another path of its beacon"
        elif deed == "weak":
            over_db, asked_db = 10 * np.log10(max(over, 1e-30)), 10 * np.log10(sound.threshold)
            dropped = f"stands {over_db:.1f} dB over the noise; {asked_db:.1f} dB are asked"
        elif deed == "alike":
            dropped = "stands no higher than other peaks of its search"
        sd_s, sd_beta = (None, None) if covariances is None else np.sqrt(np.diag(covariances[i]))
        out.append(
            PathInsight(
                range_m=c * (job.begins_s(i) - hearing.sent_s[sound.bank.emitter]),
                range_sd_m=None if sd_s is None else float(c * sd_s),
                range_rate_mps=c * burst.beta,
                range_rate_sd_mps=None if sd_beta is None else float(c * sd_beta),
                level_db=float(10 * np.log10(max(over, 1e-30))),
                amplitude=abs(burst.gain),
                is_range=detection is not None and burst.arrival_s == detection.arrival_s,
                dropped=dropped,
            )
        )
    return out


def _verdict(
    job: Separation, bank: Bank, own: list[int], alone: NDArray[np.complex128], dropped: list[PathInsight]
) -> str:
    """Say in a few words why a beacon has no range."""
    if own:
        if not any(job.awaited(i) for i in own):
            return "came, but not when its direct sound was due: an echo, it seems"
        return "cut off where the recording begins or ends"
    if dropped:
        return max(dropped, key=lambda path: path.level_db).dropped
    window = job.windows[bank.emitter]
    peak = search(alone, job.start_s, bank, job.band, *window, [], job.false_alarm_rate)
    if peak is None:
        return "no samples of its window"
    over_db, asked_db = (10 * np.log10(max(x, 1e-30)) for x in (peak.power / peak.noise, peak.threshold))
    if over_db < asked_db:
        return f"highest peak {over_db:.1f} dB over the noise; {asked_db:.1f} dB are asked"
    above_db = 10 * np.log10(peak.power / max(peak.second, 1e-30))
    return f"highest peak {over_db:.1f} dB over the noise, but only {above_db:.1f} dB over the next"
