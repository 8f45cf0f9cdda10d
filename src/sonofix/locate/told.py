"""Fixes that a recording states: positions which others computed, of which no range is known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sonofix.locate.fix import failed
from sonofix.records import Fix, Floats, RangeEpoch, Table
from sonofix.site import Site

WITHOUT_SD_M = 0.1
"""Deviation of a position's axes where the file states none, as of ranges without one."""


def told_fixes(table: Table, site: Site) -> Iterator[tuple[RangeEpoch, tuple[Fix, ...]]]:
    """Make rows of one instant of `positions.csv` an epoch without ranges, and fixes of all vehicles as they state.

    ``table`` holds `time_s`, `x_m`, `y_m`, perhaps `z_m` and `sd_m` of each axis, and `vehicle`. The level of a vehicle
    that has one (`z_m` of the site) stands above that of a row.
    """
    columns, count = table.columns, len(table.columns["time_s"])
    if not count:
        return
    whose = table.names.get("vehicle") or (site.vehicles[0].id,) * count
    sd_m = np.full(count, np.nan) if "sd_m" not in columns else columns["sd_m"]
    sds_m: list[float] = np.where(np.isnan(sd_m), WITHOUT_SD_M, sd_m).tolist()
    height_m = columns.get("z_m", np.full(count, np.nan))
    order = np.argsort(columns["time_s"], kind="stable")
    times, first = np.unique(columns["time_s"][order], return_index=True)
    for k, (time_s, rows) in enumerate(zip(times.tolist(), np.split(order, first[1:]), strict=True)):
        epoch = _silent(k, time_s, site)
        own: dict[str, Fix] = {}
        for i in rows.tolist():
            level_m = site.vehicle(whose[i]).z_m
            z = height_m[i] if level_m is None else level_m
            place = np.array([columns["x_m"][i], columns["y_m"][i], z])
            own[whose[i]] = _told(epoch, whose[i], place, ("x", "y", "z") if level_m is None else ("x", "y"), sds_m[i])
        yield epoch, tuple(own.get(v.id, _untold(epoch, v.id)) for v in site.vehicles)


def _told(epoch: RangeEpoch, vehicle: str, position_m: Floats, states: tuple[str, ...], sd_m: float) -> Fix:
    """Return a fix as it is stated."""
    return replace(
        _untold(epoch, vehicle),
        status="ok",
        states=states,
        position_m=position_m,
        covariance=sd_m**2 * np.eye(len(states)),
    )


def _untold(epoch: RangeEpoch, vehicle: str) -> Fix:
    """Return the fix of a vehicle of which an epoch tells nothing."""
    return failed(epoch, vehicle, epoch.sync_s, "too-few", "no position at this instant")


def _silent(index: int, time_s: float, site: Site) -> RangeEpoch:
    """Return an epoch in which nothing was ranged."""
    return RangeEpoch(
        index=index,
        sync_s=time_s,
        emitter=(),
        receiver=(),
        time_s=np.zeros(0),
        range_m=np.zeros(0),
        covariance_m2=np.zeros((0, 0)),
        range_rate_mps=None,
        range_rate_sd_mps=None,
        snr_db=None,
        clock="known",
        sound_speed_mps=site.sound_speed_mps,
    )
