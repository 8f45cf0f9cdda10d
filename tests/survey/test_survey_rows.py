"""Rows of a drive: what they should show, against the street's own range model and finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from sonofix.geometry import link, model
from sonofix.records import RangeEpoch
from sonofix.site import Site
from sonofix.survey.motion import ties
from sonofix.survey.rows import Guess, gather, show

C = 340.0


def mixed_site() -> Site:
    """A cart that listens with two microphones and sounds; fixed beacons and fixed microphones."""
    return Site.model_validate(
        {
            "name": "mixed",
            "air": {"sound_speed_mps": C},
            "beacon": [
                {"id": "B1", "position_m": [0.0, 0.0, 3.0]},
                {"id": "B2", "position_m": [6.0, 1.0, 2.5]},
                {"id": "S", "vehicle": "cart", "lever_arm_m": [0.2, -0.1, 0.5]},
            ],
            "vehicle": [{"id": "cart"}],
            "microphone": [
                {"id": "M1", "vehicle": "cart", "lever_arm_m": [0.3, 0.0, 0.4]},
                {"id": "M2", "vehicle": "cart", "lever_arm_m": [-0.3, 0.1, 0.4]},
                {"id": "W", "position_m": [3.0, 5.0, 2.0]},
            ],
        }
    )


def mixed_epoch(clock="known") -> RangeEpoch:
    emitter, receiver = ("B1", "B2", "B1", "S", "B2"), ("M1", "M2", "M2", "W", "W")
    time_s = np.array([10.01, 10.012, 10.008, 10.02, 10.017])
    range_m = np.array([4.1, 3.9, 4.4, 2.5, 5.0])
    return RangeEpoch(
        0, 10.0, emitter, receiver, time_s, range_m, np.eye(5) * 1e-6, np.zeros(5), np.full(5, 1e-3), None, clock, C
    )  # fmt: skip


@pytest.fixture
def laid_out():
    drive = gather(mixed_site(), [mixed_epoch("common")])
    state = np.array([[2.0, 1.5, 0.3, 1.2, -0.7, 0.1, 0.0, 0.0, 0.0, 0.6, 0.4]])
    guess = Guess(state, drive.place_m.copy(), np.array([0.02, -0.01, 0.0]), 0.003, np.array([0.4, 1e-3, 0.0]))
    # some rows have one bias, some two, some none
    return drive, guess, np.column_stack([drive.point % 3, np.arange(len(drive)) % 3 - 1])


def test_rows_agree_with_the_model_of_the_street(laid_out) -> None:
    drive, guess, _ = laid_out
    epoch = mixed_epoch()
    plain = Guess(guess.states, guess.place_m, np.zeros(0), 0.0, np.zeros(3))
    shown = show(drive, plain, np.full((len(drive), 2), -1))
    pose = np.array(
        [[*guess.states[0, :3], guess.states[0, 9], *guess.states[0, 3:6], guess.states[0, 10], 0, 0, 0, 0]]
    )
    names = list(zip(epoch.emitter, epoch.receiver, strict=True))
    order = [names.index(pair) for pair in zip(drive.emitter, drive.receiver, strict=True)]
    dt = epoch.time_s - drive.state_time_s[0]
    range_m, rate_mps, *_ = model(link(mixed_site(), epoch.emitter, epoch.receiver), pose, dt, C)
    assert shown.value[0] == pytest.approx(range_m[order], abs=1e-9)
    assert shown.value[1] == pytest.approx(rate_mps[order], abs=1e-9)


def test_derivatives_are_those_of_finite_differences(laid_out) -> None:
    drive, guess, bias = laid_out
    guess.states[:, 6:9] = 0.8, -0.5, 0.2
    shown = show(drive, guess, bias)

    def slope(change):
        h = 1e-6
        up, down = (show(drive, change(side * h), bias).value for side in (1, -1))
        return (up - down) / (2 * h)

    for k in range(11):
        step = np.eye(11)[k]
        found = slope(lambda h, s=step: replace(guess, states=guess.states + h * s))
        # the moment of sending shifts a little with the state, which the rate's derivative leaves out: v²/c
        assert shown.by_state[:, :, k] == pytest.approx(found, abs=6e-3 if drive.sends.any() else 1e-6)
        assert shown.by_state[0, :, k] == pytest.approx(found[0], abs=1e-6)
    for axis in range(3):
        move = np.eye(3)[axis]
        found = slope(lambda h, m=move: replace(guess, place_m=guess.place_m + h * m))
        assert shown.by_place[0, :, axis] == pytest.approx(found[0], abs=1e-6)
    found = slope(lambda h: replace(guess, excess=guess.excess + h))
    assert shown.by_excess[0] == pytest.approx(found[0], abs=1e-5)
    for k in range(3):
        tick = np.eye(3)[k]
        found = slope(lambda h, t=tick: replace(guess, clock=guess.clock + h * t))
        assert shown.by_clock[:, :, k] == pytest.approx(found, rel=1e-6, abs=1e-7)


def test_ties_hold_a_constant_acceleration() -> None:
    start = np.array([1.0, 2.0, 0.5, 0.3, -0.2, 0.1, 0.4, 0.1, -0.3, 0.7, 0.2])
    dt = 0.8
    end = start.copy()
    end[:3] += start[3:6] * dt + start[6:9] * dt**2 / 2
    end[3:6] += start[6:9] * dt
    end[9] += start[10] * dt
    before, after = ties(np.array([dt]))
    assert before[0] @ start + after[0] @ end == pytest.approx(np.zeros(11), abs=1e-9)


def test_ranges_between_vehicles_are_counted_not_used() -> None:
    epoch = mixed_epoch()
    epoch = RangeEpoch(
        0, 10.0, ("S", "B1"), ("M1", "M1"), epoch.time_s[:2], epoch.range_m[:2], np.eye(2), None, None, None, "known", C
    )  # fmt: skip
    drive = gather(mixed_site(), [epoch])
    assert (len(drive), drive.skipped) == (1, 1)


def test_epochs_of_two_sound_speeds_are_refused() -> None:
    first = mixed_epoch()
    second = RangeEpoch(
        1, 11.0, first.emitter, first.receiver, first.time_s + 1, first.range_m, first.covariance_m2, None, None, None,
        "known", C + 1,
    )  # fmt: skip
    with pytest.raises(ValueError, match="sound_speed_mps"):
        gather(mixed_site(), [first, second])
