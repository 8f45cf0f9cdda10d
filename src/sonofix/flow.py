"""The whole street on one screen: samples or stated ranges in, a `Step` an epoch out.

File, live and simulation run this.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.epochs import Schedule, Window, reach_s, screen
from sonofix.acquire.explain import Hearing, insight
from sonofix.acquire.peers import Peers
from sonofix.acquire.plan import acquire, make_plan
from sonofix.acquire.roll import Roll
from sonofix.locate.fix import fix
from sonofix.locate.sound_speed import SoundSpeed
from sonofix.locate.unstated import fix_by_residuals
from sonofix.locate.whose import tell_whose
from sonofix.ranging import pair_biases, range_epoch, stated_epochs
from sonofix.records import (
    Acquisition,
    Detection,
    Estimate,
    Event,
    Fix,
    Floats,
    Insight,
    Prediction,
    RangeEpoch,
    Recording,
    Step,
    Table,
    Waveform,
)
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site
from sonofix.track.belief import Belief, Motion, estimate, predict
from sonofix.track.follow import Follower, expectations
from sonofix.track.inputs import gather
from sonofix.track.smooth import FixedLag, smooth
from sonofix.two_way import TwoWay, exchange_epochs, replied

DEFAULT_MAX_SPEED_MPS = 3.0
"""Of a vehicle whose site file states none."""


def run(recording: Recording, rate_hz: float | None = None) -> Iterator[Step]:
    """Run a recording through the whole street.

    Parameters
    ----------
    recording : Recording
    rate_hz : float or None
        Estimates at this rate; None: one an epoch.

    Yields
    ------
    Step, one an epoch, in time order

    Raises
    ------
    ValueError
        If the recording holds neither samples, ranges nor exchanges, or cannot be sampled at the site's carrier.
    """
    if recording.blocks is not None and recording.rate_hz is not None:
        heard = _run_own_clocks if recording.site.own_clocks else _run_samples
        yield from heard(recording, recording.rate_hz, recording.blocks, rate_hz)
        return
    if recording.ranges is not None:
        epochs = iter(stated_epochs(recording.ranges, recording.site))
    elif "exchanges" in recording.tables:
        epochs = exchange_epochs(recording.tables["exchanges"], recording.site)
    else:
        raise ValueError(
            "the recording holds neither samples (capture.flac, capture.wav) nor ranges.csv nor exchanges.csv"
        )
    street = Street(recording.site, recording.tables.get("start"), rate_hz)
    street.sense(recording.tables, _stated_pairs(recording))
    for epoch in epochs:
        yield street.walk(epoch)


def smoothed(
    recording: Recording,
    steps: Iterable[Step],
    rate_hz: float | None = None,
    lag_s: float | None = None,
    graph: bool = False,
    on_epoch: Callable[[], None] = lambda: None,
) -> Iterator[Step]:
    """Smooth the track of a recording that was run: each instant with what was heard before it and after.

    Parameters
    ----------
    recording : Recording
    steps : iterable of Step
        As `run` yields them, all of them and in order.
    rate_hz : float or None
        Estimates at this rate; None: one an epoch.
    lag_s : float or None
        Look no further ahead: each step leaves once others so much later have come. None: between the recording's
        ends, and linearised anew until the track stays where it is.
    graph : bool
        By a factor graph (gtsam).
    on_epoch : callable
        Is called for each epoch of each pass.

    Yields
    ------
    Step, as they came, with estimates of source "smoothed"

    Raises
    ------
    ModuleNotFoundError
        If ``graph`` is asked for and gtsam is not installed.
    ValueError
        If ``lag_s`` is below 0, or a lag is asked of a graph.
    """
    if lag_s is not None:
        if lag_s < 0:
            raise ValueError(f"lag: {lag_s:g} s; a smoother looks ahead by 0 s or more")
        if graph:
            raise ValueError("a graph smooths between a recording's ends; leave out either the graph or the lag")
        yield from _lagging(recording, steps, rate_hz, lag_s)
        return
    kept = list(steps)
    if not kept:
        return
    how = smooth
    if graph:
        from sonofix.track.graph import smooth as how
    tracks = how(
        lambda: _beginning(recording, kept[0].ranges.sync_s),
        [(step.ranges, step.fixes) for step in kept],
        rate_hz,
        on_epoch=on_epoch,
    )
    for step, estimates in zip(kept, tracks, strict=True):
        yield replace(step, estimates=estimates)


def _lagging(recording: Recording, steps: Iterable[Step], rate_hz: float | None, lag_s: float) -> Iterator[Step]:
    """Smooth steps while they come."""
    waiting: deque[Step] = deque()
    lag: FixedLag | None = None
    for step in steps:
        lag = lag or FixedLag(_beginning(recording, step.ranges.sync_s), lag_s, rate_hz)
        waiting.append(step)
        for estimates in lag.take((step.ranges, step.fixes)):
            yield replace(waiting.popleft(), estimates=estimates)
    for estimates in lag.finish() if lag is not None else ():
        yield replace(waiting.popleft(), estimates=estimates)


def _beginning(recording: Recording, time_s: float) -> Follower:
    """Return a follower of a recording as `run` begins with one at the first epoch."""
    street = Street(recording.site, recording.tables.get("start"))
    street.sense(recording.tables, _stated_pairs(recording))
    street.begin(time_s)
    return street.follower


def _stated_pairs(recording: Recording) -> tuple[tuple[str, str], ...] | None:
    """Pairs (emitter, receiver) whose ranges others measured, with errors that they do not state; None: none are."""
    heard = recording.blocks is not None and recording.rate_hz is not None
    if heard:
        return None
    if recording.ranges is not None:
        return recording.ranges.pairs
    table = recording.tables["exchanges"]
    if "heard_sd_s" in table.columns and "reply_heard_sd_s" in table.columns:
        return None  # times of a receiver that knows how well it hears, as ours does
    ends = dict.fromkeys(zip(table.names["from"], table.names["to"], strict=True))
    there = [replied(recording.site, *pair) for pair in ends]
    return tuple(pair for b, m, reply, ear in there for pair in ((b.id, m.id), (reply.id, ear.id)))


def _run_own_clocks(
    recording: Recording,
    sample_rate_hz: float,
    blocks: Callable[[int], Iterator[NDArray[np.float32]]],
    rate_hz: float | None,
) -> Iterator[Step]:
    """Hear robots that each keep their own time: exchanges an epoch, ranged two-way."""
    site = recording.site
    if site.schedule is None or site.schedule.period_s is None:
        raise ValueError("reading samples needs [schedule] period_s: state how often the beacons burst")
    waveforms = waveforms_of(site, recording.references)
    most_mps = 2.0 * max(v.max_speed_mps or DEFAULT_MAX_SPEED_MPS for v in site.vehicles)
    plan = make_plan(waveforms, sample_rate_hz, site.sound_speed_mps, most_mps)
    peers, ways = Peers(site, waveforms, plan, most_mps), TwoWay(site)
    street = Street(site, recording.tables.get("start"), rate_hz)
    street.sense(recording.tables)
    stream = blocks(int(sample_rate_hz))
    samples, first, epoch, ended = np.zeros((0, 0), np.float32), 0, 0, False
    while True:
        while not ended and (first + len(samples)) / sample_rate_hz < peers.ends_s(epoch):
            block = next(stream, None)
            ended = block is None
            if block is not None:
                samples = np.concatenate([samples, block]) if samples.size else block
        end_s = (first + len(samples)) / sample_rate_hz
        if ended and epoch * site.schedule.period_s + min(b.offset_s for b in site.coded_beacons) > end_s:
            return
        heard, flags = peers.hear(epoch, samples, first)
        exchanges = peers.exchanges(epoch, heard)
        told = ways.epoch(epoch, [ways.take(exchange) for exchange in exchanges], flags)
        if told is None:
            silent = Acquisition(epoch, epoch * site.schedule.period_s, (), flags)
            told = range_epoch(site, waveforms, silent, site.sound_speed_mps)
        events = tuple(Event(told.sync_s, "", "samples", text) for text in flags)
        yield replace(street.walk(told, events), exchanges=tuple(exchanges))
        epoch += 1
        drop = min(len(samples) - 1, round(peers.begins_s(epoch) * sample_rate_hz) - first)
        if drop > 0:
            samples, first = samples[drop:], first + drop


def _run_samples(
    recording: Recording,
    sample_rate_hz: float,
    blocks: Callable[[int], Iterator[NDArray[np.float32]]],
    rate_hz: float | None,
) -> Iterator[Step]:
    """Feed a receiver block by block; tell with the last step if the capture ended before its header says."""
    site = recording.site
    waveforms = waveforms_of(site, recording.references)
    receiver = Receiver(site, sample_rate_hz, waveforms, recording.sync_s, recording.tables.get("start"), rate_hz)
    receiver.sense(recording.tables)
    count, last = 0, None

    def steps() -> Iterator[Step]:
        nonlocal count
        for block in blocks(int(sample_rate_hz)):
            count += len(block)
            yield from receiver.feed(block)
        yield from receiver.finish()

    for step in steps():
        if last is not None:
            yield last
        last = step
    if last is None:
        return
    if recording.sample_count is not None and count < recording.sample_count:
        text = f"the capture ends after {count} samples; its header states {recording.sample_count}"
        last = replace(last, events=(*last.events, Event(count / sample_rate_hz, "", "truncated", text)))
    yield last


def explain(recording: Recording, epoch: int, microphone: str | None = None) -> Insight:
    """Run a recording up to one epoch and tell what the receiver saw in it.

    Parameters
    ----------
    recording : Recording
        With samples.
    epoch : int
        Steps of `run` before it; 0 is the first.
    microphone : str or None
        By id; None: the first with a channel.

    Raises
    ------
    ValueError
        If there are no samples, the run has fewer epochs, or there is no such microphone.
    """
    site = recording.site
    if recording.blocks is None or recording.rate_hz is None:
        raise ValueError("the recording has no samples (capture.flac, capture.wav): there is nothing to look into")
    listening = [m.id for m in site.microphones if m.channel is not None]
    if microphone is not None and microphone not in listening:
        known = ", ".join(listening) or "none"
        raise ValueError(
            f"microphone {microphone}: no microphone of that id has a channel of the capture; of use: {known}"
        )
    if epoch < 0:
        raise ValueError(f"epoch {epoch}: epochs count from 0")
    heard: dict[str, Hearing] = {}
    receiver = Receiver(
        site,
        recording.rate_hz,
        waveforms_of(site, recording.references),
        recording.sync_s,
        recording.tables.get("start"),
        on_hearing=lambda hearing: heard.__setitem__(hearing.receiver, hearing),
    )
    receiver.sense(recording.tables)
    fed = chain.from_iterable(receiver.feed(block) for block in recording.blocks(int(recording.rate_hz)))
    count = 0
    for step in chain(fed, receiver.finish()):
        if count == epoch:
            ranges = step.ranges
            seen = insight(heard[microphone or listening[0]], epoch, ranges.sync_s, ranges.clock)
            own = [i for i, r in enumerate(ranges.receiver) if r == seen.microphone]
            used = {ranges.emitter[i]: bool(step.range_used[i]) for i in own}
            # what nothing predicted was listened for as the first beacon of its code
            used = {receiver.heard_as(name): was for name, was in used.items()} | used
            return replace(seen, used=used, events=step.events)
        count += 1
    there = f"epochs 0 to {count - 1}" if count else "no whole epoch"
    raise ValueError(f"epoch {epoch}: the recording has {there}")


class Street:
    """From ranges to estimates: what file, live and stated ranges share."""

    def __init__(self, site: Site, start: Table | None = None, rate_hz: float | None = None) -> None:
        self.site = site
        self.rate_hz = rate_hz
        self.follower = Follower(site, Motion(), site.free_running, gather(site, {}))
        self.air = SoundSpeed()
        self._start = start
        self._written_s: float | None = None

    def sense(self, tables: Mapping[str, Table], stated: tuple[tuple[str, str], ...] | None = None) -> None:
        """Let what vehicles' own sensors tell of their motion enter, each row at its time; before the first epoch.

        ``stated``: pairs (emitter, receiver) whose ranges come from others, with errors of their own.
        """
        inputs = gather(self.site, tables, stated)
        self.follower = Follower(self.site, self.follower.motion, self.site.free_running, inputs)

    def walk(self, epoch: RangeEpoch, flags: tuple[Event, ...] = ()) -> Step:
        """Take in the ranges of one epoch."""
        self.begin(epoch.sync_s)

        def solve(asked: RangeEpoch) -> tuple[Fix, ...]:
            return tuple(fix(asked, self.site, v.id) for v in self.site.vehicles)

        epoch, fixes, told = self.air.take(epoch, lambda e: fix_by_residuals(e, self.site, solve))
        before, hidden = self.follower.belief, self.follower.hidden
        estimates, used, events = self.follower.step(epoch, fixes)
        believed = used.copy()
        offset = np.full(len(epoch), 0.0 if epoch.clock == "known" else np.nan)
        if epoch.clock == "common" and estimates and estimates[0].clock_offset_m is not None:
            offset[:] = estimates[0].clock_offset_m
        for found in fixes:
            if found.status == "ok":
                asked = np.isfinite(found.residual_m)
                believed[asked] = found.used[asked]
                if found.clock_offset_m is not None:
                    offset[asked] = found.clock_offset_m
        if self.rate_hz is not None:
            estimates = self._between(before, hidden, estimates)
        return Step(epoch, fixes, estimates, flags + told + events, believed & np.isfinite(offset), offset)

    def begin(self, time_s: float) -> None:
        """Put vehicles where start.csv says, once: at the first epoch, or where sensors tell of motion earlier."""
        if self._start is None:
            return
        start, self._start = self._start, None
        inputs = self.follower.belief.inputs
        if inputs is not None and len(inputs.time_s):
            time_s = min(time_s, float(inputs.time_s[0]))
        if not self.site.vehicles:
            raise ValueError("start.csv places a vehicle, but the site has none: add a [[vehicle]]")
        vehicles = start.names.get("vehicle") or (self.site.vehicles[0].id,) * len(start.columns["x_m"])
        for i, vehicle in enumerate(vehicles):
            z = start.columns.get("z_m")
            level = self.site.vehicle(vehicle).z_m
            height = level if level is not None else (0.0 if z is None or np.isnan(z[i]) else float(z[i]))
            position = np.array([start.columns["x_m"][i], start.columns["y_m"][i], height])
            yaw = float(np.nan_to_num(start.columns["yaw_rad"][i])) if "yaw_rad" in start.columns else 0.0
            self.follower.start(vehicle, time_s, position, yaw)

    def _between(self, before: Belief, hidden: frozenset[int], latest: tuple[Estimate, ...]) -> tuple[Estimate, ...]:
        """Return estimates on the grid of the wished rate up to the latest instant, by what was known at each."""
        if self.rate_hz is None:
            return ()
        until_s = self.follower.belief.time_s
        if self._written_s is None:
            if latest:
                self._written_s = np.ceil(until_s * self.rate_hz) / self.rate_hz
            return ()
        out: list[Estimate] = []
        while self._written_s <= until_s:
            if self._written_s >= before.time_s:
                aged = predict(before, self._written_s, self.follower.motion)
                told = [i for i in np.flatnonzero(aged.placed).tolist() if i not in hidden]
                out += [estimate(aged, self.site, i, "predicted") for i in told]
            self._written_s += 1.0 / self.rate_hz
        return tuple(out)


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
        self._samples = np.zeros((0, 0), np.float32)
        self._first = 0  # index of _samples[0] in the stream; below 0 for the silence before it
        self._heard_last = 0
        self._agility_mps2 = 1.0

    def sense(self, tables: Mapping[str, Table]) -> None:
        """Take in what vehicles' own sensors told, as `Street.sense` does."""
        self._street.sense(tables)

    def heard_as(self, emitter: str) -> str:
        """Beacon that an emitter is listened for as where nothing is predicted: the first of its code."""
        return self._roll.head(emitter)

    def feed(self, block: NDArray[np.float32]) -> Iterator[Step]:
        """Take in samples (n, channels), full scale ±1, and yield what they complete."""
        if not self._samples.size:
            lead = int(np.ceil((self._plan.margin_s - min(0.0, self._earliest_s)) * self._plan.sample_rate_hz))
            self._samples, self._first = np.zeros((lead, block.shape[1]), np.float32), -lead
        self._samples = np.concatenate([self._samples, block])
        self._forget()
        yield from self._listen(complete=True)

    def finish(self) -> Iterator[Step]:
        """Yield what the last samples still hold."""
        yield from self._listen(complete=False)

    def _listen(self, complete: bool) -> Iterator[Step]:
        rate = self._plan.sample_rate_hz
        while (window := self._schedule.window()) is not None:
            end_s = (self._first + len(self._samples)) / rate
            wanted_s = window.closes_s + self._latest_s + self._plan.burst_s + self._plan.margin_s
            if complete and wanted_s > end_s:
                break
            shortest_s = min(w.duration_s for w in self.waveforms.values())
            if not complete and window.opens_s + min(self._offsets_s.values()) + shortest_s > end_s:
                break
            begin = max(0, round((window.opens_s + self._earliest_s - self._plan.margin_s) * rate) - self._first)
            end = round(wanted_s * rate) - self._first
            first = self._first + begin
            heard, flags, untold = self._hear(window, self._samples[begin:end], first)
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

    def _forget(self) -> None:
        """Let go of samples that no later epoch needs."""
        following = self._schedule.window()
        drop = len(self._samples) - 1
        if following is not None:
            needed_s = following.opens_s + self._earliest_s - self._plan.margin_s
            drop = min(drop, round(needed_s * self._plan.sample_rate_hz) - self._first)
        if drop > 0:
            self._samples, self._first = self._samples[drop:], self._first + drop

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
