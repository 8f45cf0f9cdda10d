"""How far a vehicle's odometry may be trusted: learnt while driving, from what ranges say.

Noise of odometry is not seen in one range: where that errs by half a metre, a heading that strays by a degree a minute
shows over minutes alone. So many small filters run beside the track, each with its own noise of place and heading and
its own drift of scale and bias, on the same arcs and ranges. How likely each found what was heard weighs it
(multiple-model estimation: Magill 1965; Bar-Shalom 2001, section 11.6.2), and the track takes the weighted mean.
"""

from __future__ import annotations

from itertools import product

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE, YAW, Links
from sonofix.records import Floats, RangeEpoch
from sonofix.track import stated, wheels
from sonofix.track.belief import Belief
from sonofix.track.inputs import WHEELS
from sonofix.track.kernel import absorb

DECADES = ((-2, -1, 0, 1, 2), (-3, -2, -1, 0, 1, 2), (-4, -2, 0, 2))
"""Powers of ten by which members multiply the variances of place and heading, and of the drift of scale and bias."""

PRIOR_DECADES = 1.5
"""Deviation of what is expected of them before anything was heard."""

MEMORY_S = 1000.0
"""What was heard longer ago hardly counts: grounds and loads change."""

STATES = 7
"""Of each member: x, y, yaw, scale and bias of odometry, scale and bias of ranges."""


@numba.njit(cache=True, error_model="numpy")
def drive(mean, covariance, factor, arc, constants):
    """Move all members along an arc, in place.

    ``mean`` (K, 7), ``covariance`` (K, 7, 7), ``factor`` (K, 3); ``arc`` (way, turn, dt); ``constants`` those of
    `track.wheels`: noise of place a second and metre, of heading a second, metre
    and radian, wander of scale and bias a second. The model is `wheels.measure`'s, as motion.
    """
    way, turn, dt = arc
    bare = constants[0] * dt + constants[1] * abs(way)
    twist = constants[2] * dt + constants[3] * abs(way) + constants[4] * abs(turn)
    for k in range(len(mean)):
        x, p = mean[k], covariance[k]
        turned = turn - x[4] * dt
        half = turned / 2
        bent = np.sin(half) / half if abs(half) > 1e-9 else 1.0
        middle = x[2] + half
        cos, sin = np.cos(middle), np.sin(middle)
        bent *= np.exp(-p[2, 2] / 2)
        chord = way * (1.0 - x[3]) * bent
        x[0] += chord * cos
        x[1] += chord * sin
        x[2] += turned
        a2, a3, a4 = -chord * sin, -way * bent * cos, chord * dt / 2 * sin
        b2, b3, b4 = chord * cos, -way * bent * sin, -chord * dt / 2 * cos
        for j in range(STATES):
            p[0, j] += a2 * p[2, j] + a3 * p[3, j] + a4 * p[4, j]
            p[1, j] += b2 * p[2, j] + b3 * p[3, j] + b4 * p[4, j]
            p[2, j] -= dt * p[4, j]
        for j in range(STATES):
            p[j, 0] += a2 * p[j, 2] + a3 * p[j, 3] + a4 * p[j, 4]
            p[j, 1] += b2 * p[j, 2] + b3 * p[j, 3] + b4 * p[j, 4]
            p[j, 2] -= dt * p[j, 4]
        place = factor[k, 0] * bare
        p[0, 0] += place
        p[1, 1] += place
        p[2, 2] += factor[k, 1] * twist
        p[3, 3] += factor[k, 2] * constants[5] * dt
        p[4, 4] += factor[k, 2] * constants[6] * dt


@numba.njit(cache=True, error_model="numpy")
def hear(mean, covariance, other, arm, range_m, variance, freedom, told):
    """Correct all members by one range, in place, and add its log likelihood to ``told`` (K,).

    ``other`` (3,) is where its other end stands, seen from the vehicle's level; ``arm`` (3,) where it was heard in the
    vehicle's axes; ``variance`` of its Student's t noise of so much ``freedom``.
    """
    row, work = np.zeros(STATES), np.empty((3, STATES))
    for k in range(len(mean)):
        x, p = mean[k], covariance[k]
        cos, sin = np.cos(x[2]), np.sin(x[2])
        swing_x, swing_y = cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]
        dx, dy, dz = x[0] + swing_x - other[0], x[1] + swing_y - other[1], arm[2] - other[2]
        far = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
        grown = (1.0 + x[5]) / far
        row[0], row[1], row[2] = grown * dx, grown * dy, grown * (dy * swing_x - dx * swing_y)
        row[5], row[6] = far, 1.0
        spread = variance
        for i in range(STATES):
            for j in range(STATES):
                spread += row[i] * p[i, j] * row[j]
        miss = range_m - (1.0 + x[5]) * far - x[6]
        surprise = miss * miss / spread
        told[k] -= 0.5 * ((freedom + 1.0) * np.log1p(surprise / freedom) + np.log(spread))
        heavier = (freedom + 3.0) * (freedom + surprise) / (freedom + 1.0) ** 2
        absorb(x, p, row, miss, variance * heavier, work)


