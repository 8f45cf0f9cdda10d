"""From samples as they come to a `Step` an epoch: what lives on between epochs, on one clock for all channels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.epochs import Schedule, Window, reach_s, screen
from sonofix.acquire.explain import Hearing
from sonofix.acquire.plan import acquire, make_plan
from sonofix.acquire.roll import Roll
from sonofix.acquire.stream import Stream
from sonofix.locate.whose import tell_whose
from sonofix.ranging import pair_biases, range_epoch
from sonofix.records import (
    Acquisition,
    Detection,
    Event,
    Floats,
    Prediction,
    RangeEpoch,
    Step,
    Table,
    Waveform,
)
from sonofix.site import Site
from sonofix.street import Street
from sonofix.track.belief import Belief, Motion, predict
from sonofix.track.follow import expectations

DEFAULT_MAX_SPEED_MPS = 3.0
"""Of a vehicle whose site file states none."""


class Receiver:
    """Follows a stream of samples: feed it blocks, it yields a Step for each epoch that they complete.

    Parameters
    ----------
    site : Site
    sample_rate_hz : float
    waveforms : mapping from beacon id to Waveform
    sync_s : float64 (epochs,) or None
        When sync commands arrived; None: every period from sample 0 on.
    start : Table or None
        Known start poses.
    rate_hz : float or None
        Estimates at this rate; None: one an epoch.
    on_hearing : callable or None
        Is told what each microphone's epoch was searched for, once it was.

    Raises
    ------
    ValueError
        If the site has no schedule, no coded beacon or no microphone with a channel, or samples come too slowly.
    """

    def __init__(
        self,
        site: Site,
        sample_rate_hz: float,
        waveforms: Mapping[str, Waveform],
        sync_s: Floats | None = None,
        start: Table | None = None,
        rate_hz: float | None = None,
        on_hearing: Callable[[Hearing], None] | None = None,
    ) -> None:
        if site.schedule is None or site.schedule.period_s is None:
            raise ValueError("reading samples needs [schedule] period_s: state how often the beacons burst")
        if site.own_clocks:
            raise ValueError("vehicles on clocks of their own ([schedule] own_clocks) are heard by `sonofix run` alone")
        self.site = site
        self.waveforms = waveforms
        self.sound_speed_mps = site.sound_speed_mps
        self.sound_speed_sd_mps = site.sound_speed_sd_mps
        self._on_hearing = on_hearing
        self._microphones = [m for m in site.microphones if m.channel is not None]
        if not self._microphones:
            raise ValueError("no [[microphone]] names a channel of the capture: add channel = 0, 1, …")
        speeds = [v.max_speed_mps or DEFAULT_MAX_SPEED_MPS for v in site.vehicles] or [0.0]
        sounding = any(b.vehicle for b in site.coded_beacons) and any(m.vehicle for m in self._microphones)
        reach = reach_s(site, self.sound_speed_mps)
        self._roll = Roll(site, waveforms, self.sound_speed_mps)
        self._plan = make_plan(
            self._roll.named(), sample_rate_hz, self.sound_speed_mps, max(speeds) * (2.0 if sounding else 1.0)
        )
        known, regular = site.schedule.synchronised, not site.free_running
        self._schedule = Schedule(site.schedule.period_s, reach, sync_s, known, regular)
        self._street = Street(site, start, rate_hz)
        self._offsets_s = {b.id: b.offset_s + b.delay_s for b in site.coded_beacons}
        lags = [m.delay_s for m in self._microphones]
        self._earliest_s = min(self._offsets_s.values()) + min(lags)
        self._latest_s = max(self._offsets_s.values()) + max(lags)
        if self._roll.short:
            # bursts that began before an epoch sound on within it, and those after it begin in it
            self._earliest_s -= self._plan.burst_s
            self._latest_s += self._plan.burst_s
        self._stream = Stream(sample_rate_hz, self._plan.margin_s - min(0.0, self._earliest_s))
        self._heard_last = 0
        self._agility_mps2 = 1.0

    def sense(self, tables: Mapping[str, Table], held: Collection[str] = ()) -> None:
        """Take in what vehicles' own sensors told, as `Street.sense` does."""
        self._street.sense(tables, held=held)

    def heard_as(self, emitter: str) -> str:
        """Beacon that an emitter is listened for as where nothing is predicted: the first of its code."""
        return self._roll.head(emitter)

    def feed(self, block: NDArray[np.float32]) -> Iterator[Step]:
        """Take in samples (n, channels), full scale ±1, and yield what they complete."""
        self._stream.add(block)
        self._forget()
        yield from self._listen(complete=True)

    def finish(self) -> Iterator[Step]:
        """Yield what the last samples still hold."""
        yield from self._listen(complete=False)

    def _listen(self, complete: bool) -> Iterator[Step]:
        while (window := self._schedule.window()) is not None:
            end_s = self._stream.end_s
            wanted_s = window.closes_s + self._latest_s + self._plan.burst_s + self._plan.margin_s
            if complete and wanted_s > end_s:
                break
            shortest_s = min(w.duration_s for w in self.waveforms.values())
            if not complete and window.opens_s + min(self._offsets_s.values()) + shortest_s > end_s:
                break
            heard, flags, untold = self._hear(window, *self._stream.between(self._needed_s(window), wanted_s))
            starts_s = np.array(
                [
                    d.arrival_s
                    - self.waveforms[d.emitter].duration_s / 2
                    - self._offsets_s[d.emitter]
                    - self.site.microphone(d.receiver).delay_s
                    for d in heard
                ]
            )
            if window.seeking:
                self._schedule.found(starts_s)
                if not heard:
                    yield self._step(window, heard, flags, untold)
            else:
                yield self._step(window, heard, flags, untold)
                self._schedule.done(starts_s)
            self._forget()

    def _needed_s(self, window: Window) -> float:
        """From when on samples tell of an epoch."""
        return window.opens_s + self._earliest_s - self._plan.margin_s

    def _forget(self) -> None:
        """Let go of samples that no later epoch needs."""
        following = self._schedule.window()
        self._stream.forget(np.inf if following is None else self._needed_s(following))

    def _hear(
        self, window: Window, samples: NDArray[np.float32], first: int
    ) -> tuple[tuple[Detection, ...], tuple[str, ...], dict[str, tuple[Detection, ...]]]:
        """Acquire every microphone's bursts: warm where a track says what to expect, cold where that fails.

        Says too which were searched cold, so that whose bursts those are is to be told, and what had come as expected.
        """
        flags: list[str] = []
        untold: dict[str, tuple[Detection, ...]] = {}
        heard: list[Detection] = []
        for microphone in self._microphones:
            channel, odd = screen(samples[:, microphone.channel], self._plan.sample_rate_hz)
            flags += [f"microphone {microphone.id}: {text}" for text in odd]
            emitters = self._roll.listens(microphone.vehicle)
            expected = {} if window.seeking else self._expect(window, microphone.id, emitters)
            call = self._roll.call(window, microphone.delay_s, emitters, expected)
            sure = not self._roll.ambiguous  # else what comes as none expects may be any of several
            found, notes = acquire(self._plan, channel, first, microphone.id, call.windows, call.predictions, sure)
            own = tuple(self._roll.heard(found, call))
            expectedly = own
            repeated = bool(expected) and len(own) < 0.7 * self._heard_last / len(self._microphones)
            if repeated:
                call = self._roll.call(window, microphone.delay_s, emitters, {})
                found, notes = acquire(self._plan, channel, first, microphone.id, call.windows)
                own = tuple(self._roll.heard(found, call))
            if self._on_hearing is not None:
                why = "the warm search heard too little" if repeated else "no track says where to look"
                given = (microphone.id, channel, first, call.windows, call.predictions)
                sent_s = self._roll.sent_s(window, microphone.delay_s, call)
                late_s = self._late_s(microphone.id, list(sent_s))
                sent_s = {name: at_s + late_s[name] for name, at_s in sent_s.items()}
                self._on_hearing(Hearing(self._plan, *given, sent_s, odd, "" if call.predictions else why))
            if not call.predictions and self._roll.ambiguous:
                untold[microphone.id] = expectedly if repeated else ()
            heard += own
            flags += [f"microphone {microphone.id}: {text}" for text in notes]
        self._heard_last = len(heard)
        return tuple(heard), tuple(flags), untold

    def _step(
        self,
        window: Window,
        heard: tuple[Detection, ...],
        flags: tuple[str, ...],
        untold: Mapping[str, tuple[Detection, ...]],
    ) -> Step:
        ranges = self._ranges(window, heard, flags)
        events = tuple(Event(window.sync_s, "", "samples", text) for text in flags)
        if untold and len(ranges):

            def alternatives(emitter: str, receiver: str) -> list[tuple[str, float]]:
                if receiver not in untold:
                    return [(emitter, 0.0)]
                whose = self._roll.whose(emitter, window)
                late_s = self._late_s(receiver, [emitter, *(other for other, _ in whose)])
                return [(other, more + late_s[emitter] - late_s[other]) for other, more in whose]

            ranges, told = tell_whose(ranges, self.site, alternatives)
            events += (Event(window.sync_s, "", "whose", told),) if told else ()
            if not len(ranges):
                # then what came as expected is all there is to go by
                left = [d for d in heard if d.receiver not in untold]
                ranges = self._ranges(window, (*left, *chain.from_iterable(untold.values())), flags)
        before = self._street.follower.belief
        step = self._street.walk(ranges, events)
        self._watch(before, self._street.follower.belief)
        return step

    def _ranges(self, window: Window, heard: tuple[Detection, ...], flags: tuple[str, ...]) -> RangeEpoch:
        acquired = Acquisition(window.index, window.sync_s, heard, flags)
        return range_epoch(self.site, self.waveforms, acquired, self.sound_speed_mps, self.sound_speed_sd_mps)

    def _late_s(self, receiver: str, emitters: list[str]) -> dict[str, float]:
        """By how much later than its way asks for each emitter's burst is heard, as the site states pairs' biases."""
        bias_m, _ = pair_biases(self.site, emitters, (receiver,) * len(emitters))
        return dict(zip(emitters, (bias_m / self.sound_speed_mps).tolist(), strict=True))

    def _watch(self, before: Belief, after: Belief) -> None:
        """Learn how briskly vehicles change speed: what the next warm search must allow for."""
        dt = after.time_s - before.time_s
        if dt > 0 and before.placed.any():
            change = float(np.max(np.abs(after.pose()[:, 4:7] - before.pose()[:, 4:7]))) / dt
            self._agility_mps2 = max(change, 0.7 * self._agility_mps2)

    def _expect(self, window: Window, receiver: str, emitters: list[str]) -> dict[str, Prediction]:
        """Say where bursts should be, from the track; nothing where no vehicle of the pair has a position."""
        belief = self._street.follower.belief
        if not belief.placed.all() or not self._heard_last or not emitters:
            return {}
        microphone = self.site.microphone(receiver)
        middle_s = {e: self._offsets_s[e] + self.waveforms[e].duration_s / 2 for e in emitters}
        aged = predict(belief, window.sync_s + float(np.mean(list(middle_s.values()))) + 0.03, self._motion(window))
        c = self._street.air.sound_speed_mps or self.sound_speed_mps
        range_m, range_sd, rate, rate_sd = expectations(aged, self.site, [(e, receiver) for e in emitters], c)
        bias_m, bias_sd_m = pair_biases(self.site, emitters, (receiver,) * len(emitters))
        range_m, range_sd = range_m + bias_m, np.hypot(range_sd, bias_sd_m)
        common = not self.site.clock_known
        offset_m = float(belief.mean[-2]) if common else 0.0
        # a free-running source keeps no time from burst to burst, only its speed carries over
        loose_s = 1.0 if self._street.follower.free_running else (1e-3 if common else 2e-4)
        return {
            e: Prediction(
                emitter=e,
                receiver=receiver,
                arrival_s=window.sync_s + middle_s[e] + microphone.delay_s + (range_m[i] + offset_m) / c,
                arrival_sd_s=float(np.hypot(range_sd[i] / c, loose_s)),
                range_rate_mps=float(rate[i]),
                range_rate_sd_mps=float(np.hypot(rate_sd[i], 0.05)),
            )
            for i, e in enumerate(emitters)
        }

    def _motion(self, window: Window) -> Motion:
        dt = max(window.sync_s - self._street.follower.belief.time_s, 0.1)
        return replace(self._street.follower.motion, acceleration_psd=max(0.01, self._agility_mps2**2 * dt))
