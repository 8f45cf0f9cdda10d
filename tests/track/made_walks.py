"""Walkers with steps, made for the tests: a path of straight legs, steps with slow errors, ranges with exact truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from locate.made_epochs import SPEED, make_site
from sonofix.records import Floats, RangeEpoch, Table

CEILING = ((0.0, 0.0, 3.0), (12.0, 0.0, 3.1), (12.0, 8.0, 3.0), (0.0, 8.0, 2.9), (6.0, 0.0, 3.1), (6.0, 8.0, 2.9))
LEVEL_M = 0.85
SITE = make_site(CEILING, level_m=LEVEL_M)
PERIOD_S = 0.5


@dataclass(frozen=True)
class Walk:
    """A path walked at constant speed: round a rectangle of 8 m × 4 m from ``begin_m`` along it."""

    speed_mps: float = 1.2
    begin_m: float = 0.0
    corner_m: tuple[float, float] = (2.0, 2.0)
    size_m: tuple[float, float] = (8.0, 4.0)

    def place(self, time_s: float) -> Floats:
        long, short = self.size_m
        way = (self.begin_m + self.speed_mps * time_s) % (2 * (long + short))
        x, y = self.corner_m
        if way < long:
            return np.array([x + way, y, LEVEL_M])
        if way < long + short:
            return np.array([x + long, y + way - long, LEVEL_M])
        if way < 2 * long + short:
            return np.array([x + long - (way - long - short), y + short, LEVEL_M])
        return np.array([x, y + short - (way - 2 * long - short), LEVEL_M])


def steps_of(walk: Walk, duration_s: float, rng: np.random.Generator, first_s: float = 0.44) -> Table:
    """Two steps a second whose length errs by a Gauss–Markov process of 5 cm and whose heading by one of 2°, 20 s."""
    times = np.arange(first_s, duration_s, 0.5)
    fade = np.exp(-0.5 / 20.0)
    error = rng.standard_normal(2)
    lengths, headings = np.full(len(times), 0.0), np.full(len(times), 0.0)
    for i, t in enumerate(times):
        chord = (walk.place(t) - walk.place(t - 0.5))[:2]
        lengths[i] = np.hypot(*chord) + 0.05 * error[0]
        headings[i] = np.arctan2(chord[1], chord[0]) + np.radians(2.0) * error[1]
        error = fade * error + np.sqrt(1 - fade**2) * rng.standard_normal(2)
    return Table({"time_s": times, "length_m": lengths, "heading_rad": headings}, {"vehicle": ("v",) * len(times)})


def epoch_of(
    walk: Walk,
    time_s: float,
    rng: np.random.Generator,
    heard: tuple[int, ...] = (0, 1, 2, 3, 4, 5),
    sd_m: float = 0.001,
    rate_sd_mps: float | None = 0.001,
    clock_m: float | None = 0.9,
) -> RangeEpoch:
    """What the walker hears of some of the beacons, each at its own moment."""
    times = time_s + 0.03 * rng.random(len(heard))
    beacons = np.array([CEILING[i] for i in heard]).reshape(-1, 3)
    ways = [np.linalg.norm(walk.place(t) - b) for t, b in zip(times, beacons, strict=True)]
    step = 1e-5
    rates = [
        (np.linalg.norm(walk.place(t + step) - b) - np.linalg.norm(walk.place(t - step) - b)) / (2 * step)
        for t, b in zip(times, beacons, strict=True)
    ]
    n = len(heard)
    epoch = RangeEpoch(
        index=0,
        sync_s=time_s - 0.05,
        emitter=tuple(f"B{i}" for i in heard),
        receiver=("M0",) * n,
        time_s=times,
        range_m=np.array(ways) + (clock_m or 0.0) + sd_m * rng.standard_normal(n),
        covariance_m2=sd_m**2 * np.eye(n),
        range_rate_mps=None,
        range_rate_sd_mps=None,
        snr_db=np.full(n, 20.0),
        clock="known" if clock_m is None else "common",
        sound_speed_mps=SPEED,
    )
    if rate_sd_mps is None:
        return epoch
    return replace(
        epoch,
        range_rate_mps=np.array(rates) + rate_sd_mps * rng.standard_normal(n),
        range_rate_sd_mps=np.full(n, rate_sd_mps),
    )
