"""Range and range-rate models with their Jacobians, for any mix of fixed and mounted emitters and receivers.

A row says that ``receiver`` heard at t what ``emitter`` sent at t − r/c: r = |p_receiver(t) − p_emitter(t − r/c)|.
Vehicles move straight and turn evenly about a reference instant; a node's place is origin + R lever arm, with
R = Rz(yaw) Ry(pitch) Rx(roll) as in `attitude`. One that stands upright has neither roll nor pitch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import hypot

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.site import Beacon, Microphone, Site, Vehicle

POSE = ("x", "y", "z", "yaw", "vx", "vy", "vz", "yaw_rate", "roll", "pitch", "roll_rate", "pitch_rate")
"""Components of one vehicle's motion state, in m, rad, m/s and rad/s; rates are those of the three angles."""

SIZE = len(POSE)
YAW, YAW_RATE, ROLL, PITCH, ROLL_RATE, PITCH_RATE = 3, 7, 8, 9, 10, 11
"""Where they stand in it."""

CLOCK = SIZE
ALONE = SIZE + 2
"""Where the clock's offset stands in the state of one vehicle, and how many components that has with its drift."""

TILT_SD_RAD = 0.15
"""How far a body tilts whose site file does not say, one sigma of roll and of pitch: 9°, as things that fly, float or
hang do; now and then twice and thrice that."""

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

    @property
    def ends(self) -> tuple[NDArray[np.int64], Floats, NDArray[np.int64], Floats]:
        """What the kernels take."""
        return self.emitter_vehicle, self.emitter_point, self.receiver_vehicle, self.receiver_point

    def touch(self, vehicle: int) -> NDArray[np.bool_]:
        """Return which rows have an end on a vehicle (n,)."""
        return (self.emitter_vehicle == vehicle) | (self.receiver_vehicle == vehicle)

    def rows(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Links:
        """Return some of the rows."""
        return Links(
            self.emitter_vehicle[keep],
            self.emitter_point[keep],
            self.receiver_vehicle[keep],
            self.receiver_point[keep],
            self.emitter_sd_m[keep],
        )


class _Same:
    """A site as a key, by identity: comparing all that it holds would take longer than looking it up anew."""

    __slots__ = ("site",)

    def __init__(self, site: Site) -> None:
        self.site = site

    def __hash__(self) -> int:
        return id(self.site)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.site is self.site


@dataclass(frozen=True, slots=True, eq=False)
class _Ends:
    """All beacons or all microphones of a site: where in the arrays each id stands, what carries it, and its place."""

    index: dict[str, int]
    vehicle: NDArray[np.int64]
    point: Floats
    sd_m: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Roster:
    """What rows are looked up in, gathered once a site (a site never changes)."""

    emitters: _Ends
    receivers: _Ends
    arms: Floats
    turns: NDArray[np.bool_]
    tilt_sd_rad: Floats


@lru_cache(maxsize=8)
def _roster(key: _Same) -> _Roster:
    site = key.site
    nodes = (*site.beacons, *site.microphones)
    vehicles = {v.id: i for i, v in enumerate(site.vehicles)}
    arms, turns = np.zeros((len(vehicles), 2)), np.zeros(len(vehicles), bool)
    for vehicle, i in vehicles.items():
        flat = np.array([n.lever_arm_m[:2] for n in nodes if n.vehicle == vehicle]).reshape(-1, 2)
        turns[i] = len(flat) > 0 and bool(np.any(np.hypot(*(flat - flat[0]).T) >= SAME_ARM_M))
        if len(flat) and not turns[i]:
            arms[i] = flat[0]
    tilt_sd_rad = np.array([_tilt_sd_rad(v, nodes) for v in site.vehicles], float)
    arms.flags.writeable = turns.flags.writeable = tilt_sd_rad.flags.writeable = False
    left_out = np.vstack([np.column_stack([arms, np.zeros(len(arms))]), np.zeros((1, 3))])

    def ends(some: tuple[Beacon, ...] | tuple[Microphone, ...]) -> _Ends:
        carrier = np.array([-1 if n.vehicle is None else vehicles[n.vehicle] for n in some], np.int64)
        point = np.array([n.position_m or n.lever_arm_m for n in some], float).reshape(-1, 3)
        sd_m = np.array([n.position_sd_m if isinstance(n, Beacon) else 0.0 for n in some], float)
        return _Ends({n.id: i for i, n in enumerate(some)}, carrier, point - left_out[carrier], sd_m)

    return _Roster(ends(site.beacons), ends(site.microphones), arms, turns, tilt_sd_rad)


def _tilt_sd_rad(vehicle: Vehicle, nodes: tuple[Beacon | Microphone, ...]) -> float:
    """Deviation of roll and pitch as the site has it, else as what stands on a floor, or does not, has it."""
    if vehicle.tilt_sd_rad is not None:
        return vehicle.tilt_sd_rad
    arms = np.array([n.lever_arm_m for n in nodes if n.vehicle == vehicle.id]).reshape(-1, 3)
    if vehicle.z_m is not None or len(arms) < 3:
        return 0.0
    return TILT_SD_RAD if np.linalg.svd(arms - arms.mean(axis=0), compute_uv=False)[1] >= SAME_ARM_M else 0.0


def open_arms(site: Site) -> Floats:
    """Horizontal lever arms (V, 2) that no heading places: of vehicles whose ends all sit on one vertical line.

    Nothing tells such a vehicle's heading, so its motion is followed at that line (`link` gives its ends so), and
    `from_arm` goes back to its origin.
    """
    return _roster(_Same(site)).arms


def turning(site: Site) -> NDArray[np.bool_]:
    """Whether each vehicle's ends tell its heading (V,): they sit on more than one vertical line."""
    return _roster(_Same(site)).turns


def tilting(site: Site) -> Floats:
    """Deviation (V,) of each vehicle's roll and pitch before anything is heard; 0: it stands upright.

    Where the site file does not say, a vehicle on a known level stands upright, and so does one whose ends are on one
    line, which tell of no attitude; others tilt by `TILT_SD_RAD`.
    """
    return _roster(_Same(site)).tilt_sd_rad


def from_arm(arm: Floats, velocity: Floats) -> tuple[Floats, float]:
    """Where the origin is from a point on a horizontal arm of open heading, and with what deviation per axis.

    A vehicle that drives is taken to look where it goes, within 0.1 rad; one that stands may look anywhere.
    """
    length, speed = hypot(arm[0], arm[1]), hypot(velocity[0], velocity[1])
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
    roster = _roster(_Same(site))
    sending, hearing = roster.emitters, roster.receivers
    try:
        sent = [sending.index[e] for e in emitters]
        heard = [hearing.index[r] for r in receivers]
    except KeyError:
        for e in emitters:
            site.beacon(e)
        for r in receivers:
            site.microphone(r)
        raise
    e, r = np.array(sent, np.int64), np.array(heard, np.int64)
    return Links(sending.vehicle[e], sending.point[e], hearing.vehicle[r], hearing.point[r], sending.sd_m[e])


@numba.njit(cache=True, error_model="numpy")
def _place(vehicle, point, state, dt, tilts, out):
    """Place, velocity, and their derivatives by yaw, roll and pitch of one end of a row: ``out`` (8, 3).

    Rows 2 to 4 are those of the place, and of the velocity by the angles' rates; 5 to 7 those of the velocity. Those
    by roll and pitch are left alone unless it ``tilts``.
    """
    for axis in range(3):
        out[0, axis] = point[axis]
        out[1, axis] = out[2, axis] = out[5, axis] = 0.0
    if tilts:
        out[3:5] = 0.0
        out[6:8] = 0.0
    if vehicle < 0:
        return
    at = SIZE * vehicle
    for axis in range(3):
        out[0, axis] = state[at + axis] + state[at + 4 + axis] * dt
        out[1, axis] = state[at + 4 + axis]
    forward, left, up = point[0], point[1], point[2]
    if forward == 0.0 and left == 0.0 and (up == 0.0 or not tilts):
        out[0, 2] += up
        return
    if not tilts:
        yaw_rate = state[at + YAW_RATE]
        yaw = state[at + YAW] + yaw_rate * dt
        cos, sin = np.cos(yaw), np.sin(yaw)
        east, north = cos * forward - sin * left, sin * forward + cos * left
        out[0, 0] += east
        out[0, 1] += north
        out[0, 2] += up
        out[2, 0], out[2, 1] = -north, east
        out[1, 0] -= yaw_rate * north
        out[1, 1] += yaw_rate * east
        out[5, 0], out[5, 1] = -yaw_rate * east, -yaw_rate * north
        return
    yaw_rate, roll_rate, pitch_rate = state[at + YAW_RATE], state[at + ROLL_RATE], state[at + PITCH_RATE]
    yaw = state[at + YAW] + yaw_rate * dt
    cos, sin = np.cos(yaw), np.sin(yaw)
    roll, pitch = state[at + ROLL] + roll_rate * dt, state[at + PITCH] + pitch_rate * dt
    cos_pitch, sin_pitch = 1.0, 0.0
    if roll != 0.0:
        cos_roll, sin_roll = np.cos(roll), np.sin(roll)
        left, up = cos_roll * left - sin_roll * up, sin_roll * left + cos_roll * up
    # before the yaw: the arm, and what roll and pitch move of it
    roll_x, roll_y, roll_z = 0.0, -up, left
    if pitch != 0.0:
        cos_pitch, sin_pitch = np.cos(pitch), np.sin(pitch)
        roll_x, roll_z = sin_pitch * left, cos_pitch * left
        forward, up = cos_pitch * forward + sin_pitch * up, cos_pitch * up - sin_pitch * forward
    east, north = cos * forward - sin * left, sin * forward + cos * left
    out[0, 0] += east
    out[0, 1] += north
    out[0, 2] += up
    out[2, 0], out[2, 1] = -north, east
    out[3, 0], out[3, 1], out[3, 2] = cos * roll_x - sin * roll_y, sin * roll_x + cos * roll_y, roll_z
    out[4, 0], out[4, 1], out[4, 2] = cos * up, sin * up, -forward
    if yaw_rate == 0.0 and roll_rate == 0.0 and pitch_rate == 0.0:
        return
    for axis in range(3):
        out[5, axis] = yaw_rate * out[2, axis] + roll_rate * out[3, axis] + pitch_rate * out[4, axis]
        out[1, axis] += out[5, axis]
    out[5, 0], out[5, 1], out[5, 2] = -out[5, 1], out[5, 0], 0.0
    # second derivatives: an angle's axis times what an angle whose axis it turns has moved
    for row in (3, 4):
        out[row + 3, 0] -= yaw_rate * out[row, 1]
        out[row + 3, 1] += yaw_rate * out[row, 0]
    if roll_rate != 0.0 or pitch_rate != 0.0:
        _turn(pitch_rate, -sin, cos, 0.0, out[3], out[6])
        _turn(roll_rate, cos_pitch * cos, cos_pitch * sin, -sin_pitch, out[3], out[6])
        _turn(pitch_rate, -sin, cos, 0.0, out[4], out[7])
        _turn(roll_rate, -sin, cos, 0.0, out[3], out[7])


@numba.njit(cache=True, error_model="numpy", inline="always")
def _turn(rate, x, y, z, arm, out):
    """Add to ``out`` (3,) what a turn about an axis moves of ``arm`` (3,)."""
    out[0] += rate * (y * arm[2] - z * arm[1])
    out[1] += rate * (z * arm[0] - x * arm[2])
    out[2] += rate * (x * arm[1] - y * arm[0])


@numba.njit(cache=True, error_model="numpy")
def expected(ends, state, dt, c, clock, tilts, value, derivative):
    """What rows would show at a state, and its derivative: the kernel that `model`, fixes and tracks share.

    Kernels that call this keep a copy of it in their own cache, which does not notice a change here.

    Parameters
    ----------
    ends : tuple
        ``emitter_vehicle, emitter_point, receiver_vehicle, receiver_point`` of `Links`, n rows.
    state : float64 (SIZE V + 2,)
        Each vehicle's ``POSE``, then the offset (m) and drift (m/s) of the clock that ranges share, if ``clock``.
    dt : float64 (n,)
        When each row was heard, from the instant the state belongs to.
    c : float
        Sound speed.
    tilts : bool
        Whether roll and pitch count; else vehicles stand upright, and derivatives by these are 0.
    value : float64 (m,), out
        Ranges and then, where it is m = 2 n long, range rates.
    derivative : float64 (m, SIZE V + 2), out
    """
    emitter_vehicle, emitter_point, receiver_vehicle, receiver_point = ends
    here, there = np.empty((8, 3)), np.empty((8, 3))
    unit, across = np.empty(3), np.empty(3)
    n, last = len(dt), len(state) - 1
    rates = len(value) > n
    derivative[:] = 0.0
    for i in range(n):
        _place(receiver_vehicle[i], receiver_point[i], state, dt[i], tilts, here)
        sent = dt[i]
        distance = 0.0
        for _ in range(4):  # contracts by v/c each time: 1e-9 of the range at 3 m/s
            _place(emitter_vehicle[i], emitter_point[i], state, sent, tilts, there)
            distance = 0.0
            for axis in range(3):
                distance += (here[0, axis] - there[0, axis]) ** 2
            distance = np.sqrt(distance)
            sent = dt[i] - distance / c
            if emitter_vehicle[i] < 0:
                break
        distance = max(distance, 1e-6)
        closing = 0.0
        drag = 0.0
        for axis in range(3):
            unit[axis] = (here[0, axis] - there[0, axis]) / distance
            closing += unit[axis] * (here[1, axis] - there[1, axis])
            drag += unit[axis] * there[1, axis]
        # how the range answers to its own delay: a moving emitter was elsewhere when it sent
        lag = 1.0 / (1.0 - drag / c)
        value[i] = distance
        if clock:
            value[i] += state[last - 1]
            derivative[i, last - 1] = 1.0
        if rates:
            value[n + i] = lag * closing
            if clock:
                # the drift's own part in the ranges of one epoch is far below any range's deviation
                value[n + i] += state[last]
                derivative[n + i, last] = 1.0
        for axis in range(3):
            across[axis] = (here[1, axis] - there[1, axis] - closing * unit[axis]) / distance
        for end in range(2):
            vehicle = receiver_vehicle[i] if end == 0 else emitter_vehicle[i]
            if vehicle < 0:
                continue
            at = SIZE * vehicle
            k = lag if end == 0 else -lag
            when = dt[i] if end == 0 else sent
            turned = here if end == 0 else there
            for axis in range(3):
                derivative[i, at + axis] += k * unit[axis]
                derivative[i, at + 4 + axis] += k * when * unit[axis]
                if rates:
                    derivative[n + i, at + axis] += k * across[axis]
                    derivative[n + i, at + 4 + axis] += k * (unit[axis] + when * across[axis])
            for angle in range(3 if tilts else 1):
                by, by_rate = at + YAW, at + YAW_RATE
                if angle > 0:
                    by, by_rate = at + ROLL + angle - 1, at + ROLL_RATE + angle - 1
                turn = 0.0
                rate_turn = 0.0
                for axis in range(3):
                    turn += unit[axis] * turned[2 + angle, axis]
                    rate_turn += across[axis] * turned[2 + angle, axis] + unit[axis] * turned[5 + angle, axis]
                derivative[i, by] += k * turn
                derivative[i, by_rate] += k * when * turn
                if rates:
                    derivative[n + i, by] += k * rate_turn
                    derivative[n + i, by_rate] += k * (turn + when * rate_turn)


def rows_at(
    links: Links, state: Floats, dt: Floats, sound_speed_mps: float, clock: bool, rates: bool, tilts: bool = True
) -> tuple[Floats, Floats]:
    """Run `expected` into new arrays: what rows would show (m,) and its derivative (m, SIZE V + 2)."""
    m = len(dt) * (2 if rates else 1)
    value, derivative = np.empty(m), np.empty((m, len(state)))
    expected(links.ends, state, dt, float(sound_speed_mps), clock, tilts, value, derivative)
    return value, derivative


def model(links: Links, pose: Floats, dt: Floats, sound_speed_mps: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Ranges and range rates that rows would show, and their derivatives.

    Parameters
    ----------
    links : Links, n rows
    pose : float64 (vehicles, SIZE)
        Each vehicle's ``POSE`` at the reference instant.
    dt : float64 (n,)
        When each row was heard, from the reference instant.

    Returns
    -------
    range_m, rate_mps : float64 (n,)
    by_range, by_rate : float64 (n, vehicles, SIZE)
        Derivatives by ``pose``.

    Raises
    ------
    ValueError
        If a pose does not have the components of ``POSE``.
    """
    if np.shape(pose)[1:] != (SIZE,):
        raise ValueError(f"pose has shape {np.shape(pose)}; give a row of {SIZE} components, POSE, a vehicle")
    n, shape = len(links), (len(links), len(pose), SIZE)
    value, derivative = rows_at(links, np.append(pose, np.zeros(2)), dt, sound_speed_mps, False, True)
    return value[:n], value[n:], derivative[:n, :-2].reshape(shape), derivative[n:, :-2].reshape(shape)


def row_times(links: Links, time_s: Floats, range_m: Floats, sound_speed_mps: float) -> Floats:
    """Return when each row speaks of its vehicle: when heard, or when sent where only the emitter moves."""
    sounding = (links.emitter_vehicle >= 0) & (links.receiver_vehicle < 0)
    return time_s - np.where(sounding, range_m / sound_speed_mps, 0.0)
