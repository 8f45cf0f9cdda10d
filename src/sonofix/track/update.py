"""Ranges and range rates straight into the belief: no fix is needed, one heard beacon still helps.

An iterated extended Kalman update in Joseph form. Rows far from what is expected are left out, row by row.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import Links, model
from sonofix.locate.noise import row_noise
from sonofix.records import Floats, RangeEpoch
from sonofix.track.belief import Belief

GATE_SIGMA = 5.0
"""A row this many deviations from its prediction is not believed."""


def update(
    belief: Belief, epoch: RangeEpoch, links: Links, candidates: NDArray[np.bool_], iterations: int = 4
) -> tuple[Belief, NDArray[np.bool_], Floats]:
    """Correct a belief, already predicted to the epoch's instant, by the epoch's rows.

    Parameters
    ----------
    candidates : bool (n,)
        Rows worth asking; those that touch a vehicle without a position are left out.

    Returns
    -------
    belief : Belief
    used : bool (n,)
    surprise : float64 (m,)
        Of the m rows asked: squared range innovation over its expected variance, 1 on average where that is true.
    """
    used = np.zeros(len(epoch), bool)
    placed = np.append(belief.placed, True)
    rows = np.flatnonzero(candidates & placed[links.emitter_vehicle] & placed[links.receiver_vehicle])
    if not len(rows) or (epoch.clock == "common" and not belief.free[-2]):
        return belief, used, np.zeros(0)
    dt = epoch.time_s[rows] - belief.time_s
    covariance_r, rates = row_noise(epoch, links, rows, dt)
    miss, derivative = _misfit(belief.mean, epoch, links.rows(rows), rows, dt)
    spread = np.einsum("ij,jk,ik->i", derivative, belief.covariance, derivative)
    n = len(rows)
    surprise = miss[:n] ** 2 / (spread[:n] + np.diag(covariance_r))
    near = surprise <= GATE_SIGMA**2
    if rates is not None:
        near &= np.abs(miss[n:]) <= GATE_SIGMA * np.sqrt(spread[n:] + np.diag(rates))
    if n > 2 and 2 * np.sum(near) < n:
        # most disagree: those that do not may do so by chance, and would drag the track along
        near[:] = False
    rows, dt = rows[near], dt[near]
    if not len(rows):
        return belief, used, surprise
    used[rows] = True
    n = len(rows)
    noise_all = covariance_r[np.ix_(near, near)]
    if rates is not None:
        ranges = noise_all
        noise_all = np.zeros((2 * n, 2 * n))
        noise_all[:n, :n] = ranges
        noise_all[n:, n:] = rates[np.ix_(near, near)]
    mean = belief.mean
    chosen = links.rows(rows)
    gain = derivative = np.zeros((0, 0))
    for _ in range(iterations):
        miss, derivative = _misfit(mean, epoch, chosen, rows, dt)
        crossed = belief.covariance @ derivative.T
        innovation = derivative @ crossed + noise_all
        gain = np.linalg.solve(innovation, crossed.T).T
        moved = belief.mean + gain @ (miss - derivative @ (belief.mean - mean))
        settled = float(np.max(np.abs(moved - mean))) < 1e-6
        mean = moved
        if settled:
            break
    keep = np.eye(len(mean)) - gain @ derivative
    covariance = keep @ belief.covariance @ keep.T + gain @ noise_all @ gain.T
    return replace(belief, mean=mean, covariance=(covariance + covariance.T) / 2), used, surprise


def _misfit(
    mean: Floats, epoch: RangeEpoch, links: Links, rows: NDArray[np.int64], dt: Floats
) -> tuple[Floats, Floats]:
    """Measured less expected ranges (then rates), and the derivative of what is expected by the whole state."""
    range_m, rate, by_range, by_rate = model(links, mean[:-2].reshape(-1, 8), dt, epoch.sound_speed_mps)
    clock = epoch.clock == "common"
    n = len(rows)
    derivative = np.zeros((n, len(mean)))
    derivative[:, :-2] = by_range.reshape(n, -1)
    miss = epoch.range_m[rows] - range_m
    if clock:
        # the clock's drift within an epoch is far below any range's deviation
        derivative[:, -2] = 1.0
        miss = miss - mean[-2]
        rate = rate + mean[-1]
    if epoch.range_rate_mps is None:
        return miss, derivative
    rates = np.zeros((n, len(mean)))
    rates[:, :-2] = by_rate.reshape(n, -1)
    rates[:, -1] = 1.0 if clock else 0.0
    return np.concatenate([miss, epoch.range_rate_mps[rows] - rate]), np.vstack([derivative, rates])
