"""Small dense algebra for the kernels of a fix: a handful of unknowns, without a call into LAPACK."""

from __future__ import annotations

import numba
import numpy as np

OPEN = 1e-5
"""A column that keeps less than this of its length beside the others leaves its unknown open."""


@numba.njit(cache=True, error_model="numpy")
def factor(a):
    """Cholesky factor of a symmetric matrix in its own lower triangle; False where it is not positive."""
    for i in range(len(a)):
        for j in range(i + 1):
            rest = a[i, j]
            for k in range(j):
                rest -= a[i, k] * a[j, k]
            if j < i:
                a[i, j] = rest / a[j, j]
            elif rest > 0.0:
                a[i, i] = np.sqrt(rest)
            else:
                return False
    return True


@numba.njit(cache=True, error_model="numpy")
def substitute(lower, x):
    """Solve L Lᵀ y = x in place, L (n, n) as `factor` leaves it."""
    for j in range(len(x)):
        for k in range(j):
            x[j] -= lower[j, k] * x[k]
        x[j] /= lower[j, j]
    for j in range(len(x) - 1, -1, -1):
        for k in range(j + 1, len(x)):
            x[j] -= lower[k, j] * x[k]
        x[j] /= lower[j, j]


@numba.njit(cache=True, error_model="numpy")
def whitener(covariance, out):
    """Lower triangular ``out`` with out · covariance · outᵀ = 1; False where the covariance is not positive."""
    n = len(covariance)
    lower = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            lower[i, j] = covariance[i, j]
    if not factor(lower):
        return False
    out[:] = 0.0
    for i in range(n):
        out[i, i] = 1.0
        for k in range(i):
            if lower[i, k] != 0.0:
                for j in range(k + 1):
                    out[i, j] -= lower[i, k] * out[k, j]
        for j in range(i + 1):
            out[i, j] /= lower[i, i]
    return True


@numba.njit(cache=True, error_model="numpy")
def orthogonalise(a, r):
    """Turn the columns of ``a`` (n, k) into orthonormal ones in place; ``r`` (k, k) upper: a = q r (Gram–Schmidt).

    A column that hangs on those before it gets a zero on the diagonal of ``r``, and becomes zero.
    """
    n, count = a.shape
    r[:] = 0.0
    for j in range(count):
        before = 0.0
        for i in range(n):
            before += a[i, j] ** 2
        for k in range(j):
            along = 0.0
            for i in range(n):
                along += a[i, k] * a[i, j]
            r[k, j] = along
            for i in range(n):
                a[i, j] -= along * a[i, k]
        left = 0.0
        for i in range(n):
            left += a[i, j] ** 2
        length = np.sqrt(left) if left > 1e-24 * before else 0.0
        r[j, j] = length
        for i in range(n):
            a[i, j] = a[i, j] / length if length > 0.0 else 0.0


@numba.njit(cache=True, error_model="numpy")
def fit(q, r, b, x):
    """Least-squares solution ``x`` of q r x = b by `orthogonalise`; 0 for columns that hang on others; spoils b."""
    count = len(x)
    for j in range(count):
        along = 0.0
        for i in range(len(b)):
            along += q[i, j] * b[i]
        x[j] = along
        for i in range(len(b)):
            b[i] -= along * q[i, j]
    for j in range(count - 1, -1, -1):
        for k in range(j + 1, count):
            x[j] -= r[j, k] * x[k]
        x[j] = x[j] / r[j, j] if r[j, j] > 0.0 else 0.0


@numba.njit(cache=True, error_model="numpy")
def spread(jacobian, covariance):
    """Covariance (k, k) of unknowns by their whitened Jacobian (m, k); False where it leaves a direction open."""
    m, count = jacobian.shape
    if m < count:
        return False
    q, r, size = np.empty((m, count)), np.empty((count, count)), np.empty(count)
    for j in range(count):
        square = 0.0
        for i in range(m):
            square += jacobian[i, j] ** 2
        size[j] = np.sqrt(square) + 1e-300
        for i in range(m):
            q[i, j] = jacobian[i, j] / size[j]
    orthogonalise(q, r)
    for j in range(count):
        if not r[j, j] >= OPEN:
            return False
    half = np.zeros((count, count))
    for j in range(count):
        for i in range(j, -1, -1):
            rest = 1.0 if i == j else 0.0
            for k in range(i + 1, j + 1):
                rest -= r[i, k] * half[k, j]
            half[i, j] = rest / r[i, i]
    for i in range(count):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, count):
                total += half[i, k] * half[j, k]
            covariance[i, j] = covariance[j, i] = total / (size[i] * size[j])
    return True


@numba.njit(cache=True, error_model="numpy")
def principal(points, dims, centre, axes, width):
    """Principal axes of points (n, 3) in their first ``dims`` coordinates, widest first (Jacobi's rotations).

    Fills ``centre`` (3,), the rows of ``axes`` (3, 3) and ``width`` (3,): the root of the summed squares along each.
    """
    n = len(points)
    scatter = np.zeros((3, 3))
    axes[:] = 0.0
    width[:] = 0.0
    centre[:] = 0.0
    for a in range(dims):
        axes[a, a] = 1.0
        for i in range(n):
            centre[a] += points[i, a] / n
    for a in range(dims):
        for b in range(dims):
            for i in range(n):
                scatter[a, b] += (points[i, a] - centre[a]) * (points[i, b] - centre[b])
    for _ in range(30):
        off = 0.0
        for a in range(dims):
            for b in range(a + 1, dims):
                off += scatter[a, b] ** 2
        if off <= 1e-34 * (scatter[0, 0] + scatter[1, 1] + scatter[2, 2]) ** 2:
            break
        for a in range(dims):
            for b in range(a + 1, dims):
                if scatter[a, b] == 0.0:
                    continue
                angle = 0.5 * np.arctan2(2.0 * scatter[a, b], scatter[a, a] - scatter[b, b])
                cos, sin = np.cos(angle), np.sin(angle)
                for k in range(dims):
                    u, v = scatter[k, a], scatter[k, b]
                    scatter[k, a], scatter[k, b] = cos * u + sin * v, cos * v - sin * u
                for k in range(dims):
                    u, v = scatter[a, k], scatter[b, k]
                    scatter[a, k], scatter[b, k] = cos * u + sin * v, cos * v - sin * u
                for k in range(dims):
                    u, v = axes[a, k], axes[b, k]
                    axes[a, k], axes[b, k] = cos * u + sin * v, cos * v - sin * u
    for a in range(dims):
        width[a] = np.sqrt(max(scatter[a, a], 0.0))
    for a in range(dims):
        for b in range(a + 1, dims):
            if width[b] > width[a]:
                width[a], width[b] = width[b], width[a]
                for k in range(dims):
                    axes[a, k], axes[b, k] = axes[b, k], axes[a, k]
