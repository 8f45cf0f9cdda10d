"""One epoch of one microphone taken apart, loudest first.

Search all beacons in what is left, accept those near the strongest, refine what was found, subtract, and search again
until nothing more stands above its threshold. So a beacon at 1 m does not hide one at 15 m, and echoes, which are
paths of the same burst, do not hide beacons that are only heard once they are gone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.bank import Bank
from sonofix.acquire.baseband import Band
from sonofix.acquire.refine import Burst, refine
from sonofix.acquire.search import Peak, search
from sonofix.acquire.tones import MARGIN_S, Tone, refit
from sonofix.records import Detection, Floats, Path, Prediction

NEAR_STRONGEST = 10 ** (-6 / 10)
"""Accepted in one pass: correlation power within this of the strongest. m-sequences isolate 9 dB at worst, so nothing
this close can be another beacon's cross-talk."""

PATH_POWER = 10 ** (-12 / 10)
"""Echoes below this share of a burst's strongest path are left alone, and so is what comes before it."""

UNEXPLAINED = 1.3
"""Power left while bursts sound, over that of their quiet margins, at which there must be more to find."""

RESIDUE = 10 ** (-12 / 10)
"""What a poorly matched burst leaves behind is weaker than this share of it."""

MOST_PATHS = 8
"""Of one burst."""

ROUGH_ITERATIONS = 3
FULL_ITERATIONS = 12
"""Of the joint refinement while paths are still being found, and when all are."""

MOST_ROUNDS = 40
"""Of searching in what is left: a bound on the work, not expected to be met."""


