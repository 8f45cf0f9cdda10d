"""Who is listened for in one epoch, and when: beacons that share a code, and bursts of the epochs before and after.

A hall larger than a beacon's reach gives the same code to beacons of different zones; epochs shorter than the flight
across it mix bursts sent in different periods. Either way one burst heard may be one of several. Where a track says
which, each is listened for where it is expected. Where none does, one of each code is listened for, and
`locate.whose` finds out whose it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sonofix.acquire.epochs import Window, across_s
from sonofix.records import Detection, Prediction, Waveform
from sonofix.signals.waveform import chips_of
from sonofix.site import Site

OUT_OF_REACH_M = 45.0
"""A beacon of a shared code is not listened for beyond this."""

APART_SD = 5.0
"""Deviations that two of one code must be expected apart, to be listened for at all."""

EARLIER, LATER = ", earlier", ", later"
"""Marks of bursts that begin before an epoch's window opens or after it closes, and sound within. No id has a comma."""


@dataclass(frozen=True, slots=True)
class Call:
    """What `acquire` is asked for: windows and predictions, by name in the plan.

    ``sent_before_s`` says of each predicted one by how much the epoch it was sent in began before this one.
    """

    windows: Mapping[str, tuple[float, float]]
    predictions: Mapping[str, Prediction]
    sent_before_s: Mapping[str, float]


