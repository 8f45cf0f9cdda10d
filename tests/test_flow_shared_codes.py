"""Halls larger than a beacon's reach, whose zones share codes; epochs shorter than the flight across the hall."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sonofix.channel import Line, simulate
from sonofix.flow import run
from sonofix.receiver import Receiver
from sonofix.records import Recording, Step, Truth
from sonofix.signals import codes
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

ZONE_M = 12.0
IN_ZONE = [(1.0, 0.0, 3.0), (10.0, 0.2, 2.8), (9.0, 5.0, 3.1), (2.0, 4.8, 2.9)]
ROUND_HALL = [(0, 0, 4), (15, 0, 4.2), (30, 0, 4), (30, 12, 4.1), (15, 12, 4), (0, 12, 3.9)]


def hall(beacons: list[dict[str, Any]], far: tuple[float, float, float], period_s: float, cycles: int) -> Site:
    return Site.model_validate(
        {
            "air": {"sound_speed_mps": 343.2},
            "bounds_m": [[0, 0, 0], far],
            "schedule": {"period_s": period_s, "synchronised": True},
            "signal": {"carrier_hz": 15e3, "cycles_per_chip": cycles, "bandwidth_hz": 4e3},
            "vehicle": [{"id": "v", "z_m": 0.4}],
            "beacon": beacons,
            "microphone": [{"id": "M", "channel": 0, "vehicle": "v"}],
        }
    )


def code(degree: int, k: int) -> dict[str, Any]:
    return {"family": "m-sequence", "degree": degree, "taps": list(codes.primitive_taps(degree)[k])}


def zones(count: int) -> Site:
    """A corridor of zones of four beacons; every other zone sends the same four codes."""
    beacons = [
        {
            "id": f"{'ABCD'[z]}{k}",
            "zone": "ABCD"[z],
            "position_m": (ZONE_M * z + x, y, h),
            "code": code(7, k + 4 * (z % 2)),
        }
        for z in range(count)
        for k, (x, y, h) in enumerate(IN_ZONE)
    ]
    return hall(beacons, (ZONE_M * count, 5.0, 3.2), 0.5, 6)


def recorded(site: Site, motion: Line, seconds: float, **how: Any) -> tuple[Recording, Truth]:
    how = {"level": 0.3, "noise_sd": 1e-3, "absorption_db_per_m": 1.3, "seed": 3, "waveforms": waveforms_of(site)} | how
    recording, truth = simulate(site, {"v": motion}, rate_hz=48e3, duration_s=seconds, **how)
    return recording, truth["v"]


def driven(site: Site, motion: Line, seconds: float, **how: Any) -> tuple[list[Step], Truth]:
    recording, truth = recorded(site, motion, seconds, **how)
    return list(run(recording)), truth


def errors_m(steps: list[Step], truth: Truth) -> np.ndarray:
    rows = [(e.time_s, *e.position_m[:2]) for step in steps for e in step.estimates]
    time_s, *place = np.array(rows).T
    return np.hypot(*(p - np.interp(time_s, truth.time_s, truth.position_m[:, k]) for k, p in enumerate(place)))


def test_a_vehicle_walks_from_zone_to_zone() -> None:
    """From the first zone to the third, which sends the first one's codes."""
    site = zones(3)
    steps, truth = driven(site, Line((7.0, 2.2, 0.4), (2.0, 0.05, 0.0)), 10.5)
    error = errors_m(steps, truth)
    assert len(error) >= len(steps) - 1
    assert np.sqrt(np.mean(error**2)) < 2e-3
    assert any(event.event == "whose" for event in steps[0].events)
    used = [{e[0] for e, u in zip(s.ranges.emitter, s.range_used, strict=True) if u} for s in steps]
    assert "A" in used[0]
    assert "C" in used[-1]


