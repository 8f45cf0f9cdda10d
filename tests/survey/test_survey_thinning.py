"""More ranges than an adjustment needs, and ranges that err alike: what is taken of them, and how sure it makes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from sonofix.survey.conclude import alike
from sonofix.survey.places import CLOSE_S, MOST_ROWS, Wishes, survey, thinned
from sonofix.survey.rows import gather
from survey.made_drive import HALL, hall, heard, wander

KNOWN = hall(sd_m=0.0)


def drive(count: int, period_s: float, rng: np.random.Generator, **how):
    return heard(KNOWN, HALL, wander, count, rng, rates=False, period_s=period_s, **how)


def test_few_ranges_are_all_taken(rng: np.random.Generator) -> None:
    epochs = drive(20, 0.05, rng)
    kept, told = thinned(epochs)
    assert kept == epochs
    assert told == ()


def test_of_many_one_in_some_is_taken_and_said(rng: np.random.Generator) -> None:
    (one,) = drive(1, 0.05, rng)
    count = 5 * MOST_ROWS // 14  # 2.5 times too many
    epochs = [replace(one, index=i, sync_s=0.05 * i, time_s=one.time_s + 0.05 * i) for i in range(count)]
    kept, (event,) = thinned(epochs)
    times_s = np.array([e.sync_s for e in kept])
    assert 0.5 * MOST_ROWS < sum(len(e) for e in kept) <= MOST_ROWS * 1.01
    assert (np.diff(times_s) > 0).all()
    assert times_s[0] < 0.2
    assert times_s[-1] > epochs[-1].sync_s - 0.2
    assert "of each 3 epochs in a row one was taken" in event.detail
    # beacons that take turns are all heard as often still: no order falls in step
    turns = [replace(e, emitter=(f"B{i % 3}",) * len(e)) for i, e in enumerate(epochs)]
    heard_of = Counter(e.emitter[0] for e in thinned(turns)[0])
    assert min(heard_of.values()) > 0.8 * max(heard_of.values())


def test_epochs_that_are_far_apart_all_stay(rng: np.random.Generator) -> None:
    (one,) = drive(1, 0.05, rng)
    epochs = [replace(one, sync_s=1.1 * CLOSE_S * i) for i in range(3 * MOST_ROWS // 7)]
    assert len(thinned(epochs)[0]) == len(epochs)


@pytest.mark.parametrize(("rho", "factor"), [(0.0, 1.0), (0.5, 3.0), (0.8, 9.0)])
def test_ranges_that_err_alike_count_for_fewer(rho: float, factor: float) -> None:
    # a first-order process: (1 + rho) / (1 - rho) (Bartlett 1935)
    rng = np.random.default_rng(4)
    task = gather(KNOWN, drive(500, 0.1, rng))
    z = np.zeros(len(task))
    for beacon in range(len(HALL)):
        rows = np.flatnonzero(task.point == beacon)
        rows = rows[np.argsort(task.time_s[rows])]
        white, last = rng.standard_normal(len(rows)), 0.0
        for i, row in enumerate(rows):
            last = z[row] = rho * last + np.sqrt(1 - rho**2) * white[i]
    used = np.ones(len(task), bool)
    got = alike(task, z, used, 0)
    assert got == pytest.approx(factor, rel=0.25, abs=0.06)
    # of what residuals show, unknowns that follow took their share before
    assert alike(task, z, used, len(task) // 2) - 1.0 == pytest.approx(2.0 * (got - 1.0))


def test_where_nobody_states_how_good_ranges_are_residuals_do() -> None:
    sds = []
    for assumed_m, stated in ((0.02, True), (0.1, False)):
        epochs = drive(60, 0.3, np.random.default_rng(3), range_sd_m=0.02)
        noisy = [replace(e, covariance_m2=np.eye(len(e)) * assumed_m**2, sd_stated=stated) for e in epochs]
        sds.append(np.array([p.sd_m for p in survey(KNOWN, noisy, Wishes(biases="pair", speed_sd_mps=0.0)).pairs]))
    assert sds[1] == pytest.approx(sds[0], rel=0.25)
    # what is stated is not made smaller
    told = [replace(e, sd_stated=True) for e in noisy]
    assert all(p.sd_m > 2 * sds[0].max() for p in survey(KNOWN, told, Wishes(biases="pair", speed_sd_mps=0.0)).pairs)


def test_deviations_of_biases_hold_where_errors_last() -> None:
    # errors of 2 cm that last for a second, ten times a second: taken for white they would be three times too sure
    off = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        epochs = drive(120, 0.1, rng, range_sd_m=1e-3)
        state, keep = np.zeros(len(HALL)), np.exp(-0.1)
        late = []
        for epoch in epochs:
            state = keep * state + np.sqrt(1 - keep**2) * 0.02 * rng.standard_normal(len(HALL))
            late.append(replace(epoch, range_m=epoch.range_m + state, covariance_m2=np.eye(len(HALL)) * 0.02**2))
        found = survey(KNOWN, late, Wishes(biases="pair", speed_sd_mps=0.0))
        off += [p.bias_m / p.sd_m for p in found.pairs]
        assert any(event.event == "alike" for event in found.events)
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.6
