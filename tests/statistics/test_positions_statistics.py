"""Tracks by positions of noise that is not as stated: how far they err is what they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from sonofix.flow import run
from sonofix.records import Floats, Innovation, Recording, Table
from sonofix.site import Site
from sonofix.track.belief import Motion
from sonofix.track.scatter import REMEMBERED, SCALES

SITE = Site.model_validate({"name": "yard", "vehicle": [{"id": "agv", "z_m": 0.0}]})
PERIOD_S, COUNT, RUNS = 0.5, 60, 24


def drive(rng: np.random.Generator) -> Floats:
    """Places (n, 2) of a vehicle that moves as the track expects: white acceleration."""
    density = Motion().acceleration_psd
    stirred = density * np.array([[PERIOD_S**3 / 3, PERIOD_S**2 / 2], [PERIOD_S**2 / 2, PERIOD_S]])
    state, out = rng.standard_normal((2, 2)), []
    for _ in range(COUNT):
        out.append(state[0])
        state = np.array([[1.0, PERIOD_S], [0.0, 1.0]]) @ state
        state = state + np.linalg.cholesky(stirred) @ rng.standard_normal((2, 2))
    return np.array(out)


CASES = ((None, 0.1), (None, 0.3), (None, 1.0), (0.1, 1.0), (0.01, 1.0), (1.0, 1.0))


@pytest.mark.parametrize(("stated_m", "sd_m"), CASES)
def test_nees_lies_in_its_band(stated_m: float | None, sd_m: float, rng: np.random.Generator) -> None:
    squared: list[float] = []
    worse: list[float] = []
    innovations: list[Innovation] = []
    time_s = PERIOD_S * np.arange(COUNT)
    for _ in range(RUNS):
        places = drive(rng)
        told = places + sd_m * rng.standard_normal(places.shape)
        columns = {"time_s": time_s, "x_m": told[:, 0], "y_m": told[:, 1]}
        errors = []
        for sd in (stated_m, sd_m):
            stated = columns if sd is None else columns | {"sd_m": np.full(COUNT, sd)}
            steps = list(run(Recording(site=SITE, tables={"positions": Table(stated)})))
            found = [e for s in steps for e in s.estimates]
            if sd is stated_m:
                innovations += [one for s in steps[20:] for one in s.innovations]
            miss = np.array([e.position_m[:2] for e in found]) - places
            errors.append(np.mean(np.sum(miss[20:] ** 2, axis=1)))
            if sd is stated_m:
                # ten seconds apart, as good as independent
                squared += [
                    float(miss[k] @ np.linalg.solve(found[k].covariance[:2, :2], miss[k])) for k in (20, 40, 59)
                ]
        worse.append(errors[0] / errors[1])
    freedom = 2 * len(squared)
    low, high = chi2.ppf([1e-3, 1 - 1e-3], freedom) / freedom
    # two axes of as many positions tell a variance to 1 / √REMEMBERED, and scales are taken in steps; between stated
    # and twice that the scale never errs to below
    slack = 1.0 + 2.0 / np.sqrt(REMEMBERED) + 2.0 * np.log(SCALES[1])
    assert low / slack < sum(squared) / freedom < high * slack
    assert np.sqrt(np.mean(worse)) < 1.15
    # innovations of a right filter are white: each corrects by two coordinates
    assert all(one.rows == 2 for one in innovations)
    nis, freedom = sum(one.nis for one in innovations), 2 * len(innovations)
    low, high = chi2.ppf([1e-3, 1 - 1e-3], freedom) / freedom
    assert low / slack < nis / freedom < high * slack
