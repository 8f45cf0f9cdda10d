"""Ranges among robots that stand, from waveforms: they sound in turn, synchronised by radio, and hear each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sonofix.acquire.plan import Plan, acquire, make_plan
from sonofix.channel import Still, Tone, simulate
from sonofix.ranging import range_epoch
from sonofix.records import Acquisition, Floats, Waveform
from sonofix.signals.codes import primitive_taps
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

ROBOTS = ("K", "R2", "R1")
RATE_HZ = 96e3
CARRIER_HZ = 40e3
SPEED_MPS = 343.2
"""What the team takes the speed of sound for."""

DEGREE = 7
SLOT_S = 0.1
"""Time division: each robot's burst of 32 ms is heard 20 m away before the next one sounds."""

REACH_M = 18.0
ABSORPTION_DB_PER_M = 1.32
NOISE_BAND_HZ = 4e3
"""A signal-to-noise ratio is a burst's mean power, first chip to last, over the noise in this band."""

AT_M = 10.0
"""Levels are those of a burst heard from here."""

BURST_AMPLITUDE = 0.03
"""Root of twice a burst's mean power there, full scale 1: a tone 20 dB louder stays within it."""

EPOCHS = 2
"""Of one stop."""

MAX_RATE_MPS = 0.3
"""Range rates searched: all stand."""


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """What all stops share: site, replicas, the receiver's plan, and levels of the simulation."""

    site: Site
    waveforms: Mapping[str, Waveform]
    plan: Plan
    level: float
    noise_sd: float
    tone: Tone


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """Ranges of one stop: pairs, ``range_m`` (n,), and their covariance (n, n), sound speed aside."""

    pairs: tuple[tuple[str, str], ...]
    range_m: Floats
    covariance_m2: Floats


def bench(snr_db: float, tone_db: float) -> Bench:
    """Prepare stops at a signal-to-noise ratio, under a tone on the carrier so far above a burst, at `AT_M`."""
    taps = primitive_taps(DEGREE)
    site = Site.model_validate(
        {
            "site": {"name": "leap-frog"},
            "air": {"sound_speed_mps": SPEED_MPS},
            "schedule": {"period_s": (len(ROBOTS) + 1) * SLOT_S, "synchronised": True},
            "signal": {"carrier_hz": CARRIER_HZ, "modulation": "ask", "cycles_per_chip": 10, "bandwidth_hz": 4e3},
            "vehicle": [{"id": robot, "z_m": 0.0, "max_speed_mps": MAX_RATE_MPS / 2} for robot in ROBOTS],
            "beacon": [
                {
                    "id": robot,
                    "vehicle": robot,
                    "lever_arm_m": [0.0, 0.0, 0.3],
                    "offset_s": i * SLOT_S,
                    "code": {"family": "m-sequence", "degree": DEGREE, "taps": taps[i]},
                }
                for i, robot in enumerate(ROBOTS)
            ],
            "microphone": [
                {"id": robot, "vehicle": robot, "channel": i, "lever_arm_m": [0.0, 0.0, 0.3]}
                for i, robot in enumerate(ROBOTS)
            ],
        }
    )
    waveforms = waveforms_of(site)
    burst = waveforms[ROBOTS[0]]
    time_s = np.linspace(0.0, burst.duration_s, 20000)
    power = float(np.mean(np.abs(sample(burst.envelope, burst.rate_hz, burst.start_s, time_s)) ** 2)) / 2
    level = BURST_AMPLITUDE / np.sqrt(2 * power) * AT_M * 10 ** (ABSORPTION_DB_PER_M * AT_M / 20)
    noise_sd = BURST_AMPLITUDE / np.sqrt(2.0) * np.sqrt(RATE_HZ / 2 / NOISE_BAND_HZ) / 10 ** (snr_db / 20)
    tone = Tone(CARRIER_HZ, BURST_AMPLITUDE * 10 ** (tone_db / 20))
    plan = make_plan(waveforms, RATE_HZ, SPEED_MPS, MAX_RATE_MPS)
    return Bench(site, waveforms, plan, float(level), float(noise_sd), tone)


def stop(bench: Bench, place_m: Floats, scale: float, seed: Sequence[int], epochs: int = EPOCHS) -> Heard:
    """Simulate and hear one stop.

    Parameters
    ----------
    place_m : float64 (3, 2)
        Where `ROBOTS` stand.
    scale : float
        The share by which ranges come out too long: sound is that much slower than it is taken for.
    seed : sequence of int
    epochs : int
        Each robot sounds so often; what all heard of a pair, both ways, is averaged by its stated variance.
    """
    rng = np.random.default_rng(seed)
    lead_s = bench.plan.margin_s
    opens_s = lead_s + SLOT_S * np.arange(len(ROBOTS))
    sums: dict[tuple[str, str], Floats] = {}
    for _ in range(epochs):
        recording, _ = simulate(
            bench.site,
            {robot: Still((float(x), float(y), 0.0)) for robot, (x, y) in zip(ROBOTS, place_m, strict=True)},
            rate_hz=RATE_HZ,
            duration_s=float(opens_s[-1]) + REACH_M / SPEED_MPS + bench.plan.burst_s + bench.plan.margin_s,
            waveforms=bench.waveforms,
            noise_sd=bench.noise_sd,
            level=bench.level,
            # the tone's phase is as random as its start
            tone=Tone(bench.tone.frequency_hz + float(rng.uniform(-20.0, 20.0)), bench.tone.amplitude),
            absorption_db_per_m=ABSORPTION_DB_PER_M,
            sound_speed_mps=SPEED_MPS / (1.0 + scale),
            clock_offset_s=lead_s,
            seed=int(rng.integers(2**31)),
        )
        assert recording.blocks is not None
        samples = np.concatenate(list(recording.blocks(1 << 20)))
        heard = []
        for i, robot in enumerate(ROBOTS):
            windows = {
                other: (float(opens_s[k]), float(opens_s[k]) + REACH_M / SPEED_MPS)
                for k, other in enumerate(ROBOTS)
                if other != robot
            }
            heard += acquire(bench.plan, np.ascontiguousarray(samples[:, i]), 0, robot, windows)[0]
        ranges = range_epoch(bench.site, bench.waveforms, Acquisition(0, lead_s, tuple(heard)), SPEED_MPS)
        for row in range(len(ranges)):
            ends = sorted((ranges.emitter[row], ranges.receiver[row]), key=ROBOTS.index)
            weight = 1.0 / ranges.covariance_m2[row, row]
            sums[ends[0], ends[1]] = sums.get((ends[0], ends[1]), np.zeros(2)) + weight * np.array(
                [1.0, ranges.range_m[row]]
            )
    pairs = tuple(pair for pair in combinations(ROBOTS, 2) if pair in sums)
    weights, weighted = (np.array([sums[pair][i] for pair in pairs]) for i in (0, 1))
    return Heard(pairs, weighted / weights, np.diag(1.0 / weights))
