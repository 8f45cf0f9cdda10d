"""How good ranges and bearings are that nobody vouches for: learnt from themselves, while they are used.

A range errs by a part that stays while one view of its pair lasts, which is a state of the filter, and by a part that
is new each time. How large either is, is learnt listener by listener and octave of range by octave; so is how far
bearings scatter. Each is one step of expectation-maximisation per measurement: what a state and its covariance, once
corrected, leave of an error's square (Särkkä and Nummenmaa 2009 have the like).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from sonofix.records import Floats
from sonofix.track.stated import BEGIN_SD_M, LASTING_S, POOL, SCALE_SD

OCTAVES = 8
"""Of range, the fourth of which begins at 1 m."""

BEGIN_SD_RAD = 0.03
"""Of bearings, before they have told."""

LEAST = 1e-4
"""What nobody vouches for is told no better than by this share of the variance taken before anything was heard."""

STATED_STAYS, STATED_NEW = 1.0, 0.5
"""Where ranges state how good they are: deviations over that, of what stays of them and of what is new beyond it."""

BEGIN_SHARE = 0.5
"""The part of a range's variance that stays, before measurements have told."""


KEPT_SHARE = 0.5
"""By what share of itself a range changes until its view is another."""

REMEMBERED = 200.0
"""Measurements of a listener by which their scatter is judged; of all listeners ten times as many."""

RUN_S = 20.0
"""How long innovations of one view are summed up."""

SWELLS = 0.1
"""How fast variances follow, per run."""

SWOLLEN = 100.0
"""At most."""

CLIPPED = 9.0
"""A single square counts as at most so many variances."""

STAYING, NEW, BEARING = range(3)
KINDS = 3
"""Errors that are learnt: of ranges the part that stays and the one that is new, and of bearings."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """What V listeners have learnt; row V is of fixed ones. Arrays are written in place.

    Attributes
    ----------
    known : float64 (V + 2, OCTAVES, KINDS, 3)
        Faded count, and sum of squares over the variance taken where nobody vouches; and what that is taken for before
        measurements tell. Last row: of all listeners.
    fading : float64 (2,)
        How long, in s, an error stays, and for what change of range, as a share of that.
    runs : float64 (W, 2, 3)
        Of each view, ranges and bearings: when its run of innovations began, their sum, over their deviations, and how
        many they are.
    swell : float64 (V + 1, 2)
        By what factor the variance of what is new of a listener's ranges and bearings is to be taken larger, as
        innovations do not average out as they should.
    believed : bool
        Ranges are as good as stated, and nothing of them stays.
    """

    known: Floats
    believed: bool
    fading: Floats
    runs: Floats
    swell: Floats

    def take_over(self, other: Noise) -> None:
        """Go on by what another has learnt."""
        for mine, its in ((self.known, other.known), (self.runs, other.runs), (self.swell, other.swell)):
            mine[:] = its


def noise(robots: int, views: int, believed: bool, stated_sd_m: float) -> Noise:
    """Return what is known before anything was heard; ``stated_sd_m``: of ranges, NaN where nobody vouches for them."""
    known = np.zeros((robots + 2, OCTAVES, KINDS, 3))
    known[:, :, :, 2] = 1.0
    if np.isfinite(stated_sd_m):
        for kind, sd_m in ((STAYING, STATED_STAYS * stated_sd_m), (NEW, STATED_NEW * stated_sd_m)):
            for k in range(OCTAVES):
                known[:, k, kind, 2] = min(1.0, sd_m**2 / begun(kind, 2.0 ** (k - 2.5)))
    return Noise(
        known,
        believed,
        np.array([LASTING_S, KEPT_SHARE]),
        np.full((views, 2, 3), np.nan),
        np.ones((robots + 1, 2)),
    )


@numba.njit(cache=True, error_model="numpy")
def octave(range_m):
    """Return the octave of a range; of one that was not measured, that of 1 m."""
    if not np.isfinite(range_m):
        return 3
    return int(min(max(np.floor(np.log2(max(range_m, 1e-9))) + 3, 0), OCTAVES - 1))


@numba.njit(cache=True, error_model="numpy")
def begun(kind, range_m):
    """Return the variance (m² or rad²) of an error before anything was heard."""
    if kind == BEARING:
        return BEGIN_SD_RAD**2
    share = BEGIN_SHARE if kind == STAYING else 1.0 - BEGIN_SHARE
    return share * (BEGIN_SD_M**2 + (SCALE_SD * range_m) ** 2)


@numba.njit(cache=True, error_model="numpy")
def variance_of(known, listener, kind, range_m):
    """Return the variance (m² or rad²) of an error of a listener, as far as learnt; of ranges beyond what is stated."""
    k = octave(range_m)
    every = (known[-1, k, kind, 1] + POOL * known[-1, k, kind, 2]) / (known[-1, k, kind, 0] + POOL)
    own = (known[listener, k, kind, 1] + POOL * every) / (known[listener, k, kind, 0] + POOL)
    return max(own, LEAST) * begun(kind, range_m)


@numba.njit(cache=True, error_model="numpy")
def fade(since_s, range_m, last_m, fading):
    """Return which part is left of a staying error of ``since_s`` ago at ``last_m``; NaN: there was none."""
    if not np.isfinite(since_s):
        return 0.0
    return np.exp(-max(since_s, 0.0) / fading[0] - abs(range_m - last_m) / (fading[1] * max(range_m, 1e-6)))


@numba.njit(cache=True, error_model="numpy")
def take(known, listener, kind, range_m, square, weight):
    """Take in the square of an error, in m² or rad², of so much weight."""
    k = octave(range_m)
    ratio = square / begun(kind, range_m)
    for row in (listener, len(known) - 1):
        keep = 1.0 - weight / (REMEMBERED if row == listener else 10.0 * REMEMBERED)
        known[row, k, kind, 0] = keep * known[row, k, kind, 0] + weight
        known[row, k, kind, 1] = keep * known[row, k, kind, 1] + weight * ratio


@numba.njit(cache=True, error_model="numpy")
def follow_run(run, swell, time_s, miss):
    """Take an innovation, over its deviation, into its view's ``run`` (3,); at its end let ``swell`` follow.

    Innovations of a filter whose noise is what it is taken for are white: their sums have the variances of as many
    (Mehra 1970). Where sums are larger, errors stay in ways that no state describes, and many tell as much as few.
    """
    if np.isfinite(run[0]) and time_s - run[0] > RUN_S:
        ratio = min(run[1] ** 2 / run[2], CLIPPED)
        swell = min(max(swell * np.exp(SWELLS * (ratio - 1.0)), 1.0), SWOLLEN)
        run[0] = np.nan
    if not np.isfinite(run[0]):
        run[0], run[1], run[2] = time_s, 0.0, 0.0
    run[1] += miss
    run[2] += 1.0
    return swell
