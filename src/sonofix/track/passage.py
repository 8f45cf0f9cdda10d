"""One pass through a recording's epochs that leaves knots to be smoothed, and what it teaches the next pass."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import POSE
from sonofix.records import Event, Fix, Floats, RangeEpoch
from sonofix.track.belief import SIZE, Belief, Nominal, predict, set_out
from sonofix.track.chain import Chain
from sonofix.track.follow import Follower
from sonofix.track.inputs import GYRO, Inputs, reckoned
from sonofix.track.wheels import open_heading

Heard = tuple[RangeEpoch, tuple[Fix, ...]]
"""What one epoch brought: its ranges, and the fixes made of them."""

YAW = POSE.index("yaw")

ANY_HEADING_RAD = float(np.pi / np.sqrt(3))
"""Deviation of a heading that may be any."""


@dataclass(frozen=True, slots=True, eq=False)
class Entered:
    """What an epoch did to the filter: its ranges, which of them entered, and its events."""

    ranges: RangeEpoch
    used: NDArray[np.bool_]
    events: tuple[Event, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """What a knot is for.

    ``epoch`` is the number of that it belongs to, ``rows`` those of the inputs that it stands just before; ``told``: it
    is a row of the track; ``entered``: it is its epoch's end; ``hidden``: vehicles of which nothing is told.
    """

    epoch: int
    rows: tuple[int, ...] = ()
    told: bool = False
    entered: Entered | None = None
    hidden: frozenset[int] = frozenset()

    @property
    def ends(self) -> bool:
        """Whether it is the end of its epoch."""
        return self.entered is not None


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """A heading that a later part of the track tells: known from this epoch on, where it began to be ``yaw_rad``."""

    epoch: int
    vehicle: int
    yaw_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Guide:
    """What a pass knows beforehand from the pass before: where to linearise (`Nominal`, for all epochs), openings."""

    row: Floats
    now: Floats
    sd: Floats
    openings: tuple[Opening, ...] = ()


class Passage:
    """One pass through a recording's epochs, in order, that leaves a chain of knots behind.

    Parameters
    ----------
    follower : Follower
        At its beginning.
    rate_hz : float or None
        Rows of the track a second; None: one an epoch.
    guide : Guide or None
        Of the pass before.
    relinearise : bool
        Make knots before rows of the inputs too, for a `Guide`.
    """

    def __init__(
        self, follower: Follower, rate_hz: float | None = None, guide: Guide | None = None, relinearise: bool = True
    ) -> None:
        self.follower = follower
        self.chain = Chain()
        self.marks: list[Mark] = []
        self.epochs = 0
        self._rate_hz = rate_hz
        self._guide = guide
        self._relinearise = relinearise
        self._written: int | None = None

    def take(self, heard: Heard) -> None:
        """Follow one epoch."""
        epoch, fixes = heard
        follower = self.follower
        if follower.belief.placed.any():
            if not self.marks:
                self._knot(Mark(self.epochs))
            self._advance(max(follower.time_of(epoch), follower.belief.time_s))
        if self._guide is not None:
            about = Nominal(self._guide.row, self._guide.now[self.epochs])
            follower.belief = replace(follower.belief, about=about)
        hidden = follower.hidden
        _, used, events = follower.step(epoch, fixes)
        anew = {event.vehicle for event in events if event.event == "reset"}
        names = [vehicle.id for vehicle in follower.site.vehicles]
        self._show({who for who in hidden - follower.hidden if names[who] not in anew})
        for opening in self._guide.openings if self._guide is not None else ():
            if opening.epoch == self.epochs:
                follower.belief = _opened(follower.belief, opening)
        if follower.belief.placed.any():
            self._knot(Mark(self.epochs, told=self._rate_hz is None, entered=Entered(epoch, used, events)))
            if self._rate_hz is not None and self._written is None:
                self._written = int(np.ceil(follower.belief.time_s * self._rate_hz))
        self.epochs += 1

    def _advance(self, until_s: float) -> None:
        """Go on to an epoch's instant, with knots on the way."""
        inputs, now_s = self.follower.belief.inputs, self.follower.belief.time_s
        stops: list[tuple[float, Mark]] = []
        if inputs is not None and self._relinearise:
            # a gyro's turns are linear
            bent = [i for i in inputs.within(now_s, until_s) if inputs.kind[i] != GYRO]
            rows = [i for i in bent if self.follower.belief.placed[inputs.vehicle[i]]]
            times = inputs.time_s[rows]
            for time_s in np.unique(times).tolist():
                own = tuple(row for row, t in zip(rows, times, strict=True) if t == time_s)
                stops.append((float(np.nextafter(time_s, -np.inf)), Mark(self.epochs, own)))
        if self._rate_hz is not None and self._written is not None:
            last = int(np.floor(until_s * self._rate_hz))
            stops += [(k / self._rate_hz, Mark(self.epochs, told=True)) for k in range(self._written, last + 1)]
            self._written = max(last + 1, self._written)
        for time_s, mark in sorted(stops, key=lambda stop: stop[0]):
            if time_s > self.follower.belief.time_s:
                self.follower.belief = predict(self.follower.belief, time_s, self.follower.motion)
            self._knot(mark)

    def _knot(self, mark: Mark) -> None:
        self.follower.belief = self.chain.knot(self.follower.belief)
        self.marks.append(replace(mark, hidden=self.follower.hidden))

    def _show(self, vehicles: set[int]) -> None:
        """Let vehicles be told of from when they were hidden: their track turned out to be right."""
        for who in vehicles:
            for k in range(len(self.marks) - 1, -1, -1):
                if who not in self.marks[k].hidden:
                    break
                self.marks[k] = replace(self.marks[k], hidden=self.marks[k].hidden - {who})

    def back(self) -> Iterator[tuple[Mark, Belief]]:
        """Return knots smoothed, last first."""
        if self.marks:
            yield from zip(reversed(self.marks), self.chain.back(), strict=True)

    def forget(self, count: int) -> None:
        """Let go of the first knots."""
        self.chain.forget(count)
        del self.marks[:count]


