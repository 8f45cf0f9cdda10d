"""Bursts of equal energy, coded and not, heard by our receiver and by the seed's filters, many times over.

A trial is a stretch of samples in which a burst sounds or none, in white noise and, where asked for, under a steady
tone on the very carrier. Our receiver knows neither when the burst comes nor how fast its sender moves. Filters are
told the start, the phase and the amplitude to the sample, which no radio message could; a matched filter told as much
of the coded burst stands beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sonofix.acquire.adaptive import Announced, desired, lms, mean_magnitude, nlms, rls
from sonofix.acquire.baseband import downconvert
from sonofix.acquire.plan import Plan, acquire, make_plan
from sonofix.acquire.search import search
from sonofix.acquire.tones import find_tones
from sonofix.records import Floats, Waveform
from sonofix.signals.codes import m_sequence, primitive_taps
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

RATE_HZ = 192e3
SPEED_MPS = 343.2
CARRIER_HZ = 40e3
DEGREE = 8
WINDOW_S = (0.03, 0.09)
"""When a burst may begin to be heard: 20 m of way."""

MAX_RATE_MPS = 3.0
NOISE_BAND_HZ = 4e3
"""A signal-to-noise ratio is a burst's mean power, first chip to last, over the noise in this band."""

FALSE_ALARM_RATE = 1e-4
"""What the receiver is planned for, per microphone and epoch, as in every run."""

RIGHT_M = 0.05

TAPS = 8
FILTERS: Mapping[str, Callable[[Floats, Floats, float], Floats]] = {
    "LMS": lambda x, d, power: lms(x, d, 0.02 / (TAPS * power), TAPS).output,
    "NLMS": lambda x, d, power: nlms(x, d, 0.02, TAPS).output,
    "RLS": lambda x, d, power: rls(x, d, TAPS, start=100.0 / power).output,
}
"""Outputs for input, desired signal, and the input's mean power, to which step and start are scaled."""

TOLD, SEARCHED = "code told", "code"
"""Detectors by code: told all that filters are told, and our receiver's search, which is told nothing."""

DETECTORS = (TOLD, SEARCHED, *FILTERS)
KINDS = ("present", "absent")


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """What trials share.

    Attributes
    ----------
    plan : Plan
        Of the receiver for one robot's code.
    waveform : Waveform
    noise_sd : float
        Of the samples, for a burst of unit gain.
    power : float
        Mean power of a burst of unit gain, first chip to last.
    carrier : float64 (2, n)
        Orthonormal sine and cosine of the carrier over a whole trial of n samples.
    """

    plan: Plan
    waveform: Waveform
    noise_sd: float
    power: float
    carrier: Floats

    @property
    def length(self) -> int:
        """Samples in a trial."""
        return self.carrier.shape[1]


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Scores of trials with a burst and without, by detector, (batches, trials): the higher, the more believed."""

    present: dict[str, Floats]
    absent: dict[str, Floats]


def bench(snr_db: float) -> Bench:
    """Plan trials with an m-sequence of 255 chips, keyed on and off, at a signal-to-noise ratio."""
    signal = Signal(carrier_hz=CARRIER_HZ, cycles_per_chip=10, bandwidth_hz=4e3)
    waveform = keyed_waveform(m_sequence(DEGREE, list(primitive_taps(DEGREE)[0])), signal)
    plan = make_plan({"R1": waveform}, RATE_HZ, SPEED_MPS, MAX_RATE_MPS, false_alarm_rate=FALSE_ALARM_RATE)
    time_s = np.linspace(0.0, waveform.duration_s, 20000)
    power = float(np.mean(np.abs(sample(waveform.envelope, waveform.rate_hz, waveform.start_s, time_s)) ** 2)) / 2
    noise_sd = float(np.sqrt(power / 10 ** (snr_db / 10) * (RATE_HZ / 2) / NOISE_BAND_HZ))
    length = int((WINDOW_S[1] + plan.burst_s + plan.margin_s) * RATE_HZ)
    turns = 2 * np.pi * CARRIER_HZ * np.arange(length) / RATE_HZ
    carrier, _ = np.linalg.qr(np.stack([np.sin(turns), np.cos(turns)]).T)
    return Bench(plan, waveform, noise_sd, power, np.ascontiguousarray(carrier.T))


def noise_and_tone(bench: Bench, tone_db: float | None, rng: np.random.Generator) -> Floats:
    """Samples (n,) of noise, under a tone of random phase so far above a burst's mean power; None: no tone."""
    out = bench.noise_sd * rng.standard_normal(bench.length)
    phase = 2 * np.pi * rng.uniform()
    if tone_db is not None:
        amplitude = np.sqrt(2 * bench.power * 10 ** (tone_db / 10))
        out += amplitude * np.sin(2 * np.pi * CARRIER_HZ * np.arange(bench.length) / RATE_HZ + phase)
    return out


def coded(bench: Bench, rng: np.random.Generator) -> tuple[Floats, float]:
    """A coded burst's samples (n,), and when its middle is heard; delay, phase and range rate are drawn."""
    w = bench.waveform
    begins_s, rate_mps, phase = rng.uniform(*WINDOW_S), rng.uniform(-MAX_RATE_MPS, MAX_RATE_MPS), rng.uniform()
    arrival_s = begins_s + w.duration_s / 2
    tau = w.duration_s / 2 + (1 - rate_mps / SPEED_MPS) * (np.arange(bench.length) / RATE_HZ - arrival_s)
    envelope = sample(w.envelope, w.rate_hz, w.start_s, tau)
    return (envelope * np.exp(2j * np.pi * (w.carrier_hz * tau + phase))).real, arrival_s


