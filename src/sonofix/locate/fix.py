"""A fix: closed-form starts, Gauss–Newton from each, mirror solutions told apart, faulty rows left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import POSE, Links, link, row_times
from sonofix.locate.noise import row_noise
from sonofix.locate.solve import Problem, Solution, solve
from sonofix.locate.start import starts
from sonofix.records import Fix, FixStatus, Floats, RangeEpoch
from sonofix.site import Site

FALSE_ALARM = 1e-5
"""Of the χ² test, per epoch."""

AMBIGUOUS_CHI2 = 16.0
"""Two solutions whose χ² differ by less are both believed: odds of e⁸ to one."""


def fix(epoch: RangeEpoch, site: Site, vehicle: str) -> Fix:
    """Solve for one vehicle's position, velocity where range rates are there, heading where microphones allow it.

    Rows whose other end is fixed are used; rows between vehicles are left to the track. Where all ranges share an
    unknown clock it is solved for beside the position, which equals TDoA with its full covariance.

    Parameters
    ----------
    epoch : RangeEpoch
    site : Site
    vehicle : str
        Its id; a known level is ``site.vehicle(vehicle).z_m``.

    Returns
    -------
    Fix
        ``status`` tells an expected failure, with its remedy; nothing is raised for poor geometry.
    """
    who = [v.id for v in site.vehicles].index(vehicle)
    links = link(site, epoch.emitter, epoch.receiver)
    mine = (links.emitter_vehicle == who) & (links.receiver_vehicle < 0)
    mine |= (links.receiver_vehicle == who) & (links.emitter_vehicle < 0)
    rows = np.flatnonzero(mine & np.isfinite(epoch.range_m))
    moments = row_times(links, epoch.time_s, epoch.range_m, epoch.sound_speed_mps)
    time_s = float(np.mean(moments[rows])) if len(rows) else epoch.sync_s
    if epoch.clock == "common" and len(rows):
        # flights are not known, only their differences: the earliest arrival stands in
        time_s = float(np.mean(epoch.time_s[rows]))
    level_m = site.vehicle(vehicle).z_m
    solver = _Rows(epoch, links, rows, time_s, level_m)
    if len(rows) < solver.needed:
        text = f"{len(rows)} of {solver.needed} ranges; bring more beacons in reach or state what is known (z_m)"
        return _failed(epoch, vehicle, time_s, "too-few", text)
    found = solver.candidates(rows)
    if not found:
        return _failed(epoch, vehicle, time_s, "no-convergence", "no position fits; check beacon positions and units")
    kept, found = _exclude(solver, rows, found)
    best = found[0]
    status: FixStatus = "ok"
    remedy = ""
    dof = solver.count(kept) - best.jacobian.shape[1]
    inflation = 1.0
    if dof > 0 and best.chi2 > _chi2_limit(dof):
        status, inflation = "inconsistent", best.chi2 / dof
        remedy = "ranges disagree and no single one explains it; check beacon positions, sound speed and echoes"
    rivals = [s for s in found[1:] if s.chi2 < best.chi2 + AMBIGUOUS_CHI2 * inflation]
    best, mirror, undecided = _tell_apart(best, rivals, site)
    if undecided:
        text = "two mirror positions fit alike; state the room's bounds_m or the vehicle's z_m, or raise one beacon"
        return replace(
            _failed(epoch, vehicle, time_s, "ambiguous", text), mirror_m=None if mirror is None else mirror.pose[:3]
        )
    covariance = _invert(best.jacobian)
    if covariance is None:
        text = "the beacons in reach leave a direction open; spread them off one line or plane"
        return _failed(epoch, vehicle, time_s, "no-convergence", text)
    states = tuple(np.array(POSE)[solver.free]) + (("clock",) if solver.clock else ())
    hdop, vdop = solver.dop(kept, best)
    used = np.zeros(len(epoch), bool)
    used[kept] = True
    residual = np.full(len(epoch), np.nan)
    full = solver.problem(rows)
    residual[rows] = full.range_m - _ranges(full, best)
    position, covariance = _shift_to_origin(best, covariance * inflation, solver)
    return Fix(
        time_s=time_s,
        vehicle=vehicle,
        status=status,
        remedy=remedy,
        states=states,
        position_m=position,
        velocity_mps=best.pose[4:7].copy() if solver.rates else None,
        yaw_rad=float(best.pose[3]) if solver.free[3] else None,
        clock_offset_m=best.clock_m if solver.clock else None,
        covariance=covariance,
        hdop=hdop,
        vdop=vdop,
        hpl_m=None,
        vpl_m=None,
        used=used,
        residual_m=residual,
        mirror_m=None if mirror is None else mirror.pose[:3],
    )


class _Rows:
    """Rows of one vehicle in one epoch, ready to be solved in any selection."""

    def __init__(
        self, epoch: RangeEpoch, links: Links, rows: NDArray[np.int64], time_s: float, level_m: float | None
    ) -> None:
        self.epoch, self.links, self.level_m = epoch, links, level_m
        self.dt = epoch.time_s - time_s
        self.clock = epoch.clock == "common"
        self.rates = epoch.range_rate_mps is not None
        mounted = links.receiver_vehicle[rows] >= 0
        arms = np.where(mounted[:, None], links.receiver_point[rows], links.emitter_point[rows])
        flat = arms[:, :2] - arms[:1, :2]
        self.sounding = bool(len(rows)) and not mounted.all()
        self.arm = arms.mean(axis=0) if len(rows) else np.zeros(3)
        turns = bool(len(rows)) and bool(np.any(np.hypot(flat[:, 0], flat[:, 1]) > 1e-3))
        self.free = np.array([True, True, level_m is None, turns] + [False] * 4)
        if self.rates:
            self.free[4:] = [True, True, level_m is None, turns]
        # two ends on one body fix the heading; a lone one off the axis leaves its origin open by its arm
        self.open_arm_m = 0.0 if turns else float(np.hypot(*self.arm[:2]))
        self.needed = int(self.free[:4].sum()) + self.clock
        here = links
        self.as_first = Links(
            np.where(here.emitter_vehicle >= 0, 0, -1),
            here.emitter_point - self._unseen(here.emitter_vehicle),
            np.where(here.receiver_vehicle >= 0, 0, -1),
            here.receiver_point - self._unseen(here.receiver_vehicle),
            here.emitter_sd_m,
        )

    def _unseen(self, vehicle: NDArray[np.int64]) -> Floats:
        """Part of mounted lever arms that no heading places: solved for at the arm's own point."""
        arm = np.array([self.arm[0], self.arm[1], 0.0]) if self.open_arm_m else np.zeros(3)
        return np.where((vehicle >= 0)[:, None], arm, 0.0)

    def count(self, rows: NDArray[np.int64]) -> int:
        return len(rows) * (2 if self.rates else 1)

    def problem(self, rows: NDArray[np.int64]) -> Problem:
        epoch, dt = self.epoch, self.dt[rows]
        covariance, rate_variance = row_noise(epoch, self.links, rows, dt)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        rate = None
        if epoch.range_rate_mps is not None and rate_variance is not None:
            rate = epoch.range_rate_mps[rows]
            n = len(rows)
            both = np.zeros((2 * n, 2 * n))
            both[:n, :n] = whiten
            both[n:, n:] = np.diag(rate_variance**-0.5)
            whiten = both
        return Problem(
            self.as_first.rows(rows),
            epoch.range_m[rows],
            rate,
            dt,
            whiten,
            self.free,
            self.clock,
            epoch.sound_speed_mps,
        )

    def candidates(self, rows: NDArray[np.int64]) -> list[Solution]:
        """Solutions from all starts, best first, none twice."""
        links = self.as_first.rows(rows)
        fixed_ends = np.where((links.emitter_vehicle < 0)[:, None], links.emitter_point, links.receiver_point)
        arms = np.where((links.emitter_vehicle < 0)[:, None], links.receiver_point, links.emitter_point)
        anchors = fixed_ends - arms * np.array([0.0, 0.0, 1.0])
        problem = self.problem(rows)
        out: list[Solution] = []
        for begin in starts(anchors, problem.range_m, self.level_m, self.clock):
            for yaw in (0.0, 1.6, 3.1, -1.6) if self.free[3] else (0.0,):
                pose = np.zeros(8)
                pose[:3], pose[3] = begin[:3], yaw
                try:
                    found = solve(problem, pose, float(begin[3]))
                except np.linalg.LinAlgError:
                    continue
                if found.converged and not any(np.linalg.norm(found.pose[:3] - s.pose[:3]) < 0.01 for s in out):
                    out.append(found)
        return sorted(out, key=lambda s: s.chi2)

    def dop(self, rows: NDArray[np.int64], solution: Solution) -> tuple[float | None, float | None]:
        """Horizontal and vertical dilution of precision: of ranges alone, unit variances."""
        problem = self.problem(rows)
        free = self.free.copy()
        free[4:] = False
        plain = replace(problem, rate_mps=None, whiten=np.eye(len(rows)), free=free)
        covariance = _invert(solve(plain, solution.pose, solution.clock_m, iterations=1).jacobian)
        if covariance is None:
            return None, None
        vertical = float(np.sqrt(covariance[2, 2])) if free[2] else None
        return float(np.sqrt(covariance[0, 0] + covariance[1, 1])), vertical


