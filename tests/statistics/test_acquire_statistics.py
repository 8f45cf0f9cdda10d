"""Does the receiver keep its statistical promises: false alarms, Fisher's bound, and the deviations it states?

The bound is computed here from the samples' own model at full rate, by differences, and shares no code with the
receiver. Each trial draws delay, phase and range acceleration anew. Intervals hold with a probability of 0.9999 for
the number of trials; `prove` runs the long versions and prints their tables.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix.acquire.plan import Plan, acquire, make_plan
from sonofix.records import Detection, Floats
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SPEED = 343.2
RATE_HZ = 48e3
COUNT = int(0.16 * RATE_HZ)
SIGNAL = Signal(carrier_hz=15e3, cycles_per_chip=8, bandwidth_hz=3e3)
WAVEFORMS = {
    name: keyed_waveform(codes.m_sequence(7, list(taps)), SIGNAL)
    for name, taps in zip("ABCD", codes.primitive_taps(7), strict=False)
}
WINDOW = (0.02, 0.06)
HALF_S = WAVEFORMS["A"].duration_s / 2
ACCELERATION_MPS2 = 2.0
MISS = 1e-4
"""Probability that a sound receiver fails one of these."""


def plan_of(names: str, false_alarm_rate: float = 1e-4) -> Plan:
    waveforms = {name: WAVEFORMS[name] for name in names}
    return make_plan(waveforms, RATE_HZ, SPEED, 3.0, ACCELERATION_MPS2, false_alarm_rate)


@dataclass(frozen=True, slots=True)
class Sound:
    emitter: str
    arrival_s: float
    rate_mps: float
    acceleration_mps2: float
    gain: complex


def model(s: Sound) -> NDArray[np.complex128]:
    """Analytic samples: their real part is heard."""
    w = WAVEFORMS[s.emitter]
    u = np.arange(COUNT) / RATE_HZ - s.arrival_s
    tau = w.duration_s / 2 + u - s.rate_mps / SPEED * u - s.acceleration_mps2 / SPEED / 2 * u**2
    return s.gain * sample(w.envelope, w.rate_hz, w.start_s, tau) * np.exp(2j * np.pi * w.carrier_hz * tau)


def bound(sounds: list[Sound], noise_sd: float) -> Floats:
    """Cramér–Rao bound of (arrival_s, range rate) of each sound, both unknown gains and curvature in all: (n, 2, 2).

    Range acceleration has a normal prior (the Bayesian information of Van Trees 1968, section 2.4).
    """
    rows = []
    for s in sounds:
        unit = model(Sound(s.emitter, s.arrival_s, s.rate_mps, s.acceleration_mps2, 1.0))
        rows += [unit.real, -unit.imag]
        here = np.array([s.arrival_s, s.rate_mps, s.acceleration_mps2])
        for step in np.diag([1e-7, 1e-5, 1e-3]):
            ahead, behind = (model(Sound(s.emitter, *(here + x), s.gain)).real for x in (step, -step))
            rows.append((ahead - behind) / (2 * step.sum()))
    jacobian = np.array(rows)
    information = jacobian @ jacobian.T / noise_sd**2
    held = 5 * np.arange(len(sounds)) + 4
    information[held, held] += 1 / ACCELERATION_MPS2**2
    scale = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.array([covariance[5 * i + 2 : 5 * i + 4, 5 * i + 2 : 5 * i + 4] for i in range(len(sounds))])


def drawn(emitter: str, gain: float, rate_mps: float, rng: np.random.Generator) -> Sound:
    phase = np.exp(2j * np.pi * rng.uniform())
    arrival_s = rng.uniform(*WINDOW) + HALF_S
    return Sound(emitter, arrival_s, rate_mps, ACCELERATION_MPS2 * rng.standard_normal(), gain * phase)


def heard(plan: Plan, sounds: list[Sound], noise_sd: float, rng: np.random.Generator) -> dict[str, Detection]:
    samples = np.sum([np.zeros(COUNT), *(model(s).real for s in sounds)], axis=0)
    samples = (samples + noise_sd * rng.standard_normal(COUNT)).astype(np.float32)
    windows = {bank.emitter: WINDOW for _, banks in plan.bands for bank in banks}
    return {d.emitter: d for d in acquire(plan, samples, 0, "M", windows)[0]}


@dataclass(frozen=True, slots=True)
class Outcome:
    """Errors (n, 2) of arrival (s) and range rate (m/s) of the bursts found, beside bound and stated covariances."""

    trials: int
    error: Floats
    bound: Floats
    stated: Floats

    @property
    def over_bound(self) -> Floats:
        """Rms error over the rms bound, of arrival and range rate."""
        return np.sqrt(np.mean(self.error**2 / np.diagonal(self.bound, axis1=1, axis2=2), axis=0))

    @property
    def over_stated(self) -> Floats:
        """Rms of error over stated deviation."""
        return np.sqrt(np.mean(self.error**2 / np.diagonal(self.stated, axis1=1, axis2=2), axis=0))


def trials(
    count: int,
    gains: dict[str, float],
    noise_sd: float,
    rng: np.random.Generator,
    watched: str = "A",
    rate_mps: float | None = None,
) -> Outcome:
    plan = plan_of("".join(gains))
    errors, bounds, stated = [], [], []
    for _ in range(count):
        sounds = [drawn(e, g, rng.uniform(-2.5, 2.5) if rate_mps is None else rate_mps, rng) for e, g in gains.items()]
        found = heard(plan, sounds, noise_sd, rng).get(watched)
        if found is None:
            continue
        at = list(gains).index(watched)
        sound = sounds[at]
        errors.append([found.arrival_s - sound.arrival_s, (1 - found.time_scale) * SPEED - sound.rate_mps])
        bounds.append(bound(sounds, noise_sd)[at])
        stated.append(found.covariance * np.array([[1, -SPEED], [-SPEED, SPEED**2]]))
    return Outcome(count, np.array(errors), np.array(bounds), np.array(stated))


def rms_interval(count: int) -> tuple[float, float]:
    """Within which the rms of so many standard normal errors lies, but for `MISS`: from χ² of ``count`` degrees."""
    from scipy.stats import chi2

    low, high = chi2.ppf([MISS / 2, 1 - MISS / 2], count)
    return float(np.sqrt(low / count)), float(np.sqrt(high / count))


LOST = 1.01
"""By the standard deviation: the pass band holds 99 % of the energy that carries the delay; a half of 1 %, rounded up
for what folds."""


def noise_for(snr_db: float, gain: float = 1.0) -> float:
    """Noise whose power over the whole band, to half the sample rate, is so far below the burst's mean power."""
    w = WAVEFORMS["A"]
    envelope = sample(w.envelope, w.rate_hz, w.start_s, np.linspace(0, w.duration_s, 5000))
    power = gain**2 * float(np.mean(np.abs(envelope) ** 2)) / 2
    return float(np.sqrt(power / 10 ** (snr_db / 10)))


