"""Wheel odometry and compass: how they carry a vehicle, and what they learn of their own errors.

A row of odometry holds until the next, so it is told at that one's time: an arc driven since. As with steps, the state
keeps the pose at the row before (the anchor), and the arc measures the difference of the two poses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE
from sonofix.records import Floats
from sonofix.track.anchor import correct, open_errors

SCALE_SD = 0.05
"""Of the share of itself by which a speed is told too high; it stays what it is."""

SCALE_PSD = 1e-6
"""In 1/s, how it wanders."""

BIAS_SD_RADPS = 0.01
"""Of a yaw rate that is told at rest."""

BIAS_PSD = 1e-8
"""In rad²/s³, how it wanders."""

CREEP_PSD = 1e-6
"""In m²/s, how a vehicle strays from its odometry along and across even at rest."""

SLIP_M = 4e-4
"""In m²/m, how it strays for each metre driven."""

TWIST_PSD = 1e-5
"""In rad²/s, the same of its heading."""

TWIST_M = 4e-4
"""In rad²/m."""

TWIST_RAD = 4e-4
"""In rad²/rad."""

UNSEEN_RAD = 0.2
"""What a vehicle that stood may have turned on the spot between two rows, before it drives off."""

STANDING_MPS = 0.01
"""A lower speed is rest."""

LONGEST_S = 2.0
"""A row that is followed by none for longer tells nothing."""

UNLIKELY = 40.0
"""Squared distance, over its variance, of an arc that is not believed."""

AGILE_PSD = 0.5
"""White acceleration in m²/s³ between two rows, beyond which speed is not believed to have changed so suddenly."""

EVEN_S = 0.2
"""Speeds of so long apart stray from odometry each by itself."""

COMPASS_SD_RAD = 0.05
"""Of one reading; steel nearby is the rest, which `ROBUST` bounds."""

ROBUST = 2.0
"""A reading that is off by more deviations than this counts as much less (Huber 1964)."""


AS_EXPECTED = np.ones(3)
"""Factors on variances: of noise of place and of heading, and of how scale and bias wander (`track.bank`)."""


def begin(covariance: Floats, free: NDArray[np.bool_], slot: int) -> None:
    """Open the errors of a vehicle's odometry, in place, before anything is known of them."""
    open_errors(covariance, free, slot + 3, (SCALE_SD, BIAS_SD_RADPS))


def wander(covariance: Floats, slot: int, dt: float, rough: Floats = AS_EXPECTED) -> None:
    """Let the errors of odometry wander for ``dt``, in place."""
    span = abs(dt) * float(rough[2])
    covariance[slot + 3, slot + 3] += SCALE_PSD * span
    covariance[slot + 4, slot + 4] += BIAS_PSD * span


def take(
    mean: Floats,
    covariance: Floats,
    free: NDArray[np.bool_],
    vehicle: int,
    slot: int,
    told: Floats,
    arm: Floats,
    about: Floats | None = None,
    rough: Floats = AS_EXPECTED,
    lone: bool = True,
) -> None:
    """Put a vehicle, in place, where an arc leads from its anchor, and the anchor there, and let it go on as told next.

    What velocity was believed has no say in it: an arc that were averaged with it would be drawn straight in every
    bend, and by its own noise tell that wheels read too much (errors in variables). It only judges whether the arc can
    be. The same of the heading where odometry is the ``lone`` sensor of turns; else arc and heading correct each other.

    ``told`` (6,) is way, turn, time, what may have been turned unseen at their end, and the speed and yaw rate that
    hold from there on; ``arm`` (2,) is where the motion is followed, from the vehicle's origin. The arc is linearised
    at ``about``, or else at the mean. One that took no time (a row that stands there twice) tells nothing.
    """
    at = SIZE * vehicle
    way, turn, dt, unseen, speed, rate = told.tolist()
    # of all headings that it may have set out on: mean of u(α) is exp(-σ²/2) u(mean of α)
    shorter = 1.0 if about is not None else float(np.exp(-covariance[slot + 2, slot + 2] / 2))
    drives = free[slot] and free[slot + 2] and np.all(np.isfinite(told[:4])) and 0.0 < dt <= LONGEST_S
    if drives:
        _drive(mean, covariance, vehicle, slot, (shorter * way, turn, dt), arm, rough, lone, about)
    if free[at + 3]:
        covariance[at + 3, at + 3] += unseen**2
        if dt != 0.0:
            since_s = dt if drives else np.inf
            go_on(mean, covariance, vehicle, slot, (shorter * speed, rate), arm, rough, lone, about, since_s)
    for own, of in ((slice(slot, slot + 2), slice(at, at + 2)), (slot + 2, at + 3)):
        mean[own] = mean[of]
        covariance[own, :] = covariance[of, :]
        covariance[:, own] = covariance[:, of]
    free[slot : slot + 2] = True
    free[slot + 2] = free[at + 3]


