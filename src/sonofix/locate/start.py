"""Closed-form starting positions: no initial guess is needed anywhere.

Squaring ``ρᵢ − b = |p − aᵢ|`` and moving the squares of the unknowns into one more unknown leaves linear equations
(Bancroft, IEEE Trans. AES 21(1), 1985). Anchors that span only a plane or a line leave the rest of the position to the
ranges' size: two mirror solutions, both returned.
"""

from __future__ import annotations

import numba
import numpy as np

from sonofix.locate.dense import fit, orthogonalise, principal
from sonofix.records import Floats

FLAT = 0.03
"""Anchors count as spanning a direction if they spread in it by this share of their widest spread; below, noise in the
ranges would decide. Gauss–Newton sees the exact places afterwards."""

MOST_STARTS = 3

ROUNDING = 1e-12
"""Of a quadratic's terms: with a known clock its square is 0 but for rounding, and the second root 1e17 m away."""


@numba.njit(cache=True, error_model="numpy")
def roots(square, linear, constant):
    """Real parts of the roots of a quadratic, each once: how many, and them. A root that rounding made is none."""
    if abs(square * constant) <= ROUNDING * linear**2:
        return (1, -constant / linear, 0.0) if linear != 0.0 else (0, 0.0, 0.0)
    inside = linear**2 - 4.0 * square * constant
    if inside <= 0.0:
        return 1, -linear / (2.0 * square), 0.0
    larger = -0.5 * (linear + (np.sqrt(inside) if linear >= 0.0 else -np.sqrt(inside)))
    return 2, larger / square, constant / larger


@numba.njit(cache=True, error_model="numpy")
def begin(anchors, range_m, flat, level_m, clock, out):
    """Fill rows of ``out`` (MOST_STARTS, 4) as `starts` describes; return how many.

    ``flat``: the level is known, as ``level_m``, which is not looked at otherwise.
    """
    n, dims = len(range_m), 2 if flat else 3
    centre, axes, width = np.empty(3), np.empty((3, 3)), np.empty(3)
    principal(anchors, dims, centre, axes, width)
    rank = 0
    for a in range(dims):
        if n > 1 and width[a] > FLAT * max(width[0], 1e-9):
            rank += 1
    base = 0.0
    if clock:
        base = range_m[0]
        for i in range(n):
            base = min(base, range_m[i])
    unknowns = rank + (1 if clock else 0)
    # 2 u·aᵢ − 2 b ρᵢ − λ = |aᵢ|² + hᵢ² − ρᵢ²  with  λ = |u|² + h² − b²
    matrix, known = np.empty((n, unknowns + 1)), np.empty(n)
    for i in range(n):
        rho = range_m[i] - base
        known[i] = -(rho**2)
        if flat:
            # what the anchors spread outside their own plane is kept as part of the known squares
            known[i] += (anchors[i, 2] - level_m) ** 2
        for a in range(rank):
            inside = 0.0
            for k in range(dims):
                inside += (anchors[i, k] - centre[k]) * axes[a, k]
            matrix[i, a] = 2.0 * inside
            known[i] += inside**2
        if clock:
            matrix[i, rank] = -2.0 * rho
        matrix[i, unknowns] = -1.0
    solutions, height = np.zeros((MOST_STARTS, unknowns)), np.zeros(MOST_STARTS)
    r, x = np.empty((unknowns + 1, unknowns + 1)), np.empty(unknowns + 1)
    q, rest, count = np.empty((n, unknowns)), np.empty(n), 0
    for i in range(n):
        rest[i] = known[i]
        for a in range(unknowns):
            q[i, a] = matrix[i, a]
    if n >= unknowns + 1 and (rank < dims or n > unknowns + 1):
        orthogonalise(matrix, r)
        fit(matrix, r, rest, x)
        squares = x[unknowns]
        for a in range(unknowns):
            squares += -(x[a] ** 2) if a < rank else x[a] ** 2
        for side in range(2 if rank < dims else 1):
            for a in range(unknowns):
                solutions[count, a] = x[a]
            height[count] = (1.0 - 2.0 * side) * np.sqrt(max(0.0, squares)) if rank < dims else 0.0
            count += 1
    if rank == dims and n >= unknowns:
        # too few rows for λ of its own: it follows from its definition, a quadratic
        small, w0, w1 = np.empty((unknowns, unknowns)), np.empty(unknowns), np.empty(unknowns)
        orthogonalise(q, small)
        fit(q, small, known, w0)
        for i in range(n):
            rest[i] = 1.0
        fit(q, small, rest, w1)
        square, linear, constant = 0.0, -1.0, 0.0
        for a in range(unknowns):
            sign = 1.0 if a < rank else -1.0
            square += sign * w1[a] ** 2
            linear += sign * 2.0 * w0[a] * w1[a]
            constant += sign * w0[a] ** 2
        several, first, second = roots(square, linear, constant)
        for k in range(several):
            root = first if k == 0 else second
            if np.isfinite(root):
                for a in range(unknowns):
                    solutions[count, a] = w0[a] + root * w1[a]
                count += 1
    for i in range(count):
        for k in range(3):
            out[i, k] = centre[k]
            for a in range(rank):
                out[i, k] += solutions[i, a] * axes[a, k]
            if rank < dims:
                out[i, k] += height[i] * axes[rank, k]
        if flat:
            out[i, 2] = level_m
        out[i, 3] = base + (solutions[i, rank] if clock else 0.0)
    return count


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
        x, y, z, clock; up to three, mirror solutions beside each other; empty where the rows are too few.
    """
    out = np.empty((MOST_STARTS, 4))
    count = begin(anchors_m, range_m, level_m is not None, float(level_m or 0.0), clock, out)
    return list(out[:count])
