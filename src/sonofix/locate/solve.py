"""Gauss–Newton with Levenberg damping on ranges and range rates, each at its own moment (the first seed's eq 7)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import Links, model
from sonofix.records import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """What is to be solved: rows of one vehicle (index 0 of ``links``) and which components are unknown.

    ``free`` (8,) marks the components of `geometry.POSE` solved for; ``clock`` whether all ranges share an offset.
    ``dt`` (n,) is when each row was heard from the reference instant; ``whiten`` (m, m) turns the stacked misfit of
    ranges and, where ``rate_mps`` is given, rates into unit noise.
    """

    links: Links
    range_m: Floats
    rate_mps: Floats | None
    dt: Floats
    whiten: Floats
    free: NDArray[np.bool_]
    clock: bool
    sound_speed_mps: float

    @property
    def unknowns(self) -> int:
        """Number of quantities solved for."""
        return int(self.free.sum()) + self.clock


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where Gauss–Newton came to rest: ``pose`` (8,), clock in m, whitened χ² and Jacobian, plain range residuals."""

    pose: Floats
    clock_m: float
    chi2: float
    jacobian: Floats
    residual_m: Floats
    converged: bool


def _misfit(problem: Problem, pose: Floats, clock_m: float) -> tuple[Floats, Floats, Floats]:
    range_m, rate, by_range, by_rate = model(problem.links, pose[None], problem.dt, problem.sound_speed_mps)
    miss = problem.range_m - range_m - clock_m
    derivative = by_range[:, 0][:, problem.free]
    if problem.clock:
        derivative = np.hstack([derivative, np.ones((len(miss), 1))])
    stacked = miss
    if problem.rate_mps is not None:
        rates = by_rate[:, 0][:, problem.free]
        if problem.clock:
            rates = np.hstack([rates, np.zeros((len(miss), 1))])
        stacked = np.concatenate([miss, problem.rate_mps - rate])
        derivative = np.vstack([derivative, rates])
    return problem.whiten @ stacked, problem.whiten @ derivative, miss


def solve(problem: Problem, pose: Floats, clock_m: float, iterations: int = 50) -> Solution:
    """Descend from a start until the step is far below the deviation of what is solved for."""
    miss, jacobian, residual = _misfit(problem, pose, clock_m)
    chi2 = float(miss @ miss)
    damping, converged, gained = 1e-6, False, np.inf
    for _ in range(iterations):
        size = np.sqrt(np.sum(jacobian**2, axis=0)) + 1e-300
        scaled = jacobian / size
        normal = scaled.T @ scaled
        step = np.linalg.solve(normal + damping * np.eye(len(normal)), scaled.T @ miss) / size
        tried, tried_clock = pose.copy(), clock_m
        tried[problem.free] += step[: int(problem.free.sum())]
        if problem.clock:
            tried_clock += float(step[-1])
        new_miss, new_jacobian, new_residual = _misfit(problem, tried, tried_clock)
        new_chi2 = float(new_miss @ new_miss)
        if new_chi2 > chi2 * (1 + 1e-9) + 1e-12:
            damping = 10 * max(damping, 1e-4)
            if damping > 1e8:
                break
            continue
        small = float(np.max(np.abs(step) * size)) < 1e-4
        pose, clock_m = tried, tried_clock
        miss, jacobian, residual = new_miss, new_jacobian, new_residual
        gained = chi2 - new_chi2
        chi2, damping = new_chi2, damping / 10
        if small:
            converged = True
            break
    # beside a beacon the range has a kink: steps zigzag over it long after nothing is gained any more
    return Solution(pose, clock_m, chi2, jacobian, residual, converged or gained < 1e-3)


def chi2(problem: Problem, pose: Floats, clock_m: float) -> float:
    """Whitened misfit of ranges alone at a pose."""
    n = len(problem.range_m)
    plain = replace(problem, rate_mps=None, whiten=problem.whiten[:n, :n])
    miss = _misfit(plain, pose, clock_m)[0]
    return float(miss @ miss)


def invert(jacobian: Floats) -> Floats | None:
    """Covariance of a whitened Jacobian, None where it leaves a direction open."""
    size = np.sqrt(np.sum(jacobian**2, axis=0)) + 1e-300
    q, r = np.linalg.qr(jacobian / size)
    del q
    if len(r) < jacobian.shape[1] or np.min(np.abs(np.diag(r))) < 1e-5:
        return None
    half = np.linalg.solve(r, np.eye(len(r)))
    return half @ half.T / np.outer(size, size)
