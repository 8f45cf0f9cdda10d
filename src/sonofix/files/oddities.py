"""What a recording holds that is no mistake in form, but that its owner should know of: one plain sentence each."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from itertools import combinations
from pathlib import Path

import numpy as np

from sonofix import air
from sonofix.files.figures import CaptureFigures, burst_s
from sonofix.files.tables import LAYOUTS
from sonofix.records import Floats, Recording, ReferenceBurst
from sonofix.signals import codes
from sonofix.site import Beacon, ChipsCode, Microphone, Site

CLOSE_M = 0.05
FLAT_M = 0.05


def oddities(
    recording: Recording, references: Mapping[str, ReferenceBurst], figures: CaptureFigures | None, has_truth: bool
) -> list[str]:
    """Return what is odd about a recording, in plain sentences; `figures` of its samples, None without samples."""
    site = recording.site
    sentences = [
        *_places(site),
        *([] if recording.by_positions else _reach(site)),
        *_schedule(site, references),
        *_air(site),
        *_chips(site),
    ]
    if figures is not None:
        sentences += [*_samples(recording, figures), *_sync(recording, figures)]
    sentences += [*_sensors(recording, figures), *unused(recording)]
    if not has_truth:
        sentences.append("there is no truth.csv, so errors cannot be told")
    return sentences


def unused(recording: Recording) -> Iterator[str]:
    """Tell positions that are not used, since what is there beside them says more."""
    if "positions" not in recording.tables or recording.by_positions:
        return
    heard = "exchanges.csv" if recording.ranges is None else "ranges.csv"
    heard = heard if recording.blocks is None else "the capture"
    yield (
        f"positions.csv is not used: the track is made of {heard}, whose ranges say more than positions made of "
        "ranges; to follow the positions instead, put them into a folder of their own, with site.toml and the tables "
        "of the vehicles' sensors"
    )


def stray_files(folder: Path) -> list[str]:
    """Return a sentence for each file whose name is nearly one that would be read."""
    known = [*(f"{stem}.csv" for stem in LAYOUTS), "capture.wav", "capture.flac", "site.toml"]
    found = [path.name for path in sorted(folder.iterdir()) if path.is_file() and path.name not in known]
    sentences = []
    for name in found:
        near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.85)
        if near and "truth" not in name:
            sentences.append(f"{name} is not read; did you mean {near[0]}?")
    return sentences


def _places(site: Site) -> Iterator[str]:
    for kind, nodes in (("beacons", site.beacons), ("microphones", site.microphones)):
        fixed = [node for node in nodes if node.position_m is not None]
        close = [
            f"{a.id} and {b.id} ({1000 * distance_m:.0f} mm)"
            for a, b in combinations(fixed, 2)
            if (distance_m := float(np.linalg.norm(_place(a) - _place(b)))) < CLOSE_M
        ]
        if close:
            more = f" and {len(close) - 3} more pairs" if len(close) > 3 else ""
            yield f"{kind} stand nearly in one place: {', '.join(close[:3])}{more}"
        if site.bounds_m is not None:
            lower, upper = np.array(site.bounds_m)
            for node in fixed:
                place = _place(node)
                if np.any(place < lower) or np.any(place > upper):
                    yield f"{kind[:-1]} {node.id} stands outside the site's bounds_m"
    guesses = [beacon.id for beacon in site.beacons if beacon.position_sd_m > 0]
    if guesses:
        yield f"the places of {', '.join(guesses)} are guesses (position_sd_m > 0)"


def _reach(site: Site) -> Iterator[str]:
    """Vehicles of which ranges would tell nothing, or not all."""
    for vehicle in site.vehicles:
        if not any(node.vehicle == vehicle.id for node in (*site.beacons, *site.microphones)):
            yield f"vehicle {vehicle.id} carries neither beacon nor microphone, so no sound tells of it"
    yield from _geometry(site)


def _geometry(site: Site) -> Iterator[str]:
    """Too few fixed nodes, or all in one point, line or plane."""
    listens = any(microphone.vehicle for microphone in site.microphones)
    nodes = site.beacons if listens else site.microphones
    kind = "beacons" if listens else "microphones"
    places = np.array([node.position_m for node in nodes if node.position_m is not None])
    if not site.vehicles or not len(places):
        return
    level_known = all(vehicle.z_m is not None for vehicle in site.vehicles)
    clock_known = site.schedule is None or site.schedule.synchronised
    needed = 2 + (not level_known) + (not clock_known)
    if len(places) < needed:
        unknowns = "x, y" + ("" if level_known else ", z") + ("" if clock_known else " and the clock")
        few = f"{len(places)} fixed {kind if len(places) > 1 else kind[:-1]}"
        yield f"{few} cannot give {unknowns}: {needed} are needed in every epoch"
    if len(places) < 2:
        return
    spread = _spread(places)
    horizontal = _spread(places[:, :2])
    if spread[0] < FLAT_M:
        yield f"all fixed {kind} stand in one point: they give a distance, no position"
    elif horizontal[-1] < FLAT_M:
        yield f"all fixed {kind} stand on one line: both sides of it look the same"
    elif not level_known and len(places) > 2 and spread[-1] < FLAT_M:
        yield f"all fixed {kind} stand in one plane: places on both sides of it look the same; state the vehicle's z_m"


def _spread(places: Floats) -> Floats:
    """Return the standard deviations along the principal axes, largest first, in m."""
    return np.linalg.svd(places - places.mean(axis=0), compute_uv=False) / np.sqrt(len(places))


def _place(node: Beacon | Microphone) -> Floats:
    return np.array(node.position_m, dtype=np.float64)


def _schedule(site: Site, references: Mapping[str, ReferenceBurst]) -> Iterator[str]:
    period_s = site.schedule.period_s if site.schedule else None
    if period_s is None:
        return
    places = np.array([n.position_m for n in (*site.beacons, *site.microphones) if n.position_m is not None])
    corners = np.array(site.bounds_m) if site.bounds_m else places
    reach_m = float(np.linalg.norm(np.ptp(corners, axis=0))) if len(corners) else 0.0
    travel_s = reach_m / site.sound_speed_mps
    lengths = {beacon.id: burst_s(site, beacon, references.get(beacon.id)) for beacon in site.coded_beacons}
    for beacon in site.coded_beacons:
        length_s = lengths[beacon.id]
        if length_s > period_s:
            yield f"beacon {beacon.id} sends for {length_s:.3f} s, longer than the period of {period_s:g} s"
    last_s = max((beacon.offset_s + lengths[beacon.id] for beacon in site.coded_beacons), default=0.0)
    if lengths and max(lengths.values()) <= period_s < last_s + travel_s:
        yield (
            f"the last burst ends {last_s:.3f} s into a period of {period_s:g} s and may travel {travel_s:.3f} s "
            f"({reach_m:.0f} m): it may be heard in the next epoch"
        )


def _air(site: Site) -> Iterator[str]:
    stated = site.air.sound_speed_mps
    if stated is not None:
        computed = float(air.sound_speed_mps(site.air.temperature_c, site.air.humidity, site.air.pressure_kpa))
        if abs(stated - computed) > 3:
            yield f"the stated sound speed of {stated:g} m/s is not that of the stated air ({computed:.1f} m/s)"


def _chips(site: Site) -> Iterator[str]:
    """Chips that decide over a family named beside them that would give others."""
    for beacon in site.beacons:
        code = beacon.code
        if not isinstance(code, ChipsCode) or code.degree is None:
            continue
        try:
            if code.family == "m-sequence" and code.taps:
                named = codes.m_sequence(code.degree, code.taps)
            elif code.family in ("gold", "kasami") and code.index is not None:
                named = (codes.gold if code.family == "gold" else codes.kasami)(code.degree, code.index)
            else:
                continue
        except ValueError as error:
            yield f"beacon {beacon.id}: the keys beside its chips name no code ({error}); the chips are used"
            continue
        if code.chips != "".join(map(str, named.tolist())):
            yield f"beacon {beacon.id}: its chips are not the {code.family} named beside them; the chips are used"


def _samples(recording: Recording, figures: CaptureFigures) -> Iterator[str]:
    site, rate_hz = recording.site, recording.rate_hz or 0.0
    if recording.sample_count is not None and figures.sample_count < recording.sample_count:
        yield (
            f"the capture holds {figures.sample_count} samples where its header states {recording.sample_count}: "
            "it is cut off or damaged"
        )
    channels = {m.channel: m.id for m in site.microphones if m.channel is not None}
    for channel, peak in enumerate(figures.peak):
        name = f"channel {channel}" + (f" ({channels[channel]})" if channel in channels else "")
        if figures.not_finite[channel]:
            yield f"{name}: {figures.not_finite[channel]} samples NaN or infinite"
        if peak == 0:
            yield f"{name} is silent throughout"
        elif peak < 1e-3:
            yield f"{name} is very weak: its peak is {20 * np.log10(peak):.0f} dB of full scale"
        if figures.clipped[channel] > 1e-6:
            yield f"{name}: {100 * figures.clipped[channel]:.3g} % of the samples are clipped"
    spare = [channel for channel in range(len(figures.peak)) if channel not in channels]
    if spare:
        yield f"no microphone names channel {', '.join(map(str, spare))} of the capture"
    for beacon in site.coded_beacons:
        signal = site.signal_of(beacon)
        if signal.cycles_per_chip and 2 * signal.carrier_hz * (1 + 1 / signal.cycles_per_chip) > rate_hz:
            yield f"beacon {beacon.id}: a rate of {rate_hz:g} Hz cuts off the upper side of its sound; record faster"
    period_s = site.schedule.period_s if site.schedule else None
    if period_s is not None and figures.sample_count < period_s * rate_hz:
        yield f"the capture lasts {figures.sample_count / rate_hz:.4g} s, less than one period of {period_s:g} s"


def _sensors(recording: Recording, figures: CaptureFigures | None) -> Iterator[str]:
    if figures is not None and recording.rate_hz is not None:
        first_s, last_s = 0.0, figures.sample_count / recording.rate_hz
    elif recording.ranges is not None:
        first_s, last_s = float(recording.ranges.time_s.min()), float(recording.ranges.time_s.max())
    elif recording.by_positions:
        told_s = recording.tables["positions"].columns["time_s"]
        if not len(told_s):
            return
        first_s, last_s = float(told_s.min()), float(told_s.max())
    else:
        return
    for stem in ("odometry", "steps", "compass", "imu"):
        if stem in recording.tables:
            told_s = recording.tables[stem].columns["time_s"]
            if told_s[0] > last_s or told_s[-1] < first_s:
                yield (
                    f"{stem}.csv (from {told_s[0]:.9g} to {told_s[-1]:.9g} s) tells nothing of the time of what is "
                    f"heard (from {first_s:.9g} to {last_s:.9g} s); both have to stand on one clock"
                )


def _sync(recording: Recording, figures: CaptureFigures) -> Iterator[str]:
    times, schedule = recording.sync_s, recording.site.schedule
    if times is None or recording.rate_hz is None:
        return
    outside = np.count_nonzero((times < 0) | (times >= figures.sample_count / recording.rate_hz))
    if outside:
        yield f"{outside} of {len(times)} sync instants lie outside the capture"
    if schedule is not None and schedule.period_s is not None and len(times) > 1:
        steps = np.diff(times)
        odd = np.count_nonzero(np.abs(steps - schedule.period_s) > 0.1 * schedule.period_s)
        if odd:
            yield f"{odd} of {len(steps)} steps between sync instants are not the period of {schedule.period_s:g} s"
