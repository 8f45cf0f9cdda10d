"""Odometry with white noise of its own, and ranges that others state: neither its scale nor theirs may drift away.

An arc that were averaged with the velocity before would tell, by its own noise, that wheels read too much.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import Drive, make_epoch, make_site
from sonofix.geometry import SIZE
from sonofix.records import Floats, Table
from sonofix.street import Street

FIELD = ((0.0, 0.0, 0.0), (40.0, 0.0, 0.0), (40.0, 30.0, 0.0), (0.0, 30.0, 0.0))
SECONDS, ROW_S = 240.0, 0.2


def mown(rng: np.random.Generator, uneven: float) -> tuple[Table, Floats, Floats]:
    """Return odometry of rows up and down a field, noise per √m, and times and poses (n, 3).

    1 m/s, and turns of 1 rad/s at the ends of rows.
    """
    time_s = np.arange(0.0, SECONDS, ROW_S)
    phase = time_s % 20.0
    turns = np.where(phase > 20.0 - np.pi, np.where((time_s // 20.0) % 2 == 0, 1.0, -1.0), 0.0)
    pose = np.zeros((len(time_s), 3))
    pose[0] = 8.0, 8.0, 0.0
    for k in range(1, len(time_s)):
        turn = turns[k - 1] * ROW_S
        middle = pose[k - 1, 2] + turn / 2
        bent = ROW_S * np.sinc(turn / (2 * np.pi))
        pose[k] = pose[k - 1] + [bent * np.cos(middle), bent * np.sin(middle), turn]
    speed = 1.0 + uneven / np.sqrt(ROW_S) * rng.standard_normal(len(time_s))
    columns = {"time_s": time_s, "v_mps": speed, "yaw_rate_radps": turns}
    return Table(columns, {"vehicle": ("v",) * len(time_s)}), time_s, pose


@pytest.mark.parametrize(("uneven", "most"), [(0.05, 2.6), (0.15, 4.0)])
def test_neither_scale_drifts(uneven: float, most: float) -> None:
    """Noise is two and a half, or seven and a half times as large as expected, and along the way alone.

    The latter is learnt within two minutes, as of odometry that strays alike to all sides: NEES stays above 2.
    """
    nees, scales, odds = [], [], []
    site = make_site(FIELD, level_m=0.0)
    pairs = tuple((b.id, m.id) for b in site.beacons for m in site.microphones)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        table, time_s, pose = mown(rng, uneven)
        street = Street(site)
        street.sense({"odometry": table}, stated=pairs)
        street.follower.start("v", 0.0, np.array([8.0, 8.0, 0.0]), 0.0)
        for k in range(int(SECONDS)):
            at_s = k + 0.5
            x, y = (float(np.interp(at_s, time_s, pose[:, i])) for i in range(2))
            epoch = make_epoch(site, Drive((x, y, 0.0)), sd_m=0.5, rng=rng, stated=True)
            heard = replace(epoch, time_s=np.full(4, at_s), sync_s=at_s)
            for got in street.walk(heard).estimates:
                off = got.position_m[:2] - [x, y]
                if at_s > SECONDS / 2 or uneven < 0.1:
                    nees.append(float(off @ np.linalg.solve(got.covariance[:2, :2], off)))
        belief = street.follower.belief
        scales.append(float(belief.mean[SIZE + 3]))
        odds.append(scales[-1] / float(np.sqrt(belief.covariance[SIZE + 3, SIZE + 3])))
    assert np.mean(nees) < most
    # of four runs the root of the mean square is above 2 once in a thousand
    assert np.sqrt(np.mean(np.square(odds))) < 2.15
    assert abs(np.mean(scales)) < 0.02
