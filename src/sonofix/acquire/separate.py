"""One epoch of one microphone taken apart: which bursts, by which paths, make up what was heard.

Bursts that stand out of their own search are taken at once, refined together and subtracted, and what is left is
searched for the rest: so a beacon at 1 m does not hide one at 15 m. Where more power remains than the quiet margins
have, there are echoes, which are paths of the same bursts: then the loudest of all candidates is taken, one at a time,
since in a crowd only the loudest is what it looks like.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.bank import Bank
from sonofix.acquire.baseband import Band
from sonofix.acquire.clicks import find_clicks
from sonofix.acquire.refine import FRESH_RAD, STALE_RAD, Burst, Joint
from sonofix.acquire.report import detection_of
from sonofix.acquire.search import Peak, mean_near, search, search_near
from sonofix.acquire.tones import MARGIN_S, Tone, refit
from sonofix.records import Detection, Prediction

STANDS_OUT = 10 ** (3 / 10)
"""Over the second highest of its own search: cross-talk and echoes make many peaks alike."""

HIGH = 4.0
"""Times the threshold: more than the highest of the forest of peaks that cross-talk makes."""

CROSS_TALK = 30.0
"""Times the mean cross-talk of a burst, which is one over its product of length and width: what lies below, beside the
strongest, must stand out by ``ALONE``."""

ALONE = 10 ** (6 / 10)

STAYS = 10 ** (-2 / 10)
"""Of its power: what a peak keeps at least when louder bursts are taken away, if it is a burst."""

PATH_POWER = 10 ** (-12 / 10)
"""A path before a burst's strongest one is its direct path where it has more than this share of its power."""

UNEXPLAINED = 1.3
"""Power left while bursts sound, over that of their quiet margins, at which there must be more to find."""

MATCHED = 10 ** (-4 / 10)
"""Of a burst's energy: what its signature alone must explain."""

FLANK = 0.5
"""Of the shortest time a burst resolves: farther from the highest peak, a burst is on its flank."""

BESIDE_OTHERS = 2.0
"""Over its threshold: what is fainter beside others, clear as it was when found, may have been what a poor fit left."""

CLEARED = 0.5
"""Times the threshold: what was clear when found must keep of it when all else is taken away."""

COLLAPSED = 0.1
"""Of the shortest time a burst resolves: paths this close, and alike in velocity, cannot be told apart."""

ECHO_POWER = 10 ** (-26 / 10)
"""Weaker echoes than this share of a burst's strongest path are not looked for."""

WOBBLE = 12.0
"""Power over the noise that leaving its parabola must explain more of a burst; noise alone explains 2 on average."""

MOSTLY = 0.6
"""Of what is left over the noise, that must be explained by it."""

AROUND_S = 8e-3
"""Before and after a burst, in which its early echoes fall: some 3 m of way."""

MOST_PATHS = 12
"""Of one burst."""

CROWD_ITERATIONS = 2
FULL_ITERATIONS = 12
"""Of the joint refinement while echoes are still being found, and when all are."""


@dataclass(slots=True, eq=False)
class Sound:
    """One path of one emitter's burst, as it was found.

    ``power`` is its correlation power then, ``clear`` whether that stood out and above the threshold at once; if not,
    it must stand ``threshold`` times above the noise when all else is taken away. ``sought`` marks what was found by
    looking only where it was predicted: the flank of another peak may have passed for it.
    """

    bank: Bank
    power: float
    threshold: float
    clear: bool
    sought: bool


Deed = Literal["taken", "aside", "unpredicted", "merged", "weak", "alike"]
"""Paths were taken, or impulses set aside; or no burst came as predicted; or paths are to be dropped because they fell
onto others, do not stand above the noise, or no higher than other peaks of their search."""

Watch = Callable[["Separation", Deed, Sequence[int]], None]
"""Is told what was done, or is about to be, and to which of the ``sounds``, by index."""


