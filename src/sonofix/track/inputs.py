"""What a vehicle's own sensors tell of its motion, in order of time, and the states that correct them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE, open_arms, tilting
from sonofix.records import Floats, Table
from sonofix.site import Site
from sonofix.track import stated as others
from sonofix.track.gyro import summed
from sonofix.track.wheels import LONGEST_S, STANDING_MPS, UNSEEN_RAD

STEP_STATES = ("anchor_x", "anchor_y", "length", "heading")
"""What a walker adds to the state: where the step before ended, and by what share of itself a step's length is told too
long, by what angle its heading too far left."""

WHEEL_STATES = ("anchor_x", "anchor_y", "anchor_yaw", "scale", "bias")
"""What odometry adds: the pose at its row before, by what share of itself its speed is told too high, and its yaw rate
at rest."""

GYRO_STATES = ("anchor_yaw", "gyro_bias")
"""What a gyro adds: the heading where its row before ended, and the rate that it tells at rest."""

STEP, WHEELS, COMPASS, GYRO = range(4)


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """Rows of the recording's sensor tables, of all vehicles, in order of time.

    Attributes
    ----------
    time_s : float64 (k,)
        When each row is known: a step at its end, a row of odometry when the next one comes.
    kind, vehicle : int (k,)
        `STEP`, `WHEELS`, `COMPASS` or `GYRO`; index of the vehicle it speaks of.
    value : float64 (k, 6)
        Length and heading of a step; way, turn and time of an arc by odometry, what may have been turned unseen at its
        end, and speed and yaw rate that hold from there on; heading of a compass; turn by a gyro and its time. NaN
        where unknown.
    step_slot, wheel_slot : int (V,)
        Where each vehicle's `STEP_STATES` and `WHEEL_STATES` stand in a belief; −1: it has none.
    gyro_slot : int (V,)
        The same of `GYRO_STATES`.
    headed : bool (V,)
        Vehicles whose heading something tells.
    arm : float64 (V, 2)
        `geometry.open_arms`.
    range_slot : int
        Where the errors of ranges that others state stand (`track.stated`); −1: ranges are our own.
    bias_slot : int
        Where open biases of our own ranges stand (`track.paired`); −1: there are none.
    size : int
        How many states are added in all.
    pairs : mapping from (emitter, receiver) to int
        Number of each pair whose ranges others state, or whose bias in our own is open.
    known_sd_m : float64 (P,)
        How well the site file states each of these pairs' bias; NaN where it does not.
    """

    time_s: Floats
    kind: NDArray[np.int64]
    vehicle: NDArray[np.int64]
    value: Floats
    step_slot: NDArray[np.int64]
    wheel_slot: NDArray[np.int64]
    gyro_slot: NDArray[np.int64]
    headed: NDArray[np.bool_]
    arm: Floats
    range_slot: int
    bias_slot: int
    size: int
    pairs: Mapping[tuple[str, str], int]
    known_sd_m: Floats

    def within(self, after_s: float, until_s: float) -> range:
        """Rows told after one instant and until another; none where the second is before the first."""
        first, last = np.searchsorted(self.time_s, [after_s, until_s], side="right")
        return range(int(first), int(last))

    def lone_wheels(self, vehicle: int) -> bool:
        """Whether nothing but a vehicle's odometry tells of its turns."""
        return bool(self.gyro_slot[vehicle] < 0)

    def holds(self, vehicle: int, time_s: float) -> int | None:
        """Number of the row of odometry that tells how a vehicle moves at an instant; None: there is none."""
        own = (self.kind == WHEELS) & (self.vehicle == vehicle) & (self.time_s <= time_s)
        rows = np.flatnonzero(own & (self.time_s > time_s - LONGEST_S))
        return int(rows[-1]) if len(rows) else None


def reckoned(inputs: Inputs, vehicle: int, until_s: float) -> Floats:
    """Poses (n, 4) that odometry alone gives, from (0, 0, 0) on: time, x, y and heading at each of its rows so far."""
    rows = np.flatnonzero((inputs.kind == WHEELS) & (inputs.vehicle == vehicle) & (inputs.time_s <= until_s))
    way, turn = np.nan_to_num(inputs.value[rows, 0]), np.nan_to_num(inputs.value[rows, 1])
    yaw = np.cumsum(turn)
    middle = yaw - turn / 2
    x, y = np.cumsum(way * np.cos(middle)), np.cumsum(way * np.sin(middle))
    return np.column_stack([inputs.time_s[rows], x, y, yaw])


