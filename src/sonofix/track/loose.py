"""Positions that others computed, loosely coupled: each corrects where its vehicle is, and is believed as it is stated.

What they were made of is not known here: a fix that is wrong is refused as a whole, and none of it helps where it lacks
one range (docs/track.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonofix.geometry import SIZE
from sonofix.records import Fix
from sonofix.track.belief import Belief
from sonofix.track.kernel import joseph

UNLIKELY = 4.0
"""Distance of a position from the track, in deviations, beyond which it is not believed: noise alone comes
there three times in ten thousand, and one that is left out costs little."""


def take(belief: Belief, vehicle: int, fix: Fix) -> tuple[Belief, float]:
    """Correct where a vehicle is by a fix of that instant, if it is believed; return by how many deviations it is off.

    The track follows the vehicle's origin, of which a fix tells.
    """
    assert fix.position_m is not None
    assert fix.covariance is not None
    at, n = SIZE * vehicle, len(belief.mean)
    axes = [i for i, name in enumerate("xyz") if name in fix.states and belief.free[at + i]]
    rows = [fix.states.index("xyz"[i]) for i in axes]
    miss = (fix.position_m - belief.mean[at : at + 3])[axes]
    derivative = np.eye(n)[[at + i for i in axes]]
    noise = fix.covariance[np.ix_(rows, rows)]
    crossed = derivative @ belief.covariance
    expected = crossed @ derivative.T + noise
    off = float(np.sqrt(miss @ np.linalg.solve(expected, miss)))
    if off > UNLIKELY:
        return belief, off
    gain = np.linalg.solve(expected, crossed).T
    covariance = joseph(belief.covariance, gain, derivative, noise)
    return replace(belief, mean=belief.mean + gain @ miss, covariance=covariance), off
