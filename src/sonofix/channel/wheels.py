"""What a vehicle's wheels would tell of a motion: speed ahead and yaw rate, as an odometry table has them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sonofix.channel.motion import Motion
from sonofix.records import Table

WHEELS_HZ = 10.0


def odometry_of(motions: Mapping[str, Motion], duration_s: float, share: float, seed: int) -> Table:
    """Tell what wheels would, `WHEELS_HZ` times a second on the recorder's clock.

    Speed and yaw rate each err by a share that stays, and by noise that makes as much of a second's way.

    Parameters
    ----------
    motions : mapping from vehicle to Motion
    duration_s : float
    share : float
        Deviation of either error.
    seed : int

    Returns
    -------
    Table
        In order of time.

    Raises
    ------
    ValueError
        If the share is not from 0 to below 1.
    """
    if not 0 <= share < 1:
        raise ValueError(f"odometry off by a share of {share:g}: it must be 0 or more, and below 1")
    time_s = np.arange(0.0, duration_s + 1e-9, 1 / WHEELS_HZ)
    half_s = 0.5 / WHEELS_HZ
    told = np.empty((2, len(time_s), len(motions)))
    for column, motion in enumerate(motions.values()):
        rng = np.random.default_rng([seed, 9, column])
        poses, before, after = (motion.at(time_s + shift) for shift in (0.0, -half_s, half_s))
        ahead = np.column_stack([np.cos(poses.yaw_rad), np.sin(poses.yaw_rad)])
        # wheels tell the mean speed of the time about each row
        way = (after.position_m - before.position_m)[:, :2]
        true = np.stack([np.sum(way * ahead, axis=1), after.yaw_rad - before.yaw_rad]) * WHEELS_HZ
        lasting, noise = rng.standard_normal((2, 1)), np.sqrt(WHEELS_HZ) * rng.standard_normal(true.shape)
        told[:, :, column] = true * (1 + share * (lasting + noise))
    return Table(
        {
            "time_s": np.repeat(time_s, len(motions)),
            "v_mps": told[0].ravel(),
            "yaw_rate_radps": told[1].ravel(),
        },
        {"vehicle": tuple(motions) * len(time_s)},
    )
