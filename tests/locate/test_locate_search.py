"""The search for all solutions, and the trials without some rows, against their plain twins."""

from __future__ import annotations

import numpy as np
import pytest

from locate import plain
from locate.made_epochs import BOUNDS, HALL, SPEED, Drive, make_epoch, make_site, shifted
from sonofix.geometry import ALONE, CLOCK, expected, link
from sonofix.locate.noise import fill_noise
from sonofix.locate.rows import gather, look
from sonofix.locate.search import MOST, search, without
from sonofix.locate.start import starts
from sonofix.records import Floats

CEILING = tuple((x, y, 3.2) for x, y, _ in HALL)
LINE = tuple((float(x), 0.1, 2.5) for x in range(0, 10, 2))
TWO_ARMS = ((0.35, 0.1, 0.5), (-0.3, -0.2, 0.5))

# name: fixed ends, lever arms, known level, sounding, unknown clock, range rates
CASES = {
    "space": (HALL, ((0.0, 0.0, 0.0),), None, False, None, None),
    "level, rates": (HALL, ((0.0, 0.0, 0.4),), 1.1, False, None, 0.05),
    "ceiling, mirrored": (CEILING, ((0.0, 0.0, 0.0),), None, False, None, 0.05),
    "line on a level": (LINE, ((0.0, 0.0, 0.0),), 1.1, False, None, None),
    "space, clock": (HALL, ((0.0, 0.0, 0.0),), None, False, 30.0, 0.05),
    "sounding on a level, clock": (HALL, ((0.0, 0.0, 0.2),), 1.1, True, -12.0, 0.05),
    "three rows": (HALL[:3], ((0.0, 0.0, 0.0),), 1.1, False, None, None),
    "two microphones": (HALL, TWO_ARMS, None, False, None, 0.05),
    "two microphones on a level, clock": (CEILING, TWO_ARMS, 1.1, False, 8.0, None),
}


def problem_of(case: str, rng: np.random.Generator) -> plain.Problem:
    walls, arms, level_m, sounding, clock_m, rate_sd = CASES[case]
    site = make_site(walls, arms_m=arms, level_m=level_m, sounding=sounding)
    place = [*rng.uniform((1.0, 1.0), (9.0, 7.0)), 1.1]
    velocity = [*rng.uniform(-1, 1, 2), 0.0]
    yaw = rng.uniform(-3, 3) if len(arms) > 1 else 0.0
    drive = Drive(place, velocity if rate_sd else (0.0, 0.0, 0.0), yaw_rad=yaw)
    times = rng.uniform(0.0, 0.05, len(walls) * len(arms))
    epoch = make_epoch(site, drive, times, rate_sd_mps=rate_sd, clock_m=clock_m, rng=rng)
    places = [0, 1] + [2] * (level_m is None) + [3] * (len(arms) > 1)
    index = np.array(places + [4 + p for p in places if rate_sd] + [CLOCK] * (clock_m is not None))
    measured, n = epoch.range_m, len(epoch)
    covariance = epoch.covariance_m2 + 1e-5
    if rate_sd:
        measured = np.concatenate([measured, epoch.range_rate_mps])
        both = np.zeros((2 * n, 2 * n))
        both[:n, :n], both[n:, n:] = covariance, rate_sd**2 * np.eye(n) + 1e-4
        covariance = both
    return plain.Problem(
        link(site, epoch.emitter, epoch.receiver), measured, times - times.mean(), covariance, index, level_m
    )


def searched(problem: plain.Problem) -> list[tuple[Floats, float, Floats]]:
    m, k = len(problem.measured), len(problem.index)
    states, chi2s, jacobians = np.empty((MOST, ALONE)), np.empty(MOST), np.empty((MOST, m, k))
    level = (problem.level_m is not None, float(problem.level_m or 0.0))
    at = (problem.rows, SPEED, problem.clock, problem.covariance, problem.index, *level)
    count = search(*at, states, chi2s, jacobians)
    return [(states[i], float(chi2s[i]), jacobians[i]) for i in range(count)]


