"""Rows of one vehicle in one epoch, ready to be solved in any selection."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SAME_ARM_M, Links, expected
from sonofix.locate.dense import spread
from sonofix.locate.noise import CLOCK_SPEED_SD, row_noise
from sonofix.locate.search import MOST, search, without
from sonofix.records import Floats, RangeEpoch

UNKNOWN_SPEED_MPS = 1.0
"""Deviation of the velocity (from 0) where no range rates tell of it: a walk."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where a descent came to rest: state (10,) as `solve.misfit` has it, whitened χ² and Jacobian (m, k)."""

    state: Floats
    chi2: float
    jacobian: Floats

    @property
    def position_m(self) -> Floats:
        """Where the motion is followed (3,)."""
        return self.state[:3]

    @property
    def clock_m(self) -> float:
        """Offset that all ranges share."""
        return float(self.state[8])


@numba.njit(cache=True, error_model="numpy")
def gather(ends, who, time_s, range_m, common, c):
    """Pick one vehicle's rows whose other end is fixed, as of a site where it is the only one.

    Returns
    -------
    rows : int64 (n,)
    middle_s : float
        Mean of the moments that they speak of: when heard, or when sent where only the emitter moves. With an unknown
        clock flights are not known, only their differences: the earliest arrival stands in.
    dt : float64 (n,)
        When each was heard, from then.
    ends : tuple
        Of these rows; lever arms less ``open_arm``.
    open_arm : float64 (2,)
        Two ends on one body fix the heading; a lone one off the axis leaves its origin open by its arm.
    turns : bool
    """
    emitter_vehicle, emitter_point, receiver_vehicle, receiver_point = ends
    count, middle_s = 0, 0.0
    mine = np.zeros(len(range_m), np.bool_)
    for i in range(len(range_m)):
        sounding = emitter_vehicle[i] == who and receiver_vehicle[i] < 0
        listening = receiver_vehicle[i] == who and emitter_vehicle[i] < 0
        mine[i] = (sounding or listening) and np.isfinite(range_m[i])
        if mine[i]:
            count += 1
            middle_s += time_s[i] - (range_m[i] / c if sounding and not common else 0.0)
    middle_s /= max(count, 1)
    rows, dt, open_arm, turns = np.empty(count, np.int64), np.empty(count), np.zeros(2), False
    sent, sent_at = np.empty(count, np.int64), np.empty((count, 3))
    heard, heard_at = np.empty(count, np.int64), np.empty((count, 3))
    first_x = first_y = 0.0
    k = 0
    for i in range(len(range_m)):
        if not mine[i]:
            continue
        rows[k], dt[k] = i, time_s[i] - middle_s
        sent[k], heard[k] = min(emitter_vehicle[i], 0), min(receiver_vehicle[i], 0)
        for axis in range(3):
            sent_at[k, axis], heard_at[k, axis] = emitter_point[i, axis], receiver_point[i, axis]
        arm = heard_at[k] if heard[k] == 0 else sent_at[k]
        if k == 0:
            first_x, first_y = arm[0], arm[1]
        turns |= (arm[0] - first_x) ** 2 + (arm[1] - first_y) ** 2 > SAME_ARM_M**2
        open_arm[0] += arm[0] / count
        open_arm[1] += arm[1] / count
        k += 1
    if turns:
        open_arm[:] = 0.0
    for k in range(count):
        arm = heard_at[k] if heard[k] == 0 else sent_at[k]
        arm[0] -= open_arm[0]
        arm[1] -= open_arm[1]
    return rows, middle_s, dt, (sent, sent_at, heard, heard_at), open_arm, turns


@numba.njit(cache=True, error_model="numpy")
def look(rows, c, clock, index, state, kept, residual):
    """Fill ``residual`` (n,) of all ranges at a state; return horizontal and vertical DOP of those kept.

    Dilution is of ranges alone, with unit variances; the horizontal one is negative where a direction is left open,
    the vertical one 0 where the level is known.
    """
    ends, dt, measured = rows
    n, places, in_space = len(dt), 0, False
    value, derivative = np.empty(n), np.empty((n, 10))
    expected(ends, state, dt, c, clock, value, derivative)
    for i in range(n):
        residual[i] = measured[i] - value[i]
    chosen = np.empty(len(index), np.int64)
    for j in index:
        if j < 4 or j == 8:
            chosen[places] = j
            places += 1
            in_space |= j == 2
    unit, covariance = np.empty((len(kept), places)), np.empty((places, places))
    for i in range(len(kept)):
        for j in range(places):
            unit[i, j] = derivative[kept[i], chosen[j]]
    if not spread(unit, covariance):
        return -1.0, 0.0
    return np.sqrt(covariance[0, 0] + covariance[1, 1]), np.sqrt(covariance[2, 2]) if in_space else 0.0


