"""The triangle of three robots: eqs 1 and 2, both solutions, which of them, and triangles that are none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from sonofix.locate.triangle import chosen_by_motion, measured_base, triangle
from sonofix.records import Floats

ANCHORS_M = np.array([[0.0, 0.0], [20.0, 0.0]])
EXACT, SD_M = np.zeros((4, 4)), 0.02
NOISE_M2 = SD_M**2 * np.eye(2)
OUTSIDE = 1e-6


def ranges(place: Floats, anchors: Floats = ANCHORS_M) -> Floats:
    return np.linalg.norm(place - anchors, axis=-1)


def test_it_is_the_seeds_equations_in_the_first_quadrant() -> None:
    place = np.array([15.0, 11.0])
    d2, d1 = ranges(place)
    d3, theta_2 = 20.0, 0.0
    theta_1 = theta_2 + np.arccos((d3**2 + d2**2 - d1**2) / (2 * d2 * d3))
    found = triangle(ANCHORS_M, EXACT, np.array([d2, d1]), NOISE_M2, side="left")
    assert found.chosen is not None
    np.testing.assert_allclose(found.chosen.position_m, d2 * np.array([np.cos(theta_1), np.sin(theta_1)]), rtol=1e-12)


def test_covariance_and_correlation_are_as_stated(rng: np.random.Generator) -> None:
    """All that is uncertain drawn anew: anchors that share errors, and ranges that do."""
    place, count = np.array([13.0, -9.0]), 4000
    root = 0.02 * rng.standard_normal((4, 4))
    base, noise = root @ root.T + 1e-4 * np.eye(4), np.array([[4.0, 2.0], [2.0, 3.0]]) * 1e-4
    errors = rng.multivariate_normal(np.zeros(4), base, count)
    heard = ranges(place) + rng.multivariate_normal(np.zeros(2), noise, count)
    whole = np.empty(count)
    for k in range(count):
        found = triangle(ANCHORS_M + errors[k].reshape(2, 2), base, heard[k], noise, side="right").chosen
        assert found is not None
        miss = np.concatenate([found.position_m - place, errors[k]])
        joint = np.block([[found.covariance_m2, found.crossed_m2], [found.crossed_m2.T, base]])
        whole[k] = miss @ np.linalg.solve(joint, miss)
    # place and anchors together: six degrees of freedom; a wrong correlation would show
    low, high = chi2.ppf([OUTSIDE / 2, 1 - OUTSIDE / 2], 6 * count) / count
    assert low < whole.mean() < high


@pytest.mark.parametrize("height_m", [0.7, 3.0, 15.0, 40.0])
def test_nees_holds_down_to_where_a_triangle_counts_as_flat(height_m: float, rng: np.random.Generator) -> None:
    place, count = np.array([9.0, height_m]), 2000
    nees, flat = [], 0
    for heard in ranges(place) + SD_M * rng.standard_normal((count, 2)):
        found = triangle(ANCHORS_M, EXACT, heard, NOISE_M2, side="left")
        if found.chosen is None:
            flat += 1
            continue
        miss = found.chosen.position_m - place
        nees.append(miss @ np.linalg.solve(found.chosen.covariance_m2, miss))
    if height_m < 1.0:
        assert flat > count / 2
        return
    assert flat == 0
    low, high = chi2.ppf([OUTSIDE / 2, 1 - OUTSIDE / 2], 2 * count) / count
    assert low < np.mean(nees) < high


def test_without_a_hint_both_are_told_and_neither_chosen() -> None:
    found = triangle(ANCHORS_M, EXACT, ranges(np.array([12.0, 7.0])), NOISE_M2)
    assert (found.status, found.chosen) == ("ambiguous", None)
    assert "half-plane" in found.remedy
    left, right = found.corners
    np.testing.assert_allclose(left.position_m, [12.0, 7.0])
    np.testing.assert_allclose(right.position_m, [12.0, -7.0])
    assert (left.side, right.side) == ("left", "right")


@pytest.mark.parametrize(("sd_m", "status"), [(1.0, "ok"), (5.0, "ambiguous")])
def test_an_expectation_chooses_if_it_is_sure_enough(sd_m: float, status: str) -> None:
    heard = ranges(np.array([12.0, -7.0]))
    found = triangle(ANCHORS_M, EXACT, heard, NOISE_M2, expected=(np.array([12.5, -6.0]), sd_m**2 * np.eye(2)))
    assert found.status == status
    if found.chosen is not None:
        assert found.chosen.side == "right"


def test_an_expectation_is_right_as_often_as_its_odds(rng: np.random.Generator) -> None:
    """At a thousand to one, of places 1.3 m off the line that are expected within 0.5 m."""
    wrong = chosen = 0
    place, expected_sd_m = np.array([10.0, 1.3]), 0.5
    for _ in range(3000):
        expected = place + expected_sd_m * rng.standard_normal(2), expected_sd_m**2 * np.eye(2)
        heard = ranges(place) + 0.002 * rng.standard_normal(2)
        found = triangle(ANCHORS_M, EXACT, heard, 0.002**2 * np.eye(2), expected=expected)
        chosen += found.chosen is not None
        wrong += found.chosen is not None and found.chosen.side != "left"
    assert 2000 < chosen < 3000
    assert wrong <= 12  # at most one in a thousand, by more than four deviations of a Poisson count


def moved(first: Floats, second: Floats, sd_m: float = 0.05) -> list:
    fixes = [triangle(ANCHORS_M, EXACT, ranges(place), NOISE_M2) for place in (first, second)]
    return list(chosen_by_motion(*fixes, second - first, sd_m**2 * np.eye(2)))


def test_motion_tells_the_side_unless_it_goes_along_the_base() -> None:
    for sign in (1.0, -1.0):
        before, after = moved(np.array([12.0, 7.0 * sign]), np.array([13.0, 9.0 * sign]))
        assert before.status == after.status == "ok"
        np.testing.assert_allclose(before.chosen.position_m, [12.0, 7.0 * sign])
        np.testing.assert_allclose(after.chosen.position_m, [13.0, 9.0 * sign])
    before, after = moved(np.array([12.0, 7.0]), np.array([14.0, 7.0]))
    assert before.status == after.status == "ambiguous"


def test_motion_across_the_line_is_followed() -> None:
    before, after = moved(np.array([12.0, 4.0]), np.array([12.0, -3.0]))
    assert before.chosen is not None
    assert after.chosen is not None
    assert (before.chosen.side, after.chosen.side) == ("left", "right")


def test_motion_chooses_nothing_where_there_are_no_solutions() -> None:
    flat = triangle(ANCHORS_M, EXACT, np.array([8.0, 12.0]), NOISE_M2)
    good = triangle(ANCHORS_M, EXACT, ranges(np.array([5.0, 5.0])), NOISE_M2)
    assert chosen_by_motion(flat, good, np.ones(2), np.eye(2)) == (flat, good)


@pytest.mark.parametrize(
    ("heard", "base_sd_m", "status", "words"),
    [
        ([8.0, 12.0], 0.0, "flat", "near the line"),
        ([7.95, 11.95], 0.0, "flat", "near the line"),  # shorter than the base by noise alone
        ([28.0, 8.0], 0.0, "flat", "near the line"),  # beyond R2
        ([7.0, 11.0], 0.0, "no-triangle", "measure them again"),
        ([40.0, 8.0], 0.0, "no-triangle", "measure them again"),
        ([15.0, 15.0], 4.0, "short-base", "move one of them away"),
    ],
)
def test_triangles_that_are_none_are_a_status(heard: list[float], base_sd_m: float, status: str, words: str) -> None:
    found = triangle(ANCHORS_M, base_sd_m**2 * np.eye(4), np.array(heard), NOISE_M2, side="left")
    assert (found.status, found.chosen, found.corners) == (status, None, ())
    assert words in found.remedy


def test_robots_in_one_place_are_no_base() -> None:
    found = triangle(np.ones((2, 2)), EXACT, np.array([3.0, 3.0]), NOISE_M2, side="left")
    assert found.status == "short-base"


def test_a_measured_base_hands_its_errors_on(rng: np.random.Generator) -> None:
    control, spread = np.array([1.0, 2.0]), np.diag([0.01, 0.02]) ** 2
    anchors, covariance = measured_base(control, spread, 20.0, 0.03, 0.7, 0.002)
    np.testing.assert_allclose(anchors[1] - control, 20.0 * np.array([np.cos(0.7), np.sin(0.7)]))
    k = control + rng.multivariate_normal(np.zeros(2), spread, 200_000)
    length, bearing = 20.0 + 0.03 * rng.standard_normal(len(k)), 0.7 + 0.002 * rng.standard_normal(len(k))
    other = k + length[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    drawn = np.cov(np.hstack([k, other]).T)
    # a sample covariance of n draws scatters by √(2/n) of the product of deviations
    size = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_array_less(np.abs(drawn - covariance) / size, 6 * np.sqrt(2 / len(k)))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"anchors_m": np.zeros((3, 2))}, r"anchors_m has shape \(3, 2\); \(2, 2\)"),
        ({"ranges_m": np.array([1.0, np.nan])}, "all must be finite"),
        ({"ranges_m": np.array([0.0, 3.0])}, "both must be above 0"),
        ({"ranges_covariance_m2": np.diag([1.0, -1.0])}, "without negative variances"),
        ({"anchors_covariance_m2": np.triu(np.ones((4, 4)))}, "must be symmetric"),
    ],
)
def test_misuse_is_told(changed: dict, words: str) -> None:
    told = {
        "anchors_m": ANCHORS_M,
        "anchors_covariance_m2": EXACT,
        "ranges_m": np.array([15.0, 15.0]),
        "ranges_covariance_m2": NOISE_M2,
    }
    with pytest.raises(ValueError, match=words):
        triangle(**(told | changed))