class Roll:
    """All that a site's coded beacons may be heard as.

    Parameters
    ----------
    waveforms : mapping from beacon id to Waveform
    sound_speed_mps : float

    Attributes
    ----------
    short : bool
        Whether a flight across all there is may outlast a period.
    sharing : mapping from beacon id to tuple of str
        First beacon of each code, and all that send it, itself among them.
    """

    def __init__(self, site: Site, waveforms: Mapping[str, Waveform], sound_speed_mps: float) -> None:
        schedule = site.schedule
        self.period_s = schedule.period_s if schedule is not None and schedule.period_s is not None else np.inf
        self._sound_speed_mps = sound_speed_mps
        self._across_s = across_s(site, sound_speed_mps)
        self.short = site.clock_known and np.isfinite(self._across_s) and self._across_s > self.period_s
        self._waveforms = waveforms
        coded = [b for b in site.coded_beacons if b.id in waveforms]
        self._offset_s = {b.id: b.offset_s + b.delay_s for b in coded}
        self._vehicle = {b.id: b.vehicle for b in coded}
        self.sharing: dict[str, tuple[str, ...]] = {}
        first: dict[tuple[object, ...], str] = {}
        for b in coded:
            chips = chips_of(b)
            # the same chips may be written in several ways
            code = repr(b.code) if chips is None else chips.tobytes()
            head = first.setdefault((code, repr(site.signal_of(b))), b.id)
            self.sharing[head] = (*self.sharing.get(head, ()), b.id)

    @property
    def ambiguous(self) -> bool:
        """Whether a burst that nothing predicts may be one of several."""
        return self.short or any(len(group) > 1 for group in self.sharing.values())

    def named(self) -> dict[str, Waveform]:
        """Return the waveforms to plan for, by name."""
        out = dict(self._waveforms)
        if self.short:
            out |= {e + mark: w for e, w in self._waveforms.items() for mark in (EARLIER, LATER)}
        return out

    def listens(self, vehicle: str | None) -> list[str]:
        """Beacons that a microphone on a vehicle, or on none, can hear: not its own."""
        return [e for e, own in self._vehicle.items() if own is None or own != vehicle]

    def call(self, window: Window, delay_s: float, emitters: list[str], expected: Mapping[str, Prediction]) -> Call:
        """Say what to listen for in an epoch: each as ``expected`` of those ``emitters``, or one of each code.

        Parameters
        ----------
        delay_s : float
            Of the microphone.
        expected : mapping from emitter id to Prediction
            Arrivals of the bursts that are sent in this epoch, whenever they are heard. Empty: nothing is known.
        """
        within = {
            e: (window.opens_s + self._offset_s[e] + delay_s, window.closes_s + self._offset_s[e] + delay_s)
            for e in emitters
        }
        if not expected:
            heads = [e for e in emitters if e in self.sharing]
            mates = {e: [within[o] for o in self.sharing[e] if o in within] for e in heads}
            windows = {e: (min(w[0] for w in mates[e]), max(w[1] for w in mates[e])) for e in heads}
            if self.short:
                for e in heads:
                    length_s = self._waveforms[e].duration_s
                    opens_s, closes_s = windows[e]
                    windows[e + EARLIER] = (opens_s - length_s, opens_s)
                    windows[e + LATER] = (closes_s, closes_s + length_s)
            return Call(windows, {}, {})
        return self._call_expected(window, within, self._told_apart(window, expected))

    def _told_apart(self, window: Window, expected: Mapping[str, Prediction]) -> dict[str, Prediction]:
        """Leave out who shares a code and is out of reach, or is expected where another of that code is."""
        out: dict[str, Prediction] = {}
        for head, group in self.sharing.items():
            asked = [e for e in group if e in expected]
            if len(group) == 1:
                out |= {e: expected[e] for e in asked}
                continue
            flight_s = {e: self._begins_s(expected[e]) - self._offset_s[e] - window.sync_s for e in asked}
            near = [e for e in asked if flight_s[e] < OUT_OF_REACH_M / self._sound_speed_mps]
            for e in near:
                rivals = [expected[o] for o in near if o != e]
                if all(self._apart(expected[e], r, self._waveforms[head]) for r in rivals):
                    out[e] = expected[e]
        return out

    def _apart(self, a: Prediction, b: Prediction, waveform: Waveform) -> bool:
        between_s = abs(a.arrival_s - b.arrival_s)
        if self.short:
            between_s = min(between_s % self.period_s, -between_s % self.period_s)
        return between_s > APART_SD * (a.arrival_sd_s + b.arrival_sd_s) + 0.05 * waveform.duration_s

    def _begins_s(self, p: Prediction) -> float:
        return p.arrival_s - self._waveforms[p.emitter].duration_s / 2

    def _call_expected(
        self, window: Window, within: Mapping[str, tuple[float, float]], expected: Mapping[str, Prediction]
    ) -> Call:
        windows: dict[str, tuple[float, float]] = {}
        predictions: dict[str, Prediction] = {}
        before_s: dict[str, float] = {}
        for e, p in expected.items():
            if not self.short:
                windows[e], predictions[e], before_s[e] = within[e], p, 0.0
                continue
            opens_s, closes_s = within[e]
            reach_s, length_s = 5 * p.arrival_sd_s + 1e-3, self._waveforms[e].duration_s
            periods = int(np.floor((self._begins_s(p) - opens_s) / self.period_s))
            for mark, back in ((EARLIER, periods + 1), ("", periods), (LATER, periods - 1)):
                since_s = window.since_s(back, self.period_s)
                arrival_s = p.arrival_s - since_s
                begins_s = arrival_s - length_s / 2
                if not mark or opens_s - length_s < begins_s < closes_s + length_s:
                    windows[e + mark] = (begins_s - reach_s, begins_s + reach_s)
                    predictions[e + mark] = replace(p, emitter=e + mark, arrival_s=arrival_s)
                    before_s[e + mark] = since_s
        return Call(windows, predictions, before_s)

    def sent_s(self, window: Window, delay_s: float, call: Call) -> dict[str, float]:
        """When each burst called for would begin to be heard had it no way to go, recorder's clock, by name."""
        out: dict[str, float] = {}
        for name in call.windows:
            emitter = name
            if self.short and name.endswith((EARLIER, LATER)):
                emitter = name.removesuffix(EARLIER).removesuffix(LATER)
            out[name] = window.sync_s + self._offset_s[emitter] + delay_s - call.sent_before_s.get(name, 0.0)
        return out

    def heard(self, found: tuple[Detection, ...], call: Call) -> Iterator[Detection]:
        """Yield what was heard of this epoch, and by how much earlier it was sent where that is known."""
        for d in found:
            if self.short and d.emitter.endswith((EARLIER, LATER)):
                continue
            yield replace(d, sent_before_s=call.sent_before_s.get(d.emitter, 0.0))

    def whose(self, emitter: str, window: Window) -> list[tuple[str, float]]:
        """List whose a burst may be: (beacon id, seconds of flight beyond those it has as the first of its code)."""
        most = int(np.floor(self._across_s / self.period_s)) if self.short else 0
        back_s = [window.since_s(n, self.period_s) for n in range(most + 1)]
        own_s = self._offset_s[emitter]
        return [(e, own_s - self._offset_s[e] + more_s) for e in self.sharing[emitter] for more_s in back_s]

    def head(self, emitter: str) -> str:
        """Return the first beacon of an emitter's code: what it is listened for as where nothing is predicted."""
        return next(head for head, group in self.sharing.items() if emitter in group)
