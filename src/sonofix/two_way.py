"""Exchanges of two robots, each on its own clock → ranges.

A burst from A to B takes z1 = r1 + b as told by both clocks, one from B to A takes z2 = r2 − b, where b is c times what
B's clock is ahead of A's. The sum knows nothing of b but what its drift makes of the time between both bursts; the
difference tells b. So a clock is followed for each pair by a Kalman filter over successive exchanges. (With two
exchanges, and robots that stand, that is double-sided two-way ranging: Neirynck, Luk & McLaughlin 2016.) What leaves is
each exchange's own two ranges, A to B and B to A, each at the instant it was heard, and their covariance: the sum is as
good as what was heard, and the difference as good as the clock is known.

Robots that drive one behind the other make r1 and r2 differ as an offset does: r1 − r2 = (r / c) u · (v_A + v_B), u
from A to B, beside what the range changes in between. That is followed too, and limits what is known of the clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from sonofix.records import Exchange, Floats, RangeEpoch, Table
from sonofix.site import Beacon, Microphone, Site

DRIFT_SD = 1e-4
"""Deviation of one clock's speed from another's before anything was heard: two cheap crystals."""

DRIFT_WANDER = 1e-8
"""How far the speed of one wanders from the other's, per √s (oven-less crystals, warming up)."""

ACCELERATION_PSD = 0.5
"""Of range, m²/s³: as briskly as a track takes vehicles to move."""

CRUISE, CRUISE_S = 0.5, 60.0
"""Deviation of the sum of both velocities along the line between, a share of the sum of highest speeds; and how long
one holds: a first-order Gauss-Markov process."""

MAX_SPEED_MPS = 3.0
"""Of a vehicle whose site file states none."""

UNSTATED_SD_M = 0.1
"""Deviation of a hearing that states none, until `ENOUGH` of them have told theirs."""

ENOUGH = 5
REMEMBERED = 40
"""Exchanges by which a pair's unstated deviations are judged."""

REFUSED = 36.0
"""Squared deviations beyond which an exchange says nothing of the clock; three such in a row begin it anew."""

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


