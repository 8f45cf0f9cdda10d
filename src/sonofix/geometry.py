"""Range and range-rate models with their Jacobians, for any mix of fixed and mounted emitters and receivers.

A row says that ``receiver`` heard at t what ``emitter`` sent at t − r/c: r = |p_receiver(t) − p_emitter(t − r/c)|.
Vehicles move straight and turn evenly about a reference instant; a node's place is origin + R(yaw) lever arm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.site import Beacon, Microphone, Site

POSE = ("x", "y", "z", "yaw", "vx", "vy", "vz", "yaw_rate")
"""Components of one vehicle's motion state, in m, rad, m/s and rad/s."""

SAME_ARM_M = 1e-3
"""Lever arms that differ by less, seen from above, are one."""

DRIVING_MPS = 0.1
"""Above this speed a vehicle is taken to look where it goes."""


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


def open_arms(site: Site) -> Floats:
    """Horizontal lever arms (V, 2) that no heading places: of vehicles whose ends all sit on one vertical line.

    Nothing tells such a vehicle's heading, so its motion is followed at that line (`link` gives its ends so), and
    `from_arm` goes back to its origin.
    """
    arms = np.zeros((len(site.vehicles), 2))
    turns = turning(site)
    for i, vehicle in enumerate(site.vehicles):
        ends = [n.lever_arm_m[:2] for n in (*site.beacons, *site.microphones) if n.vehicle == vehicle.id]
        if ends and not turns[i]:
            arms[i] = ends[0]
    return arms


def turning(site: Site) -> NDArray[np.bool_]:
    """Whether each vehicle's ends tell its heading (V,): they sit on more than one vertical line."""
    out = np.zeros(len(site.vehicles), bool)
    for i, vehicle in enumerate(site.vehicles):
        ends = np.array([n.lever_arm_m[:2] for n in (*site.beacons, *site.microphones) if n.vehicle == vehicle.id])
        out[i] = len(ends) > 0 and bool(np.any(np.hypot(*(ends - ends[0]).T) >= SAME_ARM_M))
    return out


def from_arm(arm: Floats, velocity: Floats) -> tuple[Floats, float]:
    """Where the origin is from a point on a horizontal arm of open heading, and with what deviation per axis.

    A vehicle that drives is taken to look where it goes, within 0.1 rad; one that stands may look anywhere.
    """
    length = float(np.hypot(arm[0], arm[1]))
    speed = float(np.hypot(velocity[0], velocity[1]))
    if speed < DRIVING_MPS or not length:
        return np.zeros(2), length
    along = velocity[:2] / speed
    return -(arm[0] * along + arm[1] * np.array([-along[1], along[0]])), 0.1 * length


def link(site: Site, emitters: tuple[str, ...], receivers: tuple[str, ...]) -> Links:
    """Look up the ends of rows in a site; lever arms are from where a vehicle's motion is followed (`open_arms`).

    Raises
    ------
    KeyError
        If an id is not in the site.
    """
    vehicles = {v.id: i for i, v in enumerate(site.vehicles)}
    arms = np.vstack([np.column_stack([open_arms(site), np.zeros(len(vehicles))]), np.zeros((1, 3))])

    def ends(nodes: list[Beacon] | list[Microphone]) -> tuple[NDArray[np.int64], Floats]:
        carrier = np.array([-1 if n.vehicle is None else vehicles[n.vehicle] for n in nodes], np.int64)
        point = np.array([n.position_m or n.lever_arm_m for n in nodes], float).reshape(-1, 3)
        return carrier, point - arms[carrier]

    beacons = [site.beacon(e) for e in emitters]
    emitter_vehicle, emitter_point = ends(beacons)
    receiver_vehicle, receiver_point = ends([site.microphone(r) for r in receivers])
    sd = np.array([b.position_sd_m for b in beacons], float)
    return Links(emitter_vehicle, emitter_point, receiver_vehicle, receiver_point, sd)


