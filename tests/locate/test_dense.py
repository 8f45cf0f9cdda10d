"""Small dense algebra against LAPACK, its plain twin."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.locate.dense import factor, fit, orthogonalise, principal, spread, whitener
from sonofix.records import Floats


def positive(rng: np.random.Generator, n: int) -> Floats:
    half = rng.standard_normal((n, n))
    return half @ half.T + 0.1 * np.eye(n)


@pytest.mark.parametrize("n", [1, 2, 5, 16])
def test_factor_is_the_cholesky_factor(n: int, rng: np.random.Generator) -> None:
    a = positive(rng, n)
    got = a.copy()
    assert factor(got)
    np.testing.assert_allclose(np.tril(got), np.linalg.cholesky(a), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("a", [np.diag([1.0, 0.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.full((2, 2), np.nan)])
def test_what_is_not_positive_is_told(a: Floats) -> None:
    assert not factor(a.copy())
    assert not whitener(a, np.empty((2, 2)))


@pytest.mark.parametrize("n", [1, 3, 12])
def test_whitener_is_the_inverse_cholesky_factor(n: int, rng: np.random.Generator) -> None:
    a, got = positive(rng, n), np.empty((n, n))
    assert whitener(a, got)
    np.testing.assert_allclose(got, np.linalg.inv(np.linalg.cholesky(a)), rtol=1e-9, atol=1e-11)
    blocks, apart = np.kron(np.eye(2), a), np.empty((2 * n, 2 * n))
    assert whitener(blocks, apart)
    np.testing.assert_allclose(apart, np.kron(np.eye(2), got), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(("n", "count"), [(3, 3), (8, 4), (20, 2)])
def test_fit_is_the_least_squares_solution(n: int, count: int, rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((n, count)) * 10.0 ** np.arange(count), rng.standard_normal(n)
    q, r, x = a.copy(), np.empty((count, count)), np.empty(count)
    orthogonalise(q, r)
    np.testing.assert_allclose(q @ r, a, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(q.T @ q, np.eye(count), atol=1e-12)
    np.testing.assert_allclose(np.tril(r, -1), 0.0)
    fit(q, r, b.copy(), x)
    np.testing.assert_allclose(x, np.linalg.lstsq(a, b, rcond=None)[0], rtol=1e-9)


def test_a_column_that_hangs_on_others_takes_no_part(rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((6, 3)), rng.standard_normal(6)
    a[:, 2] = a[:, 0] - 2 * a[:, 1]
    q, r, x = a.copy(), np.empty((3, 3)), np.empty(3)
    orthogonalise(q, r)
    fit(q, r, b.copy(), x)
    np.testing.assert_allclose(x, [*np.linalg.lstsq(a[:, :2], b, rcond=None)[0], 0.0], rtol=1e-9)
    nothing = np.zeros((4, 2))
    orthogonalise(nothing, r[:2, :2].copy())
    assert not nothing.any()


@pytest.mark.parametrize(("m", "count"), [(2, 2), (16, 6)])
def test_spread_is_the_inverse_of_the_normal_matrix(m: int, count: int, rng: np.random.Generator) -> None:
    # columns of very different size, as of metres and radians
    jacobian = rng.standard_normal((m, count)) * 10.0 ** rng.uniform(-3, 3, count)
    covariance = np.empty((count, count))
    assert spread(jacobian, covariance)
    size = np.sqrt(np.sum(jacobian**2, axis=0))
    expected = np.linalg.inv((jacobian / size).T @ (jacobian / size)) / np.outer(size, size)
    np.testing.assert_allclose(covariance, expected, rtol=1e-8)
    np.testing.assert_array_equal(covariance, covariance.T)


def test_an_open_direction_has_no_spread(rng: np.random.Generator) -> None:
    jacobian = rng.standard_normal((8, 3))
    out = np.empty((3, 3))
    assert not spread(jacobian[:2], out)
    jacobian[:, 2] = 0.0
    assert not spread(jacobian, out)
    jacobian[:, 2] = jacobian[:, 0] + 1e-6 * jacobian[:, 1]
    assert not spread(jacobian, out)


@pytest.mark.parametrize("dims", [2, 3])
@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_principal_axes_are_the_singular_vectors(n: int, dims: int, rng: np.random.Generator) -> None:
    points = rng.standard_normal((n, 3)) * [3.0, 10.0, 0.2] + 5.0
    centre, axes, width = np.empty(3), np.empty((3, 3)), np.empty(3)
    principal(points, dims, centre, axes, width)
    flat = points[:, :dims]
    np.testing.assert_allclose(centre[:dims], flat.mean(axis=0), rtol=1e-13)
    values, rows = np.linalg.svd(flat - flat.mean(axis=0))[1:]
    # squared widths come from a matrix product: half the digits are left of one that is 0
    np.testing.assert_allclose(width[: len(values)], values, atol=1e-6)
    np.testing.assert_allclose(axes[:dims, :dims] @ axes[:dims, :dims].T, np.eye(dims), atol=1e-12)
    for a in range(min(n - 1, dims)):
        assert abs(axes[a, :dims] @ rows[a]) == pytest.approx(1.0, abs=1e-9)
