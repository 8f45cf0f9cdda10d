"""From the ranges of an epoch to fixes and estimates: what samples, exchanges and stated ranges all go through."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from sonofix.locate.fix import fix
from sonofix.locate.sound_speed import SoundSpeed, thermometer
from sonofix.locate.unstated import fix_by_residuals
from sonofix.records import Estimate, Event, Fix, RangeEpoch, Step, Table
from sonofix.site import Site
from sonofix.track.belief import Belief, Motion, estimate, predict
from sonofix.track.follow import Follower
from sonofix.track.held import AIR
from sonofix.track.inputs import gather
from sonofix.track.late import Rewinder


class Street:
    """Follows vehicles by ranges, epoch after epoch.

    Parameters
    ----------
    site : Site
    start : Table or None
        Poses known beforehand.
    rate_hz : float or None
        Estimates at this rate; None: one an epoch.
    late_s : float
        Epochs may come out of order, late by so much; 0: each comes after those before it, as from one recorder.
    """

    def __init__(
        self, site: Site, start: Table | None = None, rate_hz: float | None = None, late_s: float = 0.0
    ) -> None:
        self.site = site
        self.rate_hz = rate_hz
        if not 0.0 <= late_s < np.inf:
            raise ValueError(f"late_s is {late_s}; epochs come late by a number of seconds from 0 on")
        self._late_s = late_s
        self._rewinder: Rewinder | None = None
        self.follower = Follower(site, Motion(), site.free_running, gather(site, {}))
        self.air = SoundSpeed()
        self._start = start
        self._written_s: float | None = None

    def sense(
        self,
        tables: Mapping[str, Table],
        stated: tuple[tuple[str, str], ...] | None = None,
        held: Collection[str] = (),
    ) -> None:
        """Let what vehicles' own sensors and a thermometer tell enter, each row at its time; before the first epoch.

        ``stated``: pairs (emitter, receiver) whose ranges come from others, with errors of their own. ``held``: what
        shall not calibrate itself (`track.held.CALIBRATIONS`).
        """
        self.air = SoundSpeed(thermometer(self.site, tables.get("temperature")), learns=AIR not in held)
        inputs = gather(self.site, tables, stated)
        self.follower = Follower(self.site, self.follower.motion, self.site.free_running, inputs, held)
        self._rewinder = None

    def walk(self, epoch: RangeEpoch, flags: tuple[Event, ...] = (), fixes: tuple[Fix, ...] | None = None) -> Step:
        """Take in the ranges of one epoch; or, where it has none, ``fixes`` of all vehicles that others made."""
        self.begin(epoch.sync_s)

        def solve(asked: RangeEpoch) -> tuple[Fix, ...]:
            return tuple(fix(asked, self.site, v.id) for v in self.site.vehicles)

        told: tuple[Event, ...] = ()
        if fixes is None:
            epoch, fixes, told = self.air.take(epoch, lambda e: fix_by_residuals(e, self.site, solve))
        before, hidden = self.follower.belief, self.follower.hidden
        if self._late_s > 0.0:
            self._rewinder = self._rewinder or Rewinder(self.follower, self._late_s)
            estimates, used, events = self._rewinder.step(epoch, fixes)
            self.follower, entered = self._rewinder.follower, self._rewinder.innovation
        else:
            estimates, used, events = self.follower.step(epoch, fixes)
            entered = self.follower.innovation
        believed = used.copy()
        offset = np.full(len(epoch), 0.0 if epoch.clock == "known" else np.nan)
        if epoch.clock == "common" and estimates and estimates[0].clock_offset_m is not None:
            offset[:] = estimates[0].clock_offset_m
        for found in fixes:
            if found.status == "ok":
                asked = np.isfinite(found.residual_m)
                believed[asked] = found.used[asked]
                if found.clock_offset_m is not None:
                    offset[asked] = found.clock_offset_m
        if any(event.event == "late" for event in events):
            believed[:] = False
        if self.rate_hz is not None:
            estimates = self._between(before, hidden, estimates)
        innovations = () if entered is None else (entered,)
        told = flags + told + events
        return Step(epoch, fixes, estimates, told, believed & np.isfinite(offset), offset, innovations=innovations)

    def begin(self, time_s: float) -> None:
        """Put vehicles where start.csv says, once: at the first epoch, or where sensors tell of motion earlier."""
        if self._start is None:
            return
        start, self._start = self._start, None
        inputs = self.follower.belief.inputs
        if inputs is not None and len(inputs.time_s):
            time_s = min(time_s, float(inputs.time_s[0]))
        if not self.site.vehicles:
            raise ValueError("start.csv places a vehicle, but the site has none: add a [[vehicle]]")
        vehicles = start.names.get("vehicle") or (self.site.vehicles[0].id,) * len(start.columns["x_m"])
        for i, vehicle in enumerate(vehicles):
            z = start.columns.get("z_m")
            level = self.site.vehicle(vehicle).z_m
            height = level if level is not None else (0.0 if z is None or np.isnan(z[i]) else float(z[i]))
            position = np.array([start.columns["x_m"][i], start.columns["y_m"][i], height])
            yaw = float(np.nan_to_num(start.columns["yaw_rad"][i])) if "yaw_rad" in start.columns else 0.0
            self.follower.start(vehicle, time_s, position, yaw)

    def _between(self, before: Belief, hidden: frozenset[int], latest: tuple[Estimate, ...]) -> tuple[Estimate, ...]:
        """Return estimates on the grid of the wished rate up to the latest instant, by what was known at each."""
        if self.rate_hz is None:
            return ()
        until_s = self.follower.belief.time_s
        if self._written_s is None:
            if latest:
                self._written_s = np.ceil(until_s * self.rate_hz) / self.rate_hz
            return ()
        out: list[Estimate] = []
        while self._written_s <= until_s:
            if self._written_s >= before.time_s:
                aged = predict(before, self._written_s, self.follower.motion)
                told = [i for i in np.flatnonzero(aged.placed).tolist() if i not in hidden]
                out += [estimate(aged, self.site, i, "predicted") for i in told]
            self._written_s += 1.0 / self.rate_hz
        return tuple(out)
