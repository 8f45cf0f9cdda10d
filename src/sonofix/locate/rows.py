"""Rows of one vehicle in one epoch, ready to be solved in any selection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import Links
from sonofix.locate.noise import row_noise
from sonofix.locate.solve import Problem, Solution, chi2, invert, solve
from sonofix.locate.start import starts
from sonofix.records import Floats, RangeEpoch

UNKNOWN_SPEED_MPS = 1.0
"""Deviation of the velocity (from 0) where no range rates tell of it: a walk."""

CLOCK_SPEED_SD = 1e-4
"""Deviation of a free clock's speed from the recorder's: two cheap crystals."""

YAW_STARTS = 12
"""Headings looked at from each starting place."""


class Rows:
    """Rows of one vehicle in one epoch: what is unknown, and what each selection of rows says of it.

    Parameters
    ----------
    epoch : RangeEpoch
    links : Links
        Of all rows of the epoch.
    rows : int (n,)
        Those of this vehicle.
    time_s : float
        The instant to solve for.
    level_m : float or None
        The vehicle's level, where known.
    """

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
        self.arm = arms.mean(axis=0) if len(rows) else np.zeros(3)
        turns = bool(len(rows)) and bool(np.any(np.hypot(flat[:, 0], flat[:, 1]) > 1e-3))
        self.free = np.array([True, True, level_m is None, turns] + [False] * 4)
        if self.rates:
            self.free[4:] = [True, True, level_m is None, turns]
        # two ends on one body fix the heading; a lone one off the axis leaves its origin open by its arm
        self.open_arm = np.zeros(2) if turns else self.arm[:2]
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
        arm = np.append(self.open_arm, 0.0)
        return np.where((vehicle >= 0)[:, None], arm, 0.0)

    def count(self, rows: NDArray[np.int64]) -> int:
        """Number of measurements in a selection: ranges, and range rates where there are any."""
        return len(rows) * (2 if self.rates else 1)

    def problem(self, rows: NDArray[np.int64]) -> Problem:
        """Return what is to be solved for a selection of rows."""
        epoch, dt = self.epoch, self.dt[rows]
        covariance, rates = row_noise(epoch, self.links, rows, dt, 0.0 if self.rates else UNKNOWN_SPEED_MPS)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        rate = None
        if epoch.range_rate_mps is not None and rates is not None:
            rate = epoch.range_rate_mps[rows]
            if self.clock:
                # a clock of its own runs at its own speed, which all range rates share
                rates = rates + (CLOCK_SPEED_SD * epoch.sound_speed_mps) ** 2
            n = len(rows)
            both = np.zeros((2 * n, 2 * n))
            both[:n, :n] = whiten
            both[n:, n:] = np.linalg.inv(np.linalg.cholesky(rates))
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
        found: list[Solution] = []

        def descend(begin: Floats) -> None:
            for yaw in self._yaws(problem, begin):
                pose = np.zeros(8)
                pose[:3], pose[3] = begin[:3], yaw
                try:
                    solution = solve(problem, pose, float(begin[3]))
                except np.linalg.LinAlgError:
                    continue
                if solution.converged:
                    found.append(solution)

        for begin in starts(anchors, problem.range_m, self.level_m, self.clock):
            descend(begin)
        # anchors nearly in one plane have nearly a mirror solution, which the linear start may have missed, or hit
        if found and self.free[3]:
            best = min(found, key=lambda s: s.chi2)
            descend(np.append(_mirrored(best.pose[:3], anchors, self.level_m is None), best.clock_m))
        out: list[Solution] = []
        for solution in sorted(found, key=lambda s: s.chi2):
            if not any(_alike(solution.pose, other.pose) for other in out):
                out.append(solution)
        return out

    def _yaws(self, problem: Problem, begin: Floats) -> Floats:
        """Headings worth starting from at a place: the best of a round, and its best rival half a turn or so away."""
        if not self.free[3]:
            return np.zeros(1)
        round_ = np.arange(YAW_STARTS) * (2 * np.pi / YAW_STARTS)
        poses = np.zeros((YAW_STARTS, 8))
        poses[:, :3], poses[:, 3] = begin[:3], round_
        misfit = np.array([chi2(problem, pose, float(begin[3])) for pose in poses])
        best = int(np.argmin(misfit))
        far = np.abs(np.angle(np.exp(1j * (round_ - round_[best])))) > 1.0
        rival = int(np.argmin(np.where(far, misfit, np.inf)))
        return round_[[best, rival]]

    def dop(self, rows: NDArray[np.int64], solution: Solution) -> tuple[float | None, float | None]:
        """Horizontal and vertical dilution of precision: of ranges alone, unit variances."""
        problem = self.problem(rows)
        free = self.free.copy()
        free[4:] = False
        plain = replace(problem, rate_mps=None, whiten=np.eye(len(rows)), free=free)
        covariance = invert(solve(plain, solution.pose, solution.clock_m, iterations=1).jacobian)
        if covariance is None:
            return None, None
        vertical = float(np.sqrt(covariance[2, 2])) if free[2] else None
        return float(np.sqrt(covariance[0, 0] + covariance[1, 1])), vertical


def _mirrored(position: Floats, anchors: Floats, in_space: bool) -> Floats:
    """Mirror image of a place in the plane (on a level: the line) that anchors are nearest to."""
    dims = 3 if in_space else 2
    centre = anchors[:, :dims].mean(axis=0)
    _, _, axes = np.linalg.svd(anchors[:, :dims] - centre)
    image = position.copy()
    image[:dims] -= 2 * ((position[:dims] - centre) @ axes[-1]) * axes[-1]
    return image


def _alike(a: Floats, b: Floats) -> bool:
    """Whether two poses are one: within 1 cm and 1°."""
    return bool(np.linalg.norm(a[:3] - b[:3]) < 0.01 and abs(np.angle(np.exp(1j * (a[3] - b[3])))) < 0.02)