class Bank:
    """Small filters of one vehicle that odometry carries, of different noise.

    Parameters
    ----------
    belief : Belief
        With inputs that hold the vehicle's odometry.
    vehicle : int
    """

    def __init__(self, belief: Belief, vehicle: int) -> None:
        inputs = belief.inputs
        assert inputs is not None
        rows = np.flatnonzero((inputs.kind == WHEELS) & (inputs.vehicle == vehicle))
        self._who = vehicle
        self._end_s, self._arc = inputs.time_s[rows], inputs.value[rows]
        decades = np.array(list(product(*DECADES)), float)
        self._factor = 10.0**decades
        self._decades = decades
        self._prior = -0.5 * np.sum((decades / PRIOR_DECADES) ** 2, axis=1)
        self._told = np.zeros(len(decades))
        self._mean = np.zeros((len(decades), STATES))
        self._covariance = np.zeros((len(decades), STATES, STATES))
        self._now_s: float | None = None
        self._heard: list[tuple[float, Floats, Floats, float, float, float]] = []
        slot = int(inputs.wheel_slot[vehicle])
        wander = (wheels.SCALE_PSD * belief.free[slot + 3], wheels.BIAS_PSD * belief.free[slot + 4])
        self._constants = np.array(
            [wheels.CREEP_PSD, wheels.SLIP_M, wheels.TWIST_PSD, wheels.TWIST_M, wheels.TWIST_RAD, *wander]
        )

    @property
    def factors(self) -> Floats:
        """Factors (3,) on the variances of place and heading, and on the drift of scale and bias."""
        odds = self._prior + self._told
        weight = np.exp(odds - odds.max())
        return 10.0 ** (weight @ self._decades / weight.sum())

    def forget(self) -> None:
        """Begin anew at the next epoch: the vehicle was pushed, or placed elsewhere; what was learnt stays."""
        self._now_s, self._heard = None, []

    def take(self, before: Belief, after: Belief, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_]) -> None:
        """Take in an epoch: ``before`` is the track's belief predicted to its instant, ``after`` the one corrected."""
        at = SIZE * self._who
        if not (after.placed[self._who] and after.free[at + YAW]):
            self.forget()
        elif self._now_s is None:
            self._begin(after)
        else:
            self._gather(before, epoch, links, asked)
            self._go(after.time_s)

    def _begin(self, belief: Belief) -> None:
        inputs = belief.inputs
        assert inputs is not None
        at, slot = SIZE * self._who, int(inputs.wheel_slot[self._who])
        own = np.array([at, at + 1, at + YAW, slot + 3, slot + 4, inputs.range_slot, inputs.range_slot + 1])
        mean, covariance = belief.mean[own], belief.covariance[np.ix_(own, own)]
        # the track follows the arm's end, odometry the origin
        cos, sin = np.cos(mean[2]), np.sin(mean[2])
        x, y = inputs.arm[self._who]
        swing = np.array([cos * x - sin * y, sin * x + cos * y])
        mean[:2] -= swing
        shift = np.eye(STATES)
        shift[:2, 2] = swing[1], -swing[0]
        self._mean[:], self._covariance[:] = mean, shift @ covariance @ shift.T
        self._now_s = belief.time_s

    def _gather(self, before: Belief, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_]) -> None:
        """Keep an epoch's ranges to fixed ends until arcs have come that reach as far."""
        inputs, trust = before.inputs, before.trust
        assert inputs is not None
        assert trust is not None
        listens = links.receiver_vehicle == self._who
        sounds = (links.emitter_vehicle == self._who) & (links.receiver_vehicle < 0)
        level = before.mean[SIZE * self._who + 2]
        pairs = len(inputs.pairs)
        for i in np.flatnonzero(asked & ((listens & (links.emitter_vehicle < 0)) | sounds)).tolist():
            arm, other = links.receiver_point[i], links.emitter_point[i].copy()
            if sounds[i]:
                arm, other = links.emitter_point[i], links.receiver_point[i].copy()
            other[2] -= level
            pair = np.array([inputs.pairs[epoch.emitter[i], epoch.receiver[i]]])
            own = stated.places(inputs.range_slot, pair, pairs)[:, 0]
            variance = epoch.covariance_m2[i, i] + trust.extra(pair)[0] + before.covariance[np.ix_(own, own)].sum()
            range_m = float(epoch.range_m[i] - before.mean[own].sum())
            self._heard.append((float(epoch.time_s[i]), other, arm, range_m, float(variance), trust.freedom))
        self._heard.sort(key=lambda one: one[0])

    def _go(self, until_s: float) -> None:
        """Go along all arcs told until an instant, and hear what was heard on them."""
        now_s = self._now_s if self._now_s is not None else until_s
        first, last = np.searchsorted(self._end_s, [now_s, until_s], side="right")
        for row in range(int(first), int(last)):
            way, turn, dt = self._arc[row, :3].tolist()
            if not np.isfinite(way + turn + dt) or dt > wheels.LONGEST_S:
                self.forget()
                return
            end_s = float(self._end_s[row])
            stops = [one for one in self._heard if one[0] <= end_s]
            self._heard = self._heard[len(stops) :]
            for time_s, heard in [*((one[0], one) for one in stops), (end_s, None)]:
                part = min(max(time_s - now_s, 0.0), dt) / dt if dt > 0 else 0.0
                if part > 0:
                    arc = part * self._arc[row, :3]
                    drive(self._mean, self._covariance, self._factor, arc, self._constants)
                    now_s = max(time_s, now_s)
                if heard is not None:
                    _, other, arm, range_m, variance, freedom = heard
                    hear(self._mean, self._covariance, other, arm, range_m, variance, freedom, self._told)
            self._now_s = now_s
            self._told -= self._told.max()
            self._told *= np.exp(-dt / MEMORY_S)
