"""Biases of pairs that a site file knows only so well: a track holds on to their doubt however long it listens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site, rows_of
from sonofix.geometry import link
from sonofix.locate.fix import fix
from sonofix.records import Estimate, Floats, RangeEpoch
from sonofix.site import Pair, Site
from sonofix.track.belief import Motion, blank
from sonofix.track.follow import Follower
from sonofix.track.inputs import gather
from sonofix.track.update import expect, noise_of, pairs_of

PLACE = (3.0, 5.5, 1.1)
BIAS_SD_M = 0.02
CALM = Motion(acceleration_psd=1e-6, climb_psd=1e-6)


def biased_site(sd_m: float = BIAS_SD_M, count: int = len(HALL), **how) -> Site:
    site = make_site(HALL, **how)
    pairs = [
        Pair.model_validate({"from": b.id, "to": m.id, "bias_sd_m": sd_m})
        for b in site.beacons[:count]
        for m in site.microphones
    ]
    return site.model_copy(update={"pairs": tuple(pairs)})


def epochs_at_rest(site: Site, rng: np.random.Generator, count: int, own: bool, rates: bool = False):
    """Epochs of a vehicle at rest as `ranging` makes them, one error a pair for all of them."""
    n = len(site.beacons) * len(site.microphones)
    off_m: Floats | None = None
    for k in range(count):
        how = {"sd_m": 0.002, "rate_sd_mps": 0.01 if rates else None}
        epoch = make_epoch(site, Drive(PLACE), 0.5 * k, rng=rng, **how)
        pair_sd_m = np.array(
            [next((p.bias_sd_m for p in site.pairs if (p.emitter, p.receiver) == ends), 0.0)
             for ends in zip(epoch.emitter, epoch.receiver, strict=True)]
        )  # fmt: skip
        off_m = pair_sd_m * rng.standard_normal(n) if off_m is None else off_m
        yield replace(
            epoch,
            range_m=epoch.range_m + off_m,
            covariance_m2=epoch.covariance_m2 + np.diag(pair_sd_m**2),
            bias_sd_m=pair_sd_m,
            snr_db=np.full(n, 20.0) if own else None,
        )


def followed(site: Site, epochs: list[RangeEpoch], stated: bool = False) -> list[Estimate]:
    pairs = [(b.id, m.id) for b in site.beacons for m in site.microphones]
    follower = Follower(site, CALM, inputs=gather(site, {}, pairs if stated else None))
    out = []
    for epoch in epochs:
        estimates, _, _ = follower.step(epoch, tuple(fix(epoch, site, v.id) for v in site.vehicles))
        out += estimates
    return out


def test_epochs_do_not_average_a_bias_away(rng: np.random.Generator) -> None:
    site = biased_site(level_m=PLACE[2])
    epochs = list(epochs_at_rest(site, rng, 30, own=True))
    one = fix(epochs[0], site, "v")
    assert one.covariance is not None
    single_m = np.sqrt(np.diag(one.covariance)[:2])
    last = followed(site, epochs)[-1]
    # noise of 2 mm is nothing beside 2 cm: thirty epochs say no more of the place than the first did
    np.testing.assert_allclose([last.sd("x"), last.sd("y")], single_m, rtol=0.02)
    # the same doubt taken for noise is averaged down
    noisy = site.model_copy(update={"pairs": ()})
    assert followed(noisy, epochs)[-1].sd("x") < 0.6 * single_m[0]


@pytest.mark.parametrize("rates", [False, True])
def test_what_a_track_says_of_its_error_holds(rates: bool) -> None:
    # squared errors over covariance of 40 runs: chi-squared of 80 degrees over 40 is 2 ± 0.32 (one sigma)
    site = biased_site(level_m=PLACE[2])
    nees = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        last = followed(site, list(epochs_at_rest(site, rng, 5, own=True, rates=rates)))[-1]
        off = last.position_m[:2] - PLACE[:2]
        nees.append(off @ np.linalg.solve(last.covariance[:2, :2], off))
    assert 2 - 4 * 0.32 < np.mean(nees) < 2 + 4 * 0.32


def test_pairs_that_are_not_stated_have_no_state(rng: np.random.Generator) -> None:
    site = biased_site(count=2, level_m=PLACE[2])
    inputs = gather(site, {})
    assert inputs is not None
    assert len(inputs.pairs) == inputs.size == 2
    (epoch,) = epochs_at_rest(site, rng, 1, own=True)
    belief, rows = blank(site, inputs), np.arange(len(epoch))
    pair = pairs_of(belief, epoch, rows)
    assert pair.tolist() == [0, 1, -1, -1, -1, -1]
    links, dt = link(site, epoch.emitter, epoch.receiver), np.zeros(len(epoch))
    derivative = expect(links, belief, belief.mean, dt, epoch, pair)[1]
    noise = noise_of(belief, epoch, links, rows, dt, pair, derivative)
    np.testing.assert_allclose(np.diag(noise), 0.002**2)
    assert gather(make_site(HALL), {}) is None
    # a bias that is known for sure needs none
    assert gather(biased_site(sd_m=0.0), {}) is None


def test_the_doubt_of_stated_ranges_begins_where_the_site_file_says() -> None:
    site = biased_site(count=2)
    pairs = [(b.id, "M0") for b in site.beacons]
    inputs = gather(site, {}, pairs)
    assert inputs is not None
    belief = blank(site, inputs)
    slow = inputs.range_slot + 2 + np.arange(len(pairs))
    np.testing.assert_allclose(np.sqrt(np.diag(belief.covariance)[slow]), [BIAS_SD_M] * 2 + [0.1] * 4)


def test_a_range_less_of_an_epoch_keeps_each_pairs_bias(rng: np.random.Generator) -> None:
    site = biased_site(level_m=PLACE[2])
    full = list(epochs_at_rest(site, rng, 12, own=True))
    keep = np.array([0, 2, 3, 5])
    some = [replace(rows_of(e, keep), bias_sd_m=None if e.bias_sd_m is None else e.bias_sd_m[keep]) for e in full[6:]]
    track = followed(site, full[:6] + some)
    # fewer ranges later on leave the place as well known as it was
    assert track[-1].sd("x") == pytest.approx(track[5].sd("x"), rel=0.05)
    assert np.hypot(*(track[-1].position_m[:2] - track[5].position_m[:2])) < 0.005
