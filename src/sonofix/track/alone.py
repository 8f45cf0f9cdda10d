"""A track by ranges alone beside the one that a vehicle's own sensors carry: what tells when these are wrong.

Ranges stated by others err by sizes that are learnt. So a compass that counts from north, a speed of the wrong sign or
wheels that spin are taken for errors of ranges, and no gate notices. The likelihood does: a track that hears no sensor
expects the ranges worse where sensors are right, and far better where they are wrong. The logarithms of what the two
expected of each epoch are summed, and begin at 0 anew whenever sensors are ahead (CUSUM: Page 1954).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import Links
from sonofix.records import Fix, Floats, RangeEpoch
from sonofix.track import stated
from sonofix.track.belief import Belief, Motion, begin_sensors, lift_anchors, lift_heading, loosen, place
from sonofix.track.held import hold
from sonofix.track.rival import bare, heard

OUTDONE = 15.0
"""Sum of differences of log likelihoods at which sensors are not believed: were they right, it would come there less
than once in three million epochs."""

BORNE_OUT = 30.0
"""By how much sensors are likelier at which ranges alone go on from where the track is."""

SILENT_S = 5.0
"""How long sensors are not heard at first; twice as long each time."""

FORGIVEN = 10.0
"""Sensors that are not gainsaid for so many times that long are heard as before."""


@dataclass(frozen=True, slots=True, eq=False)
class Alone:
    """What ranges alone say of a site's only vehicle.

    ``ahead`` is by how much likelier they were so since sensors were ahead last, ``sum`` the same since it began.
    """

    belief: Belief
    ahead: float = 0.0
    sum: float = 0.0

    def take(
        self, time_s: float, motion: Motion, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_], others: float
    ) -> Alone:
        """Follow an epoch of which the track made the log likelihood ``others``."""
        belief, _, news = heard(self.belief, time_s, motion, epoch, links, asked, others)
        return self.told(belief, news)

    def told(self, belief: Belief, news: float) -> Alone:
        """Go on with a belief to which what came was likelier than to the track by ``news``, as a logarithm."""
        return Alone(belief, max(self.ahead + news, 0.0), self.sum + news)

    @property
    def won(self) -> bool:
        """Whether it is likelier beyond doubt."""
        return self.ahead > OUTDONE

    @property
    def lost(self) -> bool:
        """Whether sensors are borne out."""
        return self.sum < -BORNE_OUT


def apart(belief: Belief, found: Fix, arm: Floats) -> Alone | None:
    """Begin a track by ranges alone where a fix puts the only vehicle; None where the fix has no position.

    What ranges err by is to be learnt anew, and so are the errors of sensors, should they be heard again.
    """
    inputs, trust = belief.inputs, belief.trust
    if inputs is None or trust is None or found.position_m is None or found.covariance is None:
        return None
    begun = loosen(place(bare(belief), 0, found, arm), 0)
    mean, covariance, free = begun.mean.copy(), begun.covariance.copy(), begun.free.copy()
    own = slice(inputs.range_slot - _sensed(belief), inputs.range_slot)
    mean[own], covariance[own, :], covariance[:, own], free[own] = 0.0, 0.0, 0.0, False
    begin_sensors(inputs, covariance, free)
    stated.begin(mean, covariance, free, inputs.range_slot, inputs.known_sd_m)
    hold(covariance, belief.held, free)
    return Alone(
        replace(begun, mean=mean, covariance=covariance, free=free, trust=trust.anew(), rough=None, heeded=False)
    )


def unled(belief: Belief, turns: bool) -> Alone:
    """Begin a track by ranges alone where a track is; its heading goes on where ranges tell it (``turns``)."""
    begun = bare(belief)
    mean, covariance, free = begun.mean.copy(), begun.covariance.copy(), begun.free.copy()
    lift_anchors(belief.inputs, 0, mean, covariance, free)
    if not turns:
        lift_heading(mean, covariance, free, 0)
    return Alone(replace(begun, mean=mean, covariance=covariance, free=free, heeded=False))


def _sensed(belief: Belief) -> int:
    """How many states the sensors of vehicles add; they stand before the errors of ranges."""
    inputs = belief.inputs
    return 0 if inputs is None else inputs.size - stated.size(len(inputs.pairs))


class Silence:
    """For how long a vehicle's sensors are not heard, each time longer that ranges gainsay them."""

    def __init__(self) -> None:
        self._until_s = -np.inf
        self._last_s = 0.0

    def begin(self, time_s: float) -> float:
        """Hear no sensors from now on; return for how long, in s."""
        forgiven = time_s - self._until_s > FORGIVEN * self._last_s
        self._last_s = SILENT_S if forgiven else 2.0 * self._last_s
        self._until_s = time_s + self._last_s
        return self._last_s

    def over(self, time_s: float) -> bool:
        """Whether sensors are to be heard."""
        return time_s >= self._until_s