class Separation:
    """The work on one epoch of one microphone in one band.

    Parameters
    ----------
    band : Band
    banks : list of Bank
        Emitters to listen for.
    baseband : complex128 (n,)
        First sample at ``start_s``; with quiet margins (`tones.MARGIN_S`) at both ends.
    tones : list of Tone
        Steady tones in it.
    windows : mapping from emitter id to (opens_s, closes_s)
        When its burst may begin to be heard.
    sound_speed_mps, kappa_sd, false_alarm_rate : float
        As in `plan.Plan`.
    watch : Watch or None
        Is told what is done.
    missing : bool (n,) or None
        Samples that were never recorded: they count for nothing.

    Attributes
    ----------
    sounds : list of Sound
        Paths found so far; burst i of ``joint`` is that of ``sounds[i]``.
    joint : Joint
    predictions : mapping from emitter id to Prediction
        What is gone by; empty once they proved wrong.
    floor : float
        Noise power by the quieter of the two margins.
    notes : list of str
        What was done to the samples.
    """

    def __init__(
        self,
        band: Band,
        banks: list[Bank],
        baseband: NDArray[np.complex128],
        start_s: float,
        tones: list[Tone],
        windows: Mapping[str, tuple[float, float]],
        *,
        sound_speed_mps: float,
        kappa_sd: float,
        false_alarm_rate: float,
        watch: Watch | None = None,
        missing: NDArray[np.bool_] | None = None,
    ) -> None:
        self.band, self.banks, self.windows = band, banks, windows
        self.baseband, self.start_s = baseband, start_s
        self.sound_speed_mps, self.false_alarm_rate = sound_speed_mps, false_alarm_rate
        self.tones = tones
        self._watch = watch
        self.notes: list[str] = []
        self._settled = False
        self.sounds: list[Sound] = []
        self.joint = Joint(
            baseband - self._tone(), start_s, band.rate_hz, kappa_sd, band.whiteness, max(1, 2 * len(banks))
        )
        if missing is not None and missing.any():
            self.joint.leave_out(missing)
        self.floor = self._margin_power()
        self.predictions: Mapping[str, Prediction] = {}

    def run(self, predictions: Mapping[str, Prediction], everywhere: bool = True) -> None:
        """Find all there is, where it is predicted; if nothing came as predicted, ``everywhere`` if that is wished."""
        if not self.banks:
            return
        self.predictions = predictions
        self._take_apart()
        if predictions and not any(self.awaited(i) for i in range(len(self.sounds))):
            # nothing came as predicted: then the prediction is what is wrong
            self._tell("unpredicted", ())
            self._keep([])
            if everywhere:
                self.predictions = {}
                self._take_apart()

    def _take_apart(self) -> None:
        self._take_beacons()
        self._settle()
        if self._disturbed():
            self._straighten()
            self._follow()
            self._leave_out_clicks()
            self._take_crowd()
            self._prune()
        elif self._prune():
            # what had been mistaken for a burst may have hidden it
            self._take_beacons()
            self._prune()
        if self._disturbed():
            self._verify()

    def _straighten(self) -> None:
        """Give bursts the curvature that explains them, loudest first: what a poor fit of one leaves disturbs all."""
        loudest_first = np.argsort([-self.energy(i) for i in range(len(self.sounds))])
        if any([self.joint.straighten(int(i)) for i in loudest_first]):  # of all, not up to the first that changed
            self._settled = False
            self._settle()

    def _follow(self) -> None:
        """Let bursts leave their parabolas, if that explains most of what is left: echoes and clicks would not."""
        if not (self.sounds and self._disturbed()):
            return
        first, last = self.sounding()
        excess = float(np.sum(np.abs(self.joint.residual[first:last]) ** 2)) - (last - first) * self.floor
        noise = self.floor * self.band.whiteness
        found = [(i, *self.joint.wobble(i)) for i in range(len(self.sounds))]
        real = [(i, phase, gained) for i, phase, gained in found if gained > WOBBLE * noise]
        if sum(gained for _, _, gained in real) < MOSTLY * excess:
            return
        for i, phase, _ in real:
            self.joint.follow(i, phase)
        self._settled = False
        self._settle()

    def _leave_out_clicks(self) -> None:
        """Set aside clicks and drop-outs."""
        if not (self.sounds and self._disturbed()):
            return
        shortest_s = min(b.waveform.duration_s for b in self.joint.bursts)
        clicks = find_clicks(self.joint.residual, shortest_s * self.band.rate_hz)
        if not len(clicks):
            return
        aside = ~self.joint.counted
        for begin, end in clicks:
            aside[begin:end] = True
        self.joint.leave_out(aside)
        self._settled = False
        self._settle()
        lasted_ms = 1e3 * float(np.sum(np.diff(clicks, axis=1))) / self.band.rate_hz
        self.notes.append(f"{len(clicks)} clicks or drop-outs, {lasted_ms:.0f} ms in all, were left out")
        self._tell("aside", ())

    def _verify(self) -> None:
        """Drop what no longer stands above the cross-talk of all that is left, beside what no burst explains."""
        doubtful = set(self.windows)
        while doubtful:
            disturbed = self._disturbed()
            dropped = [
                i
                for i, s in enumerate(self.sounds)
                if s.bank.emitter in doubtful and not self._stands_out(i, disturbed)
            ]
            doubtful = {self.sounds[i].bank.emitter for i in dropped}
            if dropped:
                self._tell("alike", dropped)
                self._keep([i for i in range(len(self.sounds)) if i not in dropped])
                self._prune()

    def _sure(self, i: int, noise: float, disturbed: bool) -> bool:
        """Whether a burst stands above the noise left around it, or out of a search; ``disturbed`` as `_disturbed`."""
        sound = self.sounds[i]
        if self.joint.matched(i) < MATCHED * self.energy(i):
            return False
        above = self.energy(i) / (sound.threshold * noise)
        alone = all(s.bank is sound.bank for s in self.sounds)
        if sound.clear and above > (CLEARED if alone else BESIDE_OTHERS):
            return True
        # among echoes the direct path need not be the highest of all
        return (above > 1.0 and (disturbed or (alone and not sound.sought))) or self._stands_out(i, disturbed)

    def _stands_out(self, i: int, disturbed: bool) -> bool:
        """Whether a burst stands out of a search of its code in what all other bursts leave.

        Cross-talk makes a forest of peaks, none far above the mean; a path may have echoes as strong, but stands high.
        What was found near a prediction must be the highest of all, unless there are echoes.
        """
        bank = self.sounds[i].bank
        known_s = [self.begins_s(k) for k, s in enumerate(self.sounds) if s.bank is bank and k != i]
        heard = self.joint.residual_with(i)
        peak = search(heard, self.start_s, bank, self.band, *self.windows[bank.emitter], known_s, self.false_alarm_rate)
        if peak is None:
            return False
        on_flank = abs(peak.start_s - self.begins_s(i)) > FLANK / self.band.half_width_hz
        if self.sounds[i].sought and not disturbed and on_flank:
            return False
        energy, floor = self.energy(i), peak.threshold * peak.noise
        return energy > floor and (energy > STANDS_OUT * peak.second or energy > HIGH * floor)

    def _collapsed(self, i: int) -> bool:
        """Whether a burst fell onto an earlier found path of its emitter, so that only their sum means anything."""
        burst = self.joint.bursts[i]
        near_s = COLLAPSED / self.band.half_width_hz
        slow = 1.0 / (np.pi * burst.waveform.carrier_hz * burst.waveform.duration_s)
        return any(
            s.bank is self.sounds[i].bank
            and abs(self.joint.bursts[k].arrival_s - burst.arrival_s) < near_s
            and abs(self.joint.bursts[k].beta - burst.beta) < slow
            for k, s in enumerate(self.sounds[:i])
        )

    def _tell(self, deed: Deed, which: Sequence[int]) -> None:
        if self._watch is not None:
            self._watch(self, deed, which)

    def _keep(self, which: list[int]) -> None:
        self.sounds = [self.sounds[i] for i in which]
        self.joint.keep(which)
        self._settled = False

    def _take_beacons(self) -> None:
        """Accept what stands out, and search the rest in what is left."""
        before: list[tuple[Bank, Peak]] = []
        while True:
            # the louder gone, what is still there was no cross-talk
            stayed = [(bank, peak) for bank, old in before if (peak := self._stays(bank, old)) is not None]
            if stayed:
                self._accept(stayed)
            missing = [bank for bank in self.banks if not any(s.bank is bank for s in self.sounds)]
            found = [(bank, peak) for bank in missing if (peak := self._look(bank)) is not None]
            if not found:
                return
            strongest = max(peak.power for _, peak in found)
            sure = [
                (bank, peak)
                for bank, peak in found
                if (peak.power > peak.threshold * peak.noise or not self.predictions)
                and peak.power
                > (STANDS_OUT if peak.power > self._cross_talk(bank) * strongest else ALONE) * peak.second
            ]
            if not sure:
                # a prediction leaves little room for anything else; without, the loudest of a crowd may be an echo
                if self._disturbed() and not self.predictions:
                    return
                sure = [max(found, key=lambda one: one[1].power)]
            self._accept(sure)
            if not self.predictions:
                accepted = {bank.emitter for bank, _ in sure}
                before = [(bank, peak) for bank, peak in found if bank.emitter not in accepted]

    def _cross_talk(self, bank: Bank) -> float:
        """Correlation power that another burst as loud may have with this one's code."""
        return CROSS_TALK / (2 * self.band.half_width_hz * bank.waveform.duration_s)

    def _stays(self, bank: Bank, old: Peak) -> Peak | None:
        """Look where an emitter's highest peak was before louder bursts were taken away; None if it went with them."""
        reach_s = 2 / self.band.rate_hz
        peak = search_near(
            self.joint.residual,
            self.start_s,
            bank,
            self.band,
            old.start_s - reach_s,
            old.start_s + reach_s,
            (old.range_rate_mps - bank.step_mps, old.range_rate_mps + bank.step_mps),
            [],
            self.false_alarm_rate,
        )
        if peak is None or peak.power < STAYS * old.power or peak.power < old.threshold * peak.noise:
            return None
        return replace(peak, threshold=old.threshold)

    def _take_crowd(self) -> None:
        """Accept paths of all bursts, one at a time, while more remains than noise."""
        last: dict[str, Peak | None] = {}
        while self._disturbed() and len(self.sounds) < MOST_PATHS * len(self.banks):
            # a burst taken away leaves less for all others: what they had before bounds what they have now
            fresh: set[str] = set()
            while True:
                waiting = [b for b in self.banks if b.emitter not in last or last[b.emitter] is not None]
                if not waiting:
                    return
                bank = max(waiting, key=lambda b: p.power if (p := last.get(b.emitter)) else np.inf)
                if bank.emitter in fresh:
                    break
                last[bank.emitter] = self._look(bank, echoes=True)
                fresh.add(bank.emitter)
            peak = last[bank.emitter]
            assert peak is not None
            self._accept([(bank, peak)], CROWD_ITERATIONS)

    def _look(self, bank: Bank, echoes: bool = False) -> Peak | None:
        """Search one emitter in what is left, where its direct path is predicted and, for ``echoes``, then everywhere.

        None where nothing is worth trying.
        """
        own = [i for i, s in enumerate(self.sounds) if s.bank is bank]
        if len(own) >= MOST_PATHS:
            return None
        opens_s, closes_s = self.windows[bank.emitter]
        known_s = [self.begins_s(i) for i in own]
        heard = (self.joint.residual, self.start_s, bank, self.band)
        expected = None if any(self.awaited(i) for i in own) else self.predictions.get(bank.emitter)
        if expected is not None:
            begins_s, reach_s = expected.arrival_s - bank.waveform.duration_s / 2, self.reach_s(expected)
            reach = 5 * expected.range_rate_sd_mps
            near = search_near(
                *heard,
                max(opens_s, begins_s - reach_s),
                min(closes_s, begins_s + reach_s),
                (expected.range_rate_mps - reach, expected.range_rate_mps + reach),
                known_s,
                self.false_alarm_rate,
            )
            if self._worth(near, own, echoes):
                return near
            if not echoes:
                return None
        peak = search(*heard, opens_s, closes_s, known_s, self.false_alarm_rate)
        return peak if self._worth(peak, own, echoes) else None

    def _worth(self, peak: Peak | None, own: list[int], echoes: bool) -> bool:
        """Whether a peak is worth trying beside its emitter's own paths."""
        if peak is None:
            return False
        # many loud bursts at once raise the median that noise is judged by: the quiet margins know better
        noise = min(peak.noise, self.floor * self.band.whiteness) if echoes else peak.noise
        least = (peak.threshold if own else peak.worth_trying) * noise
        return peak.power >= least and peak.power > ECHO_POWER * max((self.sounds[i].power for i in own), default=0.0)

    def _accept(self, found: list[tuple[Bank, Peak]], iterations: int = 1) -> None:
        for bank, peak in found:
            middle_s = peak.start_s + bank.waveform.duration_s / 2
            self.joint.add(Burst(bank.waveform, middle_s, peak.range_rate_mps / self.sound_speed_mps, 0.0, 0j))
            clear = peak.power > peak.threshold * peak.noise and peak.power > STANDS_OUT * peak.second
            sought = bank.emitter in self.predictions and not clear
            self.sounds.append(Sound(bank, peak.power, peak.threshold, clear, sought))
        self._settled = False
        self._settle(iterations)
        self._tell("taken", range(len(self.sounds) - len(found), len(self.sounds)))

    def _settle(self, iterations: int = FULL_ITERATIONS) -> None:
        """Refine all paths together, then the tones in what they leave."""
        if self._settled:
            return
        full = iterations == FULL_ITERATIONS
        self.joint.settle(iterations, FRESH_RAD if full else STALE_RAD)
        self._settled = full
        if self.tones:
            self.tones = refit(self.tones, self.joint.residual + self._tone(), self.band.rate_hz)
            self.joint.replace_baseband(self.baseband - self._tone())

    def _prune(self) -> bool:
        """Drop what was only tried and does not stand out even now that all else is gone; say whether there was any."""
        before = len(self.sounds)
        while self.sounds:
            self._settle()
            merged = [i for i in range(len(self.sounds)) if self._collapsed(i)]
            if merged:
                self._tell("merged", merged)
                self._keep([i for i in range(len(self.sounds)) if i not in merged])
                continue
            noise, disturbed = self.joint.noise(), self._disturbed()
            sure = [i for i, power in enumerate(noise) if self._sure(i, float(power), disturbed)]
            if len(sure) == len(self.sounds):
                break
            self._tell("weak", sorted(set(range(len(self.sounds))) - set(sure)))
            self._keep(sure)
        return len(self.sounds) < before

    def detections(self, receiver: str) -> list[Detection]:
        """Report each emitter by its first path of weight, where the samples hold that whole."""
        out = []
        noise = self.joint.noise()
        covariances = self.joint.covariances(noise)
        # the faintest echoes stay in what is left, and their own code hears them better than it hears noise
        echoes = len(self.sounds) > len({s.bank.emitter for s in self.sounds})
        for bank in self.banks:
            own = [i for i, s in enumerate(self.sounds) if s.bank is bank]
            if not own:
                continue
            strongest = max(self.energy(i) for i in own)
            weighty = [i for i in own if self.energy(i) >= PATH_POWER * strongest and self.awaited(i)]
            if not weighty:
                continue
            first = min(weighty, key=lambda i: self.joint.bursts[i].arrival_s)
            if self._whole(first):
                bursts = [self.joint.bursts[i] for i in own]
                louder = max(1.0, self._heard_around(first) / float(noise[first])) if echoes else 1.0
                out.append(
                    detection_of(
                        bank.emitter,
                        bank.waveform,
                        self.joint.bursts[first],
                        bursts,
                        covariances[first] * louder,
                        float(noise[first]) / self.band.whiteness,
                        receiver,
                    )
                )
        return out

    def _heard_around(self, i: int) -> float:
        """Power per sample of what is left around burst i, as its code hears it."""
        bank, rate_mps = self.sounds[i].bank, self.joint.bursts[i].beta * self.sound_speed_mps
        place = self.begins_s(i), rate_mps, AROUND_S
        return mean_near(self.joint.residual, self.start_s, bank, self.band, *place)

    def reach_s(self, expected: Prediction) -> float:
        """How far from its predicted arrival a burst is looked for."""
        return 5 * expected.arrival_sd_s + 2 / self.band.rate_hz

    def awaited(self, i: int) -> bool:
        """Whether burst i came when its emitter's direct path was predicted, or nothing was."""
        expected = self.predictions.get(self.sounds[i].bank.emitter)
        if expected is None:
            return True
        return abs(self.joint.bursts[i].arrival_s - expected.arrival_s) <= 1.2 * self.reach_s(expected)

    def begins_s(self, i: int) -> float:
        """When the first chip of burst i is heard."""
        burst = self.joint.bursts[i]
        return burst.arrival_s - burst.waveform.duration_s / 2

    def energy(self, i: int) -> float:
        """Of burst i's signature, as a matched filter sees it."""
        return abs(self.joint.bursts[i].gain) ** 2 * self.sounds[i].bank.energy

    def _tone(self) -> NDArray[np.complexfloating]:
        return sum((tone.course for tone in self.tones), np.zeros_like(self.baseband))

    def _margin_power(self) -> float:
        """Noise power by the quieter of the two margins of the epoch."""
        sounding = self.joint.residual[self.baseband != 0]
        edge = int(MARGIN_S * self.band.rate_hz)
        margins = [part for part in (sounding[:edge], sounding[-edge:]) if len(part)]
        return min((float(np.mean(np.abs(part) ** 2)) for part in margins), default=0.0)

    def _disturbed(self) -> bool:
        """Whether more is left, while bursts sound, than their quiet margins have."""
        first, last = self.sounding()
        left = self.joint.residual[first:last][self.joint.counted[first:last]]
        return bool(len(left)) and float(np.mean(np.abs(left) ** 2)) > UNEXPLAINED * self.floor

    def sounding(self) -> tuple[int, int]:
        """First and past-the-last sample in which any burst sounds, its ring included; all where none was found."""
        if not self.sounds:
            return 0, len(self.baseband)
        begins_s = min(self.begins_s(i) for i in range(len(self.sounds))) - 2e-3
        ends_s = max(
            self.begins_s(i) + 1.01 * (len(b.waveform.envelope) / b.waveform.rate_hz + b.waveform.start_s)
            for i, b in enumerate(self.joint.bursts)
        )
        first = max(0, int((begins_s - self.start_s) * self.band.rate_hz))
        return first, max(first, int((ends_s - self.start_s) * self.band.rate_hz) + 1)

    def _whole(self, i: int) -> bool:
        """Whether the recording, which begins at 0, holds a burst from its first chip to its last.

        Where the epoch began before the recording, an earlier path of a burst near its beginning may have been missed.
        """
        burst = self.joint.bursts[i]
        half_s = burst.waveform.duration_s / 2
        end_s = self.start_s + len(self.baseband) / self.band.rate_hz
        guard_s = min(half_s, 5e-3) if self.windows[self.sounds[i].bank.emitter][0] < 0 else 0.0
        return self.begins_s(i) >= max(self.start_s, guard_s) and burst.arrival_s + half_s <= end_s
