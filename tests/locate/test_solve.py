"""Gauss–Newton: where it comes to rest, against SciPy's least squares; what it returns there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from locate.made_epochs import HALL, SPEED, Drive, make_epoch, make_site
from sonofix.geometry import link, model
from sonofix.locate.solve import Problem, solve
from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site

POSITION = np.array([True, True, True, False, False, False, False, False])
MOVING = np.array([True, True, True, False, True, True, True, False])
DRIVE = Drive((3.0, 2.0, 1.0), (1.0, -0.5, 0.1))


def problem_of(site: Site, epoch: RangeEpoch, free: Floats, time_s: float = 0.0) -> Problem:
    sd = np.sqrt(np.diag(epoch.covariance_m2))
    if epoch.range_rate_sd_mps is not None:
        sd = np.concatenate([sd, epoch.range_rate_sd_mps])
    return Problem(
        link(site, epoch.emitter, epoch.receiver),
        epoch.range_m,
        epoch.range_rate_mps,
        epoch.time_s - time_s,
        np.diag(1 / sd),
        free,
        epoch.clock == "common",
        SPEED,
    )


def whitened(problem: Problem, unknowns: Floats) -> Floats:
    pose = np.zeros(8)
    pose[problem.free] = unknowns[: problem.free.sum()]
    range_m, rate, *_ = model(problem.links, pose[None], problem.dt, SPEED)
    miss = problem.range_m - range_m - (unknowns[-1] if problem.clock else 0.0)
    return problem.whiten @ (miss if problem.rate_mps is None else np.concatenate([miss, problem.rate_mps - rate]))


@pytest.mark.parametrize("rate_sd_mps", [None, 0.05])
@pytest.mark.parametrize("clock_m", [None, 25.0])
def test_rests_where_scipy_does(rate_sd_mps: float | None, clock_m: float | None, rng: np.random.Generator) -> None:
    site = make_site(HALL)
    times = rng.uniform(0.0, 0.05, len(HALL))
    epoch = make_epoch(site, DRIVE, times, rate_sd_mps=rate_sd_mps, clock_m=clock_m, rng=rng)
    problem = problem_of(site, epoch, MOVING if rate_sd_mps else POSITION)
    start = np.zeros(8)
    start[:3] = 5.0, 4.0, 1.5
    found = solve(problem, start, 20.0 if problem.clock else 0.0)
    first = np.append(start[problem.free], 20.0) if problem.clock else start[problem.free]
    peer = least_squares(lambda u: whitened(problem, u), first, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    ours = np.append(found.pose[problem.free], found.clock_m) if problem.clock else found.pose[problem.free]
    # it stops at a step of 1e-4 sigma, which here is 1e-6 m and 1e-5 m/s, well before the quadratic end
    np.testing.assert_allclose(ours, peer.x, atol=1e-6)
    assert found.converged
    assert found.chi2 == pytest.approx(2 * peer.cost, rel=1e-6)


def test_jacobian_is_the_negative_derivative_of_the_whitened_misfit() -> None:
    site = make_site(HALL)
    epoch = make_epoch(site, DRIVE, 0.01, rate_sd_mps=0.05, clock_m=3.0)
    problem = problem_of(site, epoch, MOVING)
    found = solve(problem, np.array([4.0, 3.0, 1.0, 0, 0, 0, 0, 0]), 0.0)
    at = np.append(found.pose[problem.free], found.clock_m)
    for i in range(len(at)):
        step = np.zeros(len(at))
        step[i] = 1e-5
        slope = (whitened(problem, at + step) - whitened(problem, at - step)) / 2e-5
        np.testing.assert_allclose(found.jacobian[:, i], -slope, atol=1e-5)
    assert found.jacobian.shape == (2 * len(HALL), problem.unknowns)


def test_components_that_are_not_free_stay_as_they_were_given() -> None:
    site = make_site(HALL, level_m=1.0)
    epoch = make_epoch(site, DRIVE)
    free = POSITION & ~np.eye(8, dtype=bool)[2]
    begin = np.array([5.0, 4.0, 1.0, 0.3, 0.2, -0.1, 0.05, 0.6])
    found = solve(problem_of(site, epoch, free), begin, 0.0)
    np.testing.assert_array_equal(found.pose[2:], begin[2:])
    np.testing.assert_allclose(found.pose[:2], DRIVE.position_m[:2], atol=1e-7)
    assert found.clock_m == 0.0


def test_no_iterations_only_evaluate() -> None:
    site = make_site(HALL)
    epoch = make_epoch(site, DRIVE)
    begin = np.array([5.0, 4.0, 1.0, 0, 0, 0, 0, 0])
    found = solve(problem_of(site, epoch, POSITION), begin, 0.0, iterations=0)
    np.testing.assert_array_equal(found.pose, begin)
    expected = epoch.range_m - np.linalg.norm(np.array(HALL) - begin[:3], axis=1)
    np.testing.assert_allclose(found.residual_m, expected, atol=1e-12)
    assert not found.converged


def test_a_start_far_outside_the_room_still_comes_home() -> None:
    site = make_site(HALL)
    problem = problem_of(site, make_epoch(site, DRIVE), POSITION)
    found = solve(problem, np.array([60.0, -40.0, 20.0, 0, 0, 0, 0, 0]), 0.0)
    assert found.converged
    assert np.linalg.norm(found.pose[:3] - DRIVE.position_m) < 1e-6


def test_correlated_rows_weigh_as_their_covariance_says(rng: np.random.Generator) -> None:
    # an error that all rows share is what an unknown clock with that prior would be: generalised least squares by hand
    site = make_site(HALL)
    epoch = make_epoch(site, DRIVE, rng=rng)
    shared = 1e-4 * np.eye(len(HALL)) + 0.3**2
    problem = replace(problem_of(site, epoch, POSITION), whiten=np.linalg.inv(np.linalg.cholesky(shared)))
    found = solve(problem, np.array([4.0, 3.0, 1.0, 0, 0, 0, 0, 0]), 0.0)
    place = np.array([4.0, 3.0, 1.0])
    for _ in range(30):
        gap = place - np.array(HALL)
        unit = gap / np.linalg.norm(gap, axis=1)[:, None]
        weighted = unit.T @ np.linalg.inv(shared)
        place = place + np.linalg.solve(weighted @ unit, weighted @ (epoch.range_m - np.linalg.norm(gap, axis=1)))
    np.testing.assert_allclose(found.pose[:3], place, atol=1e-7)
