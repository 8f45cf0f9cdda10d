"""A sound speed that the thermometer has wrong: told by redundant ranges, learnt from epoch to epoch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sonofix
from locate.made_epochs import HALL, SPEED, Drive, make_epoch, make_site
from sonofix.air import sound_speed_mps
from sonofix.locate.fix import fix
from sonofix.locate.sound_speed import SoundSpeed, thermometer
from sonofix.ranging import with_sound_speed
from sonofix.records import RangeEpoch, Table
from sonofix.site import AirSection, Site
from sonofix.street import Street

AIR = Path(__file__).parents[2].parent / "shared" / "captures" / "air"
PLACE = (3.0, 5.5, 1.1)
SD_M, SD_MPS = 2e-3, 0.6
SITE = make_site((*HALL, (0.0, 4.0, 1.5), (10.0, 4.0, 2.9)))


def wrong(epoch: RangeEpoch, off_mps: float, sd_mps: float = SD_MPS) -> RangeEpoch:
    """The same delays by a thermometer that is off."""
    return with_sound_speed(epoch, SPEED + off_mps, sd_mps)


def noisy(rng: np.random.Generator, site: Site = SITE, clock_m: float | None = None, time_s: float = 0.0) -> RangeEpoch:
    return replace(make_epoch(site, Drive(PLACE), sd_m=SD_M, clock_m=clock_m, rng=rng), sync_s=time_s)


def test_another_speed_and_back_is_the_same_epoch(rng: np.random.Generator) -> None:
    epoch = make_epoch(SITE, Drive(PLACE, (0.5, 0.1, 0.0)), rate_sd_mps=0.01, rng=rng)
    there = with_sound_speed(epoch, 350.0, 1.0)
    np.testing.assert_allclose(there.range_m, epoch.range_m * 350 / SPEED, rtol=1e-12)
    np.testing.assert_allclose(there.range_rate_mps, epoch.range_rate_mps * 350 / SPEED, rtol=1e-12)
    # one metre a second more or less is that share of each range, in all alike
    extra = there.covariance_m2 - (350 / SPEED) ** 2 * epoch.covariance_m2
    np.testing.assert_allclose(extra, np.outer(there.range_m, there.range_m) / 350**2, rtol=1e-9)
    back = with_sound_speed(there, SPEED, 0.0)
    np.testing.assert_allclose(back.range_m, epoch.range_m, rtol=1e-12)
    np.testing.assert_allclose(back.covariance_m2, epoch.covariance_m2, rtol=0, atol=1e-12)
    assert back.sound_speed_sd_mps == 0.0


@pytest.mark.parametrize("clock_m", [None, 20.0])
def test_a_fix_tells_the_speed_as_if_it_were_one_more_unknown(clock_m: float | None, rng: np.random.Generator) -> None:
    off = 0.8
    epoch = wrong(noisy(rng, clock_m=clock_m), off)
    found = fix(epoch, SITE, "v")
    assert found.status == "ok"
    # least squares with the scale as an unknown, the thermometer as one more row
    anchors = np.array([b.position_m for b in SITE.beacons])
    flight = epoch.range_m - (epoch.range_m.min() if clock_m is not None else 0.0)
    own = np.sqrt(np.diag(epoch.covariance_m2) - (SD_MPS / epoch.sound_speed_mps * flight) ** 2)
    state = np.array([*PLACE, 0.0, 0.0])
    free = [0, 1, 2, 3] + [4] * (clock_m is not None)
    normal = np.eye(5)
    for _ in range(20):
        away = state[:3] - anchors
        distance = np.linalg.norm(away, axis=1)
        columns = [away / distance[:, None], -flight[:, None] / epoch.sound_speed_mps, np.ones((8, 1))]
        jacobian = np.hstack(columns)[:, free] / own[:, None]
        miss = (epoch.range_m - distance + state[3] * flight / epoch.sound_speed_mps - state[4]) / own
        prior = np.array([0, 0, 0, 1 / SD_MPS, 0])[free]
        normal = jacobian.T @ jacobian + np.outer(prior, prior)
        state[free] += np.linalg.solve(normal, jacobian.T @ miss - prior * state[3] / SD_MPS)
    assert found.sound_speed_mps == pytest.approx(epoch.sound_speed_mps + state[3], abs=1e-6)
    covariance = np.linalg.inv(normal)
    assert found.sound_speed_sd_mps == pytest.approx(np.sqrt(covariance[3, 3]), rel=1e-5)
    np.testing.assert_allclose(found.position_m, state[:3], atol=1e-8)
    np.testing.assert_allclose(found.covariance[:3, :3], covariance[:3, :3], rtol=1e-5)
    assert abs(found.sound_speed_mps - SPEED) < 5 * found.sound_speed_sd_mps < 5 * SD_MPS


def test_a_speed_taken_as_it_is_is_not_told(rng: np.random.Generator) -> None:
    found = fix(noisy(rng), SITE, "v")
    assert found.sound_speed_mps is found.sound_speed_sd_mps is None


@pytest.mark.parametrize("off_mps", [-5.0, -2.4, 0.0, 2.4, 5.0])
def test_what_is_learnt_carries_over_and_is_reported(off_mps: float, rng: np.random.Generator) -> None:
    air, sds, told = SoundSpeed(), [], []
    for step in range(30):
        epoch = wrong(noisy(rng, time_s=0.5 * step), off_mps)
        asked, fixes, events = air.take(epoch, lambda e: (fix(e, SITE, "v"),))
        told += events
        assert fixes[0].status == "ok"
        assert fixes[0].used.all()
        away = fixes[0].position_m - PLACE
        assert away @ np.linalg.solve(fixes[0].covariance, away) < 36
        sds.append(fixes[0].sound_speed_sd_mps)
        assert asked.sound_speed_mps == pytest.approx(SPEED, rel=1e-3)
    assert air.sound_speed_mps == pytest.approx(SPEED, abs=5 * sds[-1])
    assert sds[-1] < 0.5 * sds[0] < 0.2
    assert [e.event for e in told] == ["sound-speed"]
    assert float(told[0].detail.split()[0]) == pytest.approx(SPEED, rel=1e-3)


@pytest.mark.parametrize("off_mps", [-2.4, 0.3])
def test_the_first_epoch_counts_once(off_mps: float, rng: np.random.Generator) -> None:
    epoch = wrong(noisy(rng), off_mps)
    asked, (first,), _ = SoundSpeed().take(epoch, lambda e: (fix(e, SITE, "v"),))
    # a thermometer that tells next to nothing: what these ranges know by themselves, which no second look adds to
    alone = fix(with_sound_speed(epoch, asked.sound_speed_mps, 100 * SD_MPS), SITE, "v")
    assert first.sound_speed_sd_mps == pytest.approx(alone.sound_speed_sd_mps, rel=2e-3)
    assert first.sound_speed_mps == pytest.approx(alone.sound_speed_mps, abs=0.02 * alone.sound_speed_sd_mps)


def test_ranges_without_redundancy_leave_the_thermometer_alone(rng: np.random.Generator) -> None:
    bare, air = make_site(HALL[:3], bounds_m=((0.0, 0.0, 0.0), (10.0, 8.0, 3.2))), SoundSpeed()
    epoch = wrong(noisy(rng, bare), 1.0)
    asked, _, events = air.take(epoch, lambda e: (fix(e, bare, "v"),))
    assert asked is epoch
    assert not events
    assert air.sound_speed_mps is None


def test_one_wrong_range_teaches_no_wrong_speed(rng: np.random.Generator) -> None:
    air = SoundSpeed()
    for step in range(12):
        heard = noisy(rng, time_s=0.5 * step)
        heard.range_m[step % 8] += 0.3
        epoch = wrong(heard, 2.4)
        _, fixes, _ = air.take(epoch, lambda e: (fix(e, SITE, "v"),))
        assert fixes[0].status != "ok" or not fixes[0].used[step % 8]
    assert air.sound_speed_mps == pytest.approx(SPEED, rel=1e-3)


def test_a_door_that_opens_is_followed(rng: np.random.Generator) -> None:
    air, told = SoundSpeed(), 0
    for step in range(60):
        air_mps = SPEED if step < 20 else SPEED + 4.0
        heard = noisy(rng, time_s=0.5 * step)
        # faster air brings the same way sooner, while the thermometer shows the same
        epoch = wrong(replace(heard, range_m=heard.range_m * SPEED / air_mps), 0.0)
        told += len(air.take(epoch, lambda e: (fix(e, SITE, "v"),))[2])
    assert air.sound_speed_mps == pytest.approx(SPEED + 4.0, rel=1e-3)
    assert told == 2


def warming(off_k: float = 0.0) -> Table:
    """A hall that warms by 6 K in a minute, by a thermometer that is read every two seconds; one cell is empty."""
    time_s = np.arange(0.0, 61.0, 2.0)
    told_c = 17.0 + time_s / 10 + off_k
    told_c[5] = np.nan
    return Table({"time_s": time_s, "temperature_c": told_c})


@pytest.mark.parametrize("off_k", [0.0, 2.0])
@pytest.mark.parametrize("beacons", [3, 8])
def test_a_hall_that_warms_is_followed_by_its_thermometer(beacons: int, off_k: float, rng: np.random.Generator) -> None:
    ends = (*HALL, (0.0, 4.0, 1.5), (10.0, 4.0, 2.9))[:beacons]
    site = make_site(ends, bounds_m=((0.0, 0.0, 0.0), (10.0, 8.0, 3.2)))
    site = site.model_copy(update={"air": AirSection(temperature_c=20.0)})
    street, away, sigmas = Street(site), [], []
    street.sense({"temperature": warming(off_k)})
    for step in range(120):
        true_mps = sound_speed_mps(17.0 + 0.05 * step)
        heard = noisy(rng, site, time_s=0.5 * step)
        scale = SPEED / true_mps
        epoch = wrong(replace(heard, range_m=heard.range_m * scale, time_s=heard.time_s + 0.5 * step), 0.0)
        epoch = with_sound_speed(epoch, site.sound_speed_mps, site.sound_speed_sd_mps)
        (told,) = street.walk(epoch).estimates
        miss = told.position_m - PLACE
        away.append(float(np.linalg.norm(miss)))
        sigmas.append(float(miss @ np.linalg.solve(told.covariance[:3, :3], miss)))
    rms_m = np.sqrt(np.mean(np.square(away)))
    if beacons == 8:
        # the thermometer's changes are followed, its error learnt
        assert rms_m < 0.006
        assert street.air.sound_speed_mps == pytest.approx(sound_speed_mps(22.95), rel=5e-4)
        assert np.mean(sigmas) < 3 * 1.5
    else:
        # nothing is to spare: the thermometer stands; the site's 20 °C alone would leave 3 K, and 6 cm
        assert rms_m < 0.015 or off_k != 0.0
        # a thermometer that is off by two of its deviations adds their square
        assert np.mean(sigmas) < 1.2 * (3 if off_k == 0.0 else 3 + 2**2)


def test_a_speed_that_the_site_states_needs_no_thermometer() -> None:
    assert thermometer(make_site(HALL), warming()) is None
    assert thermometer(make_site(HALL), None) is None


@pytest.mark.skipif(not AIR.is_dir(), reason="no recordings here")
def test_a_recording_with_a_thermometer_four_kelvin_off() -> None:
    recording = sonofix.read_recording(AIR)
    truth = sonofix.read_truth(AIR)
    truth = next(iter(truth.values())) if isinstance(truth, dict) else truth[0]
    away, last = [], None
    for step in sonofix.run(recording):
        (found,) = step.fixes
        at = [np.interp(found.time_s, truth.time_s, truth.position_m[:, i]) for i in range(2)]
        away.append(np.hypot(*(found.position_m[:2] - at)))
        last = found.sound_speed_mps
    assert np.sqrt(np.mean(np.square(away))) < 5e-3
    # 24.5 °C where the site says 20.5, by the linear rule of the recording's maker
    assert last == pytest.approx(331.5 + 0.607 * 24.5, rel=1e-3)
