"""A small recording that is right in every respect, for tests that break it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile
from scipy.signal import max_len_seq

RATE_HZ, CARRIER_HZ, CYCLES, PERIOD_S, SPEED_MPS = 48000, 12000.0, 6, 0.1, 343.2
TAPS = {"B1": [1], "B2": [5], "B3": [1, 2, 5], "B4": [1, 3, 4]}
PLACES = {"B1": (0.0, 0.0, 2.5), "B2": (4.0, 0.0, 2.4), "B3": (4.0, 3.0, 2.5), "B4": (0.0, 3.0, 2.3)}
EAR = (2.5, 1.0, 0.5)

SITE = """format = 1

[site]
name = "lab"
bounds_m = [[-0.1, -0.1, 0.0], [4.1, 3.1, 2.6]]

[air]
temperature_c = 20.0
sound_speed_mps = 343.2

[schedule]
period_s = 0.1
synchronised = true

[signal]
carrier_hz = 12000.0
modulation = "ask"
cycles_per_chip = 6

[[vehicle]]
id = "agv"
z_m = 0.0
max_speed_mps = 2.0

[[microphone]]
id = "M1"
channel = 0
vehicle = "agv"
lever_arm_m = [0.0, 0.0, 0.5]
""" + "".join(
    f"""
[[beacon]]
id = "{name}"
position_m = {list(PLACES[name])}
code = {{ family = "m-sequence", degree = 6, taps = {taps} }}
"""
    for name, taps in TAPS.items()
)

TRUTH = "time_s,x_m,y_m,z_m,yaw_rad\n0.0,2.5,1.0,0.0,0.0\n0.2,2.5,1.0,0.0,0.0\n"
EPOCHS = 2


@pytest.fixture(scope="session")
def lab_samples() -> np.ndarray:
    """0.2 s of four bursts an epoch in faint noise, float32 (9600, 1)."""
    t = np.arange(round(EPOCHS * PERIOD_S * RATE_HZ)) / RATE_HZ
    heard = 1e-3 * np.random.default_rng(1).standard_normal(len(t))
    for name, taps in TAPS.items():
        chips = max_len_seq(6, taps=taps)[0]
        distance_m = float(np.linalg.norm(np.subtract(PLACES[name], EAR)))
        for epoch in range(EPOCHS):
            since = t - epoch * PERIOD_S - distance_m / SPEED_MPS
            chip = np.floor(since * CARRIER_HZ / CYCLES).astype(int)
            on = (chip >= 0) & (chip < len(chips))
            sounding = np.where(on, chips[np.clip(chip, 0, len(chips) - 1)], 0)
            heard += 0.3 / distance_m * sounding * np.sin(2 * np.pi * CARRIER_HZ * since)
    return heard.astype(np.float32)[:, None]


@pytest.fixture
def lab(tmp_path: Path, lab_samples: np.ndarray) -> Path:
    """Make the recording, with a capture and a truth."""
    folder = tmp_path / "lab"
    folder.mkdir()
    (folder / "site.toml").write_text(SITE)
    (folder / "truth.csv").write_text(TRUTH)
    soundfile.write(folder / "capture.wav", lab_samples, RATE_HZ, subtype="PCM_16")
    return folder
