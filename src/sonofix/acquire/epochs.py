"""When to listen: the window of each epoch, from sync commands, the schedule, or the samples themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.clicks import runs
from sonofix.records import Floats
from sonofix.site import Site

CLIPPED = 0.9995
"""Of the loudest sample: two in a row at or above count as clipped, if there are many."""

LOUD = 0.25
"""Of full scale: nothing clips below."""

DROP_OUT_S = 1e-3
"""Samples that stay exactly 0 for longer were never recorded."""

START_GUARD_S = 5e-3
"""Bursts that begin this soon after an unsynchronised recording may hide a first path that came before it."""


@dataclass(frozen=True, slots=True)
class Window:
    """Bursts of one epoch begin to be heard within [opens_s, closes_s], their offsets and delays aside.

    ``sync_s`` is what ranges are measured from; ``seeking`` marks the search for an unknown clock's phase;
    ``before_s`` are the sync commands of earlier epochs, where they were told, latest first.
    """

    index: int
    sync_s: float
    opens_s: float
    closes_s: float
    seeking: bool = False
    before_s: tuple[float, ...] = ()

    def since_s(self, epochs: int, period_s: float) -> float:
        """How long before this epoch another began, so many epochs earlier."""
        if not epochs:
            return 0.0
        return self.sync_s - self.before_s[epochs - 1] if 0 < epochs <= len(self.before_s) else epochs * period_s


def across_s(site: Site, sound_speed_mps: float) -> float:
    """Longest flight there can be: the diagonal of all that is fixed, and of the room; infinite where nothing is."""
    points = [n.position_m for n in (*site.beacons, *site.microphones) if n.position_m is not None]
    points += list(site.bounds_m or ())
    return float(np.linalg.norm(np.ptp(np.array(points), axis=0))) / sound_speed_mps if len(points) > 1 else np.inf


def reach_s(site: Site, sound_speed_mps: float) -> float:
    """Longest flight worth waiting for: the diagonal of all that is fixed and half as much again, 5 m at least.

    Where too little is fixed to tell, 40 m, beyond which 40 kHz has lost 85 dB to spreading and air.
    """
    points = [n.position_m for n in (*site.beacons, *site.microphones) if n.position_m is not None]
    points += list(site.bounds_m or ())
    if len(points) < 2:
        return 40.0 / sound_speed_mps
    span = np.ptp(np.array(points), axis=0)
    return (1.5 * float(np.linalg.norm(span)) + 5.0) / sound_speed_mps


class Schedule:
    """Walks through the epochs of a recording.

    With a common clock, windows follow sync commands or the period from sample 0 on. With an unknown one, the first
    window spans a whole period; where bursts stand in it, later windows are laid round their successors.

    Parameters
    ----------
    period_s : float
    reach : float
        Longest flight, s.
    sync_s : float64 (epochs,) or None
    known : bool
        Whether bursts start at the sync command (else the offset is unknown).
    regular : bool
        Unknown clock: whether one offset holds throughout (fixed beacons), or another each burst (free-running).
    """

    def __init__(self, period_s: float, reach: float, sync_s: Floats | None, known: bool, regular: bool) -> None:
        self._period_s = period_s
        self._sync_s = sync_s if known else None
        self._known, self._regular = known, regular
        self._reach_s = min(reach, period_s) if known else min(reach, period_s / 2)
        self._index = 0
        self._seek_s = 0.0
        self._found = False
        self._first_s: float | None = None
        self._base_s = 0.0

    def window(self) -> Window | None:
        """Return the next window; None after the last sync command."""
        if self._known:
            if self._sync_s is None:
                sync_s = self._index * self._period_s
            elif self._index < len(self._sync_s):
                sync_s = float(self._sync_s[self._index])
            else:
                return None
            before_s = () if self._sync_s is None else tuple(self._sync_s[max(0, self._index - 8) : self._index][::-1])
            return Window(self._index, sync_s, sync_s, sync_s + self._reach_s, before_s=before_s)
        if self._first_s is None:
            return Window(self._index, self._seek_s, self._seek_s, self._seek_s + self._period_s, seeking=True)
        opens_s, closes_s = self._first_s - self._reach_s, self._first_s + self._reach_s
        sync_s = self._base_s + self._index * self._period_s if self._regular else opens_s
        return Window(self._index, sync_s, opens_s, closes_s)

    def found(self, starts_s: Floats) -> None:
        """Tell when the bursts of the seeking window were heard to begin: they cluster, modulo the period.

        Those of one epoch lie within the longest flight of each other; the first of the most that do begins it.
        """
        if not len(starts_s):
            self._seek_s += self._period_s
            return
        order = np.sort(starts_s)
        behind = (order[None, :] - order[:, None]) % self._period_s
        followers = np.count_nonzero(behind <= self._reach_s, axis=1)
        # of as many, the one after the longest silence
        silence = np.diff(order, prepend=order[-1] - self._period_s)
        first_s = float(order[np.lexsort((silence, followers))[-1]])
        if self._seek_s == 0.0:
            # the window may have opened amid the bursts of an epoch: begin with the first that is whole
            first_s = float((first_s - START_GUARD_S) % self._period_s + START_GUARD_S)
        self._first_s = first_s
        self._base_s = self._first_s - self._reach_s - self._index * self._period_s

    def done(self, starts_s: Floats) -> None:
        """Tell when the bursts of the last window were heard to begin, and go on to the next."""
        self._index += 1
        if self._first_s is None:
            return
        if len(starts_s):
            self._found = True
            self._first_s = float(np.min(starts_s))
        elif not self._found:
            # what the seeking window held was none of the bursts
            self._first_s, self._seek_s = None, self._first_s + self._reach_s
            return
        self._first_s += self._period_s


def screen(samples: NDArray[np.float32], rate_hz: float) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Samples fit to be filtered, and what was wrong with them: not finite (set to 0), clipped, missing or silent."""
    flags = []
    finite = np.isfinite(samples)
    if not finite.all():
        flags.append(f"{np.sum(~finite)} of {samples.size} samples are not finite; taken as silence")
        samples = np.where(finite, samples, np.float32(0))
    size = np.abs(samples)
    loudest = float(np.max(size, initial=0.0))
    # a recorder may clip below full scale: then its loudest value comes several times in a row
    top = size >= CLIPPED * loudest
    clipped = float(np.mean(top[1:] & top[:-1])) if loudest > LOUD else 0.0
    if clipped > 2e-4:
        flags.append(f"{100 * clipped:.2f} % of samples are clipped; lower the gain")
    if loudest == 0.0:
        flags.append("no sound at all: every sample is 0")
    else:
        missing = missing_runs(samples, rate_hz)
        if len(missing):
            lost_ms = 1e3 * float(np.sum(np.diff(missing, axis=1))) / rate_hz
            flags.append(f"{len(missing)} drop-outs, {lost_ms:.0f} ms in all, in which every sample is 0")
    return samples, tuple(flags)


def missing_runs(samples: NDArray[np.float32], rate_hz: float) -> NDArray[np.int64]:
    """Runs (k, 2), first and past-the-last sample, that stay exactly 0 for too long to be sound, amid samples."""
    edges = runs(samples == 0.0)
    amid = (edges[:, 0] > 0) & (edges[:, 1] < samples.size)
    return edges[amid & (np.diff(edges, axis=1)[:, 0] > DROP_OUT_S * rate_hz)]
