"""When to listen: sync commands, sample 0, an unknown clock, a beacon that runs free; and what samples are fit for."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.acquire.epochs import Schedule, reach_s, screen
from sonofix.site import Site

PERIOD_S = 0.5
REACH_S = 0.06


def walk(schedule: Schedule, bursts_s: np.ndarray, until_s: float) -> list[tuple[float, np.ndarray]]:
    """Drive a schedule as a receiver does: tell it which bursts begin in each window; return sync and bursts."""
    out = []
    while (window := schedule.window()) is not None and window.opens_s < until_s:
        inside = bursts_s[(bursts_s >= window.opens_s) & (bursts_s <= window.closes_s)]
        if window.seeking:
            schedule.found(inside)
            if len(inside):
                continue
            out.append((window.sync_s, inside))
            continue
        out.append((window.sync_s, inside))
        schedule.done(inside)
    return out


def test_without_commands_epochs_begin_at_sample_0_and_every_period() -> None:
    schedule = Schedule(PERIOD_S, REACH_S, None, known=True, regular=True)
    for index in range(5):
        window = schedule.window()
        assert window is not None
        assert (window.index, window.seeking) == (index, False)
        assert window.sync_s == window.opens_s == pytest.approx(index * PERIOD_S)
        assert window.closes_s == pytest.approx(window.opens_s + REACH_S)
        schedule.done(np.zeros(0))


def test_commands_say_when() -> None:
    sync_s = np.array([0.213, 0.714, 1.209])
    schedule = Schedule(PERIOD_S, REACH_S, sync_s, known=True, regular=True)
    for expected in sync_s:
        window = schedule.window()
        assert window is not None
        assert window.sync_s == window.opens_s == expected
        schedule.done(np.array([expected + 0.01]))
    assert schedule.window() is None


def test_no_flight_is_longer_than_the_period() -> None:
    window = Schedule(0.02, REACH_S, None, known=True, regular=True).window()
    assert window is not None
    assert window.closes_s - window.opens_s == pytest.approx(0.02)


@pytest.mark.parametrize("phase_s", [0.0, 0.004, 0.02, 0.11, 0.25, 0.4, 0.46, 0.48, 0.499])
def test_an_unknown_clock_gathers_the_bursts_of_each_epoch(phase_s: float) -> None:
    """Wherever the recording begins, also amid the bursts of an epoch: whole epochs of all beacons, none twice."""
    delays_s = np.array([0.004, 0.011, 0.023, 0.031])
    bursts_s = np.sort((np.arange(-1, 12)[:, None] * PERIOD_S + phase_s + delays_s).ravel())
    epochs = walk(Schedule(PERIOD_S, REACH_S, None, known=False, regular=True), bursts_s, 5.0)
    heard = np.concatenate([found for _, found in epochs])
    assert len(np.unique(heard)) == len(heard)
    whole = [found for _, found in epochs if len(found)]
    # the first epoch may have begun before the recording
    for sync_s, found in epochs[1:]:
        assert len(found) == 4, sync_s
    assert len(whole) >= 9
    # one offset holds for the recording: the sync instants are a regular grid, exactly
    grid = np.array([sync_s for sync_s, found in epochs if len(found)])
    np.testing.assert_allclose(np.diff(grid), PERIOD_S, rtol=0, atol=1e-12)


def test_an_unknown_clock_rides_over_beacons_that_fall_silent() -> None:
    delays_s = np.array([0.004, 0.011, 0.023, 0.031])
    bursts_s = np.arange(0, 20)[:, None] * PERIOD_S + 0.1 + delays_s
    bursts_s[5:8] = np.nan
    bursts_s[8:11, :3] = np.nan
    flat = np.sort(bursts_s[np.isfinite(bursts_s)])
    epochs = walk(Schedule(PERIOD_S, REACH_S, None, known=False, regular=True), flat, 8.0)
    counts = [len(found) for _, found in epochs]
    assert counts[:13] == [4, 4, 4, 4, 4, 0, 0, 0, 1, 1, 1, 4, 4]


@pytest.mark.parametrize("drift", [-1e-2, 0.0, 1e-2])
def test_a_free_running_beacon_is_followed(drift: float) -> None:
    """A clock 1 % off leaves every fixed grid within a few periods; each window is laid round the last burst's."""
    at = np.arange(40) * PERIOD_S * (1 + drift) + 0.31
    # five microphones
    bursts_s = np.sort((at[:, None] + np.array([0.001, 0.004, 0.006, 0.009, 0.012])).ravel())
    epochs = walk(Schedule(PERIOD_S, 0.03, None, known=False, regular=False), bursts_s, 15.0)
    assert all(len(found) == 5 for _, found in epochs)
    assert len(epochs) >= 29


