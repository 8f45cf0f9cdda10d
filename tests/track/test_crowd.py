"""Tracks by the thousand: the kernel beside the textbook, one vehicle beside `Follower`, starts, gates and misuse."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from locate.made_epochs import BOUNDS, HALL, Drive, make_epoch, make_site
from sonofix.records import Floats
from sonofix.street import Street
from sonofix.track.belief import Motion
from sonofix.track.kernel import absorb
from sonofix.track.many import Crowd, follow_many

ANCHORS = np.array(HALL)
LEVEL_M = 0.5
SD_M = 0.003


def heard(places: Floats, rng: np.random.Generator | None = None) -> Floats:
    ranges = np.linalg.norm(places[:, None] - ANCHORS, axis=2)
    return ranges if rng is None else ranges + SD_M * rng.standard_normal(ranges.shape)


def test_one_measurement_is_the_textbook_update(rng: np.random.Generator) -> None:
    for n in (1, 3, 8):
        half = rng.standard_normal((n, n))
        mean, covariance, row = rng.standard_normal(n), half @ half.T + 0.1 * np.eye(n), rng.standard_normal(n)
        gain = covariance @ row / (row @ covariance @ row + 0.2)
        got, after = mean.copy(), covariance.copy()
        absorb(got, after, row, 0.7, 0.2, np.empty((3, n)))
        np.testing.assert_allclose(got, mean + 0.7 * gain, rtol=1e-12)
        np.testing.assert_allclose(after, covariance - np.outer(gain, covariance @ row), atol=1e-12)
        np.testing.assert_array_equal(after, after.T)


def test_a_sure_measurement_leaves_the_covariance_positive() -> None:
    # a range of a micrometre upon a belief of a kilometre: P - k hP alone would lose all digits
    covariance, row = np.array([[1e6, 1e6], [1e6, 1e6 + 1e-6]]), np.array([1.0, 0.0])
    for _ in range(1000):
        absorb(np.zeros(2), covariance, row, 0.0, 1e-12, np.empty((3, 2)))
    assert np.linalg.eigvalsh(covariance).min() > 0


@pytest.mark.parametrize("level_m", [LEVEL_M, None])
def test_a_crowd_goes_as_each_vehicle_would_alone(level_m: float | None, rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=level_m, bounds_m=BOUNDS)
    start, speed = np.array([3.0, 3.0, LEVEL_M]), np.array([0.3, 0.2, 0.0])
    street, crowd = Street(site), Crowd.unknown(3, level_m is not None)
    alone = None
    for k in range(12):
        epoch = make_epoch(site, Drive(start.tolist(), speed.tolist()), 0.5 * k, sd_m=SD_M, rng=rng)
        (alone,) = street.walk(epoch).estimates
        ranges = np.tile(epoch.range_m, (3, 1))
        crowd, used = follow_many(
            crowd, 0.5 * k, ANCHORS, ranges, np.full(6, SD_M**2), level_m=level_m, bounds_m=BOUNDS
        )
        assert used.all()
    assert alone is not None
    axes = crowd.mean.shape[1] // 2
    together = np.concatenate([alone.position_m[:axes], alone.velocity_mps[:axes]])
    # a vehicle alone has its noise for motion within the epoch beside, of none here
    np.testing.assert_allclose(crowd.mean, np.tile(together, (3, 1)), atol=2e-5)
    index = [alone.states.index(s) for s in ("x", "y", "z", "vx", "vy", "vz") if s in alone.states]
    np.testing.assert_allclose(crowd.covariance[0], alone.covariance[np.ix_(index, index)], rtol=0.01, atol=1e-7)


def test_crowds_err_as_much_as_they_say(rng: np.random.Generator) -> None:
    count, motion, dt = 400, Motion(acceleration_psd=0.05), 0.5
    half = np.sqrt(motion.acceleration_psd) * np.linalg.cholesky([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    place, velocity = rng.uniform((3, 3), (7, 5), (count, 2)), rng.standard_normal((count, 2))
    crowd = Crowd.unknown(count, True)
    for k in range(8):
        places = np.column_stack([place, np.full(count, LEVEL_M)])
        ranges = heard(places, rng)
        ranges[rng.random(ranges.shape) < (0.2 if k else 0.0)] = np.nan
        crowd, _ = follow_many(
            crowd, dt * k, ANCHORS, ranges, np.full(6, SD_M**2), level_m=LEVEL_M, bounds_m=BOUNDS, motion=motion
        )
        if k < 7:
            kick = np.einsum("ij,jva->iva", half, rng.standard_normal((2, count, 2)))
            place, velocity = place + dt * velocity + kick[0], velocity + kick[1]
    miss = crowd.mean - np.concatenate([place, velocity], axis=1)
    nees = np.einsum("vi,vij,vj->v", miss, np.linalg.inv(crowd.covariance), miss)
    low, high = chi2.interval(1 - 1e-6, 4 * count)
    assert low < nees.sum() < high


def test_wrong_ranges_are_left_out_and_a_carried_vehicle_begins_anew(rng: np.random.Generator) -> None:
    here, there = np.array([[3.0, 3.0, LEVEL_M]]), np.array([[7.0, 5.0, LEVEL_M]])
    crowd, used = Crowd.unknown(1, True), np.zeros((1, 6), bool)
    for k in range(4):
        ranges = heard(here, rng)
        ranges[0, 2] += 0.5 * (k == 3)
        crowd, used = follow_many(crowd, 0.5 * k, ANCHORS, ranges, np.full(6, SD_M**2), level_m=LEVEL_M)
    assert used.tolist() == [[True, True, False, True, True, True]]
    for k in range(4, 8):
        crowd, used = follow_many(crowd, 0.5 * k, ANCHORS, heard(there, rng), np.full(6, SD_M**2), level_m=LEVEL_M)
    assert used.all()
    assert np.hypot(*(crowd.mean[0, :2] - there[0, :2])) < 0.02


def test_what_is_not_heard_stays_unknown_and_grows() -> None:
    crowd = Crowd.unknown(2, True)
    ranges = heard(np.array([[3.0, 3.0, LEVEL_M], [4.0, 4.0, LEVEL_M]]))
    ranges[1] = np.nan
    crowd, _ = follow_many(crowd, 0.0, ANCHORS, ranges, np.full(6, SD_M**2), level_m=LEVEL_M)
    assert np.isnan(crowd.mean[1]).all()
    later, used = follow_many(crowd, 1.0, ANCHORS, np.full((2, 6), np.nan), np.full(6, SD_M**2), level_m=LEVEL_M)
    assert not used.any()
    assert later.covariance[0, 0, 0] > 0.5


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"anchors_m": np.zeros(3)}, "anchors_m"),
        ({"ranges_m": np.zeros((3, 6))}, "ranges_m"),
        ({"variance_m2": np.zeros(6)}, "variance_m2"),
        ({"variance_m2": np.ones(5)}, "variance_m2"),
        ({"time_s": -1.0}, "time_s"),
        ({"level_m": None}, "crowd.mean"),
    ],
)
def test_misuse_names_the_argument(change: dict, named: str) -> None:
    given = {
        "time_s": 0.0,
        "anchors_m": ANCHORS,
        "ranges_m": heard(np.array([[3.0, 3.0, LEVEL_M]])),
        "variance_m2": np.full(6, 1e-4),
        "level_m": LEVEL_M,
    }
    given |= change
    level = given.pop("level_m")
    with pytest.raises(ValueError, match=named):
        follow_many(Crowd.unknown(1, True), level_m=level, **given)
