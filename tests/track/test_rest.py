"""Stop and go are told once each, when they happen, and not where noise alone moves."""

from __future__ import annotations

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site
from sonofix.records import Event
from sonofix.street import Street

PERIOD_S = 0.5


def events_of(rate_sd_mps: float, rng: np.random.Generator) -> list[Event]:
    """Eight seconds of driving, eight of rest, eight of driving; all "stop" and "go" told."""
    site, place, told = make_site(HALL, level_m=1.1), np.array([2.0, 3.0, 1.1]), []
    street = Street(site)
    for k in range(48):
        velocity = np.zeros(3) if 16 <= k < 32 else np.array([0.3, 0.1, 0.0])
        now_s = PERIOD_S * k
        drive = Drive(tuple(place - velocity * now_s), tuple(velocity))
        epoch = make_epoch(site, drive, now_s, sd_m=0.003, rate_sd_mps=rate_sd_mps, rng=rng)
        told += [e for e in street.walk(epoch).events if e.event in ("stop", "go")]
        place = place + PERIOD_S * velocity
    return told


def test_a_vehicle_that_stops_and_sets_off_is_told_once_each(rng: np.random.Generator) -> None:
    stop, go = events_of(0.005, rng)
    assert (stop.event, go.event) == ("stop", "go")
    assert stop.time_s == pytest.approx(8.0, abs=PERIOD_S)
    assert go.time_s == pytest.approx(16.0, abs=PERIOD_S)
    assert stop.vehicle == "v"
    assert "(4.40, 3.80) m" in stop.detail


def test_a_velocity_that_is_hardly_known_tells_of_no_rest(rng: np.random.Generator) -> None:
    assert not events_of(0.3, rng)


@pytest.mark.parametrize("speed_mps", [0.0, 0.03, 0.5])
def test_what_goes_on_as_it_was_is_not_told(speed_mps: float, rng: np.random.Generator) -> None:
    site, street = make_site(HALL, level_m=1.1), Street(make_site(HALL, level_m=1.1))
    drive = Drive((2.0, 3.0, 1.1), (speed_mps, 0.0, 0.0))
    for k in range(400 if speed_mps < 0.1 else 16):
        step = street.walk(make_epoch(site, drive, 0.02 * k, sd_m=0.003, rate_sd_mps=0.01, rng=rng))
        assert not any(e.event in ("stop", "go") for e in step.events)