def _drive(
    mean: Floats,
    covariance: Floats,
    vehicle: int,
    slot: int,
    arc: tuple[float, float, float],
    arm: Floats,
    rough: Floats,
    lone: bool,
    about: Floats | None,
) -> None:
    """Put a vehicle, in place, where an arc leads from its anchor; open its place where the arc cannot be."""
    at = SIZE * vehicle
    here = mean.copy() if about is None else about
    miss, derivative, noise = measure(here, vehicle, slot, arc, arm, rough)
    off = miss - derivative @ (mean - here)
    if off @ np.linalg.solve(derivative @ covariance @ derivative.T + noise, off) > UNLIKELY:
        # one of the two is wrong
        covariance[[at, at + 1, at + 3], [at, at + 1, at + 3]] += off**2
        return
    if lone:
        _put(mean, covariance, slice(at + 3, at + 4), here, miss[2:], derivative[2:], noise[2:, 2:])
    else:
        correct(mean, covariance, off[2:], derivative[2:], noise[2:, 2:], np.inf)
    here = mean.copy() if about is None else about
    miss, derivative, _ = measure(here, vehicle, slot, arc, arm, rough)
    _put(mean, covariance, slice(at, at + 2), here, miss[:2], derivative[:2], noise[:2, :2])


def go_on(
    mean: Floats,
    covariance: Floats,
    vehicle: int,
    slot: int,
    told: tuple[float, float],
    arm: Floats,
    rough: Floats = AS_EXPECTED,
    lone: bool = True,
    about: Floats | None = None,
    since_s: float = np.inf,
) -> None:
    """Let a vehicle move, in place, at the speed and yaw rate of the row that holds from now on.

    Unless it cannot have come to that speed in ``since_s``. A row with an empty cell tells nothing.
    """
    if not np.all(np.isfinite(told)):
        return
    at = SIZE * vehicle
    here = mean.copy() if about is None else about
    miss, derivative, noise = going(here, vehicle, slot, told, arm, rough)
    off = (miss - derivative @ (mean - here))[:2]
    expected = (derivative @ covariance @ derivative.T + noise)[:2, :2]
    if np.isfinite(since_s):
        expected += AGILE_PSD * since_s * np.eye(2)
        if off @ np.linalg.solve(expected, off) > UNLIKELY:
            return
    if lone:
        _put(mean, covariance, slice(at + 7, at + 8), here, miss[2:], derivative[2:], noise[2:, 2:])
        here = mean.copy() if about is None else about
        miss, derivative, _ = going(here, vehicle, slot, told, arm, rough)
    _put(mean, covariance, slice(at + 4, at + 6), here, miss[:2], derivative[:2], noise[:2, :2])


def _put(
    mean: Floats, covariance: Floats, own: slice, about: Floats, miss: Floats, derivative: Floats, noise: Floats
) -> None:
    """Make states what others tell of them, in place, whatever was believed of them.

    ``miss`` (k,) is what they lack at ``about`` and ``derivative`` (k, n) that of what is told there, 1 by themselves.
    """
    by = -derivative
    by[:, own] = 0.0
    to = about[own] + miss + by @ (mean - about)
    crossed = by @ covariance
    mean[own] = to
    covariance[own, :] = crossed
    covariance[:, own] = crossed.T
    covariance[own, own] = crossed @ by.T + noise


