"""Gauss–Newton: where it comes to rest, against SciPy's least squares and a plain twin; what it returns there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from locate import plain
from locate.made_epochs import HALL, SPEED, Drive, make_epoch, make_site
from sonofix.geometry import ALONE, CLOCK, link
from sonofix.locate.dense import whitener
from sonofix.locate.solve import SAME, descend
from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site

POSITION = np.array([0, 1, 2])
MOVING = np.array([0, 1, 2, 4, 5, 6])
DRIVE = Drive((3.0, 2.0, 1.0), (1.0, -0.5, 0.1))


def problem_of(site: Site, epoch: RangeEpoch, index: Floats) -> plain.Problem:
    variance, measured = np.diag(epoch.covariance_m2), epoch.range_m
    if epoch.range_rate_mps is not None:
        variance = np.concatenate([variance, epoch.range_rate_sd_mps**2])
        measured = np.concatenate([measured, epoch.range_rate_mps])
    index = np.append(index, CLOCK) if epoch.clock == "common" else index
    links = link(site, epoch.emitter, epoch.receiver)
    return plain.Problem(links, measured, epoch.time_s, np.diag(variance), index)


def solve(
    problem: plain.Problem, begin: Floats, iterations: int = 50, known: Floats | None = None
) -> tuple[Floats, float, bool, Floats, Floats]:
    """The kernel's state, χ² and whether it rests, plain misfit and whitened Jacobian."""
    m, k = len(problem.measured), len(problem.index)
    whiten, plain_miss, miss, jacobian = np.empty((m, m)), np.empty(m), np.empty(m), np.empty((m, k))
    assert whitener(problem.covariance, whiten)
    state = np.array(begin, float)
    known = np.empty((0, ALONE)) if known is None else known
    at = (problem.rows, SPEED, problem.clock, whiten, problem.index, known, iterations)
    chi2, rests = descend(*at, state, plain_miss, miss, jacobian)
    assert chi2 == pytest.approx(miss @ miss, rel=1e-12)
    return state, chi2, rests, plain_miss, jacobian


def start(*place: float, clock_m: float = 0.0) -> Floats:
    return np.array([*place, *np.zeros(9), clock_m, 0.0])


