"""The joint refinement: kernel against plain twin, derivatives against differences, recovery, and Fisher's bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix.acquire.baseband import band_limited, design_band
from sonofix.acquire.kernels import add_model, assemble, columns, matched_parts
from sonofix.acquire.refine import FRESH_RAD, Burst, Joint
from sonofix.records import Floats
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SIGNAL = Signal(carrier_hz=15e3, cycles_per_chip=8, bandwidth_hz=3e3)
BAND = design_band([keyed_waveform(codes.m_sequence(6, [5]), SIGNAL)], 48e3)
A, B, C = (
    band_limited(keyed_waveform(codes.m_sequence(6, list(taps)), SIGNAL), BAND) for taps in codes.primitive_taps(6)[:3]
)
RATE_HZ = BAND.rate_hz
START_S = 1.234
COUNT = int(0.1 * RATE_HZ)
KAPPA_SD = 6e-3


def model(burst: Burst) -> NDArray[np.complex128]:
    """Plain twin of the model: the burst's own time by its definition, the carrier's phase from the same time."""
    w = burst.waveform
    u = START_S + np.arange(COUNT) / RATE_HZ - burst.arrival_s
    tau = w.duration_s / 2 + u - burst.beta * u - burst.kappa / 2 * u**2
    envelope = sample(w.envelope, w.rate_hz, w.start_s, tau)
    # against a carrier that is at rest, which base band has taken away
    return burst.gain * envelope * np.exp(2j * np.pi * w.carrier_hz * (tau - w.duration_s / 2 - u))


def columns_of(burst: Burst) -> NDArray[np.complex128]:
    return filled(burst)[0]


def fixed(burst: Burst) -> tuple[object, ...]:
    w = burst.waveform
    return w.envelope, w.rate_hz, w.start_s, w.duration_s / 2, w.carrier_hz, START_S, RATE_HZ


def filled(burst: Burst) -> tuple[NDArray[np.complex128], NDArray[np.float32], tuple[int, int]]:
    """Columns (4, n) as complex numbers, as the kernel leaves them, and where they sound."""
    parts = np.zeros((4, 2, COUNT), np.float32)
    support = columns(*fixed(burst), burst.arrival_s, burst.beta, burst.kappa, parts)
    return parts[:, 0].astype(np.complex128) + 1j * parts[:, 1], parts, support


def refine(
    heard: NDArray[np.complex128], starts: list[Burst], kappa_sd: float, whiteness: float, iterations: int
) -> tuple[list[Burst], list[Floats], NDArray[np.complex128], Floats]:
    """Fit bursts from starting values, all at once: bursts, covariances, what they leave, noise."""
    joint = Joint(heard, START_S, RATE_HZ, kappa_sd, whiteness)
    for burst in starts:
        joint.add(burst)
    joint.settle(iterations, FRESH_RAD)
    noise = joint.noise()
    return joint.bursts, joint.covariances(noise), joint.residual, noise


BURSTS = (
    Burst(A, START_S + 0.0431, 0.0021, 0.004, 0.4 - 0.3j),
    Burst(B, START_S + 0.0502, -0.0067, -0.002, 0.05 + 0.1j),
    Burst(C, START_S + 0.0440, 0.0, 0.0, -0.8j),
)


@pytest.mark.parametrize("burst", BURSTS)
def test_kernel_is_its_plain_twin(burst: Burst) -> None:
    # single precision, and a sample or two of the filters' last ripples at either end
    np.testing.assert_allclose(columns_of(burst)[0], model(replace(burst, gain=1.0)), atol=3e-7)
    total = np.full(COUNT, 0.1 + 0j)
    add_model(total, *fixed(burst), burst.arrival_s, burst.beta, burst.kappa, burst.gain)
    np.testing.assert_allclose(total - 0.1, model(burst), atol=1e-7)


@pytest.mark.parametrize("burst", BURSTS)
@pytest.mark.parametrize(("row", "name", "step"), [(1, "arrival_s", 1e-9), (2, "beta", 1e-8), (3, "kappa", 1e-6)])
def test_derivatives_are_differences(burst: Burst, row: int, name: str, step: float) -> None:
    unit = replace(burst, gain=1.0)
    here = getattr(unit, name)
    ahead, behind = (model(replace(unit, **{name: here + s})) for s in (step, -step))
    slow, fast = (ahead - behind) / (2 * step), columns_of(burst)[row]
    # a cubic's slope jumps from piece to piece, by some 1e-4 of the largest
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-3 * np.abs(slow).max())


def test_normal_matrix_is_that_of_plain_columns(rng: np.random.Generator) -> None:
    """Also where a burst was moved, dropped, and samples were left out."""
    joint = Joint(noisy(rng, 1.0), START_S, RATE_HZ, KAPPA_SD, 1.0, room=1)
    for burst in (*BURSTS, BURSTS[1]):
        joint.add(burst)
    joint.keep([0, 1, 2])
    aside = np.zeros(COUNT, bool)
    aside[COUNT // 2 : COUNT // 2 + 50] = True
    joint.leave_out(aside)
    unit = [np.where(aside, 0, columns_of(burst)) for burst in BURSTS]
    gain: NDArray[np.complex128] = np.array([2.0, 1j, 0.3 - 1j])
    rows = np.concatenate([[v[0], 1j * v[0], *(g * v[1:])] for v, g in zip(unit, gain, strict=True)])
    plain = (np.conj(rows) @ rows.T).real
    size = np.sqrt(np.diag(plain))
    np.testing.assert_allclose(joint._normal(gain, np.zeros(3))[0], plain / np.outer(size, size), atol=3e-6)
    seen = np.conj(np.concatenate(unit)) @ joint.residual
    norm = np.linalg.norm(np.concatenate(unit), axis=1) * np.linalg.norm(joint.residual)
    np.testing.assert_allclose(joint._seen(0, 3).ravel() / norm, seen / norm, atol=3e-6)


def test_assembly_is_a_product_of_real_rows(rng: np.random.Generator) -> None:
    unit = rng.standard_normal((2, 4, 50)) + 1j * rng.standard_normal((2, 4, 50))
    gain = np.array([0.3 - 2j, 1j])
    rows = np.concatenate([[v[0], 1j * v[0], *(g * v[1:])] for v, g in zip(unit, gain, strict=True)])
    flat = unit.reshape(8, 50)
    np.testing.assert_allclose(assemble(np.conj(flat) @ flat.T, gain), (np.conj(rows) @ rows.T).real, atol=1e-12)


def test_residual_is_what_bursts_leave(rng: np.random.Generator) -> None:
    heard = noisy(rng, 1e-2) + model(BURSTS[0]) + model(BURSTS[1])
    joint = Joint(heard, START_S, RATE_HZ, KAPPA_SD, 1.0)
    for burst in BURSTS[:2]:
        joint.add(burst)
    joint.settle(10)
    left = heard - model(joint.bursts[0]) - model(joint.bursts[1])
    np.testing.assert_allclose(joint.residual, left, atol=1e-6)
    np.testing.assert_allclose(joint.residual_with(1), left + model(joint.bursts[1]), atol=1e-6)
    joint.replace_baseband(heard + 0.5)
    np.testing.assert_allclose(joint.residual, left + 0.5, atol=1e-6)


@pytest.mark.parametrize("parts", [1, 7])
def test_parts_matched_are_those_of_the_plain_model(parts: int, rng: np.random.Generator) -> None:
    heard = model(BURSTS[0]) + noisy(rng, 1e-2)
    burst = BURSTS[0]
    seen, middle_s, energy = matched_parts(
        heard, *fixed(burst), burst.arrival_s, burst.beta + 2e-4, burst.kappa, np.zeros(len(heard), bool), parts
    )
    plain = model(replace(burst, beta=burst.beta + 2e-4, gain=1.0))
    out = np.zeros((4, 2, len(heard)), np.float32)
    sounding = np.arange(*columns(*fixed(burst), burst.arrival_s, burst.beta + 2e-4, burst.kappa, out))
    pieces = np.split(sounding, np.arange(1, parts) * -(-len(sounding) // parts))
    for k, piece in enumerate(pieces):
        assert seen[k] == pytest.approx(np.vdot(plain[piece], heard[piece]), rel=1e-6)
        if k < parts - 1:
            assert middle_s[k] == pytest.approx(START_S + np.mean(piece) / RATE_HZ - burst.arrival_s)
    assert energy.sum() == pytest.approx(np.vdot(plain, plain).real, rel=1e-6)


def test_a_curvature_far_off_is_found(rng: np.random.Generator) -> None:
    """Bent by three deviations of what is expected, which a descent from a straight line does not reach."""
    kappa_sd = 0.15
    heard = model(replace(BURSTS[0], kappa=0.45, gain=0.5)) + noisy(rng, 1e-4)
    joint = Joint(heard, START_S, RATE_HZ, kappa_sd, 1.0)
    joint.add(replace(BURSTS[0], kappa=0.0, gain=0j))
    assert joint.straighten(0)
    joint.settle(20)
    assert joint.bursts[0].kappa == pytest.approx(0.45, abs=0.02)
    assert np.mean(np.abs(joint.residual) ** 2) == pytest.approx(1e-4, rel=0.2)
    assert not joint.straighten(0)


def test_a_turn_within_a_burst_is_followed(rng: np.random.Generator) -> None:
    """A source that begins to speed up while it is heard fits no parabola; a phase on top of one does."""
    burst = replace(BURSTS[0], gain=1.0, kappa=0.0)
    straight = model(burst)
    u = START_S + np.arange(len(straight)) / RATE_HZ - burst.arrival_s
    kink = np.exp(-2j * np.pi * burst.waveform.carrier_hz * 0.5 * 0.15 * np.maximum(u, 0.0) ** 2)
    joint = Joint(straight * kink + noisy(rng, 1e-4), START_S, RATE_HZ, KAPPA_SD, 1.0)
    joint.add(replace(burst, gain=0j))
    joint.settle(20)
    left = float(np.sum(np.abs(joint.residual) ** 2))
    wobble, gained = joint.wobble(0)
    joint.follow(0, wobble)
    joint.settle(20)
    now = float(np.sum(np.abs(joint.residual) ** 2))
    assert left - now == pytest.approx(gained, rel=0.2)
    assert now - 1e-4 * len(straight) < 0.1 * (left - 1e-4 * len(straight))
    # the moment of the middle is told by the envelope: it stays
    assert joint.bursts[0].arrival_s == pytest.approx(burst.arrival_s, abs=1e-5)
    # and the rate there is that before the kink, nearer than the whole burst's slope
    found = joint.bursts[0]
    assert abs(found.beta + found.swing - burst.beta) < 0.5 * abs(found.beta - burst.beta)
    assert abs(found.beta + found.swing - burst.beta) < 2 * found.swing_sd


def test_noise_gives_a_wobble_half_its_power_a_degree(rng: np.random.Generator) -> None:
    gains = []
    for _ in range(60):
        joint = Joint(model(BURSTS[0]) + noisy(rng, 1e-3), START_S, RATE_HZ, KAPPA_SD, 1.0)
        joint.add(BURSTS[0])
        joint.settle(10)
        gains.append(joint.wobble(0)[1] / 1e-3)
    # χ² of four degrees, halved: mean 2, deviation of the mean of 60 √2 / √60
    assert np.mean(gains) == pytest.approx(2.0, abs=4 * np.sqrt(2 / 60))


def test_a_burst_matches_its_signature_and_a_bare_carrier_does_not(rng: np.random.Generator) -> None:
    for heard, share in ((model(BURSTS[0]), 1.0), (0.5 * np.ones(COUNT, complex), 0.0)):
        joint = Joint(heard + noisy(rng, 1e-6), START_S, RATE_HZ, KAPPA_SD, 1.0)
        joint.add(replace(BURSTS[0], beta=0.0 if share == 0.0 else BURSTS[0].beta))
        w = BURSTS[0].waveform
        energy = abs(joint.bursts[0].gain) ** 2 * np.sum(np.abs(w.signature) ** 2) * RATE_HZ / w.rate_hz
        assert joint.matched(0) / energy == pytest.approx(share, abs=0.05)


def test_nothing_sounds_outside_the_table() -> None:
    assert not columns_of(replace(BURSTS[0], arrival_s=START_S + 9.0)).any()


def settled(
    heard: NDArray[np.complex128], starts: list[Burst], whiteness: float = 1.0, kappa_sd: float = KAPPA_SD
) -> tuple[list[Burst], list[Floats], NDArray[np.complexfloating], Floats]:
    """Roughly, then fully: the weight of κ's prior follows from what remains when a refinement begins."""
    rough = refine(heard, starts, kappa_sd, whiteness, 8)[0]
    return refine(heard, rough, kappa_sd, whiteness, 20)


