"""The recorder's clock where beacons' bursts are not synchronised with it: an offset, and how it drifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonofix.locate.noise import CLOCK_SPEED_SD
from sonofix.records import Fix, RangeEpoch
from sonofix.track.belief import Belief
from sonofix.track.held import hold

OFFSET_SD_M = 100.0
"""Of an offset of which nothing is known."""


def opened(belief: Belief, epoch: RangeEpoch, fixes: tuple[Fix, ...], free_running: bool) -> Belief:
    """Return the belief with its clock open where nothing ties it to the last epoch's.

    That is at the start, and in each epoch of a source that runs freely. It begins as the fixes have it, if any has.
    """
    unknown = epoch.clock == "common" and (free_running or not belief.free[-2])
    if not (unknown and len(epoch) and belief.placed.any()):
        return belief
    known = [f.clock_offset_m for f in fixes if f.clock_offset_m is not None]
    mean, covariance, free = belief.mean.copy(), belief.covariance.copy(), belief.free.copy()
    mean[-2] = known[0] if known else float(np.median(epoch.range_m))
    mean[-1] = 0.0
    covariance[-2:, :] = covariance[:, -2:] = 0.0
    covariance[-2, -2] = OFFSET_SD_M**2
    covariance[-1, -1] = (CLOCK_SPEED_SD * epoch.sound_speed_mps) ** 2
    free[-2:] = True
    hold(covariance, belief.held, free)
    return replace(belief, mean=mean, covariance=covariance, free=free)