@pytest.mark.parametrize("case", CASES)
def test_search_finds_what_its_plain_twin_finds(case: str, rng: np.random.Generator) -> None:
    for _ in range(8):
        problem = problem_of(case, rng)
        found, twins = searched(problem), plain.search(problem)
        assert len(found) == len(twins) > 0
        # mirrors of one plane fit alike to the last digits: their order is chance
        for state, chi2, jacobian in found:
            gaps = [np.linalg.norm(state[:3] - twin[:3]) for twin, _ in twins]
            twin, twin_chi2 = twins[int(np.argmin(gaps))]
            # both stop at a step of 1e-4 deviations of 1 cm, diluted at most tenfold
            assert min(gaps) < 1e-5
            assert abs(np.angle(np.exp(1j * (state[3] - twin[3])))) < 1e-4
            np.testing.assert_allclose(state[4:], twin[4:], atol=1e-4)
            assert chi2 == pytest.approx(twin_chi2, rel=1e-6, abs=1e-6)
            np.testing.assert_allclose(jacobian, plain.misfit(problem, state)[1], rtol=1e-9, atol=1e-8)
        assert [f[1] for f in found] == sorted(f[1] for f in found)


def test_a_covariance_that_is_not_positive_is_told(rng: np.random.Generator) -> None:
    problem = problem_of("space", rng)
    problem.covariance[0, 0] = -1.0
    states, chi2s, jacobians = np.empty((MOST, ALONE)), np.empty(MOST), np.empty((MOST, len(problem.measured), 3))
    at = (problem.rows, SPEED, False, problem.covariance, problem.index, False, 0.0)
    assert search(*at, states, chi2s, jacobians) == -1


