"""The team afterwards: every instant of every robot by all that was heard before it and after.

Passes over the whole recording, each linearised about the track of the one before: Gauss–Newton on the joint problem
(Bell, SIAM J. Optim. 4(3), 1994). A pass runs the filter forward and a modified Bryson–Frazier smoother back (Bierman,
IEEE Trans. AC 18, 1973), which inverts nothing. Measurements are judged anew by what each pass leaves of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.belief import Belief, Moment
from sonofix.team.feed import COMPASS, SIGHTING, UNHEARD, Feed
from sonofix.team.hear import REFUSED, age, spread
from sonofix.team.kernel import advance, expect, turned_by
from sonofix.team.noise import BEARING, NEW, STAYING, Noise, fade, variance_of
from sonofix.team.spans import contradicted, spans, whole
from sonofix.team.state import POSE, SIZE, SLIP_S, SPEED_SLIP, TURN_SLIP, YAW, prior, wander_psd
from sonofix.track.kernel import absorb
from sonofix.track.wheels import COMPASS_SD_RAD, ROBUST

PASSES = 4

MEMORY_BYTES = 4e9
"""More than this is not asked for."""


def smooth(
    feed: Feed,
    moments: Sequence[Moment],
    belief: Belief,
    means: Floats,
    passes: int = PASSES,
    on_moment: Callable[[], None] = lambda: None,
) -> list[Moment]:
    """Smooth a run of the joint filter.

    Parameters
    ----------
    feed : Feed
    moments : sequence of Moment, as `fleet.follow` gave them
    belief : Belief
        The filter's last: its noise is what all of the recording taught.
    means : float64 (moments, SIZE V)
        The filter's means at each moment.
    passes : int
    on_moment : callable
        Is called for each moment of each pass.

    Returns
    -------
    list of Moment; robots have a place from their odometry's first row on

    Raises
    ------
    ValueError
        If the recording is too long to be held.
    """
    count, n = means.shape
    needed = 8.0 * count * n * n
    if needed > MEMORY_BYTES:
        raise ValueError(
            f"{count} moments of {n} states take {needed / 1e9:.1f} GB to smooth; cut the recording in parts"
        )
    # what was found wrong on the way is so from the beginning
    wrong = {pair for moment in moments for pair in moment.unheard}
    feed = feed.without({robot for moment in moments for robot in moment.gainsaid}, wrong)
    active, opened = spans(feed, moments)
    nominal = whole(feed, moments, means, active)
    errors = _errors(feed, belief.noise)
    judged = None
    blocks, used = np.zeros((len(moments), len(feed.robots), POSE, POSE)), np.zeros((len(feed.time_s), 2), bool)
    for _ in range(passes):
        smoothed, blocks, used = _pass(feed, moments, nominal, active, opened, errors, belief.rough, judged, on_moment)
        nominal = smoothed
        judged = _judge(feed, moments, nominal, active, errors)
    blocks[:, :, [0, 1], [0, 1]] += contradicted(moments, len(feed.robots))[:, :, None]
    out = []
    for k, moment in enumerate(moments):
        pose = nominal[k, : SIZE * len(feed.robots)].reshape(-1, SIZE)[:, :POSE]
        rows = slice(*moment.rows)
        out.append(
            replace(
                moment,
                pose=pose.copy(),
                covariance=blocks[k],
                placed=active[k].copy(),
                used=used[rows],
            )
        )
    return out


STAYS, LEFT = 2, 3


def _errors(feed: Feed, noise: Noise) -> Floats:
    """Return of each row (rows, 4) how it errs.

    Variances of what is new of its range and bearing; the deviation of its pair's error, and which part of that is left
    of the one before (1 where there is none).
    """
    out = np.full((len(feed.time_s), 4), np.nan)
    out[:, STAYS], out[:, LEFT] = 0.0, 1.0
    last = np.full((feed.views, 2), np.nan)
    for i in range(len(feed.time_s)):
        if feed.kind[i] == COMPASS:
            out[i, 1] = COMPASS_SD_RAD**2
        if feed.kind[i] != SIGHTING:
            continue
        view, who, range_m = feed.view[i], int(feed.listener[i]), float(feed.range_m[i])
        listener = who if who >= 0 else len(feed.robots)
        out[i, 0] = feed.range_sd_m[i] ** 2 if np.isfinite(feed.range_sd_m[i]) else 0.0
        swell = (1.0, 1.0) if noise.believed else noise.swell[listener]
        out[i, 1] = variance_of(noise.known, listener, BEARING, range_m) * swell[1]
        if not noise.believed and np.isfinite(range_m):
            out[i, 0] += variance_of(noise.known, listener, NEW, range_m) * swell[0]
            out[i, STAYS] = np.sqrt(variance_of(noise.known, listener, STAYING, range_m))
            out[i, LEFT] = fade(feed.time_s[i] - last[view, 0], range_m, last[view, 1], noise.fading)
            last[view] = feed.time_s[i], range_m
    return out


def _pass(
    feed: Feed,
    moments: Sequence[Moment],
    nominal: Floats,
    active: NDArray[np.bool_],
    opened: Floats,
    errors: Floats,
    rough: Floats,
    judged: Floats | None,
    on_moment: Callable[[], None],
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Run forward and back about a track; return the smoothed means, pose covariances and what was used."""
    count, n = nominal.shape
    robots = len(feed.robots)
    mean = nominal[0].copy()
    covariance = np.eye(n)
    covariance[: SIZE * robots, : SIZE * robots] = prior(robots, feed.own_ranges, feed.scale_sd)
    mean[SIZE * robots :] = 0.0
    for r in range(robots):
        mean[SIZE * r + POSE : SIZE * (r + 1)] = 0.0
    psd = wander_psd(feed.own_ranges)
    bys, drive_noise, speed = np.zeros((count, robots, POSE, SIZE)), np.zeros((robots, POSE, POSE)), np.zeros(robots)
    means, covariances = np.empty((count, n)), np.empty((count, n, n))
    kept, gains = np.zeros((2 * len(feed.time_s), n)), np.zeros((2 * len(feed.time_s), n))
    totals, misses = np.zeros(2 * len(feed.time_s)), np.zeros(2 * len(feed.time_s))
    ends = np.zeros(count + 1, np.int64)
    used = np.zeros((len(feed.time_s), 2), bool)
    times = np.array([moment.time_s for moment in moments])
    rows = np.array([moment.rows for moment in moments])
    weights = np.ones((len(feed.time_s), 2)) if judged is None else judged
    work = np.empty((3, n))
    for k, moment in enumerate(moments):
        if k:
            last = moments[k - 1].time_s
            advance(
                mean, covariance, nominal[k - 1], active[k], feed.first, feed.odometry_s, feed.odometry, last,
                moment.time_s, rough, psd, bys[k], drive_noise, speed,
            )  # fmt: skip
        for r in np.flatnonzero(active[k]).tolist():
            if opened[k, r].any():
                at = np.arange(SIZE * r, SIZE * r + POSE)
                if k == 0 or not active[k - 1, r]:
                    mean[at] = nominal[k, at]
                    if k == 0 and r in feed.starts:
                        mean[at] = feed.starts[r]
                        # a way run backwards may have turned round more often
                        mean[at[YAW]] = nominal[k, at[YAW]] + turned_by(feed.starts[r][YAW] - nominal[k, at[YAW]])
                    covariance[at, :] = covariance[:, at] = 0.0
                    bys[k, r][:] = 0.0
                covariance[at, at] += opened[k, r]
        ends[k + 1] = _hear(
            mean, covariance, nominal[k], active[k], moment.rows, feed.kind, feed.listener, feed.source,
            feed.listener_point, feed.source_point, feed.range_m, feed.bearing_rad, feed.view, errors, weights,
            judged is None, 1.0 / feed.sound_speed_mps, speed, feed.own_ranges, used, kept, gains, totals, misses,
            int(ends[k]), work,
        )  # fmt: skip
        means[k], covariances[k] = mean, covariance
        on_moment()
    smoothed, blocks = np.empty((count, n)), np.empty((count, robots, POSE, POSE))
    _back(
        means, covariances, bys, active, times, rows, feed.view, errors, kept, gains, totals, misses, ends, smoothed,
        blocks,
    )  # fmt: skip
    for k in range(count):
        for r in np.flatnonzero(~active[k]).tolist():
            smoothed[k, SIZE * r : SIZE * (r + 1)] = nominal[k, SIZE * r : SIZE * (r + 1)]
    return smoothed, blocks, used


