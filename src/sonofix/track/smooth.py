"""Smoothing a recording: each instant with all that was told before it and after.

The epochs are followed once more, with a knot (`chain`) at each of them and wherever a row is wished for, and smoothed
backwards. What is not linear is then linearised anew about the smoothed track, until that stays where it is: Gauss and
Newton's method for the most likely track (Bell 1994, "The iterated Kalman smoother as a Gauss-Newton method").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import link
from sonofix.records import Estimate, Floats
from sonofix.track.belief import SIZE, Belief, estimate, predict
from sonofix.track.chain import Chain
from sonofix.track.follow import Follower
from sonofix.track.passage import Guide, Heard, Mark, Passage, guided
from sonofix.track.update import update

PASSES = 3
"""Most passes through a recording."""

SETTLED = 0.1
"""Passes end when no state of an epoch moves by more of its own deviation."""

MOST_BYTES = 4e9
"""Of knots kept at once: a covariance and a tie of all states each."""

BACK_SD_M = 1.0
"""A track is led back to before its vehicle's first fix while its place is known better than this."""


def smooth(
    begin: Callable[[], Follower],
    heard: Sequence[Heard],
    rate_hz: float | None = None,
    passes: int = PASSES,
    on_epoch: Callable[[], None] = lambda: None,
) -> list[tuple[Estimate, ...]]:
    """Smooth a recording between its ends (fixed interval).

    Parameters
    ----------
    begin : callable
        Gives a follower as it was before the first epoch.
    heard : sequence of (RangeEpoch, tuple of Fix)
    rate_hz : float or None
        Rows of the track a second; None: one an epoch.
    passes : int
        At most; 1 linearises where the filter did.
    on_epoch : callable
        Is called once an epoch and pass.

    Returns
    -------
    list of tuple of Estimate, as long as ``heard``
        Of source "smoothed", in order of time: what falls to each epoch.
    """
    parts = []
    for weight, each in _beginnings(begin, heard, on_epoch):
        passage = settle(each, heard, rate_hz, passes, on_epoch)
        parts.append((weight, track(passage, heard, passage.back(), rate_hz)))
    return parts[0][1] if len(parts) == 1 else _mixed(parts)


def track(
    passage: Passage, heard: Sequence[Heard], smoothed: Iterable[tuple[Mark, Belief]], rate_hz: float | None
) -> list[tuple[Estimate, ...]]:
    """Return what falls to each epoch of a passage whose knots were smoothed, last first."""
    out: list[list[Estimate]] = [[] for _ in heard]
    first: Belief | None = None
    for mark, belief in smoothed:
        first = belief
        if mark.told:
            out[mark.epoch][:0] = estimates(belief, passage.follower, mark.hidden)
    if first is not None:
        for epoch, belief in earlier(passage, heard, first, rate_hz):
            out[epoch] += estimates(belief, passage.follower)
    return [tuple(some) for some in out]


def settle(
    begin: Callable[[], Follower],
    heard: Sequence[Heard],
    rate_hz: float | None,
    passes: int,
    on_epoch: Callable[[], None],
    rows: bool = False,
) -> Passage:
    """Pass through a recording, as `smooth` says, until the track stays where it is; return the last pass.

    ``rows``: it shall have knots before rows of the inputs in any case. Where those are too many to be kept, there is
    one pass without them, linearised where the filter did.

    Raises
    ------
    ValueError
        If even the epochs' knots are too many.
    """
    belief = begin().belief
    knot_bytes = 24.0 * len(belief.mean) ** 2
    told = len(heard) if rate_hz is None or not heard else rate_hz * (heard[-1][0].sync_s - heard[0][0].sync_s)
    knots = max(len(heard), told)
    between = 0 if belief.inputs is None else len(belief.inputs.time_s)
    if knots * knot_bytes > MOST_BYTES or (rows and (knots + between) * knot_bytes > MOST_BYTES):
        need = (knots + between * rows) * knot_bytes / 1e9
        text = f"smoothing {len(heard)} epochs of {len(belief.mean)} states at once takes {need:.0f} GB"
        raise ValueError(f"{text}: smooth on the way, with --lag 10")
    if (knots + between) * knot_bytes > MOST_BYTES:
        passes = 1
    if belief.trust is not None and not between:
        # ranges of others alone: derivatives where these very ranges have put the track share their errors, and their
        # scale is then told more surely than it is (as in `update`)
        passes = 1
    guide: Guide | None = None
    before: Follower | None = None
    for left in reversed(range(passes)):
        follower = begin() if before is None else begin().knowing(before)
        passage = Passage(follower, rate_hz, guide, rows or left > 0)
        for one in heard:
            passage.take(one)
            on_epoch()
        if passage.follower.refuted.any():
            # as if that start had not been stated
            anew = settle(partial(_unstarted, begin, passage.follower.refuted), heard, rate_hz, passes, on_epoch, rows)
            if anew.marks:
                return anew
        if not left or not passage.marks or passage.follower.hidden:
            # of two starts that are not told apart none is linearised about
            return passage
        before = passage.follower
        following = guided(passage, () if guide is None else guide.openings)
        if guide is not None:
            with np.errstate(invalid="ignore"):
                moved = np.abs(following.now - guide.now) / guide.sd
            if not np.any(moved > SETTLED):
                return passage
        guide = following
    raise ValueError(f"passes: {passes}; at least 1 is needed")


