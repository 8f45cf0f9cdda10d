"""Epochs that come late: the track is what it would have been, whatever the order they come in."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from locate.made_epochs import HALL, Drive, make_epoch, make_site
from sonofix.records import RangeEpoch, Step, Table
from sonofix.site import Site
from sonofix.street import Street

PERIOD_S, COUNT = 0.5, 12
PAIRS = tuple((f"B{i}", "M0") for i in range(len(HALL)))


def drive_of(site: Site, stated: bool) -> tuple[list[RangeEpoch], dict[str, Table]]:
    rng = np.random.default_rng(5)
    drive = Drive((2.0, 3.0, 1.1), (0.5, 0.2, 0.0))
    away = Drive((6.0, 2.0, 1.1), (0.3, 0.3, 0.0))
    epochs = [
        # carried off on the way: what then happens depends on all epochs
        make_epoch(site, drive if k < 7 else away, PERIOD_S * k, sd_m=0.05, rng=rng, stated=stated)
        for k in range(COUNT)
    ]
    times = np.arange(0.0, 7.0, 0.1)
    speed = {"time_s": times, "v_mps": 0.54 + 0 * times, "yaw_rate_radps": 0 * times}
    return epochs, {"odometry": Table(speed)}


def walked(site: Site, order: list[int], late_s: float, stated: bool) -> tuple[Street, list[Step]]:
    epochs, tables = drive_of(site, stated)
    street = Street(site, late_s=late_s)
    street.sense(tables, PAIRS if stated else None)
    return street, [street.walk(epochs[k]) for k in order]


@settings(max_examples=15, deadline=None)
@given(
    jitter=st.lists(st.floats(0, 1.9), min_size=COUNT, max_size=COUNT),
    stated=st.booleans(),
)
def test_any_order_within_the_window_ends_the_same(jitter: list[float], stated: bool) -> None:
    site = make_site(HALL, level_m=1.1)
    order = sorted(range(COUNT), key=lambda k: PERIOD_S * k + jitter[k])
    right, _ = walked(site, list(range(COUNT)), 0.0, stated)
    street, steps = walked(site, order, 2.0, stated)
    np.testing.assert_array_equal(street.follower.belief.mean, right.follower.belief.mean)
    np.testing.assert_array_equal(street.follower.belief.covariance, right.follower.belief.covariance)
    assert not any(event.event == "late" for step in steps for event in step.events)


def test_estimates_are_always_of_the_latest_instant() -> None:
    _, steps = walked(make_site(HALL, level_m=1.1), [0, 1, 3, 2, 4, 6, 5, 7, 8, 9, 10, 11], 1.0, False)
    times = [step.estimates[0].time_s for step in steps]
    assert times == sorted(times)
    # what came late was used
    assert all(step.range_used.any() for step in steps)


def test_innovations_are_of_the_epoch_that_came() -> None:
    site, order = make_site(HALL, level_m=1.1), [0, 1, 3, 2, 4, 6, 5]
    _, steps = walked(site, order, 1.0, False)
    _, right = walked(site, list(range(7)), 0.0, False)
    for k, step in zip(order, steps, strict=True):
        if k in (2, 4, 5):  # what came before it is the same by then
            assert step.innovations == right[k].innovations


def test_what_comes_too_late_is_left_out_and_told() -> None:
    site = make_site(HALL, level_m=1.1)
    street, steps = walked(site, [0, 1, 2, 4, 5, 6, 3], 1.0, False)
    without, _ = walked(site, [0, 1, 2, 4, 5, 6], 0.0, False)
    (event,) = steps[-1].events
    assert event.event == "late"
    assert "1.5 s late" in event.detail
    assert not steps[-1].range_used.any()
    assert not steps[-1].innovations
    assert not steps[-1].estimates
    np.testing.assert_array_equal(street.follower.belief.mean, without.follower.belief.mean)


def test_memory_is_bounded_by_the_window() -> None:
    site = make_site(HALL, level_m=1.1)
    street = Street(site, late_s=1.0)
    rng = np.random.default_rng(2)
    for k in range(60):
        street.walk(make_epoch(site, Drive((2.0, 3.0, 1.1)), PERIOD_S * k, sd_m=0.05, rng=rng))
    assert len(street._rewinder._taken) <= 4
