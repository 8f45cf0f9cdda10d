"""A recording as peers take it, and the models of motion and range that they share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, Recording


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Ranges of one vehicle in order of time, and what it knows of its motion.

    ``anchors_m`` (A, 3), ``arms_m`` (T, 3) of what hears on the vehicle; per range (n,) ``time_s``, ``anchor``,
    ``tag``, ``range_m`` and ``stated_sd_m`` (NaN where none is); ``odometry`` (m, 3) of time, speed and turn rate, each
    row held until the next; ``start`` x, y, yaw where it is given; ``level_m`` where the vehicle's height is known.
    """

    anchors_m: Floats
    arms_m: Floats
    time_s: Floats
    anchor: NDArray[np.int64]
    tag: NDArray[np.int64]
    range_m: Floats
    stated_sd_m: Floats
    odometry: Floats
    start: Floats | None
    level_m: float | None

    def instants(self) -> Iterator[tuple[float, slice]]:
        """Each time at which ranges were heard, with its rows."""
        firsts = np.append(np.flatnonzero(np.diff(self.time_s, prepend=-np.inf) > 0), len(self.time_s))
        for first, end in zip(firsts[:-1].tolist(), firsts[1:].tolist(), strict=True):
            yield float(self.time_s[first]), slice(first, end)

    def driven(self, from_s: float, to_s: float) -> Iterator[tuple[float, float, float]]:
        """Way, turn and duration by the odometry, piece by piece; nothing is known before its first row."""
        time_s, speed, turn = self.odometry.T
        first, last = np.searchsorted(time_s, [from_s, to_s], side="right") - 1
        for row in range(max(int(first), 0), int(last) + 1):
            until = to_s if row + 1 == len(time_s) else min(to_s, float(time_s[row + 1]))
            dt = until - max(from_s, float(time_s[row]))
            yield float(speed[row]) * dt, float(turn[row]) * dt, dt


def problem(recording: Recording) -> Problem:
    """Return the ranges of a recording with one vehicle."""
    site, ranges, tables = recording.site, recording.ranges, recording.tables
    assert ranges is not None
    anchors = {b.id: i for i, b in enumerate(site.beacons)}
    tags = {m.id: i for i, m in enumerate(site.microphones)}
    order = np.argsort(ranges.time_s, kind="stable")
    odometry, start = np.zeros((0, 3)), None
    if "odometry" in tables:
        columns = tables["odometry"].columns
        odometry = np.column_stack([columns[name] for name in ("time_s", "v_mps", "yaw_rate_radps")])
    if "start" in tables:
        columns = tables["start"].columns
        start = np.array([columns[name][0] for name in ("x_m", "y_m", "yaw_rad")])
    sd = np.full(len(order), np.nan) if ranges.sd_m is None else ranges.sd_m
    return Problem(
        anchors_m=np.array([b.position_m for b in site.beacons], float),
        arms_m=np.array([m.lever_arm_m for m in site.microphones], float),
        time_s=ranges.time_s[order],
        anchor=np.array([anchors[name] for name in ranges.emitter])[order],
        tag=np.array([tags[name] for name in ranges.receiver])[order],
        range_m=ranges.range_m[order],
        stated_sd_m=sd[order],
        odometry=odometry,
        start=start,
        level_m=site.vehicles[0].z_m,
    )


