"""The simulator stands for the recordings: simulate what was recorded, and the receiver ranges both equally well.

The same site, the true motion, the level and the noise measured on the recording; then errors of the same variance,
by the F interval for their numbers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sonofix import score
from sonofix.channel import Sampled, simulate
from sonofix.files import read_recording, read_truth
from sonofix.flow import run
from sonofix.records import Floats, Recording, Truth
from sonofix.signals.waveform import waveforms_of

ABSORPTION_DB_PER_M = 1.32
"""What the recordings' maker states."""

MISS = 1e-3


def fitted(recording: Recording, truths: dict[str, Truth], lasting_s: float) -> tuple[float, float]:
    """Level and noise of a recording: least squares of one beacon's sound each, and what is left where all is quiet."""
    assert recording.blocks is not None
    assert recording.rate_hz is not None
    count = int(lasting_s * recording.rate_hz)
    heard = next(recording.blocks(count))[:, 0].astype(float)
    motions = {v: Sampled(t.time_s, t.position_m, t.yaw_rad) for v, t in truths.items()}
    made, _ = simulate(
        recording.site,
        motions,
        rate_hz=recording.rate_hz,
        duration_s=lasting_s,
        waveforms=waveforms_of(recording.site),
        level=1.0,
        absorption_db_per_m=ABSORPTION_DB_PER_M,
    )
    assert made.blocks is not None
    sound = next(made.blocks(count))[:, 0].astype(float)
    level = float(sound @ heard / (sound @ sound))
    quiet = np.abs(sound) < 1e-3 * np.abs(sound).max()
    assert quiet.sum() > 2e4
    return level, float(np.std(heard[quiet]))


def errors(recording: Recording, truths: dict[str, Truth]) -> tuple[Floats, Floats, Floats]:
    """Errors of ranges (m) and of their rates (m/s), and of ranges over stated deviations."""
    site = recording.site
    columns = score.range_columns(run(recording))
    beacons = {b.id: b for b in site.beacons}
    microphone = site.microphones[0]

    def true(shift_s: float) -> Floats:
        return np.array(
            [
                score.heard_range_m(beacons[e], microphone, truths, np.array([t + shift_s]), site.sound_speed_mps)[0]
                for e, t in zip(columns.emitter, columns.time_s, strict=True)
            ]
        )

    error = columns.range_m - true(0.0)
    return error, columns.range_rate_mps - (true(0.01) - true(-0.01)) / 0.02, error / columns.sd_m


def ratio_interval(first: int, second: int) -> tuple[float, float]:
    """Of two rms of equal variance: the root of the F interval."""
    from scipy.stats import f

    low, high = f.ppf([MISS / 2, 1 - MISS / 2], first, second)
    return float(np.sqrt(low)), float(np.sqrt(high))


@pytest.mark.parametrize("name", ["still", "drive"])
def test_receiver_ranges_simulation_and_recording_equally_well(captures: Path, name: str) -> None:
    recording, truths = read_recording(captures / name), read_truth(captures / name)
    assert recording.rate_hz is not None
    assert recording.sample_count is not None
    level, noise_sd = fitted(recording, truths, 2.0)
    motions = {v: Sampled(t.time_s, t.position_m, t.yaw_rad) for v, t in truths.items()}
    made, made_truths = simulate(
        recording.site,
        motions,
        rate_hz=recording.rate_hz,
        duration_s=recording.sample_count / recording.rate_hz,
        waveforms=waveforms_of(recording.site),
        level=level,
        noise_sd=noise_sd,
        absorption_db_per_m=ABSORPTION_DB_PER_M,
        seed=11,
    )
    theirs, ours = errors(recording, truths), errors(made, made_truths)
    assert len(theirs[0]) == len(ours[0])
    low, high = ratio_interval(len(theirs[0]), len(ours[0]))
    for kind, first, second in zip(("range", "range rate", "range over sd"), theirs, ours, strict=True):
        ratio = np.sqrt(np.mean(first**2) / np.mean(second**2))
        assert low < ratio < high, kind
    # and no bias of one against the other: the difference of two means
    sd = np.sqrt(np.mean(theirs[0] ** 2) / len(theirs[0]) + np.mean(ours[0] ** 2) / len(ours[0]))
    assert abs(theirs[0].mean() - ours[0].mean()) < 3.3 * sd
