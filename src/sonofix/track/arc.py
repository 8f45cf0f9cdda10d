"""Constant turn: a vehicle that drives on at one speed and one turn rate goes along an arc.

Its velocity turns with it: constant speed and rate of turn, disturbed by white acceleration along, across and of the
turn (nearly coordinated turn: Bar-Shalom, Li and Kirubarajan 2001, section 11.7). The rate is the body's where its
heading is followed. Else it is that of its course, which ranges and their rates tell while it drives; it fades in
`STRAIGHT_S`, since a vehicle that stands tells nothing of it.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE, YAW, YAW_RATE
from sonofix.records import Floats
from sonofix.track.kernel import fade, stir

STRAIGHT_S = 5.0
"""Within so long a course forgets its turn."""

TURN_SD_RADPS = 0.7
"""Of a course of which nothing is known yet, and of one long forgotten: half a turn in `STRAIGHT_S`."""


def open_course(covariance: Floats, free: NDArray[np.bool_], vehicle: int) -> None:
    """Begin to follow how fast a vehicle's course turns whose heading is not followed, in place."""
    at = SIZE * vehicle + YAW_RATE
    free[at] = True
    covariance[at, at] = TURN_SD_RADPS**2


@numba.njit(cache=True, error_model="numpy")
def bend(mean, covariance, free, vehicle, density, dt):
    """Move one vehicle's place and velocity by ``dt`` along its arc, in place, by white acceleration of a density.

    With ω the rate of turn, s = sin(ω dt)/ω and c = (1 − cos(ω dt))/ω: p' = p + (s, −c; c, s) v and v' = R(ω dt) v.
    """
    x = SIZE * vehicle
    vx, vy, rate = x + 4, x + 5, mean[x + YAW_RATE]
    angle = rate * dt
    cos, sin = np.cos(angle), np.sin(angle)
    if abs(angle) < 1e-4:
        # to third order, where the closed form would cancel
        along, aside = dt * (1.0 - angle**2 / 6), dt * angle / 2
        by_along, by_aside = -(dt**2) * angle / 3, dt**2 / 2
    else:
        along, aside = sin / rate, (1.0 - cos) / rate
        by_along, by_aside = (dt * cos - along) / rate, (dt * sin - aside) / rate
    u, v = mean[vx], mean[vy]
    # how place and velocity answer to the rate of turn
    turned = (
        by_along * u - by_aside * v,
        by_aside * u + by_along * v,
        dt * (-sin * u - cos * v),
        dt * (cos * u - sin * v),
    )
    mean[x] += along * u - aside * v
    mean[x + 1] += aside * u + along * v
    mean[vx], mean[vy] = cos * u - sin * v, sin * u + cos * v
    linear = (cos, sin, along, aside)
    _carry(covariance, x, linear, turned)
    _carry(covariance.T, x, linear, turned)
    # white acceleration is the same from all sides: a turn leaves its integral's noise as it is
    for at in (x, x + 1):
        stir(covariance, at, at + 4, density, dt)
    if free[x + YAW_RATE] and not free[x + YAW]:
        fade(mean, covariance, x + YAW_RATE, np.exp(-abs(dt) / STRAIGHT_S), TURN_SD_RADPS**2)


@numba.njit(cache=True, error_model="numpy")
def _carry(rows, x, linear, turned):
    """Move rows of a covariance as `bend` moves the states: by velocity, and as they answer to the rate of turn."""
    cos, sin, along, aside = linear
    for k in range(len(rows)):
        a, b, w = rows[x + 4, k], rows[x + 5, k], rows[x + YAW_RATE, k]
        rows[x, k] += along * a - aside * b + turned[0] * w
        rows[x + 1, k] += aside * a + along * b + turned[1] * w
        rows[x + 4, k] = cos * a - sin * b + turned[2] * w
        rows[x + 5, k] = sin * a + cos * b + turned[3] * w