@numba.njit(cache=True)
def _place(vehicle, point, pose, at, dt, out):
    """Place, velocity and their derivatives by yaw of one end of a row: rows 0 to 3 of ``out`` (4, 3)."""
    out[:] = 0.0
    if vehicle < 0:
        out[0] = point
        return
    yaw_rate = pose[at, 7]
    yaw = pose[at, 3] + yaw_rate * dt
    cos, sin = np.cos(yaw), np.sin(yaw)
    east = cos * point[0] - sin * point[1]
    north = sin * point[0] + cos * point[1]
    for axis in range(3):
        out[0, axis] = pose[at, axis] + pose[at, 4 + axis] * dt
        out[1, axis] = pose[at, 4 + axis]
    out[0, 0] += east
    out[0, 1] += north
    out[0, 2] += point[2]
    out[2, 0], out[2, 1] = -north, east
    out[1, 0] -= yaw_rate * north
    out[1, 1] += yaw_rate * east
    out[3, 0], out[3, 1] = -yaw_rate * east, -yaw_rate * north


@numba.njit(cache=True)
def _fill(
    emitter_vehicle, emitter_point, receiver_vehicle, receiver_point, pose, dt, c, range_m, rate, by_range, by_rate
):
    """Fill what `model` returns, row by row."""
    here, there = np.empty((4, 3)), np.empty((4, 3))
    unit, across = np.empty(3), np.empty(3)
    for i in range(len(dt)):
        _place(receiver_vehicle[i], receiver_point[i], pose, receiver_vehicle[i], dt[i], here)
        sent = dt[i]
        distance = 0.0
        for _ in range(4):  # contracts by v/c each time: 1e-9 of the range at 3 m/s
            _place(emitter_vehicle[i], emitter_point[i], pose, emitter_vehicle[i], sent, there)
            distance = np.sqrt(np.sum((here[0] - there[0]) ** 2))
            sent = dt[i] - distance / c
        distance = max(distance, 1e-6)
        closing = 0.0
        drag = 0.0
        for axis in range(3):
            unit[axis] = (here[0, axis] - there[0, axis]) / distance
            closing += unit[axis] * (here[1, axis] - there[1, axis])
            drag += unit[axis] * there[1, axis]
        # how the range answers to its own delay: a moving emitter was elsewhere when it sent
        lag = 1.0 / (1.0 - drag / c)
        range_m[i] = distance
        rate[i] = lag * closing
        for axis in range(3):
            across[axis] = (here[1, axis] - there[1, axis] - closing * unit[axis]) / distance
        for end in range(2):
            vehicle = receiver_vehicle[i] if end == 0 else emitter_vehicle[i]
            if vehicle < 0:
                continue
            k = lag if end == 0 else -lag
            when = dt[i] if end == 0 else sent
            turned = here if end == 0 else there
            turn = 0.0
            rate_turn = 0.0
            for axis in range(3):
                turn += unit[axis] * turned[2, axis]
                rate_turn += across[axis] * turned[2, axis] + unit[axis] * turned[3, axis]
                by_range[i, vehicle, axis] += k * unit[axis]
                by_range[i, vehicle, 4 + axis] += k * when * unit[axis]
                by_rate[i, vehicle, axis] += k * across[axis]
                by_rate[i, vehicle, 4 + axis] += k * (unit[axis] + when * across[axis])
            by_range[i, vehicle, 3] += k * turn
            by_range[i, vehicle, 7] += k * when * turn
            by_rate[i, vehicle, 3] += k * rate_turn
            by_rate[i, vehicle, 7] += k * (turn + when * rate_turn)


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
    n = len(links)
    range_m, rate = np.empty(n), np.empty(n)
    by_range, by_rate = np.zeros((n, len(pose), 8)), np.zeros((n, len(pose), 8))
    ends = (links.emitter_vehicle, links.emitter_point, links.receiver_vehicle, links.receiver_point)
    _fill(*ends, np.ascontiguousarray(pose), dt, sound_speed_mps, range_m, rate, by_range, by_rate)
    return range_m, rate, by_range, by_rate


def row_times(links: Links, time_s: Floats, range_m: Floats, sound_speed_mps: float) -> Floats:
    """Return when each row speaks of its vehicle: when heard, or when sent where only the emitter moves."""
    sounding = (links.emitter_vehicle >= 0) & (links.receiver_vehicle < 0)
    return time_s - np.where(sounding, range_m / sound_speed_mps, 0.0)
