"""Where emitters and microphones are: fixed, or carried by a vehicle; and where their mirror images are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sonofix.attitude import spin, turned
from sonofix.channel.motion import Motion
from sonofix.channel.propagate import KNOT_S, PoseTable
from sonofix.records import Floats, Truth
from sonofix.site import Beacon, Microphone, Site

TRUTH_HZ = 200.0
SURVEY_HZ = 20.0
"""How often a run is looked at before it is simulated: for levels, and whether all stays inside the room."""


def position_at(node: Beacon | Microphone, motions: Mapping[str, Motion], time_s: Floats) -> Floats:
    """Position of a beacon or microphone at ``time_s`` (n,), east-north-up, (n, 3)."""
    if node.position_m is not None:
        return np.tile(np.asarray(node.position_m, float), (len(time_s), 1))
    poses = motions[str(node.vehicle)].at(time_s)
    return poses.position_m + turned(node.lever_arm_m, poses.roll_rad, poses.pitch_rad, poses.yaw_rad)


def pose_table(
    node: Beacon | Microphone, motions: Mapping[str, Motion], from_s: float, to_s: float, sound_speed_mps: float
) -> PoseTable:
    """Tabulate a node's way from ``from_s`` to ``to_s``, with two knots to spare at both ends.

    Raises
    ------
    ValueError
        If the node moves faster than a third of the speed of sound (delays are bounded with that in mind).
    """
    first = int(np.floor(from_s / KNOT_S)) - 2
    if node.position_m is not None:
        # two knots do: beyond its ends a table is held
        return PoseTable(first, np.tile(np.asarray(node.position_m, float), (2, 1)), np.zeros((2, 3)))
    time_s = np.arange(first, int(np.ceil(to_s / KNOT_S)) + 3).astype(np.float64) * KNOT_S
    poses = motions[str(node.vehicle)].at(time_s)
    position, velocity = poses.position_m, poses.velocity_mps
    if any(node.lever_arm_m):
        arm = turned(node.lever_arm_m, poses.roll_rad, poses.pitch_rad, poses.yaw_rad)
        roll, pitch, yaw = (
            np.zeros(len(time_s)) if angle is None else np.gradient(angle, KNOT_S)
            for angle in (poses.roll_rad, poses.pitch_rad, poses.yaw_rad)
        )
        position = position + arm
        velocity = velocity + np.cross(spin(poses.pitch_rad, poses.yaw_rad, (roll, pitch, yaw)), arm)
    speed = float(np.linalg.norm(np.diff(position, axis=0), axis=1).max()) / KNOT_S
    if speed > sound_speed_mps / 3:
        raise ValueError(
            f"vehicle {node.vehicle} moves at {speed:.0f} m/s between {time_s[0]:.2f} and {time_s[-1]:.2f} s; "
            f"the simulation holds up to a third of the speed of sound, {sound_speed_mps / 3:.0f} m/s"
        )
    return PoseTable(first, np.ascontiguousarray(position), np.ascontiguousarray(velocity))


def mirrored(table: PoseTable, axis: int, wall_m: float) -> PoseTable:
    """Table of the emitter's image behind the wall where coordinate ``axis`` equals ``wall_m``."""
    position, velocity = table.position_m.copy(), table.velocity_mps.copy()
    position[:, axis] = 2 * wall_m - position[:, axis]
    velocity[:, axis] *= -1
    return PoseTable(table.first_knot, position, velocity)


def truth_of(vehicle: str, motion: Motion, duration_s: float) -> Truth:
    """Poses of a vehicle's origin 200 times a second, from 0 to before ``duration_s``."""
    time_s = np.arange(max(int(np.ceil(duration_s * TRUTH_HZ - 1e-9)), 1)) / TRUTH_HZ
    poses = motion.at(time_s)
    return Truth(vehicle, time_s, poses.position_m, poses.yaw_rad, poses.roll_rad, poses.pitch_rad)


def survey_times(duration_s: float) -> Floats:
    """Instants at which a run is looked over before it is simulated."""
    return np.arange(int(duration_s * SURVEY_HZ) + 1) / SURVEY_HZ


def check_inside(site: Site, motions: Mapping[str, Motion], duration_s: float) -> None:
    """Check that every beacon and microphone stays inside the room: a wall reflects only what is before it.

    Raises
    ------
    ValueError
        If the site has no bounds, or naming what leaves them, where and when.
    """
    if site.bounds_m is None:
        raise ValueError("site.bounds_m is missing: echoes need the room's two corners; add it or set echo to 0")
    low, high = np.asarray(site.bounds_m, float)
    for kind, nodes in (("beacon", site.beacons), ("microphone", site.microphones)):
        for node in nodes:
            time_s = np.zeros(1) if node.vehicle is None else survey_times(duration_s)
            position = position_at(node, motions, time_s)
            outside = np.flatnonzero(((position < low) | (position > high)).any(axis=1))
            if outside.size:
                where = ", ".join(f"{value:.2f}" for value in position[outside[0]])
                raise ValueError(
                    f"{kind} {node.id} is at ({where}) m at {time_s[outside[0]]:.2f} s, outside site.bounds_m "
                    f"{low.tolist()} to {high.tolist()}; echoes need everything inside: widen the bounds or move it"
                )