@pytest.mark.parametrize("snr_db", [0.0, 20.0])
def test_errors_reach_the_bound(snr_db: float, rng: np.random.Generator) -> None:
    count = 150
    outcome = trials(count, {"A": 1.0}, noise_for(snr_db), rng)
    assert len(outcome.error) == count
    low, high = rms_interval(count)
    assert (outcome.over_bound > low).all()
    assert (outcome.over_bound < high * LOST).all()


@pytest.mark.parametrize("snr_db", [0.0, 20.0])
def test_stated_deviations_are_honest(snr_db: float, rng: np.random.Generator) -> None:
    count = 150
    outcome = trials(count, {"A": 1.0, "B": 0.2}, noise_for(snr_db), rng, watched="B" if snr_db > 10 else "A")
    assert len(outcome.error) == count
    low, high = rms_interval(count)
    assert (outcome.over_stated > low).all()
    assert (outcome.over_stated < high).all()
    # both together, their correlation included: squared Mahalanobis distance of two degrees of freedom
    whole = np.einsum("ni,nij,nj->n", outcome.error, np.linalg.inv(outcome.stated), outcome.error)
    low, high = rms_interval(2 * count)
    assert low**2 < whole.mean() / 2 < high**2
    # nor is either end biased: the mean of n errors over their deviations is normal of deviation 1/sqrt(n)
    bias = np.mean(outcome.error / np.sqrt(np.diagonal(outcome.stated, axis1=1, axis2=2)), axis=0)
    assert (np.abs(bias) < 4.0 / np.sqrt(count)).all()


def alarms(plan: Plan, count: int, rng: np.random.Generator, sounds: list[Sound] | None = None) -> int:
    silent = {bank.emitter for _, banks in plan.bands for bank in banks} - {s.emitter for s in sounds or []}
    return sum(len(silent & set(heard(plan, sounds or [], 0.1, rng))) for _ in range(count))


def most(count: int, probability: float) -> int:
    """Number of alarms that a receiver which keeps its promise exceeds with probability `MISS` at most."""
    from scipy.stats import binom

    return int(binom.ppf(1 - MISS, count, probability))


@pytest.mark.parametrize("stated", [1e-4, 1e-2])
def test_silent_beacons_are_reported_no_oftener_than_stated(stated: float, rng: np.random.Generator) -> None:
    count = 300
    assert alarms(plan_of("A", stated), count, rng) <= most(count, stated)


def test_a_loud_beacon_does_not_raise_silent_ones(rng: np.random.Generator) -> None:
    """Its cross-talk stands 20 dB above the noise before it is taken away, and nowhere after."""
    count = 100
    plan = plan_of("AB", 1e-3)
    loud = sum(alarms(plan, 1, rng, [drawn("A", 3.0, rng.uniform(-2.5, 2.5), rng)]) for _ in range(count))
    assert loud <= most(count, 1e-3)


