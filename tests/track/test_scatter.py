"""How far positions err: members are Kalman filters, noise is learnt as it is, and an outlier is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonofix.records import Floats
from sonofix.track.scatter import AGILE, REMEMBERED, SCALES, Scatter, scatter

SD_M, PERIOD_S = 0.1, 0.5


def followed(places: Floats, known: Scatter | None = None) -> Scatter:
    known = (known or scatter()).begun(0.0, places[0], SD_M**2, 3.0)
    for k, place in enumerate(places[1:], 1):
        known, _ = known.taken(PERIOD_S * k, place, SD_M**2)
    return known


def drive(count: int) -> Floats:
    time_s = PERIOD_S * np.arange(count)
    return np.column_stack([3.0 * np.cos(0.2 * time_s), 3.0 * np.sin(0.2 * time_s)])


@pytest.mark.parametrize(("scale", "agile"), [(0, 1), (10, 2), (23, 0)])
def test_a_member_is_a_kalman_filter(scale: int, agile: int, rng: np.random.Generator) -> None:
    # near enough to each other that no member calls one a stray
    places = drive(12) + 0.05 * rng.standard_normal((12, 2))
    known = followed(places)
    noise, density = (SCALES[scale] * SD_M) ** 2, AGILE[agile]
    mean, spread = np.array([places[0], (0.0, 0.0)]), np.diag([noise, 9.0])
    flow = np.array([[1.0, PERIOD_S], [0.0, 1.0]])
    for place in places[1:]:
        mean = flow @ mean
        spread = flow @ spread @ flow.T
        spread += density * np.array([[PERIOD_S**3 / 3, PERIOD_S**2 / 2], [PERIOD_S**2 / 2, PERIOD_S]])
        gain = spread[:, 0] / (spread[0, 0] + noise)
        mean = mean + np.outer(gain, place - mean[0])
        spread = spread - np.outer(gain, spread[0])
    assert known.state is not None
    assert known.covariance is not None
    np.testing.assert_allclose(known.state[scale, agile], mean, atol=1e-9)
    np.testing.assert_allclose(known.covariance[scale, agile], spread, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), turn=st.floats(-3.1, 3.1), shift=st.floats(-1e3, 1e3))
def test_what_is_learnt_knows_no_place_and_no_direction(seed: int, turn: float, shift: float) -> None:
    places = drive(20) + 0.4 * np.random.default_rng(seed).standard_normal((20, 2))
    turned = places @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + shift
    np.testing.assert_allclose(followed(turned).heard, followed(places).heard, atol=1e-5)
    # nor does the spread of the mixture
    values = [np.linalg.eigvalsh(followed(some).mixed()[1]) for some in (places, turned)]
    np.testing.assert_allclose(*values, rtol=1e-4)
    assert values[0].min() > 0.0


@pytest.mark.parametrize("sd_m", [0.1, 0.3, 1.0])
def test_noise_is_learnt_as_it_is(sd_m: float, rng: np.random.Generator) -> None:
    found = [followed(drive(100) + sd_m * rng.standard_normal((100, 2))).scale for _ in range(10)]
    # 2 REMEMBERED squares tell a deviation to 1 / √(4 REMEMBERED), ten times over; then scales are 1.22 apart
    sd = np.sqrt(1.0 / (4.0 * REMEMBERED) / 10.0)
    assert abs(np.log(np.mean(found) * SD_M / sd_m)) < 3.0 * sd + np.log(SCALES[1] / SCALES[0]) / 2.0


def test_noise_that_grows_is_learnt_within_ten_positions_and_forgotten(rng: np.random.Generator) -> None:
    places = drive(150)
    places[:50] += 0.1 * rng.standard_normal((50, 2))
    places[50:100] += rng.standard_normal((50, 2))
    places[100:] += 0.1 * rng.standard_normal((50, 2))
    assert followed(places[:50]).scale < 1.5
    assert followed(places[:60]).scale > 5.0
    assert 7.0 < followed(places[:100]).scale < 14.0
    assert followed(places).scale < 2.0


@pytest.mark.parametrize("off_m", [1.0, 8.0, 80.0])
def test_one_outlier_is_no_noise(off_m: float, rng: np.random.Generator) -> None:
    places = drive(31) + 0.1 * rng.standard_normal((31, 2))
    places[25] += (off_m, 0.0)
    assert followed(places[:26]).scale < 2.0
    assert followed(places).scale < 1.5