class Rows:
    """Rows of one vehicle in one epoch: what is unknown, and what each selection of them says of it.

    Selections count these rows, not those of the epoch: ``rows`` (n,) are theirs there.

    Parameters
    ----------
    epoch : RangeEpoch
    links : Links
        Of all rows of the epoch.
    who : int
        The vehicle's index in the site.
    level_m : float or None
        The vehicle's level, where known.
    """

    def __init__(self, epoch: RangeEpoch, links: Links, who: int, level_m: float | None) -> None:
        self.clock, self.rates = epoch.clock == "common", epoch.range_rate_mps is not None
        self.level_m = level_m
        self._speed_mps = float(epoch.sound_speed_mps)
        self.rows, middle_s, self._dt, self._ends, self.open_arm, self.turns = gather(
            links.ends, who, epoch.time_s, epoch.range_m, self.clock, self._speed_mps
        )
        self.time_s = middle_s if len(self.rows) else epoch.sync_s
        places = [0, 1] + [2] * (level_m is None) + [3] * self.turns
        self.needed = len(places) + self.clock
        self._index = np.array(places + [4 + p for p in places if self.rates] + [8] * self.clock)
        self.range_m = self._measured = epoch.range_m[self.rows]
        if epoch.range_rate_mps is not None:
            self._measured = np.concatenate([self.range_m, epoch.range_rate_mps[self.rows]])
        speed_sd, clock_sd = 0.0 if self.rates else UNKNOWN_SPEED_MPS, CLOCK_SPEED_SD * self._speed_mps * self.clock
        self._covariance = row_noise(epoch, links, self.rows, self._dt, speed_sd, clock_sd)

    @property
    def components(self) -> tuple[int, ...]:
        """Which components of `geometry.POSE` are solved for."""
        return tuple(int(j) for j in self._index if j < 8)

    def degrees(self, count: int) -> int:
        """Degrees of freedom of so many rows: measurements (ranges, and rates where there are any) less unknowns."""
        return count * (2 if self.rates else 1) - len(self._index)

    def candidates(self, rows: NDArray[np.int64]) -> list[Solution]:
        """Solutions from all starts, best first, none twice.

        Raises
        ------
        LinAlgError
            If the covariance of rows is not positive.
        """
        ends, dt, measured, covariance = self._ends, self._dt, self._measured, self._covariance
        if len(rows) < len(dt):
            both = np.concatenate([rows, rows + len(dt)]) if self.rates else rows
            ends, dt = tuple(part[rows] for part in ends), dt[rows]
            measured, covariance = measured[both], np.ascontiguousarray(covariance[both[:, None], both])
        m, flat = len(measured), self.level_m is not None
        states, chi2s, jacobians = np.empty((MOST, 10)), np.empty(MOST), np.empty((MOST, m, len(self._index)))
        at = (
            (ends, dt, measured),
            self._speed_mps,
            self.clock,
            covariance,
            self._index,
            flat,
            float(self.level_m or 0),
        )
        count = search(*at, states, chi2s, jacobians)
        if count < 0:
            raise np.linalg.LinAlgError("covariance_m2 is not positive definite; give every range a deviation above 0")
        return [Solution(states[i], float(chi2s[i]), jacobians[i]) for i in range(count)]

    def without(self, choices: NDArray[np.int64], found: Solution) -> tuple[Floats, Floats, Floats]:
        """Solve again from a solution with each choice (q, p) of rows alone.

        Returns
        -------
        position_m, chi2, deviation_m : float64 (q, 3), (q,), (q,)
            The deviation is the largest of any unknown, the others taken as known.
        """
        states, chi2s, deviations = np.empty((len(choices), 10)), np.empty(len(choices)), np.empty(len(choices))
        rows = (self._ends, self._dt, self._measured)
        at = (self._speed_mps, self.clock, self._covariance, self._index)
        without(rows, *at, choices, found.state, states, chi2s, deviations)
        return states[:, :3], chi2s, deviations

    def look(self, kept: NDArray[np.int64], found: Solution) -> tuple[Floats, float | None, float | None]:
        """Residuals (n,) of all rows at a solution, and horizontal and vertical DOP of those kept."""
        residual_m = np.empty(len(self._dt))
        rows = (self._ends, self._dt, self._measured)
        hdop, vdop = look(rows, self._speed_mps, self.clock, self._index, found.state, kept, residual_m)
        return residual_m, None if hdop < 0 else hdop, None if hdop < 0 or self.level_m is not None else vdop

    def covariance(self, found: Solution) -> Floats | None:
        """Covariance (k, k) of what is solved for; None where it leaves a direction open."""
        out = np.empty((len(self._index),) * 2)
        return out if spread(found.jacobian, out) else None
