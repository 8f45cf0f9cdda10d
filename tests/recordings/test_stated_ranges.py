"""Real ranges that others stated: how near causal tracks come to the truth, where the recordings are present."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sonofix.files import read_recording, read_truth
from sonofix.flow import run


@pytest.mark.parametrize(
    ("name", "rmse_m", "inside"),
    [
        ("labyrinth", 0.070, 0.75),
        ("carpark-513", 0.95, 0.75),
        # long: 24 pairs at 20 Hz
        pytest.param("table-fast", 0.052, 0.75, marks=pytest.mark.prove),
    ],
)
def test_tracks_come_near_the_truth(data: Path, name: str, rmse_m: float, inside: float) -> None:
    recording = read_recording(data / name, to_run=True)
    truth = next(iter(read_truth(data / name).values()))
    told = [e for step in run(recording) for e in step.estimates]
    told = [e for e in told if truth.time_s[0] <= e.time_s <= truth.time_s[-1]]
    time_s = [e.time_s for e in told]
    miss = np.array([e.position_m[:2] for e in told])
    miss -= np.column_stack([np.interp(time_s, truth.time_s, truth.position_m[:, i]) for i in range(2)])
    sd = np.array([np.sqrt(np.diag(e.covariance)[:2]) for e in told])
    # a vehicle is told of from the start on, but for the seconds in which two places are as likely
    assert told[0].time_s - truth.time_s[0] < 10.0
    assert np.sqrt(np.mean(np.sum(miss**2, axis=1))) < rmse_m
    assert np.mean(np.all(np.abs(miss) < 2 * sd, axis=1)) > inside
