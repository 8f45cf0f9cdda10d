"""All rows of a drive side by side: which moving state hears which fixed end, and what that should show.

Beside the vehicles' states, unknown are places of fixed ends, biases, the sound speed and a common clock. A row that
was heard at t speaks of its vehicle at t, or at t − range/c where only the emitter moves, as in `geometry`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import link, row_times, turning
from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site

STATE = 11
"""Components of a vehicle's state: place, velocity and acceleration (3 each), yaw, yaw rate."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Rows of all epochs, sorted by state, and the instants of the states.

    Attributes
    ----------
    state : int64 (n,)
        Index of the moving end's state; −1 where both ends are fixed.
    arm : float64 (n, 3)
        Of the moving end, body frame; the other end's place where both are fixed.
    sends : bool (n,)
        Whether the moving end sends.
    point : int64 (n,)
        Index of the fixed end in ``names``.
    dt : float64 (n,)
        When the row was heard, from its state's instant.
    time_s, range_m, range_sd_m : float64 (n,)
    lasting_sd_m : float64 (n,)
        Of the one error that all rows of a pair share, as the site states it; ``range_sd_m`` does not hold it.
    rate_mps, rate_sd_mps : float64 (n,)
        NaN where there are no range rates.
    emitter, receiver : tuple of str, length n
    epoch : int64 (n,)
        Index of the epoch.
    names : tuple of str
        Fixed ends: beacons, then microphones.
    place_m : float64 (p, 3)
        Of the fixed ends, as the site has it.
    state_time_s : float64 (s,)
        Ascending for each vehicle.
    state_vehicle, state_epoch : int64 (s,)
    level_m : float64 (s,)
        Of the state's vehicle; NaN where it is not known.
    turns : bool (s,)
        Whether the vehicle's ends tell its heading.
    sound_speed_mps : float
        That made the ranges.
    common_clock : bool
    sd_stated : bool
        False where ``range_sd_m`` is an assumption, as nobody stated how good ranges are.
    skipped : int
        Rows between vehicles, which a survey does not take.
    """

    state: NDArray[np.int64]
    arm: Floats
    sends: NDArray[np.bool_]
    point: NDArray[np.int64]
    dt: Floats
    time_s: Floats
    range_m: Floats
    range_sd_m: Floats
    lasting_sd_m: Floats
    rate_mps: Floats
    rate_sd_mps: Floats
    emitter: tuple[str, ...]
    receiver: tuple[str, ...]
    epoch: NDArray[np.int64]
    names: tuple[str, ...]
    place_m: Floats
    state_time_s: Floats
    state_vehicle: NDArray[np.int64]
    state_epoch: NDArray[np.int64]
    level_m: Floats
    turns: NDArray[np.bool_]
    sound_speed_mps: float
    common_clock: bool
    sd_stated: bool
    skipped: int

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.state)


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """Values of all unknowns: states (s, 11), places (p, 3), biases (b,), relative excess of the sound speed, clock.

    ``clock`` (3,): offset (m), drift (m/s) and its change (m/s²) at the recording's time 0.
    """

    states: Floats
    place_m: Floats
    bias_m: Floats
    excess: float
    clock: Floats


def gather(site: Site, epochs: Sequence[RangeEpoch]) -> Drive:
    """Lay the rows of all epochs side by side.

    Raises
    ------
    ValueError
        If there is no row of a fixed end, or epochs differ in clock or sound speed.
    """
    if len({(e.clock, e.sound_speed_mps) for e in epochs}) > 1:
        raise ValueError("epochs of one survey must share clock and sound_speed_mps; survey one recording at a time")
    beacons = [b for b in site.beacons if b.vehicle is None]
    microphones = [m for m in site.microphones if m.vehicle is None]
    names = tuple(b.id for b in beacons) + tuple(m.id for m in microphones)
    number = {("from", b.id): i for i, b in enumerate(beacons)}
    number |= {("to", m.id): len(beacons) + i for i, m in enumerate(microphones)}
    parts: dict[str, list[NDArray[Any]]] = {}
    ends: list[tuple[str, str]] = []
    instants: list[tuple[int, float, int]] = []
    turns, skipped = turning(site), 0
    for index, epoch in enumerate(epochs):
        links = link(site, epoch.emitter, epoch.receiver)
        keep = np.isfinite(epoch.range_m) & ((links.emitter_vehicle < 0) | (links.receiver_vehicle < 0))
        skipped += int(np.count_nonzero(~keep))
        instant_s = row_times(links, epoch.time_s, epoch.range_m, epoch.sound_speed_mps)
        who = np.maximum(links.emitter_vehicle, links.receiver_vehicle)
        for vehicle in np.unique(who[keep]):
            rows = np.flatnonzero(keep & (who == vehicle))
            middle_s = float(np.mean(instant_s[rows]))
            state = -1
            if vehicle >= 0:
                state = len(instants)
                instants.append((int(vehicle), middle_s, index))
            hears = links.emitter_vehicle[rows] < 0
            nothing = np.full(len(rows), np.nan)
            columns = {
                "state": np.full(len(rows), state),
                "arm": np.where(hears[:, None], links.receiver_point[rows], links.emitter_point[rows]),
                "sends": ~hears,
                "point": np.array(
                    [number["from", epoch.emitter[i]] if h else number["to", epoch.receiver[i]]
                     for i, h in zip(rows, hears, strict=True)]
                ),
                "dt": epoch.time_s[rows] - middle_s,
                "time_s": epoch.time_s[rows],
                "range_m": epoch.range_m[rows],
                "range_sd_m": np.sqrt(np.diag(epoch.covariance_m2)[rows] - epoch.bias_m2[rows]),
                "lasting_sd_m": np.sqrt(epoch.bias_m2[rows]),
                "rate_mps": nothing if epoch.range_rate_mps is None else epoch.range_rate_mps[rows],
                "rate_sd_mps": nothing if epoch.range_rate_sd_mps is None else epoch.range_rate_sd_mps[rows],
                "epoch": np.full(len(rows), index),
            }  # fmt: skip
            for key, value in columns.items():
                parts.setdefault(key, []).append(value)
            ends += [(epoch.emitter[i], epoch.receiver[i]) for i in rows]
    if not ends:
        raise ValueError("no range has a fixed end; a survey needs fixed beacons that a vehicle hears")
    flat = {key: np.concatenate(value) for key, value in parts.items()}
    # states: vehicle by vehicle, each in order of time
    order = sorted(range(len(instants)), key=lambda i: instants[i][:2])
    place = np.empty(len(order) + 1, np.int64)
    place[order], place[-1] = np.arange(len(order)), -1
    state = place[flat["state"]]
    sort = np.argsort(state, kind="stable")
    vehicle = np.array([instants[i][0] for i in order], np.int64)
    levels = np.array([np.nan if v.z_m is None else v.z_m for v in site.vehicles])
    rest = {key: flat[key][sort] for key in flat if key != "state"}
    return Drive(
        state=state[sort],
        emitter=tuple(ends[i][0] for i in sort),
        receiver=tuple(ends[i][1] for i in sort),
        names=names,
        place_m=np.array([n.position_m for n in (*beacons, *microphones)], float).reshape(-1, 3),
        state_time_s=np.array([instants[i][1] for i in order]),
        state_vehicle=vehicle,
        state_epoch=np.array([instants[i][2] for i in order], np.int64),
        level_m=levels[vehicle],
        turns=turns[vehicle],
        sound_speed_mps=epochs[0].sound_speed_mps,
        common_clock=epochs[0].clock == "common",
        sd_stated=all(e.sd_stated for e in epochs),
        skipped=skipped,
        **rest,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What rows would show, and derivatives: ranges in row 0 of each array, range rates in row 1.

    ``value`` (2, n); by the state (2, n, 11), the fixed end's place (2, n, 3), the sound speed's relative excess (2, n)
    and the clock (2, n, 3). By the bias it is 1 for ranges and 0 for rates.
    """

    value: Floats
    by_state: Floats
    by_place: Floats
    by_excess: Floats
    by_clock: Floats


