"""Surveys of many made drives: deviations are true, whatever is known before."""

from dataclasses import replace

import numpy as np
import pytest
from made_drive import HALL, circle, hall, heard, wander
from scipy.stats import chi2

from sonofix.records import RangeEpoch
from sonofix.survey.gauge import freedom, laid_upon
from sonofix.survey.places import Wishes, survey

DRIVES = 50
PLACES = HALL[[0, 2, 4, 5, 6]]


def nees(way, seed: int, known: int, biases: str, count: int, lasting_m: float = 0.0) -> tuple[float, int]:
    """Squared error over covariance of one survey, open rigid motions taken out, and its degrees of freedom.

    ``lasting_m``: what each pair's ranges err by, the same in all epochs, and the site states as a doubt.
    """
    rng = np.random.default_rng(seed)
    sd = np.full(len(PLACES), 0.2)
    sd[:known] = 0.0
    site = hall(PLACES + sd[:, None] * rng.standard_normal(PLACES.shape), sd)
    bias = 0.05 * rng.standard_normal(len(PLACES)) if biases == "beacon" else 0.0
    epochs = heard(site, PLACES, way, count, rng, bias_m=bias, period_s=0.9)
    if lasting_m:
        epochs = lasting(epochs, lasting_m, rng)
    found = survey(site, epochs, Wishes(biases=biases, bias_sd_m=0.05))
    places = np.array([b.position_m for b in found.beacons])
    target = PLACES if known else laid_upon(PLACES, places, True)
    error = (places - target)[known:].ravel()
    covariance = found.covariance_m2[3 * known :, 3 * known :]
    free = freedom(places[known:], places[:known], True).basis
    inside = np.linalg.svd(np.hstack([free, np.zeros((len(error), len(error)))]))[0][:, free.shape[1] :]
    error, covariance = inside.T @ error, inside.T @ covariance @ inside
    return float(error @ np.linalg.solve(covariance, error)), len(error)


def lasting(epochs: list[RangeEpoch], sd_m: float, rng: np.random.Generator) -> list[RangeEpoch]:
    """Let each pair's ranges err by one amount throughout, as well known as a site file states it."""
    error = {f"B{i + 1}": sd_m * rng.standard_normal() for i in range(len(PLACES))}
    return [
        replace(
            epoch,
            range_m=epoch.range_m + [error[name] for name in epoch.emitter],
            covariance_m2=epoch.covariance_m2 + np.eye(len(epoch)) * sd_m**2,
            bias_sd_m=np.full(len(epoch), sd_m),
        )
        for epoch in epochs
    ]


LONG = pytest.mark.prove


@pytest.mark.parametrize(
    ("known", "biases"), [(0, "none"), pytest.param(2, "beacon", marks=LONG), pytest.param(0, "beacon", marks=LONG)]
)
def test_errors_are_as_large_as_stated(known: int, biases: str) -> None:
    totals = [nees(wander, seed, known, biases, 20) for seed in range(DRIVES)]
    total, degrees = (sum(part) for part in zip(*totals, strict=True))
    low, high = chi2.ppf([0.0005, 0.9995], degrees)
    # deviations are widened where residuals happen to be large, and never narrowed: some percent of variance
    assert 0.9 * low < total < high


def alike_for(epochs: list[RangeEpoch], sd_m: float, lasting_s: float, rng: np.random.Generator) -> list[RangeEpoch]:
    """Give each beacon's ranges an error that wanders: a first-order process of one deviation."""
    state, last_s, out = sd_m * rng.standard_normal(len(PLACES)), epochs[0].sync_s, []
    for epoch in epochs:
        keep = np.exp(-(epoch.sync_s - last_s) / lasting_s)
        state = keep * state + np.sqrt(1.0 - keep**2) * sd_m * rng.standard_normal(len(PLACES))
        last_s = epoch.sync_s
        spread = np.eye(len(epoch)) * sd_m**2
        out.append(replace(epoch, range_m=epoch.range_m + state, covariance_m2=spread))
    return out


@LONG
@pytest.mark.parametrize("lasting_s", [0.01, 1.0])
@pytest.mark.parametrize("biases", ["none", "pair"])
def test_errors_that_last_are_as_large_as_stated(biases: str, lasting_s: float) -> None:
    totals = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        site = hall(
            PLACES + np.array([[0], [0], [0.2], [0.2], [0.2]]) * rng.standard_normal((5, 3)), [0, 0, 0.2, 0.2, 0.2]
        )
        bias = 0.05 * rng.standard_normal(len(PLACES)) if biases == "pair" else 0.0
        epochs = heard(site, PLACES, wander, 120, rng, bias_m=bias, period_s=0.25, rates=False, range_sd_m=1e-6)
        found = survey(site, alike_for(epochs, 0.02, lasting_s, rng), Wishes(biases=biases, bias_sd_m=0.05))
        error = (np.array([b.position_m for b in found.beacons]) - PLACES)[2:].ravel()
        totals.append(float(error @ np.linalg.solve(found.covariance_m2[6:, 6:], error)))
        off = [(p.bias_m - b) / p.sd_m for p, b in zip(found.pairs, np.broadcast_to(bias, 5), strict=False)]
        assert np.all(np.abs(off) < 5.0)
    low, high = chi2.ppf([0.0005, 0.9995], 9 * len(totals))
    # how many in a row err alike is itself known to a quarter only
    assert 0.7 * low < sum(totals) < 1.3 * high


@pytest.mark.parametrize("biases", ["none", "beacon"])
def test_a_doubt_about_pairs_lasts(biases: str) -> None:
    # taken for noise that is new in each range, 2 cm would shrink with the root of 20 epochs
    totals = [nees(wander, seed, 2, biases, 20, lasting_m=0.02) for seed in range(10)]
    total, degrees = (sum(part) for part in zip(*totals, strict=True))
    low, high = chi2.ppf([0.0005, 0.9995], degrees)
    assert 0.9 * low < total < high


def test_errors_are_never_larger_than_stated_on_a_circle() -> None:
    for seed in range(4):
        value, degrees = nees(circle, seed, 0, "none", 26)
        assert value < chi2.ppf(1 - 1e-4, degrees)