def _exclude(solver: _Rows, rows: NDArray[np.int64], found: list[Solution]) -> tuple[NDArray[np.int64], list[Solution]]:
    """Leave out rows one by one while the χ² test fails and doing so mends most of it; one row stays to check by."""
    while True:
        best = found[0]
        dof = solver.count(rows) - best.jacobian.shape[1]
        if dof <= 0 or best.chi2 <= _chi2_limit(dof) or len(rows) <= solver.needed + 1:
            return rows, found
        trials: list[tuple[float, NDArray[np.int64]]] = []
        for i in range(len(rows)):
            fewer = np.delete(rows, i)
            try:
                again = solve(solver.problem(fewer), best.pose, best.clock_m)
            except np.linalg.LinAlgError:
                continue
            trials.append((again.chi2 / max(1, solver.count(fewer) - best.jacobian.shape[1]), fewer))
        if not trials:
            return rows, found
        mended, fewer = min(trials, key=lambda trial: trial[0])
        again = solver.candidates(fewer)
        if mended > 0.5 * best.chi2 / dof or not again:
            return rows, found
        rows, found = fewer, again


def _tell_apart(best: Solution, rivals: list[Solution], site: Site) -> tuple[Solution, Solution | None, bool]:
    """Choose among solutions that fit alike by the room's bounds; say so where that does not decide."""
    if not rivals:
        return best, None, False
    if site.bounds_m is None:
        return best, rivals[0], True
    low, high = np.array(site.bounds_m)
    inside = [s for s in [best, *rivals] if np.all(s.pose[:3] >= low - 0.1) and np.all(s.pose[:3] <= high + 0.1)]
    if len(inside) != 1:
        return best, rivals[0], True
    others = [s for s in [best, *rivals] if s is not inside[0]]
    return inside[0], others[0], False