@numba.njit(cache=True, error_model="numpy")
def _hear(
    mean, covariance, about, active, rows, kind, listener, source, listener_point, source_point, range_m, bearing_rad,
    view, errors, weights, gate, flight_s_per_m, speed, common, used, kept, gains, totals, misses, end, work,
):  # fmt: skip
    """Take rows in, linearised about a track, and keep what the way back needs; return where that ends."""
    n = len(mean)
    row = np.empty((2, n))
    first = SIZE * len(active)
    # errors of pairs fade all together, before anything is corrected, so that the way back may do so after
    for i in range(rows[0], rows[1]):
        if errors[i, LEFT] < 1.0:
            age(mean, covariance, first + view[i], errors[i, LEFT])
    for i in range(rows[0], rows[1]):
        a, b = listener[i], source[i]
        if kind[i] == UNHEARD or (a >= 0 and not active[a]) or (b >= 0 and not active[b]):
            continue
        shown = direction = 0.0
        if kind[i] == COMPASS:
            row[1, :] = 0.0
            row[1, SIZE * a + YAW] = 1.0
            direction = about[SIZE * a + YAW]
        else:
            shown, direction, _ = expect(
                about, a, b, listener_point[i], source_point[i], flight_s_per_m, speed, common, row
            )
            if errors[i, STAYS] > 0.0:
                row[0, first + view[i]] = errors[i, STAYS]
                shown += errors[i, STAYS] * about[first + view[i]]
        for j in (1, 0):
            measured = bearing_rad[i] if j == 1 else range_m[i]
            used[i, j] = False
            if not np.isfinite(measured) or (j == 1 and a < 0) or not weights[i, j] > 0.0:
                continue
            miss = turned_by(measured - direction) if j == 1 else measured - shown
            for m in range(n):
                if row[j, m] != 0.0:
                    miss -= row[j, m] * (mean[m] - about[m])
            variance = errors[i, j] / weights[i, j]
            total = spread(covariance, row[j]) + variance
            if gate and miss * miss > REFUSED * total:
                continue
            absorb(mean, covariance, row[j], miss, variance, work)
            kept[end], gains[end], totals[end], misses[end] = row[j], work[1], total, miss
            used[i, j] = True
            end += 1
    return end


