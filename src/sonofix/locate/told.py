"""Fixes that a recording states: positions which others computed, of which no range is known."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sonofix.locate.fix import fix
from sonofix.records import Fix, RangeEpoch, Table
from sonofix.site import Site

WITHOUT_SD_M = 0.1
"""Deviation of a position's axes where the file states none, as of ranges without one."""


def told_fixes(table: Table, site: Site) -> Iterator[tuple[RangeEpoch, tuple[Fix, ...]]]:
    """Make each row of `positions.csv` an epoch without ranges, and the fixes of all vehicles: its own is as stated.

    ``table`` holds `time_s`, `x_m`, `y_m`, perhaps `z_m` and `sd_m` of each axis, and `vehicle`. The level of a vehicle
    that has one (`z_m` of the site) stands above that of a row.
    """
    columns, count = table.columns, len(table.columns["time_s"])
    whose = table.names.get("vehicle") or (site.vehicles[0].id,) * count
    sd_m = np.full(count, np.nan) if "sd_m" not in columns else columns["sd_m"]
    sd_m = np.where(np.isnan(sd_m), WITHOUT_SD_M, sd_m)
    height_m = columns.get("z_m", np.full(count, np.nan))
    for i in np.argsort(columns["time_s"], kind="stable").tolist():
        epoch = _silent(i, float(columns["time_s"][i]), site)
        level_m = site.vehicle(whose[i]).z_m
        states = ("x", "y", "z") if level_m is None else ("x", "y")
        place = np.array([columns["x_m"][i], columns["y_m"][i], height_m[i] if level_m is None else level_m])
        own = Fix(
            time_s=epoch.sync_s,
            vehicle=whose[i],
            status="ok",
            remedy="",
            states=states,
            position_m=place,
            velocity_mps=None,
            yaw_rad=None,
            clock_offset_m=None,
            covariance=sd_m[i] ** 2 * np.eye(len(states)),
            hdop=None,
            vdop=None,
            hpl_m=None,
            vpl_m=None,
            used=np.zeros(0, bool),
            residual_m=np.zeros(0),
        )
        yield epoch, tuple(own if v.id == whose[i] else fix(epoch, site, v.id) for v in site.vehicles)


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