def gather(site: Site, tables: Mapping[str, Table], stated: Iterable[tuple[str, str]] | None = None) -> Inputs | None:
    """Bring the tables that the track uses (`steps`, `odometry`, `compass`, `imu`) into one order.

    A row with an empty cell tells nothing but its time. ``stated``: the pairs (emitter, receiver) whose ranges come
    from others, with errors of their own; None where ranges are our own. Return None where there is neither, nor a pair
    of the site whose bias is open.
    """
    known = {(p.emitter, p.receiver): p.bias_sd_m for p in site.pairs}
    asked = dict.fromkeys(stated if stated is not None else (pair for pair, sd_m in known.items() if sd_m))
    pairs = {pair: i for i, pair in enumerate(asked)}
    known_sd_m = np.array([known.get(pair, np.nan) for pair in pairs], float)
    ids, tilts = [v.id for v in site.vehicles], tilting(site) > 0
    parts: list[tuple[Floats, NDArray[np.int64], NDArray[np.int64], Floats]] = []
    for kind, stem in ((STEP, "steps"), (WHEELS, "odometry"), (COMPASS, "compass"), (GYRO, "imu")):
        table = tables.get(stem)
        if table is None or not ids or not len(table.columns["time_s"]):
            continue
        n = len(table.columns["time_s"])
        whose = table.names.get("vehicle") or (ids[0],) * n
        for i, name in enumerate(ids):
            rows = np.array([w == name for w in whose])
            own = {column: values[rows] for column, values in table.columns.items()}
            # of a body that tilts the upward axis does not tell its heading's turns alone
            if rows.any() and not (kind == GYRO and tilts[i]):
                times_s, values = _values(kind, own)
                parts.append((times_s, np.full(len(times_s), kind), np.full(len(times_s), i), values))
    if not parts:
        if stated is None and not pairs:
            return None
        none = np.zeros(0, np.int64)
        parts.append((np.zeros(0), none, none, np.zeros((0, 6))))
    time_s, kinds, vehicle, value = (np.concatenate(p) for p in zip(*parts, strict=True))
    order = np.argsort(time_s, kind="stable")
    # only a compass tells what odometry did not see, if no gyro saw it; without one the doubt would stay
    asking = np.setdiff1d(vehicle[kinds == COMPASS], vehicle[kinds == GYRO])
    unaware = (kinds == WHEELS) & ~np.isin(vehicle, asking)
    value[unaware, 3] = 0.0
    size, slots = 0, np.full((GYRO + 1, len(ids)), -1, np.int64)
    for kind, states in ((STEP, STEP_STATES), (WHEELS, WHEEL_STATES), (GYRO, GYRO_STATES)):
        for i in np.unique(vehicle[kinds == kind]).tolist():
            slots[kind, i] = SIZE * len(ids) + size
            size += len(states)
    range_slot, bias_slot = -1, -1
    if stated is not None:
        range_slot = SIZE * len(ids) + size
        size += others.size(len(pairs))
    elif pairs:
        bias_slot = SIZE * len(ids) + size
        size += len(pairs)
    headed = np.array([bool(np.any((vehicle == i) & np.isin(kinds, (WHEELS, COMPASS)))) for i in range(len(ids))])
    return Inputs(
        time_s[order],
        kinds[order],
        vehicle[order],
        value[order],
        slots[STEP],
        slots[WHEELS],
        slots[GYRO],
        headed,
        open_arms(site),
        range_slot,
        bias_slot,
        size,
        pairs,
        known_sd_m,
    )


def _values(kind: int, own: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """Times (k,) and rows (k, 6) of one vehicle as `Inputs` has them."""
    time_s = own["time_s"]
    if kind == GYRO:
        time_s, turn, dt = summed(time_s, own["gz_radps"])
        return time_s, np.column_stack([turn, dt, np.full((len(time_s), 4), np.nan)])
    out = np.full((len(time_s), 6), np.nan)
    if kind == STEP:
        out[:, 0], out[:, 1] = own["length_m"], own["heading_rad"]
    elif kind == COMPASS:
        out[:, 0] = own["heading_rad"]
    else:
        # each row holds until the next, where it becomes known what was driven
        dt = np.diff(time_s)
        out[1:, 0], out[1:, 1], out[1:, 2] = own["v_mps"][:-1] * dt, own["yaw_rate_radps"][:-1] * dt, dt
        slow = np.abs(own["v_mps"]) < STANDING_MPS
        out[1:, 3] = np.where(slow[:-1] & ~slow[1:], UNSEEN_RAD, 0.0)
        out[0, 3] = 0.0
        out[:-1, 4], out[:-1, 5] = own["v_mps"][:-1], own["yaw_rate_radps"][:-1]
    return time_s, out
