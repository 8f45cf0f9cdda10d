"""Exchanges of two robots, each on its own clock → ranges, each way, and epochs on the first robot's clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from sonofix.pair_clock import PairClock
from sonofix.records import Exchange, Floats, RangeEpoch, Table
from sonofix.site import Beacon, Microphone, Site

MAX_SPEED_MPS = 3.0
"""Of a vehicle whose site file states none."""

SWEEP_S = 1.0
"""Exchanges are gathered into epochs no longer than this."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoRanges:
    """What one exchange gives; A is the robot that the site names first.

    Attributes
    ----------
    robots : (str, str)
        A and B.
    emitter, receiver : (str, str)
        Of the burst from A to B, and of that from B to A.
    heard_s : (float, float)
        When each was heard, on A's clock.
    range_m : float64 (2,)
    covariance_m2 : float64 (2, 2)
    rate_mps, rate_sd_mps : float64 (2,) or None
    snr_db : (float, float) or None
    stated : bool
        Whether deviations of what was heard were stated.
    """

    robots: tuple[str, str]
    emitter: tuple[str, str]
    receiver: tuple[str, str]
    heard_s: tuple[float, float]
    range_m: Floats
    covariance_m2: Floats
    rate_mps: Floats | None
    rate_sd_mps: Floats | None
    snr_db: tuple[float, float] | None
    stated: bool


class TwoWay:
    """Follows the clocks of all pairs of a site's robots, and tells their exchanges as ranges.

    Times are told on the clock of the first robot that the site names.
    """

    def __init__(self, site: Site) -> None:
        self._site = site
        self._order = [vehicle.id for vehicle in site.vehicles]
        self._speed = {vehicle.id: vehicle.max_speed_mps or MAX_SPEED_MPS for vehicle in site.vehicles}
        self._clocks: dict[tuple[str, str], PairClock] = {}

    def take(self, exchange: Exchange) -> TwoRanges:
        """Range one exchange; those of a pair must come in their order.

        Raises
        ------
        ValueError
            If its ends are not on two vehicles that both sound and listen.
        """
        beacon, microphone, reply, ear = replied(self._site, exchange.emitter, exchange.receiver)
        names, sends = (str(beacon.vehicle), str(microphone.vehicle)), (beacon.id, reply.id)
        hears = (microphone.id, ear.id)
        e = exchange
        stamps = (e.sent_s, e.heard_s, e.reply_sent_s, e.reply_heard_s)
        sd = None if e.heard_sd_s is None or e.reply_heard_sd_s is None else (e.heard_sd_s, e.reply_heard_sd_s)
        scales, snr = e.time_scales, e.snr_db
        if self._order.index(names[0]) > self._order.index(names[1]):
            names, sends, hears = names[::-1], sends[::-1], hears[::-1]
            stamps = (*stamps[2:], *stamps[:2])
            sd = None if sd is None else sd[::-1]
            scales = None if scales is None else scales[::-1]
            snr = None if snr is None else (snr[1], snr[0])
        c = self._site.sound_speed_mps
        pair = (names[0], names[1])
        if pair not in self._clocks:
            self._clocks[pair] = PairClock(c, self._speed[pair[0]] + self._speed[pair[1]])
        when, range_m, covariance, drift = self._clocks[pair].take(*stamps, None if sd is None else c * np.array(sd))
        rate = rate_sd = None
        if scales is not None:
            # each burst is as long as its sender's clock makes it, and measured by its hearer's
            rate = c * (1.0 - np.array([scales[0][0], scales[1][0]])) + np.array([-drift[0], drift[0]])
            rate_sd = np.hypot(c * np.array([scales[0][1], scales[1][1]]), drift[1])
        return TwoRanges(
            pair,
            (sends[0], sends[1]),
            (hears[0], hears[1]),
            (float(when[0]), float(when[1])),
            range_m,
            covariance,
            rate,
            rate_sd,
            snr,
            sd is not None,
        )

    def told_s(self, robot: str, time_s: float) -> float | None:
        """Return a time on a robot's clock as the first robot's clock has it; None where nothing joins the two."""
        seen, waiting = {robot}, deque([(robot, time_s)])
        while waiting:
            name, at_s = waiting.popleft()
            if name == self._order[0]:
                return at_s
            for (a, b), clock in self._clocks.items():
                other = b if name == a else a
                if name not in (a, b) or other in seen or not clock.known:
                    continue
                seen.add(other)
                waiting.append((other, at_s + clock.ahead_s(at_s) if name == a else at_s - clock.behind_s(at_s)))
        return None

    def epoch(self, index: int, ranges: Iterable[TwoRanges], flags: tuple[str, ...] = ()) -> RangeEpoch | None:
        """Gather ranges into an epoch, in order of the time they were heard; None where none can be told in time."""
        parts = [(part, [self.told_s(part.robots[0], t) for t in part.heard_s]) for part in ranges]
        kept = [(part, [t for t in told if t is not None]) for part, told in parts if None not in told]
        if not kept:
            return None
        n, c = 2 * len(kept), self._site.sound_speed_mps
        time_s = np.array([t for _, told in kept for t in told])
        covariance = np.zeros((n, n))
        for k, (part, _) in enumerate(kept):
            covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = part.covariance_m2
        range_m = np.concatenate([part.range_m for part, _ in kept])
        speed_sd = self._site.sound_speed_sd_mps
        covariance += (speed_sd / c) ** 2 * np.outer(range_m, range_m)
        order = np.argsort(time_s, kind="stable")

        def joined(name: str) -> Floats | None:
            values = [getattr(part, name) for part, _ in kept]
            return None if any(v is None for v in values) else np.concatenate(values)[order]

        emitter = [name for part, _ in kept for name in part.emitter]
        receiver = [name for part, _ in kept for name in part.receiver]
        return RangeEpoch(
            index=index,
            sync_s=float(time_s.min()),
            emitter=tuple(emitter[i] for i in order),
            receiver=tuple(receiver[i] for i in order),
            time_s=time_s[order],
            range_m=range_m[order],
            covariance_m2=covariance[np.ix_(order, order)],
            range_rate_mps=joined("rate_mps"),
            range_rate_sd_mps=joined("rate_sd_mps"),
            snr_db=joined("snr_db"),
            clock="known",
            sound_speed_mps=c,
            flags=flags,
            sound_speed_sd_mps=speed_sd,
            sd_stated=all(part.stated for part, _ in kept),
        )


