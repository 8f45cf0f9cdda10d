"""The adjustment: vehicles' states, beacons, biases, sound speed and clock at once, by damped Gauss–Newton."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.survey.normal import Normal, motion_residuals
from sonofix.survey.rows import Guess
from sonofix.survey.task import CAUCHY, Fit, Scale, Task, residuals

OUTLIER = 5.0
"""Residuals in deviations beyond which a row is left out in the end."""

STILL = 1e-6
"""A step ends the descent if it lowers the misfit by less than this share."""

STEPS = 60

LEAST = 1e-3
"""Share of an assumed deviation that residuals may prove."""


def adjust(task: Task, guess: Guess, on_step: Callable[[], None] | None = None) -> Fit:
    """Fit everything: robustly from far off, then without outliers, weights as residuals prove them.

    Deviations stand as stated, or are widened where residuals are larger: a bad model or understated noise must not
    come out as confidence.
    """
    drive = task.drive
    everything = np.ones(len(drive), bool)
    wide = np.inf
    for _ in range(40):
        if on_step is not None:
            on_step()
        residual = residuals(task, guess)
        # what is far off pulls as if so uncertain: the crowd is brought into line before single rows are judged
        spread = [_spread(residual[0]), _spread(residual[1])]
        scale = Scale(np.hypot(drive.range_sd_m, spread[0]), np.hypot(drive.rate_sd_mps, spread[1]), True, everything)
        guess, _ = descend(task, guess, scale, 3)
        if spread[0] > 0.98 * wide:
            break
        wide = spread[0]
    factors = _factors(task, guess, everything)
    used = _judged(task, guess, factors)
    information = np.zeros((len(task.mean),) * 2)
    chi2 = 0.0
    before = used
    for _ in range(4):
        if on_step is not None:
            on_step()
        scale = Scale(drive.range_sd_m * factors[0], drive.rate_sd_mps * factors[1], False, used)
        guess, (chi2, information) = descend(task, guess, scale, STEPS)
        before, factors = used, _factors(task, guess, used)
        used = _judged(task, guess, factors)
        if np.array_equal(before, used):
            break
    used = before
    counted = int(np.count_nonzero(used) + np.count_nonzero(used & np.isfinite(drive.rate_mps)))
    degrees = counted - _unknowns(task)
    return Fit(guess, information, residuals(task, guess), used, chi2, degrees, factors)


def _spread(residual: Floats) -> float:
    """Robust deviation of what is there; 0 where nothing is."""
    there = residual[np.isfinite(residual)]
    return 1.48 * float(np.median(np.abs(there))) if len(there) else 0.0


def _unknowns(task: Task) -> int:
    """Unknowns that rows pay for: what the motion prior and prior knowledge bring is not counted as theirs."""
    rates = bool(np.isfinite(task.drive.rate_mps).any())
    return task.followed + (task.poses if rates else 0)


def _factors(task: Task, guess: Guess, used: NDArray[np.bool_]) -> tuple[float, float]:
    """How much larger residuals are than stated deviations, unknowns accounted for; below 1 only where none is stated.

    That is, where the deviation of ranges is but an assumption.
    """
    drive, out = task.drive, []
    residual = residuals(task, guess)
    sds = (drive.range_sd_m, drive.rate_sd_mps)
    counted = sum(int(np.count_nonzero(np.isfinite(r) & used)) for r in residual)
    paid = np.sqrt(counted / max(counted - _unknowns(task), 0.05 * counted, 1.0))
    for k in range(2):
        there = np.isfinite(residual[k]) & used
        least = LEAST if k == 0 and not drive.sd_stated else 1.0
        out.append(max(least, paid * _spread((residual[k] / sds[k])[there])) if there.any() else 1.0)
    return out[0], out[1]


def _judged(task: Task, guess: Guess, factors: tuple[float, float]) -> NDArray[np.bool_]:
    """Rows (n,) that are no outliers."""
    residual, drive = residuals(task, guess), task.drive
    off = np.abs(residual[0]) / (drive.range_sd_m * factors[0])
    off = np.fmax(off, np.abs(residual[1]) / (drive.rate_sd_mps * factors[1]))
    return off < OUTLIER


def descend(task: Task, guess: Guess, scale: Scale, steps: int) -> tuple[Guess, tuple[float, Floats]]:
    """Take Levenberg–Marquardt steps; return where they led, the misfit there and the Schur complement."""
    damping = 1e-9
    cost = _cost(task, guess, scale)
    system = Normal(task, guess, scale)
    for _ in range(steps):
        found = None
        for _ in range(12):
            step = system.solve(damping)
            if step is not None:
                tried = task.moved(guess, *step)
                tried_cost = _cost(task, tried, scale)
                if tried_cost <= cost:
                    found = tried, tried_cost
                    break
            damping = max(10.0 * damping, 1e-7)
        if found is None:
            break
        gain = cost - found[1]
        guess, cost = found
        damping /= 10.0
        system = Normal(task, guess, scale)
        if gain <= STILL * max(cost, 1.0):
            break
    return guess, (cost, system.schur())


def _cost(task: Task, guess: Guess, scale: Scale) -> float:
    """Misfit: Cauchy's or the square of each residual, of ties between states, and of what is known before."""
    residual = residuals(task, guess)
    z = (residual / np.stack([scale.range_sd_m, scale.rate_sd_mps]))[:, scale.used]
    z = z[np.isfinite(z)]
    cost = float(np.sum(CAUCHY**2 * np.log1p((z / CAUCHY) ** 2) if scale.robust else z**2))
    off = task.shared(guess) - task.mean
    cost += float(np.sum(task.information * off**2))
    tied, own = motion_residuals(task, guess)
    return cost + float(np.sum(tied**2) + np.sum(own**2))
