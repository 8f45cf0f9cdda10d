"""Rows of one vehicle in one epoch, ready to be solved in any selection."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import ALONE, CLOCK, PITCH, PITCH_RATE, ROLL, ROLL_RATE, SAME_ARM_M, SIZE, YAW, Links, expected
from sonofix.locate.curved import least_biases
from sonofix.locate.dense import spread, whitener
from sonofix.locate.integrity import RISK, levels, threshold
from sonofix.locate.noise import CLOCK_SPEED_SD, row_noise
from sonofix.locate.search import MOST, rivals, search, without
from sonofix.locate.solve import beforehand, misfit
from sonofix.ranging import flights_m
from sonofix.records import Floats, RangeEpoch

UNKNOWN_SPEED_MPS = 1.0
"""Deviation of the velocity (from 0) where no range rates tell of it: a walk."""

ASTRAY_SIGMA = 3.0
"""Deviations that a place may be off by at which the least bias noticed is told."""

ROCKING_RADPS = 2.0
"""How fast a body that tilts rocks, one sigma."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where a descent came to rest: state (ALONE,) as `solve.misfit` has it, whitened χ² and Jacobian (m, k)."""

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
        return float(self.state[CLOCK])


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
    value, derivative = np.empty(n), np.empty((n, ALONE))
    expected(ends, state, dt, c, clock, beforehand(index) > 0, value, derivative)
    for i in range(n):
        residual[i] = measured[i] - value[i]
    chosen = np.empty(len(index), np.int64)
    for j in index:
        if j <= YAW or j in (ROLL, PITCH, CLOCK):
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
    tilt_sd_rad : float
        Deviation of its roll and pitch before anything is heard; 0: it stands upright.
    """

    def __init__(
        self, epoch: RangeEpoch, links: Links, who: int, level_m: float | None, tilt_sd_rad: float = 0.0
    ) -> None:
        self.clock, self.rates = epoch.clock == "common", epoch.range_rate_mps is not None
        self.level_m = level_m
        self._speed_mps = float(epoch.sound_speed_mps)
        self.rows, middle_s, self._dt, self._ends, self.open_arm, self.turns = gather(
            links.ends, who, epoch.time_s, epoch.range_m, self.clock, self._speed_mps
        )
        self.time_s = middle_s if len(self.rows) else epoch.sync_s
        places = [0, 1] + [2] * (level_m is None) + [YAW] * self.turns
        self.needed = len(places) + self.clock
        # ends on one vertical line tell no heading, without which roll and pitch mean nothing
        self.tilts = self.turns and tilt_sd_rad > 0.0
        tilt, rocking = [ROLL, PITCH] * self.tilts, [ROLL_RATE, PITCH_RATE] * (self.tilts and self.rates)
        rates = [4 + p for p in places if self.rates]
        self._index = np.array(places + tilt + rates + rocking + [CLOCK] * self.clock)
        self.range_m = self._measured = epoch.range_m[self.rows]
        if epoch.range_rate_mps is not None:
            self._measured = np.concatenate([self.range_m, epoch.range_rate_mps[self.rows]])
        speed_sd, clock_sd = 0.0 if self.rates else UNKNOWN_SPEED_MPS, CLOCK_SPEED_SD * self._speed_mps * self.clock
        self._speed_sd_mps = float(epoch.sound_speed_sd_mps)
        self._flight_m = flights_m(epoch.range_m, self.clock)[self.rows]
        self._covariance = row_noise(epoch, links, self.rows, self._dt, speed_sd, clock_sd)
        self.swing_rad = 0.0 if self.turns else tilt_sd_rad
        self._before = len(tilt) + len(rocking)
        if self._before:
            m, known = len(self._covariance), [tilt_sd_rad] * len(tilt) + [ROCKING_RADPS] * len(rocking)
            self._measured = np.append(self._measured, np.zeros(len(known)))
            whole = np.zeros((m + len(known),) * 2)
            whole[:m, :m], whole[m:, m:] = self._covariance, np.diag(np.square(known))
            self._covariance = whole

    @property
    def components(self) -> tuple[int, ...]:
        """Which components of `geometry.POSE` are solved for."""
        return tuple(int(j) for j in self._index if j < SIZE)

    def degrees(self, count: int) -> int:
        """Degrees of freedom of so many rows: measurements (ranges, and rates where there are any) less unknowns."""
        return count * (2 if self.rates else 1) + self._before - len(self._index)

    @property
    def reach_up_m(self) -> float:
        """How far above or below the origin of the body the ends are that were heard: the most of it."""
        _, sent_at, heard, heard_at = self._ends
        return float(np.abs(np.where(heard == 0, heard_at[:, 2], sent_at[:, 2])).max(initial=0.0))

    def candidates(self, rows: NDArray[np.int64]) -> list[Solution]:
        """Solutions from all starts, best first, none twice.

        Raises
        ------
        LinAlgError
            If the covariance of rows is not positive.
        """
        kept, covariance = self._kept(rows)
        m, flat = len(covariance), self.level_m is not None
        states, chi2s, jacobians = np.empty((MOST, ALONE)), np.empty(MOST), np.empty((MOST, m, len(self._index)))
        at = (
            kept,
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

    def _kept(self, rows: NDArray[np.int64]) -> tuple[tuple, Floats]:
        """Return a selection's rows as kernels take them, and their covariance."""
        if len(rows) == len(self._dt):
            return (self._ends, self._dt, self._measured), self._covariance
        before = np.arange(len(self._measured) - self._before, len(self._measured))
        both = np.concatenate([rows, rows + len(self._dt), before] if self.rates else [rows, before])
        ends = tuple(part[rows] for part in self._ends)
        return (ends, self._dt[rows], self._measured[both]), np.ascontiguousarray(self._covariance[both[:, None], both])

    def without(self, choices: NDArray[np.int64], found: Solution) -> tuple[Floats, Floats]:
        """Solve again from a solution with each choice (q, p) of rows alone.

        Returns
        -------
        position_m, chi2 : float64 (q, 3), (q,)
        """
        states, chi2s = np.empty((len(choices), ALONE)), np.empty(len(choices))
        rows = (self._ends, self._dt, self._measured)
        at = (self._speed_mps, self.clock, self._covariance, self._index)
        without(rows, *at, choices, found.state, states, chi2s)
        return states[:, :3], chi2s

    def descends(self, kept: NDArray[np.int64], found: Solution) -> float:
        """Return how far χ² falls from a solution on: not at all where it is at rest."""
        return found.chi2 - float(self.without(kept[None], found)[1][0])

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

    def bent(self, kept: NDArray[np.int64], found: Solution, covariance: Floats) -> Floats:
        """What the bend of rows over the reach of roll and pitch adds to a covariance (k, k) of a body that tilts.

        A tilt that rows tell poorly swings ends on arcs, which the linear model takes for straight. All unknowns move
        with it as their covariance has it; what rows then show beyond the linear model, h = ½ H ξ² with ξ of unit
        variance and E(h²) = ¾ H², is noise of the rows (Bar-Shalom 2001, section 10.3.2).
        """
        (rows, noise), unknowns = self._kept(kept), self._index
        tilt = np.isin(unknowns, (ROLL, PITCH))
        size, axes = np.linalg.eigh(covariance[np.ix_(tilt, tilt)])
        at = np.zeros((5, len(noise)))
        whiten, plain, jacobian = np.empty_like(noise), np.empty(len(noise)), np.empty_like(found.jacobian)
        whitener(noise, whiten)
        for i, side in enumerate((0.0, 1.0, -1.0, 1.0, -1.0)):
            state, along = found.state.copy(), axes[:, max(i - 1, 0) // 2]
            reach = np.sqrt(size[max(i - 1, 0) // 2])
            state[unknowns] += side * covariance[:, tilt] @ along / reach
            misfit(rows, self._speed_mps, self.clock, whiten, unknowns, state, plain, at[i], jacobian)
        bends = (at[1::2] + at[2::2]) / 2 - at[0]
        moved = covariance @ found.jacobian.T @ bends.T
        # both ways of tilting bend together at worst
        return 6.0 * moved @ moved.T

    def sound_speed(self, kept: NDArray[np.int64], found: Solution) -> tuple[float, float] | None:
        """Sound speed and its deviation by the rows kept, with the epoch's own as the prior; None where that is exact.

        Its error scales all flights alike and is part of their covariance; what the residuals tell of it is the best
        linear unbiased prediction (Henderson, Biometrics 31(2), 1975, eq 3.9), as if it had been one more unknown.
        """
        if not self._speed_sd_mps:
            return None
        (rows, covariance), m = self._kept(kept), len(found.jacobian)
        whiten, plain, miss, jacobian = np.empty((m, m)), np.empty(m), np.empty(m), np.empty_like(found.jacobian)
        whitener(covariance, whiten)
        misfit(rows, self._speed_mps, self.clock, whiten, self._index, found.state, plain, miss, jacobian)
        # a metre a second more than taken makes ranges that much longer than measured
        shown = whiten[:, : len(kept)] @ (-self._flight_m[kept] / self._speed_mps)
        q = np.linalg.qr(jacobian)[0]
        left = shown - q @ (q.T @ shown)
        variance = self._speed_sd_mps**2
        told = max(1.0 - variance * float(left @ left), 0.0)
        return self._speed_mps + variance * float(shown @ miss), self._speed_sd_mps * float(np.sqrt(told))

    def least_biases(self, kept: NDArray[np.int64], found: Solution, missed_rate: float) -> Floats:
        """Biases (p, 2) of the rows kept, as `curved.least_biases` has them, of places where a solution may lie.

        That is where it does, and `ASTRAY_SIGMA` of its deviations to either side along the position's widest axis.
        """
        (rows, covariance), out = self._kept(kept), np.empty((len(kept), 2))
        at = (self._speed_mps, self.clock, covariance, self._index, self.level_m is not None, float(self.level_m or 0))
        spreads, places = self.covariance(found), np.tile(found.state, (3, 1))
        if spreads is not None:
            axes = 2 if self.level_m is not None else 3
            size, along = np.linalg.eigh(spreads[:axes, :axes])
            shift = ASTRAY_SIGMA * spreads[:, :axes] @ along[:, -1] / np.sqrt(size[-1])
            places[1, self._index] += shift
            places[2, self._index] -= shift
        least_biases(rows, *at, places, threshold(self.degrees(len(kept))), missed_rate, out)
        return out

    def protection(
        self, kept: NDArray[np.int64], found: Solution, others: list[Solution], bounds_m: tuple | None
    ) -> tuple[float | None, float | None]:
        """Horizontal and vertical protection level of a solution that passed the test with the rows kept.

        At most one row is taken to be wrong beyond those left out, or as many as those: in range, rate or both. Where
        a selection less one row fits a second place as well (a mirror image), the fault may have chosen between them:
        the level then holds both places. Where it is so loose that ranges bend within its reach, the level holds what
        it allows: there the linear model does not.

        Returns
        -------
        hpl_m, vpl_m : float or None
            None where integrity cannot be judged; vpl_m also where the level is known.
        """
        if len(kept) <= self.needed:
            return None, None
        covariance, left_out = self._kept(kept)[1], len(self._dt) - len(kept)
        whiten = np.empty_like(covariance)
        whitener(covariance, whiten)
        told = np.arange(len(whiten) - self._before)
        groups, faults = told.reshape(-1, len(kept)).T, max(1, left_out)
        hpl, vpl = levels(
            found.jacobian,
            whiten,
            (0, 1),
            2 if self.level_m is None else None,
            groups=groups,
            faults=faults,
            selections=2 ** (left_out + 1) * comb(len(self._dt), left_out),
        )
        if not np.isfinite(hpl):
            return None, None
        room = np.array([[-np.inf] * 3, [np.inf] * 3] if bounds_m is None else bounds_m, float)
        away, whole = np.zeros(4), threshold(self.degrees(len(kept)), RISK)
        at = (self._speed_mps, self.clock, self._covariance, self._index, self.level_m is not None)
        reach = float(np.sqrt(-2 * np.log(RISK)))
        limit = threshold(max(self.degrees(len(kept) - 1), 1), RISK)
        # at the end of this reach the nearest range has bent by the smallest deviation
        near_m = max(float(np.abs(self.range_m[kept] - found.clock_m).min()), 0.1)
        bend_m2 = 2.0 * near_m * float(np.sqrt(covariance.diagonal()[: len(kept)].min()))
        rows = (self._ends, self._dt, self._measured)
        rivals(rows, *at, float(self.level_m or 0.0), kept, found.state, limit, reach, bend_m2, room, away)
        for other in others:
            place = other.position_m
            if other.chi2 <= whole and np.all(place >= room[0] - 0.1) and np.all(place <= room[1] + 0.1):
                apart = np.abs(place - found.position_m)
                away[:2] = np.maximum(away[:2], (np.hypot(apart[0], apart[1]), apart[2]))
        if not np.isfinite(away[0]):
            return None, None
        hpl = max(hpl + float(away[0]), float(away[2]))
        if vpl is None or not np.isfinite(vpl):
            return hpl, None
        return hpl, max(vpl + float(away[1]), float(away[3]))