@pytest.mark.parametrize("rate_sd_mps", [None, 0.05])
@pytest.mark.parametrize("clock_m", [None, 25.0])
def test_rests_where_scipy_and_the_plain_twin_do(
    rate_sd_mps: float | None, clock_m: float | None, rng: np.random.Generator
) -> None:
    site = make_site(HALL)
    times = rng.uniform(0.0, 0.05, len(HALL))
    epoch = make_epoch(site, DRIVE, times, rate_sd_mps=rate_sd_mps, clock_m=clock_m, rng=rng)
    problem = problem_of(site, epoch, MOVING if rate_sd_mps else POSITION)
    begin = start(5.0, 4.0, 1.5, clock_m=20.0 if problem.clock else 0.0)

    def miss(unknowns: Floats) -> Floats:
        state = begin.copy()
        state[problem.index] = unknowns
        return plain.misfit(problem, state)[0]

    found, chi2, rests, *_ = solve(problem, begin)
    peer = least_squares(miss, begin[problem.index], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    # it stops at a step of 1e-4 sigma, which here is 1e-6 m and 1e-5 m/s, well before the quadratic end
    np.testing.assert_allclose(found[problem.index], peer.x, atol=1e-6)
    assert rests
    assert chi2 == pytest.approx(2 * peer.cost, rel=1e-6)
    twin, twin_chi2, twin_rests = plain.solve(problem, begin)
    # the same steps: only rounding is left between them
    np.testing.assert_allclose(found, twin, atol=1e-10)
    assert chi2 == pytest.approx(twin_chi2, rel=1e-9)
    assert twin_rests


def test_jacobian_is_the_derivative_of_what_is_expected() -> None:
    site = make_site(HALL)
    problem = problem_of(site, make_epoch(site, DRIVE, 0.01, rate_sd_mps=0.05, clock_m=3.0), MOVING)
    found, _, _, _, jacobian = solve(problem, start(4.0, 3.0, 1.0))
    for i, j in enumerate(problem.index):
        step = np.zeros(ALONE)
        step[j] = 1e-5
        slope = (plain.misfit(problem, found + step)[0] - plain.misfit(problem, found - step)[0]) / 2e-5
        np.testing.assert_allclose(jacobian[:, i], -slope, atol=1e-5)
    assert jacobian.shape == (2 * len(HALL), len(problem.index))


def test_components_that_are_not_asked_for_stay_as_they_were_given() -> None:
    site = make_site(HALL, level_m=1.0)
    begin = np.array([5.0, 4.0, 1.0, 0.3, 0.2, -0.1, 0.05, 0.6, *np.zeros(6)])
    found, *_ = solve(problem_of(site, make_epoch(site, DRIVE), np.array([0, 1])), begin)
    np.testing.assert_array_equal(found[2:], begin[2:])
    np.testing.assert_allclose(found[:2], DRIVE.position_m[:2], atol=1e-7)


def test_no_iterations_only_evaluate() -> None:
    site = make_site(HALL)
    epoch = make_epoch(site, DRIVE)
    begin = start(5.0, 4.0, 1.0)
    found, _, rests, miss, _ = solve(problem_of(site, epoch, POSITION), begin, iterations=0)
    np.testing.assert_array_equal(found, begin)
    np.testing.assert_allclose(miss, epoch.range_m - np.linalg.norm(np.array(HALL) - begin[:3], axis=1), atol=1e-12)
    assert not rests


def test_a_start_far_outside_the_room_still_comes_home() -> None:
    site = make_site(HALL)
    found, _, rests, *_ = solve(problem_of(site, make_epoch(site, DRIVE), POSITION), start(60.0, -40.0, 20.0))
    assert rests
    assert np.linalg.norm(found[:3] - DRIVE.position_m) < 1e-6


def test_a_descent_to_a_place_already_known_ends_there() -> None:
    site = make_site(HALL)
    problem = problem_of(site, make_epoch(site, DRIVE), POSITION)
    home, *_ = solve(problem, start(4.0, 3.0, 1.0))
    elsewhere = home + np.eye(ALONE)[0]
    found, _, rests, *_ = solve(problem, start(60.0, -40.0, 20.0), known=np.array([elsewhere, home]))
    assert not rests
    assert np.linalg.norm(found[:3] - home[:3]) < SAME
    assert solve(problem, start(60.0, -40.0, 20.0), known=elsewhere[None])[2]


def test_correlated_rows_weigh_as_their_covariance_says(rng: np.random.Generator) -> None:
    # an error that all rows share is what an unknown clock with that prior would be: generalised least squares by hand
    site = make_site(HALL)
    epoch = make_epoch(site, DRIVE, rng=rng)
    shared = 1e-4 * np.eye(len(HALL)) + 0.3**2
    problem = replace(problem_of(site, epoch, POSITION), covariance=shared)
    found, *_ = solve(problem, start(4.0, 3.0, 1.0))
    place = np.array([4.0, 3.0, 1.0])
    for _ in range(30):
        gap = place - np.array(HALL)
        unit = gap / np.linalg.norm(gap, axis=1)[:, None]
        weighted = unit.T @ np.linalg.inv(shared)
        place = place + np.linalg.solve(weighted @ unit, weighted @ (epoch.range_m - np.linalg.norm(gap, axis=1)))
    np.testing.assert_allclose(found[:3], place, atol=1e-7)


@pytest.mark.parametrize("rows", [np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]] * 3)], ids=["one row", "one point"])
def test_directions_that_no_row_tells_of_do_no_harm(rows: Floats) -> None:
    site = make_site(rows)
    problem = problem_of(site, make_epoch(site, Drive((3.0, 2.0, 1.0))), POSITION)
    found, chi2, *_ = solve(problem, start(2.0, 2.0, 0.5))
    assert np.isfinite(found).all()
    assert chi2 < 1e-6
