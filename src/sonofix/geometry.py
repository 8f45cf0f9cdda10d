"""Range and range-rate models with their Jacobians, for any mix of fixed and mounted emitters and receivers.

A row says that ``receiver`` heard at t what ``emitter`` sent at t − r/c: r = |p_receiver(t) − p_emitter(t − r/c)|.
Vehicles move straight and turn evenly about a reference instant; a node's place is origin + R(yaw) lever arm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.site import Beacon, Microphone, Site

POSE = ("x", "y", "z", "yaw", "vx", "vy", "vz", "yaw_rate")
"""Components of one vehicle's motion state, in m, rad, m/s and rad/s."""


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Where the ends of each row sit.

    Attributes
    ----------
    emitter_vehicle, receiver_vehicle : int (n,)
        Index of the vehicle that carries the end; −1: fixed.
    emitter_point, receiver_point : float64 (n, 3)
        Position of a fixed end, lever arm (body frame) of a mounted one.
    emitter_sd_m : float64 (n,)
        Deviation of a fixed emitter's stated place, per axis.
    """

    emitter_vehicle: NDArray[np.int64]
    emitter_point: Floats
    receiver_vehicle: NDArray[np.int64]
    receiver_point: Floats
    emitter_sd_m: Floats

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.emitter_vehicle)

    def rows(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Links:
        """Return some of the rows."""
        return Links(
            self.emitter_vehicle[keep],
            self.emitter_point[keep],
            self.receiver_vehicle[keep],
            self.receiver_point[keep],
            self.emitter_sd_m[keep],
        )


def link(site: Site, emitters: tuple[str, ...], receivers: tuple[str, ...]) -> Links:
    """Look up the ends of rows in a site.

    Raises
    ------
    KeyError
        If an id is not in the site.
    """
    vehicles = {v.id: i for i, v in enumerate(site.vehicles)}

    def ends(nodes: list[Beacon] | list[Microphone]) -> tuple[NDArray[np.int64], Floats]:
        carrier = np.array([-1 if n.vehicle is None else vehicles[n.vehicle] for n in nodes], np.int64)
        point = np.array([n.position_m or n.lever_arm_m for n in nodes], float).reshape(-1, 3)
        return carrier, point

    beacons = [site.beacon(e) for e in emitters]
    emitter_vehicle, emitter_point = ends(beacons)
    receiver_vehicle, receiver_point = ends([site.microphone(r) for r in receivers])
    sd = np.array([b.position_sd_m for b in beacons], float)
    return Links(emitter_vehicle, emitter_point, receiver_vehicle, receiver_point, sd)


def _places(
    vehicle: NDArray[np.int64], point: Floats, pose: Floats, dt: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Place, velocity, and their derivatives by yaw, of one end of each row at ``dt`` from the reference instant."""
    state = np.where((vehicle >= 0)[:, None], pose[vehicle], 0.0)
    yaw = state[:, 3] + state[:, 7] * dt
    cos, sin = np.cos(yaw), np.sin(yaw)
    mounted = (vehicle >= 0).astype(float)
    x, y, z = point.T
    arm = np.column_stack([cos * x - sin * y, sin * x + cos * y, z]) * mounted[:, None]
    by_yaw = np.column_stack([-arm[:, 1], arm[:, 0], np.zeros(len(x))])
    place = np.where(mounted[:, None] > 0, state[:, :3] + state[:, 4:7] * dt[:, None] + arm, point)
    velocity = state[:, 4:7] + state[:, 7:8] * by_yaw
    velocity_by_yaw = -state[:, 7:8] * np.column_stack([arm[:, 0], arm[:, 1], np.zeros(len(x))])
    return place, velocity, by_yaw, velocity_by_yaw


def model(links: Links, pose: Floats, dt: Floats, sound_speed_mps: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Ranges and range rates that rows would show, and their derivatives.

    Parameters
    ----------
    links : Links, n rows
    pose : float64 (vehicles, 8)
        Each vehicle's ``POSE`` at the reference instant.
    dt : float64 (n,)
        When each row was heard, from the reference instant.

    Returns
    -------
    range_m, rate_mps : float64 (n,)
    by_range, by_rate : float64 (n, vehicles, 8)
        Derivatives by ``pose``.
    """
    receiver, receiver_v, receiver_by_yaw, receiver_v_by_yaw = _places(
        links.receiver_vehicle, links.receiver_point, pose, dt
    )
    sent = dt
    for _ in range(3):  # contracts by v/c each time; from 10 m and 3 m/s: 1e-7 m after three
        emitter = _places(links.emitter_vehicle, links.emitter_point, pose, sent)[0]
        sent = dt - np.sqrt(np.sum((receiver - emitter) ** 2, axis=1)) / sound_speed_mps
    emitter, emitter_v, emitter_by_yaw, emitter_v_by_yaw = _places(
        links.emitter_vehicle, links.emitter_point, pose, sent
    )
    away = receiver - emitter
    range_m = np.sqrt(np.sum(away**2, axis=1))
    safe = np.maximum(range_m, 1e-6)
    unit = away / safe[:, None]
    # how the range answers to its own delay: a moving emitter was elsewhere when it sent
    lag = 1.0 / (1.0 - np.sum(unit * emitter_v, axis=1) / sound_speed_mps)
    relative = receiver_v - emitter_v
    rate = lag * np.sum(unit * relative, axis=1)
    across = (relative - np.sum(unit * relative, axis=1)[:, None] * unit) / safe[:, None]
    by_range = np.zeros((len(links), len(pose), 8))
    by_rate = np.zeros_like(by_range)
    row = np.arange(len(links))
    for vehicle, sign, when, by_yaw, v_by_yaw in (
        (links.receiver_vehicle, 1.0, dt, receiver_by_yaw, receiver_v_by_yaw),
        (links.emitter_vehicle, -1.0, sent, emitter_by_yaw, emitter_v_by_yaw),
    ):
        on = vehicle >= 0
        at, who = row[on], vehicle[on]
        k = (sign * lag)[on]
        u, t, a = unit[on], when[on], across[on]
        turn, v_turn = by_yaw[on], v_by_yaw[on]
        u_turn = np.sum(u * turn, axis=1)
        rate_turn = np.sum(a * turn, axis=1) + np.sum(u * v_turn, axis=1)
        by_range[at, who, :3] += k[:, None] * u
        by_range[at, who, 3] += k * u_turn
        by_range[at, who, 4:7] += (k * t)[:, None] * u
        by_range[at, who, 7] += k * t * u_turn
        by_rate[at, who, :3] += k[:, None] * a
        by_rate[at, who, 3] += k * rate_turn
        by_rate[at, who, 4:7] += k[:, None] * (u + t[:, None] * a)
        by_rate[at, who, 7] += k * (u_turn + t * rate_turn)
    return range_m, rate, by_range, by_rate


def row_times(links: Links, time_s: Floats, range_m: Floats, sound_speed_mps: float) -> Floats:
    """Return when each row speaks of its vehicle: when heard, or when sent where only the emitter moves."""
    sounding = (links.emitter_vehicle >= 0) & (links.receiver_vehicle < 0)
    return time_s - np.where(sounding, range_m / sound_speed_mps, 0.0)
