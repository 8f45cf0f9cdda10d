"""What rows are uncertain by beyond their own measurement: beacon places, and motion within the epoch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import Links
from sonofix.records import Floats, RangeEpoch

MANOEUVRE_MPS2 = 2.0
"""Acceleration (one sigma) within an epoch: rows heard some milliseconds apart see another velocity."""

TYPICAL_SPEED_MPS = 1.5
"""What a misplaced beacon's direction is taken to matter at."""


def row_noise(
    epoch: RangeEpoch, links: Links, rows: NDArray[np.int64], dt: Floats, speed_sd_mps: float = 0.0
) -> tuple[Floats, Floats | None]:
    """Covariances (n, n) of ranges in m² and of range rates in m²/s², where there are any.

    ``dt`` (n,) is when each row was heard from the instant the motion state belongs to; ``speed_sd_mps`` the deviation
    of a velocity that is taken as 0.
    """
    covariance = epoch.covariance_m2[np.ix_(rows, rows)] + np.diag(
        (MANOEUVRE_MPS2 * dt**2 / 2) ** 2 + (speed_sd_mps * dt) ** 2
    )
    emitters = np.array([epoch.emitter[i] for i in rows])
    # a beacon's misplacement is the same for all who hear it
    covariance += np.where(emitters[:, None] == emitters, links.emitter_sd_m[rows] ** 2, 0.0)
    if epoch.range_rate_sd_mps is None:
        return covariance, None
    # a misplaced beacon is seen in another direction, so that its range rate is another part of the velocity
    turned = TYPICAL_SPEED_MPS * links.emitter_sd_m[rows] / np.maximum(np.abs(epoch.range_m[rows]), 1.0)
    return covariance, np.diag(epoch.range_rate_sd_mps[rows] ** 2 + (MANOEUVRE_MPS2 * dt) ** 2 + turned**2)
