"""A second place that ranges might as well put a vehicle, followed beside the track until one of the two is likelier.

Ranges stated by others state deviations that are worth little: a track that began in the wrong valley learns to take
its misfit for noise, and no gate notices. Its likelihood does: noise that is learnt to be large makes every epoch
unlikely. So where a fix of the latest ranges is far from the track, a track from there runs along, with errors and
noise of its own to learn, and the logarithms of what the two expected of each epoch are summed (Bayes factor; a
sequential test, Wald 1945).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import Links
from sonofix.locate.search import mirror
from sonofix.records import Fix, Floats, RangeEpoch
from sonofix.track import stated
from sonofix.track.belief import SIZE, Belief, Motion, loosen, place, predict, set_out
from sonofix.track.course import Course
from sonofix.track.held import hold
from sonofix.track.update import update

DECIDED = 10.0
"""Difference of log likelihoods at which one of two tracks is dropped: odds of e¹⁰."""

FAR = 20.0
"""Squared distance, over its variance, of a fix that is worth a rival."""

ASKED_S = 5.0
"""How often a fix of the latest ranges is looked at."""

HEARD = 30
"""Ranges before which likelihoods are not compared: how large noise is must be known first."""

TRIED_S = 30.0
"""A rival that has not won by then is dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """A track beside the track: what it believes, and by how much it was likelier since it began at ``since_s``.

    One with a ``course`` finds its heading by that, and has no end: its start is as good as the track's, and ranges
    alone may never tell the two apart.
    """

    belief: Belief
    vehicle: int
    since_s: float
    ahead: float = 0.0
    course: Course | None = None

    def take(
        self, time_s: float, motion: Motion, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_], others: float
    ) -> tuple[Rival, NDArray[np.bool_]]:
        """Follow an epoch of which the track made the log likelihood ``others``; return the rows used, too."""
        belief, used, news = heard(self.belief, time_s, motion, epoch, links, asked, others)
        if self.course is not None and belief.heeded:
            belief = set_out(self.course.head(belief))
        return replace(self, belief=belief, ahead=self.ahead + news), used

    @property
    def won(self) -> bool:
        """Whether it is likelier beyond doubt."""
        return self.ahead > DECIDED

    @property
    def lost(self) -> bool:
        """Whether it is less likely beyond doubt, or has had its time."""
        late = self.course is None and self.belief.time_s - self.since_s > TRIED_S
        return self.ahead < -DECIDED or late


def heard(
    belief: Belief,
    time_s: float,
    motion: Motion,
    epoch: RangeEpoch,
    links: Links,
    asked: NDArray[np.bool_],
    others: float,
) -> tuple[Belief, NDArray[np.bool_], float]:
    """Let a track beside the track take in an epoch of which that made the log likelihood ``others``.

    Returns
    -------
    belief : Belief
    used : bool (n,)
    news : float
        By how much it was likelier; 0 while it is not known how large noise is.
    """
    belief, used, *_ = update(predict(belief, max(time_s, belief.time_s), motion), epoch, links, asked)
    trust = belief.trust
    return belief, used, 0.0 if trust is None or trust.count[-1] < HEARD else trust.told - others


def image(place_m: Floats, free: NDArray[np.bool_], vehicle: int, links: Links, like: Fix) -> Fix:
    """Return a fix at the mirror image of a vehicle's place in the line that the fixed ends of rows are nearest to.

    ``place_m`` (3,) is that place, ``free`` what a belief follows.

    It has no position where they are not near a line, or where a heading or a height would have to be mirrored too.
    """
    at, listening = SIZE * vehicle, links.receiver_vehicle == vehicle
    nowhere = replace(like, position_m=None)
    if free[at + 2] or free[at + 3]:
        return nowhere
    ends = np.concatenate(
        [
            links.emitter_point[listening & (links.emitter_vehicle < 0)],
            links.receiver_point[(links.emitter_vehicle == vehicle) & (links.receiver_vehicle < 0)],
        ]
    )
    place_m = place_m.copy()
    if len(ends) < 2 or not mirror(place_m, ends, 2):
        return nowhere
    return replace(like, position_m=place_m, covariance=np.eye(2), states=("x", "y"), velocity_mps=None)


def beside(belief: Belief, vehicle: int, found: Fix, arm: Floats) -> Rival | None:
    """Begin a rival where a fix puts a vehicle, if that is far from the track; None where it is not.

    What ranges err by is to be learnt anew; noise begins as large as the track has it.
    """
    if belief.inputs is None or belief.trust is None or found.position_m is None or found.covariance is None:
        return None
    own = slice(SIZE * vehicle, SIZE * vehicle + 2)
    apart = found.position_m[:2] - belief.mean[own]
    allowed = belief.covariance[own, own] + found.covariance[:2, :2] + stated.BIAS_SD_M**2 * np.eye(2)
    if apart @ np.linalg.solve(allowed, apart) < FAR:
        return None
    return begun(belief, vehicle, found, arm)


def begun(belief: Belief, vehicle: int, found: Fix, arm: Floats, course: Course | None = None) -> Rival:
    """Begin a rival where a fix puts a vehicle; ranges must be stated by others."""
    assert belief.inputs is not None
    assert belief.trust is not None
    loose = loosen(place(bare(belief), vehicle, found, arm), vehicle)
    mean, covariance, free = loose.mean.copy(), loose.covariance.copy(), loose.free.copy()
    stated.begin(mean, covariance, free, belief.inputs.range_slot, belief.inputs.known_sd_m)
    hold(covariance, belief.held, free)
    loose = replace(loose, mean=mean, covariance=covariance, free=free, trust=belief.trust.anew())
    return Rival(loose, vehicle, belief.time_s, course=course)


def bare(belief: Belief) -> Belief:
    """Return a belief without the copies of earlier states that it carries to be smoothed, nor where to linearise."""
    own = _own(belief)
    return replace(
        belief,
        mean=belief.mean[own],
        covariance=belief.covariance[np.ix_(own, own)],
        free=belief.free[own],
        about=None,
    )


def follows(belief: Belief, rival: Belief) -> Belief:
    """Return a rival's belief in a belief's place, with copies of earlier states that then tell nothing of it."""
    own, n = _own(belief), len(belief.mean)
    mean, covariance, free = belief.mean.copy(), np.zeros((n, n)), np.zeros(n, bool)
    copies = np.setdiff1d(np.arange(n), own)
    covariance[np.ix_(copies, copies)] = belief.covariance[np.ix_(copies, copies)]
    mean[own], free[own] = rival.mean, rival.free
    covariance[np.ix_(own, own)] = rival.covariance
    return replace(rival, mean=mean, covariance=covariance, free=free, about=belief.about)


def _own(belief: Belief) -> NDArray[np.int64]:
    """Where a belief's own states stand: copies of earlier ones stand before the clock."""
    count, n = SIZE * len(belief.placed) + (belief.inputs.size if belief.inputs is not None else 0), len(belief.mean)
    return np.append(np.arange(count), [n - 2, n - 1])
