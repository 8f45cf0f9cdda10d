"""Ranges stated by others: the errors that they carry for seconds and minutes, and how far each can be trusted.

A range is stated as (1 + k) r + b + s + q + noise: k and b are common to all, s (slow) and q (quick) are first-order
Gauss-Markov processes of each pair of an emitter and a receiver. How large s, q and the noise are is learnt from the
ranges themselves, pair by pair with all pairs as the prior (docs/track.md). Of a pair whose bias the site file states,
that is taken off before, and s begins as well known as the file says. Scale and bias of all stay open even so: what
a survey took for the way's scale, all its biases share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import lgamma, log

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats

SCALE_SD = 0.05
"""Of the share of the way by which all ranges are too long; it stays what it is."""

BIAS_SD_M = 0.1
"""Of what all ranges are too long by; it stays what it is."""

COMMON = 2
"""States that all pairs share: scale and bias."""

KINDS = 2
"""Errors of each pair: slow, quick."""

BEGIN_SD_M = 0.1
"""Of slow errors, of quick ones and of noise beyond what is stated, each, before ranges have told."""

LASTING_S = 300.0
"""Correlation time of slow errors (antennas, walls) where none was seen to jump."""

QUICK_S = 2.0
"""Correlation time of quick errors (multipath along the way)."""

SHARED = 1.5
"""Where a `panel` weighs sizes, what all pairs share may be so many times as large as what each errs by."""

HEAVY = 4.0
"""Of Student's t distribution, as which noise is taken first: outliers of many metres then weigh next to nothing."""

LIGHT = 30.0
"""Of one that is nearly Gaussian, of which every range tells more: noise is taken for it where that is likelier."""

FREEDOM = (HEAVY, LIGHT)

_FREEDOM = np.array(FREEDOM)[:, None]
_LEAD = np.array([lgamma((nu + 1.0) / 2) - lgamma(nu / 2) - 0.5 * log(nu) for nu in FREEDOM])[:, None]

TAILED = 3.0
"""Logarithm of the odds for heavy tails before anything was heard."""

UNDONE = 20.0
"""Those odds grow no larger, either way: noise may change."""

STRAY = log(0.05 / 100.0)
"""Logarithm of the density (1/m) of a range that may be anything within 100 m; one in twenty is."""

SETTLED = 0.3
"""Logarithm of a change of a row's noise that is none."""

REMEMBERED = 100.0
"""Ranges of a pair by which its noise is judged; of all pairs ten times as many."""

POOL = 10.0
"""Ranges of a pair that weigh as much as what all pairs show."""

RATE = 0.02
"""How fast variances of slow and quick errors follow, per range."""

JUMP = 20.0
"""Squared sum of a pair's last innovations, over its variance, at which its error has jumped: noise alone comes there
once in a hundred thousand."""

RUN = 0.9
"""How fast innovations of a pair are forgotten, per range, in that sum."""

SINGLE = 2.5
"""A single innovation counts as at most so many deviations there: one outlier is none."""

