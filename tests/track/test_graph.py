"""The factor graph beside the smoother: the same knots, the same factors, the same track."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site, rows_of
from sonofix.records import Estimate
from sonofix.track import graph
from sonofix.track.follow import Follower
from sonofix.track.inputs import gather
from sonofix.track.passage import Heard
from sonofix.track.smooth import smooth
from track.made_walks import SITE as HALLWAY
from track.made_walks import Walk, epoch_of, steps_of
from track.test_follow_team import robots_epoch, two_robots
from track.test_smooth import PERIOD_S, curving, heard_of, odometry


@pytest.fixture
def gtsam() -> None:
    pytest.importorskip("gtsam")


def check(
    begin: Callable[[], Follower], heard: list[Heard], rate_hz: float | None = None, unlike: float = 0.05
) -> None:
    """Both find the same: apart by a fraction of the deviation, which they agree on to a share ``unlike``."""
    apart = []
    for a, b in zip(smooth(begin, heard, rate_hz), graph.smooth(begin, heard, rate_hz), strict=True):
        for x, y in zip(a, b, strict=True):
            assert (x.time_s, x.vehicle, x.states, y.source) == (y.time_s, y.vehicle, y.states, "smoothed")
            apart.append(sigmas_apart(x, y))
            np.testing.assert_allclose(np.sqrt(y.covariance.diagonal()), np.sqrt(x.covariance.diagonal()), rtol=unlike)
    assert len(apart) >= len(heard)
    assert np.mean(apart) < 0.1
    assert max(apart) < 0.5


def sigmas_apart(x: Estimate, y: Estimate) -> float:
    k = len(x.states)
    parts = {"x": 0, "y": 1, "z": 2}
    at = [i for i in range(k) if x.states[i] in parts]
    miss = np.array([(y.position_m - x.position_m)[parts[x.states[i]]] for i in at])
    return float(np.sqrt(miss @ np.linalg.solve(x.covariance[np.ix_(at, at)], miss) / len(at)))


@pytest.mark.usefixtures("gtsam")
@pytest.mark.parametrize("rate_hz", [None, 5.0])
def test_ranges_alone(rate_hz: float | None, rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    check(lambda: Follower(site), curving(site, 30, rng), rate_hz)


@pytest.mark.usefixtures("gtsam")
def test_an_unknown_clock_and_rates(rng: np.random.Generator) -> None:
    site = make_site(HALL)
    drive = Drive((2.0, 2.0, 1.0), (0.3, 0.2, 0.0))
    epochs = [make_epoch(site, drive, PERIOD_S * k, rate_sd_mps=0.05, clock_m=7.0, rng=rng) for k in range(20)]
    check(lambda: Follower(site), heard_of(site, epochs))


@pytest.mark.usefixtures("gtsam")
def test_steps_through_a_blind_zone(rng: np.random.Generator) -> None:
    walk = Walk()
    inputs = gather(HALLWAY, {"steps": steps_of(walk, 20.0, rng)})
    heard = [(0,) if 8 <= 0.1 + PERIOD_S * k < 13 else (0, 1, 2, 3, 4, 5) for k in range(36)]
    epochs = [epoch_of(walk, 0.1 + PERIOD_S * k, rng, h) for k, h in enumerate(heard)]
    check(lambda: Follower(HALLWAY, inputs=inputs), heard_of(HALLWAY, epochs))


@pytest.mark.usefixtures("gtsam")
def test_odometry_whose_heading_is_found_on_the_way(rng: np.random.Generator) -> None:
    site = make_site(HALL, level_m=1.1)
    times = np.arange(0.0, 20.0, 0.1)
    inputs = gather(site, {"odometry": odometry(np.column_stack([times, 0.6 + 0 * times, 0.2 + 0 * times]))})

    def way(t: float) -> tuple[float, float, float]:
        return (5.0 + 3.0 * np.sin(0.2 * t), 4.0 - 3.0 * np.cos(0.2 * t), 1.1)

    epochs = [make_epoch(site, Drive(way(t)), t, sd_m=0.05, rng=rng) for t in 0.05 + PERIOD_S * np.arange(38)]
    check(lambda: Follower(site, inputs=inputs), heard_of(site, epochs))


@pytest.mark.usefixtures("gtsam")
def test_odometry_tells_by_rows_a_second_apart_and_the_very_last(rng: np.random.Generator) -> None:
    """Ranges have ended by then but for one, which tells of half the place."""
    site = make_site(HALL, level_m=1.1)
    times = np.arange(-1.0, 16.0, 1.0)
    inputs = gather(site, {"odometry": odometry(np.column_stack([times, 0.6 + 0 * times, 0.2 + 0 * times]))})

    def way(t: float) -> tuple[float, float, float]:
        return (5.0 + 3.0 * np.sin(0.2 * t), 4.0 - 3.0 * np.cos(0.2 * t), 1.1)

    moments = [*(0.05 + PERIOD_S * np.arange(28)), 15.02]
    epochs = [make_epoch(site, Drive(way(t)), t, sd_m=0.05, rng=rng) for t in moments]
    epochs[-1] = rows_of(epochs[-1], [0])

    def begin() -> Follower:
        follower = Follower(site, inputs=inputs)
        follower.start("v", -0.5, np.array(way(-0.5)), -0.1)
        return follower

    check(begin, heard_of(site, epochs))


@pytest.mark.usefixtures("gtsam")
def test_two_vehicles_and_one_carried_away(rng: np.random.Generator) -> None:
    site = two_robots()
    a, b = Drive((2.0, 2.0, 0.0), (0.3, 0.2, 0.0)), Drive((8.0, 6.0, 0.0), (-0.2, 0.0, 0.0))
    away = Drive((5.0, 6.0, 0.0))
    epochs = [robots_epoch(site, a if k < 12 else away, b, PERIOD_S * k, rng) for k in range(24)]
    # where one is placed anew the graph leaves out the range between them, by which the filter betters the other
    check(lambda: Follower(site), heard_of(site, epochs), unlike=0.2)


@pytest.mark.usefixtures("gtsam")
def test_a_clock_of_its_own_in_each_epoch_is_refused(rng: np.random.Generator) -> None:
    site = make_site(HALL, sounding=True)
    heard = heard_of(site, [make_epoch(site, Drive((3.0, 3.0, 1.0)), clock_m=3.0, rng=rng)])
    with pytest.raises(ValueError, match="clock"):
        graph.smooth(lambda: Follower(site, free_running=True), heard)


def test_without_gtsam_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    site = make_site(HALL)
    with pytest.raises(ModuleNotFoundError, match=r"sonofix\[graph\]"):
        graph.smooth(lambda: Follower(site), curving(site, 2, rng))
