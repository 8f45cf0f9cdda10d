"""Which rows to believe where each may be true by itself, but not all of them together.

A prediction that is good to decimetres lets an echo pass that is some decimetres late, and ranges of a millimetre then
take the track along. All rows together tell: their innovations y have the covariance S = H P Hᵀ + R, and the cost
yᵀ S⁻¹ y is χ² (Bar-Shalom 2001, sec. 5.4). Where it cannot be, hypotheses are weighed by their likelihoods (as in
multiple-hypothesis tracking: Reid 1979): a row is wrong, or the prediction is, or two of them. Which are as good as the
best is not decided: the state is all of theirs, with their scatter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sonofix.locate.integrity import threshold
from sonofix.records import Floats
from sonofix.track.kernel import joseph

FALSE_ALARM = 1e-6
"""Of the χ² test of all rows together: how often rows without fault are doubted, or a true hypothesis is not seen."""

UNDECIDED = 9.2
"""Hypotheses that are less likely than the best by less than this are not ruled out: odds of 100 to 1."""

EARLY = 4.6
"""What a hypothesis pays for a row it calls wrong that came too early: odds of 10 to 1, since an echo comes late."""

NOISE_SIGMA = 3.0
"""A row is too early by more deviations than this."""

FREER = 25.0
"""Factor on what was predicted, as a covariance, where the prediction is wrong: the most by which rows pass alone."""

TRIED = 12
"""Hypotheses of one kind that are solved: those likeliest where all rows have put the state."""


@dataclass(frozen=True, slots=True, eq=False)
class Peak:
    """The most likely state by what was predicted and m measurements, and what tells how likely it is.

    Attributes
    ----------
    mean : float64 (n,)
    derivative : float64 (m, n)
        Of the measurements, there.
    miss : float64 (m,)
        Innovations, linearised there.
    expected : float64 (m, m)
        Their covariance S.
    noise : float64 (m, m)
    gain : float64 (n, m)
    settled : bool
        Whether iterations came to it.
    """

    mean: Floats
    derivative: Floats
    miss: Floats
    expected: Floats
    noise: Floats
    gain: Floats
    settled: bool = True

    @property
    def cost(self) -> float:
        """Minus twice the log likelihood of mean and measurements at their best: χ² of m degrees."""
        return float(self.miss @ np.linalg.solve(self.expected, self.miss))

    @property
    def misfit(self) -> tuple[float, float]:
        """Part of the cost that is the measurements' own, and what is expected of it: their redundancy."""
        weighed = np.linalg.solve(self.expected, self.miss)
        return float(weighed @ self.noise @ weighed), float(np.trace(np.linalg.solve(self.expected, self.noise)))

    def evidence(self, factor: float = 1.0) -> tuple[float, bool]:
        """Minus twice the log likelihood of the measurements, but for a constant of each, and whether they may be so.

        ``factor`` is on the covariance of what was predicted.
        """
        expected = factor * (self.expected - self.noise) + self.noise
        cost = float(self.miss @ np.linalg.solve(expected, self.miss))
        return cost + float(np.linalg.slogdet(expected)[1]), cost <= limit(len(self.miss))

    def covariance(self, before: Floats) -> Floats:
        """Return the state's covariance, by Joseph's form, where ``before`` was predicted."""
        return joseph(before, self.gain, self.derivative, self.noise)


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """Rows believed (r,), the state they make most likely, and minus twice how likely that is, but for a constant."""

    kept: NDArray[np.bool_]
    peak: Peak
    weight: float


def odd(found: Peak) -> bool:
    """Whether rows cannot all be true together, or come to no state."""
    return not found.settled or found.cost > limit(len(found.miss))


def limit(count: int) -> float:
    """Return the cost of so many measurements beyond which they cannot all be true."""
    return threshold(count, FALSE_ALARM)


def likely(
    whole: Peak,
    count: int,
    before: Floats,
    solve: Callable[[NDArray[np.bool_]], Peak],
    look: Callable[[Floats], tuple[Floats, Floats, Floats]],
) -> list[Hypothesis]:
    """Return what may be true of rows that cannot be together, best first; nothing where no hypothesis is.

    One row is wrong, or else the prediction; if neither can be, two rows, or one and the prediction. A hypothesis whose
    state did not settle is among them where it is not ruled out.

    Parameters
    ----------
    whole : Peak
        By all rows.
    count : int
        Of rows.
    before : float64 (n, n)
        Covariance of what was predicted.
    solve : callable
        Gives the peak by some rows (r,).
    look : callable
        Gives of all rows at a mean: by how much ranges are too long, their derivative (r, n), their variance (r,).
    """
    weight, sound = whole.evidence(FREER)
    found = [Hypothesis(np.ones(count, bool), whole, weight)] if sound else []
    ones = _solved(whole, count, 1, solve)
    found += _weighed(ones, 1.0, before, look)
    if not found:
        found = _weighed(ones, FREER, before, look) + _weighed(_solved(whole, count, 2, solve), 1.0, before, look)
    found.sort(key=lambda one: one.weight)
    return [one for one in found if one.weight <= found[0].weight + UNDECIDED]


def mixed(hypotheses: list[Hypothesis], before: Floats) -> tuple[Floats, Floats]:
    """Return mean and covariance of the state where any hypothesis may be true: their mean, with their scatter.

    Each counts by the root of its likelihood (a tempered one: Grünwald 2012), so that the least likely of two, should
    it be true, lies within three and a half deviations.
    """
    share = np.exp([(hypotheses[0].weight - one.weight) / 4.0 for one in hypotheses])
    share /= share.sum()
    means = np.array([one.peak.mean for one in hypotheses])
    mean = share @ means
    covariance = (share[:, None] * (means - mean)).T @ (means - mean)
    for part, one in zip(share.tolist(), hypotheses, strict=True):
        covariance += part * one.peak.covariance(before)
    return mean, covariance


def _solved(
    whole: Peak, count: int, out: int, solve: Callable[[NDArray[np.bool_]], Peak]
) -> list[tuple[NDArray[np.bool_], Peak]]:
    """Solve without each choice of ``out`` rows, likeliest first; at least one row is left."""
    if count <= out:
        return []
    weighed = np.linalg.solve(whole.expected, whole.miss)
    inverse = np.linalg.solve(whole.expected, np.eye(len(weighed)))
    gains, choices = [], list(combinations(range(count), out))
    for choice in choices:
        # what the cost falls by where measurements are left out, all else being linear
        at = np.array([i for row in choice for i in range(row, len(weighed), count)])
        gains.append(float(weighed[at] @ np.linalg.solve(inverse[np.ix_(at, at)], weighed[at])))
    solved = []
    for k in np.argsort(gains)[::-1][:TRIED]:
        kept = np.ones(count, bool)
        kept[list(choices[k])] = False
        solved.append((kept, solve(kept)))
    return solved


def _weighed(
    solved: Iterable[tuple[NDArray[np.bool_], Peak]],
    factor: float,
    before: Floats,
    look: Callable[[Floats], tuple[Floats, Floats, Floats]],
) -> list[Hypothesis]:
    """Return those that may be so. A wrong row may be anything within a metre, and a metre a second."""
    found = []
    for kept, peak in solved:
        weight, sound = peak.evidence(factor)
        if sound:
            late_m, derivative, variance = look(peak.mean)
            spread = np.einsum("ij,jk,ik->i", derivative, peak.covariance(before), derivative) + variance
            early = np.count_nonzero(~kept & (late_m < -NOISE_SIGMA * np.sqrt(spread)))
            found.append(Hypothesis(kept, peak, weight + EARLY * early))
    return found
