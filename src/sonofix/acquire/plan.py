"""The acquisition plan: everything about a site's bursts that can be computed before the first sample comes.

One epoch of one microphone is taken apart loudest first: search all beacons not yet found in what is left, accept
those near the strongest, refine everything found so far together, subtract, and search again until nothing more stands
above its threshold. So a beacon at 1 m does not hide one at 15 m.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.bank import Bank, make_bank
from sonofix.acquire.baseband import Band, band_limited, design_band, downconvert
from sonofix.acquire.refine import Burst, refine
from sonofix.acquire.search import Peak, search
from sonofix.acquire.tones import MARGIN_S, Tone, find_tones, level_db, refit
from sonofix.records import Detection, Floats, Path, Prediction, Waveform

NEAR_STRONGEST = 10 ** (-6 / 10)
"""Accepted in one pass: correlation power within this of the strongest. m-sequences isolate 9 dB at worst, so nothing
this close can be another beacon's cross-talk."""

PATH_POWER = 10 ** (-12 / 10)
"""Echoes below this share of a burst's strongest path are left alone, and so is what comes before it."""

MOST_PATHS = 8
"""Of one burst."""

ROUGH_ITERATIONS = 3
FULL_ITERATIONS = 12
"""Of the joint refinement while paths are still being found, and when all are."""

MOST_ROUNDS = 40
"""Of searching in what is left: a bound on the work, not expected to be met."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What `acquire` needs to know, planned once.

    Attributes
    ----------
    sample_rate_hz, sound_speed_mps : float
    bands : tuple of (Band, tuple of Bank)
        Beacons on one carrier share a band.
    false_alarm_rate : float
        That a silent beacon is reported, per epoch and microphone.
    kappa_sd : float
        Prior deviation of range acceleration over c, 1/s.
    """

    sample_rate_hz: float
    sound_speed_mps: float
    bands: tuple[tuple[Band, tuple[Bank, ...]], ...]
    false_alarm_rate: float
    kappa_sd: float

    @property
    def margin_s(self) -> float:
        """Samples wanted before the first arrival searched and after the last burst: filters settle, tones show."""
        return MARGIN_S + max(len(band.taps) / band.sample_rate_hz for band, _ in self.bands)

    @property
    def burst_s(self) -> float:
        """Longest burst, its ring and its stretch included."""
        return max(bank.replicas.shape[1] / band.rate_hz for band, banks in self.bands for bank in banks)


def make_plan(
    waveforms: Mapping[str, Waveform],
    sample_rate_hz: float,
    sound_speed_mps: float,
    max_rate_mps: float = 3.0,
    max_acceleration_mps2: float = 2.0,
    false_alarm_rate: float = 1e-4,
) -> Plan:
    """Plan the acquisition of a set of beacons.

    Parameters
    ----------
    waveforms : mapping from emitter id to Waveform
    max_rate_mps : float
        Range rates searched: ±.
    max_acceleration_mps2 : float
        One-sigma range acceleration within a burst (a pass at 2 m/s and 2 m gives 2 m/s²).

    Raises
    ------
    ValueError
        If there is no waveform, or the sample rate is too low for a carrier.
    """
    if not waveforms:
        raise ValueError("no beacon has a code, so there is nothing to listen for: give each [[beacon]] its code")
    bands = []
    for carrier_hz in sorted({w.carrier_hz for w in waveforms.values()}):
        members = {k: w for k, w in waveforms.items() if w.carrier_hz == carrier_hz}
        band = design_band(list(members.values()), sample_rate_hz)
        banks = tuple(
            make_bank(emitter, band_limited(w, band), band, max_rate_mps, sound_speed_mps)
            for emitter, w in members.items()
        )
        bands.append((band, banks))
    return Plan(
        sample_rate_hz, sound_speed_mps, tuple(bands), false_alarm_rate, max_acceleration_mps2 / sound_speed_mps
    )


