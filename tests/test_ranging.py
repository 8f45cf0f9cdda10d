"""From detections to ranges: the instant that defines a row, signs, delays and offsets, and stated ranges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sonofix.ranging import JERK_MPS3, RANGES_WITHOUT_SD_M, SWEEP_S, range_epoch, stated_epochs, with_sound_speed
from sonofix.records import Acquisition, Detection, RangeEpoch, RangeRows
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

SPEED = 340.0
HALF_S = 31 * 10 / 40e3 / 2


def site_of(synchronised: bool = True, **beacon: Any) -> Site:
    def m_sequence(taps: list[int]) -> dict[str, Any]:
        return {"family": "m-sequence", "degree": 5, "taps": taps}

    return Site.model_validate(
        {
            "air": {"sound_speed_mps": SPEED},
            "schedule": {"period_s": 0.5, "synchronised": synchronised},
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10, "bandwidth_hz": 4e3},
            "vehicle": [{"id": "v"}],
            "beacon": [
                {"id": "A", "position_m": [0, 0, 3], "code": m_sequence([3])} | beacon,
                {"id": "B", "position_m": [5, 0, 3], "code": m_sequence([2])},
            ],
            "microphone": [
                {"id": "M", "channel": 0, "vehicle": "v"},
                {"id": "N", "channel": 1, "vehicle": "v", "delay_s": 2e-3},
            ],
        }
    )


def heard(emitter: str, receiver: str, arrival_s: float, time_scale: float = 1.0) -> Detection:
    covariance = np.array([[4e-12, 1e-12], [1e-12, 9e-12]])
    return Detection(emitter, receiver, arrival_s, time_scale, covariance, 0.1, 12.0)


def epoch_of(site: Site, *detections: Detection, sync_s: float = 2.0, speed_sd_mps: float = 0.0) -> RangeEpoch:
    acquired = Acquisition(4, sync_s, detections, ("odd",))
    return range_epoch(site, waveforms_of(site), acquired, SPEED, speed_sd_mps)


def test_a_row_belongs_to_the_moment_the_middle_is_heard() -> None:
    epoch = epoch_of(site_of(), heard("A", "M", 2.0 + HALF_S + 0.01))
    assert epoch.time_s == pytest.approx([2.0 + HALF_S + 0.01])
    assert epoch.range_m == pytest.approx([3.4])
    assert (epoch.emitter, epoch.receiver) == (("A",), ("M",))
    assert (epoch.index, epoch.sync_s, epoch.clock, epoch.sound_speed_mps) == (4, 2.0, "known", SPEED)
    assert epoch.flags == ("odd",)
    assert epoch.snr_db is not None
    assert epoch.snr_db.tolist() == [12.0]


def test_offsets_and_delays_are_taken_off() -> None:
    """The beacon's make it send later, the microphone's make its samples late: neither is flight."""
    site = site_of(offset_s=0.05, delay_s=1e-3)
    epoch = epoch_of(site, heard("A", "N", 2.0 + 0.05 + 1e-3 + HALF_S + 0.01 + 2e-3))
    assert epoch.range_m == pytest.approx([3.4])
    assert epoch.time_s == pytest.approx([2.0 + 0.05 + 1e-3 + HALF_S + 0.01])


def test_receding_is_positive() -> None:
    """A burst that is heard slowly, time scale below 1, comes from a source that recedes."""
    epoch = epoch_of(site_of(), heard("A", "M", 2.02, 1 - 1.7 / SPEED), heard("B", "M", 2.03, 1 + 0.34 / SPEED))
    assert epoch.range_rate_mps == pytest.approx([1.7, -0.34])
    bent = JERK_MPS3 * (2 * HALF_S) ** 2 / 40
    assert epoch.range_rate_sd_mps == pytest.approx(np.hypot(SPEED * np.array([3e-6, 3e-6]), bent))


def test_a_cubic_way_tilts_its_parabola_by_a_fortieth_of_jerk_and_duration_squared() -> None:
    t = np.linspace(-HALF_S, HALF_S, 20001)
    tilt = np.polynomial.polynomial.polyfit(t, JERK_MPS3 * t**3 / 6, 2)[1]
    assert tilt == pytest.approx(JERK_MPS3 * (2 * HALF_S) ** 2 / 40, rel=1e-3)


def test_rows_come_in_order_of_arrival() -> None:
    epoch = epoch_of(site_of(), heard("B", "M", 2.03), heard("A", "N", 2.025), heard("A", "M", 2.02))
    assert epoch.emitter == ("A", "A", "B")
    assert epoch.receiver == ("M", "N", "M")
    assert (np.diff(epoch.time_s) > 0).all() or epoch.time_s[0] >= epoch.time_s[1]


def test_variance_is_the_arrivals_and_what_all_rows_share() -> None:
    late = [heard("A", "M", 2.0 + HALF_S + 0.01), heard("B", "M", 2.0 + HALF_S + 0.03)]
    alone = epoch_of(site_of(), *late)
    np.testing.assert_allclose(alone.covariance_m2, np.diag([4e-12 * SPEED**2] * 2))
    # the speed's error is one for all: 3.4 m and 10.2 m are wrong in proportion
    shared = epoch_of(site_of(), *late, speed_sd_mps=0.6)
    ranges = np.array([3.4, 10.2])
    expected = np.diag([4e-12 * SPEED**2] * 2) + (0.6 / SPEED) ** 2 * np.outer(ranges, ranges)
    np.testing.assert_allclose(shared.covariance_m2, expected)


def test_one_unknown_offset_is_in_all_rows() -> None:
    detections = [heard("A", "M", 2.0 + HALF_S + 0.01), heard("B", "M", 2.0 + HALF_S + 0.03)]
    epoch = epoch_of(site_of(synchronised=False), *detections, speed_sd_mps=0.6)
    assert epoch.clock == "common"
    assert np.diff(epoch.range_m) == pytest.approx([6.8])
    # flights are not known then: only their differences scale with the sound speed
    own = 4e-12 * SPEED**2
    np.testing.assert_allclose(epoch.covariance_m2, np.diag([own, own + (0.6 / SPEED * 6.8) ** 2]))


def test_nothing_heard_is_an_epoch_too() -> None:
    for synchronised in (True, False):
        epoch = epoch_of(site_of(synchronised), speed_sd_mps=0.6)
        assert len(epoch) == 0
        assert epoch.covariance_m2.shape == (0, 0)
        assert epoch.range_rate_mps is not None
        assert epoch.range_rate_mps.shape == epoch.time_s.shape == epoch.range_m.shape == (0,)


def rows_of(rows: list[tuple[float, str, str, float]], sd_m: list[float] | None = None) -> RangeRows:
    time_s, emitter, receiver, range_m = zip(*rows, strict=True)
    sd = None if sd_m is None else np.array(sd_m)
    return RangeRows(np.array(time_s), emitter, receiver, np.array(range_m), sd)


def test_a_sweep_ends_where_a_pair_comes_again() -> None:
    rows = [
        (0.0, "A", "v", 1.0),
        (0.1, "B", "v", 2.0),
        (0.2, "A", "v", 1.1),
        (0.3, "B", "w", 2.1),
        (0.4, "B", "v", 2.2),
    ]
    epochs = stated_epochs(rows_of(rows), site_of())
    assert [e.emitter for e in epochs] == [("A", "B"), ("A", "B", "B")]
    assert [e.receiver for e in epochs] == [("v", "v"), ("v", "w", "v")]
    assert [e.index for e in epochs] == [0, 1]
    assert [e.sync_s for e in epochs] == [0.0, 0.2]
    assert epochs[1].range_m.tolist() == [1.1, 2.1, 2.2]
    assert epochs[1].time_s.tolist() == [0.2, 0.3, 0.4]
    assert {e.clock for e in epochs} == {"known"}
    assert all(e.range_rate_mps is None and e.snr_db is None for e in epochs)


def test_a_sweep_is_no_longer_than_a_second() -> None:
    rows = [(0.7 * i, name, "v", 1.0) for i, name in enumerate("ABCDEF")]
    epochs = stated_epochs(rows_of(rows), site_of())
    assert [e.emitter for e in epochs] == [("A", "B"), ("C", "D"), ("E", "F")]
    assert all(np.ptp(e.time_s) <= SWEEP_S for e in epochs)


def test_every_row_is_in_one_epoch_whatever_their_order(rng: np.random.Generator) -> None:
    rows = [
        (float(t), "ABC"[rng.integers(3)], "vw"[rng.integers(2)], float(i)) for i, t in enumerate(rng.uniform(0, 9, 80))
    ]
    epochs = stated_epochs(rows_of(rows), site_of())
    assert sorted(r for e in epochs for r in e.range_m) == [float(i) for i in range(80)]
    times = np.concatenate([e.time_s for e in epochs])
    assert (np.diff(times) >= 0).all()
    assert all(len(set(zip(e.emitter, e.receiver, strict=True))) == len(e) for e in epochs)


def test_deviations_are_as_stated_or_that_of_radio() -> None:
    rows = [(0.0, "A", "v", 1.0), (0.1, "B", "v", 2.0)]
    (some,) = stated_epochs(rows_of(rows, [0.02, np.nan]), site_of())
    np.testing.assert_allclose(some.covariance_m2, np.diag([0.02**2, RANGES_WITHOUT_SD_M**2]))
    (none,) = stated_epochs(rows_of(rows), site_of())
    np.testing.assert_allclose(none.covariance_m2, np.diag([RANGES_WITHOUT_SD_M**2] * 2))


def test_no_rows_are_no_epochs() -> None:
    empty = RangeRows(np.zeros(0), (), (), np.zeros(0), None)
    assert stated_epochs(empty, site_of()) == []


def paired(site: Site, **pair: float) -> Site:
    return Site.model_validate({**site.model_dump(by_alias=True), "pair": [{"from": "A", "to": "N", **pair}]})


def test_a_pairs_bias_is_taken_off_what_is_heard_and_what_is_stated() -> None:
    site = paired(site_of(), bias_m=0.3, bias_sd_m=0.02)
    late = [heard("A", "N", 2.0 + HALF_S + 0.01 + 2e-3), heard("A", "M", 2.0 + HALF_S + 0.01)]
    epoch = epoch_of(site, *late)
    at = {receiver: i for i, receiver in enumerate(epoch.receiver)}
    assert epoch.range_m[[at["N"], at["M"]]] == pytest.approx([3.4 - 0.3, 3.4])
    own = 4e-12 * SPEED**2
    np.testing.assert_allclose(np.diag(epoch.covariance_m2)[[at["N"], at["M"]]], [own + 0.02**2, own])
    assert epoch.bias_m2[[at["N"], at["M"]]] == pytest.approx([0.02**2, 0.0])
    (stated,) = stated_epochs(rows_of([(0.0, "A", "N", 5.0), (0.0, "A", "M", 5.0)], [0.1, 0.1]), site)
    assert stated.range_m == pytest.approx([4.7, 5.0])
    np.testing.assert_allclose(np.diag(stated.covariance_m2), [0.01 + 0.02**2, 0.01])
    assert stated.bias_m2 == pytest.approx([0.02**2, 0.0])


def test_stated_ranges_are_ways_already_whatever_the_delays() -> None:
    rows = rows_of([(0.0, "A", "N", 5.0), (0.0, "B", "M", 5.0)])
    (epoch,) = stated_epochs(rows, site_of(delay_s=3e-3, offset_s=0.05))
    assert epoch.range_m == pytest.approx([5.0, 5.0])


def test_another_sound_speed_keeps_a_bias_within_its_covariance() -> None:
    site = paired(site_of(), bias_sd_m=0.1)
    epoch = epoch_of(site, heard("A", "N", 2.0 + HALF_S + 0.01), heard("B", "M", 2.0 + HALF_S + 0.02), speed_sd_mps=0.6)
    slower = with_sound_speed(epoch, 0.99 * SPEED, 0.0)
    own = 4e-12 * (0.99 * SPEED) ** 2
    np.testing.assert_allclose(np.diag(slower.covariance_m2) - slower.bias_m2, own, rtol=1e-6)


@pytest.mark.parametrize("synchronised", [True, False])
def test_no_pair_is_biased_unless_stated(synchronised: bool) -> None:
    epoch = epoch_of(site_of(synchronised), heard("A", "M", 2.02))
    assert epoch.bias_sd_m is None
    assert epoch.bias_m2.tolist() == [0.0]
