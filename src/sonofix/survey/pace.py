"""How a beacon keeps time: period, drift and jitter from when its bursts were heard."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, Pace

SIGNIFICANT = 4.0
LATEST_SHARE = 0.02
"""Of a period: bursts farther from the schedule are no part of it."""


def number_bursts(time_s: Floats, period_s: float) -> tuple[NDArray[np.int64], float]:
    """Number bursts by the period, and find the period itself (Theil–Sen on neighbours, then on the whole).

    Returns
    -------
    number : int64 (n,)
        From 0 on; missed bursts leave gaps.
    period_s : float
    """
    steps = np.maximum(1, np.round(np.diff(time_s) / period_s)).astype(np.int64)
    number = np.concatenate([[0], np.cumsum(steps)])
    if len(time_s) < 2:
        return number, period_s
    period = float(np.median(np.diff(time_s) / steps))
    for reach in (8, 64, 512):
        # over longer spans the same error of time weighs less
        apart = min(reach, len(time_s) - 1)
        spans = np.round((time_s[apart:] - time_s[:-apart]) / period)
        period = float(np.median((time_s[apart:] - time_s[:-apart]) / np.maximum(spans, 1)))
    number = np.concatenate([[0], np.cumsum(np.maximum(1, np.round(np.diff(time_s) / period)).astype(np.int64))])
    return number, period


def fit_pace(scheduled_s: Floats, heard_s: Floats, sd_s: Floats, used: NDArray[np.bool_], period_s: float) -> Pace:
    """Fit rate and drift to bursts; leave out those that stand off the others.

    Parameters
    ----------
    scheduled_s, heard_s, sd_s : float64 (n,)
        When due, when heard, and the deviation of that.
    used : bool (n,)
    period_s : float
        Nominal.
    """
    late = heard_s - scheduled_s
    late = late - late[used].mean()
    used = used.copy()
    middle = 0.5 * (scheduled_s[used].min() + scheduled_s[used].max())
    t = scheduled_s - middle
    degree = 2 if np.count_nonzero(used) >= 8 else 1
    for _ in range(10):
        base = np.vander(t[used], degree + 1, increasing=True)
        size = np.maximum(np.abs(base).max(axis=0), 1e-30)
        weights = _robust(base / size, late[used])
        coefficient = weights / size
        residual = late - np.vander(t, degree + 1, increasing=True) @ coefficient
        spread = max(1.4826 * float(np.median(np.abs(residual[used]))), float(np.median(sd_s[used])), 1e-9)
        wild = used & (np.abs(residual) > 6.0 * spread)
        if not wild.any() or np.count_nonzero(used & ~wild) < 3:
            break
        used &= ~wild
    if degree == 2:
        fitted = _fit(t[used], late[used], sd_s[used], 2)
        if abs(fitted[0][2]) < SIGNIFICANT * fitted[1][2]:
            degree = 1
    coefficient, deviation = _fit(t[used], late[used], sd_s[used], degree)
    residual = late - np.vander(t, degree + 1, increasing=True) @ coefficient
    tau, allan = _allan(scheduled_s[used], late[used], period_s)
    return Pace(
        scheduled_s=scheduled_s,
        late_s=late,
        residual_s=residual,
        used=used,
        rate=float(coefficient[1]),
        rate_sd=float(deviation[1]),
        drift_per_s=float(2 * coefficient[2]) if degree == 2 else None,
        drift_sd_per_s=float(2 * deviation[2]) if degree == 2 else None,
        jitter_s=float(np.sqrt(np.mean(residual[used] ** 2))),
        allan_tau_s=tau,
        allan=allan,
    )


def _robust(base: Floats, values: Floats) -> Floats:
    """Least absolute deviations, by reweighting."""
    weight = np.ones(len(values))
    solution = np.zeros(base.shape[1])
    for _ in range(20):
        solution = np.linalg.lstsq(base * weight[:, None], values * weight, rcond=None)[0]
        size = np.abs(values - base @ solution)
        weight = 1.0 / np.sqrt(np.maximum(size, max(float(np.median(size)) * 1e-2, 1e-12)))
    return solution


def _fit(t: Floats, late: Floats, sd_s: Floats, degree: int) -> tuple[Floats, Floats]:
    """Coefficients of a polynomial and their deviations, by the scatter or the stated deviations, whichever is more."""
    base = np.vander(t, degree + 1, increasing=True)
    size = np.maximum(np.abs(base).max(axis=0), 1e-30)
    solution = np.linalg.lstsq(base / size, late, rcond=None)[0] / size
    spare = max(len(t) - degree - 1, 1)
    variance = max(float(np.sum((late - base @ solution) ** 2)) / spare, float(np.mean(sd_s**2)))
    normal = (base / size).T @ (base / size)
    spread = np.linalg.pinv(normal) / np.outer(size, size)
    return solution, np.sqrt(variance * np.diag(spread))


def _allan(scheduled_s: Floats, late_s: Floats, period_s: float) -> tuple[Floats, Floats]:
    """Overlapping Allan deviation of the relative period from time errors (IEEE 1139, eq for x), gaps skipped."""
    number = np.round((scheduled_s - scheduled_s[0]) / period_s).astype(np.int64)
    apart = max(1, int(np.min(np.diff(number)))) if len(number) > 1 else 1
    x = np.full(int(number[-1]) // apart + 1, np.nan)
    x[number // apart] = late_s
    spans, deviations = [], []
    m = 1
    while 2 * m < len(x) and 2 * m <= len(x) // 2 + 1:
        second = x[2 * m :] - 2 * x[m:-m] + x[: -2 * m]
        second = second[np.isfinite(second)]
        if len(second) >= 2:
            spans.append(m * apart * period_s)
            deviations.append(float(np.sqrt(np.mean(second**2) / 2) / (m * apart * period_s)))
        m *= 2
    return np.array(spans), np.array(deviations)
