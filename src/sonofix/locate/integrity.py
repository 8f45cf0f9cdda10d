"""When not to believe a fix: what a χ² test must notice, and how far off a fix that passes it may be.

A linear model ``y = J x + noise + bias``, noise of covariance C, W = C⁻¹; residuals are weighed by W. A bias f in some
rows leaves x wrong by ``A f``, A = (JᵀWJ)⁻¹JᵀW, and gives their χ² the noncentrality ``fᵀPf``, P = W − WJA: Baarda's
reliability theory (Netherlands Geodetic Commission 2(5), 1968) and receiver autonomous integrity monitoring (Brown,
Navigation 39(3), 1992, and in Parkinson & Spilker, Global Positioning System II, 1996, ch. 5). The error by a bias over
the root of its noncentrality is the *slope*: what error comes with how much to notice it by.

Estimate and χ² are independent, so that the risk of an error beyond a level L without an alarm is, whatever the bias,
at most the largest over λ of P(noise > L − slope √λ) P(χ²'(dof, λ) < threshold): no bias is assumed, and no fault is
taken to be as rare as a satellite's. Exclusion chooses among selections of rows; each gets its share of the risk (the
union bound that solution separation uses: Blanch et al., IEEE Trans. AES 51(1), 2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from sonofix.locate.dense import spread, whitener
from sonofix.locate.reliability import BLIND, largest, parts, steepest
from sonofix.records import Floats

FALSE_ALARM = 1e-5
"""Of the χ² test that a fix makes, per epoch: far below what is asked (1e-3), since real noise has wider tails."""

MISSED = 5e-4
"""Of a bias as large as the minimum detectable one: half of what is asked (1e-3)."""

RISK = 1e-7
"""Of an error beyond the protection level without an alarm, per epoch."""

GRID = 96
"""Noncentralities at which the risk is weighed; between two the worse of both ends is taken."""

MOST_SETS = 5000
"""Sets of rows that may be wrong together, looked at one by one: tens of milliseconds; with more no level is given."""


@lru_cache(maxsize=256)
def threshold(degrees: int, false_alarm_rate: float = FALSE_ALARM) -> float:
    """Return the χ² beyond which rows are taken to disagree; inf where none is left over to tell.

    Parameters
    ----------
    degrees : int
        Rows less unknowns.
    false_alarm_rate : float
        Probability that rows without fault go beyond.
    """
    from scipy.special import chdtri

    _check_rate("false_alarm_rate", false_alarm_rate)
    return float(chdtri(degrees, false_alarm_rate)) if degrees > 0 else float("inf")


@lru_cache(maxsize=256)
def noncentrality(degrees: int, false_alarm_rate: float = FALSE_ALARM, missed_rate: float = MISSED) -> float:
    """Return the noncentrality at which χ² stays below its threshold with probability ``missed_rate``.

    inf where no row is left over to tell.
    """
    from scipy.optimize import brentq
    from scipy.special import chndtr

    _check_rate("missed_rate", missed_rate)
    limit = threshold(degrees, false_alarm_rate)
    if degrees <= 0:
        return float("inf")

    def above(root: float) -> float:
        return float(chndtr(limit, degrees, root**2)) - missed_rate

    if above(0.0) <= 0:
        return 0.0
    root = brentq(above, 0.0, np.sqrt(limit) + 40.0, xtol=1e-9)
    return float(np.asarray(root)) ** 2


def slopes(jacobian: Floats, covariance: Floats, states: Sequence[int]) -> Floats:
    """Error of some unknowns (root of their squares' sum) per root of noncentrality, for a bias in each row alone.

    Parameters
    ----------
    jacobian : float64 (m, k)
        Derivative of rows by unknowns.
    covariance : float64 (m, m)
        Of the rows, full.
    states : sequence of int
        Which unknowns.

    Returns
    -------
    float64 (m,)
        inf where a bias would not show.

    Raises
    ------
    LinAlgError
        If the covariance is not positive.
    """
    white, whiten = _whiten(jacobian, covariance)
    gain, seen, size, rank = parts(white, whiten)
    if rank < white.shape[1]:
        return np.full(len(white), np.inf)
    chosen, alone = np.array(states, np.int64), np.arange(len(white))[:, None]
    return np.array([steepest(gain, seen, size, alone[i : i + 1], chosen) for i in range(len(white))])


def minimum_detectable_bias(
    jacobian: Floats, covariance: Floats, false_alarm_rate: float = FALSE_ALARM, missed_rate: float = MISSED
) -> Floats:
    """Smallest bias of each row alone that the χ² test notices (Baarda's internal reliability), of a linear model.

    What ranges that bend make of it, a fix can tell: `detectable.detectable_biases`.

    Parameters
    ----------
    jacobian : float64 (m, k)
        Derivative of rows by unknowns, not whitened.
    covariance : float64 (m, m)
        Of the rows, full.
    false_alarm_rate : float
        Of the test; `FALSE_ALARM` is what `fix` uses.
    missed_rate : float
        Of a bias of just this size, either sign.

    Returns
    -------
    float64 (m,)
        In the rows' unit; inf where a bias of that row cannot be noticed, whatever its size.

    Raises
    ------
    LinAlgError
        If the covariance is not positive.
    ValueError
        If a rate does not lie between 0 and 1.
    """
    _, seen, size, rank = parts(*_whiten(jacobian, covariance))
    needed, left = noncentrality(len(seen) - rank, false_alarm_rate, missed_rate), np.diag(seen)
    out = np.full(len(seen), np.inf)
    shows = left > BLIND * size
    out[shows] = np.sqrt(needed / left[shows])
    return out


def protection_levels(
    jacobian: Floats,
    covariance: Floats,
    horizontal: Sequence[int],
    vertical: int | None = None,
    *,
    risk: float = RISK,
    fault_probability: float = 1.0,
    false_alarm_rate: float = FALSE_ALARM,
    groups: NDArray[np.int64] | None = None,
    faults: int = 1,
    selections: int = 1,
) -> tuple[float, float | None]:
    """Levels that the horizontal and the vertical error exceed without an alarm at most with the stated risk.

    Parameters
    ----------
    jacobian : float64 (m, k)
        Derivative of rows by unknowns, not whitened.
    covariance : float64 (m, m)
        Of the rows, full.
    horizontal : sequence of int
        Which unknowns are x and y (or one of them).
    vertical : int or None
        Which is z; None where the level is known.
    risk : float
        Per epoch.
    fault_probability : float
        That an epoch has a fault at all. 1 assumes nothing: echoes are not rare.
    false_alarm_rate : float
        Of the χ² test that passed; `FALSE_ALARM` is what `fix` uses.
    groups : int (h, g) or None
        Rows that may be wrong together (a range and its rate); None: each row alone.
    faults : int
        How many of these at once.
    selections : int
        Among how many selections of rows these were chosen by their test.

    Returns
    -------
    hpl_m, vpl_m : float, float or None
        inf where a fault may go unnoticed at any size (too few rows, or fewer than faults), or where there are more
        than `MOST_SETS` ways to choose ``faults`` groups; vpl_m None where ``vertical`` is.

    Raises
    ------
    LinAlgError
        If the covariance is not positive.
    ValueError
        If a rate or risk does not lie between 0 and 1.
    """
    white, whiten = _whiten(jacobian, covariance)
    return levels(
        white,
        whiten,
        horizontal,
        vertical,
        risk=risk,
        fault_probability=fault_probability,
        false_alarm_rate=false_alarm_rate,
        groups=groups,
        faults=faults,
        selections=selections,
    )


def levels(
    white: Floats,
    whiten: Floats,
    horizontal: Sequence[int],
    vertical: int | None,
    *,
    risk: float = RISK,
    fault_probability: float = 1.0,
    false_alarm_rate: float = FALSE_ALARM,
    groups: NDArray[np.int64] | None = None,
    faults: int = 1,
    selections: int = 1,
) -> tuple[float, float | None]:
    """Do as `protection_levels`, from a whitened Jacobian (m, k) and what whitened it (m, m), lower triangular."""
    _check_rate("risk", risk)
    if not 0 <= fault_probability <= 1:
        raise ValueError(f"fault_probability {fault_probability}: give a probability")
    gain, seen, size, rank = parts(white, whiten)
    count = white.shape[1]
    deviation = np.empty((count, count))
    if rank < count or not spread(white, deviation):
        return np.inf, None if vertical is None else np.inf
    sets = np.arange(len(white))[:, None] if groups is None else np.asarray(groups, np.int64)
    if fault_probability and (faults > len(sets) or comb(len(sets), faults) > MOST_SETS):
        return np.inf, None if vertical is None else np.inf
    if fault_probability and faults > 1:
        chosen = np.array(list(combinations(range(len(sets)), faults)), np.int64).reshape(-1, faults)
        sets = sets[chosen].reshape(len(chosen), -1)
    # with a fault in every epoch there is no other kind to share the risk with
    each = risk if fault_probability in (0.0, 1.0) else risk / 2
    quiet_risk = each / selections
    faulted_risk = min(each / max(fault_probability, 1e-300), 0.5) / selections

    def level(states: NDArray[np.int64]) -> float:
        sd = largest(deviation, states)
        alone = sd * _quiet(quiet_risk, len(states))
        if not fault_probability:
            return alone
        slope = steepest(gain, seen, size, sets, states) if len(white) > count else np.inf
        if not np.isfinite(slope):
            return np.inf
        root, noise = _trade(len(white) - count, false_alarm_rate, faulted_risk, len(states))
        return max(alone, float(np.max(slope * root + sd * noise)))

    return level(np.array(horizontal)), None if vertical is None else level(np.array([vertical]))


def _whiten(jacobian: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    covariance = np.ascontiguousarray(covariance, float)
    whiten = np.empty_like(covariance)
    if not whitener(covariance, whiten):
        raise np.linalg.LinAlgError("covariance is not positive definite; give every row a deviation above 0")
    return whiten @ jacobian, whiten


def _deviations(probability: float | Floats, count: int) -> Floats:
    """Deviations beyond which the noise of one or two unknowns lies with a probability (two: by the longer axis)."""
    from scipy.special import ndtri

    likely = np.minimum(probability, 1.0)
    return np.asarray(-ndtri(likely / 2) if count == 1 else np.sqrt(-2 * np.log(likely)))


@lru_cache(maxsize=256)
def _quiet(probability: float, count: int) -> float:
    return float(_deviations(probability, count))


@lru_cache(maxsize=256)
def _trade(degrees: int, false_alarm_rate: float, risk: float, count: int) -> tuple[Floats, Floats]:
    """Roots of noncentrality, and how many deviations of noise must be allowed for up to each.

    The more a bias moves the fix, the less likely it passes the test, and the less noise need be feared beside it.
    """
    from scipy.special import chndtr

    root = np.linspace(0.0, np.sqrt(noncentrality(degrees, false_alarm_rate, min(risk, 0.5))), GRID)
    passes = chndtr(threshold(degrees, false_alarm_rate), degrees, root[:-1] ** 2)
    return root[1:], _deviations(risk / np.maximum(passes, risk), count)


def _check_rate(name: str, value: float) -> None:
    if not 0 < value < 1:
        raise ValueError(f"{name} {value}: give a probability between 0 and 1")
