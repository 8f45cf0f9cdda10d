"""An unknown clock equals time differences with their full covariance: against a solver that knows differences only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site
from sonofix.locate.fix import fix
from sonofix.records import Floats, RangeEpoch

PLACE = np.array([3.0, 5.5, 1.1])
ANCHORS = np.array(HALL)


def by_differences(
    anchors: Floats, epoch: RangeEpoch, begin: Floats, level: bool, reference: int
) -> tuple[Floats, Floats]:
    """Gauss–Newton on range differences to one reference, each weighted by the covariance that all share."""
    n = len(anchors)
    others = np.delete(np.arange(n), reference)
    difference = np.eye(n)[others]
    difference[:, reference] = -1.0
    weight = np.linalg.inv(difference @ epoch.covariance_m2 @ difference.T)
    axes = slice(0, 2 if level else 3)
    place = begin.astype(float).copy()
    normal = np.eye(3)
    for _ in range(50):
        away = place - anchors
        distance = np.linalg.norm(away, axis=1)
        jacobian = difference @ (away / distance[:, None])[:, axes]
        miss = difference @ (epoch.range_m - distance)
        normal = jacobian.T @ weight @ jacobian
        place[axes] += np.linalg.solve(normal, jacobian.T @ weight @ miss)
    return place, np.linalg.inv(normal)


@pytest.mark.parametrize("level", [False, True], ids=["space", "level"])
@pytest.mark.parametrize("reference", [0, 3])
@pytest.mark.parametrize("clock_m", [-200.0, 0.0, 31.0])
def test_unknown_clock_equals_differences(
    level: bool, reference: int, clock_m: float, rng: np.random.Generator
) -> None:
    site = make_site(HALL, level_m=PLACE[2] if level else None)
    sd = rng.uniform(0.5e-3, 2e-3, 6)
    epoch = make_epoch(site, Drive(PLACE), sd_m=1e-3, clock_m=clock_m, rng=rng)
    # unequal rows that share noise: the reference's own is in every difference, and so is the sound speed's
    epoch = replace(epoch, covariance_m2=np.diag(sd**2) + 1e-6 * np.outer(sd, sd) / sd.mean() ** 2)
    found = fix(epoch, site, "v")
    assert found.status == "ok"
    place, covariance = by_differences(ANCHORS, epoch, PLACE, level, reference)
    np.testing.assert_allclose(found.position_m, place, rtol=0, atol=1e-9)
    k = 2 if level else 3
    np.testing.assert_allclose(found.covariance[:k, :k], covariance, rtol=1e-6)


def test_an_offset_of_all_ranges_moves_only_the_clock(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    epoch = make_epoch(site, Drive(PLACE), clock_m=3.0, rng=rng)
    later = replace(epoch, range_m=epoch.range_m + 1000.0)
    a, b = fix(epoch, site, "v"), fix(later, site, "v")
    np.testing.assert_allclose(b.position_m, a.position_m, atol=1e-7)
    assert b.clock_offset_m - a.clock_offset_m == pytest.approx(1000.0, abs=1e-7)


def test_the_clock_costs_certainty() -> None:
    site = make_site(HALL)
    known = fix(make_epoch(site, Drive(PLACE)), site, "v")
    unknown = fix(make_epoch(site, Drive(PLACE), clock_m=0.0), site, "v")
    for state in "xyz":
        assert unknown.sd(state) > known.sd(state) * (1 - 1e-9)
    assert unknown.vdop > known.vdop
