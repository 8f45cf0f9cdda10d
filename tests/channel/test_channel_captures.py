"""The simulator against recordings of another maker: subtract what it says was heard, and noise must remain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sonofix.channel import Sampled, simulate
from sonofix.files import read_recording, read_truth
from sonofix.signals.waveform import waveform_of

LASTING_S = 2.0


@pytest.mark.parametrize(
    ("name", "echo"), [("still", 0.0), ("drive", 0.0), ("fast", 0.0), ("pair", 0.0), ("echo", 0.6)]
)
def test_what_remains_is_noise(captures: Path, name: str, echo: float) -> None:
    recording = read_recording(captures / name)
    assert recording.blocks is not None
    assert recording.rate_hz is not None
    count = int(LASTING_S * recording.rate_hz)
    heard = next(recording.blocks(count)).astype(float)
    motions = {
        vehicle: Sampled(t.time_s, t.position_m, t.yaw_rad) for vehicle, t in read_truth(captures / name).items()
    }
    sounds = []
    for beacon in recording.site.coded_beacons:
        made, _ = simulate(
            recording.site,
            motions,
            rate_hz=recording.rate_hz,
            duration_s=LASTING_S,
            waveforms={beacon.id: waveform_of(recording.site, beacon)},
            level=1.0,
            echo=echo,
            absorption_db_per_m=1.32,
        )
        assert made.blocks is not None
        sounds.append(next(made.blocks(count)))
    for channel in range(heard.shape[1]):
        basis = np.stack([s[:, channel] for s in sounds], axis=1).astype(float)
        level, *_ = np.linalg.lstsq(basis, heard[:, channel], rcond=None)
        remains = heard[:, channel] - basis @ level
        loud = np.abs(basis).max(axis=1) > 1e-3 * np.abs(basis).max()
        assert loud.sum() > 5e4
        assert (~loud).sum() > 5e4
        # each deviation is known to 1 / sqrt(2n), 0.3 %; the bursts are 4 to 9 times as strong as the noise
        assert np.std(heard[loud, channel]) > 3 * np.std(heard[~loud, channel])
        assert np.std(remains[loud]) == pytest.approx(np.std(remains[~loud]), rel=0.015)
        np.testing.assert_allclose(level, level.mean(), rtol=0.02)
