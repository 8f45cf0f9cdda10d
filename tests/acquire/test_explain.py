"""What is told of an epoch is what the receiver did with it: paths, surfaces, spectra, stages and verdicts."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from acquire.test_plan import HALF_S, LENGTH_S, MIXED, PLAN, RATE_HZ, SPEED, WAVEFORMS, WINDOW, heard, rendered
from sonofix.acquire.baseband import downconvert
from sonofix.acquire.explain import Hearing, insight, surface
from sonofix.acquire.plan import acquire
from sonofix.acquire.search import profile
from sonofix.records import BandInsight, BeaconInsight, Insight, Prediction

SENT_S = {"A": 0.0, "B": 0.001, "C": 0.002, "D": 0.003}


def seen(
    samples: NDArray[np.float32],
    names: str = "ABCD",
    predictions: dict[str, Prediction] | None = None,
    first: int = 0,
    window: tuple[float, float] = WINDOW,
) -> Insight:
    windows = dict.fromkeys(names, window)
    why = "" if predictions else "nothing is known yet"
    hearing = Hearing(PLAN, "M", samples, first, windows, predictions or {}, SENT_S, ("odd",), why)
    return insight(hearing, 7, 0.0, "known")


def beacon(told: Insight, name: str) -> BeaconInsight:
    return next(b for band in told.bands for b in band.beacons if b.beacon == name)


def band_of(told: Insight) -> BandInsight:
    (band,) = told.bands
    return band


def warm() -> dict[str, Prediction]:
    return {n: Prediction(n, "M", arrival_s, 1e-4, rate, 0.05) for n, arrival_s, rate, _ in MIXED}


@pytest.mark.parametrize("predictions", [None, warm()], ids=["cold", "warm"])
def test_detections_and_paths_are_those_of_the_receiver(
    predictions: dict[str, Prediction] | None, rng: np.random.Generator
) -> None:
    samples = heard([*MIXED, ("A", 0.064, 1.3, 0.08j)], 1e-3, rng)
    told = seen(samples, predictions=predictions)
    found, notes = acquire(PLAN, samples, 0, "M", dict.fromkeys("ABCD", WINDOW), predictions)
    assert [d.emitter for d in told.detections] == [d.emitter for d in found]
    assert told.notes == ("odd", *notes)
    for mine, theirs in zip(told.detections, found, strict=True):
        assert (mine.arrival_s, mine.time_scale, mine.amplitude) == (
            theirs.arrival_s,
            theirs.time_scale,
            theirs.amplitude,
        )
        assert np.array_equal(mine.covariance, theirs.covariance)
        shown = beacon(told, mine.emitter)
        path = shown.reported
        assert path is not None
        assert shown.verdict == ""
        assert path.range_m == pytest.approx(SPEED * (mine.arrival_s - HALF_S - SENT_S[mine.emitter]), abs=1e-9)
        assert path.range_sd_m == pytest.approx(SPEED * np.sqrt(mine.covariance[0, 0]), rel=1e-9)
        assert path.range_rate_mps == pytest.approx(SPEED * (1 - mine.time_scale), abs=1e-9)
        assert path.range_rate_sd_mps == pytest.approx(SPEED * np.sqrt(mine.covariance[1, 1]), rel=1e-9)
        assert path.amplitude == mine.amplitude
        kept = [p for p in shown.paths if not p.dropped]
        ways = [path.range_m + SPEED * p.delay_s for p in theirs.paths]
        assert sorted(p.range_m for p in kept) == pytest.approx(sorted(ways), abs=1e-9)
        assert sum(p.is_range for p in kept) == 1


def test_surface_is_the_correlation_with_every_replica(rng: np.random.Generator) -> None:
    band, banks = PLAN.bands[0]
    bank = banks[0]
    baseband, start_s = downconvert(heard(MIXED, 1e-3, rng), 0, band)
    begins_s, power = surface(baseband, start_s, bank, band, 0.01, 0.05)
    assert power.shape == (len(bank.replicas), len(begins_s))
    length = bank.replicas.shape[1]
    first = round((begins_s[0] - bank.lead_s - start_s) * band.rate_hz)
    for row in rng.integers(len(bank.replicas), size=5):
        for column in rng.integers(len(begins_s), size=5):
            piece = baseband[first + column : first + column + length]
            plain = abs(np.vdot(bank.replicas[row][: len(piece)], piece)) ** 2
            assert power[row, column] == pytest.approx(plain, rel=1e-3, abs=1e-6 * float(power.max()))
    # and what the search boils down is the same plane
    best, _, _ = profile(baseband[first : first + len(begins_s) - 1 + length], bank, len(begins_s))
    np.testing.assert_allclose(power.max(axis=0), best, rtol=1e-3)


def test_cancelling_brings_a_quiet_beacon_out(rng: np.random.Generator) -> None:
    told = seen(heard([("A", 0.06, 1.3, 1.0), ("B", 0.062, -2.1, 1 / 64)], 5e-4, rng))
    quiet = beacon(told, "B")
    path = quiet.reported
    assert path is not None
    row, column = np.unravel_index(np.argmax(quiet.alone_db), quiet.alone_db.shape)
    cell_m, cell_mps = np.diff(quiet.range_m)[0], np.diff(quiet.range_rate_mps)[0]
    assert quiet.range_m[column] == pytest.approx(SPEED * (0.062 - HALF_S - SENT_S["B"]), abs=cell_m)
    assert quiet.range_rate_mps[row] == pytest.approx(-2.1, abs=cell_mps)
    assert quiet.alone_db.max() == pytest.approx(path.level_db, abs=2.0)
    # as it was heard, the loud one's cross-talk covers it
    assert quiet.heard_db.max() > quiet.heard_db[row, column] + 3
    loud = beacon(told, "A")
    assert loud.alone_db.max() == pytest.approx(loud.heard_db.max(), abs=0.5)


def test_stages_say_how_much_was_left(rng: np.random.Generator) -> None:
    told = seen(heard([("A", 0.06, 1.3, 1.0), ("B", 0.062, -2.1, 1 / 64)], 5e-4, rng))
    stages = band_of(told).stages
    assert stages[0].deed == "as heard"
    assert stages[-1].deed == "refined"
    assert [(s.deed, s.beacons) for s in stages[1:3]] == [("burst", ("A",)), ("burst", ("B",))]
    levels = [s.left_db for s in stages]
    assert np.diff(levels).max() < 0.1  # less and less, but for what a rough fit took of the noise
    # the power of the burst over the noise's, both behind the filter
    band = PLAN.bands[0][0]
    noise = 4 * 5e-4**2 / band.decimation / band.whiteness
    w = WAVEFORMS["A"]
    inside = slice(int(-w.start_s * w.rate_hz), int((w.duration_s - w.start_s) * w.rate_hz))
    ratio_db = 10 * np.log10(np.mean(np.abs(w.envelope[inside]) ** 2) / noise)
    assert levels[0] == pytest.approx(ratio_db, abs=2.0)  # the margins' noise is measured in few samples
    assert -1.0 < levels[-1] < 3.0  # the burst was 64 dB above: what its model misses stays
    assert band_of(told).left_power_db.mean() < 3
    assert band_of(told).heard_power_db.max() > 40


def test_spectra_hold_the_power(rng: np.random.Generator) -> None:
    noise = (0.01 * rng.standard_normal(int(LENGTH_S * RATE_HZ))).astype(np.float32)
    told = seen(noise)
    # white noise of variance s² has the one-sided density 2 s² / f_s
    level = 10 * np.log10(2 * 0.01**2 / RATE_HZ)
    density = 10 ** (told.spectrum_db / 10)
    assert 10 * np.log10(density[2:].mean()) == pytest.approx(level, abs=0.3)
    band = band_of(told)
    assert 10 * np.log10(np.mean(10 ** (band.heard_db / 10))) == pytest.approx(level, abs=0.5)
    assert band.quiet_db == pytest.approx(level, abs=1.5)
    assert band.edges_hz[0] <= band.frequency_hz.min() < 15e3 < band.frequency_hz.max() <= band.edges_hz[1]
    assert all(b.verdict.endswith("dB are asked") for b in band.beacons)
    # what is tried in noise alone is dropped again
    kept = [p for b in band.beacons for p in b.paths if not p.dropped]
    assert not kept
    assert abs(band.stages[0].left_db - band.stages[-1].left_db) < 0.1


def test_a_tone_is_told_and_gone_from_the_clean_spectrum(rng: np.random.Generator) -> None:
    t = np.arange(int(LENGTH_S * RATE_HZ)) / RATE_HZ
    samples = heard(MIXED, 1e-3, rng) + (0.5 * np.cos(2 * np.pi * 15.8e3 * t)).astype(np.float32)
    told = seen(samples)
    band = band_of(told)
    assert band.tones_hz == pytest.approx((15.8e3,), abs=1.0)
    assert [s.deed for s in band.stages[:2]] == ["as heard", "tones"]
    at = int(np.argmin(np.abs(band.frequency_hz - 15.8e3)))
    assert band.heard_db[at] > band.clean_db[at] + 20
    assert "a tone at 15.80" in " ".join(told.notes)


def test_clicks_are_shown_where_they_were(rng: np.random.Generator) -> None:
    samples = heard(MIXED, 1e-3, rng)
    at = int(0.07 * RATE_HZ)
    samples[at : at + 24] += (0.05 * rng.standard_normal(24)).astype(np.float32)
    band = band_of(seen(samples))
    assert "clicks" in {s.deed for s in band.stages}
    when_s = band.time_s[band.aside]
    assert len(when_s)
    assert np.all(np.abs(when_s - 0.07) < 0.004)
    assert not band_of(seen(heard(MIXED, 1e-3, rng))).aside.any()


def test_warm_windows_are_those_searched(rng: np.random.Generator) -> None:
    told = seen(heard(MIXED, 1e-3, rng), predictions=warm())
    assert told.search == "warm"
    for name, arrival_s, rate, _ in MIXED:
        predicted = beacon(told, name).predicted
        assert predicted is not None
        (near_m, far_m), (slow, fast) = predicted
        way_m = SPEED * (arrival_s - HALF_S - SENT_S[name])
        assert (near_m + far_m) / 2 == pytest.approx(way_m, abs=1e-6)
        # five deviations and two samples of the base band
        assert (far_m - near_m) / 2 == pytest.approx(SPEED * (5e-4 + 2 / PLAN.bands[0][0].rate_hz), rel=1e-6)
        assert (slow, fast) == pytest.approx((rate - 0.25, rate + 0.25))
    assert beacon(told, "C").predicted is None


def test_wrong_predictions_are_told(rng: np.random.Generator) -> None:
    samples = heard([("A", 0.061, 0.0, 0.05), ("B", 0.07, 0.0, 0.1)], 1e-3, rng)
    wrong = {"A": Prediction("A", "M", 0.08, 1e-4, 0.0, 0.05), "B": Prediction("B", "M", 0.05, 1e-4, 0.0, 0.05)}
    told = seen(samples, "AB", wrong)
    assert told.search == "cold: no burst came as predicted"
    assert {d.emitter for d in told.detections} == {"A", "B"}
    assert all(b.predicted is None for b in band_of(told).beacons)
    assert seen(heard(MIXED, 1e-3, rng)).search == "cold: nothing is known yet"


def test_verdicts_say_why_there_is_no_range(rng: np.random.Generator) -> None:
    samples = heard([("A", 0.061, 0.0, 0.05), ("B", 0.07, 0.0, 0.1)], 1e-3, rng)
    expected = {"A": Prediction("A", "M", 0.055, 1e-4, 0.0, 0.05), "B": Prediction("B", "M", 0.07, 1e-4, 0.0, 0.05)}
    told = seen(samples, "ABC", expected)
    assert beacon(told, "B").verdict == ""
    late = beacon(told, "A")
    assert late.verdict.startswith("came, but not when its direct sound was due")
    assert late.reported is None
    assert any(not p.dropped for p in late.paths)
    assert "dB are asked" in beacon(told, "C").verdict
    assert not [p for p in beacon(told, "C").paths if not p.dropped]
    lines = told.left_out(band_of(told).beacons)
    assert lines[0] == "Samples: odd."
    assert f"A: no range; {late.verdict}." in lines
    cut = rendered(WAVEFORMS["A"], LENGTH_S - 0.7 * HALF_S, 0.0, 0.2).astype(np.float32)
    cut += (1e-3 * rng.standard_normal(len(cut))).astype(np.float32)
    assert beacon(seen(cut, "A", window=(0.0, 0.19)), "A").verdict == "cut off where the recording begins or ends"


def test_dropped_paths_say_why(rng: np.random.Generator) -> None:
    """So faint that it is tried in some of many epochs, and held in few."""
    dropped = []
    for _ in range(30):
        samples = heard([("A", 0.061, 0.0, 0.1), ("B", 0.07, 0.5, 2.2e-4)], 1e-3, rng)
        dropped += [p for b in band_of(seen(samples, "ABCD")).beacons for p in b.paths if p.dropped]
    assert dropped
    for path in dropped:
        assert path.range_sd_m is None
        assert not path.is_range
        assert "dB are asked" in path.dropped or "no higher" in path.dropped


@pytest.mark.parametrize("count", [0, 3, int(LENGTH_S * RATE_HZ)])
def test_silence_is_told_too(count: int) -> None:
    told = seen(np.zeros(count, np.float32))
    assert told.detections == ()
    for band in told.bands:
        assert band.quiet_db is None
        assert all(b.verdict for b in band.beacons)
        assert all(np.isfinite(b.heard_db).all() and np.isfinite(b.alone_db).all() for b in band.beacons)