def acquire(
    plan: Plan,
    samples: NDArray[np.float32],
    first_sample: int,
    receiver: str,
    windows: Mapping[str, tuple[float, float]],
    predictions: Mapping[str, Prediction] | None = None,
) -> tuple[tuple[Detection, ...], tuple[str, ...]]:
    """All bursts that one microphone heard in one epoch.

    Parameters
    ----------
    samples : float32 (n,)
        One channel around the epoch; index 0 is sample ``first_sample`` of the recording.
    receiver : str
        The microphone's id.
    windows : mapping from emitter id to (opens_s, closes_s)
        When its burst may begin to be heard, recorder's clock. Emitters not named are not searched.
    predictions : mapping from emitter id to Prediction
        Warm search: delay and range rate only within five deviations of what is expected.

    Returns
    -------
    detections : tuple of Detection, strongest first
    notes : tuple of str
        What was done to the samples before.
    """
    notes: list[str] = []
    found: list[tuple[Burst, Detection]] = []
    for band, banks in plan.bands:
        baseband, start_s = downconvert(samples, first_sample, band)
        if len(baseband):
            listening = [b for b in banks if b.emitter in windows]
            tones = find_tones(baseband, band.rate_hz)
            left = baseband - sum(tone.course for tone in tones)
            for tone in tones:
                text = f"a tone at {(band.carrier_hz + tone.offset_hz) / 1e3:.3f} kHz"
                notes.append(f"{text}, {level_db(tone, left):.0f} dB over all else in the band, was taken out")
            found += _take_apart(plan, band, listening, baseband, tones, start_s, receiver, windows, predictions or {})
    found.sort(key=lambda pair: -abs(pair[0].gain))
    return tuple(detection for _, detection in found), tuple(notes)


@dataclass(frozen=True, slots=True, eq=False)
class _Heard:
    """One path of one emitter's burst, as found.

    ``power`` is its correlation power then, ``clear`` whether that stood above the threshold at once; if not, it must
    stand ``threshold`` times above the noise when all else is taken away.
    """

    bank: Bank
    power: float
    threshold: float
    clear: bool

    @property
    def sounds_s(self) -> float:
        """From its first chip until its last has rung off, slowed by 1 % at most."""
        w = self.bank.waveform
        return 1.01 * (len(w.envelope) / w.rate_hz + w.start_s)


def _take_apart(
    plan: Plan,
    band: Band,
    banks: list[Bank],
    baseband: NDArray[np.complex128],
    tones: list[Tone],
    start_s: float,
    receiver: str,
    windows: Mapping[str, tuple[float, float]],
    predictions: Mapping[str, Prediction],
) -> list[tuple[Burst, Detection]]:
    """All bursts of one band, loudest first, each with its echoes."""
    bursts: list[Burst] = []
    heard: list[_Heard] = []
    covariances: list[Floats] = []
    noise = np.zeros(0)
    residual = baseband - sum(tone.course for tone in tones)

    def accept(found: list[tuple[Bank, Peak]]) -> None:
        nonlocal bursts, covariances, residual, noise
        for bank, peak in found:
            beta = peak.range_rate_mps / plan.sound_speed_mps
            bursts.append(Burst(bank.waveform, peak.start_s + bank.waveform.duration_s / 2, beta, 0.0, 0j))
            heard.append(_Heard(bank, peak.power, peak.threshold, peak.power > peak.threshold * peak.noise))
        settle(ROUGH_ITERATIONS)

    def settle(iterations: int) -> None:
        """Refine all paths together on the stretch of samples in which any of them sounds."""
        nonlocal bursts, covariances, residual, noise, tones
        begin = min(b.arrival_s - b.waveform.duration_s / 2 - 2e-3 for b in bursts)
        end = max(b.arrival_s - b.waveform.duration_s / 2 + h.sounds_s for b, h in zip(bursts, heard, strict=True))
        first = max(0, int((begin - start_s) * band.rate_hz))
        last = int((end - start_s) * band.rate_hz) + 1
        clean = baseband - sum(tone.course for tone in tones)
        bursts, covariances, left, noise = refine(
            clean[first:last],
            start_s + first / band.rate_hz,
            band.rate_hz,
            bursts,
            plan.kappa_sd,
            band.whiteness,
            iterations,
        )
        residual = clean
        residual[first:last] = left
        if tones:
            heard_s = residual + sum(tone.course for tone in tones)
            tones = refit(tones, heard_s, band.rate_hz)
            residual = heard_s - sum(tone.course for tone in tones)

    for _ in range(MOST_ROUNDS):
        peaks: list[tuple[Bank, Peak]] = []
        for bank in banks:
            paths = [(b, h) for b, h in zip(bursts, heard, strict=True) if h.bank is bank]
            if len(paths) >= MOST_PATHS:
                continue
            known_s = [b.arrival_s - bank.waveform.duration_s / 2 for b, _ in paths]
            peak = _search(plan, band, bank, residual, start_s, windows, predictions, known_s)
            if peak is None or peak.power < (peak.threshold if paths else peak.worth_trying) * peak.noise:
                continue
            if peak.power > PATH_POWER * max((h.power for _, h in paths), default=0.0):
                peaks.append((bank, peak))
        if not peaks:
            break
        strongest = max(peak.power for _, peak in peaks)
        accept([(bank, peak) for bank, peak in peaks if peak.power >= NEAR_STRONGEST * strongest])
    while bursts:
        # interference from paths not yet found is gone now: only what stands above the last noise was really heard
        settle(FULL_ITERATIONS)
        power = np.array([abs(b.gain) ** 2 * h.bank.energy for b, h in zip(bursts, heard, strict=True)])
        sure = power > np.array([0.0 if h.clear else h.threshold for h in heard]) * noise
        if sure.all():
            break
        bursts = [b for b, keep in zip(bursts, sure, strict=True) if keep]
        heard = [h for h, keep in zip(heard, sure, strict=True) if keep]
    return _first_paths(bursts, heard, covariances, noise, baseband, start_s, band, receiver, windows)


