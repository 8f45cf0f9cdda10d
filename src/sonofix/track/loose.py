"""Positions that others computed, loosely coupled: each corrects where its vehicle is, and is believed as it is stated.

What they were made of is not known here: a fix that is wrong is refused as a whole, and none of it helps where it lacks
one range (docs/track.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonofix.geometry import SIZE, from_arm
from sonofix.records import Fix, Floats
from sonofix.track.belief import Belief
from sonofix.track.kernel import joseph

UNLIKELY = 16.0
"""Squared distance of a position from the track, over its variance, beyond which it is not believed: noise alone comes
there three times in ten thousand, and one that is left out costs little."""


def take(belief: Belief, vehicle: int, fix: Fix, arm: Floats) -> tuple[Belief, bool]:
    """Correct where a vehicle is by a fix of that instant; return whether it was believed.

    ``arm`` (2,) is its `geometry.open_arms`: the track follows that point, the fix tells the origin.
    """
    assert fix.position_m is not None
    assert fix.covariance is not None
    at, n = SIZE * vehicle, len(belief.mean)
    axes = [i for i, name in enumerate("xyz") if name in fix.states and belief.free[at + i]]
    rows = [fix.states.index("xyz"[i]) for i in axes]
    shift, aside_m = from_arm(arm, belief.mean[at + 4 : at + 7])
    miss = (fix.position_m - belief.mean[at : at + 3] - np.append(shift, 0.0))[axes]
    derivative = np.eye(n)[[at + i for i in axes]]
    noise = fix.covariance[np.ix_(rows, rows)] + aside_m**2 * np.eye(len(rows))
    crossed = derivative @ belief.covariance
    expected = crossed @ derivative.T + noise
    if miss @ np.linalg.solve(expected, miss) > UNLIKELY:
        return belief, False
    gain = np.linalg.solve(expected, crossed).T
    covariance = joseph(belief.covariance, gain, derivative, noise)
    return replace(belief, mean=belief.mean + gain @ miss, covariance=covariance), True
