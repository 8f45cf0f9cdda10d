"""How far each robot's odometry may be trusted: learnt while driving, from what is heard.

Two things are learnt. How far its place and its heading stray by chance: many small filters run beside the team's, each
with noise of its own, on the same odometry and measurements, and how likely each found these weighs it (Magill 1965;
Bar-Shalom, Li and Kirubarajan 2001, section 11.6.2), as `track.bank` does for a single vehicle. And how far it slips,
which is a state: by its expected square, a step of expectation-maximisation an instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numba
import numpy as np

from sonofix.records import Floats
from sonofix.team.feed import SIGHTING, Feed
from sonofix.team.kernel import advance, expect, turned_by
from sonofix.team.noise import BEARING, NEW, STAYING, Noise, fade, variance_of
from sonofix.team.state import SIZE, SLIP_S, SLIP_SD, SPEED_SLIP, TURN_SLIP, wander_psd
from sonofix.track.bank import MEMORY_S, PRIOR_DECADES
from sonofix.track.kernel import absorb
from sonofix.track.stated import HEAVY

if TYPE_CHECKING:
    from sonofix.team.belief import Belief

DECADES = (-2, -1, 0, 1, 2)
"""Powers of ten by which members multiply the variances of place, and of heading."""

POOL = 10.0
"""Slips that weigh as much as what is expected of them before anything was heard."""

REMEMBERED = 300.0
"""Slips by which it is judged how large they are."""

LEAST = 1e-4
"""They are never taken for less than by this factor on their variance."""


@numba.njit(cache=True, error_model="numpy")
def weigh(
    mean, covariance, chances, robot, rows, kind, listener, source, listener_point, source_point, range_m,
    range_sd_m, bearing_rad, view, time_s, known, fading, swell, last, believed, flight_s_per_m, speed, placed, about,
    doubt,
):  # fmt: skip
    """Correct the members (K, SIZE), (K, SIZE, SIZE) of one robot by rows; add log likelihoods to ``chances`` (K,).

    Other robots, and errors of views, are as ``about`` and ``doubt``, the team's mean and covariance before these rows,
    have them. Noise is Student's t, of `HEAVY` degrees. The rest is as `hear.hear` has it.
    """
    robots = len(placed)
    both, row = np.zeros(2 * SIZE), np.empty((2, 2 * SIZE))
    work, fast = np.empty((3, SIZE)), np.zeros(2)
    for i in range(rows[0], rows[1]):
        a, b = listener[i], source[i]
        if kind[i] != SIGHTING or (a != robot and b != robot):
            continue
        other = b if a == robot else a
        if other >= 0 and not placed[other]:
            continue
        who = a if a >= 0 else robots
        fast[0] = speed[robot]
        if other >= 0:
            both[SIZE:] = about[SIZE * other : SIZE * (other + 1)]
            fast[1] = speed[other]
        here = 0 if a == robot else (1 if a >= 0 else -1)
        there = 0 if b == robot else (1 if b >= 0 else -1)
        staying = missed = 0.0
        if not believed and np.isfinite(range_m[i]):
            at = SIZE * robots + view[i]
            left = fade(time_s[i] - last[view[i], 0], range_m[i], last[view[i], 1], fading)
            staying = variance_of(known, who, STAYING, range_m[i])
            missed = np.sqrt(staying) * left * about[at]
            staying *= 1.0 - left * left + left * left * doubt[at, at]
        for k in range(len(mean)):
            both[:SIZE] = mean[k]
            shown, direction, _ = expect(
                both, here, there, listener_point[i], source_point[i], flight_s_per_m, fast, believed, row
            )
            before = mean[k].copy()
            for j in (1, 0):
                measured = bearing_rad[i] if j == 1 else range_m[i]
                if not np.isfinite(measured) or (j == 1 and a < 0):
                    continue
                if j == 1:
                    off = turned_by(measured - direction)
                    variance = variance_of(known, who, BEARING, range_m[i]) * (1.0 if believed else swell[who, 1])
                else:
                    off = measured - shown - missed
                    variance = range_sd_m[i] ** 2 if np.isfinite(range_sd_m[i]) else 0.0
                    variance += staying
                    if not believed:
                        variance += variance_of(known, who, NEW, range_m[i]) * swell[who, 0]
                if other >= 0:
                    for m in range(SIZE):
                        for q in range(SIZE):
                            variance += row[j, SIZE + m] * doubt[SIZE * other + m, SIZE * other + q] * row[j, SIZE + q]
                total = variance
                for m in range(SIZE):
                    off -= row[j, m] * (mean[k, m] - before[m])
                    for q in range(SIZE):
                        total += row[j, m] * covariance[k, m, q] * row[j, q]
                surprise = off * off / total
                chances[k] -= 0.5 * ((HEAVY + 1.0) * np.log1p(surprise / HEAVY) + np.log(total))
                heavier = (HEAVY + 3.0) * (HEAVY + surprise) / (HEAVY + 1.0) ** 2
                absorb(mean[k], covariance[k], row[j, :SIZE], off, variance * heavier, work)


@numba.njit(cache=True, error_model="numpy")
def carry(mean, covariance, time_s, told, from_s, until_s, rough, psd):
    """Drive all members on, in place; ``rough`` (K, 4)."""
    placed, first = np.ones(1, np.bool_), np.array([0, len(time_s)])
    by, noise, speed = np.zeros((1, 3, SIZE)), np.zeros((1, 3, 3)), np.zeros(1)
    for k in range(len(mean)):
        advance(
            mean[k], covariance[k], mean[k], placed, first, time_s, told, from_s, until_s, rough[k : k + 1], psd,
            by, noise, speed,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Learnt:
    """Of V robots: logarithms of K members' likelihoods (V, K), and sums of two slips, count and square (V, 2, 2)."""

    chances: Floats
    slips: Floats