MOST = 9.0
"""A single square counts as at most so many variances."""


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """What has been learnt of P pairs; a new one with each epoch.

    Attributes
    ----------
    count, stated : float64 (P + 1,)
        Ranges of each pair, faded, and sums of the variances they stated; last: of all.
    square : float64 (2, P + 1)
        Sums of their squared residuals, as noise of each of `FREEDOM` counts them.
    own, weight : float64 (2, P)
        Sums of squared slow and quick errors, and their number, faded.
    pool : float64 (2,)
        Variance (m²) of slow and quick errors over all pairs.
    run : float64 (2, P)
        Sums of each pair's last normalised innovations and of their variances, faded.
    watched_s : float64 (2, P)
        When each pair was first and last heard, of all pairs that were; NaN of others.
    jumps : int
        How often a pair's error has jumped.
    told : float
        Logarithm of the likelihood of the epoch just taken in, with no range below `STRAY`: how wide a belief is, is no
        reason to be told by outliers.
    tailed : float
        Logarithm of the odds that noise has the heavier tails.
    sizes : float64 (4,) or None
        Those of all pairs that a `panel` has found: slow and quick deviation (m), quick time (s), density of white
        acceleration (m²/s³); None: each pair's are learnt here.
    """

    count: Floats
    square: Floats
    stated: Floats
    own: Floats
    weight: Floats
    pool: Floats
    run: Floats
    watched_s: Floats
    jumps: int = 0
    told: float = 0.0
    tailed: float = TAILED
    sizes: Floats | None = None

    @property
    def variance(self) -> Floats:
        """Variances (2, P) of each pair's slow and quick errors, in m²."""
        if self.sizes is not None:
            return np.repeat(self.sizes[:2, None] ** 2, self.own.shape[1], axis=1)
        return (self.own + POOL * self.pool[:, None]) / (self.weight + POOL)

    @property
    def tails(self) -> Floats:
        """How likely noise of each of `FREEDOM` is (2,); members of a `panel` all take its tails for heavy."""
        if self.sizes is not None:
            return np.array([1.0, 0.0])
        odds = np.array([self.tailed, 0.0])
        return np.exp(odds - np.logaddexp(*odds))

    @property
    def freedom(self) -> float:
        """Degrees of freedom that noise has, in the geometric mean."""
        return float(np.exp(self.tails @ np.log(FREEDOM)))

    @property
    def every_m2(self) -> Floats:
        """Variance (2,) that ranges of all pairs have beyond what they state, as noise of each of `FREEDOM`."""
        return (self.square[:, -1] - self.stated[-1] + POOL * BEGIN_SD_M**2) / (self.count[-1] + POOL)

    @property
    def rough_m(self) -> float:
        """Deviation of all that ranges err by, beyond what they state and share, outliers aside."""
        return float(np.sqrt(max(self.every_m2[0], 0.0) + self.pool.sum()))

    def extras(self, pair: NDArray[np.int64]) -> Floats:
        """Variance (2, n) in m² that rows of some pairs have beyond what they state, as noise of each of `FREEDOM`."""
        beyond = self.square[:, pair] - self.stated[pair] + POOL * self.every_m2[:, None]
        return np.maximum(beyond / (self.count[pair] + POOL), 0.0)

    def extra(self, pair: NDArray[np.int64]) -> Floats:
        """Variance (n,) in m² that rows of some pairs have beyond what they state."""
        return self.tails @ self.extras(pair)

    def weighed(self, pair: NDArray[np.int64], miss: Floats, spread: Floats, noise: Floats) -> tuple[Trust, Floats]:
        """Return what is known once innovations (n,) of variances ``spread`` came, and by what these rows' noise grows.

        That is what Student's t asks for, by squared innovations over their variance; of both `FREEDOM`, weighed by how
        likely each has been, row by row. Of the tails of noise a row tells as far as ``noise`` (n,) is its variance:
        by the square of that share, as the kurtosis of a sum has it.
        """
        tails, extras = self.tails, self.extras(pair)
        spreads = spread - tails @ extras + extras
        told = log_likelihood(miss**2 / spreads, spreads)
        tells = (noise / spread) ** 2
        larger = 1.0 / (tails @ (1.0 / heavier(miss**2 / spread, _FREEDOM)))
        tailed = float(np.clip(self.tailed + (told[0] - told[1]) @ tells, -UNDONE, UNDONE))
        each = tails @ told
        return replace(self, told=float(np.sum(np.maximum(each, STRAY))), tailed=tailed), larger

    def together(self, miss: Floats, expected: Floats, noise: Floats, larger: Floats) -> Floats:
        """Return by what the noise of rows (n,) grows where each is judged by what all others say, too.

        What is off within what a wide prediction allows may be far off by the other rows. ``miss`` (n,) are innovations
        and ``expected`` (n, n) their covariance, ``noise`` (n,) what is in that of each row, ``larger`` (n,) by what it
        grows by the prediction alone. The row that is furthest from what is asked of it follows first.
        """
        larger, tails = larger.copy(), self.tails
        for _ in range(2 * len(miss)):
            rest = np.linalg.inv(expected + np.diag((larger - 1.0) * noise))
            own = rest.diagonal()
            spread = np.maximum(1.0 / own - (larger - 1.0) * noise, noise)
            asked = 1.0 / (tails @ (1.0 / heavier((rest @ miss / own) ** 2 / spread, _FREEDOM)))
            change = np.abs(np.log(asked / larger))
            furthest = int(np.argmax(change))
            if change[furthest] < SETTLED:
                break
            larger[furthest] = asked[furthest]
        return larger

    def heard(
        self, pair: NDArray[np.int64], miss: Floats, spread: Floats, time_s: Floats
    ) -> tuple[Trust, NDArray[np.bool_]]:
        """Return what is known once innovations (n,) of variances ``spread`` came, and the rows whose error jumped.

        Innovations of a pair whose error is what it is taken for are white; where those of few pairs keep to one side
        while others do not, something stepped into their way (generalised likelihood ratio: Willsky and Jones 1976).
        """
        run = self.run.copy()
        run[0, pair] = RUN * run[0, pair] + np.clip(miss / np.sqrt(spread), -SINGLE, SINGLE)
        run[1, pair] = RUN**2 * run[1, pair] + 1.0
        jumped = run[0, pair] ** 2 > JUMP * run[1, pair]
        if self.sizes is not None or 2 * np.count_nonzero(run[0] ** 2 > JUMP / 4 * run[1]) > np.count_nonzero(run[1]):
            jumped[:] = False  # it is the vehicle that moved
        run[:, pair[jumped]] = 0.0
        watched_s = self.watched_s.copy()
        watched_s[0, pair] = np.fmin(watched_s[0, pair], time_s)
        watched_s[1, pair] = time_s
        return replace(self, run=run, watched_s=watched_s, jumps=self.jumps + int(np.count_nonzero(jumped))), jumped

    @property
    def lasting_s(self) -> float:
        """Correlation time of slow errors: the time between jumps of one pair, by all pairs (a Poisson process)."""
        if self.sizes is not None:
            return LASTING_S
        return (LASTING_S + float(np.nansum(self.watched_s[1] - self.watched_s[0]))) / (1.0 + self.jumps)

    def anew(self) -> Trust:
        """Return what another track may begin with: noise as large, soon forgotten; errors as before anything."""
        few = min(1.0, POOL / max(float(self.count[-1]), 1e-9))
        begun = trust(len(self.count) - 1)
        return replace(
            begun,
            count=few * self.count,
            square=few * self.square,
            stated=few * self.stated,
            sizes=self.sizes,
            tailed=self.tailed,
        )

    def after(self, pair: NDArray[np.int64], square: Floats, stated: Floats, errors: Floats) -> Trust:
        """Return what is known after another epoch, one expectation-maximisation step on (Särkkä & Nummenmaa 2009).

        Parameters
        ----------
        pair : int (n,)
        square, stated : float64 (n,)
            Squared residual and the variance of what the belief expects there, in sum; variance stated.
        errors : float64 (2, n)
            The same of the rows' slow and quick errors: square of the mean, and variance.
        """
        counted = (_FREEDOM + 1.0) / (_FREEDOM + square / (stated + self.extras(pair))) * square
        count, squares, claims = self.count.copy(), self.square.copy(), self.stated.copy()
        own, weight, pool = self.own.copy(), self.weight.copy(), self.pool.copy()
        errors = np.minimum(errors, MOST * self.variance[:, pair])
        for i, k in enumerate(pair.tolist()):
            for at, keep in ((k, 1.0 - 1.0 / REMEMBERED), (-1, 1.0 - 0.1 / REMEMBERED)):
                count[at] = keep * count[at] + 1.0
                squares[:, at] = keep * squares[:, at] + counted[:, i]
                claims[at] = keep * claims[at] + stated[i]
            own[:, k] = (1.0 - RATE) * own[:, k] + errors[:, i]
            weight[:, k] = (1.0 - RATE) * weight[:, k] + 1.0
        pool += RATE * (errors.mean(axis=1) - pool)
        return replace(self, count=count, square=squares, stated=claims, own=own, weight=weight, pool=pool)


