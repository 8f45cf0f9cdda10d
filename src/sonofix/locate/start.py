"""Closed-form starting positions: no initial guess is needed anywhere.

Squaring ``ρᵢ − b = |p − aᵢ|`` and moving the squares of the unknowns into one more unknown leaves linear equations
(Bancroft, IEEE Trans. AES 21(1), 1985). Anchors that span only a plane or a line leave the rest of the position to the
ranges' size: two mirror solutions, both returned.
"""

from __future__ import annotations

import numpy as np

from sonofix.records import Floats

FLAT = 0.03
"""Anchors count as spanning a direction if they spread in it by this share of their widest spread; below, noise in the
ranges would decide. Gauss–Newton sees the exact places afterwards."""


def starts(anchors_m: Floats, range_m: Floats, level_m: float | None, clock: bool) -> list[Floats]:
    """Candidates for a position.

    Parameters
    ----------
    anchors_m : float64 (n, 3)
        Fixed ends, already less the lever arm's height.
    range_m : float64 (n,)
    level_m : float or None
        The level the position lies on, where known.
    clock : bool
        Whether all ranges share an unknown offset.

    Returns
    -------
    list of float64 (4,)
        x, y, z, clock; up to four, mirror solutions beside each other; empty where the rows are too few.
    """
    dims = 2 if level_m is not None else 3
    anchors = anchors_m[:, :dims]
    centre = anchors.mean(axis=0)
    _, spread, axes = np.linalg.svd(anchors - centre, full_matrices=True)
    rank = int(np.sum(spread > FLAT * max(spread[0], 1e-9))) if len(anchors) > 1 else 0
    frame = axes[:rank]
    inside = (anchors - centre) @ frame.T
    # what the anchors spread outside their own plane is kept as part of the known squares
    height_m = (anchors_m[:, 2] - level_m) if level_m is not None else np.zeros(len(anchors))
    base = float(range_m.min()) if clock else 0.0
    rho = range_m - base
    # 2 u·aᵢ − 2 b ρᵢ − λ = |aᵢ|² + hᵢ² − ρᵢ²  with  λ = |u|² + h² − b²
    known = np.sum(inside**2, axis=1) + height_m**2 - rho**2
    columns = [2 * inside] + ([-2 * rho[:, None]] if clock else [])
    matrix = np.hstack(columns)
    unknowns = matrix.shape[1]
    out: list[Floats] = []

    def add(u: Floats, b: float, h: float) -> None:
        for sign in (1.0, -1.0) if rank < dims else (1.0,):
            point = centre + u @ frame
            if rank < dims:
                point = point + sign * h * axes[rank]
            full = np.append(point, level_m) if level_m is not None else point
            out.append(np.append(full, b + base))

    def split(solution: Floats) -> tuple[Floats, float]:
        return solution[:rank], float(solution[rank]) if clock else 0.0

    if len(rho) >= unknowns + 1 and (rank < dims or len(rho) > unknowns + 1):
        solution, *_ = np.linalg.lstsq(np.hstack([matrix, -np.ones((len(rho), 1))]), known, rcond=None)
        u, b = split(solution)
        add(u, b, float(np.sqrt(max(0.0, solution[-1] - u @ u + b**2))))
    if rank == dims and len(rho) >= unknowns:
        # too few rows for λ of its own: it follows from its definition, a quadratic
        w0, *_ = np.linalg.lstsq(matrix, known, rcond=None)
        w1, *_ = np.linalg.lstsq(matrix, np.ones(len(rho)), rcond=None)
        (u0, b0), (u1, b1) = split(w0), split(w1)
        roots = np.roots(np.array([u1 @ u1 - b1**2, 2 * (u0 @ u1 - b0 * b1) - 1.0, u0 @ u0 - b0**2], float))
        for root in np.unique(roots.real):
            add(u0 + root * u1, b0 + root * b1, 0.0)
    return out