def show(drive: Drive, guess: Guess, bias: NDArray[np.int64]) -> Shown:
    """Compute what the rows would show.

    The way r = |p_moving − p_fixed|, at the moment the moving end heard or sent; its derivative in the moment of
    hearing is u·v, or u·v / (1 + u·v/c) where the moving end sends. With another sound speed than was taken, ranges
    and rates come out smaller by 1 + excess.

    Parameters
    ----------
    bias : int64 (n, k)
        Indices of each row's biases; −1: none.
    """
    n, moving = len(drive), drive.state >= 0
    own = np.where(moving[:, None], guess.states[drive.state], 0.0) if len(guess.states) else np.zeros((n, STATE))
    scale = 1.0 + guess.excess
    c = drive.sound_speed_mps * scale
    yaw_rate = np.where(moving, own[:, 10], 0.0)
    there = guess.place_m[drive.point]
    sending = drive.sends & moving

    def placed(dt: Floats) -> tuple[Floats, Floats]:
        """Where the moving ends are, and their arms in the site's axes."""
        yaw = own[:, 9] + yaw_rate * dt
        cos, sin = np.where(moving, np.cos(yaw), 1.0), np.where(moving, np.sin(yaw), 0.0)
        east = cos * drive.arm[:, 0] - sin * drive.arm[:, 1]
        north = sin * drive.arm[:, 0] + cos * drive.arm[:, 1]
        arm = np.column_stack([east, north, drive.arm[:, 2]])
        return own[:, :3] + own[:, 3:6] * dt[:, None] + own[:, 6:9] * (dt**2 / 2)[:, None] + arm, arm

    dt = drive.dt
    here, arm = placed(dt)
    way = np.maximum(np.linalg.norm(here - there, axis=1), 1e-6)
    # where the moving end sends, the moment depends on the way: each round contracts by v/c
    for _ in range(4 if sending.any() else 0):
        dt = np.where(sending, drive.dt - way / c, drive.dt)
        here, arm = placed(dt)
        way = np.maximum(np.linalg.norm(here - there, axis=1), 1e-6)
    east, north = arm[:, 0], arm[:, 1]
    turn = np.column_stack([-north, east, np.zeros(n)])
    velocity = own[:, 3:6] + own[:, 6:9] * dt[:, None] + turn * yaw_rate[:, None]
    unit = (here - there) / way[:, None]
    closing = np.sum(unit * velocity, axis=1)
    lag = np.where(drive.sends, 1.0 / (1.0 + closing / c), 1.0)
    across = (velocity - closing[:, None] * unit) / way[:, None]
    since = drive.time_s
    value = np.empty((2, n))
    value[0] = way / scale + guess.clock[0] + guess.clock[1] * since + guess.clock[2] * since**2 / 2
    if len(guess.bias_m):
        value[0] += np.where(bias >= 0, guess.bias_m[bias], 0.0).sum(axis=1)
    value[1] = lag * closing / scale + guess.clock[1] + guess.clock[2] * since
    along, side = lag / scale, lag**2 / scale
    by_state, by_place = np.zeros((2, n, STATE)), np.zeros((2, n, 3))
    for k, (place, speed) in enumerate(((unit, None), (across, unit))):
        factor = (along if k == 0 else side)[:, None]
        late = dt[:, None]
        by_state[k, :, :3] = factor * place
        by_state[k, :, 3:6] = factor * place * late
        by_state[k, :, 6:9] = factor * place * late**2 / 2
        turned = np.sum(place * turn, axis=1)
        swing = np.zeros(n)
        if speed is not None:
            by_state[k, :, 3:6] += factor * speed
            by_state[k, :, 6:9] += factor * speed * late
            # the arm's own speed turns with it
            inward = np.column_stack([-yaw_rate * east, -yaw_rate * north, np.zeros(n)])
            turned = turned + np.sum(speed * inward, axis=1)
            swing = np.sum(speed * turn, axis=1)
        by_state[k, :, 9] = factor[:, 0] * turned
        by_state[k, :, 10] = factor[:, 0] * (turned * dt + swing)
        by_place[k] = -factor * place
    by_state[:, ~moving] = 0.0
    # sound that is faster left a moving emitter later
    later = np.where(sending, lag * closing * way / c, 0.0)
    by_excess = np.stack([(later - way / scale) / scale, -lag * closing / scale**2])
    by_clock = np.zeros((2, n, 3))
    by_clock[0] = np.column_stack([np.ones(n), since, since**2 / 2])
    by_clock[1, :, 1], by_clock[1, :, 2] = 1.0, since
    return Shown(value, by_state, by_place, by_excess, by_clock)
