"""The third seed's simulations: a burst picked out of noise (figures 2, 4, 5), a knock (3, 6), and leap-frog."""

from __future__ import annotations

from sonofix.studies.robots_collision import Collision
from sonofix.studies.robots_detection import Detection
from sonofix.studies.robots_leapfrog import Leapfrog
from sonofix.studies.work import Work


def study(runs: int, seed: int, waveforms: int, part: str) -> Work:
    """Set one part up, "detection", "collision" or "leapfrog"."""
    return {"detection": Detection, "collision": Collision, "leapfrog": Leapfrog}[part](runs, seed, waveforms)