@numba.njit(cache=True, error_model="numpy")
def _back(
    means, covariances, bys, active, times, heard, view, errors, kept, gains, totals, misses, ends, smoothed, blocks,
):  # fmt: skip
    """Smooth backwards: x − P λ and P − P Λ P, with λ and Λ carried back over measurements and drives."""
    count, n = means.shape
    robots = active.shape[1]
    adjoint, information = np.zeros(n), np.zeros((n, n))
    told = np.empty(n)
    carried = np.empty((3, n))
    for k in range(count - 1, -1, -1):
        for i in range(n):
            value = means[k, i]
            for j in range(n):
                value -= covariances[k, i, j] * adjoint[j]
            smoothed[k, i] = value
        for r in range(robots):
            at = SIZE * r
            rows = covariances[k, at : at + POSE]
            less = rows @ information @ rows.T
            blocks[k, r] = covariances[k, at : at + POSE, at : at + POSE] - 0.5 * (less + less.T)
        for m in range(ends[k + 1] - 1, ends[k] - 1, -1):
            row, gain = kept[m], gains[m]
            # (I − k hᵀ)ᵀ Λ (I − k hᵀ) + h hᵀ / s, and (I − k hᵀ)ᵀ λ − h y / s
            along = 0.0
            for i in range(n):
                value = 0.0
                for j in range(n):
                    value += information[i, j] * gain[j]
                told[i] = value
                along += value * gain[i]
            pull = 0.0
            for i in range(n):
                pull += gain[i] * adjoint[i]
            for i in range(n):
                adjoint[i] -= row[i] * (pull + misses[m] / totals[m])
                for j in range(n):
                    information[i, j] += (
                        row[i] * row[j] * (along + 1.0 / totals[m]) - row[i] * told[j] - told[i] * row[j]
                    )
        if k == 0:
            break
        for i in range(heard[k, 0], heard[k, 1]):
            if errors[i, LEFT] < 1.0:
                at = SIZE * robots + view[i]
                adjoint[at] *= errors[i, LEFT]
                for m in range(n):
                    information[at, m] *= errors[i, LEFT]
                    information[m, at] *= errors[i, LEFT]
        for r in range(robots):
            if not active[k, r]:
                continue
            at = SIZE * r
            by = bys[k, r]
            # slips fade after the drive, so first on the way back
            left = np.exp(-(times[k] - times[k - 1]) / SLIP_S)
            for j in (SPEED_SLIP, TURN_SLIP):
                adjoint[at + j] *= left
                for m in range(n):
                    information[at + j, m] *= left
                    information[m, at + j] *= left
            # Fᵀ λ, Fᵀ Λ F: columns of the pose spread to all of the robot's states
            for i in range(3):
                told[i] = adjoint[at + i]
            for i in range(3):
                adjoint[at + i] = 0.0
            for i in range(3):
                for j in range(SIZE):
                    adjoint[at + j] += by[i, j] * told[i]
            for i in range(3):
                for m in range(n):
                    carried[i, m] = information[at + i, m]
                    information[at + i, m] = 0.0
            for i in range(3):
                for j in range(SIZE):
                    for m in range(n):
                        information[at + j, m] += by[i, j] * carried[i, m]
            for i in range(3):
                for m in range(n):
                    carried[i, m] = information[m, at + i]
                    information[m, at + i] = 0.0
            for i in range(3):
                for j in range(SIZE):
                    for m in range(n):
                        information[m, at + j] += by[i, j] * carried[i, m]


