"""From samples as they come to a `Step` an epoch, where each robot keeps its own time and ranging is two-way."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.peers import Peers
from sonofix.acquire.plan import make_plan
from sonofix.acquire.stream import Stream
from sonofix.ranging import range_epoch
from sonofix.receiver import DEFAULT_MAX_SPEED_MPS
from sonofix.records import Acquisition, Event, Step, Table, Waveform
from sonofix.site import Site
from sonofix.street import Street
from sonofix.two_way import TwoWay


class PeerReceiver:
    """Follows robots on clocks of their own ([schedule] own_clocks) as `Receiver` follows those on one.

    Parameters
    ----------
    site : Site
    sample_rate_hz : float
        That every channel's clock claims.
    waveforms : mapping from beacon id to Waveform
    start : Table or None
        Known start poses.
    rate_hz : float or None
        Estimates at this rate; None: one an epoch.

    Raises
    ------
    ValueError
        If the site has no schedule.
    """

    def __init__(
        self,
        site: Site,
        sample_rate_hz: float,
        waveforms: Mapping[str, Waveform],
        start: Table | None = None,
        rate_hz: float | None = None,
    ) -> None:
        if site.schedule is None or site.schedule.period_s is None:
            raise ValueError("reading samples needs [schedule] period_s: state how often the beacons burst")
        most_mps = 2.0 * max(v.max_speed_mps or DEFAULT_MAX_SPEED_MPS for v in site.vehicles)
        plan = make_plan(waveforms, sample_rate_hz, site.sound_speed_mps, most_mps)
        self.site, self.waveforms = site, waveforms
        self._peers, self._ways = Peers(site, waveforms, plan, most_mps), TwoWay(site)
        self._street = Street(site, start, rate_hz)
        self._stream = Stream(sample_rate_hz)
        self._period_s, self._opens_s = site.schedule.period_s, min(b.offset_s for b in site.coded_beacons)
        self._epoch = 0

    def sense(self, tables: Mapping[str, Table], held: Collection[str] = ()) -> None:
        """Take in what robots' own sensors told, as `Street.sense` does."""
        self._street.sense(tables, held=held)

    def feed(self, block: NDArray[np.float32]) -> Iterator[Step]:
        """Take in samples (n, channels), full scale ±1, and yield what they complete."""
        self._stream.add(block)
        while self._stream.end_s >= self._peers.ends_s(self._epoch):
            yield self._step()

    def finish(self) -> Iterator[Step]:
        """Yield what the last samples still hold."""
        while self._epoch * self._period_s + self._opens_s <= self._stream.end_s:
            yield self._step()

    def _step(self) -> Step:
        epoch = self._epoch
        heard, flags = self._peers.hear(epoch, self._stream.samples, self._stream.first)
        exchanges = self._peers.exchanges(epoch, heard)
        told = self._ways.epoch(epoch, [self._ways.take(exchange) for exchange in exchanges], flags)
        if told is None:
            silent = Acquisition(epoch, epoch * self._period_s, (), flags)
            told = range_epoch(self.site, self.waveforms, silent, self.site.sound_speed_mps)
        events = tuple(Event(told.sync_s, "", "samples", text) for text in flags)
        self._epoch += 1
        self._stream.forget(self._peers.begins_s(self._epoch))
        return replace(self._street.walk(told, events), exchanges=tuple(exchanges))
