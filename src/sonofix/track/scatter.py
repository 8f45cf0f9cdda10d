"""How far positions err that others computed: a scale on what they state, learnt from innovations.

A vehicle that moves freely and positions that err look alike in one innovation; in a row of them they do not (Mehra
1970). So small filters of the vehicle's place and velocity run beside the track, each with a scale and an agility of
its own, and how likely each found what came weighs it (multiple-model estimation: Magill 1965). Where a vehicle's own
sensors lead the track, its own innovations tell the scale better; what the small filters heard is kept apart from that,
so that they can gainsay it. All of this fades, so that the scale follows noise that changes. A position may also be
anything, so that one outlier tells next to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sonofix.records import Floats

SCALES: Floats = np.geomspace(1.0, 100.0, 24)
"""What deviations are taken times, 1.22 apart. Never less than they are stated: what lasts shows in no innovation."""

AGILE: Floats = np.array([5.0, 0.5, 0.05, 0.005, 0.0005])
"""Densities of white acceleration, in m²/s³: a car in traffic, to one that stands."""

PRIOR = 4.0
"""Before anything was heard a scale s is as likely as this power of 1/s: twice the stated is one to sixteen."""

_BEFORE: Floats = -PRIOR * np.log(SCALES)[:, None]

REMEMBERED = 50.0
"""Positions by which the scale is judged: it is then known to 7 %."""

UNDONE = 20.0
"""No member is less likely than the likeliest by more, as a logarithm: noise may change at once."""

STRAY = 0.05
"""Share of positions that may be anything within `ROOM_M`."""

ROOM_M = 100.0
"""Along each axis."""


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """What is known of how far the positions of one vehicle err along some axes; a new one with each.

    Attributes
    ----------
    heard : float64 (24, 5)
        Logarithms of how likely each of `SCALES` and `AGILE` found what came, faded.
    time_s : float
    state : float64 (24, 5, 2, d) or None
        Of each member the place along d axes and its velocity, [place or velocity, axis]; None before a first position.
    covariance : float64 (24, 5, 2, 2)
        Of place and velocity, the same along each axis.
    led : float64 (24, 1) or None
        As ``heard``, by a track that a vehicle's own sensors lead; None where none do.
    """

    heard: Floats
    time_s: float = 0.0
    state: Floats | None = None
    covariance: Floats | None = None
    led: Floats | None = None

    @property
    def weight(self) -> Floats:
        """How likely each scale is (24,)."""
        return (self._members if self.led is None else _weighed(self.led)).sum(axis=1)

    @property
    def _members(self) -> Floats:
        """How likely each member is (24, 5)."""
        return _weighed(self.heard)

    @property
    def scale(self) -> float:
        """What a stated deviation is to be taken times, by the mean of variances."""
        return float(np.sqrt(self.weight @ SCALES**2))

    def begun(self, time_s: float, place_m: Floats, variance_m2: float, speed_sd_mps: float) -> Scatter:
        """Return what is known where a vehicle was put, at a position (d,) of a stated variance, and moves anyhow."""
        state = np.zeros((len(SCALES), len(AGILE), 2, len(place_m)))
        state[:, :, 0] = place_m
        covariance = np.zeros((len(SCALES), len(AGILE), 2, 2))
        covariance[:, :, 0, 0] = variance_m2 * SCALES[:, None] ** 2
        covariance[:, :, 1, 1] = speed_sd_mps**2
        return replace(self, time_s=time_s, state=state, covariance=covariance)

    def taken(self, time_s: float, place_m: Floats, variance_m2: float) -> tuple[Scatter, float]:
        """Return what is known once a position (d,) of a stated variance came, by the members.

        Beside it the logarithm of how likely that was, over that of one that may be anything.
        """
        assert self.state is not None
        assert self.covariance is not None
        dt = time_s - self.time_s
        flow = np.array([[1.0, dt], [0.0, 1.0]])
        # Bar-Shalom 2001, eq 6.2.2-12
        stirred = AGILE[:, None, None] * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        state, covariance = flow @ self.state, flow @ self.covariance @ flow.T + stirred
        noise = variance_m2 * SCALES[:, None] ** 2
        spread = covariance[..., 0, 0] + noise
        miss = place_m - state[:, :, 0]
        axes = len(place_m)
        sized = np.log(1.0 - STRAY) - 0.5 * (axes * np.log(2.0 * np.pi * spread) + (miss**2).sum(axis=-1) / spread)
        believed = sized > stray(axes)
        gain = np.where(believed[..., None], covariance[..., 0] / spread[..., None], 0.0)
        keep = np.eye(2) - gain[..., None] * np.array([1.0, 0.0])
        noisy = noise[..., None, None] * gain[..., None] * gain[..., None, :]
        covariance = keep @ covariance @ np.swapaxes(keep, -1, -2) + noisy
        state = state + gain[..., None] * miss[..., None, :]
        told = np.logaddexp(sized, stray(axes))
        likely = float(np.log(np.sum(self._members * np.exp(told - stray(axes)))))
        return Scatter(_told(self.heard, told), time_s, state, covariance, self.led), likely

    def judged(self, miss_m: Floats, spread_m2: Floats, stated_m2: Floats) -> tuple[Scatter, float]:
        """Return what is known once a position came, by a track that sensors lead, and how likely it was, as `taken`.

        ``miss_m`` (d,) is by how much it is off the track, ``spread_m2`` (d, d) the covariance of what the track
        expects, ``stated_m2`` (d, d) that which the position states.
        """
        each = spread_m2 + SCALES[:, None, None] ** 2 * stated_m2
        surprise = (
            np.linalg.solve(each, np.broadcast_to(miss_m, (len(SCALES), len(miss_m)))[..., None])[..., 0] @ miss_m
        )
        sized = np.log(1.0 - STRAY) - 0.5 * (surprise + np.linalg.slogdet(2.0 * np.pi * each)[1])
        told = np.logaddexp(sized, stray(len(miss_m)))
        weight = self.weight
        # what the members learnt before sensors led goes on
        led = _told(np.log(weight)[:, None] - _BEFORE, np.zeros((len(SCALES), 1))) if self.led is None else self.led
        likely = float(np.log(weight @ np.exp(told - stray(len(miss_m)))))
        return replace(self, led=_told(led, told[:, None])), likely

    def mixed(self) -> tuple[Floats, Floats]:
        """Return the mean (2, d) of all members, place and velocity, and its covariance with their scatter."""
        assert self.state is not None
        assert self.covariance is not None
        weight = self._members
        mean = np.einsum("sq,sqia->ia", weight, self.state)
        apart = (self.state - mean).reshape(*weight.shape, mean.size)
        within = np.kron(np.einsum("sq,sqij->ij", weight, self.covariance), np.eye(mean.shape[1]))
        return mean, within + np.einsum("sq,sqi,sqj->ij", weight, apart, apart)


def _weighed(heard: Floats) -> Floats:
    """Return how likely each is that found what came as likely as ``heard``."""
    log = heard + _BEFORE
    weight = np.exp(log - log.max())
    return weight / weight.sum()


def _told(heard: Floats, told: Floats) -> Floats:
    log = (1.0 - 1.0 / REMEMBERED) * heard + told + _BEFORE
    # not by what was heard alone: scales that few positions refute would come back by what was likely before
    return np.maximum(log - log.max(), -UNDONE) - _BEFORE


def stray(axes: int) -> float:
    """Logarithm of the density of a position that may be anything, times how often one is."""
    return float(np.log(STRAY) - axes * np.log(ROOM_M))


def scatter() -> Scatter:
    """Return what is known before any position came."""
    return Scatter(np.zeros((len(SCALES), len(AGILE))))