def _shift_to_origin(best: Solution, covariance: Floats, solver: _Rows) -> tuple[Floats, Floats]:
    """Position of the vehicle's origin where a lone lever arm leaves the heading open.

    The arm becomes uncertainty, unless the vehicle drives, when it is taken to look where it goes.
    """
    position = best.pose[:3].copy()
    if not solver.open_arm_m:
        return position, covariance
    speed = float(np.hypot(best.pose[4], best.pose[5]))
    covariance = covariance.copy()
    if speed > 0.1:
        along = best.pose[4:6] / speed
        position[:2] -= solver.arm[0] * along + solver.arm[1] * np.array([-along[1], along[0]])
        covariance[:2, :2] += np.eye(2) * (0.1 * solver.open_arm_m) ** 2
    else:
        covariance[:2, :2] += np.eye(2) * solver.open_arm_m**2
    return position, covariance


def _ranges(problem: Problem, solution: Solution) -> Floats:
    once = solve(problem, solution.pose, solution.clock_m, iterations=0)
    return problem.range_m - once.residual_m


def _invert(jacobian: Floats) -> Floats | None:
    """Covariance of a whitened Jacobian, None where it leaves a direction open."""
    size = np.sqrt(np.sum(jacobian**2, axis=0)) + 1e-300
    q, r = np.linalg.qr(jacobian / size)
    del q
    if len(r) < jacobian.shape[1] or np.min(np.abs(np.diag(r))) < 1e-6:
        return None
    half = np.linalg.solve(r, np.eye(len(r)))
    return half @ half.T / np.outer(size, size)


def _chi2_limit(dof: int) -> float:
    from scipy.special import chdtri

    return float(chdtri(dof, FALSE_ALARM))


def _failed(epoch: RangeEpoch, vehicle: str, time_s: float, status: FixStatus, remedy: str) -> Fix:
    nothing = np.zeros(len(epoch), bool)
    return Fix(
        time_s,
        vehicle,
        status,
        remedy,
        (),
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        nothing,
        np.full(len(epoch), np.nan),
    )