def _beginnings(
    begin: Callable[[], Follower], heard: Sequence[Heard], on_epoch: Callable[[], None]
) -> list[tuple[float, Callable[[], Follower]]]:
    """Return what the recording is smoothed from, and how likely each is: one beginning, if that is all there is to it.

    Where members of different sizes of errors were needed (`panel.Panel`), which no chain of knots can tie, a first way
    through weighs them, and each that is likely is smoothed by itself.
    """
    scout = begin()
    if not scout.weighs:
        return [(1.0, begin)]
    for epoch, fixes in heard:
        scout.step(epoch, fixes)
        on_epoch()
    return [(w, partial(_with, begin, scout, sizes)) for w, sizes in scout.likely] or [(1.0, begin)]


def _with(begin: Callable[[], Follower], scout: Follower, sizes: Floats) -> Follower:
    return begin().knowing(scout, sizes)


def _unstarted(begin: Callable[[], Follower], refuted: NDArray[np.bool_]) -> Follower:
    return begin().unstarted(refuted)


def _mixed(parts: Sequence[tuple[float, list[tuple[Estimate, ...]]]]) -> list[tuple[Estimate, ...]]:
    """Return the mean of tracks, by weight, with their scatter in its covariance."""
    weight = np.array([w for w, _ in parts])
    out = []
    for epoch in zip(*(told for _, told in parts), strict=True):
        # what one began from later than others, only they have
        times = sorted({e.time_s for some in epoch for e in some})
        by_time = [{e.time_s: e for e in some} for some in epoch]
        rows = [[(w, told[at]) for w, told in zip(weight, by_time, strict=True) if at in told] for at in times]
        out.append(tuple(_mean(row) for row in rows))
    return out


def _mean(row: list[tuple[float, Estimate]]) -> Estimate:
    """Mean of estimates of one vehicle at one instant that have the same states."""
    share = np.array([w for w, _ in row]) / sum(w for w, _ in row)
    states = row[0][1].states
    each = np.array([np.concatenate([e.position_m, e.velocity_mps]) for _, e in row])
    mean = share @ each
    axes = ("x", "y", "z", "vx", "vy", "vz")
    own = [i for i, state in enumerate(states) if state in axes]
    at = [axes.index(states[i]) for i in own]
    covariance = np.einsum("k,kij->ij", share, np.array([e.covariance for _, e in row]))
    apart = (each - mean)[:, at]
    covariance[np.ix_(own, own)] += (share[:, None] * apart).T @ apart
    return replace(row[0][1], position_m=mean[:3], velocity_mps=mean[3:], covariance=covariance)


