"""Leap-frog of the third seed: what three robots hear of each other, errors over 100 m, and against odometry."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.records import Finding, Floats, Sheet
from sonofix.studies import begin, robots_leapfrog, robots_stops, robots_strip

RUNS = 40


@pytest.fixture(scope="module")
def sheet() -> Sheet:
    work = begin("robots", RUNS, 4, 0, "leapfrog")
    shares = [share for _, share in work.work()]
    assert shares == sorted(shares)
    found = work.sheet()
    assert found is not None
    return found


def named(sheet: Sheet) -> dict[tuple[str, str], Finding]:
    return {(f.case, f.quantity): f for f in sheet.findings}


def test_ranges_heard_under_a_tone_err_as_stated() -> None:
    """Twenty-four squares of normal errors: their root mean square scatters by 1 / √48."""
    bench = robots_stops.bench(robots_strip.SNR_DB, robots_strip.TONE_DB)
    ranging, miss, sd = robots_strip.calibrated(bench, 5)
    assert miss.shape == (robots_strip.BENCH_STOPS, 3)
    assert abs(np.sqrt(np.mean((miss / sd) ** 2)) - 1.0) < 4 / np.sqrt(2 * miss.size)
    assert 0.0005 < ranging.sd_m < 0.005


def test_a_stop_hears_the_speed_of_sound_and_the_tone_is_what_is_stated() -> None:
    bench = robots_stops.bench(30.0, 20.0)
    heard = robots_stops.stop(bench, robots_strip.START_M, 0.01, (1, 2), epochs=1)
    assert heard.pairs == (("K", "R2"), ("K", "R1"), ("R2", "R1"))
    true = 1.01 * np.array([np.hypot(10 / 3, 10.0), 20 / 3, np.hypot(10 / 3, 10.0)])
    np.testing.assert_allclose(heard.range_m, true, atol=5 * np.sqrt(np.diag(heard.covariance_m2)).max())
    # 20 dB over a burst's power is ten times its amplitude
    assert bench.tone.amplitude == pytest.approx(10 * robots_stops.BURST_AMPLITUDE)


@pytest.mark.prove
def test_errors_are_as_stated_and_within_a_thousandth_of_the_path(sheet: Sheet) -> None:
    found = named(sheet)
    for case in robots_strip.CASES:
        # of 2 n normal errors in all, in one direction mostly
        assert abs(found[case.name, "error over its deviation"].value - 1.0) < 4 / np.sqrt(2 * RUNS)
        assert found[case.name, "end error over path"].value < 1e-3
        assert abs(found[case.name, "NEES of x, y"].value - 2.0) < 4 * 2 / np.sqrt(RUNS)


def test_the_speed_of_sound_costs_its_share_of_the_way_and_a_base_tells_it(sheet: Sheet) -> None:
    found = named(sheet)
    # a hundred metres and the strip's own length
    assert found["0.01 % of the speed of sound", "end error it makes"].value == pytest.approx(0.0107, abs=0.0003)
    doubted, based = (found[case.name, "error of the speed of sound"] for case in robots_strip.CASES[1:])
    assert doubted.value == pytest.approx(5e-4, rel=4 / np.sqrt(2 * RUNS))
    assert based.value < 0.6 * doubted.value


def test_leapfrog_is_far_ahead_of_odometry(sheet: Sheet) -> None:
    found = named(sheet)
    assert found["odometry alone", "end error, rms"].value > 10 * found["known to 0.05 %", "end error, rms"].value


def test_plans_asked_anew_keep_their_word(sheet: Sheet) -> None:
    found = named(sheet)
    case = f"planned anew, for {100 * robots_leapfrog.PLANNED_SD_M:g} cm"
    assert found[case, "end error stated, rms"].value <= robots_leapfrog.PLANNED_SD_M
    measured = found[case, "end error, rms"]
    assert measured.value < robots_leapfrog.PLANNED_SD_M * (1 + 4 / np.sqrt(2 * RUNS))
    assert measured.claim == "at most 6 cm"
    assert found[case, "stops out of reach, a run"].value == 0.0
    # half of the error takes more leaps
    leaps = [found[f"planned anew, for {size} cm", "leaps"].value for size in ("3", "4.5", "6")]
    assert leaps == sorted(leaps, reverse=True)
    assert leaps[0] > leaps[-1] + 5


def test_leaps_are_listed_one_by_one(sheet: Sheet) -> None:
    (listing,) = sheet.listings
    rows = [dict(zip(listing.columns, row, strict=True)) for row in listing.rows]
    assert [row["leap"] for row in rows] == list(range(1, len(rows) + 1))
    assert {row["robot"] for row in rows} == set(robots_stops.ROBOTS)
    assert rows[-1]["left"] == 0
    assert rows[-1]["end_sd_m"] == rows[-1]["sd_m"]
    # each goes as far as from where it stood last, to the deviation with which it lands (5 σ of 5 %)
    stood: dict[str | int | float, Floats] = dict(zip(robots_stops.ROBOTS, robots_strip.START_M, strict=True))
    for row in rows:
        place = np.array([row["x_m"], row["y_m"]], float)
        went = float(np.hypot(*(place - stood[row["robot"]])))
        assert float(row["way_m"]) == pytest.approx(went, rel=5 * robots_strip.WAY_SD)
        stood[row["robot"]] = place
    assert listing.note.startswith("6 cm wanted; foreseen at the start: ")


def test_what_is_out_of_reach_is_told_with_the_best_there_is() -> None:
    work = begin("robots", 1, 4, 0, "leapfrog", 0.004)
    for _ in work.work():
        pass
    sheet = work.sheet()
    assert sheet is not None
    foreseen = named(sheet)["planned once, for 0.4 cm", "end error foreseen"]
    assert foreseen.claim == "out of reach: the best there is"
    assert 0.01 < foreseen.value < 0.03
    best = f"{100 * foreseen.value:.3g} cm"
    assert f"0.4 cm wanted, which is out of reach; the best that can be reached is {best}" in sheet.listings[0].note
    assert named(sheet)["planned anew, for 0.4 cm", "end error, rms"].claim == f"out of reach; best: {best}"


@pytest.mark.parametrize(
    ("part", "wanted_m", "words"),
    [
        ("collision", 0.06, "only study robots, part leapfrog"),
        ("leapfrog", 0.0, "above 0 m"),
        ("leapfrog", float("nan"), "above 0 m"),
    ],
)
def test_wishes_that_are_none_are_told(part: str, wanted_m: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        begin("robots", 1, 0, 0, part, wanted_m)


def test_panels_show_growth_and_places(sheet: Sheet) -> None:
    along, strip, speed, weighed, plans, reached = sheet.panels
    by_name = {curve.name: curve for curve in along.curves}
    assert by_name["leap-frog"].y[-1] > 2 * by_name["leap-frog"].y[2]
    assert (by_name["leap-frog"].y[4:] < by_name["CPS-II, 0.12 %"].y[4:]).all()
    stops = next(curve for curve in strip.curves if curve.name == "stops of all, in order")
    assert stops.x[0] == 0.0
    assert stops.x[-1] == pytest.approx(robots_strip.COURSE.length_m, abs=4.0)
    assert {curve.name for curve in speed.curves} >= {"foreseen", "found"}
    # cases apart are not joined by a line
    assert next(curve.kind for curve in speed.curves if curve.name == "found") == "points"
    assert weighed.logarithmic
    once, anew, wanted = plans.curves
    assert once.y[0] == pytest.approx(anew.y[0], rel=0.01)
    assert anew.y[0] <= wanted.y[0]
    # asked anew, what a plan has to spare is spent on longer leaps
    assert np.nanmedian(once.y) < np.nanmedian(anew.y) < np.nanmax(anew.y) < 1.05 * wanted.y[0]
    by_name = {curve.name: curve for curve in reached.curves}
    assert (by_name["stated"].y <= by_name["stated"].x).all()


@pytest.mark.parametrize(("runs", "claim"), [(1, ""), (robots_leapfrog.FEW, "0.7 to 1.4")])
def test_nothing_is_expected_of_too_few_runs(runs: int, claim: str) -> None:
    assert robots_leapfrog.ratio(np.ones((runs, 2)), np.tile(np.eye(2), (runs, 1, 1)), "").claim == claim


def test_a_robot_that_hears_nobody_ends_the_run_with_a_reason() -> None:
    deaf = robots_stops.Heard((), np.zeros(0), np.zeros((0, 0)))
    with pytest.raises(RuntimeError, match="all range each other"):
        robots_strip.drive(robots_strip.CASES[0], lambda place_m, scale: deaf, np.random.default_rng(1))
