"""How ranges that others state err, and how calmly a vehicle moves, where nothing but these ranges tells of it.

Errors that wander and a vehicle that does look alike within seconds; over minutes they do not. So many filters run
beside the track on the same ranges, each with its own size and time of errors, and freedom of motion. How likely each
found what was heard weighs it, and where ranges are rough the track is their weighted mean with their scatter
(multiple-model estimation: Magill 1965; Bar-Shalom 2001, section 11.6.2). A size that was taken too small at first then
leaves no scale or bias behind that is told more surely than it is.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE, YAW
from sonofix.records import Floats
from sonofix.track import stated
from sonofix.track.belief import Belief, Motion, drift
from sonofix.track.held import hold
from sonofix.track.kernel import fade
from sonofix.track.tilt import step_of

QUICK_M = (0.3, 1.0, 3.0)
"""Deviations of quick errors of pairs."""

QUICK_S = (8.0, 32.0, 128.0)
"""Correlation times of quick errors."""

FREE_PSD = (1e-6, 1e-4, 1e-2, 1.0)
"""Densities of white acceleration in m²/s³."""

EXPECTED = (0.1, 0.1, 2.0, 0.5)
"""What is expected of these four before anything was heard."""

PRIOR_DECADES = (1.5, 1.5, 1.5, 3.0)
"""Deviations of that, in powers of ten."""

MEMORY_S = 1000.0
"""What was heard longer ago hardly counts."""

ANEW_S = 64.0
"""A pair's ranges tell anew how they err after so long, twice the time that errors are expected to last: the mean of
errors that last τ is as good as one of independent ones 2τ apart. Taken for news each, they would make one member
certain that is only the least wrong (a tempered likelihood: Grünwald 2012)."""

PLACED = 3.0
"""A place that began from such ranges is off by so many times as much."""

BEGUN_MPS = 0.5
"""How fast a vehicle may be there, beyond what its track knows."""

WORST = 20.0
"""By how much, in log likelihood, a member may be less likely than the best: one that is unlikely now may soon be
right, when a vehicle sets off or a pair's way is blocked (as probabilities of transition keep it: Blom and Bar-Shalom
1988)."""

GATE = 25.0
"""Squared innovation, over its variance, beyond which a row tells a member nothing."""

PATIENCE = 3
"""Rows of a pair in a row that tell nothing, after which its quick error is opened by what it misses."""

MOST_PAIRS = 12
"""Of more, each pair's errors are learnt by itself (`stated`): members cost the square of their number, and so many
pairs hold each other to the truth."""

SILENT_S = 10.0
"""After longer silence members begin anew where the track is found: their rows are linearised once, where it expects
the vehicle."""

ROUGH_M = 0.3
"""Where ranges err by more, several times what is expected of them, the track is what the members hold; else each
pair's errors are best learnt by themselves (`stated.Trust`)."""

NEARLY_ALL = 0.95
"""Of the weight; members that hold the rest change nothing worth their time."""

MEMBERS = np.array(list(product((stated.BEGIN_SD_M,), QUICK_M, QUICK_S, FREE_PSD)))
"""Of each (K, 4): slow and quick deviation, quick time, density of acceleration."""


@numba.njit(cache=True, error_model="numpy")
def go(mean, covariance, free, member, dt, densities, tilt, tilt_noise, slot, pairs, lasting_s):
    """Age all members by ``dt``, in place.

    ``mean`` (K, n), ``covariance`` (K, n, n), ``free`` (n,); ``densities`` (2,) of climbs and turns; ``tilt`` (2, 2)
    and ``tilt_noise`` (2, 2) move roll and pitch; ``slot`` is where errors of ranges stand.
    """
    n = mean.shape[1]
    span = abs(dt)
    first = slot + 2
    for k in range(len(mean)):
        x, p = mean[k], covariance[k]
        for part in range(4):
            at, rate = part, part + 4
            if not free[rate]:
                continue
            drift(x, p, at, rate, free[at], member[k, 3] if part < 2 else densities[part - 2], dt)
        if free[8]:
            for pair in range(2):
                at, rate = 8 + pair, 10 + pair
                a, b = x[at], x[rate]
                x[at], x[rate] = tilt[0, 0] * a + tilt[0, 1] * b, tilt[1, 0] * a + tilt[1, 1] * b
                for j in range(n):
                    a, b = p[at, j], p[rate, j]
                    p[at, j], p[rate, j] = tilt[0, 0] * a + tilt[0, 1] * b, tilt[1, 0] * a + tilt[1, 1] * b
                for j in range(n):
                    a, b = p[j, at], p[j, rate]
                    p[j, at], p[j, rate] = tilt[0, 0] * a + tilt[0, 1] * b, tilt[1, 0] * a + tilt[1, 1] * b
                p[at, at] += tilt_noise[0, 0]
                p[at, rate] += tilt_noise[0, 1]
                p[rate, at] += tilt_noise[1, 0]
                p[rate, rate] += tilt_noise[1, 1]
        slow, quick = np.exp(-span / lasting_s), np.exp(-span / member[k, 2])
        for i in range(first, first + 2 * pairs):
            sd = member[k, 0] if i < first + pairs else member[k, 1]
            fade(x, p, i, slow if i < first + pairs else quick, sd * sd)


