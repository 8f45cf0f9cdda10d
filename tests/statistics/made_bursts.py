"""Made-up epochs of bursts with known truth, many at a time, and Fisher's bound for them.

The bound is computed from the samples' own model at full rate, by differences, and shares no code with the receiver.
A signal-to-noise ratio is the mean power of a burst, from its first chip to its last, over the noise in 4 kHz.
"""

from __future__ import annotations

import sys
import zlib
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.plan import Plan, acquire, make_plan
from sonofix.records import Floats, Prediction, Waveform
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SPEED = 343.2
RATE_HZ = 192e3
SIGNAL = Signal(carrier_hz=40e3, cycles_per_chip=10, bandwidth_hz=4e3)
NOISE_BAND_HZ = 4e3
WINDOW = (0.03, 0.09)
"""When bursts begin to be heard: 20 m of hall."""

MAX_RATE_MPS = 3.0
ACCELERATION_SD_MPS2 = 4.0
"""Deviation of range acceleration that the receiver takes for granted (`make_plan`'s)."""

RATE_SD_MPS = 0.05
"""Of a warm search's prediction."""

PLANNED = 8
WRONG_M = 0.05


@cache
def waveforms(degree: int) -> dict[str, Waveform]:
    """Eight m-sequences, by letter."""
    taps = codes.primitive_taps(degree)
    return {
        name: keyed_waveform(codes.m_sequence(degree, list(one)), SIGNAL)
        for name, one in zip("ABCDEFGH", taps, strict=False)
    }


@cache
def plan_of(degree: int, names: str, false_alarm_rate: float = 1e-4) -> Plan:
    bursts = {name: waveforms(degree)[name] for name in names}
    return make_plan(bursts, RATE_HZ, SPEED, MAX_RATE_MPS, ACCELERATION_SD_MPS2, false_alarm_rate)


@dataclass(frozen=True, slots=True)
class Sound:
    """One burst: when its middle is heard, its motion then, and its complex gain."""

    emitter: str
    arrival_s: float
    rate_mps: float
    acceleration_mps2: float
    gain: complex


def model(degree: int, s: Sound, time_s: Floats) -> NDArray[np.complex128]:
    """Analytic samples at ``time_s``: their real part is heard."""
    w = waveforms(degree)[s.emitter]
    u = time_s - s.arrival_s
    tau = w.duration_s / 2 + u - s.rate_mps / SPEED * u - s.acceleration_mps2 / SPEED / 2 * u**2
    return s.gain * sample(w.envelope, w.rate_hz, w.start_s, tau) * np.exp(2j * np.pi * w.carrier_hz * tau)


def noise_for(degree: int, snr_db: float) -> float:
    """Deviation of white noise at the full rate for a burst of unit gain."""
    w = waveforms(degree)["A"]
    envelope = sample(w.envelope, w.rate_hz, w.start_s, np.linspace(0, w.duration_s, 20000))
    power = float(np.mean(np.abs(envelope) ** 2)) / 2
    return float(np.sqrt(power / 10 ** (snr_db / 10) * (RATE_HZ / 2) / NOISE_BAND_HZ))


@cache
def bound(degree: int, emitter: str, rate_mps: float, noise_sd: float) -> Floats:
    """Cramér–Rao bound of (arrival s, range rate m/s) of one burst of unit gain, (2, 2).

    Complex gain (so the carrier's phase) and range acceleration are unknown too; that has a normal prior (the Bayesian
    information of Van Trees 1968, section 2.4).
    """
    half_s = waveforms(degree)[emitter].duration_s / 2
    time_s = np.arange(int((2 * half_s + 0.02) * RATE_HZ)) / RATE_HZ
    here = np.array([half_s + 0.008, rate_mps, 0.0])

    def unit(where: Floats) -> NDArray[np.complex128]:
        return model(degree, Sound(emitter, float(where[0]), float(where[1]), float(where[2]), 1.0), time_s)

    plain = unit(here)
    rows = [plain.real, -plain.imag]
    for step in np.diag([1e-7, 1e-5, 1e-3]):
        ahead, behind = (unit(here + x).real for x in (step, -step))
        rows.append((ahead - behind) / (2 * step.sum()))
    jacobian = np.array(rows)
    information = jacobian @ jacobian.T / noise_sd**2
    information[4, 4] += 1 / ACCELERATION_SD_MPS2**2
    scale = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return covariance[2:4, 2:4]


