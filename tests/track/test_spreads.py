"""Level and height are heard apart, and each deviation is taken by its own scale."""

from __future__ import annotations

import numpy as np

from sonofix.records import Fix, Floats
from sonofix.track.scatter import scatter
from sonofix.track.spreads import Spreads, spreads

SD_M = 0.1


def fix(time_s: float, place_m: Floats, states: tuple[str, ...] = ("x", "y", "z")) -> Fix:
    return Fix(
        time_s=time_s,
        vehicle="agv",
        status="ok",
        remedy="",
        states=states,
        position_m=place_m,
        velocity_mps=None,
        yaw_rad=None,
        clock_offset_m=None,
        covariance=SD_M**2 * np.eye(len(states)),
        hdop=None,
        vdop=None,
        hpl_m=None,
        vpl_m=None,
        used=np.zeros(0, bool),
        residual_m=np.zeros(0),
    )


def followed(places: Floats, states: tuple[str, ...] = ("x", "y", "z")) -> Spreads:
    known = spreads().begun(0.0, fix(0.0, places[0], states), 3.0)
    for k, place in enumerate(places[1:], 1):
        known, _ = known.taken(0.5 * k, fix(0.5 * k, place, states))
    return known


def test_each_learns_its_own(rng: np.random.Generator) -> None:
    places = rng.standard_normal((60, 3)) * (0.1, 0.1, 1.0)
    known = followed(places)
    assert known.level.scale < 2.0
    assert 6.0 < known.height.scale < 15.0
    # the level hears the same as without a height, and noise is taken by either
    np.testing.assert_allclose(known.level.heard, followed(places, ("x", "y")).level.heard)
    sd_m = np.sqrt(np.diag(known.noise(fix(0.0, places[0]), ("x", "z"))))
    np.testing.assert_allclose(sd_m, SD_M * np.array([known.level.scale, known.height.scale]))


def test_without_a_height_that_hears_nothing(rng: np.random.Generator) -> None:
    known = followed(rng.standard_normal((10, 3)), ("x", "y"))
    np.testing.assert_array_equal(known.height.heard, scatter().heard)
    assert known.scale == known.level.scale


def test_likelihoods_of_both_are_of_the_same_axes(rng: np.random.Generator) -> None:
    known, there = followed(0.1 * rng.standard_normal((20, 3))), fix(10.0, np.zeros(3))
    _, both = known.taken(10.0, there)
    level, height = (part.taken(10.0, np.zeros(n), SD_M**2)[1] for part, n in ((known.level, 2), (known.height, 1)))
    assert both == level + height
    miss, spread = np.array([0.1, 0.0, -0.1]), 0.01 * np.eye(3)
    _, both = known.judged(miss, spread, there, "xyz")
    _, level = known.judged(miss[:2], spread[:2, :2], there, "xy")
    _, height = known.judged(miss[2:], spread[2:, 2:], there, "z")
    np.testing.assert_allclose(both, level + height)