@dataclass(frozen=True, slots=True)
class Setting:
    """What a peer is told about one recording: how far to trust ranges and motion, and what else is unknown.

    Noise: a range's deviation is ``range_sd_m``, plus ``stated`` times that which came with it. Driven by odometry,
    the way is off by ``way_sd`` per √m, to the side by ``side_sd`` per √m, the heading by ``turn_sd`` per √s. Else
    velocities wander: ``acceleration_psd`` (m²/s³), ``climb_psd`` upwards, ``spin_psd`` (rad²/s³).

    Extra unknowns, all constant: a ``bias`` of each anchor or each pair, about ``bias_m``; a common scale of ranges and
    one of the odometer, about 0 within ``scale_sd`` and ``odometer_sd``. The filter leaves out rows beyond ``gate``
    deviations, the graph weighs rows down by Cauchy's function from ``robust`` deviations on. ``heading_rad``: where
    the vehicle faces at first, where no start is given; ``speed_sd_mps``: of its velocities then, from 0.
    """

    range_sd_m: float
    stated: float = 0.0
    way_sd: float = 0.1
    side_sd: float = 0.02
    turn_sd: float = 0.1
    acceleration_psd: float = 0.5
    climb_psd: float = 0.001
    spin_psd: float = 0.3
    bias: str = ""
    bias_m: float = 0.0
    bias_sd_m: float = 0.3
    scale_sd: float = 0.0
    odometer_sd: float = 0.0
    gate: float = np.inf
    robust: float = np.inf
    heading_rad: float = 0.0
    heading_sd_rad: float = 0.1
    speed_sd_mps: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Motion and ranges of one problem under one setting.

    The state is x, y, z where the level is unknown, yaw where tags sit off the origin or there is odometry, then the
    rates of all these unless there is odometry; the extras are the biases, then range scale and odometer scale.
    """

    problem: Problem
    setting: Setting
    wheels: bool = field(init=False)
    rises: bool = field(init=False)
    shows_yaw: bool = field(init=False)
    turns: bool = field(init=False)
    places: int = field(init=False)
    own: int = field(init=False)
    biases: int = field(init=False)
    _ways: dict[tuple[float, float], tuple[Floats, float, Floats]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        told = self.problem
        wheels, rises = len(told.odometry) > 0, told.level_m is None
        shows_yaw = bool(np.abs(told.arms_m[:, :2]).max() > 0)
        places = 2 + rises + (wheels or shows_yaw)
        anchors, tags = len(told.anchors_m), len(told.arms_m)
        for name, value in (
            ("wheels", wheels),
            ("rises", rises),
            ("shows_yaw", shows_yaw),
            ("turns", wheels or shows_yaw),
            ("places", places),
            ("own", places if wheels else 2 * places),
            ("biases", {"": 0, "anchor": anchors, "pair": anchors * tags}[self.setting.bias]),
        ):
            object.__setattr__(self, name, value)

    def extras_sd(self) -> Floats:
        """Deviation of each extra unknown beforehand."""
        scales = [sd for sd in (self.setting.scale_sd, self.setting.odometer_sd) if sd]
        return np.array([self.setting.bias_sd_m] * self.biases + scales)

    def extras(self) -> Floats:
        """Most likely value of each extra unknown beforehand."""
        return np.array([self.setting.bias_m] * self.biases + [0.0] * (len(self.extras_sd()) - self.biases))

    def range_sd_m(self, rows: slice) -> Floats:
        sd = np.full(len(self.problem.time_s[rows]), self.setting.range_sd_m)
        return sd + self.setting.stated * self.problem.stated_sd_m[rows] if self.setting.stated else sd

    def ranges(self, state: Floats, extras: Floats, rows: slice) -> tuple[Floats, Floats, Floats]:
        """Ranges (k,) that rows should show, and their derivatives by state (k, own) and extras (k, extras)."""
        told, setting = self.problem, self.setting
        arm, anchor = told.arms_m[told.tag[rows]], told.anchors_m[told.anchor[rows]]
        yaw = state[2 + self.rises] if self.shows_yaw else 0.0
        cos, sin = np.cos(yaw), np.sin(yaw)
        turned = np.column_stack([cos * arm[:, 0] - sin * arm[:, 1], sin * arm[:, 0] + cos * arm[:, 1], arm[:, 2]])
        origin = np.array([state[0], state[1], state[2] if self.rises else told.level_m])
        away = origin + turned - anchor
        distance = np.sqrt(np.sum(away**2, axis=1))
        unit = away / distance[:, None]
        by_state, by_extras = np.zeros((len(distance), self.own)), np.zeros((len(distance), len(extras)))
        by_state[:, : 2 + self.rises] = unit[:, : 2 + self.rises]
        if self.shows_yaw:
            by_state[:, 2 + self.rises] = unit[:, 1] * turned[:, 0] - unit[:, 0] * turned[:, 1]
        shown = distance
        if setting.scale_sd:
            shown = distance * (1.0 + extras[self.biases])
            by_state *= 1.0 + extras[self.biases]
            by_extras[:, self.biases] = distance
        if self.biases:
            of = told.anchor[rows] + (len(told.anchors_m) * told.tag[rows] if setting.bias == "pair" else 0)
            shown = shown + extras[of]
            by_extras[np.arange(len(of)), of] = 1.0
        return shown, by_state, by_extras

    def moved(self, state: Floats, extras: Floats, from_s: float, to_s: float) -> tuple[Floats, Floats, Floats, Floats]:
        """State at a later time, its derivatives by state and extras, and the covariance of what disturbs it."""
        return (self._driven if self.wheels else self._drifted)(state, extras, from_s, to_s)

    def _drifted(self, state: Floats, extras: Floats, from_s: float, to_s: float) -> tuple[Floats, ...]:
        """Constant velocity under white acceleration (Bar-Shalom 2001, eq 6.2.2-12)."""
        n, dt = self.places, to_s - from_s
        by_state = np.eye(2 * n)
        by_state[:n, n:] = dt * np.eye(n)
        setting = self.setting
        density = np.array(
            [setting.acceleration_psd] * 2 + [setting.climb_psd] * self.rises + [setting.spin_psd] * self.turns
        )
        noise, place, rate = np.zeros((2 * n, 2 * n)), np.arange(n), np.arange(n, 2 * n)
        noise[place, place], noise[rate, rate] = density * dt**3 / 3, density * dt
        noise[place, rate] = noise[rate, place] = density * dt**2 / 2
        return by_state @ state, by_state, np.zeros((2 * n, len(extras))), noise

    def _driven(self, state: Floats, extras: Floats, from_s: float, to_s: float) -> tuple[Floats, ...]:
        """Unicycle by odometry: what it did in its own frame, laid on where it stood."""
        way, turn, spread = self._done(from_s, to_s)
        cos, sin = np.cos(state[2]), np.sin(state[2])
        ahead = np.array([cos * way[0] - sin * way[1], sin * way[0] + cos * way[1]])
        longer = 1.0 + (extras[-1] if self.setting.odometer_sd else 0.0)
        by_state, by_extras, axes = np.eye(3), np.zeros((3, len(extras))), np.eye(3)
        by_state[:2, 2] = -longer * ahead[1], longer * ahead[0]
        if self.setting.odometer_sd:
            by_extras[:2, -1] = ahead
        axes[:2, :2] = (cos, -sin), (sin, cos)
        return state + np.append(longer * ahead, turn), by_state, by_extras, axes @ spread @ axes.T

    def _done(self, from_s: float, to_s: float) -> tuple[Floats, float, Floats]:
        """Way (2,) and turn by odometry in the frame of ``from_s``, each piece a chord, and the covariance (3, 3).

        The way errs along it and to its side, the heading with time.
        """
        known = self._ways.get((from_s, to_s))
        if known is not None:
            return known
        setting, way, turned = self.setting, np.zeros(2), 0.0
        spread = np.diag([1e-6, 1e-6, 1e-8])
        for length, turn, dt in self.problem.driven(from_s, to_s):
            middle = turned + turn / 2
            ahead = np.array([np.cos(middle), np.sin(middle)])
            step, axes = np.eye(3), np.array([ahead, [-ahead[1], ahead[0]]]).T
            step[:2, 2] = length * axes[:, 1]
            spread = step @ spread @ step.T
            spread[:2, :2] += axes @ np.diag([setting.way_sd**2, setting.side_sd**2]) @ axes.T * abs(length)
            spread[2, 2] += setting.turn_sd**2 * dt
            way += length * ahead
            turned += turn
        self._ways[from_s, to_s] = way, turned, spread
        return way, turned, spread
