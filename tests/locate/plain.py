"""Plain NumPy twins of the kernels of a fix: the same steps with whole arrays, LAPACK and no thought of speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonofix.geometry import ALONE, CLOCK, Links, model
from sonofix.locate.start import FLAT, ROUNDING
from sonofix.records import Floats

SPEED = 343.0


@dataclass(frozen=True)
class Problem:
    """Rows of one vehicle, index 0 of `links`; `index` says which of a state (ALONE,) are unknown."""

    links: Links
    measured: Floats
    dt: Floats
    covariance: Floats
    index: Floats
    level_m: float | None = None

    @property
    def clock(self) -> bool:
        return CLOCK in self.index

    @property
    def rows(self) -> tuple:
        return self.links.ends, self.dt, self.measured

    @property
    def whiten(self) -> Floats:
        return np.linalg.inv(np.linalg.cholesky(self.covariance))

    def some(self, keep: Floats) -> Problem:
        n = len(self.dt)
        both = np.concatenate([keep, np.asarray(keep) + n]) if len(self.measured) > n else keep
        covariance = self.covariance[np.ix_(both, both)]
        return Problem(self.links.rows(keep), self.measured[both], self.dt[keep], covariance, self.index, self.level_m)


def misfit(problem: Problem, state: Floats) -> tuple[Floats, Floats]:
    """Whitened misfit and Jacobian."""
    range_m, rate, by_range, by_rate = model(problem.links, state[None, :CLOCK], problem.dt, SPEED)
    n = len(problem.dt)
    value, derivative = np.concatenate([range_m, rate]), np.zeros((2 * n, ALONE))
    derivative[:, :CLOCK] = np.concatenate([by_range[:, 0], by_rate[:, 0]])
    if problem.clock:
        value += np.repeat(state[CLOCK:], n)
        derivative[:n, CLOCK] = derivative[n:, CLOCK + 1] = 1.0
    m, whiten = len(problem.measured), problem.whiten
    return whiten @ (problem.measured - value[:m]), whiten @ derivative[:m][:, problem.index]


def solve(problem: Problem, state: Floats) -> tuple[Floats, float, bool]:
    """Gauss–Newton with Levenberg damping by LAPACK: where it comes to rest, χ², and whether it did."""
    state = state.copy()
    miss, jacobian = misfit(problem, state)
    chi2, damping, gained = float(miss @ miss), 1e-6, np.inf
    for _ in range(50):
        size = np.sqrt(np.sum(jacobian**2, axis=0)) + 1e-300
        scaled = jacobian / size
        step = np.linalg.solve(scaled.T @ scaled + damping * np.eye(len(size)), scaled.T @ miss)
        tried = state.copy()
        tried[problem.index] += step / size
        new_miss, new_jacobian = misfit(problem, tried)
        new_chi2 = float(new_miss @ new_miss)
        if new_chi2 > chi2 * (1 + 1e-9) + 1e-12:
            damping = 10 * max(damping, 1e-4)
            if damping > 1e8:
                break
            continue
        gained, state, miss, jacobian, chi2, damping = (
            chi2 - new_chi2,
            tried,
            new_miss,
            new_jacobian,
            new_chi2,
            damping / 10,
        )
        if np.max(np.abs(step)) < 1e-4:
            return state, chi2, True
    return state, chi2, gained < 1e-3


def starts(anchors_m: Floats, range_m: Floats, level_m: float | None, clock: bool) -> list[Floats]:
    """Closed-form starts by LAPACK's least squares and singular values."""
    dims = 2 if level_m is not None else 3
    anchors = anchors_m[:, :dims]
    centre = anchors.mean(axis=0)
    _, width, axes = np.linalg.svd(anchors - centre, full_matrices=True)
    rank = int(np.sum(width > FLAT * max(width[0], 1e-9))) if len(anchors) > 1 else 0
    frame = axes[:rank]
    inside = (anchors - centre) @ frame.T
    height_m = (anchors_m[:, 2] - level_m) if level_m is not None else np.zeros(len(anchors))
    base = float(range_m.min()) if clock else 0.0
    rho = range_m - base
    known = np.sum(inside**2, axis=1) + height_m**2 - rho**2
    matrix = np.hstack([2 * inside] + ([-2 * rho[:, None]] if clock else []))
    sign = np.array([1.0] * rank + [-1.0] * clock)
    out: list[Floats] = []

    def add(w: Floats, heights: list[float]) -> None:
        for height in heights:
            point = centre + w[:rank] @ frame + (height * axes[rank] if rank < dims else 0.0)
            place = np.append(point, level_m) if level_m is not None else point
            out.append(np.append(place, base + (w[rank] if clock else 0.0)))

    n, unknowns = matrix.shape
    if n >= unknowns + 1 and (rank < dims or n > unknowns + 1):
        solution = np.linalg.lstsq(np.hstack([matrix, -np.ones((n, 1))]), known, rcond=None)[0]
        height = float(np.sqrt(max(0.0, solution[-1] - sign @ solution[:-1] ** 2)))
        add(solution[:-1], [height, -height] if rank < dims else [0.0])
    if rank == dims and n >= unknowns:
        w0 = np.linalg.lstsq(matrix, known, rcond=None)[0]
        w1 = np.linalg.lstsq(matrix, np.ones(n), rcond=None)[0]
        terms = np.array([sign @ w1**2, 2 * sign @ (w0 * w1) - 1.0, sign @ w0**2])
        if abs(terms[0] * terms[2]) <= ROUNDING * terms[1] ** 2:
            terms = terms[1:]
        for root in np.unique(np.roots(terms).real):
            add(w0 + root * w1, [0.0])
    return out


