"""What holds for any triangle: exact from exact ranges, moved with the world, its covariance as by differences."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from sonofix.locate.triangle import triangle
from sonofix.records import Floats

place = st.tuples(st.floats(-30, 30), st.floats(-30, 30)).map(np.array)
seeds = st.integers(0, 2**32 - 1)


def drawn(seed: int, sd_m: float = 1e-3) -> tuple[Floats, Floats]:
    """Covariances of anchors (4, 4) and ranges (2, 2), full."""
    rng = np.random.default_rng(seed)
    one, other = sd_m * rng.standard_normal((4, 4)), sd_m * rng.standard_normal((2, 2))
    return one @ one.T, other @ other.T + 1e-2 * sd_m**2 * np.eye(2)


def side_of(anchors: Floats, where: Floats) -> float:
    (x, y), (u, v) = anchors[1] - anchors[0], where - anchors[0]
    return float((x * v - y * u) / np.hypot(x, y))


@given(place, place, place, seeds)
def test_exact_ranges_give_the_exact_place_on_its_side(k: Floats, r2: Floats, r1: Floats, seed: int) -> None:
    anchors = np.stack([k, r2])
    assume(np.linalg.norm(r2 - k) > 1.0)
    (base, noise), beside = drawn(seed), side_of(anchors, r1)
    assume(abs(beside) > 1.0)
    found = triangle(anchors, base, np.linalg.norm(r1 - anchors, axis=1), noise)
    left, right = found.corners
    own, other = (left, right) if beside > 0 else (right, left)
    np.testing.assert_allclose(own.position_m, r1, atol=1e-8)
    # the other is its mirror image, as far from both
    np.testing.assert_allclose(
        np.linalg.norm(other.position_m - anchors, axis=1), np.linalg.norm(r1 - anchors, axis=1), atol=1e-8
    )
    assert abs(side_of(anchors, other.position_m) + beside) < 1e-8


@given(place, place, place, seeds, st.floats(-3, 3), place)
def test_a_triangle_moves_with_the_world(
    k: Floats, r2: Floats, r1: Floats, seed: int, angle: float, shift: Floats
) -> None:
    anchors = np.stack([k, r2])
    assume(np.linalg.norm(r2 - k) > 1.0 and abs(side_of(anchors, r1)) > 1.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    both = np.kron(np.eye(2), turn)
    base, noise = drawn(seed)
    ranges = np.linalg.norm(r1 - anchors, axis=1)
    here = triangle(anchors, base, ranges, noise)
    there = triangle(anchors @ turn.T + shift, both @ base @ both.T, ranges, noise)
    assert here.status == there.status
    for one, other in zip(here.corners, there.corners, strict=True):
        np.testing.assert_allclose(other.position_m, one.position_m @ turn.T + shift, atol=1e-7)
        scale = np.abs(one.covariance_m2).max()
        np.testing.assert_allclose(other.covariance_m2, turn @ one.covariance_m2 @ turn.T, atol=1e-6 * scale)
        np.testing.assert_allclose(other.crossed_m2, turn @ one.crossed_m2 @ both.T, atol=1e-6 * scale)


@given(place, place, place, seeds)
def test_covariance_is_that_of_derivatives_by_differences(k: Floats, r2: Floats, r1: Floats, seed: int) -> None:
    anchors = np.stack([k, r2])
    assume(np.linalg.norm(r2 - k) > 1.0 and abs(side_of(anchors, r1)) > 1.0)
    base, noise = drawn(seed)
    told = np.concatenate([anchors.ravel(), np.linalg.norm(r1 - anchors, axis=1)])

    def solved(values: Floats) -> Floats:
        found = triangle(values[:4].reshape(2, 2), base, values[4:], noise)
        return np.stack([corner.position_m for corner in found.corners])

    step = 1e-5
    jacobian = np.stack([(solved(told + e) - solved(told - e)) / (2 * step) for e in step * np.eye(6)], axis=-1)
    joint = np.block([[base, np.zeros((4, 2))], [np.zeros((2, 4)), noise]])
    for corner, rows in zip(triangle(anchors, base, told[4:], noise).corners, jacobian, strict=True):
        scale = np.abs(corner.covariance_m2).max() + np.abs(base).max()
        np.testing.assert_allclose(corner.covariance_m2, rows @ joint @ rows.T, atol=1e-4 * scale)
        np.testing.assert_allclose(corner.crossed_m2, rows[:, :4] @ base, atol=1e-4 * scale)
