"""A gyro carries the heading where nothing is heard, and its bias is learnt where something is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from locate.made_epochs import HALL, Drive, make_epoch, make_site, rows_of
from sonofix.locate.fix import fix
from sonofix.records import Floats, Table
from sonofix.street import Street
from sonofix.track import gyro
from sonofix.track.belief import estimate, predict
from sonofix.track.follow import Follower
from sonofix.track.inputs import GYRO, gather
from sonofix.track.smooth import smooth

SITE = make_site(HALL, arms_m=((0.2, 0.0, 0.0), (-0.2, 0.0, 0.0)), level_m=1.1)
BIAS_RADPS = 0.02
HEARD_S, END_S = 10.0, 15.0
RATE_HZ = 100.0


def yaw(time_s: Floats) -> Floats:
    """Turns to the left at 0.3 rad/s, and from when nothing is heard to the right at 0.4 rad/s."""
    return 0.3 * np.minimum(time_s, HEARD_S) - 0.4 * np.maximum(time_s - HEARD_S, 0.0)


def imu(rng: np.random.Generator, bias_radps: float = BIAS_RADPS) -> Table:
    times = np.arange(0.0, END_S + 0.1, 1 / RATE_HZ)
    rate = np.diff(yaw(np.append(times, times[-1] + 1 / RATE_HZ))) * RATE_HZ + bias_radps
    rate = rate + np.sqrt(gyro.NOISE_PSD * RATE_HZ) * rng.standard_normal(len(times))
    return Table({"time_s": times, "gz_radps": rate}, {"vehicle": ("v",) * len(times)})


def at_the_end(rng: np.random.Generator, table: Table | None) -> tuple[float, float]:
    """Error of the heading after five seconds of silence, and its deviation."""
    street = Street(SITE)
    street.sense({} if table is None else {"imu": table})
    for time_s in np.arange(0.1, HEARD_S, 0.5):
        still = Drive((4.0, 3.0, 1.1), yaw_rad=float(yaw(time_s)) - 0.3 * time_s, yaw_rate_radps=0.3)
        street.walk(make_epoch(SITE, still, float(time_s), sd_m=0.001, rate_sd_mps=0.002, rng=rng))
    got = estimate(predict(street.follower.belief, END_S, street.follower.motion), SITE, 0, "predicted")
    assert got.yaw_rad is not None
    return float(np.angle(np.exp(1j * (got.yaw_rad - yaw(np.array(END_S)))))), got.sd("yaw") or np.nan


def test_a_gyro_knows_the_heading_when_nothing_is_heard(rng: np.random.Generator) -> None:
    blind, _ = at_the_end(rng, None)
    carried, sd = at_the_end(rng, imu(rng))
    assert abs(blind) > 0.5
    assert abs(carried) < 0.03
    assert sd < 0.02


def test_a_gyro_is_as_good_as_it_says() -> None:
    runs = 40
    squares = []
    for k in range(runs):
        rng = np.random.default_rng([5, k])
        error, sd = at_the_end(rng, imu(rng, gyro.BIAS_SD_RADPS * rng.standard_normal()))
        squares.append((error / sd) ** 2)
    low, high = chi2.interval(1 - 1e-6, runs)
    # turns told half a percent wrong are allowed for, and are right here
    assert 0.1 * low < np.sum(squares) < high


def test_smoothing_leads_a_heading_through_silence(rng: np.random.Generator) -> None:
    street = Street(SITE)
    table, heard = imu(rng), []
    for time_s in np.arange(0.1, END_S, 0.5):
        rate = 0.3 if time_s < HEARD_S else -0.4
        still = Drive((4.0, 3.0, 1.1), yaw_rad=float(yaw(time_s) - rate * time_s), yaw_rate_radps=rate)
        epoch = make_epoch(SITE, still, float(time_s), sd_m=0.001, rate_sd_mps=0.002, rng=rng)
        heard.append((rows_of(epoch, np.arange(0) if 5.0 < time_s < 14.0 else np.arange(len(epoch))), ()))
    heard[0] = (heard[0][0], (fix(heard[0][0], SITE, "v"),))

    def begin() -> Follower:
        street.sense({"imu": table})
        return street.follower

    off = []
    for ((got,),) in zip(smooth(begin, heard), strict=True):
        assert got.yaw_rad is not None
        off.append((np.angle(np.exp(1j * (got.yaw_rad - yaw(np.array(got.time_s))))), got.sd("yaw") or np.nan))
    error, sd = np.array(off).T
    assert np.abs(error).max() < 0.01
    assert np.all(np.abs(error) < 5 * sd)
    assert sd.max() < 0.01


def test_its_bias_is_learnt(rng: np.random.Generator) -> None:
    street = Street(SITE)
    street.sense({"imu": imu(rng)})
    for time_s in np.arange(0.1, HEARD_S, 0.5):
        still = Drive((4.0, 3.0, 1.1), yaw_rad=0.0, yaw_rate_radps=0.3)
        street.walk(make_epoch(SITE, still, float(time_s), sd_m=0.001, rate_sd_mps=0.002, rng=rng))
    belief = street.follower.belief
    assert belief.inputs is not None
    slot = int(belief.inputs.gyro_slot[0]) + 1
    assert belief.mean[slot] == pytest.approx(BIAS_RADPS, abs=4 * np.sqrt(belief.covariance[slot, slot]))
    assert belief.covariance[slot, slot] < (0.2 * gyro.BIAS_SD_RADPS) ** 2


def test_rows_are_summed_exactly() -> None:
    times = np.arange(0.0, 1.0, 0.01)
    rate = np.sin(times)
    ends, turn, dt = gyro.summed(times, rate)
    assert np.isnan(turn[0])
    assert turn[1:].sum() == pytest.approx(float(np.sum(rate[:-1] * np.diff(times))))
    assert dt[1:].sum() == pytest.approx(times[-1])
    assert np.all(np.diff(ends)[:-1] > 0.049)


def test_gaps_and_empty_cells_tell_nothing(rng: np.random.Generator) -> None:
    times = np.array([0.0, 0.05, 0.1, 2.0, 2.05, 2.1])
    _, turn, _ = gyro.summed(times, np.array([1.0, np.nan, 1.0, 1.0, 1.0, 1.0]))
    np.testing.assert_array_equal(np.isnan(turn), [True, False, True, True, False, False])
    # a row that stands there twice, at the end of all
    _, turn, dt = gyro.summed(np.array([0.0, 0.05, 0.05]), np.ones(3))
    np.testing.assert_array_equal(dt[1:], [0.05, 0.0])
    mean, covariance, free = np.zeros(12), np.eye(12), np.ones(12, bool)
    gyro.take(mean, covariance, free, 0, 8, float(turn[2]), float(dt[2]))
    assert not mean.any()
    table = imu(rng)
    columns = {name: values.copy() for name, values in table.columns.items()}
    columns["gz_radps"][300:700] = np.nan
    error, sd = at_the_end(rng, replace(table, columns=columns))
    assert abs(error) < 5 * sd
    assert sd < 0.05


def test_a_lone_microphone_has_no_heading_to_turn(rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    street = Street(site)
    street.sense({"imu": imu(rng)})
    epoch = make_epoch(site, Drive((4.0, 3.0, 1.1)), 0.1, rng=rng)
    (got,) = street.walk(epoch).estimates
    (later,) = street.walk(replace(rows_of(epoch, [0, 1, 2, 3]), time_s=np.full(4, 0.6), sync_s=0.55)).estimates
    assert got.yaw_rad is None
    assert later.yaw_rad is None


def test_bodies_that_tilt_do_without(rng: np.random.Generator) -> None:
    arms = ((0.2, 0.0, 0.0), (-0.2, 0.1, 0.0), (-0.2, -0.1, 0.1))
    assert gather(make_site(HALL, arms_m=arms), {"imu": imu(rng)}) is None
    flat = gather(make_site(HALL, arms_m=arms, level_m=1.0), {"imu": imu(rng)})
    assert flat is not None
    assert np.all(flat.kind == GYRO)
