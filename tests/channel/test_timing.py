"""When bursts leave: in step with sync commands, or on clocks of their own."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.channel import Still, simulate
from sonofix.channel.timing import timing_of
from sonofix.signals.waveform import waveform_of
from sonofix.site import Beacon, Site


def _beacon(offset_s: float = 0.0, delay_s: float = 0.0) -> Beacon:
    return Beacon(id="A", position_m=(0.0, 0.0, 0.0), offset_s=offset_s, delay_s=delay_s)


def _between(starts_s: np.ndarray, from_s: float, to_s: float) -> np.ndarray:
    assert (np.diff(starts_s) > 0).all()
    return starts_s[(starts_s >= from_s) & (starts_s <= to_s)]


def test_synchronised_bursts_follow_each_sync_command() -> None:
    timing = timing_of(0.5, True, 10.0)
    np.testing.assert_allclose(timing.sync_s, 0.5 * np.arange(20))
    starts = timing.starts_s(_beacon(0.16, 0.001), -1.0, 3.0)
    np.testing.assert_allclose(_between(starts, -0.9, 2.0), 0.161 + 0.5 * np.arange(-2, 4), atol=1e-12)


def test_synchronised_beacons_do_not_drift_away() -> None:
    timing = timing_of(0.5, True, 1000.0, beacon_drift={"A": 1e-4})
    starts = _between(timing.starts_s(_beacon(), 995.0, 999.0), 995.1, 998.9)
    np.testing.assert_allclose(starts, 0.5 * np.round(starts / 0.5), atol=1e-9)
    assert timing.stretch(_beacon()) == pytest.approx(1.0001)


def test_free_running_beacons_do() -> None:
    timing = timing_of(0.5, False, 1000.0, offset_s=0.2, drift=2e-5, beacon_drift={"A": 1e-4})
    starts = _between(timing.starts_s(_beacon(0.1), 990.0, 999.0), 990.1, 998.9)
    np.testing.assert_allclose(np.diff(starts), 0.5 * 1.00012, atol=1e-9)
    k = np.round((starts - 0.2) / 1.00012 / 0.5 - 0.2)
    np.testing.assert_allclose(starts, 0.2 + (0.5 * k + 0.1) * 1.00012, atol=1e-9)


def test_jittered_sync_commands_are_what_the_beacons_follow() -> None:
    timing = timing_of(0.5, True, 500.0, offset_s=0.1, jitter_s=0.002, seed=3)
    off = timing.sync_s - (0.1 + 0.5 * np.arange(1000))
    assert off.std() == pytest.approx(0.002, rel=0.1)
    assert np.abs(off).max() <= 0.006
    starts = timing.starts_s(_beacon(0.05), 0.0, 500.0)
    np.testing.assert_allclose(_between(starts, 0.1, 499.9), timing.sync_s + 0.05, atol=1e-12)


def test_late_first_sync_still_lists_epochs_of_the_recording_alone() -> None:
    sync = timing_of(0.5, True, 3.0, offset_s=1.2).sync_s
    np.testing.assert_allclose(sync, [0.2, 0.7, 1.2, 1.7, 2.2, 2.7])


def test_jitter_needs_sync_commands() -> None:
    with pytest.raises(ValueError, match="not synchronised"):
        timing_of(0.5, False, 3.0, jitter_s=0.001)


def _site(synchronised: bool) -> Site:
    return Site.model_validate(
        {
            "air": {"sound_speed_mps": 343.2},
            "schedule": {"period_s": 0.1, "synchronised": synchronised},
            "signal": {"carrier_hz": 30e3, "cycles_per_chip": 10, "modulation": "bpsk"},
            "vehicle": [{"id": "v"}],
            "beacon": [
                {"id": "A", "position_m": (0, 0, 0), "code": {"family": "m-sequence", "degree": 5, "taps": [2]}}
            ],
            "microphone": [{"id": "M", "channel": 0, "vehicle": "v"}],
        }
    )


@pytest.mark.parametrize(
    ("synchronised", "how", "told"),
    [
        (True, {}, False),
        (True, {"clock_offset_s": 0.02}, True),
        (True, {"sync_jitter_s": 0.001}, True),
        (False, {"clock_offset_s": 0.02, "clock_drift": 1e-5}, False),
    ],
)
def test_sync_instants_are_told_where_they_are_irregular_and_known(
    synchronised: bool, how: dict[str, float], told: bool
) -> None:
    recording, _ = simulate(
        _site(synchronised), {"v": Still((1, 0, 0))}, rate_hz=96e3, duration_s=1.0, waveforms={}, **how
    )
    assert (recording.sync_s is not None) == told


def test_bursts_stand_in_the_samples_where_the_clock_says() -> None:
    site = _site(synchronised=False)
    rate, drift, offset, distance = 96e3, 3e-4, 0.0123, 3.432
    recording, _ = simulate(
        site,
        {"v": Still((distance, 0, 0))},
        rate_hz=rate,
        duration_s=2.0,
        absorption_db_per_m=0.0,
        level=1.0,
        waveforms={"A": waveform_of(site, site.beacons[0])},
        clock_offset_s=offset,
        beacon_drift={"A": drift},
    )
    assert recording.blocks is not None
    loud = np.abs(np.concatenate(list(recording.blocks(10**6)))[:, 0]) > 0.1
    # bursts of 31 chips last 10.3 ms: a loud sample after 20 ms of silence begins one
    edges = [n for n in np.flatnonzero(loud) if not loud[max(0, n - 1920) : n].any()]
    expected = offset + 0.1 * (1 + drift) * np.arange(20) + distance / 343.2
    np.testing.assert_allclose(np.array(edges) / rate, expected[: len(edges)], atol=1.5 / 30e3)
    assert len(edges) == 20