def guided(passage: Passage, before: tuple[Opening, ...] = ()) -> Guide:
    """Return what the next pass may know of a pass: its smoothed track, with the headings that it had opened before."""
    belief = passage.follower.belief
    inputs, count = belief.inputs, passage.epochs
    n = SIZE * len(belief.placed) + (inputs.size if inputs is not None else 0) + 2
    row = np.full((0 if inputs is None else len(inputs.time_s), n), np.nan)
    now, sd = np.full((count, n), np.nan), np.full((count, n), np.nan)
    times_s = np.full(count, np.nan)
    for mark, smoothed in passage.back():
        state = np.where(smoothed.free, smoothed.mean, np.nan)
        if mark.ends:
            now[mark.epoch], times_s[mark.epoch] = state, smoothed.time_s
            sd[mark.epoch] = np.sqrt(np.maximum(smoothed.covariance.diagonal(), 1e-30))
        row[list(mark.rows)] = state
    openings = [replace(old, yaw_rad=float(now[old.epoch, SIZE * old.vehicle + YAW])) for old in before]
    openings = [opening for opening in openings if np.isfinite(opening.yaw_rad)]
    if inputs is not None:
        for who in np.flatnonzero(inputs.wheel_slot >= 0).tolist():
            openings += _backwards(inputs, who, times_s, row, now)
    return Guide(row, now, sd, tuple(openings))


def _backwards(inputs: Inputs, who: int, times_s: Floats, row: Floats, now: Floats) -> Iterator[Opening]:
    """Lead a heading that became known on the way back to where the vehicle was placed, by its odometry, in place."""
    at, anchor = SIZE * who + YAW, int(inputs.wheel_slot[who]) + 2
    placed, known = np.isfinite(now[:, SIZE * who]), np.isfinite(now[:, at])
    path = reckoned(inputs, who, np.inf)
    if not len(path):
        return
    rows = np.flatnonzero(inputs.vehicle == who)

    def turned(time_s: Floats) -> Floats:
        return path[np.maximum(np.searchsorted(path[:, 0], time_s, side="right") - 1, 0), 3]

    for first in np.flatnonzero(placed & ~known & np.append(True, ~placed[:-1] | known[:-1])).tolist():
        after = np.flatnonzero(known[first:]) + first
        if not len(after) or not placed[first : after[0]].all():
            continue
        begun = after[0]
        yaw = now[begun, at] - turned(times_s[begun : begun + 1])
        now[first:begun, at] = yaw + turned(times_s[first:begun])
        own = rows[(inputs.time_s[rows] > times_s[first]) & (inputs.time_s[rows] <= times_s[begun])]
        row[own, at] = yaw + turned(inputs.time_s[own])
        row[own, anchor] = yaw + turned(np.nextafter(inputs.time_s[own], -np.inf))
        yield Opening(first, who, float(now[first, at]))


def _opened(belief: Belief, opening: Opening) -> Belief:
    """Begin to follow a heading, which may be any, linearised where it will be found."""
    if not belief.placed[opening.vehicle] or belief.free[SIZE * opening.vehicle + YAW]:
        return belief
    mean, covariance, free = belief.mean.copy(), belief.covariance.copy(), belief.free.copy()
    open_heading(mean, covariance, free, opening.vehicle, opening.yaw_rad, ANY_HEADING_RAD)
    return set_out(replace(belief, mean=mean, covariance=covariance, free=free))
