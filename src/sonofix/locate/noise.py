"""What rows are uncertain by beyond their own measurement: beacon places, and motion within the epoch."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import Links
from sonofix.records import Floats, RangeEpoch

MANOEUVRE_MPS2 = 2.0
"""Acceleration (one sigma) within an epoch: rows heard some milliseconds apart see another velocity."""

TYPICAL_SPEED_MPS = 1.5
"""What a misplaced beacon's direction is taken to matter at."""

CLOCK_SPEED_SD = 1e-4
"""Deviation of a free clock's speed from the recorder's: two cheap crystals."""


@numba.njit(cache=True, error_model="numpy")
def fill_noise(
    range_m, covariance_m2, rate_sd_mps, misplaced_m, emitter, rows, dt, speed_sd_mps, clock_sd_mps, agile_mps2,
    out,
):  # fmt: skip
    """Fill ``out`` (m, m) as `row_noise` describes it.

    Of all rows of an epoch: ``range_m``, their covariance, ``rate_sd_mps`` (empty without rates: m = n), their
    emitters' ``misplaced_m``, and ``emitter``: a number each. Of the n rows asked for: ``rows`` and ``dt``.
    """
    n = len(rows)
    out[:] = 0.0
    for i in range(n):
        a = rows[i]
        for k in range(n):
            b = rows[k]
            out[i, k] = covariance_m2[a, b]
            # a beacon's misplacement is the same for all who hear it
            if emitter[a] == emitter[b]:
                out[i, k] += misplaced_m[a] ** 2
        out[i, i] += (agile_mps2 * dt[i] ** 2 / 2) ** 2 + (speed_sd_mps * dt[i]) ** 2
    if len(out) == n:
        return
    for i in range(n):
        a = rows[i]
        # a clock of its own runs at its own speed, which all range rates share
        for k in range(n):
            out[n + i, n + k] = clock_sd_mps**2
        # a misplaced beacon is seen in another direction, so that its range rate is another part of the velocity
        turned = TYPICAL_SPEED_MPS * misplaced_m[a] / max(abs(range_m[a]), 1.0)
        out[n + i, n + i] += rate_sd_mps[a] ** 2 + (agile_mps2 * dt[i]) ** 2 + turned**2


def row_noise(
    epoch: RangeEpoch,
    links: Links,
    rows: NDArray[np.int64],
    dt: Floats,
    speed_sd_mps: float = 0.0,
    clock_sd_mps: float = 0.0,
    agile_mps2: float = MANOEUVRE_MPS2,
) -> Floats:
    """Covariance (m, m) of some rows' ranges in m² and, below, of their range rates in m²/s², where there are any.

    Parameters
    ----------
    dt : float64 (n,)
        When each row was heard, from the instant the motion state belongs to.
    speed_sd_mps : float
        Deviation of a velocity that is taken as 0.
    clock_sd_mps : float
        Deviation of a clock's drift that is taken as 0.
    agile_mps2 : float
        Deviation of the acceleration, of which each row is taken to have another; 0 where it is told of elsewhere.
    """
    if links.emitter_sd_m.any():
        emitter = np.unique(np.array(epoch.emitter), return_inverse=True)[1]
    else:
        emitter = np.zeros(len(epoch), np.int64)
    rate_sd = np.zeros(0) if epoch.range_rate_sd_mps is None else epoch.range_rate_sd_mps
    out = np.empty((2 * len(rows),) * 2 if len(rate_sd) else (len(rows),) * 2)
    own = (epoch.range_m, np.ascontiguousarray(epoch.covariance_m2), rate_sd, links.emitter_sd_m, emitter)
    fill_noise(*own, rows, dt, speed_sd_mps, clock_sd_mps, agile_mps2, out)
    return out
