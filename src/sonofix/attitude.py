"""Attitudes: how roll, pitch and yaw turn a body whose axes point forward, left and up.

R = Rz(yaw) Ry(pitch) Rx(roll) turns body axes into east, north, up. Roll above 0 lifts the left side, pitch above 0
lowers the nose. At a pitch of ±90° yaw and roll are one; bodies that point there have no use for three angles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.floating]


def turned(arm_m: ArrayLike, roll_rad: Floats | None, pitch_rad: Floats | None, yaw_rad: Floats) -> Floats:
    """Where an arm (3,) of the body frame points, (n, 3) east-north-up, at angles (n,); None: upright."""
    forward, left, up = np.asarray(arm_m, float)
    if roll_rad is not None:
        cos, sin = np.cos(roll_rad), np.sin(roll_rad)
        left, up = cos * left - sin * up, sin * left + cos * up
    if pitch_rad is not None:
        cos, sin = np.cos(pitch_rad), np.sin(pitch_rad)
        forward, up = cos * forward + sin * up, cos * up - sin * forward
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.stack([cos * forward - sin * left, sin * forward + cos * left, np.broadcast_to(up, cos.shape)], axis=-1)


def spin(pitch_rad: Floats | None, yaw_rad: Floats, rates_radps: tuple[Floats, Floats, Floats]) -> Floats:
    """Angular velocity (n, 3), east-north-up, of a body whose roll, pitch and yaw change at these rates, (n,) each."""
    roll, pitch, yaw = rates_radps
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    level, down = (1.0, 0.0) if pitch_rad is None else (np.cos(pitch_rad), np.sin(pitch_rad))
    return np.stack([roll * level * cos - pitch * sin, roll * level * sin + pitch * cos, yaw - roll * down], axis=-1)


def quaternion(roll_rad: ArrayLike, pitch_rad: ArrayLike, yaw_rad: ArrayLike) -> Floats:
    """Return x, y, z and w, (4, …), of the unit quaternions that turn body axes into east, north, up."""
    half = [0.5 * np.asarray(angle, float) for angle in (roll_rad, pitch_rad, yaw_rad)]
    (a, d), (b, e), (c, f) = ((np.sin(angle), np.cos(angle)) for angle in half)
    return np.array([a * e * f - d * b * c, d * b * f + a * e * c, d * e * c - a * b * f, d * e * f + a * b * c])