def _first_paths(
    bursts: list[Burst],
    heard: list[_Heard],
    covariances: list[Floats],
    noise: Floats,
    baseband: NDArray[np.complex128],
    start_s: float,
    band: Band,
    receiver: str,
    windows: Mapping[str, tuple[float, float]],
) -> list[tuple[Burst, Detection]]:
    """Report each emitter by its first path of weight, where the samples hold that whole."""
    out = []
    for bank in {id(h.bank): h.bank for h in heard}.values():
        own = [i for i, h in enumerate(heard) if h.bank is bank]
        strongest = max(abs(bursts[i].gain) ** 2 for i in own)
        weighty = [i for i in own if abs(bursts[i].gain) ** 2 >= PATH_POWER * strongest]
        first = min(weighty, key=lambda i: bursts[i].arrival_s)
        paths = tuple(
            Path(
                bursts[i].arrival_s - bursts[first].arrival_s,
                float(20 * np.log10(abs(bursts[i].gain) / max(abs(bursts[first].gain), 1e-30) + 1e-9)),
            )
            for i in own
        )
        if _whole(bursts[first], baseband, start_s, band, windows[bank.emitter][0]):
            found = _detection(bursts[first], bank, receiver, covariances[first], float(noise[first]), band, paths)
            out.append((bursts[first], found))
    return out


def _search(
    plan: Plan,
    band: Band,
    bank: Bank,
    residual: NDArray[np.complexfloating],
    start_s: float,
    windows: Mapping[str, tuple[float, float]],
    predictions: Mapping[str, Prediction],
    known_s: list[float],
) -> Peak | None:
    opens_s, closes_s = windows[bank.emitter]
    rates = None
    expected = predictions.get(bank.emitter)
    if expected is not None:
        begins_s = expected.arrival_s - bank.waveform.duration_s / 2
        reach_s = 5 * expected.arrival_sd_s + 2 / band.rate_hz
        opens_s, closes_s = max(opens_s, begins_s - reach_s), min(closes_s, begins_s + reach_s)
        reach = 5 * expected.range_rate_sd_mps
        rates = (expected.range_rate_mps - reach, expected.range_rate_mps + reach)
    return search(residual, start_s, bank, band, opens_s, closes_s, rates, known_s, plan.false_alarm_rate)


def _whole(burst: Burst, baseband: NDArray[np.complex128], start_s: float, band: Band, opens_s: float) -> bool:
    """Whether the recording, which begins at 0, holds the burst from its first chip to its last.

    Where the epoch began before the recording, an earlier path of a burst near its beginning may have been missed.
    """
    half_s = burst.waveform.duration_s / 2
    end_s = start_s + len(baseband) / band.rate_hz
    guard_s = min(half_s, 5e-3) if opens_s < 0 else 0.0
    return burst.arrival_s - half_s >= max(start_s, guard_s) and burst.arrival_s + half_s <= end_s


def _detection(
    burst: Burst, bank: Bank, receiver: str, covariance: Floats, noise: float, band: Band, paths: tuple[Path, ...]
) -> Detection:
    # β and the time scale differ in sign
    sign = np.array([[1.0, -1.0], [-1.0, 1.0]])
    inside = slice(
        int(-burst.waveform.start_s * burst.waveform.rate_hz),
        int((burst.waveform.duration_s - burst.waveform.start_s) * burst.waveform.rate_hz),
    )
    power = abs(burst.gain) ** 2 * float(np.mean(np.abs(burst.waveform.envelope[inside]) ** 2))
    in_band = noise / band.whiteness
    return Detection(
        emitter=bank.emitter,
        receiver=receiver,
        arrival_s=burst.arrival_s,
        time_scale=1.0 - burst.beta,
        covariance=covariance * sign,
        amplitude=abs(burst.gain),
        snr_db=float(10 * np.log10(max(power, 1e-30) / in_band)),
        paths=paths,
    )
