"""One epoch taken apart: near and far, echoes, cut-off bursts, warm searches, several carriers."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix.acquire.plan import acquire, make_plan
from sonofix.records import Detection, Prediction, Waveform
from sonofix.signals import codes
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import keyed_waveform
from sonofix.site import Signal

SPEED = 343.2
RATE_HZ = 48e3
SIGNAL = Signal(carrier_hz=15e3, cycles_per_chip=8, bandwidth_hz=3e3)
WAVEFORMS = {
    name: keyed_waveform(codes.m_sequence(7, list(taps)), SIGNAL)
    for name, taps in zip("ABCD", codes.primitive_taps(7), strict=False)
}
PLAN = make_plan(WAVEFORMS, RATE_HZ, SPEED, max_rate_mps=3.0)
HALF_S = WAVEFORMS["A"].duration_s / 2
LENGTH_S = 0.2
WINDOW = (0.0, 0.1)


def rendered(w: Waveform, arrival_s: float, rate_mps: float, gain: complex, first: int = 0) -> NDArray[np.float64]:
    """Samples from index ``first`` on of one burst whose middle is heard at ``arrival_s``."""
    u = (first + np.arange(int(LENGTH_S * RATE_HZ))) / RATE_HZ - arrival_s
    tau = w.duration_s / 2 + (1 - rate_mps / SPEED) * u
    return np.real(gain * sample(w.envelope, w.rate_hz, w.start_s, tau) * np.exp(2j * np.pi * w.carrier_hz * tau))


def heard(
    bursts: list[tuple[str, float, float, complex]], noise_sd: float, rng: np.random.Generator, first: int = 0
) -> NDArray[np.float32]:
    parts = [rendered(WAVEFORMS[name], *rest, first) for name, *rest in bursts]
    total = np.sum([np.zeros(int(LENGTH_S * RATE_HZ)), *parts], axis=0)
    return (total + noise_sd * rng.standard_normal(len(total))).astype(np.float32)


def listen(samples: NDArray[np.float32], first: int = 0, names: str = "ABCD", **how: object) -> dict[str, Detection]:
    windows = dict.fromkeys(names, WINDOW)
    found, _ = acquire(PLAN, samples, first, "M", windows, **how)  # type: ignore[arg-type]
    assert len({d.emitter for d in found}) == len(found)
    assert all(d.receiver == "M" for d in found)
    assert all(a.amplitude >= b.amplitude for a, b in pairwise(found))
    return {d.emitter: d for d in found}


def agrees(found: Detection, arrival_s: float, rate_mps: float) -> bool:
    """Whether arrival and time scale are within four and a half of their stated deviations."""
    error = np.array([found.arrival_s - arrival_s, found.time_scale - (1 - rate_mps / SPEED)])
    return bool(error @ np.linalg.solve(found.covariance, error) < 4.5**2)


MIXED = [("A", 0.061, 1.3, 0.2 + 0j), ("B", 0.075, -2.1, 0.1j), ("D", 0.09, 0.0, -0.05 + 0j)]


def test_all_that_sounds_is_found_and_nothing_else(rng: np.random.Generator) -> None:
    found = listen(heard(MIXED, 1e-3, rng))
    assert set(found) == {"A", "B", "D"}
    for name, arrival_s, rate, gain in MIXED:
        assert agrees(found[name], arrival_s, rate)
        assert found[name].amplitude == pytest.approx(abs(gain), rel=0.02)
        assert found[name].paths[0].delay_s == 0.0
        assert len(found[name].paths) == 1


def test_a_quiet_beacon_is_heard_beside_a_loud_one(rng: np.random.Generator) -> None:
    """By 36 dB, where codes isolate 20 dB: 1 m beside 60."""
    found = listen(heard([("A", 0.06, 1.3, 1.0), ("B", 0.062, -2.1, 1 / 64)], 5e-4, rng))
    assert set(found) == {"A", "B"}
    assert agrees(found["A"], 0.06, 1.3)
    assert agrees(found["B"], 0.062, -2.1)


def test_snr_is_that_of_the_burst_in_the_band(rng: np.random.Generator) -> None:
    w, band = WAVEFORMS["A"], PLAN.bands[0][0]
    tau = np.linspace(0, w.duration_s, 5000)
    power = 0.04 * np.mean(np.abs(sample(w.envelope, w.rate_hz, w.start_s, tau)) ** 2)
    # white noise of variance s² at this rate has 4 s² B / f_s in a band B, by the convention of analytic amplitudes
    in_band = 4 * 0.02**2 / band.decimation / band.whiteness
    found = listen(heard([("A", 0.06, 0.0, 0.2)], 0.02, rng))["A"]
    assert found.snr_db == pytest.approx(10 * np.log10(power / in_band), abs=1.0)


@pytest.mark.parametrize("delay_s", [0.8e-3, 3e-3])
def test_echoes_are_paths_of_their_burst(delay_s: float, rng: np.random.Generator) -> None:
    direct, echo = ("A", 0.06, 0.5, 0.1 + 0j), ("A", 0.06 + delay_s, -0.5, 0.06j)
    found = listen(heard([direct, echo], 3e-4, rng))["A"]
    assert agrees(found, 0.06, 0.5)
    strong = [p for p in found.paths if p.gain_db > -10]
    assert [p.delay_s for p in strong] == pytest.approx([0.0, delay_s], abs=2e-5)
    assert strong[1].gain_db == pytest.approx(20 * np.log10(0.6), abs=0.3)


def test_first_path_is_reported_even_where_a_later_is_stronger(rng: np.random.Generator) -> None:
    found = listen(heard([("A", 0.06, 0.0, 0.05), ("A", 0.0631, 0.0, 0.1j)], 3e-4, rng))["A"]
    assert agrees(found, 0.06, 0.0)
    assert max(p.gain_db for p in found.paths) == pytest.approx(6.02, abs=0.3)


@pytest.mark.parametrize("first", [4711, 96_000_000])
def test_times_are_the_recorders(first: int, rng: np.random.Generator) -> None:
    """Whatever the stretch begins with, also after half an hour."""
    begins = first / RATE_HZ
    samples = heard([("A", begins + 0.06, 1.3, 0.2)], 1e-3, rng, first)
    found, _ = acquire(PLAN, samples, first, "M", {"A": (begins, begins + 0.1)})
    assert len(found) == 1
    assert agrees(found[0], begins + 0.06, 1.3)


def test_bursts_cut_off_are_left_out(rng: np.random.Generator) -> None:
    samples = heard([("A", 0.06, 0.0, 0.2), ("B", 0.10, 0.0, 0.2)], 1e-3, rng)
    end = int((0.10 + 0.8 * HALF_S) * RATE_HZ)
    assert set(listen(samples[:end])) == {"A"}
    # what began before the recording did is not whole either
    samples = heard([("A", 0.8 * HALF_S, 0.0, 0.2), ("B", 0.10, 0.0, 0.2)], 1e-3, rng)
    windows = dict.fromkeys("AB", (-0.05, 0.1))
    padded = np.concatenate([np.zeros(2400, np.float32), samples])
    assert {d.emitter for d in acquire(PLAN, padded, -2400, "M", windows)[0]} == {"B"}


def test_only_named_beacons_are_searched_in_their_windows(rng: np.random.Generator) -> None:
    samples = heard(MIXED, 1e-3, rng)
    assert set(listen(samples, names="AC")) == {"A"}
    begins = {name: arrival_s - HALF_S for name, arrival_s, *_ in MIXED}
    late = {"A": (begins["A"] + 0.01, 0.1)}
    assert not acquire(PLAN, heard(MIXED[:1], 1e-3, rng), 0, "M", late)[0]
    narrow = {"B": (begins["B"] - 0.001, begins["B"] + 0.001)}
    (found,) = acquire(PLAN, heard(MIXED[1:2], 1e-3, rng), 0, "M", narrow)[0]
    assert agrees(found, 0.075, -2.1)


def test_a_warm_search_finds_the_same(rng: np.random.Generator) -> None:
    samples = heard(MIXED, 1e-3, rng)
    predictions = {
        name: Prediction(name, "M", arrival_s + 1e-4, 1e-4, rate + 0.05, 0.05) for name, arrival_s, rate, _ in MIXED
    }
    cold, warm = listen(samples), listen(samples, predictions=predictions)
    assert set(cold) == set(warm)
    for name, detection in cold.items():
        sd = np.sqrt(detection.covariance[0, 0])
        # both end in the same minimum
        assert warm[name].arrival_s == pytest.approx(detection.arrival_s, abs=0.05 * sd)


def test_a_burst_that_comes_when_none_is_expected_is_not_the_direct_one(rng: np.random.Generator) -> None:
    """Others came as predicted, so the prediction holds, and this one is an echo of what was shadowed."""
    samples = heard([("A", 0.061, 0.0, 0.05), ("B", 0.07, 0.0, 0.1)], 1e-3, rng)
    assert set(listen(samples, names="AB")) == {"A", "B"}
    expected = {"A": Prediction("A", "M", 0.055, 1e-4, 0.0, 0.05), "B": Prediction("B", "M", 0.07, 1e-4, 0.0, 0.05)}
    warm = listen(samples, names="AB", predictions=expected)
    assert set(warm) == {"B"}
    assert agrees(warm["B"], 0.07, 0.0)


def test_a_warm_search_looks_elsewhere_where_nothing_came_as_predicted(rng: np.random.Generator) -> None:
    samples = heard([("A", 0.061, 0.0, 0.05), ("B", 0.07, 0.0, 0.1)], 1e-3, rng)
    wrong = {"A": Prediction("A", "M", 0.08, 1e-4, 0.0, 0.05), "B": Prediction("B", "M", 0.05, 1e-4, 0.0, 0.05)}
    warm = listen(samples, names="AB", predictions=wrong)
    assert set(warm) == {"A", "B"}


def test_a_warm_search_hears_what_a_cold_one_does_not(rng: np.random.Generator) -> None:
    samples = heard([("A", 0.061, 0.0, 6e-4), ("B", 0.07, 0.0, 0.1)], 1e-3, rng)
    expected = {"A": Prediction("A", "M", 0.061, 1e-4, 0.0, 0.05), "B": Prediction("B", "M", 0.07, 1e-4, 0.0, 0.05)}
    assert set(listen(samples, names="AB", predictions=expected)) == {"A", "B"}


def test_beacons_on_two_carriers(rng: np.random.Generator) -> None:
    high = keyed_waveform(codes.m_sequence(7, [6]), Signal(carrier_hz=19e3, cycles_per_chip=10, bandwidth_hz=1500.0))
    plan = make_plan({"A": WAVEFORMS["A"], "H": high}, RATE_HZ, SPEED)
    assert [band.carrier_hz for band, _ in plan.bands] == [15e3, 19e3]
    samples = heard([("A", 0.06, 1.0, 0.1)], 1e-3, rng) + rendered(high, 0.09, -1.0, 0.2).astype(np.float32)
    found = {d.emitter: d for d in acquire(plan, samples, 0, "M", {"A": WINDOW, "H": WINDOW})[0]}
    assert set(found) == {"A", "H"}
    assert found["A"].arrival_s == pytest.approx(0.06, abs=2e-5)
    assert found["H"].arrival_s == pytest.approx(0.09, abs=2e-5)


def test_silence_and_too_few_samples_give_nothing() -> None:
    assert not listen(np.zeros(int(LENGTH_S * RATE_HZ), np.float32))
    assert not listen(np.zeros(3, np.float32))
    assert not listen(np.zeros(0, np.float32))


def test_plan_knows_how_much_it_needs() -> None:
    longest = max(len(w.envelope) / w.rate_hz for w in WAVEFORMS.values())
    assert longest <= PLAN.burst_s <= 1.3 * longest
    assert 0 < PLAN.margin_s < 0.05


def test_nothing_to_listen_for_is_refused() -> None:
    with pytest.raises(ValueError, match="no beacon has a code"):
        make_plan({}, RATE_HZ, SPEED)


def test_samples_that_are_not_finite_are_refused() -> None:
    samples = np.zeros(4800, np.float32)
    samples[7] = np.nan
    with pytest.raises(ValueError, match=r"1 of 4800 samples are not finite"):
        acquire(PLAN, samples, 0, "M", {"A": (0.0, 0.01)})


@pytest.mark.parametrize("lost_s", [3e-3, 12e-3])
def test_samples_that_were_never_recorded_count_for_nothing(lost_s: float, rng: np.random.Generator) -> None:
    """A drop-out amid bursts that two others hide behind: what it took is no sound, and no phantom makes up for it."""
    samples = heard(MIXED, 1e-3, rng)
    first = int(0.066 * RATE_HZ)
    samples[first : first + int(lost_s * RATE_HZ)] = 0.0
    found = listen(samples)
    assert set(found) == {"A", "B", "D"}
    for name, arrival_s, rate, _ in MIXED:
        assert agrees(found[name], arrival_s, rate)


def test_where_nothing_comes_as_predicted_the_caller_decides_what_then(rng: np.random.Generator) -> None:
    samples = heard([("A", 0.061, 0.0, 0.2 + 0j)], 1e-3, rng)
    wrong = {"A": Prediction("A", "M", 0.1, 2e-4, 0.0, 0.05)}
    assert agrees(listen(samples, predictions=wrong)["A"], 0.061, 0.0)
    assert not listen(samples, predictions=wrong, everywhere=False)