def test_where_zones_repeat_all_round_nothing_is_claimed() -> None:
    """Heard from the middle of a zone alone, its codes say nothing of which zone it is: no position is better."""
    site = zones(4)
    only = {b.id for b in site.beacons if b.zone == "A"}
    only = {k: w for k, w in waveforms_of(site).items() if k in only}
    recording, _ = recorded(site, Line((6.0, 2.2, 0.4), (0.1, 0.0, 0.0)), 1.2, waveforms=only)
    steps = list(run(recording))
    assert steps
    assert not any(step.estimates for step in steps)
    assert any("cannot be told" in event.detail for event in steps[0].events)


def test_a_vehicle_carried_to_another_zone_is_not_believed_in_the_first() -> None:
    """Both send the same codes: what comes there as nothing was expected may be of either."""
    site = zones(3)
    parts = [recorded(site, Line((x, 2.2, 0.4), (0.3, 0.0, 0.0)), 2.0)[0] for x in (4.0, 28.0)]
    receiver = Receiver(site, 48e3, waveforms_of(site))
    steps: list[Step] = []
    for part in parts:
        assert part.blocks is not None
        steps += [step for block in part.blocks(10**9) for step in receiver.feed(block)]
    steps += receiver.finish()
    carried = [step for step in steps if step.ranges.sync_s >= 2.5]
    assert len(carried) >= 3
    for step in carried:
        for estimate in step.estimates:
            assert abs(estimate.position_m[0] - 28.0) < 2.0 or estimate.source == "predicted"
    assert carried[-1].estimates[0].source == "fused"


def test_a_second_microphone_that_falls_silent_takes_nothing_with_it() -> None:
    site = zones(3)
    raw = site.model_dump(by_alias=True, exclude_none=True, mode="json")
    raw["microphone"].append({"id": "N", "channel": 1, "vehicle": "v", "lever_arm_m": [0.3, 0.0, 0.0]})
    two = Site.model_validate(raw)
    recording, truth = recorded(two, Line((27.0, 2.2, 0.4), (0.3, 0.0, 0.0)), 2.5)
    assert recording.blocks is not None
    samples = np.concatenate(list(recording.blocks(10**9)))
    samples[48_000:, 1] = 0.0
    receiver = Receiver(two, 48e3, waveforms_of(two))
    steps = [*receiver.feed(samples), *receiver.finish()]
    assert len(steps) >= 4
    assert np.max(errors_m(steps, truth)) < 0.02


def test_fixed_microphones_hear_a_beacon_that_drives_in_short_epochs() -> None:
    places = [(0.0, 0.0, 3.0), (30.0, 0.5, 2.8), (30.0, 12.0, 3.1), (0.5, 12.0, 2.9)]
    raw = hall([{"id": "B", "vehicle": "v", "code": code(5, 0)}], (30.0, 12.0, 4.0), 0.08, 5).model_dump(
        by_alias=True, exclude_none=True, mode="json"
    )
    raw["microphone"] = [{"id": f"M{i}", "channel": i, "position_m": place} for i, place in enumerate(places)]
    steps, truth = driven(
        Site.model_validate(raw), Line((9.0, 5.0, 0.4), (0.8, 0.1, 0.0)), 0.9, absorption_db_per_m=0.3
    )
    error = errors_m(steps, truth)
    assert len(error) >= len(steps) - 2
    assert np.sqrt(np.mean(error**2)) < 0.02


@pytest.mark.parametrize("start", [(3.0, 6.0, 0.4), (24.0, 4.0, 0.4)])
def test_epochs_shorter_than_the_flight(start: tuple[float, float, float]) -> None:
    """Twenty a second across 30 m: a period is 17 m, and bursts of two or three periods sound at once."""
    beacons = [{"id": f"B{i}", "position_m": place, "code": code(5, i)} for i, place in enumerate(ROUND_HALL)]
    steps, truth = driven(
        hall(beacons, (30.0, 12.0, 5.0), 0.05, 5), Line(start, (1.2, 0.1, 0.0)), 0.7, absorption_db_per_m=0.3
    )
    error = errors_m(steps, truth)
    assert len(error) >= len(steps) - 2
    assert np.sqrt(np.mean(error**2)) < 5e-3
    longest = max(float(np.max(step.ranges.range_m)) for step in steps if len(step.ranges))
    assert longest > 0.05 * 343.2