class PairClock:
    """One robot's clock as another's sees it.

    The state is range, its rate, c times the offset, c times the drift, and the sum of both velocities along the line
    from A to B (m, m/s), at ``time_s`` on A's clock.
    """

    def __init__(self, sound_speed_mps: float, max_rate_mps: float) -> None:
        self._c, self._max_rate_mps = sound_speed_mps, max_rate_mps
        self.time_s = -np.inf
        self.mean = np.zeros(5)
        self.covariance = np.zeros((5, 5))
        self._halves: deque[tuple[float, float]] = deque(maxlen=REMEMBERED)
        self._refused = 0

    @property
    def known(self) -> bool:
        """Whether anything was heard."""
        return bool(np.isfinite(self.time_s))

    def ahead_s(self, time_s: float) -> float:
        """What B's clock shows beyond A's, at a time on A's."""
        return float(self.mean[2] + self.mean[3] * (time_s - self.time_s)) / self._c

    def behind_s(self, shown_s: float) -> float:
        """What A's clock shows less than B's, when B's shows a time."""
        drift = float(self.mean[3]) / self._c
        at_s = (shown_s - float(self.mean[2]) / self._c + drift * self.time_s) / (1.0 + drift)
        return shown_s - at_s

    def take(
        self, sent_s: float, heard_s: float, reply_sent_s: float, reply_heard_s: float, sd_m: Floats | None
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Take in what A sent and B heard, and what B sent and A heard, whichever came first.

        Parameters
        ----------
        sent_s, reply_heard_s : float
            On A's clock.
        heard_s, reply_sent_s : float
            On B's.
        sd_m : float64 (2,) or None
            c times the deviations of what B heard, and A; None: not stated.

        Returns
        -------
        heard_s : float64 (2,)
            When B heard A, and A heard B, on A's clock.
        range_m : float64 (2,)
            A to B, B to A.
        covariance_m2 : float64 (2, 2)
        drift_mps : float64 (2,)
            c times the drift, and its deviation.
        """
        c = self._c
        way = np.array([c * (heard_s - sent_s), c * (reply_heard_s - reply_sent_s)])
        flight_s = float(way.sum()) / 2 / c
        when = np.array([sent_s + flight_s, reply_heard_s])
        if sd_m is None:
            sd_m = np.full(2, self._judged((when[0] + when[1]) / 2, float(way[0] - way[1]) / 2))
        clock, known = self._clock_at(float(when[0]))
        # B heard A at the first instant, and sent at another: its clock drifts between
        between_s = float(when[1]) - flight_s - float(when[0])
        moved_m = self._max_rate_mps * np.hypot(float(when[1] - when[0]), CRUISE * flight_s) + 1e-6
        table = np.array(
            [
                [1.0, 0.0, 1.0, 0.0],
                [0.0, 1.0, -1.0, -between_s],
                [-1.0, 1.0, 0.0, 0.0],
            ]
        )
        weight = 1.0 / np.array([sd_m[0], sd_m[1], moved_m]) ** 2
        information = (table.T * weight) @ table
        information[2:, 2:] += known
        spread = np.linalg.inv(information)
        # solved for what the clock differs by from what was expected, so that long offsets cost no digits
        gap = np.array([way[0] - clock[0], way[1] + clock[0] + between_s * clock[1], 0.0])
        solved = spread @ (table.T @ (weight * gap))
        self._learn(when, way, sd_m, flight_s)
        drift = np.array([self.mean[3], np.sqrt(self.covariance[3, 3])])
        return when, solved[:2], spread[:2, :2], drift

    def _clock_at(self, time_s: float) -> tuple[Floats, Floats]:
        """Offset and drift expected (2,), in m and m/s, and the information (2, 2) in that."""
        if not self.known:
            return np.zeros(2), np.diag([0.0, 1.0 / (DRIFT_SD * self._c) ** 2])
        mean, covariance = self._aged(time_s)
        return mean[2:4], np.linalg.inv(covariance[2:4, 2:4])

    def _aged(self, time_s: float) -> tuple[Floats, Floats]:
        dt = time_s - self.time_s
        step = np.eye(5)
        step[0, 1] = step[2, 3] = dt
        step[4, 4] = np.exp(-abs(dt) / CRUISE_S)
        noise = np.zeros((5, 5))
        shape = np.array([[abs(dt) ** 3 / 3, dt * abs(dt) / 2], [dt * abs(dt) / 2, abs(dt)]])
        noise[:2, :2] = ACCELERATION_PSD * shape
        noise[2:4, 2:4] = (DRIFT_WANDER * self._c) ** 2 * shape
        noise[4, 4] = (CRUISE * self._max_rate_mps) ** 2 * (1.0 - step[4, 4] ** 2)
        return step @ self.mean, step @ self.covariance @ step.T + noise

    def _learn(self, when: Floats, way: Floats, sd_m: Floats, flight_s: float) -> None:
        """Follow range and clock: both ways in the order they were heard."""
        if not self.known:
            self._begin(when, way, sd_m)
            return
        before = self.time_s, self.mean, self.covariance
        strange = 0.0
        for k in np.argsort(when).tolist():
            self.mean, self.covariance = self._aged(float(when[k]))
            self.time_s = float(when[k])
            # B's clock as it was when it sent
            late_s = flight_s / 2
            shows = np.array([1.0, 0.0, 1.0, 0.0, late_s] if k == 0 else [1.0, 0.0, -1.0, flight_s, -late_s])
            crossed = self.covariance @ shows
            spread = float(shows @ crossed) + sd_m[k] ** 2
            miss = float(way[k] - shows @ self.mean)
            strange = max(strange, miss**2 / spread)
            gain = crossed / spread
            keep = np.eye(5) - np.outer(gain, shows)
            self.mean = self.mean + gain * miss
            self.covariance = keep @ self.covariance @ keep.T + sd_m[k] ** 2 * np.outer(gain, gain)
        if strange <= REFUSED:
            self._refused = 0
            return
        self._refused += 1
        self.time_s, self.mean, self.covariance = before
        if self._refused >= 3:
            self._begin(when, way, sd_m)

    def _begin(self, when: Floats, way: Floats, sd_m: Floats) -> None:
        """Begin with one exchange of robots that may move as they can."""
        self.time_s, self._refused = float(when.max()), 0
        self.mean = np.array([way.sum() / 2, 0.0, (way[0] - way[1]) / 2, 0.0, 0.0])
        own, drift = float(sd_m @ sd_m) / 4, DRIFT_SD * self._c
        # taken for independent, which they are not: a few exchanges later it does not matter
        moved = (self._max_rate_mps**2 + drift**2) * float(np.ptp(when)) ** 2
        cruise = (CRUISE * self._max_rate_mps) ** 2
        moved += cruise * float(way.sum() / 4 / self._c) ** 2
        self.covariance = np.diag([own + moved, self._max_rate_mps**2, own + moved, drift**2, cruise])

    def _judged(self, time_s: float, half_m: float) -> float:
        """Deviation of hearings that state none: half-differences against straight lines between their neighbours.

        A half-difference has the same noise as a range, a hearing's over √2; a clock drifts, and does not jump.
        """
        self._halves.append((time_s, half_m))
        if len(self._halves) < ENOUGH + 2:
            return UNSTATED_SD_M
        t, h = np.array(self._halves).T
        share = (t[1:-1] - t[:-2]) / np.maximum(t[2:] - t[:-2], 1e-9)
        off = h[1:-1] - (1 - share) * h[:-2] - share * h[2:]
        # a median of squares, for outliers; 0.455 is that of chi-squared
        return float(np.sqrt(2 * np.median(off**2 / (1 + share**2 + (1 - share) ** 2)) / 0.455))


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
