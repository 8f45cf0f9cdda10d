"""Halls that studies listen in: a made-up site, what would be heard there, and the receiver run on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix import flow
from sonofix.channel import Motion, direct_gains, level_below, noise_for_snr, simulate
from sonofix.records import Floats, Recording, Step, Table
from sonofix.signals.codes import primitive_taps
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

RATE_HZ = 192_000.0
SNR_DB = 6.0
"""Of the median burst over the noise in the whole band."""

PEAK = 0.5
"""Of all bursts together, full scale 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """What the receiver made of one run, an epoch a row; NaN where it made nothing.

    Attributes
    ----------
    fix_s, fix_m : float64 (n,), (n, 2)
        Fixes from single epochs.
    track_s, track_m, track_mps : float64 (n,), (n, 2), (n, 2)
        Estimates of the track.
    """

    fix_s: Floats
    fix_m: Floats
    track_s: Floats
    track_m: Floats
    track_mps: Floats


def hall(
    name: str,
    size_m: tuple[float, float, float],
    beacons_m: Sequence[tuple[float, float, float]],
    vehicle: str,
    level_m: float,
    synchronised: bool,
) -> Site:
    """Return a hall of beacons with m-sequences of 511 chips on 40 kHz, two bursts a second, one microphone."""
    taps = primitive_taps(9)
    return Site.model_validate(
        {
            "site": {"name": name, "bounds_m": [[0, 0, 0], list(size_m)]},
            "schedule": {"period_s": 0.5, "synchronised": synchronised},
            "signal": {"carrier_hz": 40e3, "modulation": "ask", "cycles_per_chip": 10, "bandwidth_hz": 4e3},
            "vehicle": [{"id": vehicle, "z_m": level_m, "max_speed_mps": 2.0}],
            "beacon": [
                {"id": f"B{i + 1}", "position_m": p, "code": {"family": "m-sequence", "degree": 9, "taps": taps[i]}}
                for i, p in enumerate(beacons_m)
            ],
            "microphone": [{"id": "M1", "channel": 0, "vehicle": vehicle, "lever_arm_m": [0.0, 0.0, 0.0]}],
        }
    )


def sounded(
    site: Site,
    motion: Motion,
    duration_s: float,
    seed: int,
    clock_offset_s: float = 0.0,
    blind_s: tuple[float, float] | None = None,
    heard_blind: Sequence[str] = (),
) -> Recording:
    """Simulate what the site's one microphone would hear.

    Parameters
    ----------
    site : Site
    motion : Motion
        Of its one vehicle.
    duration_s : float
    seed : int
        Of the noise.
    clock_offset_s : float
        Of the first epoch on the recorder's clock.
    blind_s : (float, float), optional
        Recorder's time in which all beacons but ``heard_blind`` are silent: from one epoch's start to another's.
    heard_blind : sequence of beacon ids
    """
    motions = {site.vehicles[0].id: motion}
    waveforms = waveforms_of(site)
    gains = direct_gains(site, motions, waveforms, duration_s)
    level = level_below(PEAK, gains, waveforms)
    noise_sd = noise_for_snr(SNR_DB, level, gains, waveforms)

    def made(sounding: Sequence[str]) -> Recording:
        recording, _ = simulate(
            site,
            motions,
            rate_hz=RATE_HZ,
            duration_s=duration_s,
            waveforms={beacon: waveforms[beacon] for beacon in sounding},
            noise_sd=noise_sd,
            level=level,
            clock_offset_s=clock_offset_s,
            seed=seed,
        )
        return recording

    recording = made(list(waveforms))
    if blind_s is None:
        return recording
    return _spliced(recording, made(heard_blind), blind_s)


def _spliced(loud: Recording, quiet: Recording, span_s: tuple[float, float]) -> Recording:
    """Return one recording that is another within a span; both have the same noise."""
    loud_blocks, quiet_blocks = loud.blocks, quiet.blocks
    if loud_blocks is None or quiet_blocks is None:
        raise ValueError("recordings without samples cannot be spliced")
    first, last = (round(edge * RATE_HZ) for edge in span_s)

    def blocks(length: int) -> Iterator[NDArray[np.float32]]:
        start = 0
        for one, other in zip(loud_blocks(length), quiet_blocks(length), strict=True):
            index = start + np.arange(len(one))
            yield np.where(((index >= first) & (index < last))[:, None], other, one)
            start += len(one)

    return replace(loud, blocks=blocks)


def listened(recording: Recording, tables: Mapping[str, Table] | None = None) -> Iterator[Step]:
    """Run the receiver on a recording, with tables of the vehicle's own sensors beside it; a step an epoch."""
    yield from flow.run(replace(recording, tables=dict(tables or {})))


def laid_out(steps: Sequence[Step]) -> Heard:
    """Lay a run of one vehicle out by epochs."""
    n = len(steps)
    fix_s, track_s = np.full(n, np.nan), np.full(n, np.nan)
    fix_m, track_m, track_mps = (np.full((n, 2), np.nan) for _ in range(3))
    for k, step in enumerate(steps):
        for fix in step.fixes:
            if fix.status == "ok" and fix.position_m is not None:
                fix_s[k], fix_m[k] = fix.time_s, fix.position_m[:2]
        for estimate in step.estimates:
            track_s[k] = estimate.time_s
            track_m[k], track_mps[k] = estimate.position_m[:2], estimate.velocity_mps[:2]
    return Heard(fix_s, fix_m, track_s, track_m, track_mps)


def truth_at(motion: Motion, time_s: Floats) -> tuple[Floats, Floats]:
    """True places (n, 2) and velocities (n, 2) at given times (n,), NaN where the time is."""
    known = np.isfinite(time_s)
    places, velocities = (np.full((len(time_s), 2), np.nan) for _ in range(2))
    poses = motion.at(time_s[known])
    places[known], velocities[known] = poses.position_m[:, :2], poses.velocity_mps[:, :2]
    return places, velocities
