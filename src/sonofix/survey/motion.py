"""How a vehicle's state ties to the next: constant acceleration, disturbed so much that a brisk vehicle fits in.

The disturbance is white jerk (Bar-Shalom, Li, Kirubarajan 2001, section 6.2.3); accelerations are held near 0 only by
what a vehicle can do. Between epochs half a second apart this says next to nothing of the place.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.survey.rows import STATE, Drive

ACCELERATION_MPS2 = 2.0
"""One sigma, per axis: a brisk vehicle's, a walker's."""

SETTLES_S = 1.0
"""Time over which an acceleration becomes another."""

TURN_PSD = 2.0
"""Of white yaw acceleration, rad²/s³."""

SPEED_MPS, TURN_RADPS = 10.0, 6.0
"""Deviations of a first state's velocity and yaw rate, from 0: next to nothing known."""

LEVEL_SD_M = 1e-5
"""Of a known level, where another vehicle's is not known."""

_JERK = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
_TURN = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
_JERK_ROOT = np.linalg.inv(np.linalg.cholesky(_JERK))
_TURN_ROOT = np.linalg.inv(np.linalg.cholesky(_TURN))


def ties(dt: Floats) -> tuple[Floats, Floats]:
    """Whitened ties of states to their successors: ``before`` and ``after`` (m, 11, 11), with before x₁ + after x₂ ≈ 0.

    Parameters
    ----------
    dt : float64 (m,)
        Seconds between the two.
    """
    m = len(dt)
    t = np.maximum(dt, 1e-6)
    moved, after = np.zeros((m, STATE, STATE)), np.zeros((m, STATE, STATE))
    psd = 2.0 * ACCELERATION_MPS2**2 / SETTLES_S
    jerk = _JERK_ROOT[None] * (t[:, None] ** -np.array([2.5, 1.5, 0.5]))[:, None, :] / np.sqrt(psd)
    turn = _TURN_ROOT[None] * (t[:, None] ** -np.array([1.5, 0.5]))[:, None, :] / np.sqrt(TURN_PSD)
    for axis in range(3):
        at = np.array([axis, 3 + axis, 6 + axis])
        after[:, at[:, None], at[None, :]] = jerk
        moved[:, at, at] = 1.0
        moved[:, at[0], at[1]] = moved[:, at[1], at[2]] = t
        moved[:, at[0], at[2]] = t**2 / 2
    at = np.array([9, 10])
    after[:, at[:, None], at[None, :]] = turn
    moved[:, at, at] = 1.0
    moved[:, 9, 10] = t
    return -after @ moved, after


def first_information(drive: Drive) -> Floats:
    """Information (s, 11) on each state by itself: accelerations are bounded, a first velocity is, levels are known.

    A state close upon another says little of its own about acceleration: its share is what has settled since.
    """
    information = np.zeros((len(drive.state_time_s), STATE))
    first = begins(drive)
    gap_s = np.diff(drive.state_time_s, prepend=-np.inf)
    share = np.where(first, 1.0, np.minimum(gap_s / SETTLES_S, 1.0))
    information[:, 6:9] = share[:, None] / ACCELERATION_MPS2**2
    information[first, 3:6] = SPEED_MPS**-2
    information[first, 10] = TURN_RADPS**-2
    level = ~np.isnan(drive.level_m)
    information[level, 2:9:3] = LEVEL_SD_M**-2
    information[~drive.turns, 9:] = 1.0
    return information


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """What is known of a drive's states before anything is heard, in the free components (k of 11).

    Attributes
    ----------
    free : int64 (k,)
    first, then : int64 (m,)
        States that are tied, each to its vehicle's next.
    before, after : float64 (m, 11, 11)
        Of `ties`.
    root : float64 (s, 11)
        Of each state's own information.
    target : float64 (s, 11)
        What that draws it to: its level, and 0.
    """

    free: NDArray[np.int64]
    first: NDArray[np.int64]
    then: NDArray[np.int64]
    before: Floats
    after: Floats
    root: Floats
    target: Floats


@lru_cache(maxsize=4)
def chain(drive: Drive) -> Chain:
    """Return what is known of a drive's states; a drive never changes, so it is worked out once."""
    first = np.flatnonzero(~begins(drive)[1:])
    before, after = ties(drive.state_time_s[first + 1] - drive.state_time_s[first])
    target = np.zeros((len(drive.state_time_s), STATE))
    target[:, 2] = np.nan_to_num(drive.level_m)
    root = np.sqrt(first_information(drive))
    return Chain(free_components(drive), first, first + 1, before, after, root, target)


def begins(drive: Drive) -> NDArray[np.bool_]:
    """Whether each state is its vehicle's first (s,)."""
    return np.diff(drive.state_vehicle, prepend=-1) != 0


def free_components(drive: Drive) -> NDArray[np.int64]:
    """Components of a state that some vehicle leaves open, ascending."""
    flat = len(drive.level_m) > 0 and not np.isnan(drive.level_m).any()
    closed = ([2, 5, 8] if flat else []) + ([] if drive.turns.any() else [9, 10])
    return np.array([i for i in range(STATE) if i not in closed])
