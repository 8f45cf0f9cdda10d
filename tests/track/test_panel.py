"""Members of different sizes of errors, where nothing but others' ranges tells of a vehicle."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.flow import Street
from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site
from sonofix.track import stated
from sonofix.track.follow import Follower
from sonofix.track.panel import hear
from sonofix.track.smooth import smooth

ENDS_M = np.array([(0, 0, 2.5), (20, 0, 1.5), (20, 15, 2.5), (0, 15, 1.5), (10, -2, 2), (9, 17, 2)], float)
SITE = Site.model_validate(
    {
        "format": 1,
        "vehicle": [{"id": "walker", "z_m": 0.0}],
        "beacon": [{"id": f"B{i}", "position_m": end.tolist()} for i, end in enumerate(ENDS_M)],
        "microphone": [{"id": "tag", "vehicle": "walker", "lever_arm_m": [0.0, 0.0, 0.0]}],
    }
)
PAIRS = tuple((f"B{i}", "tag") for i in range(len(ENDS_M)))
PERIOD_S = 0.2


def heard(time_s: float, range_m: Floats, sd_m: float) -> RangeEpoch:
    count = len(ENDS_M)
    return RangeEpoch(
        index=round(time_s / PERIOD_S),
        sync_s=time_s,
        emitter=tuple(pair[0] for pair in PAIRS),
        receiver=("tag",) * count,
        time_s=np.full(count, time_s),
        range_m=range_m,
        covariance_m2=np.eye(count) * sd_m**2,
        range_rate_mps=None,
        range_rate_sd_mps=None,
        snr_db=None,
        clock="known",
        sound_speed_mps=343.0,
        sound_speed_sd_mps=0.0,
        sd_stated=False,
        bias_sd_m=None,
    )


@pytest.mark.parametrize("walks", [True, False])
def test_errors_that_wander_are_told(walks: bool) -> None:
    """Errors of 0.8 m that last 30 s: the track says that it is uncertain by them.

    Where each pair's sizes are learnt alone, 0.72 to 0.82 of it lie inside.
    """
    inside, square = [], []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        error, fade = rng.normal(0, 0.8, len(ENDS_M)), np.exp(-PERIOD_S / 30.0)
        street = Street(SITE)
        street.sense({}, stated=PAIRS)
        for k in range(600):
            time_s = PERIOD_S * k
            place = np.array([10 + 6 * np.cos(0.1 * time_s), 7.5 + 4 * np.sin(0.2 * time_s), 0.0])
            if not walks:
                place = np.array([4 + np.clip(time_s - 60, 0, 12), 5.0, 0.0])
            error = fade * error + 0.8 * np.sqrt(1 - fade**2) * rng.standard_normal(len(ENDS_M))
            range_m = np.linalg.norm(ENDS_M - place, axis=1) + error + rng.normal(0, 0.1, len(ENDS_M))
            for got in street.walk(heard(time_s, range_m, 0.1)).estimates:
                if time_s > 20:
                    off = np.abs(got.position_m[:2] - place[:2])
                    inside.append(bool(np.all(off < 2 * np.sqrt(got.covariance.diagonal()[:2]))))
                    square.append(float(off @ off))
    assert np.mean(inside) > 0.88
    assert np.sqrt(np.mean(square)) < 0.8


def test_a_first_place_by_stated_ranges_is_their_fix() -> None:
    rng = np.random.default_rng(3)
    range_m = np.linalg.norm(ENDS_M - [7.0, 6.0, 0.0], axis=1) + rng.normal(0, 0.1, len(ENDS_M))
    street = Street(SITE)
    street.sense({}, stated=PAIRS)
    step = street.walk(heard(0.0, range_m, 0.1))
    (found,), (told,) = step.fixes, step.estimates
    assert found.position_m is not None
    np.testing.assert_allclose(told.position_m, found.position_m, atol=1e-9)


def test_members_take_rows_as_the_textbook_does(rng: np.random.Generator) -> None:
    n, rows = 6, 4
    root = rng.standard_normal((n, n))
    mean, covariance = rng.standard_normal(n), root @ root.T
    derivative, variance = rng.standard_normal((rows, n)), rng.uniform(0.5, 1.5, rows)
    offset = derivative @ mean + 0.1 * rng.standard_normal(rows)
    x, p, told = mean[None].copy(), covariance[None].copy(), np.zeros(1)
    which = np.arange(rows)
    hear(x, p, derivative, offset, variance, which, np.ones(rows), 1e12, told, np.zeros((1, n), np.int64))
    gain = np.linalg.solve(derivative @ covariance @ derivative.T + np.diag(variance), derivative @ covariance).T
    np.testing.assert_allclose(x[0], mean + gain @ (offset - derivative @ mean), atol=1e-8)
    np.testing.assert_allclose(p[0], covariance - gain @ derivative @ covariance, atol=1e-8)


def test_a_pair_that_is_blocked_is_opened_at_last() -> None:
    """Rows far off tell a member nothing, until they keep on: then the pair's quick error takes what it misses."""
    x, p = np.zeros((1, 2)), np.eye(2)[None] * 0.01
    row, refused = np.array([[1.0, 1.0]]), np.zeros((1, 2), np.int64)
    for k in range(3):
        hear(
            x,
            p,
            row,
            np.array([9.0]),
            np.array([0.01]),
            np.array([1]),
            np.ones(1),
            stated.HEAVY,
            np.zeros(1),
            refused,
        )
        assert (abs(x[0, 1]) > 8.0) == (k == 2)
    assert abs(x[0, 0]) < 0.1


def test_smoothing_holds_what_its_members_hold() -> None:
    """Of errors of 0.8 m that last 30 s a smoothed track is better than the causal one, not far surer than right."""
    rng = np.random.default_rng(5)
    error, fade = rng.normal(0, 0.8, len(ENDS_M)), np.exp(-PERIOD_S / 30.0)

    def begin() -> Follower:
        street = Street(SITE)
        street.sense({}, stated=PAIRS)
        return street.follower

    street, epochs, told, places = Street(SITE), [], [], []
    street.sense({}, stated=PAIRS)
    for k in range(400):
        time_s = PERIOD_S * k
        place = np.array([10 + 6 * np.cos(0.1 * time_s), 7.5 + 4 * np.sin(0.2 * time_s), 0.0])
        error = fade * error + 0.8 * np.sqrt(1 - fade**2) * rng.standard_normal(len(ENDS_M))
        range_m = np.linalg.norm(ENDS_M - place, axis=1) + error + rng.normal(0, 0.1, len(ENDS_M))
        step = street.walk(heard(time_s, range_m, 0.1))
        epochs.append((step.ranges, step.fixes))
        told.append(step.estimates)
        places.append(place)

    def judged(tracks: list) -> tuple[float, float]:
        off = np.array([e.position_m[:2] - p[:2] for some, p in zip(tracks, places, strict=True) for e in some[:1]])
        spread = np.array([e.covariance[:2, :2] for some in tracks for e in some[:1]])
        nees = np.einsum("ti,ti->t", off, np.linalg.solve(spread, off[..., None])[..., 0])
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), float(np.mean(nees))

    causal_m, _ = judged(told)
    smoothed_m, nees = judged(smooth(begin, epochs))
    assert street.follower.likely
    assert smoothed_m < causal_m
    assert nees < 5.0
