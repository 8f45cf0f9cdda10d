"""Range figures against numbers worked out by hand."""

import numpy as np
import pytest

from sonofix.records import Truth
from sonofix.score import RangeColumns, heard_range_m, node_position_m, score_ranges
from sonofix.site import Site

C = 340.0


def site(beacon: dict, microphone: dict, **more: object) -> Site:
    return Site.model_validate(
        {
            "vehicle": [{"id": "agv"}],
            "beacon": [{"id": "B", **beacon}],
            "microphone": [{"id": "M", **microphone}],
            **more,
        }
    )


def straight(speed_mps: float, from_m: float = 3.0, yaw_rad: float | None = None) -> dict[str, Truth]:
    """A vehicle along x, 10 s."""
    time = np.linspace(-1.0, 10.0, 1101)
    place = np.column_stack([from_m + speed_mps * time, 0 * time, 0 * time])
    return {"agv": Truth("agv", time, place, None if yaw_rad is None else np.full(len(time), yaw_rad))}


def rows(range_m: list[float], time_s: list[float], **more: object) -> RangeColumns:
    count = len(range_m)
    unknown = np.full(count, np.nan)
    given = {"emitter": ("B",) * count, "receiver": ("M",) * count, "used": np.ones(count, bool)}
    given |= {"sd_m": unknown, "range_rate_mps": unknown, "clock_offset_m": unknown} | more
    return RangeColumns(np.array(time_s), range_m=np.array(range_m), **given)


def test_moving_microphone_is_measured_where_it_hears():
    at = site({"position_m": (0, 0, 0)}, {"vehicle": "agv"})
    truths = straight(2.0)
    figures = score_ranges(at, truths, rows([3.010, 5.010, 7.010], [0.0, 1.0, 2.0]), C)
    assert figures.used.count == 3
    assert figures.used.median_m == pytest.approx(0.010, abs=1e-12)
    assert figures.used.rms_m == pytest.approx(0.010, abs=1e-12)
    assert figures.used.p95_m == pytest.approx(0.010, abs=1e-12)
    assert figures.range_rate_rms_mps is None
    assert figures.error_over_sd_rms is None


@pytest.mark.parametrize("speed_mps", [-3.0, 0.0, 2.0, 30.0])
def test_moving_beacon_is_measured_where_it_sounded(speed_mps):
    """The beacon recedes along x: r = x(t − r/c), so r = x(t) / (1 + v/c)."""
    at = site({"vehicle": "agv"}, {"position_m": (0, 0, 0)})
    time = np.array([0.5, 0.7])
    expected = (40.0 + speed_mps * time) / (1 + speed_mps / C)
    found = heard_range_m(at.beacons[0], at.microphones[0], straight(speed_mps, 40.0), time, C)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_range_rate_error():
    at = site({"position_m": (0, 0, 0)}, {"vehicle": "agv"})
    given = rows([5.0, 7.0], [1.0, 2.0], range_rate_mps=np.array([2.1, 1.8]))
    found = score_ranges(at, straight(2.0), given, C).range_rate_rms_mps
    assert found == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 2), abs=1e-9)


def test_lever_arm_turns_with_the_vehicle():
    at = site({"position_m": (0, 0, 0)}, {"vehicle": "agv", "lever_arm_m": (0.5, 0.2, 0.4)})
    place = node_position_m(at.microphones[0], straight(0.0, 3.0, np.pi / 2), np.array([1.0]))
    np.testing.assert_allclose(place, [[3.0 - 0.2, 0.5, 0.4]], atol=1e-12)


def test_clock_offset_is_taken_off_and_sd_judges_the_rest():
    at = site({"position_m": (0, 0, 0)}, {"vehicle": "agv"})
    given = rows([4.0, 5.5], [0.0, 1.0], clock_offset_m=np.array([0.99, 0.48]), sd_m=np.array([0.01, 0.02]))
    figures = score_ranges(at, straight(2.0), given, C)
    assert figures.used.rms_m == pytest.approx(np.sqrt((0.01**2 + 0.02**2) / 2))
    assert figures.error_over_sd_rms == pytest.approx(1.0)


def test_gross_errors_are_counted_and_set_aside_and_unused_rows_are_of_all_only():
    at = site({"position_m": (0, 0, 0)}, {"vehicle": "agv"})
    given = rows([3.02, 3.5, 2.0], [0.0, 0.0, 0.0], used=np.array([True, True, False]))
    figures = score_ranges(at, straight(2.0), given, C)
    assert (figures.used.count, figures.used.beyond_5cm) == (2, 1)
    assert (figures.every.count, figures.every.beyond_5cm) == (3, 2)
    assert figures.used.rms_within_5cm_m == pytest.approx(0.02)


def test_rows_that_cannot_be_judged_are_left_out():
    at = site({"position_m": (0, 0, 0)}, {"vehicle": "agv"})
    strangers = rows([3.0, 4.0], [0.0, 0.0], emitter=("B", "X"))
    assert score_ranges(at, straight(2.0), strangers, C).every.count == 1
    assert score_ranges(at, {}, rows([3.0], [0.0]), C).every.count == 0
    empty = score_ranges(at, straight(2.0), rows([], []), C)
    assert empty.used.rms_m is None
    assert empty.used.count == 0


def test_share_of_expected_counts_epochs_and_pairs():
    at = site({"position_m": (0, 0, 0)}, {"vehicle": "agv"}, schedule={"period_s": 0.5})
    # 11 s of truth hold 22 epochs
    found = score_ranges(at, straight(2.0), rows([3.0] * 11, [0.0] * 11), C)
    assert found.share_of_expected == pytest.approx(11 / 22)
    assert score_ranges(site({"position_m": (0, 0, 0)}, {"vehicle": "agv"}), straight(2.0), rows([3.0], [0.0]),
                        C).share_of_expected is None  # fmt: skip