def off(burst: Burst, rng: np.random.Generator) -> Burst:
    """As a search leaves it: half a sample and half a cell of range rate off, curvature and gain not known."""
    arrival_s = burst.arrival_s + rng.uniform(-0.5, 0.5) / RATE_HZ
    return Burst(burst.waveform, arrival_s, burst.beta + rng.uniform(-1, 1) * 8e-4, 0.0, 0j)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_noiseless_bursts_are_recovered(count: int, rng: np.random.Generator) -> None:
    # κ is held by its prior, which without noise weighs nothing
    truth = list(BURSTS[:count])
    heard = np.sum([model(b) for b in truth], axis=0)
    found, _, residual, _ = settled(heard, [off(b, rng) for b in truth])
    for burst, true in zip(found, truth, strict=True):
        assert burst.arrival_s == pytest.approx(true.arrival_s, abs=1e-9)
        assert burst.beta == pytest.approx(true.beta, abs=1e-7)
        assert burst.kappa == pytest.approx(true.kappa, abs=1e-5)
        assert abs(burst.gain - true.gain) < 1e-5
    assert np.linalg.norm(residual) < 1e-5 * np.linalg.norm(heard)


def test_an_echo_of_the_same_code_is_told_apart(rng: np.random.Generator) -> None:
    direct = Burst(A, START_S + 0.04, 0.001, 0.0, 0.3 + 0j)
    echo = Burst(A, START_S + 0.04 + 1.1e-3, -0.001, 0.0, 0.2j)
    found, _, _, _ = settled(model(direct) + model(echo), [off(direct, rng), off(echo, rng)])
    for burst, true in zip(found, (direct, echo), strict=True):
        assert burst.arrival_s == pytest.approx(true.arrival_s, abs=1e-8)
        assert burst.beta == pytest.approx(true.beta, abs=5e-7)
        assert abs(burst.gain - true.gain) < 1e-4


