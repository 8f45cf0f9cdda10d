"""Robots that each keep their own time: when to listen for each other's bursts, and what makes an exchange.

Every channel runs on its robot's clock, and every robot sounds by its own: burst k leaves at k periods and its offset.
All begin within half a period of each other, so that burst k of another is heard within half a period of when one's
own clock has it leave. Once heard, it is expected a period later, give or take clocks and motion.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.epochs import screen
from sonofix.acquire.plan import Plan, acquire
from sonofix.acquire.tones import MARGIN_S
from sonofix.records import Detection, Exchange, Waveform
from sonofix.site import Beacon, Microphone, Site

CLOCKS = 2e-4
"""How much two clocks' speeds may differ."""

SLACK_S = 2e-3
"""Wider than what clocks and motion ask for."""

LEAST_S = 10 * MARGIN_S
"""Length below which a stretch is widened: tones are told from bursts by outlasting them."""

FORGOTTEN = 8
"""Epochs of silence after which a burst is looked for all over again."""


@dataclass(frozen=True, slots=True)
class _Heard:
    """The last burst heard of an emitter: epoch, and when it began on the hearer's clock."""

    epoch: int
    begins_s: float


class Peers:
    """Listens for the bursts of robots on clocks of their own, epoch by epoch.

    Parameters
    ----------
    site : Site
        With `schedule.own_clocks`.
    waveforms : mapping from beacon id to Waveform
    plan : Plan
    max_rate_mps : float
        Of range between two robots.
    """

    def __init__(self, site: Site, waveforms: Mapping[str, Waveform], plan: Plan, max_rate_mps: float) -> None:
        assert site.schedule is not None
        assert site.schedule.period_s is not None
        self._period_s = site.schedule.period_s
        self._waveforms, self._plan = waveforms, plan
        self._speed_mps, self._max_rate_mps = site.sound_speed_mps, max_rate_mps
        self._beacons = {b.id: b for b in site.coded_beacons}
        self.microphones = [m for m in site.microphones if m.channel is not None]
        self._last: dict[tuple[str, str], _Heard] = {}

    def ends_s(self, epoch: int) -> float:
        """When all of an epoch's samples are there, on every clock."""
        return max((span[1] for span in self._spans_s(epoch)), default=0.0)

    def begins_s(self, epoch: int) -> float:
        """When the first of an epoch's samples is due, on any clock."""
        return min((span[0] for span in self._spans_s(epoch)), default=0.0)

    def hear(
        self, epoch: int, samples: NDArray[np.float32], first: int
    ) -> tuple[dict[tuple[str, str], Detection], tuple[str, ...]]:
        """Acquire all channels' bursts of one epoch.

        Parameters
        ----------
        samples : float32 (n, channels)
            Row 0 is sample ``first`` on every channel's own clock.

        Returns
        -------
        heard : dict from (beacon, microphone) to Detection
            Times on the microphone's clock.
        flags : tuple of str
        """
        rate, flags = self._plan.sample_rate_hz, []
        heard: dict[tuple[str, str], Detection] = {}
        for microphone in self.microphones:
            windows = {e: self._window(epoch, microphone, e) for e in self._emitters(microphone)}
            if not windows:
                continue
            opens_s, closes_s = self._span_s(windows.values())
            begin = max(0, round(opens_s * rate) - first)
            own = samples[begin : max(begin, round(closes_s * rate) - first), microphone.channel]
            if not own.size:
                continue
            channel, odd = screen(own, rate)
            found, notes = acquire(self._plan, channel, first + begin, microphone.id, windows)
            flags += [f"microphone {microphone.id}: {text}" for text in (*odd, *notes)]
            for d in found:
                heard[d.emitter, microphone.id] = d
                begins_s = d.arrival_s - self._waveforms[d.emitter].duration_s / 2
                self._last[d.emitter, microphone.id] = _Heard(epoch, begins_s)
        return heard, tuple(flags)

    def exchanges(self, epoch: int, heard: Mapping[tuple[str, str], Detection]) -> list[Exchange]:
        """Pairs of robots that heard each other in an epoch: who sounds earlier by the schedule comes first."""
        order = sorted(self._beacons.values(), key=lambda b: b.offset_s)
        out = []
        for a, b in combinations(order, 2):
            there = self._ear(heard, a, b)
            back = self._ear(heard, b, a)
            if a.vehicle == b.vehicle or there is None or back is None:
                continue
            (ear, first), (other, second) = there, back
            out.append(
                Exchange(
                    emitter=a.id,
                    receiver=ear.id,
                    sent_s=self._sent_s(epoch, a),
                    heard_s=first.arrival_s - ear.delay_s,
                    reply_sent_s=self._sent_s(epoch, b),
                    reply_heard_s=second.arrival_s - other.delay_s,
                    heard_sd_s=float(np.sqrt(first.covariance[0, 0])),
                    reply_heard_sd_s=float(np.sqrt(second.covariance[0, 0])),
                    time_scales=(
                        (first.time_scale, float(np.sqrt(first.covariance[1, 1]))),
                        (second.time_scale, float(np.sqrt(second.covariance[1, 1]))),
                    ),
                    snr_db=(first.snr_db, second.snr_db),
                )
            )
        return out

    def _ear(
        self, heard: Mapping[tuple[str, str], Detection], emitter: Beacon, on: Beacon
    ) -> tuple[Microphone, Detection] | None:
        """Microphone on a beacon's vehicle that is paired with it, and what it heard of another beacon."""
        ears = [m for m in self.microphones if m.vehicle == on.vehicle]
        ear = next((m for m in ears if m.id == on.id), ears[0] if ears else None)
        found = None if ear is None else heard.get((emitter.id, ear.id))
        return None if ear is None or found is None else (ear, found)

    def _spans_s(self, epoch: int) -> list[tuple[float, float]]:
        windows = [[self._window(epoch, m, e) for e in self._emitters(m)] for m in self.microphones]
        return [self._span_s(own) for own in windows if own]

    def _span_s(self, windows: Collection[tuple[float, float]]) -> tuple[float, float]:
        """Samples wanted of a channel: all bursts that begin within windows, margins, and enough to know a tone by."""
        opens = min(w[0] for w in windows) - self._plan.margin_s
        closes = max(w[1] for w in windows) + self._plan.burst_s + self._plan.margin_s
        wider = max(0.0, LEAST_S - (closes - opens)) / 2
        return opens - wider, closes + wider

    def _emitters(self, microphone: Microphone) -> list[str]:
        return [b.id for b in self._beacons.values() if b.vehicle != microphone.vehicle]

    def _sent_s(self, epoch: int, beacon: Beacon) -> float:
        """When the middle of a burst leaves, on its own robot's clock."""
        return self._begins_s(epoch, beacon) + self._waveforms[beacon.id].duration_s / 2

    def _begins_s(self, epoch: int, beacon: Beacon) -> float:
        return epoch * self._period_s + beacon.offset_s + beacon.delay_s

    def _window(self, epoch: int, microphone: Microphone, emitter: str) -> tuple[float, float]:
        """When a burst may begin to be heard, on the microphone's clock."""
        last = self._last.get((emitter, microphone.id))
        if last is None or epoch - last.epoch > FORGOTTEN:
            middle_s = self._begins_s(epoch, self._beacons[emitter]) + microphone.delay_s
            return middle_s - self._period_s / 2, middle_s + self._period_s / 2
        since_s = (epoch - last.epoch) * self._period_s
        reach_s = since_s * (CLOCKS + self._max_rate_mps / self._speed_mps) + SLACK_S
        return last.begins_s + since_s - reach_s, last.begins_s + since_s + reach_s
