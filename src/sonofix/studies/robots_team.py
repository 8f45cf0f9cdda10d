"""A robot knocked aside while two others stand, heard: all three sound and listen, the receiver runs as on any team."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sonofix.channel import Motion, Sampled, Still, direct_gains, level_below, noise_for_snr, simulate
from sonofix.records import Event, Floats, Recording, Step, Table
from sonofix.signals.codes import primitive_taps
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

RATE_HZ = 192_000.0
PERIOD_S = 0.5
SNR_DB = 6.0
"""Of the median burst over the noise in the whole band."""

PEAK = 0.5
ROBOTS = ("K", "R2", "R1")
OFFSETS_S = (0.0, 0.16, 0.32)
"""Time division: each sounds when the one before has been heard 25 m away."""

SENSORS_HZ = 10.0
KNOCK_S = 0.08
"""How long the knock takes, between two epochs' bursts; so short, no burst is heard of it."""

EVENTS = ("slip", "reset")
"""What the track reports where ranges show that a robot is not where its own sensors have it."""


@dataclass(frozen=True, slots=True, eq=False)
class Team:
    """R1's run as the receiver had it: an epoch a row, NaN where it made nothing; and its events."""

    time_s: Floats
    place_m: Floats
    sd_m: Floats
    events: tuple[Event, ...]


def site(anchors_m: Sequence[tuple[float, float]]) -> Site:
    """Return a site of three robots on one level, each with a code of 255 chips on 40 kHz and a microphone."""
    taps = primitive_taps(8)
    height = [0.0, 0.0, 0.3]
    return Site.model_validate(
        {
            "site": {"name": f"a team round {anchors_m[0]} and {anchors_m[1]}"},
            "schedule": {"period_s": PERIOD_S, "synchronised": True},
            "signal": {"carrier_hz": 40e3, "modulation": "ask", "cycles_per_chip": 10, "bandwidth_hz": 4e3},
            "vehicle": [{"id": robot, "z_m": 0.0, "max_speed_mps": 2.0} for robot in ROBOTS],
            "beacon": [
                {
                    "id": robot,
                    "vehicle": robot,
                    "lever_arm_m": height,
                    "offset_s": OFFSETS_S[i],
                    "code": {"family": "m-sequence", "degree": 8, "taps": taps[i]},
                }
                for i, robot in enumerate(ROBOTS)
            ],
            "microphone": [
                {"id": robot, "vehicle": robot, "channel": i, "lever_arm_m": height} for i, robot in enumerate(ROBOTS)
            ],
        }
    )


def knocked(
    start_m: tuple[float, float],
    corner_m: tuple[float, float],
    beside_m: tuple[float, float],
    speed_mps: float,
    duration_s: float,
) -> tuple[Sampled, float]:
    """Motion of R1: straight to a corner, knocked beside it, and on by the same heading; and when the knock is over."""
    start, corner, beside = (np.array([*place, 0.0]) for place in (start_m, corner_m, beside_m))
    way = corner - start
    unit, yaw = way / np.linalg.norm(way), float(np.arctan2(way[1], way[0]))
    knock_s = float(np.linalg.norm(way)) / speed_mps
    over_s = knock_s + KNOCK_S
    end = beside + (duration_s - over_s) * speed_mps * unit
    rows = np.array([0.0, knock_s, over_s, duration_s])
    return Sampled(rows, np.array([start, corner, beside, end]), np.full(4, yaw), "linear"), over_s


def recorded(
    team: Site,
    anchors_m: Sequence[tuple[float, float]],
    motion: Motion,
    speed_mps: float,
    duration_s: float,
    compass_sd_rad: float,
    way_sd: float,
    seed: int,
) -> Recording:
    """Simulate what the three would record, with odometry, compass and start poses of each.

    Wheels tell R1's ``speed_mps`` with white errors, a share ``way_sd`` of a second's way (so more of a tenth's), and
    nothing of the knock.
    """
    motions: dict[str, Motion] = {robot: Still((*place, 0.0)) for robot, place in zip(ROBOTS, anchors_m, strict=False)}
    motions["R1"] = motion
    waveforms = waveforms_of(team)
    gains = direct_gains(team, motions, waveforms, duration_s)
    level = level_below(PEAK, gains, waveforms)
    recording, _ = simulate(
        team,
        motions,
        rate_hz=RATE_HZ,
        duration_s=duration_s,
        waveforms=waveforms,
        noise_sd=noise_for_snr(SNR_DB, level, gains, waveforms),
        level=level,
        seed=seed,
    )
    rng = np.random.default_rng([seed, 8])
    time_s = np.arange(0.0, duration_s, 1 / SENSORS_HZ)
    speed, heading, names = [], [], []
    for robot in ROBOTS:
        true = motions[robot].at(time_s)
        drives = speed_mps if robot == "R1" else 0.0
        speed.append(drives * (1 + way_sd * np.sqrt(SENSORS_HZ) * rng.standard_normal(len(time_s))))
        heading.append(true.yaw_rad + compass_sd_rad * rng.standard_normal(len(time_s)))
        names += [robot] * len(time_s)
    poses = [motions[robot].at(np.zeros(1)) for robot in ROBOTS]
    vehicles, times = tuple(names), np.tile(time_s, len(ROBOTS))
    tables = {
        "odometry": Table(
            {"time_s": times, "v_mps": np.concatenate(speed), "yaw_rate_radps": np.zeros(len(times))},
            {"vehicle": vehicles},
        ),
        "compass": Table({"time_s": times, "heading_rad": np.concatenate(heading)}, {"vehicle": vehicles}),
        "start": Table(
            {
                "x_m": np.array([pose.position_m[0, 0] for pose in poses]),
                "y_m": np.array([pose.position_m[0, 1] for pose in poses]),
                "yaw_rad": np.array([pose.yaw_rad[0] for pose in poses]),
            },
            {"vehicle": ROBOTS},
        ),
    }
    return Recording(
        site=recording.site,
        rate_hz=recording.rate_hz,
        sample_count=recording.sample_count,
        blocks=recording.blocks,
        tables=tables,
    )


def laid_out(steps: Sequence[Step]) -> Team:
    """Lay R1's run out by epochs."""
    n = len(steps)
    time_s, sd_m, place_m = np.full(n, np.nan), np.full(n, np.nan), np.full((n, 2), np.nan)
    events: list[Event] = []
    for k, step in enumerate(steps):
        for estimate in step.estimates:
            if estimate.vehicle == "R1":
                time_s[k], place_m[k] = estimate.time_s, estimate.position_m[:2]
                sd_m[k] = np.hypot(estimate.sd("x") or 0.0, estimate.sd("y") or 0.0)
        events += [event for event in step.events if event.event in EVENTS]
    return Team(time_s, place_m, sd_m, tuple(events))
