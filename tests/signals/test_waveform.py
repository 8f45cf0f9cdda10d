"""Bursts against a slow direct computation: every chip's exact response, twice through a one-pole resonator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix.records import Floats, ReferenceBurst, Waveform
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import chips_of, reference_waveform, resonance, waveform_of, waveforms_of
from sonofix.site import Beacon, Signal, Site

SPEED = 343.2
M_SEQUENCE = {"family": "m-sequence", "degree": 5, "taps": [3]}


SIGNAL = Signal(carrier_hz=40e3, cycles_per_chip=10, bandwidth_hz=4e3)


def site_of(code: dict[str, Any] | None = None, **signal: Any) -> Site:
    return Site.model_validate(
        {
            "air": {"sound_speed_mps": SPEED},
            "schedule": {"period_s": 0.5},
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10, "bandwidth_hz": 4e3} | signal,
            "vehicle": [{"id": "v"}],
            "beacon": [{"id": "A", "position_m": [0, 0, 0], "code": code or M_SEQUENCE}],
            "microphone": [{"id": "M", "channel": 0, "vehicle": "v"}],
        }
    )


def burst_of(code: dict[str, Any] | None = None, **signal: Any) -> Waveform:
    site = site_of(code, **signal)
    return waveform_of(site, site.beacons[0])


def slow_response(levels: Floats, chip_s: float, bandwidth_hz: float, tau: Floats) -> Floats:
    """Envelope at burst times: a row of rectangular chips through two resonators, each one pole, chip by chip.

    While a chip of level u lasts, the first resonator's a(t) = u + A exp(−λt), and the second's
    b(t) = u + (b₀ − u) exp(−λt) + A λ t exp(−λt), with λ = πB.
    """
    decay = np.pi * bandwidth_hz
    out = np.zeros(len(tau))
    first = second = 0.0
    for i, level in enumerate([*levels, 0.0]):
        begin, end = i * chip_s, (i + 1) * chip_s if i < len(levels) else np.inf
        t = tau - begin
        now = (tau >= begin) & (tau < end)
        out[now] = (level + (second - level + (first - level) * decay * t) * np.exp(-decay * t))[now]
        gone = np.exp(-decay * chip_s)
        second = level + (second - level + (first - level) * decay * chip_s) * gone
        first = level + (first - level) * gone
    return out


def times(w: Waveform) -> Floats:
    return w.start_s + np.arange(len(w.envelope)) / w.rate_hz


CODES = {
    "m-sequence": M_SEQUENCE,
    "gold": {"family": "gold", "degree": 5, "index": 7},
    "kasami": {"family": "kasami", "degree": 4, "index": 2},
    "chips": {"chips": "0110011000001010"},
}


@pytest.mark.parametrize("modulation", ["ask", "bpsk"])
@pytest.mark.parametrize("bandwidth_hz", [2e3, 4e3, 9e3])
@pytest.mark.parametrize("code", list(CODES))
def test_keyed_envelope_is_that_of_two_resonators(code: str, bandwidth_hz: float, modulation: str) -> None:
    site = site_of(CODES[code], modulation=modulation, bandwidth_hz=bandwidth_hz)
    w = waveform_of(site, site.beacons[0])
    chips = chips_of(site.beacons[0])
    assert chips is not None
    levels = chips.astype(float) if modulation == "ask" else 2.0 * chips - 1.0
    chip_s = 10 / 40e3
    assert w.duration_s == pytest.approx(len(chips) * chip_s)
    assert w.carrier_hz == 40e3
    slow = slow_response(levels, chip_s, bandwidth_hz, times(w))
    # the table holds the response's spectrum up to 32 chip rates, beyond which 1e-4 of the amplitude is left at most
    np.testing.assert_allclose(w.envelope, slow, rtol=0, atol=2e-4)
    shared = levels.mean() if modulation == "ask" else 0.0
    slow = slow_response(levels - shared, chip_s, bandwidth_hz, times(w))
    np.testing.assert_allclose(w.signature, slow, rtol=0, atol=2e-4)


def test_signature_correlates_only_with_what_chips_do_not_share() -> None:
    """Between two on-off codes the bare carrier, which is in both, adds to cross-talk; signatures leave it out."""
    a, b = (burst_of({"family": "m-sequence", "degree": 9, "taps": list(t)}) for t in codes.primitive_taps(9)[:2])
    whole = np.abs(np.vdot(a.envelope, b.envelope)) / np.linalg.norm(a.envelope) / np.linalg.norm(b.envelope)
    bare = np.abs(np.vdot(a.signature, b.signature)) / np.linalg.norm(a.signature) / np.linalg.norm(b.signature)
    assert whole > 0.4
    assert bare < 0.15


def test_without_transducers_chips_are_rectangles() -> None:
    site = site_of(bandwidth_hz=None)
    w = waveform_of(site, site.beacons[0])
    chips = chips_of(site.beacons[0])
    assert chips is not None
    first = round(-w.start_s * w.rate_hz)
    each = w.envelope[first : first + 64 * len(chips)].reshape(len(chips), 64)
    # band-limited edges ring, but a chip's mean is its level but for the half sample at either edge
    np.testing.assert_allclose(each.mean(axis=1), chips, atol=1.1 / 64)
    np.testing.assert_allclose(each[:, 16:48], np.repeat(chips, 32).reshape(-1, 32), atol=0.02)


@pytest.mark.parametrize("factor", [0.9, 0.994, 1.0, 1.0 + 1 / 512, 1.1])
def test_replicas_stretch_by_any_factor(factor: float) -> None:
    site = site_of()
    w = waveform_of(site, site.beacons[0])
    chips = chips_of(site.beacons[0])
    assert chips is not None
    heard = np.linspace(-1e-3, 12e-3, 4001)
    stretched = sample(w.envelope, w.rate_hz, w.start_s, factor * heard)
    np.testing.assert_allclose(
        stretched, slow_response(chips.astype(float), 2.5e-4, 4e3, factor * heard), rtol=0, atol=2e-4
    )


def test_a_resonator_has_its_width() -> None:
    gain = np.abs(resonance(np.array([-2e3, 0.0, 2e3]), 4e3)) ** 2
    np.testing.assert_allclose(gain, [0.5, 1.0, 0.5], rtol=1e-12)


@pytest.mark.parametrize(("start_hz", "stop_hz"), [(38e3, 42e3), (43e3, 39e3)])
def test_chirp_sweeps_from_start_to_stop(start_hz: float, stop_hz: float) -> None:
    code = {"family": "chirp", "start_hz": start_hz, "stop_hz": stop_hz, "duration_s": 20e-3}
    w = burst_of(code, bandwidth_hz=None)
    tau = times(w)
    assert w.duration_s == 20e-3
    inside = (tau > 1e-4) & (tau < w.duration_s - 1e-4)
    phase = np.unwrap(np.angle(w.envelope[inside]))
    frequency_hz = 40e3 + np.gradient(phase, tau[inside]) / (2 * np.pi)
    expected = start_hz + (stop_hz - start_hz) * tau[inside] / w.duration_s
    np.testing.assert_allclose(frequency_hz[1:-1], expected[1:-1], atol=1.0)
    np.testing.assert_allclose(np.abs(w.envelope[inside]), 1.0, rtol=1e-12)
    assert not w.envelope[(tau < 0) | (tau > w.duration_s)].any()


def test_chirp_passes_both_resonators() -> None:
    code = {"family": "chirp", "start_hz": 38e3, "stop_hz": 42e3, "duration_s": 20e-3}
    w = burst_of(code, bandwidth_hz=3e3)
    # exact steps of both resonators on a grid 50 times as fine as the table
    step = 1 / (50 * w.rate_hz)
    tau = step * (np.arange(int((w.duration_s + 2e-3) / step)) + 0.5)
    drive = np.exp(2j * np.pi * (-2e3 * tau + 4e3 * tau**2 / (2 * w.duration_s))) * (tau < w.duration_s)
    from scipy.signal import lfilter

    gone = np.exp(-np.pi * 3e3 * step)
    once = lfilter([1 - gone], [1, -gone], drive)
    twice = np.asarray(lfilter([1 - gone], [1, -gone], once))
    at = np.linspace(1e-4, w.duration_s + 1.5e-3, 500)
    slow = np.interp(at, tau + step / 2, twice.real) + 1j * np.interp(at, tau + step / 2, twice.imag)
    found = sample(w.envelope, w.rate_hz, w.start_s, at)
    # the table knows the chirp's edges to half a sample, what follows them to that over the resonators' time constant
    np.testing.assert_allclose(found, slow, atol=0.5 / w.rate_hz * np.pi * 3e3)
    settled = (at > 1e-3) & (at < w.duration_s)
    np.testing.assert_allclose(found[settled], slow[settled], atol=2e-3)


def rendered(w: Waveform, rate_hz: float, count: int, begins_s: float) -> NDArray[np.float64]:
    """Samples of a burst whose first chip is heard at ``begins_s``."""
    tau = np.arange(count) / rate_hz - begins_s
    return np.real(sample(w.envelope, w.rate_hz, w.start_s, tau) * np.exp(2j * np.pi * w.carrier_hz * tau))


@pytest.mark.parametrize(("distance_m", "start_s"), [(0.0, 0.0), (0.5, 0.0), (1.2, 2.5e-3)])
@pytest.mark.parametrize(("rate_hz", "lost"), [(96e3, 1.5e-2), (192e3, 2e-3)])
def test_a_recorded_burst_reads_back_as_what_was_sent(
    distance_m: float, start_s: float, rate_hz: float, lost: float
) -> None:
    sent = burst_of()
    file = rendered(sent, rate_hz, int(20e-3 * rate_hz), start_s + distance_m / SPEED)
    back = reference_waveform(ReferenceBurst(file, rate_hz), SIGNAL, SPEED, distance_m, start_s)
    tau = np.linspace(0.0, sent.duration_s + 1e-3, 3001)
    ours = sample(back.envelope, back.rate_hz, back.start_s, tau)
    theirs = sample(sent.envelope, sent.rate_hz, sent.start_s, tau)
    # the phase at the file's beginning is arbitrary; D = D0 + c N holds for the envelope
    turn = np.vdot(theirs, ours) / np.vdot(theirs, theirs)
    assert abs(turn) == pytest.approx(1.0, abs=2e-3)
    # what lies beyond half the sample rate is lost to the file
    np.testing.assert_allclose(ours, turn * theirs, rtol=0, atol=lost)
    fine = np.linspace(-1e-6, 1e-6, 201)
    match = [np.abs(np.vdot(sample(back.envelope, back.rate_hz, back.start_s, tau + f), theirs)) for f in fine]
    # 2e-7 s are 0.07 mm
    assert abs(fine[int(np.argmax(match))]) <= 2e-7
    assert back.duration_s == pytest.approx(20e-3 - start_s)


def test_the_mean_of_a_recorded_burst_is_no_part_of_it() -> None:
    file = rendered(burst_of(), 192e3, 3000, 1e-3)
    plain = reference_waveform(ReferenceBurst(file, 192e3), SIGNAL, SPEED)
    shifted = reference_waveform(ReferenceBurst(file + 0.1, 192e3), SIGNAL, SPEED)
    np.testing.assert_allclose(shifted.envelope, plain.envelope, atol=1e-12)


def test_waveforms_of_a_site() -> None:
    site = Site.model_validate(
        {
            "schedule": {"period_s": 0.5},
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10, "bandwidth_hz": 4e3},
            "beacon": [
                {"id": "A", "position_m": [0, 0, 0], "code": M_SEQUENCE},
                {"id": "mute", "position_m": [1, 0, 0]},
                {"id": "B", "position_m": [2, 0, 0], "code": {"chips": "0101"}, "carrier_hz": 20e3},
                {"id": "R", "position_m": [3, 0, 0], "code": {"reference": "r.flac", "start_s": 1e-3}},
            ],
        }
    )
    file = ReferenceBurst(rendered(burst_of(), 192e3, 3000, 1e-3), 192e3)
    made = waveforms_of(site, {"R": file})
    assert list(made) == ["A", "B", "R"]
    assert (made["B"].carrier_hz, made["B"].duration_s) == (20e3, pytest.approx(4 * 10 / 20e3))
    assert made["R"].duration_s == pytest.approx(3000 / 192e3 - 1e-3)


def test_what_cannot_be_made_is_named() -> None:
    site = site_of({"reference": "r.flac"})
    with pytest.raises(ValueError, match=r"beacon A: .* r\.flac, which was not given"):
        waveform_of(site, site.beacons[0])
    mute = Beacon.model_validate({"id": "mute", "position_m": [0, 0, 0], "carrier_hz": 40e3})
    with pytest.raises(ValueError, match="beacon mute has no code"):
        waveform_of(site, mute)
    loose = Beacon.model_validate({"id": "A", "position_m": [0, 0, 0], "carrier_hz": 40e3, "code": {"chips": "01"}})
    bare = Site.model_construct(**dict(site) | {"signal": None})
    with pytest.raises(ValueError, match="cycles_per_chip is missing"):
        waveform_of(bare, loose)
    signal = Signal(carrier_hz=40e3)
    with pytest.raises(ValueError, match="48000 Hz, too slow for a carrier of 40000"):
        reference_waveform(ReferenceBurst(np.zeros(100), 48e3), signal, SPEED)
    with pytest.raises(ValueError, match="holds 5 samples; at least 16"):
        reference_waveform(ReferenceBurst(np.zeros(5), 192e3), signal, SPEED)
