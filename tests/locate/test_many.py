"""Fixes by the thousand: the same answers as `fix` and as SciPy, whatever is heard."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from locate.made_epochs import BOUNDS, HALL, Drive, make_epoch, make_site
from sonofix.locate.fix import fix
from sonofix.locate.many import REMEDIES, STATUSES, fix_many
from sonofix.locate.standing import misfit
from sonofix.records import Floats

ANCHORS = np.array((*HALL, (0.0, 4.0, 1.5), (10.0, 4.0, 2.9)))
CEILING = np.array([(0.0, 0.0, 3.2), (10.0, 0.0, 3.2), (10.0, 8.0, 3.2), (0.0, 8.0, 3.2), (4.0, 3.0, 3.2)])
SD_M = 0.01


def ranges(anchors: Floats, count: int, level_m: float | None, rng: np.random.Generator) -> tuple[Floats, Floats]:
    places = rng.uniform((0.5, 0.5, 0.2), (9.5, 7.5, 2.0), (count, 3))
    places[:, 2] = places[:, 2] if level_m is None else level_m
    away = np.linalg.norm(places[:, None] - anchors, axis=2)
    return places, away + SD_M * rng.standard_normal(away.shape)


@pytest.mark.parametrize("anchors", [ANCHORS, CEILING], ids=["walls", "ceiling"])
@pytest.mark.parametrize("bounds", [None, BOUNDS], ids=["open", "room"])
@pytest.mark.parametrize("level_m", [None, 1.1])
@pytest.mark.parametrize("clock_m", [None, 5.0])
def test_each_is_what_fix_says(
    anchors: Floats, bounds: tuple | None, level_m: float | None, clock_m: float | None, rng: np.random.Generator
) -> None:
    site = make_site(anchors, level_m=level_m, bounds_m=bounds)
    _, measured = ranges(anchors, 40, level_m, rng)
    measured += clock_m or 0.0
    measured[rng.random(measured.shape) < 0.2] = np.nan
    measured[::7, 0] += 0.8
    measured[0] = np.nan
    found = fix_many(
        anchors, measured, np.full(len(anchors), SD_M**2), level_m=level_m, clock=clock_m is not None, bounds_m=bounds
    )
    epoch = make_epoch(site, Drive((0.0, 0.0, level_m or 0.0)), sd_m=SD_M, clock_m=clock_m)
    for e in range(len(found)):
        one = fix(replace(epoch, range_m=measured[e]), site, "v")
        assert STATUSES[found.status[e]] == one.status
        assert found.remedy(e) == REMEDIES[STATUSES.index(one.status)]
        assert found.used[e].tolist() == one.used.tolist()
        if one.position_m is None:
            assert np.isnan(found.position_m[e]).all()
            assert np.isnan(found.covariance[e]).all()
            continue
        assert found.states == one.states
        np.testing.assert_allclose(found.position_m[e], one.position_m, rtol=0, atol=1e-6)
        np.testing.assert_allclose(found.covariance[e], one.covariance, rtol=1e-4, atol=1e-12)
        if clock_m is not None:
            assert found.clock_offset_m[e] == pytest.approx(one.clock_offset_m, abs=1e-6)
    assert (found.clock_offset_m is None) == (clock_m is None)


@pytest.mark.parametrize("faults", [1, 2, 3, 8])
@pytest.mark.parametrize("level_m", [None, 1.1])
@pytest.mark.parametrize("clock_m", [None, 5.0])
@pytest.mark.parametrize("anchors", [ANCHORS, CEILING], ids=["walls", "ceiling"])
def test_wrong_ranges_are_left_out_as_by_fix(
    anchors: Floats, faults: int, level_m: float | None, clock_m: float | None, rng: np.random.Generator
) -> None:
    site = make_site(anchors, level_m=level_m, bounds_m=BOUNDS)
    _, measured = ranges(anchors, 40, level_m, rng)
    for row in measured:
        wrong = rng.choice(len(anchors), min(faults, len(anchors)), replace=False)
        row[wrong] += rng.choice((-1.0, 1.0), len(wrong)) * rng.uniform(0.05, 1.5, len(wrong))
    measured = np.abs(measured) + (clock_m or 0.0)
    found = fix_many(
        anchors, measured, np.full(len(anchors), SD_M**2), level_m=level_m, clock=clock_m is not None, bounds_m=BOUNDS
    )
    epoch = make_epoch(site, Drive((0.0, 0.0, level_m or 0.0)), sd_m=SD_M, clock_m=clock_m)
    told = 0
    for e in range(len(found)):
        one = fix(replace(epoch, range_m=measured[e]), site, "v")
        assert (STATUSES[found.status[e]], found.used[e].tolist()) == (one.status, one.used.tolist())
        if one.position_m is not None:
            told += 1
            np.testing.assert_allclose(found.position_m[e], one.position_m, rtol=0, atol=1e-6)
            np.testing.assert_allclose(found.covariance[e], one.covariance, rtol=1e-4, atol=1e-12)
    assert told > 0


@pytest.mark.parametrize("level_m", [None, 0.4], ids=["space", "level"])
@pytest.mark.parametrize("clock", [False, True], ids=["clock known", "clock unknown"])
@pytest.mark.parametrize("by_m", [-3.0, 3.0, 30.0, 300.0])
def test_a_range_off_by_far_hides_no_precise_place(
    level_m: float | None, clock: bool, by_m: float, rng: np.random.Generator
) -> None:
    places = rng.uniform((1, 1, 0.2), (9, 7, 1.6), (300, 3)) if level_m is None else None
    if places is None:
        places = np.column_stack([rng.uniform((1, 1), (9, 7), (300, 2)), np.full(300, level_m)])
    measured = np.linalg.norm(places[:, None] - ANCHORS, axis=2) + 0.001 * rng.standard_normal((300, len(ANCHORS)))
    row = rng.integers(0, len(ANCHORS), 300)
    measured[np.arange(300), row] += by_m
    measured += 60.0 * clock
    if not clock:
        # what is too short stays positive, as a range is
        measured = np.abs(measured)
    found = fix_many(ANCHORS, measured, np.full(8, 0.001**2), level_m=level_m, clock=clock, bounds_m=BOUNDS)
    well = found.status == 0
    assert np.mean(well) >= 0.99
    np.testing.assert_array_equal(np.flatnonzero(~found.used[well]) % 8, row[well])
    away = found.position_m[well] - places[well]
    away = away[:, : 2 + (level_m is None)]
    within = np.linalg.solve(found.covariance[well][:, : away.shape[1], : away.shape[1]], away[..., None])[..., 0]
    assert np.all(np.sum(away * within, axis=1) < 36)


def test_scipy_agrees_to_a_micrometre(rng: np.random.Generator) -> None:
    _, measured = ranges(ANCHORS, 60, 1.1, rng)
    found = fix_many(ANCHORS, measured, np.full(8, SD_M**2), level_m=1.1)
    assert (found.status == 0).all()
    for e in range(60):

        def miss(place: Floats, e: int = e) -> Floats:
            return (np.linalg.norm(np.append(place, 1.1) - ANCHORS, axis=1) - measured[e]) / SD_M

        peer = least_squares(miss, [5.0, 4.0], method="lm", xtol=1e-13, ftol=1e-13)
        np.testing.assert_allclose(found.position_m[e, :2], peer.x, rtol=0, atol=1e-6)
        assert found.chi2[e] == pytest.approx(2 * peer.cost, rel=1e-6)


def test_every_shape_of_covariance_weighs_alike(rng: np.random.Generator) -> None:
    _, measured = ranges(ANCHORS, 5, None, rng)
    variance = rng.uniform(0.5, 2.0, 8) * SD_M**2
    alike = [variance, np.diag(variance), np.tile(variance, (5, 1)), np.tile(np.diag(variance), (5, 1, 1))]
    found = [fix_many(ANCHORS, measured, given) for given in alike]
    for other in found[1:]:
        np.testing.assert_array_equal(other.position_m, found[0].position_m)
    # what ranges share is weighed too: a common error pulls less once it is known of
    common = np.diag(variance) + 1e-3 * np.ones((8, 8))
    assert np.abs(fix_many(ANCHORS, measured, common).position_m - found[0].position_m).max() > 1e-5


def test_misfit_and_jacobian_are_whitened_as_plain_algebra_has_it(rng: np.random.Generator) -> None:
    whiten = np.tril(rng.standard_normal((8, 8)))
    state, measured = np.array([3.0, 5.5, 1.1, 0.4]), rng.uniform(2, 9, 8)
    plain, jacobian = np.empty(8), np.empty((8, 4))
    chi2 = misfit(ANCHORS, measured, whiten, np.arange(4), state, plain, jacobian)
    away = state[:3] - ANCHORS
    distance = np.linalg.norm(away, axis=1)
    want = whiten @ (measured - distance - 0.4)
    np.testing.assert_allclose(plain, want, rtol=1e-12)
    np.testing.assert_allclose(jacobian, whiten @ np.column_stack([away / distance[:, None], np.ones(8)]), rtol=1e-10)
    assert chi2 == pytest.approx(want @ want)


def test_no_epochs_are_no_trouble() -> None:
    found = fix_many(ANCHORS, np.zeros((0, 8)), np.full(8, 1e-4))
    assert len(found) == 0
    assert found.position_m.shape == (0, 3)


def changed(values: Floats, at: tuple, to: float) -> Floats:
    out = values.copy()
    out[at] = to
    return out


@pytest.mark.parametrize(
    ("anchors", "measured", "covariance", "word"),
    [
        (ANCHORS[:, :2], np.ones((1, 8)), np.ones(8), "anchors_m has shape"),
        (changed(ANCHORS, (3, 1), np.nan), np.ones((1, 8)), np.ones(8), r"anchors_m\[3\]"),
        (ANCHORS, np.ones((1, 7)), np.ones(8), "ranges_m has shape"),
        (ANCHORS, np.ones(8), np.ones(8), "ranges_m has shape"),
        (ANCHORS, changed(np.ones((3, 8)), (2, 5), np.inf), np.ones(8), r"ranges_m\[2, 5\] is inf"),
        (ANCHORS, changed(np.ones((3, 8)), (1, 4), -1.0), np.full(8, 1e-4), r"ranges_m\[1, 4\] is -1"),
        (ANCHORS, np.ones((1, 8)), np.ones(7), "covariance_m2 has shape"),
        (ANCHORS, np.ones((1, 8)), np.zeros(8), "epoch 0, anchor 0 is 0"),
        (ANCHORS, np.ones((3, 8)), changed(np.ones((3, 8)), (2, 1), -1.0), "epoch 2, anchor 1 is -1"),
        (ANCHORS, np.ones((3, 8)), changed(np.ones((3, 8)), (1, 6), np.nan), "epoch 1, anchor 6 is nan"),
        (ANCHORS, np.ones((3, 8)), changed(np.ones(8), (2,), np.inf), "epoch 0, anchor 2 is inf"),
        (ANCHORS, np.ones((3, 8)), np.ones((8, 8)), "positive definite"),
        (ANCHORS, np.ones((3, 8)), changed(np.eye(8), (0, 1), 0.2), "not symmetric"),
        ("B1", np.ones((3, 8)), np.ones(8), "anchors_m 'B1': give numbers, one row"),
        (ANCHORS, [[1.0] * 8, [1.0]], np.ones(8), r"ranges_m \[\[1.0, .*: give numbers, an epoch a row"),
        (ANCHORS, np.ones((3, 8)), np.full(8, 1j), "covariance_m2 array.*: give numbers"),
    ],
)
def test_misuse_is_named(anchors: ArrayLike, measured: ArrayLike, covariance: ArrayLike, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        fix_many(anchors, measured, covariance)


@pytest.mark.parametrize(
    ("asked", "word"),
    [
        ({"bounds_m": [[1, 1, 1], [0, 0, 0]]}, "bounds_m"),
        ({"bounds_m": [[0, 0, np.nan], [1, 1, 1]]}, "bounds_m"),
        ({"bounds_m": [0, 0, 0]}, "bounds_m"),
        ({"bounds_m": "hall"}, "bounds_m 'hall': give numbers, two corners"),
        ({"level_m": np.nan}, "level_m nan"),
        ({"level_m": "x"}, "level_m 'x': give numbers, a finite level, or None"),
        ({"level_m": "1.5"}, "level_m '1.5': give numbers"),
        ({"level_m": [0.0, 1.0]}, r"level_m \[0.0, 1.0\]: give a finite level"),
    ],
)
def test_a_room_or_level_that_is_none_is_named(asked: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        fix_many(ANCHORS, np.ones((1, 8)), np.ones(8), **asked)


def test_what_was_not_heard_needs_no_variance(rng: np.random.Generator) -> None:
    _, measured = ranges(ANCHORS, 4, 1.1, rng)
    measured[:, 2] = np.nan
    variance = np.full((4, 8), SD_M**2)
    unknown = variance.copy()
    unknown[:, 2] = np.nan
    found = [fix_many(ANCHORS, measured, given, level_m=1.1) for given in (variance, unknown)]
    assert (found[1].status == 0).all()
    np.testing.assert_array_equal(found[0].position_m, found[1].position_m)


def test_noise_may_make_a_range_negative_at_an_anchor_and_a_clock_any(rng: np.random.Generator) -> None:
    at = ANCHORS[0]
    measured = np.linalg.norm(at - ANCHORS, axis=1)[None] - 2.0 * SD_M * np.eye(8)[:1]
    found = fix_many(ANCHORS, measured, np.full(8, SD_M**2))
    assert found.status[0] == 0
    assert np.linalg.norm(found.position_m[0] - at) < 0.1
    found = fix_many(ANCHORS, measured - 20.0, np.full(8, SD_M**2), clock=True)
    assert found.clock_offset_m[0] == pytest.approx(-20.0, abs=0.1)