def noisy(rng: np.random.Generator, power: float) -> NDArray[np.complex128]:
    return np.sqrt(power / 2) * (rng.standard_normal(COUNT) + 1j * rng.standard_normal(COUNT))


def fisher_covariance(bursts: list[Burst], power: float) -> Floats:
    """Inverse information about (Re g, Im g, arrival, β, κ) of each burst, by differences of the plain twin."""
    steps = {"arrival_s": 1e-7, "beta": 1e-7, "kappa": 1e-5}
    rows = []
    for burst in bursts:
        rows += [model(replace(burst, gain=1.0)), 1j * model(replace(burst, gain=1.0))]
        for name, step in steps.items():
            here = getattr(burst, name)
            ahead, behind = (model(replace(burst, **{name: here + s})) for s in (step, -step))
            rows.append((ahead - behind) / (2 * step))
    jacobian = np.array(rows)
    information = 2 / power * (np.conj(jacobian) @ jacobian.T).real
    kappa = 5 * np.arange(len(bursts)) + 4
    information[kappa, kappa] += 1 / KAPPA_SD**2
    scale = np.sqrt(np.diag(information))
    return np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_covariance_is_the_inverse_of_fishers_information(count: int, rng: np.random.Generator) -> None:
    truth = list(BURSTS[:count])
    heard = np.sum([model(b) for b in truth], axis=0) + noisy(rng, 1e-4)
    found, covariances, _, noise = settled(heard, [off(b, rng) for b in truth])
    sounding = np.sum(np.abs(columns_of(truth[0])[0]) > 0)
    # noise is measured on what remains, from which 5 of 2n degrees of freedom a burst went into the fit
    np.testing.assert_allclose(noise, 1e-4, rtol=5 / np.sqrt(sounding) + 5 * count / (2 * sounding))
    for i, covariance in enumerate(covariances):
        expected = fisher_covariance(found, float(noise[i]))[5 * i + 2 : 5 * i + 4, 5 * i + 2 : 5 * i + 4]
        np.testing.assert_allclose(covariance, expected, rtol=5e-3, atol=5e-3 * np.sqrt(np.prod(np.diag(expected))))


