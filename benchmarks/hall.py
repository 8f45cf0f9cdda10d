"""The demonstration's hall, 192 kHz, 6 dB: what all benchmarks run on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.channel import Motion, Tone, direct_gains, level_below, noise_for_snr, simulate
from sonofix.cli.demo import PERIOD_S, RATE_HZ, SNR_DB, demo_motion, demo_site
from sonofix.records import Recording, Truth
from sonofix.signals.waveform import waveforms_of

LAP_S = 20.0
__all__ = ["LAP_S", "PERIOD_S", "RATE_HZ", "lap_motion", "laps", "recorded"]


def lap_motion() -> Motion:
    """Return the round through the hall; it takes `LAP_S` and goes on for ever."""
    return demo_motion(LAP_S)


def recorded(
    duration_s: float,
    motion: Motion,
    *,
    echo: float = 0.0,
    snr_db: float | None = SNR_DB,
    tone: Tone | None = None,
    sound_speed_mps: float | None = None,
) -> tuple[Recording, Truth]:
    """Return what the hall's microphone hears, computed as it is read; ``snr_db`` None: without noise."""
    site = demo_site()
    motions, waveforms = {"agv": motion}, waveforms_of(site)
    gains = direct_gains(site, motions, waveforms, duration_s)
    level = level_below(0.5, gains, waveforms, echo)
    recording, truth = simulate(
        site,
        motions,
        rate_hz=RATE_HZ,
        duration_s=duration_s,
        waveforms=waveforms,
        level=level,
        noise_sd=0.0 if snr_db is None else noise_for_snr(snr_db, level, gains, waveforms),
        echo=echo,
        tone=tone,
        sound_speed_mps=sound_speed_mps,
        seed=1,
    )
    return recording, truth["agv"]


def laps(count: int) -> tuple[Recording, Truth]:
    """Return a recording of several laps: one, computed once, and then again and again."""
    lap, truth = recorded(LAP_S, lap_motion())
    assert lap.blocks is not None
    samples = np.concatenate(list(lap.blocks(RATE_HZ)))

    def blocks(length: int) -> Iterator[NDArray[np.float32]]:
        for start in range(0, count * len(samples), length):
            yield samples[np.arange(start, min(start + length, count * len(samples))) % len(samples)]

    time_s = np.concatenate([truth.time_s + k * LAP_S for k in range(count)])
    again = Truth(truth.vehicle, time_s, np.tile(truth.position_m, (count, 1)), None)
    return replace(lap, sample_count=count * len(samples), blocks=blocks), again