def replied(site: Site, emitter: str, receiver: str) -> tuple[Beacon, Microphone, Beacon, Microphone]:
    """Both ends of an exchange: the burst's beacon and its hearer, the beacon that replied and who heard that.

    The reply comes from the hearer's vehicle: from the beacon of the microphone's id, else the first; and so back.

    Raises
    ------
    ValueError
        If an end stands on no vehicle, or a vehicle only sounds or only listens.
    """
    beacon, microphone = site.beacon(emitter), site.microphone(receiver)
    for kind, node in (("beacon", beacon), ("microphone", microphone)):
        if node.vehicle is None:
            raise ValueError(f"{kind} {node.id} is fixed; exchanges are between vehicles: mount it on one that stands")
    replies = [b for b in site.beacons if b.vehicle == microphone.vehicle]
    ears = [m for m in site.microphones if m.vehicle == beacon.vehicle]
    for vehicle, found, verb in ((microphone.vehicle, replies, "sounds"), (beacon.vehicle, ears, "listens")):
        if not found:
            raise ValueError(f"vehicle {vehicle} never {verb}; an exchange needs a beacon and a microphone on both")
    reply = next((b for b in replies if b.id == microphone.id), replies[0])
    ear = next((m for m in ears if m.id == beacon.id), ears[0])
    return beacon, microphone, reply, ear


def exchanges_of(table: Table) -> list[Exchange]:
    """Rows of `exchanges.csv`, in their order."""
    columns = table.columns
    none = np.full(len(columns["sent_s"]), np.nan)
    sds = [columns.get(name, none).tolist() for name in ("heard_sd_s", "reply_heard_sd_s")]
    stamps = [columns[name].tolist() for name in ("sent_s", "heard_s", "reply_sent_s", "reply_heard_s")]
    return [
        Exchange(emitter, receiver, *times, *(None if np.isnan(sd) else sd for sd in own))
        for emitter, receiver, times, own in zip(
            table.names["from"], table.names["to"], zip(*stamps, strict=True), zip(*sds, strict=True), strict=True
        )
    ]


def exchange_epochs(table: Table, site: Site) -> Iterator[RangeEpoch]:
    """Epochs of the exchanges that a recording states: one sweep over the pairs each, until a pair comes again.

    Exchanges that no chain of others joins to the first robot's clock are left out.
    """
    ways = TwoWay(site)
    found = [ways.take(exchange) for exchange in exchanges_of(table)]
    told = [(ways.told_s(part.robots[0], part.heard_s[1]), part) for part in found]
    ordered = sorted(((t, part) for t, part in told if t is not None), key=lambda row: row[0])
    sweep: list[tuple[float, TwoRanges]] = []
    index = 0
    for t, part in ordered:
        if sweep and (any(part.robots == p.robots for _, p in sweep) or t - sweep[0][0] > SWEEP_S):
            if (epoch := ways.epoch(index, [p for _, p in sweep])) is not None:
                yield epoch
                index += 1
            sweep = []
        sweep.append((t, part))
    if sweep and (epoch := ways.epoch(index, [p for _, p in sweep])) is not None:
        yield epoch
