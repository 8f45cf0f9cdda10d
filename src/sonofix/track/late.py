"""Epochs that come late or out of order: the track goes back to before them, and takes in anew what came since.

Whatever the order in which epochs within the window come, the track ends as if the same ranges and fixes had come each
at its time.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Estimate, Event, Fix, Innovation, RangeEpoch
from sonofix.track.follow import Follower


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    """An epoch, and the follower as it was before."""

    time_s: float
    epoch: RangeEpoch
    fixes: tuple[Fix, ...]
    before: Follower


class Rewinder:
    """Follows epochs in the order of their times, however they come.

    Parameters
    ----------
    follower : Follower
        As it is before the first epoch.
    window_s : float
        By how much an epoch may come late, counted from the latest; what comes later still is left out, and told.

    Attributes
    ----------
    innovation : Innovation or None
        Of the epoch that came last, at its own instant.
    """

    def __init__(self, follower: Follower, window_s: float) -> None:
        self.follower = follower
        self._window_s = window_s
        self._taken: list[_Taken] = []
        self.innovation: Innovation | None = None

    def step(
        self, epoch: RangeEpoch, fixes: tuple[Fix, ...]
    ) -> tuple[tuple[Estimate, ...], NDArray[np.bool_], tuple[Event, ...]]:
        """Take in one epoch; return what `Follower.step` does: estimates at the latest instant, the epoch's rows used.

        Events are those of this epoch; what a late one changes in those after it is not told again.
        """
        time_s = self.follower.time_of(epoch)
        times = [taken.time_s for taken in self._taken]
        if times and time_s < times[-1] - self._window_s:
            self.innovation = None
            late_s = times[-1] - time_s
            text = f"came {late_s:.3g} s late, beyond the window of {self._window_s:g} s: left out"
            return (), np.zeros(len(epoch), bool), (Event(time_s, "", "late", text),)
        at = bisect_right(times, time_s)
        since = self._taken[at:]
        if since:
            self.follower = since[0].before
        del self._taken[at:]
        estimates, used, events = self._follow(_Taken(time_s, epoch, fixes, self.follower))
        self.innovation = self.follower.innovation
        for taken in since:
            estimates, _, _ = self._follow(taken)
        last_s = self._taken[-1].time_s
        # one from before the window stays: the latest that may come is taken in behind it
        while len(self._taken) > 1 and self._taken[1].time_s < last_s - self._window_s:
            del self._taken[0]
        return estimates, used, events

    def _follow(self, taken: _Taken) -> tuple[tuple[Estimate, ...], NDArray[np.bool_], tuple[Event, ...]]:
        before = self.follower.copied()
        self._taken.append(_Taken(taken.time_s, taken.epoch, taken.fixes, before))
        return self.follower.step(taken.epoch, taken.fixes)
