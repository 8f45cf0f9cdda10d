"""Ranges and range rates straight into the belief: no fix is needed, one heard beacon still helps.

An iterated extended Kalman update in Joseph form. Rows far from what is expected are left out, row by row.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import Links, rows_at
from sonofix.locate.noise import row_noise
from sonofix.records import Floats, RangeEpoch
from sonofix.track.belief import Belief

GATE_SIGMA = 5.0
"""A row this many deviations from its prediction is not believed."""

SETTLED = 1e-6
"""Iterations end when nothing in the state moves by more, in its own unit."""


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
    clock, with_rates = epoch.clock == "common", epoch.range_rate_mps is not None
    if not len(rows) or (clock and not belief.free[-2]):
        return belief, used, np.zeros(0)
    dt = epoch.time_s[rows] - belief.time_s
    noise = row_noise(epoch, links, rows, dt)
    measured = epoch.range_m[rows]
    stated = epoch.snr_db is None
    if epoch.range_rate_mps is not None:
        measured = np.concatenate([measured, epoch.range_rate_mps[rows]])
    links = links.rows(rows)
    shown, derivative = _expected(links, belief, belief.mean, dt, epoch, stated)
    miss = measured - shown
    crossed = derivative @ belief.covariance
    surprise = miss**2 / (np.einsum("ij,ij->i", crossed, derivative) + noise.diagonal())
    # a row is believed where its range is, and its rate if it has one
    near = (surprise <= GATE_SIGMA**2).reshape(-1, len(rows)).all(axis=0)
    surprise = surprise[: len(rows)]
    if len(rows) > 2 and 2 * np.count_nonzero(near) < len(rows):
        # most disagree: those that do not may do so by chance, and would drag the track along
        near[:] = False
    if not near.any():
        return belief, used, surprise
    used[rows[near]] = True
    if not near.all():
        both = np.tile(near, 2) if with_rates else near
        links, dt, measured, noise = links.rows(near), dt[near], measured[both], noise[both][:, both]
        miss, derivative, crossed = miss[both], derivative[both], crossed[both]
    mean, gain = belief.mean, np.zeros((0, 0))
    for k in range(iterations):
        if k:
            shown, derivative = _expected(links, belief, mean, dt, epoch, stated)
            miss, crossed = measured - shown, derivative @ belief.covariance
        gain = np.linalg.solve(crossed @ derivative.T + noise, crossed).T
        moved = belief.mean + gain @ (miss - derivative @ (belief.mean - mean))
        settled = float(np.abs(moved - mean).max()) < SETTLED
        mean = moved
        if settled:
            break
    keep = np.eye(len(mean)) - gain @ derivative
    covariance = keep @ belief.covariance @ keep.T + gain @ noise @ gain.T
    return replace(belief, mean=mean, covariance=(covariance + covariance.T) / 2), used, surprise


def _expected(
    links: Links, belief: Belief, mean: Floats, dt: Floats, epoch: RangeEpoch, stated: bool
) -> tuple[Floats, Floats]:
    """Return what rows would show at a mean, and its derivative; ranges stated by others with errors of their own."""
    clock, rates = epoch.clock == "common", epoch.range_rate_mps is not None
    shown, derivative = rows_at(links, mean, dt, epoch.sound_speed_mps, clock, rates, not belief.upright)
    if stated and belief.inputs is not None and belief.inputs.range_slot >= 0:
        slot, n = belief.inputs.range_slot, len(dt)
        derivative *= 1.0 + mean[slot]
        derivative[:n, slot], derivative[:n, slot + 1] = shown[:n], 1.0
        shown = shown * (1.0 + mean[slot])
        shown[:n] += mean[slot + 1]
    return shown, derivative


def strangeness(belief: Belief, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_]) -> float:
    """Minus twice the log likelihood (but for a constant) of all rows asked for, ranges and rates together."""
    placed = np.append(belief.placed, True)
    rows = np.flatnonzero(asked & placed[links.emitter_vehicle] & placed[links.receiver_vehicle])
    dt = epoch.time_s[rows] - belief.time_s
    shown, derivative = _expected(links.rows(rows), belief, belief.mean, dt, epoch, epoch.snr_db is None)
    measured = epoch.range_m[rows]
    if epoch.range_rate_mps is not None:
        measured = np.concatenate([measured, epoch.range_rate_mps[rows]])
    expected = derivative @ belief.covariance @ derivative.T + row_noise(epoch, links, rows, dt)
    miss = measured - shown
    return float(miss @ np.linalg.solve(expected, miss) + np.linalg.slogdet(expected)[1])
