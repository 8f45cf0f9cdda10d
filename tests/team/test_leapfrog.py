"""Leap-frog: statuses, mirror solutions, the speed of sound's share, and errors as stated."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.records import Floats
from sonofix.team.leapfrog import Formation, begin, leapt, opened, ranged

ROBOTS = ("K", "R2", "R1")
PAIRS = (("K", "R2"), ("K", "R1"), ("R2", "R1"))
START_M = np.array([[0.0, 0.0], [8.0, 0.0], [3.0, 7.0]])
NOISE = 0.002**2 * np.eye(3)


def distances(place_m: Floats) -> Floats:
    return np.array([np.hypot(*(place_m[ROBOTS.index(b)] - place_m[ROBOTS.index(a)])) for a, b in PAIRS])


def begun(scale_sd: float = 0.0, base: tuple[float, float] | None = None, range_m: Floats | None = None) -> Formation:
    rough = START_M + np.array([[0.0, 0.0], [0.5, 0.0], [-0.4, 0.6]])
    heard = distances(START_M) if range_m is None else range_m
    found = begin(ROBOTS, rough, PAIRS, heard, NOISE, scale_sd, base)
    assert found.status == "ok"
    return found.formation


def test_the_start_defines_the_frame_and_ranges_tell_the_rest() -> None:
    formation = begun()
    np.testing.assert_allclose(formation.place_m, START_M, atol=1e-9)
    assert not formation.covariance_m2("K").any()
    # R2 is known across the line by definition, along it as a range is
    np.testing.assert_allclose(formation.covariance_m2("R2"), np.diag([0.002**2, 0.0]), atol=1e-18)
    assert formation.scale_sd == 0.0


def test_a_base_measured_tells_the_speed_of_sound() -> None:
    """k = r / d − 1 with r to 2 mm and d to 1 mm: σ² = (2² + 1²) mm² / d², beside what was known before."""
    heard = 1.002 * distances(START_M)
    formation = begun(scale_sd=0.01, base=(8.0, 0.001), range_m=heard)
    alone = (0.002**2 + 0.001**2) / 8.0**2
    assert formation.scale_sd == pytest.approx(np.sqrt(1 / (1 / alone + 1 / 0.01**2)), rel=1e-3)
    assert formation.scale == pytest.approx(0.002, abs=1e-5)
    np.testing.assert_allclose(formation.place_m, START_M, atol=1e-4)


def test_without_a_base_the_speed_of_sound_stays_as_doubtful_and_its_share_is_told() -> None:
    formation = begun(scale_sd=1e-3)
    assert formation.scale_sd == pytest.approx(1e-3, rel=1e-9)
    # a place errs as if all were drawn to another scale
    np.testing.assert_allclose(formation.by_scale_m("R1"), -START_M[2], atol=1e-6)
    assert not formation.by_scale_m("K").any()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_odometry_tells_the_side(side: float) -> None:
    formation, true = begun(), START_M.copy()
    # six metres to either side of the middle between R2 and R1
    true[0] = [5.5, 3.5] + side * 6.0 * np.array([7.0, 5.0]) / np.hypot(7.0, 5.0)
    leap = leapt(formation, "K", true[0] - START_M[0] + [0.3, -0.4], 0.5**2 * np.eye(2), PAIRS, distances(true), NOISE)
    assert leap.status == "ok"
    np.testing.assert_allclose(leap.formation.place_m, true, atol=1e-3)


def test_odometry_that_cannot_tell_the_side_leaves_the_team_as_it_was() -> None:
    formation, true = begun(), START_M.copy()
    true[0] = [11.0, 7.0]
    leap = leapt(formation, "K", true[0], 10.0**2 * np.eye(2), PAIRS, distances(true), NOISE)
    assert (leap.status, leap.formation) == ("ambiguous", formation)
    assert "side" in leap.remedy


def test_a_robot_that_should_have_stood_is_found_out() -> None:
    formation, true = begun(), START_M.copy()
    true[0], true[1] = [11.0, 7.0], [8.1, 0.05]
    leap = leapt(formation, "K", [11.0, 7.0], 0.5**2 * np.eye(2), PAIRS, distances(true), NOISE)
    assert (leap.status, leap.formation) == ("contradicted", formation)
    assert "moved" in leap.remedy
    again = ranged(formation, PAIRS, distances(START_M) + [0.05, 0.0, 0.0], NOISE)
    assert again.status == "contradicted"


def test_too_few_and_flat_are_told() -> None:
    formation, true = begun(), START_M.copy()
    true[0] = [11.0, 7.0]
    few = leapt(formation, "K", [11.0, 7.0], np.eye(2), PAIRS[:2], distances(true)[:2], NOISE[:2, :2])
    assert few.status == "ok"  # both anchors range it
    few = leapt(formation, "K", [11.0, 7.0], np.eye(2), PAIRS[1:], distances(true)[1:], NOISE[1:, 1:])
    assert few.status == "ambiguous"
    assert "come nearer" in few.remedy
    true[0] = START_M[1] + 0.7 * (START_M[2] - START_M[1])
    flat = leapt(formation, "K", true[0], 0.1**2 * np.eye(2), PAIRS, distances(true), NOISE)
    assert flat.status == "flat"
    assert begin(ROBOTS, START_M, PAIRS[:2], distances(START_M)[:2], NOISE[:2, :2], 0.0).status == "flat"


def test_a_robot_that_nobody_ranges_leaves_the_start_open() -> None:
    four = (*ROBOTS, "R3")
    place = np.vstack([START_M, [9.0, 9.0]])
    pairs, heard = PAIRS * 2, np.tile(distances(START_M), 2)
    assert begin(four, place, pairs, heard, 1e-6 * np.eye(6), 0.0).status == "flat"


def test_dead_reckoning_opens_one_robot_alone() -> None:
    formation = begun()
    after = opened(formation, "R1", np.array([1.0, 2.0]), 0.3**2 * np.eye(2))
    np.testing.assert_allclose(after.place_m[2], START_M[2] + [1.0, 2.0], atol=1e-9)
    np.testing.assert_allclose(after.covariance_m2("R1") - formation.covariance_m2("R1"), 0.09 * np.eye(2))
    np.testing.assert_array_equal(after.covariance[:4, :4], formation.covariance[:4, :4])


def strip(rng: np.random.Generator, scale_sd: float) -> tuple[Floats, Floats, float]:
    """Nine leaps; error of the last to leap, its covariance, error of the scale."""
    true, scale = np.array([[0.0, 0.0], [3.5, 7.0], [7.0, 0.0]]), scale_sd * rng.standard_normal()

    def heard() -> Floats:
        return (1 + scale) * distances(true) + 0.002 * rng.standard_normal(3)

    formation = begin(ROBOTS, true, PAIRS, heard(), NOISE, scale_sd).formation
    for k in range(9):
        who = k % 3
        to = true[(who + 2) % 3] + [3.5, -7.0 if true[(who + 2) % 3][1] > 3.5 else 7.0]
        told, true[who] = to - true[who], to + 0.3 * rng.standard_normal(2)
        leap = leapt(formation, ROBOTS[who], told, 0.3**2 * np.eye(2), PAIRS, heard(), NOISE)
        assert leap.status == "ok"
        formation = leap.formation
    return formation.place_m[2] - true[2], formation.covariance_m2("R1"), formation.scale - scale


@pytest.mark.parametrize("scale_sd", [0.0, 1e-3])
def test_errors_are_as_stated(scale_sd: float) -> None:
    """The mean of n squared errors, chi-squared with two degrees of freedom, scatters by 2 / √n about 2."""
    rng, n = np.random.default_rng(8), 150
    squares = []
    for _ in range(n):
        miss, covariance, _ = strip(rng, scale_sd)
        squares.append(miss @ np.linalg.solve(covariance, miss))
    assert abs(np.mean(squares) - 2.0) < 4 * 2 / np.sqrt(n)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"robots": ("K", "R2")}, "three or more"),
        ({"robots": ("K", "R2", "K")}, "each once"),
        ({"place_m": START_M[:2]}, r"shape \(2, 2\)"),
        ({"place_m": np.zeros((3, 2))}, "one place"),
        ({"scale_sd": -1.0}, "deviations below 0"),
        ({"range_m": np.ones(2)}, "a row a pair"),
        ({"range_m": np.array([8.0, np.nan, 8.0])}, "finite"),
        ({"pairs": (("K", "R2"), ("K", "R9"), ("R2", "R1"))}, "robot R9: the team has K, R2, R1"),
    ],
)
def test_misuse_is_told(change: dict, words: str) -> None:
    given = {
        "robots": ROBOTS,
        "place_m": START_M,
        "pairs": PAIRS,
        "range_m": distances(START_M),
        "covariance_m2": NOISE,
        "scale_sd": 0.0,
    }
    with pytest.raises(ValueError, match=words):
        begin(**(given | change))
