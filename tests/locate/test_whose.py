"""Whose bursts they are: told by geometry, or not at all."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.geometry import SIZE, link, model
from sonofix.locate.fix import fix
from sonofix.locate.whose import tell_whose
from sonofix.records import RangeEpoch
from sonofix.site import Site

SPEED = 343.2
LEFT = [(0.0, 0.0, 3.0), (8.0, 0.5, 2.7), (7.0, 6.0, 3.1), (1.0, 5.5, 2.9)]
RIGHT = [(24.0, 1.0, 3.0), (33.0, 0.0, 2.7), (30.0, 6.0, 3.1), (25.0, 4.0, 2.9)]


def site(right: list[tuple[float, float, float]] = RIGHT, near: list[tuple[float, float, float]] | None = None) -> Site:
    codes = [{"chips": chips} for chips in ("0111", "0011", "0101", "0001")]
    return Site.model_validate(
        {
            "air": {"sound_speed_mps": SPEED},
            "schedule": {"period_s": 0.5},
            "signal": {"carrier_hz": 4e4, "cycles_per_chip": 10},
            "vehicle": [{"id": "v", "z_m": 0.5}],
            "beacon": [
                {"id": f"{zone}{k}", "zone": zone, "position_m": place, "code": codes[k]}
                for zone, places in (("L", LEFT), ("R", right), ("N", near or []))
                for k, place in enumerate(places)
            ],
            "microphone": [{"id": "M", "vehicle": "v"}],
        }
    )


def heard(place: tuple[float, float, float], zone: str, wrap_m: float = 0.0) -> RangeEpoch:
    """Ranges to the four beacons of a zone, each named after the first of its code, modulo ``wrap_m``."""
    pose = np.zeros((1, SIZE))
    pose[0, :3], pose[0, 4:6] = place, (0.5, -0.2)
    links = link(site(), tuple(f"{zone}{k}" for k in range(4)), ("M",) * 4)
    range_m, rate, *_ = model(links, pose, np.zeros(4), SPEED)
    return RangeEpoch(
        index=0,
        sync_s=0.0,
        emitter=("L0", "L1", "L2", "L3"),
        receiver=("M",) * 4,
        time_s=np.full(4, 0.1),
        range_m=range_m % wrap_m if wrap_m else range_m,
        covariance_m2=np.eye(4) * 1e-6,
        range_rate_mps=rate,
        range_rate_sd_mps=np.full(4, 2e-3),
        snr_db=20.0 - np.arange(4.0),
        clock="known",
        sound_speed_mps=SPEED,
    )


def mates(emitter: str, receiver: str) -> list[tuple[str, float]]:
    return [(emitter, 0.0), ("R" + emitter[1:], 0.0)]


@pytest.mark.parametrize(("place", "zone"), [((3.0, 2.0, 0.5), "L"), ((28.0, 2.5, 0.5), "R")])
def test_the_zone_is_told(place: tuple[float, float, float], zone: str) -> None:
    told, text = tell_whose(heard(place, zone), site(), mates)
    assert set(told.emitter) == {f"{zone}{k}" for k in range(4)}
    assert "4 of 4" in text
    found = fix(told, site(), "v")
    assert found.position_m == pytest.approx(place, abs=0.01)


def test_periods_are_told() -> None:
    wrap_m = 6.0
    epoch = heard((3.0, 2.0, 0.5), "L", wrap_m)
    told, _ = tell_whose(epoch, site(), lambda e, r: [(e, n * wrap_m / SPEED) for n in range(3)])
    found = fix(told, site(), "v")
    assert found.position_m == pytest.approx((3.0, 2.0, 0.5), abs=0.01)
    assert set(told.emitter) == set(epoch.emitter)


def test_what_makes_no_sense_is_left_out() -> None:
    epoch = heard((3.0, 2.0, 0.5), "L")
    epoch.range_m[3] += 2.0
    told, _ = tell_whose(epoch, site(), mates)
    assert set(told.emitter) == {"L0", "L1", "L2"}


def test_two_that_make_as_much_sense_give_none() -> None:
    """Two ranges fit some place in either zone."""
    epoch = heard((3.0, 2.0, 0.5), "L")
    epoch.range_m[2:] = np.array([55.0, 71.0])
    told, text = tell_whose(epoch, site(), mates)
    assert len(told) == 0
    assert "cannot be told" in text


def test_zones_that_repeat_exactly_are_not_told_apart_but_for_who_is_nearer() -> None:
    """Each position has all four ranges; beacons of the same codes nearer to one of them would be heard there."""
    again = [(x + 24.0, y, z) for x, y, z in LEFT]
    near = [(x + 26.0, 2.0, 2.5) for x, _, _ in LEFT]
    epoch = heard((3.0, 2.0, 0.5), "L")
    told, _ = tell_whose(epoch, site(again), mates)
    assert len(told) == 0
    told, _ = tell_whose(epoch, site(again, near), lambda e, r: [*mates(e, r), ("N" + e[1:], 0.0)])
    assert set(told.emitter) == {"L0", "L1", "L2", "L3"}


def test_nothing_to_decide_says_nothing() -> None:
    epoch = heard((3.0, 2.0, 0.5), "L")
    told, text = tell_whose(epoch, site(), lambda e, r: [(e, 0.0)])
    assert text == ""
    assert told.emitter == epoch.emitter
    np.testing.assert_allclose(told.range_m, epoch.range_m)
    np.testing.assert_allclose(told.covariance_m2, epoch.covariance_m2)