class FixedLag:
    """Smooths while epochs come: each leaves once others up to ``lag_s`` later are known. One pass, bounded memory.

    Parameters
    ----------
    follower : Follower
        As it was before the first epoch.
    lag_s : float
        Infinite: all leave at the end.
    rate_hz : float or None
        Rows of the track a second; None: one an epoch.
    """

    def __init__(self, follower: Follower, lag_s: float, rate_hz: float | None = None) -> None:
        self._passage = Passage(follower, rate_hz, relinearise=False)
        self._lag_s = lag_s
        self._left = 0

    def take(self, heard: Heard) -> list[tuple[Estimate, ...]]:
        """Follow one epoch; return what falls to each epoch that leaves now, in order."""
        self._passage.take(heard)
        knots = self._passage.chain.knots
        if not knots:
            return self._leave(self._passage.epochs, 0)
        due_s = knots[-1].belief.time_s - self._lag_s
        count = sum(knot.belief.time_s <= due_s for knot in knots)
        ended = [i for i, mark in enumerate(self._passage.marks[:count]) if mark.ends]
        if not ended:
            return []
        return self._leave(self._passage.marks[ended[-1]].epoch + 1, ended[-1] + 1)

    def finish(self) -> list[tuple[Estimate, ...]]:
        """Return what falls to the epochs that have not left."""
        return self._leave(self._passage.epochs, 0)

    def _leave(self, epochs: int, knots: int) -> list[tuple[Estimate, ...]]:
        """Let epochs go, as far as those before number ``epochs``, and what lies before knot ``knots``."""
        out: list[list[Estimate]] = [[] for _ in range(epochs - self._left)]
        if out:
            for mark, belief in self._passage.back():
                if mark.told and self._left <= mark.epoch < epochs:
                    out[mark.epoch - self._left][:0] = estimates(belief, self._passage.follower, mark.hidden)
        self._left = max(epochs, self._left)
        # the last knot's copy travels on
        self._passage.forget(min(knots, len(self._passage.marks) - 1))
        return [tuple(some) for some in out]


def earlier(
    passage: Passage, heard: Sequence[Heard], first: Belief, rate_hz: float | None
) -> Iterator[tuple[int, Belief]]:
    """Lead a smoothed track back to epochs before its first, by ranges too few for a fix and the motion alone.

    ``first`` is the smoothed belief there. What began with ranges gathered from those epochs is not led back, nor what
    has another clock in each. Yields the rows of the track in order of time, each with its epoch.
    """
    begun = next(mark.epoch for mark in passage.marks if mark.ends)
    if passage.marks[0].hidden:
        return
    sound = {fix.vehicle for fix in heard[begun][1] if fix.position_m is not None}
    names = [passage.follower.site.vehicles[who].id for who in np.flatnonzero(first.placed)]
    if passage.follower.free_running or not passage.marks[0].ends or not sound.issuperset(names):
        return
    chain, rows, site = Chain(), [-1], passage.follower.site
    belief = chain.knot(replace(first, about=None))
    limit_s = first.time_s
    for k in range(begun - 1, -1, -1):
        epoch = heard[k][0]
        if not len(epoch):
            continue
        time_s = min(passage.follower.time_of(epoch), limit_s)
        if rate_hz is not None:
            for stop in range(int(np.ceil(limit_s * rate_hz)) - 1, int(np.ceil(time_s * rate_hz)) - 1, -1):
                belief = chain.knot(predict(belief, stop / rate_hz, passage.follower.motion))
                rows.append(k)
        belief = predict(belief, time_s, passage.follower.motion)
        links = link(site, epoch.emitter, epoch.receiver)
        belief, *_ = update(belief, epoch, links, np.isfinite(epoch.range_m))
        own = [SIZE * who + i for who in np.flatnonzero(first.placed) for i in (0, 1)]
        if belief.covariance[own, own].max() > BACK_SD_M**2:
            break
        belief = chain.knot(belief)
        rows.append(-1 if rate_hz is not None else k)
        limit_s = time_s
    for k, smoothed in zip(reversed(rows), chain.back(), strict=True):
        if k >= 0:
            yield k, smoothed


def estimates(belief: Belief, follower: Follower, hidden: frozenset[int] = frozenset()) -> list[Estimate]:
    """Return what a smoothed belief says of each vehicle that may be told of."""
    told = [who for who in np.flatnonzero(belief.placed).tolist() if who not in hidden]
    return [estimate(belief, follower.site, who, "smoothed") for who in told]