def trust(pairs: int) -> Trust:
    """Return what is known of so many pairs before anything was heard."""
    every, each = np.zeros(pairs + 1), np.zeros((KINDS, pairs))
    return Trust(
        every,
        np.zeros((len(FREEDOM), pairs + 1)),
        every,
        each,
        each,
        np.full(KINDS, BEGIN_SD_M**2),
        np.zeros((2, pairs)),
        np.full((2, pairs), np.nan),
    )


def size(pairs: int) -> int:
    """How many states stated ranges of so many pairs add."""
    return COMMON + KINDS * pairs


def begin(mean: Floats, covariance: Floats, free: NDArray[np.bool_], slot: int, known_sd_m: Floats) -> None:
    """Open all errors, in place, before any range has told of them.

    ``known_sd_m`` (P,): how well the site file states what each pair's ranges err by; NaN where it does not.
    """
    pairs = len(known_sd_m)
    own = slice(slot, slot + size(pairs))
    mean[own] = covariance[own, :] = covariance[:, own] = 0.0
    slow = np.where(np.isnan(known_sd_m), BEGIN_SD_M, known_sd_m)
    deviations = np.concatenate([[SCALE_SD, BIAS_SD_M], slow, np.full(pairs, BEGIN_SD_M)])
    covariance[own, own] = np.diag(deviations**2)
    free[own] = True


