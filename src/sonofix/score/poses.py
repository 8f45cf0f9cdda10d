"""True places at any time: of vehicles, of what rides on them, and the way that sound went between two."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sonofix.attitude import turned
from sonofix.records import Floats, Truth
from sonofix.site import Beacon, Microphone

_WAY_ITERATIONS = 30


def pose_at(truth: Truth, time_s: Floats) -> tuple[Floats, Floats]:
    """Return true positions (n, 3) and headings (n,), linear between rows, held beyond the first and last.

    A truth of one row holds for ever; a heading that is not known is taken as 0.
    """
    yaw = np.zeros(len(truth.time_s)) if truth.yaw_rad is None else truth.yaw_rad
    table = np.column_stack([truth.position_m, yaw])
    rows = np.column_stack([np.interp(time_s, truth.time_s, table[:, k]) for k in range(4)])
    return rows[:, :3], rows[:, 3]


def tilt_at(truth: Truth, time_s: Floats) -> tuple[Floats, Floats]:
    """Return true roll and pitch (n,), interpolated as `pose_at` does; 0 where they are not known: upright."""
    known = (np.zeros(len(truth.time_s)) if angle is None else angle for angle in (truth.roll_rad, truth.pitch_rad))
    roll, pitch = (np.interp(time_s, truth.time_s, angle) for angle in known)
    return roll, pitch


def within(truth: Truth, time_s: Floats) -> NDArray[np.bool_]:
    """Return whether each time lies in the truth's span; always, where the truth is one row."""
    if len(truth.time_s) == 1:
        return np.ones(np.shape(time_s), bool)
    return (time_s >= truth.time_s[0]) & (time_s <= truth.time_s[-1])


def node_position_m(node: Beacon | Microphone, truths: Mapping[str, Truth], time_s: Floats) -> Floats:
    """Return where a beacon or microphone is at the given times, shape (n, 3).

    The lever arm (forward, left, up) is turned with its vehicle.

    Raises
    ------
    ValueError
        If the node rides on a vehicle without truth.
    """
    if node.position_m is not None:
        return np.tile(np.asarray(node.position_m, float), (len(time_s), 1))
    if node.vehicle is None or node.vehicle not in truths:
        known = ", ".join(truths) or "none"
        raise ValueError(f"{node.id} rides on {node.vehicle}, of which there is no truth; there is of: {known}")
    position, yaw = pose_at(truths[node.vehicle], time_s)
    return position + turned(node.lever_arm_m, *tilt_at(truths[node.vehicle], time_s), yaw)


def heard_range_m(
    beacon: Beacon, microphone: Microphone, truths: Mapping[str, Truth], time_s: Floats, sound_speed_mps: float
) -> Floats:
    """Return ``|p_microphone(t) − p_beacon(t − range / c)|`` (n,): the way that the sound heard at t has gone.

    The equation contracts by the beacon's speed over that of sound, so a few rounds of insertion solve it.
    """
    ear = node_position_m(microphone, truths, time_s)
    way = np.zeros(len(time_s))
    for _ in range(_WAY_ITERATIONS):
        before, way = way, np.linalg.norm(ear - node_position_m(beacon, truths, time_s - way / sound_speed_mps), axis=1)
        if not len(way) or np.max(np.abs(way - before)) < 1e-12:
            break
    return way
