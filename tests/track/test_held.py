"""States that calibrate themselves, each switched off: they stay at what they began with, and what that costs."""

from __future__ import annotations

import typing

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site
from sonofix.flow import run, smoothed
from sonofix.ranging import with_sound_speed
from sonofix.records import Floats, RangeRows, Recording, Table
from sonofix.street import Street
from sonofix.track.belief import blank
from sonofix.track.held import CALIBRATIONS, places
from sonofix.track.inputs import gather

LONG = 0.04
"""By what share ranges and odometry read too much."""

ALL = tuple(name for name in CALIBRATIONS if name != "sound-speed")


def at(time_s: float) -> Floats:
    return np.array([5.0 + 2.0 * np.cos(0.3 * time_s), 4.0 + 2.0 * np.sin(0.3 * time_s), 1.1])


def recording(rng: np.random.Generator, scale: float = LONG) -> Recording:
    """Stated ranges around a circle, too long by a share, and odometry that reads too much by as much."""
    site = make_site(HALL, level_m=1.1)
    times = np.repeat(np.arange(0.0, 40.0, 0.25), len(HALL)) + 1e-3 * np.tile(np.arange(len(HALL)), 160)
    anchors = np.tile(np.array(HALL, float), (160, 1))
    way = np.linalg.norm(np.array([at(t) for t in times]) - anchors, axis=1)
    ranges = (1 + scale) * way + 0.02 * rng.standard_normal(len(way))
    emitters = tuple(f"B{i}" for i in range(len(HALL))) * 160
    driven_s = np.arange(0.0, 40.0, 0.1)
    speed = np.full(len(driven_s), 0.6 * (1 + LONG))
    odometry = {"time_s": driven_s, "v_mps": speed, "yaw_rate_radps": np.full(len(driven_s), 0.3)}
    rows = RangeRows(times, emitters, ("M0",) * len(times), ranges, np.full(len(times), 0.02))
    return Recording(site=site, ranges=rows, tables={"odometry": Table(odometry)})


def rms_m(steps: list) -> float:
    miss = [e.position_m[:2] - at(e.time_s)[:2] for s in steps for e in s.estimates if e.time_s > 20]
    return float(np.sqrt(np.mean(np.sum(np.square(miss), axis=1))))


def test_a_scale_that_is_held_is_not_found(rng: np.random.Generator) -> None:
    made = recording(rng)
    free, held = list(run(made)), list(run(made, held=("range-scale",)))
    assert rms_m(free) < 0.03
    assert rms_m(held) > 2 * rms_m(free)
    after = list(smoothed(made, held, held=("range-scale",)))
    assert rms_m(after) > 1.5 * rms_m(list(smoothed(made, free)))


@pytest.mark.parametrize("name", ALL)
def test_what_is_held_stays_as_it_began(name: str, rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    drive_s = np.arange(0.0, 10.0, 0.1)
    tables = {
        "odometry": Table({"time_s": drive_s, "v_mps": 0.4 + 0 * drive_s, "yaw_rate_radps": 0.1 + 0 * drive_s}),
        "imu": Table({"time_s": drive_s, "gz_radps": 0.1 + 0 * drive_s}),
        "steps": Table({"time_s": drive_s[::5], "length_m": 0.2 + 0 * drive_s[::5], "heading_rad": 0.1 * drive_s[::5]}),
    }
    stated = tuple((f"B{i}", "M0") for i in range(len(HALL))) if name.startswith(("range", "pair")) else None
    street = Street(site)
    street.sense(tables, stated, (name,))
    for k in range(18):
        epoch = make_epoch(site, Drive((3, 4, 1.1), (0.4, 0.1, 0.0)), 0.5 * k, sd_m=0.05, clock_m=2.0, rng=rng)
        street.walk(epoch)
    belief = street.follower.belief
    own = places((name,), belief.inputs)
    assert len(own)
    assert belief.placed.all()
    assert not belief.mean[own].any()
    assert not belief.covariance[own].any()
    assert not belief.free[own].any()
    others = np.setdiff1d(places(ALL, belief.inputs) % len(belief.mean), own % len(belief.mean))
    assert (belief.covariance[others, others] > 0).all()


def test_a_speed_that_is_held_is_the_sites(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    street = Street(site)
    street.sense({}, held=("sound-speed",))
    for k in range(6):
        epoch = make_epoch(site, Drive((3.0, 5.0, 1.1)), 0.5 * k, sd_m=0.002, rng=rng)
        step = street.walk(with_sound_speed(epoch, 1.005 * epoch.sound_speed_mps, 0.6))
        assert step.ranges.sound_speed_mps == pytest.approx(1.005 * epoch.sound_speed_mps, rel=1e-12)
        assert step.fixes[0].sound_speed_mps is None
        assert not any(event.event == "sound-speed" for event in step.events)


def test_the_command_tells_all_names() -> None:
    from sonofix.cli.run import run

    (option,) = typing.get_args(typing.get_type_hints(run, include_extras=True)["hold"])[1:]
    assert all(name in option.help for name in CALIBRATIONS)


def test_names_are_checked_and_told() -> None:
    with pytest.raises(ValueError, match=r"'range' is nothing that calibrates itself.*range-scale"):
        places(("range",), None)
    inputs = gather(make_site(HALL), {})
    assert inputs is None
    assert places(ALL, inputs).tolist() == [-1]
    assert not blank(make_site(HALL)).held.size
