"""Tracks by the thousand: vehicles that hear the same fixed beacons, all aged and corrected in one compiled call.

Each vehicle is a filter of its own: place and velocity, white acceleration, ranges one by one in Joseph form. It
starts, and begins anew when its ranges agree on another place, from `locate.many.fix_many`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sonofix.locate.integrity import threshold
from sonofix.locate.many import fix_many
from sonofix.records import Floats
from sonofix.track.belief import Motion
from sonofix.track.follow import PATIENCE
from sonofix.track.kernel import absorb
from sonofix.track.update import GATE_SIGMA

START_SPEED_SD_MPS = 1.0
"""Of a vehicle that a fix without velocity has just placed, each axis."""

ITERATIONS = 4
"""Of one correction at most."""

BENT = 0.01
"""A correction is repeated about where it led while a range bends on the way there by more than this share of its
deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class Crowd:
    """What is believed of many vehicles at one instant.

    Attributes
    ----------
    time_s : float
    mean : float64 (V, 2 d)
        Place and velocity along d axes: x and y on a known level, else x, y and z. NaN until a vehicle is placed.
    covariance : float64 (V, 2 d, 2 d)
        NaN likewise.
    refused : int64 (V,)
        Epochs in a row in which most ranges of a vehicle were not believed.
    """

    time_s: float
    mean: Floats
    covariance: Floats
    refused: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of vehicles."""
        return len(self.mean)

    @classmethod
    def unknown(cls, count: int, level_known: bool, time_s: float = 0.0) -> Crowd:
        """Return vehicles of which nothing is known yet."""
        n = 4 if level_known else 6
        return cls(time_s, np.full((count, n), np.nan), np.full((count, n, n), np.nan), np.zeros(count, np.int64))


def follow_many(
    crowd: Crowd,
    time_s: float,
    anchors_m: ArrayLike,
    ranges_m: ArrayLike,
    variance_m2: ArrayLike,
    *,
    level_m: float | None = None,
    bounds_m: Sequence[Sequence[float]] | None = None,
    motion: Motion | None = None,
) -> tuple[Crowd, NDArray[np.bool_]]:
    """Age all vehicles to an instant and correct each by the ranges it heard then.

    Parameters
    ----------
    crowd : Crowd
    time_s : float
    anchors_m : float64 (b, 3)
        As `fix_many` takes them.
    ranges_m : float64 (V, b)
        NaN where not heard.
    variance_m2 : float64 (b,) or (V, b)
        Of each range, independent of the others.
    level_m : float or None
        The level that all vehicles move on; None: their height is followed.
    bounds_m : (2, 3) or None
        The room, for starts.
    motion : Motion or None

    Returns
    -------
    crowd : Crowd
    used : bool (V, b)

    Raises
    ------
    ValueError
        If shapes do not match, time goes backwards, or a range that was heard has no variance above 0.
    """
    anchors, ranges = np.ascontiguousarray(anchors_m, float), np.ascontiguousarray(ranges_m, float)
    if anchors.ndim != 2 or anchors.shape[1] != 3:
        raise ValueError(f"anchors_m has shape {anchors.shape}; give one row of x, y, z an anchor: (b, 3)")
    axes = 2 if level_m is not None else 3
    if crowd.mean.shape != (len(crowd), 2 * axes):
        raise ValueError(f"crowd.mean has shape {crowd.mean.shape}; with level_m {level_m} it is (V, {2 * axes})")
    if ranges.shape != (len(crowd), len(anchors)):
        raise ValueError(f"ranges_m has shape {ranges.shape}; give ({len(crowd)}, {len(anchors)}): vehicles, anchors")
    if time_s < crowd.time_s:
        raise ValueError(f"time_s {time_s} lies before the crowd's, {crowd.time_s}; give epochs in order")
    given = np.asarray(variance_m2, float)
    if given.shape not in ((len(anchors),), ranges.shape):
        raise ValueError(f"variance_m2 has shape {given.shape}; give ({len(anchors)},) or {ranges.shape}")
    variance = np.ascontiguousarray(np.broadcast_to(given, ranges.shape))
    if not np.all(variance[np.isfinite(ranges)] > 0.0):
        raise ValueError("variance_m2: a range that was heard has no variance above 0")
    motion = motion or Motion()
    mean, covariance, refused = crowd.mean.copy(), crowd.covariance.copy(), crowd.refused.copy()
    used = np.zeros(ranges.shape, bool)
    densities = np.array([motion.acceleration_psd, motion.acceleration_psd, motion.climb_psd])
    dt, level = float(time_s - crowd.time_s), float(level_m or 0.0)
    limits = np.array([threshold(count) for count in range(len(anchors) + 1)])
    _follow(mean, covariance, refused, dt, densities, anchors, ranges, variance, level, limits, used)
    lost = np.isnan(mean[:, 0]) | (refused >= PATIENCE)
    anew = np.flatnonzero(lost | (refused > 0))
    if len(anew):
        found = fix_many(anchors, ranges[anew], variance[anew], level_m=level_m, bounds_m=bounds_m)
        # ranges that agree on one place, with some to spare, gainsay a track at once; others must insist
        there = (found.status == 0) & (lost[anew] | (np.count_nonzero(found.used, axis=1) > axes))
        who = anew[there]
        mean[who], covariance[who] = 0.0, np.diag(np.repeat([0.0, START_SPEED_SD_MPS**2], axes))
        mean[who, :axes], covariance[who, :axes, :axes] = found.position_m[there, :axes], found.covariance[there]
        refused[who], used[who] = 0, found.used[there]
    return Crowd(float(time_s), mean, covariance, refused), used


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _follow(mean, covariance, refused, dt, densities, anchors, ranges, variance, level_m, limits, used):
    """Age and correct every vehicle that has a place, in place."""
    for v in numba.prange(len(mean)):
        if not np.isnan(mean[v, 0]):
            age(mean[v], covariance[v], dt, densities)
            asked, believed = correct(mean[v], covariance[v], anchors, ranges[v], variance[v], level_m, limits, used[v])
            refused[v] = refused[v] + 1 if 2 * believed < asked else 0


@numba.njit(cache=True, error_model="numpy")
def age(mean, covariance, dt, densities):
    """Move one vehicle's belief by ``dt``, in place, by white acceleration (Bar-Shalom 2001, eq 6.2.2-12)."""
    n, axes = len(mean), len(mean) // 2
    for a in range(axes):
        rate = axes + a
        mean[a] += dt * mean[rate]
        for k in range(n):
            covariance[a, k] += dt * covariance[rate, k]
        for k in range(n):
            covariance[k, a] += dt * covariance[k, rate]
        covariance[a, a] += densities[a] * dt**3 / 3
        covariance[a, rate] += densities[a] * dt**2 / 2
        covariance[rate, a] += densities[a] * dt**2 / 2
        covariance[rate, rate] += densities[a] * dt


