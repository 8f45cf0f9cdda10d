"""The third seed's simulations: a burst picked out of noise (figures 2, 4, 5), and a robot knocked aside (3, 6)."""

from __future__ import annotations

from sonofix.studies.robots_collision import Collision
from sonofix.studies.robots_detection import Detection
from sonofix.studies.work import Work


def study(runs: int, seed: int, waveforms: int, part: str) -> Work:
    """Set one part up, "detection" or "collision"."""
    return {"detection": Detection, "collision": Collision}[part](runs, seed, waveforms)