class Rough:
    """What is learnt of the odometry of V robots; writes the factors of a `Belief`."""

    def __init__(self, feed: Feed) -> None:
        robots = len(feed.robots)
        self._decades = np.array(list(product(DECADES, DECADES)), float)
        self._prior = -0.5 * np.sum((self._decades / PRIOR_DECADES) ** 2, axis=1)
        members = len(self._decades)
        self._chances = np.zeros((robots, members))
        self._mean = np.zeros((robots, members, SIZE))
        self._covariance = np.zeros((robots, members, SIZE, SIZE))
        self._now_s = np.full(robots, np.nan)
        self._slips = np.zeros((robots, 2, 2))
        self._slip_s = np.full(robots, np.nan)
        self._psd = wander_psd(feed.own_ranges)

    def forget(self, robot: int) -> None:
        """Begin a robot's members anew: it was placed elsewhere; what was learnt stays."""
        self._now_s[robot] = np.nan

    def learnt(self) -> Learnt:
        """Return what is known until now."""
        return Learnt(self._chances.copy(), self._slips.copy())

    def unlearn(self, belief: Belief, robot: int, learnt: Learnt, rough: Floats) -> None:
        """Go back, for one robot, to what was ``learnt``, and the factors that led to: since then it was pushed."""
        self.forget(robot)
        self._chances[robot], self._slips[robot] = learnt.chances[robot], learnt.slips[robot]
        belief.rough[robot] = rough[robot]

    def take(self, feed: Feed, belief: Belief, known: Noise, rows: tuple[int, int], robot: int, now_s: float) -> None:
        """Take rows in for one robot, of which ``belief`` knows all that came before; set its factors on noise."""
        if not belief.placed[robot]:
            self.forget(robot)
            return
        own = slice(SIZE * robot, SIZE * (robot + 1))
        mean, covariance = self._mean[robot], self._covariance[robot]
        if np.isnan(self._now_s[robot]):
            mean[:], covariance[:] = belief.mean[own], belief.covariance[own, own]
        else:
            a, b = feed.first[robot], feed.first[robot + 1]
            rough = np.tile(belief.rough[robot], (len(mean), 1))
            rough[:, :2] = 10.0**self._decades
            since_s = float(self._now_s[robot])
            carry(mean, covariance, feed.odometry_s[a:b], feed.odometry[a:b], since_s, now_s, rough, self._psd)
            chances = self._chances[robot]
            weigh(
                mean, covariance, chances, robot, rows, feed.kind, feed.listener, feed.source, feed.listener_point,
                feed.source_point, feed.range_m, feed.range_sd_m, feed.bearing_rad, feed.view, feed.time_s, known.known,
                known.fading, known.swell, belief.last, known.believed, 1.0 / feed.sound_speed_mps, belief.speed,
                belief.placed, belief.mean, belief.covariance,
            )  # fmt: skip
            chances -= chances.max()
            chances *= np.exp(-(now_s - since_s) / MEMORY_S)
            odds = self._prior + chances
            weight = np.exp(odds - odds.max())
            belief.rough[robot, :2] = 10.0 ** (weight @ self._decades / weight.sum())
        self._now_s[robot] = now_s

    def slipped(self, belief: Belief, robot: int, now_s: float) -> None:
        """Learn from a belief just corrected how far a robot slips; set its factors on that."""
        left = np.exp(-(now_s - self._slip_s[robot]) / SLIP_S) if np.isfinite(self._slip_s[robot]) else 0.0
        self._slip_s[robot] = now_s
        for j, state in enumerate((SPEED_SLIP, TURN_SLIP)):
            at = SIZE * robot + state
            taken = belief.rough[robot, 2 + j]
            variance = belief.covariance[at, at] / SLIP_SD**2
            # what nothing was heard of says nothing; how well a slip is seen depends on no measurement's value
            weight = (1.0 - left**2) * max(0.0, 1.0 - variance / taken)
            keep = 1.0 - weight / REMEMBERED
            self._slips[robot, j] *= keep
            self._slips[robot, j] += weight * np.array([1.0, (belief.mean[at] / SLIP_SD) ** 2 + variance])
            count, square = self._slips[robot, j]
            belief.rough[robot, 2 + j] = max((square + POOL) / (count + POOL), LEAST)