def test_whiteness_scales_the_noise(rng: np.random.Generator) -> None:
    heard = model(BURSTS[0]) + noisy(rng, 1e-4)
    once, twice = (settled(heard, [off(BURSTS[0], rng)], w) for w in (1.0, 1.5))
    assert twice[3][0] == pytest.approx(1.5 * once[3][0], rel=1e-3)


def test_curvature_is_held_to_what_is_plausible(rng: np.random.Generator) -> None:
    """In loud noise κ stays within its prior; the data alone would scatter ten times as far."""
    kappas, free = [], []
    for _ in range(30):
        heard = model(replace(BURSTS[0], kappa=0.0, gain=1.0)) + noisy(rng, 5.0)
        start = [replace(off(BURSTS[0], rng), arrival_s=BURSTS[0].arrival_s, beta=BURSTS[0].beta)]
        kappas.append(settled(heard, start)[0][0].kappa)
        free.append(settled(heard, start, kappa_sd=1e3)[0][0].kappa)
    assert np.std(kappas) < KAPPA_SD
    assert np.std(free) > 3 * np.std(kappas)


def test_misfit_never_grows(rng: np.random.Generator) -> None:
    """Steps that would raise it are damped instead: however far the start, no more remains than there."""
    heard = model(BURSTS[0]) + model(BURSTS[2]) + noisy(rng, 1e-3)
    for _ in range(10):
        start = [
            replace(b, arrival_s=b.arrival_s + rng.normal(0, 1e-3), beta=b.beta + rng.normal(0, 3e-3))
            for b in (BURSTS[0], BURSTS[2])
        ]
        before, after = (refine(heard, start, 1e3, 1.0, n)[2] for n in (0, 12))
        assert np.linalg.norm(after) <= np.linalg.norm(before) * (1 + 1e-9)
