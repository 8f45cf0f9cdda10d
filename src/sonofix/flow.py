"""The whole street on one screen: samples or stated ranges in, a `Step` an epoch out.

File, live and simulation run this.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from itertools import chain

from sonofix.acquire.explain import Hearing, insight
from sonofix.locate.told import told_fixes
from sonofix.peer_receiver import PeerReceiver
from sonofix.ranging import stated_epochs
from sonofix.receiver import Receiver
from sonofix.records import Event, Fix, Insight, RangeEpoch, Recording, Step
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site
from sonofix.street import Street
from sonofix.track.follow import Follower
from sonofix.track.smooth import FixedLag, smooth
from sonofix.two_way import exchange_epochs, replied


def run(recording: Recording, rate_hz: float | None = None, held: Collection[str] = ()) -> Iterator[Step]:
    """Run a recording through the whole street.

    Parameters
    ----------
    recording : Recording
    rate_hz : float or None
        Estimates at this rate; None: one an epoch.
    held : collection of str
        What shall not calibrate itself, of `track.held.CALIBRATIONS`.

    Yields
    ------
    Step, one an epoch, in time order

    Raises
    ------
    ValueError
        If the recording holds neither samples, ranges, exchanges nor positions, or cannot be sampled at the site's
        carrier, or ``held`` names what nothing calibrates.
    """
    if recording.blocks is not None and recording.rate_hz is not None:
        yield from _heard(recording, rate_hz, held)
        return
    heard: Iterable[tuple[RangeEpoch, tuple[Fix, ...] | None]]
    if recording.ranges is not None:
        heard = ((epoch, None) for epoch in stated_epochs(recording.ranges, recording.site))
    elif "exchanges" in recording.tables:
        heard = ((epoch, None) for epoch in exchange_epochs(recording.tables["exchanges"], recording.site))
    elif "positions" in recording.tables:
        heard = told_fixes(recording.tables["positions"], recording.site)
    else:
        raise ValueError(
            "the recording holds neither samples (capture.flac, capture.wav) nor ranges.csv, exchanges.csv or "
            "positions.csv"
        )
    street = Street(_site_of(recording), recording.tables.get("start"), rate_hz)
    street.sense(recording.tables, _stated_pairs(recording), held)
    for epoch, fixes in heard:
        yield street.walk(epoch, fixes=fixes)


def smoothed(
    recording: Recording,
    steps: Iterable[Step],
    rate_hz: float | None = None,
    lag_s: float | None = None,
    graph: bool = False,
    on_epoch: Callable[[], None] = lambda: None,
    held: Collection[str] = (),
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
    held : collection of str
        As `run` was told.

    Yields
    ------
    Step, as they came, with estimates of source "smoothed"

    Raises
    ------
    ModuleNotFoundError
        If ``graph`` is asked for and gtsam is not installed.
    ValueError
        If ``lag_s`` is below 0, or a lag is asked of a graph, or a graph of positions.
    """
    if lag_s is not None:
        if lag_s < 0:
            raise ValueError(f"lag: {lag_s:g} s; a smoother looks ahead by 0 s or more")
        if graph:
            raise ValueError("a graph smooths between a recording's ends; leave out either the graph or the lag")
        yield from _lagging(recording, steps, rate_hz, lag_s, held)
        return
    if graph and recording.by_positions:
        raise ValueError("a graph is made of ranges; positions.csv is smoothed without it (--smooth)")
    kept = list(steps)
    if not kept:
        return
    how = smooth
    if graph:
        from sonofix.track.graph import smooth as how
    tracks = how(
        lambda: _beginning(recording, kept[0].ranges.sync_s, held),
        [(step.ranges, step.fixes) for step in kept],
        rate_hz,
        on_epoch=on_epoch,
    )
    for step, estimates in zip(kept, tracks, strict=True):
        yield replace(step, estimates=estimates)


def _lagging(
    recording: Recording, steps: Iterable[Step], rate_hz: float | None, lag_s: float, held: Collection[str]
) -> Iterator[Step]:
    """Smooth steps while they come."""
    waiting: deque[Step] = deque()
    lag: FixedLag | None = None
    for step in steps:
        lag = lag or FixedLag(_beginning(recording, step.ranges.sync_s, held), lag_s, rate_hz)
        waiting.append(step)
        for estimates in lag.take((step.ranges, step.fixes)):
            yield replace(waiting.popleft(), estimates=estimates)
    for estimates in lag.finish() if lag is not None else ():
        yield replace(waiting.popleft(), estimates=estimates)


def _beginning(recording: Recording, time_s: float, held: Collection[str]) -> Follower:
    """Return a follower of a recording as `run` begins with one at the first epoch."""
    street = Street(_site_of(recording), recording.tables.get("start"))
    street.sense(recording.tables, _stated_pairs(recording), held)
    street.begin(time_s)
    return street.follower


def _site_of(recording: Recording) -> Site:
    """Return a recording's site; where positions are of vehicles' origins, nothing rides on these."""
    site = recording.site
    if not recording.by_positions:
        return site
    fixed = tuple(beacon for beacon in site.beacons if beacon.vehicle is None)
    return site.model_copy(update={"beacons": fixed, "microphones": ()})


def _stated_pairs(recording: Recording) -> tuple[tuple[str, str], ...] | None:
    """Pairs (emitter, receiver) whose ranges others measured, with errors that they do not state; None: none are."""
    heard = recording.blocks is not None and recording.rate_hz is not None
    if heard:
        return None
    if recording.ranges is not None:
        return recording.ranges.pairs
    if "exchanges" not in recording.tables:
        return None
    table = recording.tables["exchanges"]
    if "heard_sd_s" in table.columns and "reply_heard_sd_s" in table.columns:
        return None  # times of a receiver that knows how well it hears, as ours does
    ends = dict.fromkeys(zip(table.names["from"], table.names["to"], strict=True))
    there = [replied(recording.site, *pair) for pair in ends]
    return tuple(pair for b, m, reply, ear in there for pair in ((b.id, m.id), (reply.id, ear.id)))


def _heard(recording: Recording, rate_hz: float | None, held: Collection[str]) -> Iterator[Step]:
    """Feed a receiver block by block; tell with the last step if the capture ended before its header says."""
    site, sample_rate_hz, blocks = recording.site, recording.rate_hz, recording.blocks
    assert sample_rate_hz is not None
    assert blocks is not None
    waveforms, start = waveforms_of(site, recording.references), recording.tables.get("start")
    if site.own_clocks:
        receiver = PeerReceiver(site, sample_rate_hz, waveforms, start, rate_hz)
    else:
        receiver = Receiver(site, sample_rate_hz, waveforms, recording.sync_s, start, rate_hz)
    receiver.sense(recording.tables, held)
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