@dataclass(frozen=True, slots=True)
class Case:
    """What sounds in an epoch.

    ``louder_db`` holds one entry a sounding beacon; one at 0 dB has the signal-to-noise ratio ``snr_db``. Others of
    ``planned`` are silent. ``rate_mps`` None: drawn within ±3 m/s. ``expected_m`` is the deviation of a prediction's
    range, None for a cold search.
    """

    degree: int
    snr_db: float
    louder_db: tuple[float, ...] = (0.0,)
    planned: int = 1
    rate_mps: float | None = None
    acceleration_mps2: float = 0.0
    expected_m: float | None = None
    false_alarm_rate: float = 1e-4

    @property
    def names(self) -> str:
        return "ABCDEFGH"[: self.planned]

    @property
    def noise_sd(self) -> float:
        return noise_for(self.degree, self.snr_db)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What came of many epochs: a row an epoch, a column a sounding beacon; NaN where it was not found.

    ``error`` (n, k, 2) of arrival (s) and range rate (m/s), ``stated`` (n, k, 2, 2) their covariance, ``bound`` (n, k,
    2) the variances that Fisher's bound has for each alone; ``alarms`` (n,) silent beacons reported.
    """

    error: Floats
    stated: Floats
    bound: Floats
    alarms: NDArray[np.int64]

    @property
    def found(self) -> NDArray[np.bool_]:
        return np.isfinite(self.error[..., 0])

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """Ranges off by more than 5 cm."""
        return np.abs(np.nan_to_num(SPEED * self.error[..., 0])) > WRONG_M

    def over_bound(self, which: NDArray[np.bool_] | None = None) -> Floats:
        """Rms error over the rms bound, of arrival and range rate, of all found (or those of ``which``)."""
        which = self.found if which is None else which
        return np.sqrt(np.mean(self.error[which] ** 2, axis=0) / np.mean(self.bound[which], axis=0))

    def over_stated(self) -> Floats:
        """Errors over their stated deviations (m, 2)."""
        deviation = np.sqrt(np.diagonal(self.stated[self.found], axis1=1, axis2=2))
        return self.error[self.found] / deviation

    def rmse_m(self, which: NDArray[np.bool_] | None = None) -> float:
        """Of range."""
        error = self.error[self.found if which is None else which, 0]
        return float(SPEED * np.sqrt(np.mean(error**2))) if len(error) else float("nan")


def epochs(case: Case, count: int, seed: np.random.SeedSequence) -> Outcome:
    """Draw, render and acquire so many epochs."""
    rng = np.random.default_rng(seed)
    plan = plan_of(case.degree, case.names, case.false_alarm_rate)
    half_s = waveforms(case.degree)["A"].duration_s / 2
    length = int((WINDOW[1] + plan.burst_s + plan.margin_s) * RATE_HZ)
    windows = dict.fromkeys(case.names, WINDOW)
    beacons = len(case.louder_db)
    error = np.full((count, beacons, 2), np.nan)
    stated, limits = np.full((count, beacons, 2, 2), np.nan), np.full((count, beacons, 2), np.nan)
    alarms = np.zeros(count, np.int64)
    for n in range(count):
        sounding = rng.permutation(list(case.names))[:beacons]
        sounds = [
            _drawn(case, str(name), louder, half_s, rng) for name, louder in zip(sounding, case.louder_db, strict=True)
        ]
        samples = case.noise_sd * rng.standard_normal(length, np.float32)
        for s in sounds:
            first = int((s.arrival_s - 1.05 * half_s - 2e-3) * RATE_HZ)
            last = min(length, int((s.arrival_s + 1.05 * half_s + 5e-3) * RATE_HZ))
            samples[first:last] += model(case.degree, s, np.arange(first, last) / RATE_HZ).real.astype(np.float32)
        # a full scale of 1, as recorders have
        samples /= np.float32(np.abs(samples).max())
        expected = None if case.expected_m is None else _expected(case, case.expected_m, sounds, half_s, rng)
        heard = {d.emitter: d for d in acquire(plan, samples, 0, "M", windows, expected)[0]}
        alarms[n] = len(set(heard) - set(sounding))
        for k, s in enumerate(sounds):
            limits[n, k] = np.diag(bound(case.degree, s.emitter, round(s.rate_mps), case.noise_sd / abs(s.gain)))
            if (d := heard.get(s.emitter)) is not None:
                error[n, k] = d.arrival_s - s.arrival_s, (1 - d.time_scale) * SPEED - s.rate_mps
                stated[n, k] = d.covariance * np.array([[1, -SPEED], [-SPEED, SPEED**2]])
    return Outcome(error, stated, limits, alarms)


def _drawn(case: Case, name: str, louder_db: float, half_s: float, rng: np.random.Generator) -> Sound:
    rate = rng.uniform(-MAX_RATE_MPS, MAX_RATE_MPS) if case.rate_mps is None else case.rate_mps
    gain = 10 ** (louder_db / 20) * np.exp(2j * np.pi * rng.uniform())
    return Sound(name, rng.uniform(*WINDOW) + half_s, rate, case.acceleration_mps2, gain)


def _expected(
    case: Case, sd_m: float, sounds: list[Sound], half_s: float, rng: np.random.Generator
) -> dict[str, Prediction]:
    """Predictions of all beacons planned, honest for those that sound; silent ones are expected somewhere."""
    out = {}
    for name in case.names:
        s = next((s for s in sounds if s.emitter == name), None)
        arrival_s = rng.uniform(*WINDOW) + half_s if s is None else s.arrival_s + sd_m / SPEED * rng.standard_normal()
        rate_mps = 0.0 if s is None else s.rate_mps + RATE_SD_MPS * rng.standard_normal()
        out[name] = Prediction(name, "M", arrival_s, sd_m / SPEED, rate_mps, RATE_SD_MPS)
    return out


CHUNKS = 8


def many(case: Case, count: int, seed: int, workers: Executor | None = None) -> Outcome:
    """As `epochs`, shared among workers; the same whatever their number. Says on stderr what it has done."""
    seeds = np.random.SeedSequence([seed, zlib.crc32(repr(case).encode())]).spawn(CHUNKS)
    each = [count // CHUNKS + (i < count % CHUNKS) for i in range(CHUNKS)]
    if workers is None:
        parts = [epochs(case, n, s) for n, s in zip(each, seeds, strict=True) if n]
    else:
        parts = list(workers.map(epochs, [case] * CHUNKS, each, seeds))
        print(f"  {count} epochs of {case}", file=sys.stderr, flush=True)
    return Outcome(
        *(np.concatenate([getattr(part, field) for part in parts]) for field in ("error", "stated", "bound", "alarms"))
    )