@dataclass(frozen=True, slots=True, eq=False)
class Sound:
    """One path of one emitter's burst, as far as it is known.

    ``power`` is its correlation power when it was found, ``clear`` whether that stood above the threshold at once; if
    not, it must stand ``threshold`` times above the noise when all else is taken away. ``covariance`` (2, 2) is that of
    arrival and β, ``noise`` the white-equivalent power left around it.
    """

    bank: Bank
    burst: Burst
    power: float
    threshold: float
    clear: bool
    covariance: Floats
    noise: float

    @property
    def begins_s(self) -> float:
        """When its first chip is heard."""
        return self.burst.arrival_s - self.burst.waveform.duration_s / 2

    @property
    def ends_s(self) -> float:
        """When its last chip has rung off, slowed by 1 % at most."""
        w = self.burst.waveform
        return self.begins_s + 1.01 * (len(w.envelope) / w.rate_hz + w.start_s)

    @property
    def energy(self) -> float:
        """Of its signature, as a matched filter sees it."""
        return abs(self.burst.gain) ** 2 * self.bank.energy


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
    ) -> None:
        self.band, self.banks, self.windows = band, banks, windows
        self.baseband, self.start_s = baseband, start_s
        self.sound_speed_mps, self.kappa_sd, self.false_alarm_rate = sound_speed_mps, kappa_sd, false_alarm_rate
        self.tones = tones
        self.sounds: list[Sound] = []
        self.residual: NDArray[np.complexfloating] = baseband - self._tone()
        self._floor = self._margin_power()

    def run(self, predictions: Mapping[str, Prediction]) -> None:
        """Find all there is: first where it is predicted, then, if that does not explain what is heard, everywhere."""
        warm = dict(predictions)
        for _ in range(MOST_ROUNDS):
            disturbed = bool(self.sounds) and self._power_left() > UNEXPLAINED * self._floor
            peaks = [
                (bank, peak)
                for bank in self.banks
                if (peak := self._look(bank, warm, echoes=disturbed and not warm)) is not None
            ]
            if peaks:
                strongest = max(peak.power for _, peak in peaks)
                self._accept([(bank, peak) for bank, peak in peaks if peak.power >= NEAR_STRONGEST * strongest])
            elif warm and (disturbed or not self.sounds):
                warm = {}
            elif disturbed or not self.sounds:
                # nothing stands out of the crowd, if there is one: begin with its loudest
                crowd = [(bank, p) for bank in self.banks if (p := self._look(bank, warm, False, by_margins=True))]
                if not crowd:
                    break
                self._accept([max(crowd, key=lambda found: found[1].power)])
            else:
                break
        self._prune()

    def detections(self, receiver: str) -> list[Detection]:
        """Report each emitter by its first path of weight, where the samples hold that whole."""
        out = []
        for bank in self.banks:
            own = [s for s in self.sounds if s.bank is bank]
            if not own:
                continue
            strongest = max(s.energy for s in own)
            first = min((s for s in own if s.energy >= PATH_POWER * strongest), key=lambda s: s.burst.arrival_s)
            if self._whole(first):
                out.append(_detection(first, own, receiver, self.band))
        return out

    def _look(
        self, bank: Bank, predictions: Mapping[str, Prediction], echoes: bool, by_margins: bool = False
    ) -> Peak | None:
        """Search one emitter in what is left; None where nothing is worth trying."""
        own = [s for s in self.sounds if s.bank is bank]
        if own and (not echoes or len(own) >= MOST_PATHS):
            return None
        opens_s, closes_s = self.windows[bank.emitter]
        rates = None
        expected = predictions.get(bank.emitter)
        if expected is not None:
            begins_s = expected.arrival_s - bank.waveform.duration_s / 2
            reach_s = 5 * expected.arrival_sd_s + 2 / self.band.rate_hz
            opens_s, closes_s = max(opens_s, begins_s - reach_s), min(closes_s, begins_s + reach_s)
            reach = 5 * expected.range_rate_sd_mps
            rates = (expected.range_rate_mps - reach, expected.range_rate_mps + reach)
        known_s = [s.begins_s for s in own]
        peak = search(
            self.residual, self.start_s, bank, self.band, opens_s, closes_s, rates, known_s, self.false_alarm_rate
        )
        if peak is None:
            return None
        # many loud bursts at once raise the median that noise is judged by: the quiet margins know better
        noise = min(peak.noise, self._floor * self.band.whiteness) if by_margins else peak.noise
        if peak.power < (peak.threshold if own else peak.worth_trying) * noise:
            return None
        return peak if peak.power > PATH_POWER * max((s.power for s in own), default=0.0) else None

    def _accept(self, found: list[tuple[Bank, Peak]]) -> None:
        for bank, peak in found:
            middle_s = peak.start_s + bank.waveform.duration_s / 2
            burst = Burst(bank.waveform, middle_s, peak.range_rate_mps / self.sound_speed_mps, 0.0, 0j)
            clear = peak.power > peak.threshold * peak.noise
            self.sounds.append(Sound(bank, burst, peak.power, peak.threshold, clear, np.zeros((2, 2)), 0.0))
        self._settle(ROUGH_ITERATIONS)

    def _settle(self, iterations: int) -> None:
        """Refine all paths together on the stretch in which any of them sounds, then the tones in what they leave."""
        first, last = self._stretch()
        clean = self.baseband - self._tone()
        bursts, covariances, left, noise = refine(
            clean[first:last],
            self.start_s + first / self.band.rate_hz,
            self.band.rate_hz,
            [s.burst for s in self.sounds],
            self.kappa_sd,
            self.band.whiteness,
            iterations,
        )
        self.sounds = [
            replace(sound, burst=burst, covariance=covariance, noise=float(power))
            for sound, burst, covariance, power in zip(self.sounds, bursts, covariances, noise, strict=True)
        ]
        self.residual = clean
        self.residual[first:last] = left
        if self.tones:
            without_bursts = self.residual + self._tone()
            self.tones = refit(self.tones, without_bursts, self.band.rate_hz)
            self.residual = without_bursts - self._tone()

    def _prune(self) -> None:
        """Drop what was only tried and does not stand out even now that all else is gone."""
        while self.sounds:
            self._settle(FULL_ITERATIONS)
            # beside what no burst explains, a weak peak may be part of it, however clear it looked
            disturbed = self._power_left() > UNEXPLAINED * self._floor
            weak = RESIDUE * max(s.energy for s in self.sounds) if disturbed else 0.0
            sure = [s for s in self.sounds if (s.clear and s.energy >= weak) or s.energy > s.threshold * s.noise]
            if len(sure) == len(self.sounds):
                break
            self.sounds = sure

    def _tone(self) -> NDArray[np.complexfloating]:
        return sum((tone.course for tone in self.tones), np.zeros_like(self.baseband))

    def _stretch(self) -> tuple[int, int]:
        """Samples in which any burst sounds."""
        begins_s = min(s.begins_s for s in self.sounds) - 2e-3
        ends_s = max(s.ends_s for s in self.sounds)
        first = max(0, int((begins_s - self.start_s) * self.band.rate_hz))
        return first, max(first + 1, int((ends_s - self.start_s) * self.band.rate_hz) + 1)

    def _margin_power(self) -> float:
        """Noise power by the quieter of the two margins of the epoch."""
        sounding = self.residual[self.baseband != 0]
        edge = int(MARGIN_S * self.band.rate_hz)
        margins = [part for part in (sounding[:edge], sounding[-edge:]) if len(part)]
        return min((float(np.mean(np.abs(part) ** 2)) for part in margins), default=0.0)

    def _power_left(self) -> float:
        """Power left while bursts sound."""
        first, last = self._stretch()
        left = self.residual[first:last]
        return float(np.mean(np.abs(left) ** 2)) if len(left) else 0.0

    def _whole(self, sound: Sound) -> bool:
        """Whether the recording, which begins at 0, holds a burst from its first chip to its last.

        Where the epoch began before the recording, an earlier path of a burst near its beginning may have been missed.
        """
        half_s = sound.burst.waveform.duration_s / 2
        end_s = self.start_s + len(self.baseband) / self.band.rate_hz
        guard_s = min(half_s, 5e-3) if self.windows[sound.bank.emitter][0] < 0 else 0.0
        return sound.begins_s >= max(self.start_s, guard_s) and sound.burst.arrival_s + half_s <= end_s


def _detection(first: Sound, own: list[Sound], receiver: str, band: Band) -> Detection:
    burst, w = first.burst, first.burst.waveform
    inside = slice(int(-w.start_s * w.rate_hz), int((w.duration_s - w.start_s) * w.rate_hz))
    power = abs(burst.gain) ** 2 * float(np.mean(np.abs(w.envelope[inside]) ** 2))
    in_band = first.noise / band.whiteness
    paths = tuple(
        Path(
            s.burst.arrival_s - burst.arrival_s,
            float(20 * np.log10(max(abs(s.burst.gain), 1e-12) / max(abs(burst.gain), 1e-12))),
        )
        for s in own
    )
    return Detection(
        emitter=first.bank.emitter,
        receiver=receiver,
        arrival_s=burst.arrival_s,
        time_scale=1.0 - burst.beta,
        # β and the time scale differ in sign
        covariance=first.covariance * np.array([[1.0, -1.0], [-1.0, 1.0]]),
        amplitude=abs(burst.gain),
        snr_db=float(10 * np.log10(max(power, 1e-30) / in_band)),
        paths=paths,
    )