def search(problem: Problem) -> list[tuple[Floats, float]]:
    """Solutions from all starts, best first, none twice; every descent runs to its end."""
    links, n = problem.links, len(problem.dt)
    listening = (links.emitter_vehicle < 0)[:, None]
    fixed = np.where(listening, links.emitter_point, links.receiver_point)
    arms = np.where(listening, links.receiver_point, links.emitter_point)
    anchors = fixed - arms * [0.0, 0.0, 1.0]
    turns = 3 in problem.index
    dims = 3 if problem.level_m is None else 2
    found: list[tuple[Floats, float]] = []

    def yaws(begin: Floats) -> list[float]:
        round_ = np.arange(12) * (2 * np.pi / 12)
        whiten = problem.whiten[:n, :n]
        misfits = []
        for yaw in round_:
            pose = np.array([*begin[:3], yaw, *np.zeros(8)])
            miss = problem.measured[:n] - model(links, pose[None], problem.dt, SPEED)[0] - begin[3] * problem.clock
            misfits.append(float(np.sum((whiten @ miss) ** 2)))
        best = int(np.argmin(misfits))
        far = np.abs(np.angle(np.exp(1j * (round_ - round_[best])))) > 1.0
        return [round_[best], round_[int(np.argmin(np.where(far, misfits, np.inf)))]]

    def descend(begin: Floats) -> None:
        for yaw in yaws(begin) if turns else [0.0]:
            state, chi2, rests = solve(problem, np.array([*begin[:3], yaw, *np.zeros(8), begin[3], 0]))
            if rests:
                found.append((state, chi2))

    for begin in starts(anchors, problem.measured[:n], problem.level_m, problem.clock):
        descend(begin)
    if found and turns:
        best = min(found, key=lambda f: f[1])[0]
        flat = anchors[:, :dims]
        normal = np.linalg.svd(flat - flat.mean(axis=0))[2][-1]
        image = best[:3].copy()
        image[:dims] -= 2 * ((best[:dims] - flat.mean(axis=0)) @ normal) * normal
        descend(np.append(image, best[CLOCK]))
    out: list[tuple[Floats, float]] = []
    for state, chi2 in sorted(found, key=lambda f: f[1]):
        turn = [abs(np.angle(np.exp(1j * (state[3] - other[3])))) for other, _ in out]
        gap = [np.linalg.norm(state[:3] - other[:3]) for other, _ in out]
        if not any(g < 0.01 and t < 0.02 for g, t in zip(gap, turn, strict=True)):
            out.append((state, chi2))
    return out