@numba.njit(cache=True, error_model="numpy")
def hear(mean, covariance, rows, offset, variance, quick, news, freedom, told, refused):
    """Correct all members by ranges ``offset = rows x + noise``, in place, and add log likelihoods to ``told`` (K,).

    ``news`` (r,) is how much of each row's error is news of its pair; ``quick`` (r,) is where each row's quick error
    stands; ``refused`` (K, n) counts rows in a row that told nothing.
    """
    n = mean.shape[1]
    work = np.empty(n)
    for r in range(len(rows)):
        row = rows[r]
        some = np.flatnonzero(row)
        for k in range(len(mean)):
            x, p = mean[k], covariance[k]
            work[:] = 0.0
            miss, expected = offset[r], 0.0
            for i in some:
                miss -= row[i] * x[i]
                for j in range(n):
                    work[j] += row[i] * p[i, j]
            for i in some:
                expected += row[i] * work[i]
            spread = expected + variance[r]
            surprise = miss * miss / spread
            told[k] -= 0.5 * news[r] * ((freedom + 1.0) * np.log1p(min(surprise, GATE) / freedom) + np.log(spread))
            if surprise > GATE:
                refused[k, quick[r]] += 1
                if refused[k, quick[r]] < PATIENCE:
                    continue
                own = quick[r]
                p[own, own] += miss * miss
                work[own] += row[own] * miss * miss
                expected += row[own] ** 2 * miss * miss
                surprise = miss * miss / (expected + variance[r])
            refused[k, quick[r]] = 0
            heavier = (freedom + 3.0) * (freedom + surprise) / (freedom + 1.0) ** 2
            total = expected + heavier * variance[r]
            for j in range(n):
                x[j] += work[j] * miss / total
            root = np.sqrt(total)
            for j in range(n):
                work[j] /= root
            for i in range(n):
                for j in range(n):
                    p[i, j] -= work[i] * work[j]