@pytest.mark.parametrize("case", ["space", "level, rates", "space, clock", "two microphones"])
@pytest.mark.parametrize("left_out", [1, 2])
def test_trials_without_rows_match_their_plain_twin(case: str, left_out: int, rng: np.random.Generator) -> None:
    problem = problem_of(case, rng)
    problem.measured[1] += 0.7
    state = plain.search(problem)[0][0]
    n = len(problem.dt)
    choices = np.array([np.delete(np.arange(n), rng.choice(n, left_out, replace=False)) for _ in range(6)])
    states, chi2s = np.empty((6, ALONE)), np.empty(6)
    at = (problem.rows, SPEED, problem.clock, problem.covariance, problem.index)
    without(*at, choices, state, states, chi2s)
    for i, keep in enumerate(choices):
        some = problem.some(keep)
        twin, twin_chi2, _ = plain.solve(some, state)
        np.testing.assert_allclose(states[i], twin, atol=1e-5)
        assert chi2s[i] == pytest.approx(twin_chi2, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("level_m", [None, 1.1])
@pytest.mark.parametrize("clock_m", [None, 17.0])
@pytest.mark.parametrize("walls", [HALL, CEILING, LINE, HALL[:4]], ids=["hall", "ceiling", "line", "four"])
def test_starts_match_their_plain_twin(
    walls: tuple, clock_m: float | None, level_m: float | None, rng: np.random.Generator
) -> None:
    anchors = np.array(walls)
    for _ in range(10):
        place = np.array([*rng.uniform((1, 1), (9, 7)), 1.1])
        range_m = np.linalg.norm(anchors - place, axis=1) + (clock_m or 0.0) + 0.01 * rng.standard_normal(len(anchors))
        got, twins = (s(anchors, range_m, level_m, clock_m is not None) for s in (starts, plain.starts))
        assert len(got) == len(twins)
        for twin in twins:
            if walls is LINE and level_m is None:
                # any turn about the line is as good
                gaps = [np.linalg.norm(away(s, anchors) - away(twin, anchors)) for s in got]
            else:
                gaps = [np.linalg.norm(s - twin) for s in got]
            assert min(gaps) < 1e-6 * (1 + np.linalg.norm(twin))


def away(start: Floats, anchors: Floats) -> Floats:
    return np.append(np.linalg.norm(start[:3] - anchors, axis=1), start[3])


def test_gathered_rows_are_those_of_plain_masks(rng: np.random.Generator) -> None:
    site = make_site(HALL, arms_m=TWO_ARMS)
    epoch = make_epoch(site, Drive((3.0, 2.0, 1.0), yaw_rad=0.4), rng.uniform(0, 0.1, 12))
    epoch.range_m[4] = np.nan
    links = link(site, epoch.emitter, epoch.receiver)
    rows, middle_s, dt, ends, open_arm, turns = gather(links.ends, 0, epoch.time_s, epoch.range_m, False, SPEED)
    keep = np.flatnonzero(np.isfinite(epoch.range_m))
    assert rows.tolist() == keep.tolist()
    assert middle_s == pytest.approx(epoch.time_s[keep].mean(), rel=1e-14)
    np.testing.assert_allclose(dt, epoch.time_s[keep] - middle_s, atol=1e-15)
    for got, whole in zip(ends, links.ends, strict=True):
        np.testing.assert_array_equal(got, whole[keep])
    assert turns
    assert not open_arm.any()
    # one microphone alone tells no heading: its arm is left out
    front = np.array([r == "M0" for r in epoch.receiver])
    some = links.rows(front)
    _, _, _, ends, open_arm, turns = gather(some.ends, 0, epoch.time_s[front], epoch.range_m[front], False, SPEED)
    assert not turns
    np.testing.assert_allclose(open_arm, TWO_ARMS[0][:2], rtol=1e-14)
    np.testing.assert_allclose(ends[3], np.tile([0.0, 0.0, 0.5], (5, 1)), atol=1e-15)
    assert len(gather(links.ends, 1, epoch.time_s, epoch.range_m, False, SPEED)[0]) == 0


def test_sounding_rows_speak_of_when_they_were_sent() -> None:
    site = make_site(HALL, sounding=True)
    epoch = make_epoch(site, Drive((3.0, 2.0, 1.0)), 5.0)
    links = link(site, epoch.emitter, epoch.receiver)
    at = (links.ends, 0, epoch.time_s, epoch.range_m)
    assert gather(*at, False, SPEED)[1] == pytest.approx(5.0 - epoch.range_m.mean() / SPEED, rel=1e-14)
    assert gather(*at, True, SPEED)[1] == pytest.approx(5.0, rel=1e-14)


@pytest.mark.parametrize("case", ["space, clock", "level, rates", "two microphones"])
def test_dilution_and_residuals_match_their_plain_twin(case: str, rng: np.random.Generator) -> None:
    problem = problem_of(case, rng)
    state = plain.search(problem)[0][0]
    n = len(problem.dt)
    keep, residual = np.arange(1, n), np.empty(n)
    hdop, vdop = look(problem.rows, SPEED, problem.clock, problem.index, state, keep, residual)
    ranges = plain.Problem(problem.links, problem.measured[:n], problem.dt, np.eye(n), problem.index, problem.level_m)
    miss, jacobian = plain.misfit(ranges, state)
    np.testing.assert_allclose(residual, miss, atol=1e-12)
    places = [i for i, j in enumerate(problem.index) if j < 4 or j == CLOCK]
    covariance = np.linalg.inv(jacobian[keep][:, places].T @ jacobian[keep][:, places])
    assert hdop == pytest.approx(np.sqrt(covariance[0, 0] + covariance[1, 1]), rel=1e-9)
    assert vdop == pytest.approx(np.sqrt(covariance[2, 2]) if problem.level_m is None else 0.0, rel=1e-9)


def test_kernels_are_compiled_for_one_layout_each(rng: np.random.Generator) -> None:
    # a second set of types would cost seconds in the middle of a run
    from sonofix.locate.fix import fix

    for case in CASES:
        searched(problem_of(case, rng))
    site = make_site(HALL, bounds_m=BOUNDS, level_m=1.1)
    fix(shifted(make_epoch(site, Drive((3.0, 2.0, 1.1)), rate_sd_mps=0.05, rng=rng), 2, 0.7), site, "v")
    for kernel in (expected, gather, fill_noise, search, without, look):
        assert len(kernel.signatures) == 1, kernel.py_func.__name__