def _judge(feed: Feed, moments: Sequence[Moment], nominal: Floats, active: NDArray[np.bool_], errors: Floats) -> Floats:
    """Return weights (rows, 2) by what a track leaves of each measurement; 0: not believed (Huber 1964, cut off)."""
    weights = np.zeros((len(feed.time_s), 2))
    row = np.empty((2, nominal.shape[1]))
    for k, moment in enumerate(moments):
        for i in range(*moment.rows):
            a, b = int(feed.listener[i]), int(feed.source[i])
            unheard = feed.kind[i] == UNHEARD
            if unheard or (a >= 0 and not active[k, a]) or (b >= 0 and not active[k, b]):
                continue
            if feed.kind[i] == COMPASS:
                left = np.array([np.nan, turned_by(feed.bearing_rad[i] - nominal[k, SIZE * a + YAW])])
            else:
                shown, direction, _ = expect(
                    nominal[k],
                    a,
                    b,
                    feed.listener_point[i],
                    feed.source_point[i],
                    1.0 / feed.sound_speed_mps,
                    moment.speed_mps,
                    feed.own_ranges,
                    row,
                )
                if errors[i, STAYS] > 0.0:
                    shown += errors[i, STAYS] * nominal[k, SIZE * len(feed.robots) + feed.view[i]]
                left = np.array([feed.range_m[i] - shown, turned_by(feed.bearing_rad[i] - direction)])
            off = np.abs(left) / np.sqrt(errors[i, :2])
            weight = np.where(off < np.sqrt(REFUSED), np.minimum(1.0, ROBUST / np.maximum(off, 1e-9)), 0.0)
            if feed.kind[i] == COMPASS:
                weight = np.minimum(1.0, ROBUST / np.maximum(off, 1e-9))
            elif weight[1] == 0.0 and np.isfinite(left[1]):
                weight[:] = 0.0
            weights[i] = np.nan_to_num(weight)
    return weights
