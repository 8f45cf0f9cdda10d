"""The third seed's fusion (eqs 5 to 9): odometry and compass predict, the cooperative place corrects; three ways of it.

States are (x, y), A and H the identity, B u the way that wheels and compass tell of an epoch. All runs at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats

Way = Literal["reset", "plain", "proper"]
"""As printed; eqs 5 to 9 without the replacement; and those with a test for collisions."""

STRANGE = 27.631
"""Squared innovation over its covariance beyond which a robot was displaced: noise comes there once in a million epochs
(χ² of two degrees of freedom)."""

DISPLACED_M = 10.0
"""How far a robot may have been displaced, one sigma on each axis: large against any fix, so that its value tells
nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """Estimates (runs, n, 2), predictions before each update, covariances (runs, n, 2, 2) and collisions (runs, n)."""

    places_m: Floats
    ahead_m: Floats
    covariance_m2: Floats
    collision: NDArray[np.bool_]


def reckoned(start_m: Floats, told_m: Floats) -> Floats:
    """Places (runs, n, 2) by wheels and compass alone, from displacements (runs, n, 2)."""
    return start_m + np.cumsum(told_m, axis=1)


def follow(
    start_m: Floats,
    start_covariance_m2: Floats,
    told_m: Floats,
    told_covariance_m2: Floats,
    fixes_m: Floats,
    fixes_covariance_m2: Floats,
    way: Way,
) -> Followed:
    """Follow runs by eqs 5 to 9.

    Parameters
    ----------
    start_m, start_covariance_m2 : float64 (2,), (2, 2)
        x̂(0) and P(0), before the first epoch.
    told_m, told_covariance_m2 : float64 (runs, n, 2), (2, 2)
        B u and Q: displacement of each epoch by the robot's own sensors.
    fixes_m, fixes_covariance_m2 : float64 (runs, n, 2), (runs, n, 2, 2)
        z and R: cooperative places.
    way : "reset", "plain" or "proper"
        "reset": the last cooperative place stands for x̂(k − 1) in eq 5, while P goes on by eqs 7 to 9, as printed.
        "plain": x̂(k − 1) is the last estimate. "proper": so too, but where z is far stranger than noise makes it, the
        robot was displaced, and its place is opened before it is corrected.
    """
    runs, n = told_m.shape[:2]
    places, ahead = np.empty((runs, n, 2)), np.empty((runs, n, 2))
    covariances, collision = np.empty((runs, n, 2, 2)), np.zeros((runs, n), bool)
    state = np.tile(np.asarray(start_m, np.float64), (runs, 1))
    covariance = np.tile(np.asarray(start_covariance_m2, np.float64), (runs, 1, 1))
    for k in range(n):
        before = fixes_m[:, k - 1] if way == "reset" and k else state
        ahead[:, k] = before + told_m[:, k]
        covariance = covariance + told_covariance_m2
        miss, noise = fixes_m[:, k] - ahead[:, k], fixes_covariance_m2[:, k]
        if way == "proper":
            strange = np.einsum("ri,ri->r", miss, np.linalg.solve(covariance + noise, miss[..., None])[..., 0])
            collision[:, k] = strange > STRANGE
            covariance = covariance + collision[:, k, None, None] * DISPLACED_M**2 * np.eye(2)
        gain = np.swapaxes(np.linalg.solve(covariance + noise, covariance), 1, 2)
        state = ahead[:, k] + np.einsum("rij,rj->ri", gain, miss)
        keep = np.eye(2) - gain
        covariance = keep @ covariance @ np.swapaxes(keep, 1, 2) + gain @ noise @ np.swapaxes(gain, 1, 2)
        places[:, k], covariances[:, k] = state, covariance
    return Followed(places, ahead, covariances, collision)


def epochs_until_back(miss_m: Floats, since: int, within_m: float) -> Floats:
    """Epochs (runs,) from ``since`` on until errors (runs, n) come within a bound and stay there; 1: the very first."""
    outside = miss_m[:, since:] > within_m
    last = outside.shape[1] - np.argmax(outside[:, ::-1], axis=1)
    return np.where(outside.any(axis=1), last + 1.0, 1.0)