def test_a_false_burst_while_seeking_does_not_move_the_epochs() -> None:
    schedule = Schedule(PERIOD_S, REACH_S, None, known=False, regular=True)
    schedule.found(np.array([0.094, 0.103, 0.112, 0.495]))
    window = schedule.window()
    assert window is not None
    assert window.opens_s == pytest.approx(0.094 - REACH_S)


def test_what_was_none_of_the_bursts_is_sought_anew() -> None:
    schedule = Schedule(PERIOD_S, REACH_S, None, known=False, regular=True)
    schedule.found(np.array([0.495]))
    for _ in range(3):
        window = schedule.window()
        assert window is not None
        if window.seeking:
            schedule.found(np.array([0.094, 0.103, 0.112]) + PERIOD_S * np.ceil((window.opens_s - 0.094) / PERIOD_S))
            break
        schedule.done(np.zeros(0))
    window = schedule.window()
    assert window is not None
    assert (window.opens_s + REACH_S - 0.094) % PERIOD_S == pytest.approx(0.0, abs=1e-9)
    assert window.sync_s == pytest.approx(window.opens_s)


@pytest.mark.parametrize("regular", [True, False])
def test_silence_at_the_start_is_waited_through(regular: bool) -> None:
    bursts_s = np.sort((np.arange(4, 12)[:, None] * PERIOD_S + 0.3 + np.array([0.004, 0.011, 0.023])).ravel())
    epochs = walk(Schedule(PERIOD_S, REACH_S, None, known=False, regular=regular), bursts_s, 5.0)
    counts = [len(found) for _, found in epochs]
    # every period of silence is an epoch too, in which nothing was heard
    assert counts[:4] == [0, 0, 0, 0]
    assert counts[4:] == [3] * len(counts[4:])
    assert len(counts) >= 9


def site_of(positions: list[tuple[float, float, float]]) -> Site:
    beacons = [{"id": f"B{i}", "position_m": p} for i, p in enumerate(positions)]
    return Site.model_validate({"beacon": beacons, "vehicle": [{"id": "v"}]})


def test_reach_is_more_than_the_diagonal() -> None:
    site = site_of([(0, 0, 0), (3, 4, 12)])
    assert reach_s(site, 340.0) * 340.0 == pytest.approx(1.5 * 13 + 5)
    boxed = Site.model_validate({"bounds_m": [[0, 0, 0], [3, 4, 12]], "beacon": [{"id": "B", "position_m": [1, 1, 1]}]})
    assert reach_s(boxed, 340.0) * 340.0 == pytest.approx(1.5 * 13 + 5)


def test_reach_where_nothing_is_known() -> None:
    assert reach_s(site_of([(1, 1, 1)]), 340.0) * 340.0 == pytest.approx(40.0)


def test_sound_samples_are_left_alone(rng: np.random.Generator) -> None:
    samples = (0.2 * rng.standard_normal(5000)).astype(np.float32)
    fit, flags = screen(samples, 48e3)
    assert flags == ()
    np.testing.assert_array_equal(fit, samples)


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf])
def test_samples_that_are_not_finite_are_flagged_and_silenced(odd: float) -> None:
    samples = np.full(1000, 0.1, np.float32)
    samples[[3, 700]] = odd
    fit, flags = screen(samples, 48e3)
    assert len(flags) == 1
    assert flags[0].startswith("2 of 1000 samples are not finite")
    assert fit[3] == fit[700] == 0
    assert np.isnan(samples[3]) or np.isinf(samples[3])
    assert np.count_nonzero(fit == np.float32(0.1)) == 998


def test_clipped_samples_are_flagged() -> None:
    samples = np.full(1000, 0.1, np.float32)
    samples[:20] = 1.0
    samples[20:25] = -1.0
    fit, flags = screen(samples, 48e3)
    assert flags == ("2.40 % of samples are clipped; lower the gain",)
    np.testing.assert_array_equal(fit, samples)


def test_clipping_below_full_scale_is_told_by_its_level(rng: np.random.Generator) -> None:
    samples = (0.3 * rng.standard_normal(20_000)).clip(-0.7, 0.7).astype(np.float32)
    assert any("clipped" in flag for flag in screen(samples, 48e3)[1])


def test_drop_outs_are_told(rng: np.random.Generator) -> None:
    samples = (0.2 * rng.standard_normal(20_000)).astype(np.float32)
    samples[5000:5480] = 0.0
    assert screen(samples, 48e3)[1] == ("1 drop-outs, 10 ms in all, in which every sample is 0",)
    samples[:480] = samples[-480:] = 0.0  # the recording's ends are no drop-outs
    assert len(screen(samples, 48e3)[1]) == 1
    assert screen(samples, 48e3)[1][0].startswith("1 drop-outs")


def test_dead_channels_are_flagged() -> None:
    assert screen(np.zeros(100, np.float32), 48e3)[1] == ("no sound at all: every sample is 0",)
    assert any("no sound at all" in flag for flag in screen(np.full(100, np.nan, np.float32), 48e3)[1])