class Panel:
    """Filters of the one vehicle of a site, of different sizes of errors and freedom of motion."""

    def __init__(self) -> None:
        self._prior = -0.5 * np.sum((np.log10(MEMBERS / EXPECTED) / PRIOR_DECADES) ** 2, axis=1)
        self._told = np.zeros(len(MEMBERS))
        self._mean = np.zeros((0, 0))
        self._covariance = np.zeros((0, 0, 0))
        self._free = np.zeros(0, bool)
        self._now_s: float | None = None

    @property
    def weight(self) -> Floats:
        """Probabilities (K,) of the members."""
        odds = self._prior + self._told
        weight = np.exp(odds - odds.max())
        return weight / weight.sum()

    @property
    def sizes(self) -> Floats:
        """Slow and quick deviation (m), quick time (s), density of acceleration (m²/s³): weighted, as logarithms."""
        return np.exp(self.weight @ np.log(MEMBERS))

    def likely(self) -> list[tuple[float, Floats]]:
        """Weight and sizes of the likeliest members, which hold `NEARLY_ALL` of the weight."""
        weight = self.weight
        order = np.argsort(-weight)
        count = int(np.searchsorted(np.cumsum(weight[order]), NEARLY_ALL)) + 1
        return [(float(weight[k]), MEMBERS[k]) for k in order[:count]]

    def silent(self, time_s: float) -> bool:
        """Whether nothing was heard for long."""
        return self._now_s is not None and time_s - self._now_s > SILENT_S

    def forget(self) -> None:
        """Begin anew at the next epoch: the vehicle was placed elsewhere; how likely members are stays."""
        self._now_s = None

    def begin(self, belief: Belief) -> None:
        """Begin at a belief's place, with errors of which nothing is known."""
        inputs = belief.inputs
        assert inputs is not None
        slot, pairs, count = inputs.range_slot, len(inputs.pairs), len(MEMBERS)
        n = SIZE * len(belief.placed) + inputs.size
        self._free = belief.free[:n].copy()
        mean, covariance = belief.mean[:n].copy(), belief.covariance[:n, :n].copy()
        stated.begin(mean, covariance, self._free, slot, inputs.known_sd_m)
        self._mean, self._covariance = np.tile(mean, (count, 1)), np.tile(covariance, (count, 1, 1))
        slow, quick = slot + 2 + np.arange(pairs), slot + 2 + pairs + np.arange(pairs)
        where = [i for i in range(YAW) if self._free[i]]
        speeds = [i for i in range(YAW + 1, YAW + 4) if self._free[i]]
        unknown = np.isnan(inputs.known_sd_m)
        for k, (slow_m, quick_m, _, _) in enumerate(MEMBERS):
            own = self._covariance[k]
            own[slot + 1, slot + 1] = stated.BIAS_SD_M**2 + (stated.SHARED * quick_m) ** 2
            own[slow, slow] = np.where(unknown, slow_m**2, own[slow, slow])
            own[quick, quick] = quick_m**2
            own[where, where] += (PLACED * quick_m) ** 2
            own[speeds, speeds] += BEGUN_MPS**2
        self._hold(belief)
        self._refused = np.zeros((count, n), np.int64)
        self._last_s = np.full(pairs, belief.time_s)
        self._now_s = belief.time_s

    def _hold(self, belief: Belief) -> None:
        """Leave what shall not calibrate itself as it began."""
        if belief.held is not None:
            hold(self._covariance, belief.held[belief.held >= 0], self._free)

    @property
    def begun(self) -> bool:
        """Whether the members follow the vehicle."""
        return self._now_s is not None

    @property
    def states(self) -> int:
        """How many states each has: those of a belief but for its clock."""
        return self._mean.shape[1]

    def take(self, belief: Belief, motion: Motion, rows: tuple[Floats, Floats, Floats, NDArray[np.int64]]) -> None:
        """Take in an epoch's rows (`update.linear`); ``belief`` is the track's, predicted to its instant."""
        inputs = belief.inputs
        assert inputs is not None
        n = self._mean.shape[1]
        dt = belief.time_s - (belief.time_s if self._now_s is None else self._now_s)
        sd = belief.tilts(0)
        tilt, noise = step_of(sd, motion.tilt_pace_radps, dt)
        densities = np.array([motion.climb_psd, motion.turn_psd])
        go(
            self._mean,
            self._covariance,
            self._free,
            MEMBERS,
            dt,
            densities,
            tilt,
            noise,
            inputs.range_slot,
            len(inputs.pairs),
            stated.LASTING_S,
        )
        self._hold(belief)
        self._now_s = belief.time_s
        derivative, offset, variance, pair = rows
        quick = inputs.range_slot + 2 + len(inputs.pairs) + pair
        hear(
            self._mean,
            self._covariance,
            np.ascontiguousarray(derivative[:, :n]),
            offset,
            variance,
            quick,
            self._news(pair, belief.time_s),
            stated.HEAVY,
            self._told,
            self._refused,
        )
        self._told *= np.exp(-abs(dt) / MEMORY_S)
        odds = self._prior + self._told
        self._told = np.maximum(odds, odds.max() - WORST) - self._prior
        self._told -= self._told.max()

    def _news(self, pair: NDArray[np.int64], time_s: float) -> Floats:
        """How far what rows of pairs err by is news of them: what is said again at once is not."""
        news = np.minimum((time_s - self._last_s[pair]) / ANEW_S, 1.0)
        self._last_s[pair] = time_s
        return news

    def mixed(self, belief: Belief) -> Belief:
        """Return a belief that holds what the members hold together."""
        n, weight = self._mean.shape[1], self.weight
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        mean[:n] = weight @ self._mean
        apart = self._mean - mean[:n]
        covariance[:n, :n] = np.einsum("k,kij->ij", weight, self._covariance) + (weight[:, None] * apart).T @ apart
        return replace(belief, mean=mean, covariance=covariance)
