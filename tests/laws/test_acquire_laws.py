"""What holds for every epoch: bursts come back as they were made, and moving or scaling samples does just that."""

from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sonofix.acquire.plan import Plan, acquire, make_plan
from sonofix.records import Detection, Waveform
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SPEED = 343.2
RATE_HZ = 48e3
COUNT = int(0.13 * RATE_HZ)
CODES = (*((6, taps) for taps in codes.primitive_taps(6)), *((5, taps) for taps in codes.primitive_taps(5)))


@cache
def planned(code: int, modulation: str, cycles: int) -> tuple[Waveform, Plan]:
    degree, taps = CODES[code]
    signal = {"carrier_hz": 15e3, "modulation": modulation, "cycles_per_chip": cycles, "bandwidth_hz": 3e3}
    w = keyed_waveform(codes.m_sequence(degree, list(taps)), Signal.model_validate(signal))
    return w, make_plan({"A": w}, RATE_HZ, SPEED, max_rate_mps=3.0)


def rendered(w: Waveform, arrival_s: float, rate_mps: float, gain: complex) -> NDArray[np.float32]:
    u = np.arange(COUNT) / RATE_HZ - arrival_s
    tau = w.duration_s / 2 + (1 - rate_mps / SPEED) * u
    return np.real(
        gain * sample(w.envelope, w.rate_hz, w.start_s, tau) * np.exp(2j * np.pi * w.carrier_hz * tau)
    ).astype(np.float32)


def heard(plan: Plan, samples: NDArray[np.float32], first: int = 0) -> Detection:
    begins = first / RATE_HZ
    found, _ = acquire(plan, samples, first, "M", {"A": (begins, begins + 0.09)})
    assert len(found) == 1
    return found[0]


kinds = st.tuples(st.integers(0, len(CODES) - 1), st.sampled_from(["ask", "bpsk"]), st.sampled_from([6, 8, 11]))
arrivals = st.floats(0.03, 0.09)
rates = st.floats(-2.9, 2.9)
phases = st.floats(-np.pi, np.pi)
few = settings(max_examples=25, deadline=None)


@few
@given(kinds, arrivals, rates, phases)
def test_noiseless_bursts_come_back_as_they_were_made(
    kind: tuple[int, str, int], arrival_s: float, rate_mps: float, phase: float
) -> None:
    w, plan = planned(*kind)
    found = heard(plan, rendered(w, arrival_s, rate_mps, 0.3 * np.exp(1j * phase)))
    # what folds at 48 kHz and what the pass band leaves out is some 1e-3 of the burst: 0.1 mm and 1 mm/s
    assert abs(found.arrival_s - arrival_s) * SPEED < 2e-4
    assert abs((1 - found.time_scale) * SPEED - rate_mps) < 2e-3
    assert abs(found.amplitude / 0.3 - 1) < 2e-3


@few
@given(kinds, arrivals, rates, st.integers(0, 10**8), st.integers(0, 2**32 - 1))
def test_a_later_recording_is_heard_as_much_later(
    kind: tuple[int, str, int], arrival_s: float, rate_mps: float, later: int, seed: int
) -> None:
    """The same samples, counted from another sample on: the same bursts, that while later."""
    w, plan = planned(*kind)
    noise = 0.02 * np.random.default_rng(seed).standard_normal(COUNT).astype(np.float32)
    samples = rendered(w, arrival_s, rate_mps, 0.3) + noise
    before, after = heard(plan, samples), heard(plan, samples, later)
    # of 100 million samples, 2000 s, a double leaves 2e-13 s; the refinement stops at a tenth of a micron
    assert abs(after.arrival_s - before.arrival_s - later / RATE_HZ) < 2e-9
    assert abs(after.time_scale - before.time_scale) < 1e-7
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-3)


@few
@given(kinds, arrivals, rates, st.integers(1, 500), st.integers(0, 2**32 - 1))
def test_silence_before_shifts_all_that_follows(
    kind: tuple[int, str, int], arrival_s: float, rate_mps: float, silence: int, seed: int
) -> None:
    w, plan = planned(*kind)
    noise = 0.02 * np.random.default_rng(seed).standard_normal(COUNT).astype(np.float32)
    samples = rendered(w, arrival_s, rate_mps, 0.3) + noise
    before = heard(plan, samples)
    after = heard(plan, np.concatenate([np.zeros(silence, np.float32), samples]))
    sd_s, sd = np.sqrt(np.diag(before.covariance))
    # decimation falls on other samples: the estimates differ by what aliases, far below the noise
    assert abs(after.arrival_s - before.arrival_s - silence / RATE_HZ) < 0.3 * sd_s
    assert abs(after.time_scale - before.time_scale) < 0.3 * sd


@few
@given(kinds, arrivals, rates, st.floats(-60.0, 60.0), st.integers(0, 2**32 - 1))
def test_loudness_changes_the_amplitude_alone(
    kind: tuple[int, str, int], arrival_s: float, rate_mps: float, gain_db: float, seed: int
) -> None:
    w, plan = planned(*kind)
    noise = 0.02 * np.random.default_rng(seed).standard_normal(COUNT).astype(np.float32)
    samples = rendered(w, arrival_s, rate_mps, 0.3) + noise
    factor = np.float32(10 ** (gain_db / 20))
    before, after = heard(plan, samples), heard(plan, factor * samples)
    sd_s = np.sqrt(before.covariance[0, 0])
    assert abs(after.arrival_s - before.arrival_s) < 1e-3 * sd_s
    assert abs(after.amplitude / before.amplitude / float(factor) - 1) < 1e-4
    assert abs(after.snr_db - before.snr_db) < 1e-2
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-3)


@few
@given(kinds, arrivals, rates, phases)
def test_the_carriers_phase_changes_nothing(
    kind: tuple[int, str, int], arrival_s: float, rate_mps: float, phase: float
) -> None:
    """A burst of any phase is as far away: only the envelope and the way the phase turns tell range and rate."""
    w, plan = planned(*kind)
    before, after = (heard(plan, rendered(w, arrival_s, rate_mps, g)) for g in (0.3, 0.3 * np.exp(1j * phase)))
    assert abs(after.arrival_s - before.arrival_s) * SPEED < 4e-4
    assert abs(after.time_scale - before.time_scale) * SPEED < 4e-3
