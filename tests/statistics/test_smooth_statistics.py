"""Smoothed tracks over many runs whose truth is drawn from the filter's own model: errors as large as they say.

Bands are those of `test_track_statistics`. The last case begins without a heading: what its odometry tells enters far
from where it is linearised at first.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2
from test_track_statistics import CASES, MOTION, OUTSIDE, STATES, Case, draw_clock, draw_truth, epoch_at

from locate.made_epochs import HALL, Drive, make_epoch, make_site
from sonofix.locate.fix import fix
from sonofix.records import Estimate, Floats, Table
from sonofix.track import wheels
from sonofix.track.follow import Follower
from sonofix.track.inputs import gather
from sonofix.track.smooth import smooth


def measure(case: Case, runs: int, epochs: int, rng: np.random.Generator, rate_hz: float | None = None) -> Floats:
    """NEES (runs, epochs) of smoothed states."""
    site, out = case.site, np.zeros((runs, epochs))
    for r in range(runs):
        places, velocities = draw_truth(case, epochs, rng)
        offsets, speeds = draw_clock(case, epochs, rng)
        made = [epoch_at(case, site, places[k], velocities[k], k, (offsets[k], speeds[k]), rng) for k in range(epochs)]
        heard = [(e, (fix(e, site, "v"),) if k == 0 else ()) for k, e in enumerate(made)]
        track = smooth(lambda: Follower(site, MOTION, case.free_running), heard, rate_hz)
        for k, (got,) in enumerate(track):
            index = [got.states.index(s) for s in case.states]
            miss = np.concatenate([got.position_m - places[k], got.velocity_mps - velocities[k]])
            miss = miss[[STATES.index(s) for s in case.states]]
            out[r, k] = miss @ np.linalg.solve(got.covariance[np.ix_(index, index)], miss)
    return out


@pytest.mark.parametrize("name", CASES)
def test_smoothed_tracks_err_as_much_as_they_say(name: str, rng: np.random.Generator) -> None:
    case, runs, epochs = CASES[name], 30, 10
    nees = measure(case, runs, epochs, rng)
    low, high = chi2.interval(1 - OUTSIDE / epochs, runs * len(case.states))
    each = nees.sum(axis=0)
    assert ((low < each) & (each < high)).all(), each / (runs * len(case.states))


def odometry_drive(rng: np.random.Generator, seconds: float) -> tuple[Table, Floats, Floats]:
    """Odometry whose errors are those of the filter's model; true times and poses (n, 3) at its rows."""
    scale, bias = wheels.SCALE_SD * rng.standard_normal(), wheels.BIAS_SD_RADPS * rng.standard_normal()
    dt = 0.1
    yaw, place = rng.uniform(-3, 3), rng.uniform(3, 6, 2)
    rows, poses, speed, rate = [], [], 0.3, 0.0
    for k in range(round(seconds / dt) + 1):
        rows.append((dt * k, speed / (1 - scale), rate + bias))
        poses.append((*place, yaw))
        way, turn = speed * dt, rate * dt
        place = place + way * np.array([np.cos(yaw + turn / 2), np.sin(yaw + turn / 2)])
        place = place + np.sqrt(wheels.CREEP_PSD * dt + wheels.SLIP_M * way) * rng.standard_normal(2)
        twist = wheels.TWIST_PSD * dt + wheels.TWIST_M * way / (1 - scale) + wheels.TWIST_RAD * abs(turn)
        yaw += turn + np.sqrt(twist) * rng.standard_normal()
        rate = float(np.clip(rate + 0.1 * rng.standard_normal(), -0.5, 0.5))
        speed = float(np.clip(speed + 0.02 * rng.standard_normal(), 0.1, 0.5))
    table = np.array(rows)
    columns = {"time_s": table[:, 0], "v_mps": table[:, 1], "yaw_rate_radps": table[:, 2]}
    return Table(columns, {"vehicle": ("v",) * len(rows)}), table[:, 0], np.array(poses)


def errors_of(got: Estimate, pose: Floats) -> Floats:
    """NEES of x and y, and of the heading."""
    miss = got.position_m[:2] - pose[:2]
    yaw = float(np.angle(np.exp(1j * ((got.yaw_rad or 0.0) - pose[2])))) / (got.sd("yaw") or np.nan)
    return np.array([miss @ np.linalg.solve(got.covariance[:2, :2], miss), yaw**2])


def test_a_start_without_heading_is_linearised_until_its_errors_are_honest() -> None:
    site, runs, found = make_site(HALL, level_m=1.1), 25, []
    for seed in range(runs):
        rng = np.random.default_rng([23, seed])
        table, times, poses = odometry_drive(rng, 12.0)
        inputs = gather(site, {"odometry": table})
        drives = [Drive((*poses[5 * k, :2], 1.1)) for k in range(1, 24)]
        epochs = [make_epoch(site, d, times[5 * (k + 1)], sd_m=0.2, rng=rng) for k, d in enumerate(drives)]
        track = smooth(lambda inputs=inputs: Follower(site, inputs=inputs), [(e, (fix(e, site, "v"),)) for e in epochs])
        found.append([errors_of(got, poses[5 * k]) for k, (got,) in enumerate(track, start=1)])
    nees = np.array(found)

    for column, degrees in ((0, 2), (1, 1)):
        high = chi2.ppf(1 - OUTSIDE, degrees * runs) / runs
        assert nees[:, :, column].mean(axis=0).max() < high
