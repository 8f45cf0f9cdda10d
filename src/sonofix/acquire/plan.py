"""The acquisition plan: everything about a site's bursts that can be computed before the first sample comes.

What is done with it, epoch by epoch, stands in `separate`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.bank import Bank, make_bank
from sonofix.acquire.baseband import Band, band_limited, design_band, downconvert
from sonofix.acquire.epochs import missing_runs
from sonofix.acquire.separate import Separation, Watch
from sonofix.acquire.tones import MARGIN_S, find_tones, level_db, told
from sonofix.records import Detection, Prediction, Waveform


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
    max_acceleration_mps2: float = 4.0,
    false_alarm_rate: float = 1e-4,
) -> Plan:
    """Plan the acquisition of a set of beacons.

    Parameters
    ----------
    waveforms : mapping from emitter id to Waveform
    max_rate_mps : float
        Range rates searched: ±.
    max_acceleration_mps2 : float
        One-sigma range acceleration within a burst (a pass at 3 m/s and 2 m gives 4.5 m/s²).

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
    everywhere: bool = True,
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
    everywhere : bool
        Whether to search everywhere where nothing comes as predicted.

    Returns
    -------
    detections : tuple of Detection, strongest first
    notes : tuple of str
        What was done to the samples before.

    Raises
    ------
    ValueError
        If samples are not finite; `epochs.screen` makes them so.
    """
    if not np.isfinite(samples).all():
        bad = int(np.sum(~np.isfinite(samples)))
        raise ValueError(f"{bad} of {samples.size} samples are not finite; pass them through epochs.screen first")
    notes: list[str] = []
    found: list[Detection] = []
    for job in taken_apart(plan, samples, first_sample, windows, predictions, everywhere=everywhere):
        notes += job.notes
        found += job.detections(receiver)
    found.sort(key=lambda detection: -detection.amplitude)
    return tuple(found), tuple(notes)


def taken_apart(
    plan: Plan,
    samples: NDArray[np.float32],
    first_sample: int,
    windows: Mapping[str, tuple[float, float]],
    predictions: Mapping[str, Prediction] | None = None,
    watch: Watch | None = None,
    everywhere: bool = True,
) -> Iterator[Separation]:
    """Do the work of `acquire` and yield it, band by band; ``watch`` is told each step of it."""
    unrecorded = missing_runs(samples, plan.sample_rate_hz)
    for band, banks in plan.bands:
        baseband, start_s = downconvert(samples, first_sample, band)
        if not len(baseband):
            continue
        tones = find_tones(baseband, band.rate_hz)
        missing = np.zeros(len(baseband), bool)
        for begin, end in unrecorded:
            # an output of the filter rests on as many samples as it has taps
            missing[max(0, (begin - len(band.taps)) // band.decimation + 1) : end // band.decimation + 1] = True
        job = Separation(
            band,
            [b for b in banks if b.emitter in windows],
            baseband,
            start_s,
            tones,
            windows,
            sound_speed_mps=plan.sound_speed_mps,
            kappa_sd=plan.kappa_sd,
            false_alarm_rate=plan.false_alarm_rate,
            watch=watch,
            missing=missing,
        )
        left = baseband - sum(tone.course for tone in tones)
        for tone in tones:
            job.notes.append(told(band.carrier_hz + tone.offset_hz, level_db(tone, left)))
        job.run(predictions or {}, everywhere)
        yield job