@numba.njit(cache=True, error_model="numpy")
def _expected(place, axes, anchor, level_m, row):
    """Range to an anchor from a place (d,), and how it answers: the first d entries of ``row``."""
    square = 0.0
    for a in range(3):
        apart = (place[a] if a < axes else level_m) - anchor[a]
        square += apart**2
        if a < axes:
            row[a] = apart
    distance = max(np.sqrt(square), 1e-6)
    for a in range(axes):
        row[a] /= distance
    return distance


@numba.njit(cache=True, error_model="numpy")
def correct(mean, covariance, anchors, ranges, variance, level_m, limits, used):
    """Correct one vehicle by what it heard, in place; return how many ranges that were and how many are believed.

    A range `GATE_SIGMA` off what the motion lets expect is left out, and so is, while all together are too far off
    (``limits`` of χ² by their number), the one that disagrees most with the others; none is believed where more than a
    third would be left out: a few that are left agree with anything.
    """
    n, axes, count = len(mean), len(mean) // 2, len(ranges)
    row, work = np.zeros(n), np.empty((3, n))
    asked = believed = 0
    for i in range(count):
        used[i] = False
        if not np.isfinite(ranges[i]):
            continue
        asked += 1
        miss = ranges[i] - _expected(mean, axes, anchors[i], level_m, row)
        used[i] = miss**2 <= GATE_SIGMA**2 * (variance[i] + _variance(row, covariance, axes))
        believed += used[i]
    before, prior, about = mean.copy(), covariance.copy(), mean.copy()
    while believed and asked - believed <= max(1, asked // 3):
        chi2 = _absorb_all(mean, covariance, about, anchors, ranges, variance, level_m, used, row, work)
        for _ in range(ITERATIONS - 1):
            moved, nearest, least = 0.0, np.inf, np.inf
            for a in range(axes):
                moved += (mean[a] - about[a]) ** 2
            for i in range(count):
                if used[i]:
                    nearest = min(nearest, max(ranges[i], 0.1))
                    least = min(least, variance[i])
            # over a way across, a range bends by its square over twice the range
            if (moved / (2.0 * nearest)) ** 2 < BENT**2 * least:
                break
            about[:] = mean
            mean[:] = before
            covariance[:] = prior
            chi2 = _absorb_all(mean, covariance, about, anchors, ranges, variance, level_m, used, row, work)
        if chi2 <= limits[believed]:
            return asked, believed
        worst, far = -1, -1.0
        for i in range(count):
            if used[i]:
                miss = ranges[i] - _expected(mean, axes, anchors[i], level_m, row)
                # what is left of a range that was believed varies less than the range (Baarda's w-test)
                off = miss**2 / max(variance[i] - _variance(row, covariance, axes), 1e-6 * variance[i])
                if off > far:
                    worst, far = i, off
        used[worst] = False
        believed -= 1
        mean[:] = before
        covariance[:] = prior
        about[:] = before
    used[:] = False
    return asked, 0


@numba.njit(cache=True, error_model="numpy")
def _variance(row, covariance, axes):
    """Variance of a range by the place alone."""
    total = 0.0
    for a in range(axes):
        for b in range(axes):
            total += row[a] * covariance[a, b] * row[b]
    return total


@numba.njit(cache=True, error_model="numpy")
def _absorb_all(mean, covariance, about, anchors, ranges, variance, level_m, used, row, work):
    """Absorb every range believed, all straightened about one state; return the innovations' χ²."""
    axes, chi2 = len(mean) // 2, 0.0
    for i in range(len(ranges)):
        if used[i]:
            miss = ranges[i] - _expected(about, axes, anchors[i], level_m, row)
            for a in range(axes):
                miss -= row[a] * (mean[a] - about[a])
            chi2 += absorb(mean, covariance, row, miss, variance[i], work)
    return chi2
