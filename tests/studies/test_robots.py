"""The third seed's study: its numbers, detection by code and by filters, and a knock that is repaired."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, norm

from sonofix.records import Finding, Sheet
from sonofix.studies import begin, robots_bursts, robots_collision, robots_detection, robots_fusion
from sonofix.studies.work import Work


def finished(work: Work) -> Sheet:
    for _ in work.work():
        pass
    sheet = work.sheet()
    assert sheet is not None
    return sheet


def named(sheet: Sheet) -> dict[tuple[str, str], Finding]:
    return {(f.case, f.quantity): f for f in sheet.findings}


@pytest.fixture(scope="module")
def detection() -> Sheet:
    return finished(begin("robots", 30, 1, 0, "detection"))


@pytest.fixture(scope="module")
def collision() -> dict[tuple[str, str], Finding]:
    return named(finished(begin("robots", 60, 1, 0, "collision")))


def test_the_seeds_means_come_out_with_eight_taps(detection: Sheet) -> None:
    """Each is one draw of a mean that scatters from run to run: within four of those deviations."""
    found, name = named(detection), robots_detection.SETTINGS[0].name
    for kind, printed in (("present", 4.956), ("absent", 4.126)):
        mean = found[f"{name}: {kind}", "mean |y|"]
        assert mean.sd is not None
        scatter = mean.sd * np.sqrt(mean.runs)
        assert abs(mean.value - printed) < 4 * scatter
    assert found[name, "told apart"].value == 1.0


def test_other_settings_do_not_tell_a_burst_from_none(detection: Sheet) -> None:
    found = named(detection)
    assert found["LMS, 32 taps, step 1e-4, 1 V", "told apart"].value == 0.0
    assert found["LMS, 32 taps, step 1e-4, 1 V: absent", "mean |y|"].value > 4.5  # within the band, and nothing sounds
    assert found["tone ¼ period off", "told apart"].value == 0.0
    present, absent = (found[f"tone ¼ period off: {kind}", "mean |y|"].value for kind in ("present", "absent"))
    assert present < absent  # a burst makes less than none


def test_the_three_figures_are_drawn(detection: Sheet) -> None:
    titles = ["Figure 2", "Figure 4: a burst", "Figure 5: none", "Amplitude matching"]
    assert [panel.title for panel in detection.panels] == titles
    scan = next(panel for panel in detection.panels if panel.title == "Amplitude matching")
    by_name = {curve.name: curve for curve in scan.curves}
    # 32 taps diverge at steps that 8 still bear: two over the power times the taps
    assert np.isnan(by_name["32 taps, a burst"].y[-3:]).all()
    assert np.isfinite(by_name["8 taps, a burst"].y[-3])


def test_bursts_have_the_energy_that_is_stated() -> None:
    bench = robots_bursts.bench(0.0)
    rng = np.random.default_rng(4)
    count = bench.waveform.duration_s * robots_bursts.RATE_HZ
    coded = np.mean([np.sum(robots_bursts.coded(bench, rng)[0] ** 2) for _ in range(20)])
    # the ring after the last chip adds a little
    assert coded == pytest.approx(bench.power * count, rel=0.02)
    tone = robots_bursts.noise_and_tone(bench, 20.0, rng) - robots_bursts.noise_and_tone(
        bench, None, np.random.default_rng(0)
    )
    assert np.mean(tone**2) == pytest.approx(100 * bench.power + 2 * bench.noise_sd**2, rel=0.02)


def test_a_matched_filter_told_all_is_as_good_as_theory_says() -> None:
    """A known burst in white noise: detection is Q(Q⁻¹(p) − √(E/σ²)) (Kay 1998, eq 4.14); 400 trials."""
    bench, rng = robots_bursts.bench(-14.0), np.random.default_rng(5)
    present, absent, energy = [], [], []
    for _ in range(400):
        burst, _ = robots_bursts.coded(bench, rng)
        noise = robots_bursts.noise_and_tone(bench, None, rng)
        absent.append(robots_bursts.told_score(bench, noise, burst))
        present.append(robots_bursts.told_score(bench, noise + burst, burst))
        # what goes steadily on the carrier is given away
        energy.append(float(burst @ burst - np.sum((bench.carrier @ burst) ** 2)))
    deflection = np.sqrt(np.mean(energy)) / bench.noise_sd
    threshold = norm.isf(0.1) * bench.noise_sd * np.sqrt(np.mean(energy))
    for scores, share in ((absent, 0.1), (present, norm.sf(norm.isf(0.1) - deflection))):
        count = int(np.sum(np.array(scores) > threshold))
        assert binom.ppf(1e-4, 400, share) <= count <= binom.ppf(1 - 1e-4, 400, share)


def test_under_a_loud_tone_the_code_is_heard_and_filters_are_lost() -> None:
    bench = robots_bursts.bench(0.0)
    scores = robots_bursts.scored(bench, 0, 6, 40, 20.0)
    share = {name: robots_bursts.detected(scores, name, np.array([0.1]))[0] for name in robots_bursts.DETECTORS}
    assert share[robots_bursts.TOLD] == share[robots_bursts.SEARCHED] == 1.0
    assert max(share[name] for name in robots_bursts.FILTERS) < 0.7


def test_the_receiver_misses_nothing_under_a_tone_twenty_decibels_louder() -> None:
    missed, alarmed = robots_bursts.decided(robots_bursts.bench(0.0), 0, 8, 60, 20.0)
    # at a thousandth each, two or more of sixty come once in 580 times
    assert missed.sum() <= 1
    assert alarmed.sum() <= 1


def test_bounds_are_exact() -> None:
    """None of n: 1 − p of all n trials remain at 5 %, so p = 1 − 0.05^(1/n); all of n: no bound."""
    assert robots_bursts.at_most(0, 3000) == pytest.approx(1 - 0.05 ** (1 / 3000), rel=1e-9)
    assert robots_bursts.at_most(7, 7) == 1.0
    # of 50 trials at the bound, so few come with 5 %
    assert binom.cdf(3, 50, robots_bursts.at_most(3, 50)) == pytest.approx(0.05, rel=1e-9)


def test_a_knock_is_repaired_as_printed_and_properly(collision: dict[tuple[str, str], Finding]) -> None:
    for name in ("as printed", "with a test for collisions"):
        assert collision[name, "back within three epochs"].value == 1.0
        assert collision[name, "rms later"].value < 0.04
    # the replacement looks one epoch back; a test for collisions does not wait for that
    assert collision["as printed", "rms at the first epoch after"].value > 1.0
    assert collision["with a test for collisions", "rms at the first epoch after"].value < 0.05
    assert collision["eqs 5 to 9 alone", "back within three epochs"].value == 0.0
    assert collision["wheels and compass", "rms at the end"].value == pytest.approx(5.0, abs=0.1)


def test_a_collision_is_reported_once_and_the_covariance_is_right(collision: dict[tuple[str, str], Finding]) -> None:
    name = "with a test for collisions"
    assert collision[name, "collision reported at once"].value == 1.0
    assert collision[name, "reported elsewhere"].value == 0.0
    nees = collision[name, "NEES of x, y"]
    assert nees.sd is not None
    assert abs(nees.value - 2.0) < 5 * nees.sd
    # keeping what the estimate knew is better than throwing it away
    assert collision[name, "rms before"].value < 0.95 * collision["as printed", "rms before"].value


def test_without_a_knock_the_proper_way_is_eqs_5_to_9(rng: np.random.Generator) -> None:
    told = rng.normal(0.5, 0.01, (3, 10, 2))
    fixes = np.cumsum(np.full((3, 10, 2), 0.5), axis=1) + 0.02 * rng.standard_normal((3, 10, 2))
    noise = np.tile(0.02**2 * np.eye(2), (3, 10, 1, 1))
    settings = (np.zeros(2), np.zeros((2, 2)), told, 0.01**2 * np.eye(2), fixes, noise)
    proper, plain = (robots_fusion.follow(*settings, way=way) for way in ("proper", "plain"))
    assert not proper.collision.any()
    np.testing.assert_array_equal(proper.places_m, plain.places_m)
    # by hand, with matrices that are multiples of one: variance p ← (p + q) r / (p + q + r)
    p, q, r, state = 0.0, 0.01**2, 0.02**2, np.zeros((3, 2))
    for k in range(10):
        gain = (p + q) / (p + q + r)
        state = state + told[:, k] + gain * (fixes[:, k] - state - told[:, k])
        p = (p + q) * (1 - gain)
        np.testing.assert_allclose(plain.places_m[:, k], state, rtol=1e-12)
        np.testing.assert_allclose(plain.covariance_m2[:, k], np.tile(p * np.eye(2), (3, 1, 1)), atol=1e-18)


def test_epochs_until_back_are_counted_from_the_first() -> None:
    miss = np.array([[9.0, 0.0, 0.0, 0.0], [0.0, 9.0, 0.0, 0.0], [0.0, 9.0, 0.0, 9.0]])
    np.testing.assert_array_equal(robots_fusion.epochs_until_back(miss, 1, 1.0), [1.0, 2.0, 4.0])


def test_runs_are_the_same_however_many_there_are() -> None:
    few, many = robots_collision.simulated(range(1), 3), robots_collision.simulated(range(2), 3)
    np.testing.assert_array_equal(few.fixes_m, many.fixes_m[:1])
    assert not np.array_equal(many.fixes_m[0], many.fixes_m[1])


def test_a_knock_is_heard_reported_and_repaired_from_waveforms() -> None:
    sheet = finished(begin("robots", 1, 0, 1, "collision"))
    found = named(sheet)
    assert found["from waveforms: track", "rms before"].value < 0.05
    assert found["from waveforms: track", "until back"].value <= robots_collision.WITHIN
    assert found["from waveforms", "collision reported"].value == 1.0
    assert "5.0" in sheet.panels[-1].note  # metres from where its own sensors had it


@pytest.mark.parametrize(
    ("name", "part", "words"),
    [
        ("robots", "leap", "study robots, part leap: there is none of that name; choose of detection, collision"),
        ("robots", None, "study robots, part None: there is none of that name; choose of detection, collision"),
        ("quasi-gps", "detection", "it is of one piece: leave the part out"),
    ],
)
def test_parts_that_are_none_are_told(name: str, part: str | None, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        begin(name, 1, 0, 0, part)