def open_pairs(covariance: Floats, slot: int, known: Trust) -> None:
    """Give the errors of pairs the variances that are known of them, in place: before anything was heard."""
    at = np.arange(slot + COMMON, slot + COMMON + known.own.size)
    covariance[at, at] = known.variance.ravel()
    covariance[slot + 1, slot + 1] = max(
        BIAS_SD_M**2, known.pool[0] if known.sizes is None else (SHARED * known.sizes[1]) ** 2
    )


def wander(mean: Floats, covariance: Floats, slot: int, known: Trust, dt: float) -> None:
    """Let slow and quick errors age by ``dt``, in place (Gelb 1974, section 3.7)."""
    own = slice(slot + COMMON, slot + COMMON + known.own.size)
    quick_s = QUICK_S if known.sizes is None else float(known.sizes[2])
    fade = np.repeat(np.exp(-abs(dt) / np.array([known.lasting_s, quick_s])), known.own.shape[1])
    mean[own] *= fade
    covariance[own, :] *= fade[:, None]
    covariance[:, own] *= fade
    at = np.arange(own.start, own.stop)
    covariance[at, at] += known.variance.ravel() * (1.0 - fade**2)
    # where pairs err by more than was expected, so may what they share
    if known.sizes is None:
        covariance[slot + 1, slot + 1] += max(known.pool[0] - BIAS_SD_M**2, 0.0) * (1.0 - fade[0] ** 2)


def places(slot: int, pair: NDArray[np.int64], pairs: int) -> NDArray[np.int64]:
    """Where the slow and quick errors of rows stand in a belief (2, n)."""
    return slot + COMMON + pairs * np.arange(KINDS)[:, None] + pair


def show(
    mean: Floats, slot: int, pair: NDArray[np.int64], pairs: int, shown: Floats, derivative: Floats
) -> tuple[Floats, Floats]:
    """Return what rows would show (n,), and its derivative (n, states), once errors are added to what geometry says."""
    derivative = derivative * (1.0 + mean[slot])
    derivative[:, slot], derivative[:, slot + 1] = shown, 1.0
    at = places(slot, pair, pairs)
    derivative[np.arange(len(pair)), at] = 1.0
    return shown * (1.0 + mean[slot]) + mean[slot + 1] + mean[at].sum(axis=0), derivative


def heavier(surprise: Floats, freedom: Floats | float) -> Floats:
    """Return the factor on a row's variance that Student's t asks for, by its squared innovation over its variance.

    Noise of known weights (ν + 1) / (ν + z²) would tell (ν + 3) / (ν + 1) times what such a row tells (Fisher's
    information of t about its place: Lange, Little and Taylor 1989), so it is larger by that.
    """
    return (freedom + 3.0) / (freedom + 1.0) * (freedom + surprise) / (freedom + 1.0)


def log_likelihood(surprise: Floats, variance: Floats) -> Floats:
    """Logarithms (2, n) of rows' Student's t density (1/m), of each of `FREEDOM`.

    ``surprise`` and ``variance`` (2, n).
    """
    return _LEAD - 0.5 * ((_FREEDOM + 1.0) * np.log1p(surprise / _FREEDOM) + np.log(variance))
