"""The second seed's study: the claim at both noises, temperature, blind zones, and a short walk from waveforms."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.channel import Waypoints
from sonofix.records import Finding, Sheet
from sonofix.studies import begin, pedestrian, quasi_gps


def finished(work: pedestrian.Work) -> Sheet:
    last: dict[str, float] = {}
    for what, share in work.work():
        assert share >= last.get(what, 0.0)
        last[what] = share
    assert all(share == pytest.approx(1.0) for share in last.values())
    sheet = work.sheet()
    assert sheet is not None
    return sheet


def named(sheet: Sheet) -> dict[tuple[str, str], Finding]:
    return {(f.case, f.quantity): f for f in sheet.findings}


@pytest.fixture(scope="module")
def found() -> dict[tuple[str, str], Finding]:
    return named(finished(begin("pedestrian", 40, 1, 0)))


def test_the_claim_holds_at_100_us_and_not_at_300(found: dict[tuple[str, str], Finding]) -> None:
    for noise, holds in (("100 µs", True), ("300 µs", False)):
        claim = found[f"{noise}: integrated", "95 %"]
        assert claim.sd is not None
        # by more than ten standard errors either way
        assert (claim.value + 10 * claim.sd < pedestrian.CLAIM_M) == holds
        assert (claim.value - 10 * claim.sd > pedestrian.CLAIM_M) != holds


def test_drift_is_suppressed_and_both_are_better_than_fixes(found: dict[tuple[str, str], Finding]) -> None:
    for noise, at_least in (("100 µs", 1.0), ("300 µs", 1.3)):
        fixes = found[f"{noise}: fixes alone", "rms"].value
        both = found[f"{noise}: integrated", "rms"].value
        drift = found[f"{noise}: steps alone", "rms after ten laps"].value
        assert both * at_least < fixes
        assert drift > 10 * both


def test_noise_of_fixes_grows_with_that_of_times(found: dict[tuple[str, str], Finding]) -> None:
    near, far = (found[f"{noise}: fixes alone", "rms"].value for noise in ("100 µs", "300 µs"))
    assert far / near == pytest.approx(3.0, rel=0.01)  # the same noise, three times as large
    # 3.4 cm of way a time, at a dilution of a little over one
    assert 0.03 < near < 0.05


def test_air_that_is_not_corrected_for_costs_centimetres(found: dict[tuple[str, str], Finding]) -> None:
    name = "100 µs, air taken for 10 °C: fixes alone"
    assert found[name, "rms"].value > 1.5 * found["100 µs: fixes alone", "rms"].value


def test_steps_alone_lose_the_way_in_blind_zones(found: dict[tuple[str, str], Finding]) -> None:
    end = found["100 µs, blind zones: integrated", "rms at their end"].value
    assert end > 2 * found["100 µs: integrated", "rms"].value
    assert end < found["100 µs: steps alone", "rms after ten laps"].value


def test_a_walk_is_the_same_however_many_there_are() -> None:
    few = pedestrian.simulated(range(2), 3, 1e-4, steps=8)
    many = pedestrian.simulated(range(4), 3, 1e-4, steps=8)
    np.testing.assert_array_equal(few.both, many.both[:2])
    assert not np.array_equal(few.both[0], few.both[1])


def test_chords_of_the_walk_that_is_heard_are_steps() -> None:
    motion = Waypoints(((2.0, 2.0, 0.85), (10.0, 2.0, 0.85), (10.0, 6.0, 0.85)), 1.2, radius_m=0.3)
    np.testing.assert_allclose(pedestrian.chords(motion, np.array([0.44, 0.94])), [[0.6, 0.0]] * 2, atol=1e-9)


def test_a_short_walk_from_waveforms() -> None:
    sheet = finished(pedestrian.study(1, 0, 1, walk_s=4.0, blind_s=(2.0, 3.0)))
    found = named(sheet)
    assert found["from waveforms: fixes alone", "rms"].value < 0.03
    assert found["from waveforms: track, beacons heard", "rms"].value < 0.03
    assert found["from waveforms: track", "rms at blind zone's end"].value < 0.15
    panel = sheet.panels[-1]
    assert panel.title == "From waveforms"
    (fixes,) = [curve for curve in panel.curves if curve.kind == "raw"]
    # one beacon alone gives no fix: two epochs of eight
    assert np.count_nonzero(np.isnan(fixes.y)) == 2


def test_a_short_drive_from_waveforms() -> None:
    sheet = finished(quasi_gps.study(1, 0, 1, drive_s=6.0))
    found = named(sheet)
    assert found["from waveforms: fixes", "position"].value < 0.003
    assert found["from waveforms: track", "position"].value < 0.003
    assert found["from waveforms: track", "velocity"].value < 0.01
    assert [panel.note for panel in sheet.panels] == ["as printed"] * 4 + ["from waveforms"] * 4


def test_nothing_finished_is_no_sheet_and_a_part_is_one() -> None:
    work = begin("quasi-gps", 60, 0, 0)
    assert work.sheet() is None
    next(iter(work.work()))
    sheet = work.sheet()
    assert sheet is not None
    assert {f.runs for f in sheet.findings} == {25}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("robot", 1, 0, 0), "study robot: there is none of that name; there are quasi-gps, pedestrian, robots"),
        (("quasi-gps", 0, 0, 0), "runs 0: it must be 1 or more"),
        (("quasi-gps", 1, 0, -1), "waveforms -1: it must be 0 or more"),
    ],
)
def test_misuse_is_told(given: tuple[str, int, int, int], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        begin(*given)