def heard_right(bench: Bench, samples: Floats, arrival_s: float | None) -> tuple[bool, bool]:
    """Whether the receiver reports the burst within `RIGHT_M`, and whether it reports anything that is not there."""
    scaled = (samples / np.abs(samples).max()).astype(np.float32)
    found, _ = acquire(bench.plan, scaled, 0, "K", {"R1": WINDOW_S})
    near = [arrival_s is not None and abs(d.arrival_s - arrival_s) * SPEED_MPS <= RIGHT_M for d in found]
    return any(near), not all(near)


def code_score(bench: Bench, samples: Floats) -> float:
    """Highest correlation power over the noise, tones taken out: what the receiver's search stands on."""
    ((band, (bank,)),) = bench.plan.bands
    baseband, start_s = downconvert((samples / np.abs(samples).max()).astype(np.float32), 0, band)
    left = baseband - sum((tone.course for tone in find_tones(baseband, band.rate_hz)), np.zeros_like(baseband))
    peak = search(left, start_s, bank, band, *WINDOW_S, [], FALSE_ALARM_RATE)
    return 0.0 if peak is None else peak.power / peak.noise


def told_score(bench: Bench, samples: Floats, burst: Floats) -> float:
    """Correlation with the very burst, all that goes steadily on the carrier taken out: a matched filter told all."""
    return float(samples @ (burst - bench.carrier.T @ (bench.carrier @ burst)))


def filter_scores(bench: Bench, rng: np.random.Generator, tone_db: float | None) -> tuple[list[float], list[float]]:
    """Scores of all filters, with a burst of plain carrier and without, in one stretch of noise each.

    The burst has the coded one's length and energy. A score is how near the output's mean magnitude comes to that of
    the desired signal, the seed's amplitude matching with its band left open.
    """
    count = round(bench.waveform.duration_s * RATE_HZ)
    announced = Announced(CARRIER_HZ, float(np.sqrt(2 * bench.power)), "sine")
    wanted = desired(announced, 1.0, np.arange(count) / RATE_HZ)
    expected = mean_magnitude(wanted)
    scores = []
    for burst in (wanted, 0.0):
        heard = noise_and_tone(bench, tone_db, rng)[:count] + burst
        # from radio and the converter: the level of all that is heard is known
        power = float(np.mean(heard**2))
        scores.append([-abs(mean_magnitude(f(heard, wanted, power)) - expected) for f in FILTERS.values()])
    return scores[0], scores[1]


def scored(bench: Bench, batch: int, seed: int, trials: int, tone_db: float | None) -> Scores:
    """Score so many trials of one batch by all detectors; (1, trials) each."""
    rng = np.random.default_rng([seed, 6, batch])
    present, absent = [], []
    for _ in range(trials):
        burst, _ = coded(bench, rng)
        with_burst, without = filter_scores(bench, rng, tone_db)
        for rows, sounding, filtered in ((present, burst, with_burst), (absent, 0.0, without)):
            samples = noise_and_tone(bench, tone_db, rng) + sounding
            rows.append([told_score(bench, samples, burst), code_score(bench, samples), *filtered])
    shaped = ({name: np.array(rows)[None, :, i] for i, name in enumerate(DETECTORS)} for rows in (present, absent))
    return Scores(*shaped)


def joined(parts: Sequence[Scores]) -> Scores:
    """All batches together, a row each."""
    return Scores(
        *({name: np.concatenate([getattr(p, kind)[name] for p in parts]) for name in DETECTORS} for kind in KINDS)
    )


def decided(bench: Bench, batch: int, seed: int, trials: int, tone_db: float) -> tuple[Floats, Floats]:
    """Whether the receiver missed coded bursts, and whether it reported what was not there, (1, trials) each.

    Each trial listens twice, with a burst and without; a report at a wrong place counts as false alarm in the first.
    """
    rng = np.random.default_rng([seed, 7, batch])
    missed, alarmed = np.zeros((1, trials)), np.zeros((1, trials))
    for k in range(trials):
        burst, arrival_s = coded(bench, rng)
        right, wrong = heard_right(bench, noise_and_tone(bench, tone_db, rng) + burst, arrival_s)
        _, silent = heard_right(bench, noise_and_tone(bench, tone_db, rng), None)
        missed[0, k], alarmed[0, k] = not right, wrong or silent
    return missed, alarmed


def detected(scores: Scores, name: str, false_alarms: Floats) -> Floats:
    """Share of bursts detected (k,) at thresholds that let through shares (k,) of the trials without one."""
    threshold = np.quantile(scores.absent[name], 1.0 - np.asarray(false_alarms), method="higher")
    return np.mean(scores.present[name].ravel() > threshold[:, None], axis=1)


def at_most(count: int, trials: int, confidence: float = 0.95) -> float:
    """Upper bound of a probability where an event happened so often (Clopper & Pearson 1934, one-sided)."""
    from scipy.stats import beta

    return 1.0 if count >= trials else float(beta.ppf(confidence, count + 1, trials - count))
