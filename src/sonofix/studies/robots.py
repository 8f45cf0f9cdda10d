"""The third seed's simulations: a burst picked out of noise (figures 2, 4, 5), a knock (3, 6), and leap-frog."""

from __future__ import annotations

from sonofix.studies.robots_collision import Collision
from sonofix.studies.robots_detection import Detection
from sonofix.studies.robots_leapfrog import Leapfrog
from sonofix.studies.work import Work


def study(runs: int, seed: int, waveforms: int, part: str, wanted_m: float | None = None) -> Work:
    """Set one part up, "detection", "collision" or "leapfrog"; ``wanted_m`` is for the last."""
    if part == "leapfrog":
        return Leapfrog(runs, seed, waveforms) if wanted_m is None else Leapfrog(runs, seed, waveforms, wanted_m)
    return {"detection": Detection, "collision": Collision}[part](runs, seed, waveforms)