def measure(
    about: Floats, vehicle: int, slot: int, arc: tuple[float, float, float], arm: Floats, rough: Floats = AS_EXPECTED
) -> tuple[Floats, Floats, Floats]:
    """Return by how much an arc (way, turn, time) misses a state (3,), what it measures there, and its covariance.

    With a and α the anchor's place and heading, k and b the errors of way and yaw rate, and ω = turn − b dt: ψ = α + ω,
    p − a = (1 − k) way sinc(ω/2) u(α + ω/2) + (R(ψ) − R(α)) arm.
    """
    at = SIZE * vehicle
    way, turn, dt = arc
    before, now = about[slot + 2], about[at + 3]
    turned = turn - about[slot + 4] * dt
    bent = float(np.sinc(turned / (2 * np.pi)))
    chord = way * (1.0 - about[slot + 3]) * bent
    middle = before + turned / 2
    along = np.array([np.cos(middle), np.sin(middle)])
    across = np.array([-along[1], along[0]])

    def swung(yaw: float) -> Floats:
        cos, sin = np.cos(yaw), np.sin(yaw)
        return np.array([cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]])

    here, there = swung(now), swung(before)
    shift = chord * along + here - there
    miss = np.append(shift - (about[at : at + 2] - about[slot : slot + 2]), before + turned - now)
    derivative = np.zeros((3, len(about)))
    derivative[0, at] = derivative[1, at + 1] = derivative[2, at + 3] = 1.0
    derivative[0, slot] = derivative[1, slot + 1] = derivative[2, slot + 2] = -1.0
    derivative[:2, slot + 2] = -chord * across + np.array([-there[1], there[0]])
    derivative[:2, at + 3] = -np.array([-here[1], here[0]])
    derivative[:2, slot + 3] = way * bent * along
    derivative[:2, slot + 4] = chord * dt / 2 * across
    derivative[2, slot + 4] = dt
    place = CREEP_PSD * dt + SLIP_M * abs(way)
    heading = TWIST_PSD * dt + TWIST_M * abs(way) + TWIST_RAD * abs(turn)
    return miss, derivative, np.diag([rough[0] * place, rough[0] * place, rough[1] * heading])


def going(
    about: Floats, vehicle: int, slot: int, told: tuple[float, float], arm: Floats, rough: Floats = AS_EXPECTED
) -> tuple[Floats, Floats, Floats]:
    """Return by how much speed and yaw rate that are told miss a state (3,), what they measure there, and covariance.

    v = (1 − k) speed u(ψ) + ω R(ψ) J arm in x and y, J a quarter turn to the left, and ω = yaw rate − b.
    """
    at, (speed, rate) = SIZE * vehicle, told
    along = np.array([np.cos(about[at + 3]), np.sin(about[at + 3])])
    across = np.array([-along[1], along[0]])
    out = arm[0] * along + arm[1] * across
    left = np.array([-out[1], out[0]])
    goes, turns = (1.0 - about[slot + 3]) * speed, about[at + 7]
    miss = np.append(goes * along + turns * left - about[at + 4 : at + 6], rate - about[slot + 4] - turns)
    derivative = np.zeros((3, len(about)))
    derivative[0, at + 4] = derivative[1, at + 5] = derivative[2, at + 7] = 1.0
    derivative[:2, at + 3], derivative[:2, at + 7] = turns * out - goes * across, -left
    derivative[:2, slot + 3] = speed * along
    derivative[2, slot + 4] = 1.0
    uneven = CREEP_PSD + SLIP_M * abs(speed)
    twist = TWIST_PSD + TWIST_M * abs(speed) + TWIST_RAD * abs(rate)
    return miss, derivative, np.diag([rough[0] * uneven, rough[0] * uneven, rough[1] * twist]) / EVEN_S


def point(mean: Floats, covariance: Floats, free: NDArray[np.bool_], vehicle: int, heading_rad: float) -> None:
    """Correct a heading by a compass reading, in place; the first reading gives the heading."""
    at = SIZE * vehicle + 3
    if not np.isfinite(heading_rad):
        return
    if not free[at]:
        open_heading(mean, covariance, free, vehicle, heading_rad, 2 * COMPASS_SD_RAD)
        return
    miss = float(np.angle(np.exp(1j * (heading_rad - mean[at]))))
    derivative = np.zeros((1, len(mean)))
    derivative[0, at] = 1.0
    off = abs(miss) / np.sqrt(covariance[at, at] + COMPASS_SD_RAD**2)
    noise = COMPASS_SD_RAD**2 * max(1.0, off / ROBUST)
    correct(mean, covariance, np.array([miss]), derivative, np.array([[noise]]), np.inf)


def open_heading(
    mean: Floats, covariance: Floats, free: NDArray[np.bool_], vehicle: int, yaw_rad: float, sd_rad: float
) -> None:
    """Begin to follow a heading, in place; how fast it turns starts at 0 ± 1 rad/s."""
    for i, value, sd in ((3, yaw_rad, sd_rad), (7, 0.0, 1.0)):
        at = SIZE * vehicle + i
        mean[at] = value
        covariance[at, :] = covariance[:, at] = 0.0
        covariance[at, at] = sd**2
        free[at] = True
