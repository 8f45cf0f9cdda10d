"""Smoothing: what the filter knew at one instant, once all that came later is known too.

The Rauch-Tung-Striebel smoother (1965), for any filter whose every operation acts on one joint Gaussian: beside its
state the belief carries a copy of the state at the knot before. Whatever happens until the next knot, motion, sensors'
rows, ranges, a push, a vehicle placed anew, acts on both, so that at the next knot their joint Gaussian holds all that
ties the two: x_k given x_k+1 is ``offset + gain x_k+1``, with covariance ``rest`` (Bar-Shalom 2001, section 8.6).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.track.belief import Belief

CLOCK = 2
"""States at a belief's end, its clock: the copy stands before them."""

DEPENDENT = 1e-12
"""Eigenvalues of a correlation matrix below this are none: two states are one there, as a pose and its fresh anchor."""


@dataclass(frozen=True, slots=True, eq=False)
class Knot:
    """An instant that is smoothed: what the filter believed there, of what is estimated.

    Attributes
    ----------
    belief : Belief
        Without the copy.
    index : int (f,)
        Where its free states stand.
    """

    belief: Belief
    index: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """What a knot is, given the next: free states ``offset + gain (next knot's free states)``, covariance ``rest``."""

    offset: Floats
    gain: Floats
    rest: Floats


def copied(belief: Belief) -> Belief:
    """Return a belief that carries a copy of its free states, before the clock."""
    index, n = np.flatnonzero(belief.free), len(belief.mean)
    order = np.concatenate([np.arange(n - CLOCK), index, np.arange(n - CLOCK, n)])
    free = belief.free[order]
    free[n - CLOCK : n - CLOCK + len(index)] = False
    return replace(belief, mean=belief.mean[order], covariance=belief.covariance[np.ix_(order, order)], free=free)


def parted(belief: Belief, count: int) -> tuple[Belief, Floats, Floats, Floats]:
    """Part a belief from the copy of ``count`` states that it carries.

    Returns
    -------
    belief : Belief
    mean (count,), covariance (count, count) of the copy
    crossed : float64 (count, n), covariance of the copy with the state
    """
    n = len(belief.mean)
    own = np.concatenate([np.arange(n - CLOCK - count), np.arange(n - CLOCK, n)])
    old = np.arange(n - CLOCK - count, n - CLOCK)
    kept = replace(belief, mean=belief.mean[own], covariance=belief.covariance[np.ix_(own, own)], free=belief.free[own])
    return kept, belief.mean[old], belief.covariance[np.ix_(old, old)], belief.covariance[np.ix_(old, own)]


def tie(mean: Floats, covariance: Floats, crossed: Floats, after: Floats, after_covariance: Floats) -> Tie:
    """Condition earlier states on later ones, jointly Gaussian.

    ``mean`` (f,) and ``covariance`` (f, f) are of the earlier, ``after`` (g,) and ``after_covariance`` (g, g) of the
    later, ``crossed`` (f, g) between them. Later states may be known, or be each other's copies.
    """
    sd = np.sqrt(np.maximum(after_covariance.diagonal(), 0.0))
    scale = np.divide(1.0, sd, out=np.zeros_like(sd), where=sd > 0)
    value, vector = np.linalg.eigh(after_covariance * np.outer(scale, scale))
    sound = value > DEPENDENT * max(len(value), 1)
    half = scale[:, None] * vector[:, sound] / np.sqrt(value[sound])
    gain = (crossed @ half) @ half.T
    # Joseph's form: positive by construction
    rest = covariance - gain @ crossed.T - crossed @ gain.T + gain @ after_covariance @ gain.T
    return Tie(mean - gain @ after, gain, (rest + rest.T) / 2)


class Chain:
    """Knots in order of time, each tied to the next, and the belief that carries the last one's copy on."""

    def __init__(self) -> None:
        self.knots: list[Knot] = []
        self.ties: list[Tie] = []

    def knot(self, belief: Belief) -> Belief:
        """Make an instant a knot; return the belief to go on with.

        ``belief`` is that which the knot before returned, whatever happened to it meanwhile; any for the first knot.
        """
        if self.knots:
            belief, mean, covariance, crossed = parted(belief, len(self.knots[-1].index))
            index = np.flatnonzero(belief.free)
            own = belief.covariance[np.ix_(index, index)]
            self.ties.append(tie(mean, covariance, crossed[:, index], belief.mean[index], own))
        self.knots.append(Knot(belief, np.flatnonzero(belief.free)))
        return copied(belief)

    def back(self) -> Iterator[Belief]:
        """Return the smoothed beliefs, last knot first."""
        last = self.knots[-1]
        mean, covariance = last.belief.mean[last.index], last.belief.covariance[np.ix_(last.index, last.index)]
        yield last.belief
        for knot, tied in zip(self.knots[-2::-1], self.ties[::-1], strict=True):
            mean = tied.offset + tied.gain @ mean
            covariance = tied.rest + tied.gain @ covariance @ tied.gain.T
            covariance = (covariance + covariance.T) / 2
            whole_mean, whole = knot.belief.mean.copy(), np.zeros_like(knot.belief.covariance)
            whole_mean[knot.index] = mean
            whole[np.ix_(knot.index, knot.index)] = covariance
            yield replace(knot.belief, mean=whole_mean, covariance=whole)

    def forget(self, count: int) -> None:
        """Let go of the first knots."""
        del self.knots[:count], self.ties[:count]
