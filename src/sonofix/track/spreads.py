"""How far positions of a vehicle err on the level, and how far in height, which may be another thing altogether."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sonofix.records import Fix, Floats
from sonofix.track.scatter import Scatter, scatter

CLIMB_SD_MPS = 1.0
"""Upwards, of a vehicle that positions have just placed."""


@dataclass(frozen=True, slots=True, eq=False)
class Spreads:
    """What is known of how far the positions of one vehicle err; a new one with each.

    ``level`` is of x and y, ``height`` of z; the latter hears nothing where positions tell no height.
    """

    level: Scatter
    height: Scatter

    @property
    def begins(self) -> bool:
        """Whether no position has come since it was placed by anything else."""
        return self.level.state is None

    @property
    def scale(self) -> float:
        """What the larger of both stated deviations is to be taken times."""
        return max(self.level.scale, self.height.scale if self.height.state is not None else 1.0)

    def noise(self, fix: Fix, axes: Sequence[str]) -> Floats:
        """Covariance (d, d) of a fix along axes, as its deviations are to be taken."""
        each = np.array([self.height.scale if axis == "z" else self.level.scale for axis in axes])
        return _stated_m2(fix, axes) * np.outer(each, each)

    def begun(self, time_s: float, fix: Fix, speed_sd_mps: float) -> Spreads:
        """Return what is known where a fix put a vehicle, which moves anyhow."""
        assert fix.position_m is not None
        level = self.level.begun(time_s, fix.position_m[:2], _variance_m2(fix, "xy"), speed_sd_mps)
        if "z" not in fix.states:
            return Spreads(level, self.height)
        return Spreads(level, self.height.begun(time_s, fix.position_m[2:], _variance_m2(fix, "z"), CLIMB_SD_MPS))

    def taken(self, time_s: float, fix: Fix) -> tuple[Spreads, float]:
        """Return what is known once a fix came, by the members, and how likely that was, as `Scatter.taken` does."""
        assert fix.position_m is not None
        level, likely = self.level.taken(time_s, fix.position_m[:2], _variance_m2(fix, "xy"))
        if "z" not in fix.states:
            return Spreads(level, self.height), likely
        height, upwards = self.height.taken(time_s, fix.position_m[2:], _variance_m2(fix, "z"))
        return Spreads(level, height), likely + upwards

    def judged(self, miss_m: Floats, spread_m2: Floats, fix: Fix, axes: Sequence[str]) -> tuple[Spreads, float]:
        """Return what is known once a fix came, by the track along axes, and how likely it was: `Scatter.judged`.

        ``miss_m`` (d,) is by how much it is off the track, ``spread_m2`` (d, d) the covariance of what that expects.
        """
        stated = _stated_m2(fix, axes)
        both, likely = [self.level, self.height], 0.0
        for k, names in enumerate(("xy", "z")):
            own = [i for i, axis in enumerate(axes) if axis in names]
            if own:
                block = np.ix_(own, own)
                both[k], news = both[k].judged(miss_m[own], spread_m2[block], stated[block])
                likely += news
        return Spreads(*both), likely

    def led(self, by: Spreads | None) -> Spreads:
        """Return the same, led as another or by nothing."""
        level, height = (None, None) if by is None else (by.level.led, by.height.led)
        return Spreads(replace(self.level, led=level), replace(self.height, led=height))

    def kept(self) -> Spreads:
        """Return what is known of noise, but of no place."""
        level, height = (replace(scatter(), heard=known.heard, led=known.led) for known in (self.level, self.height))
        return Spreads(level, height)


def spreads() -> Spreads:
    """Return what is known before any position came."""
    return Spreads(scatter(), scatter())


def _stated_m2(fix: Fix, axes: Sequence[str]) -> Floats:
    """Covariance (d, d) that a fix states along axes."""
    assert fix.covariance is not None
    rows = [fix.states.index(axis) for axis in axes]
    return fix.covariance[np.ix_(rows, rows)]


def _variance_m2(fix: Fix, axes: str) -> float:
    """Variance of axes that a fix states, in the mean."""
    assert fix.covariance is not None
    return float(np.mean([fix.covariance[i, i] for i, name in enumerate(fix.states) if name in axes]))
