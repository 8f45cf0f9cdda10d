"""Bodies that tilt, for the tests of fixes and tracks: attitudes are turned here by another library's rotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from locate.made_epochs import Drive
from sonofix.records import Floats

CORNERS = ((0.25, 0.0, 0.03), (-0.15, 0.2, 0.0), (-0.15, -0.2, 0.0))
"""Three microphones, not on a line."""

TETRAHEDRON = (*CORNERS, (0.0, 0.0, 0.2))
"""Four that are not in a plane: its mirror image is no turned one."""


@dataclass(frozen=True)
class Flight(Drive):
    """Straight motion of a body that turns evenly in yaw, roll and pitch."""

    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    roll_rate_radps: float = 0.0
    pitch_rate_radps: float = 0.0

    def point(self, arm_m: Sequence[float], time_s: float) -> Floats:
        pitch = self.pitch_rad + self.pitch_rate_radps * time_s
        roll = self.roll_rad + self.roll_rate_radps * time_s
        return self.origin(time_s) + Rotation.from_euler("ZYX", [self.yaw(time_s), pitch, roll]).apply(arm_m)


def flight(rng: np.random.Generator, tilt_sd_rad: float = 0.3, rates: bool = False) -> Flight:
    """Somewhere in the hall, at any heading, tilted at random; ``rates``: moving and rocking."""
    velocity = 0.5 * rng.standard_normal(3) if rates else np.zeros(3)
    spins = 0.8 * rng.standard_normal(3) if rates else np.zeros(3)
    roll, pitch = np.clip(tilt_sd_rad * rng.standard_normal(2), -1.4, 1.4)
    place = rng.uniform((1, 1, 0.5), (9, 7, 2))
    return Flight(place, velocity, rng.uniform(-3, 3), spins[0], float(roll), float(pitch), spins[1], spins[2])