def told(title: str, header: list[str], rows: list[list[str]]) -> None:
    print(f"\n{title}\n\n| {' | '.join(header)} |\n|{'---|' * len(header)}")
    for row in rows:
        print(f"| {' | '.join(row)} |")


@pytest.mark.prove
def test_table_of_errors_over_the_bound(rng: np.random.Generator) -> None:
    count = 1000
    low, high = rms_interval(count)
    rows = []
    for snr_db in (-20.0, -17.5, -15.0, -10.0, -5.0, 0.0, 10.0, 20.0, 30.0):
        outcome = trials(count, {"A": 1.0}, noise_for(snr_db), rng)
        share = len(outcome.error) / count
        rmse = np.sqrt(np.mean(outcome.error**2, axis=0)) if len(outcome.error) else np.full(2, np.nan)
        over, stated = outcome.over_bound, outcome.over_stated
        rows.append(
            [f"{snr_db:g} dB", f"{100 * share:.1f} %", f"{1e3 * SPEED * rmse[0]:.3g} mm", f"{over[0]:.3f}"]
            + [f"{1e3 * rmse[1]:.3g} mm/s", f"{over[1]:.3f}", f"{stated[0]:.3f}", f"{stated[1]:.3f}"]
        )
        if snr_db >= -5.0:
            assert share == 1.0
            assert (over > low).all()
            assert (over < high * LOST).all()
            assert (stated > low).all()
            assert (stated < high * LOST).all()
    header = ["SNR (whole band)", "found", "range rmse", "over bound", "rate rmse", "over bound"]
    header += ["range error over sd", "rate error over sd"]
    told(f"Errors over the Cramér–Rao bound, {count} bursts a row (interval {low:.3f} … {high:.3f})", header, rows)


@pytest.mark.prove
def test_table_of_velocities(rng: np.random.Generator) -> None:
    count = 1000
    low, high = rms_interval(count)
    rows = []
    for rate_mps in (-3.0, -2.0, -1.0, -0.3, 0.0, 0.3, 1.0, 2.0, 3.0):
        outcome = trials(count, {"A": 1.0}, noise_for(10.0), rng, rate_mps=rate_mps)
        over = outcome.over_bound
        bias = np.mean(outcome.error, axis=0)
        rows.append(
            [f"{rate_mps:g} m/s", f"{len(outcome.error)}", f"{over[0]:.3f}", f"{over[1]:.3f}"]
            + [f"{1e3 * SPEED * bias[0]:+.4f} mm", f"{1e3 * bias[1]:+.4f} mm/s"]
        )
        assert len(outcome.error) == count
        assert (over > low).all()
        assert (over < high * LOST).all()
    header = [
        "range rate",
        "found",
        "range rmse over bound",
        "rate rmse over bound",
        "mean error",
        "mean error of rate",
    ]
    told(f"Moving sources at 10 dB, {count} bursts a row (interval {low:.3f} … {high:.3f})", header, rows)


@pytest.mark.prove
def test_table_of_false_alarms(rng: np.random.Generator) -> None:
    rows = []
    for stated, count in ((1e-4, 6000), (1e-3, 6000), (1e-2, 4000), (1e-1, 2000)):
        number = alarms(plan_of("A", stated), count, rng)
        rows.append([f"{stated:g}", f"{count}", f"{number}", f"{number / count:.2g}", f"{most(count, stated)}"])
        assert number <= most(count, stated)
    told(
        "False alarms of a silent beacon in noise alone",
        ["stated, an epoch", "epochs", "alarms", "rate", f"most allowed (p = {MISS:g})"],
        rows,
    )


@pytest.mark.prove
def test_table_of_near_and_far(rng: np.random.Generator) -> None:
    """The far beacon at 0 dB over the noise, the near one louder and louder."""
    count = 400
    low, high = rms_interval(count)
    rows = []
    for louder_db in (0.0, 10.0, 20.0, 30.0, 40.0):
        outcome = trials(count, {"A": 1.0, "B": 10 ** (louder_db / 20)}, noise_for(0.0), rng)
        over, stated = outcome.over_bound, outcome.over_stated
        share = len(outcome.error) / count
        rows.append(
            [f"{louder_db:g} dB", f"{100 * share:.1f} %", f"{over[0]:.3f}", f"{over[1]:.3f}"]
            + [f"{stated[0]:.3f}", f"{stated[1]:.3f}"]
        )
        if louder_db <= 30.0:
            assert share == 1.0
            assert (over < high * LOST).all()
    header = ["near beacon louder by", "far one found", "range rmse over bound", "rate rmse over bound"]
    header += ["range error over sd", "rate error over sd"]
    told(f"Near and far, {count} epochs a row (interval {low:.3f} … {high:.3f})", header, rows)
