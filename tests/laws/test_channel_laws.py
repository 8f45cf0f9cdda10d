"""What holds for every simulated recording: moving the world moves nothing, time is one, sound takes its time."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sonofix.channel import Line, Motion, Waypoints, simulate
from sonofix.channel.motion import Poses
from sonofix.channel.propagate import KNOT_S, PoseTable, emission_delay_s
from sonofix.records import Floats, Waveform
from sonofix.signals.waveform import waveform_of
from sonofix.site import Site

RATE, SPEED = 48e3, 343.2
coordinate = st.floats(-8.0, 8.0)
point = st.tuples(coordinate, coordinate, coordinate)
slow = st.floats(-3.0, 3.0)


def _site(fixed: tuple[float, float, float], arm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Site:
    return Site.model_validate(
        {
            "air": {"sound_speed_mps": SPEED},
            "schedule": {"period_s": 0.06},
            "signal": {"carrier_hz": 15e3, "cycles_per_chip": 8, "bandwidth_hz": 3e3},
            "vehicle": [{"id": "v"}],
            "beacon": [{"id": "A", "position_m": fixed, "code": {"family": "m-sequence", "degree": 4, "taps": [3]}}],
            "microphone": [{"id": "M", "channel": 0, "vehicle": "v", "lever_arm_m": arm}],
        }
    )


WAVEFORMS: dict[str, Waveform] = {"A": waveform_of(_site((0.0, 0.0, 0.0)), _site((0.0, 0.0, 0.0)).beacons[0])}


def _heard(site: Site, motion: Motion, length: int = 10**6, **how: Any) -> NDArray[np.float32]:
    how = {"duration_s": 0.12, "absorption_db_per_m": 0.5, "level": 1.0} | how
    recording, _ = simulate(site, {"v": motion}, rate_hz=RATE, waveforms=WAVEFORMS, **how)
    assert recording.blocks is not None
    return np.concatenate(list(recording.blocks(length)))


class _Moved:
    """A motion seen from a frame that is turned about the vertical and shifted."""

    def __init__(self, motion: Motion, turn_rad: float, shift_m: tuple[float, float, float]) -> None:
        self.motion, self.turn_rad, self.shift_m = motion, turn_rad, np.asarray(shift_m)
        cos, sin = np.cos(turn_rad), np.sin(turn_rad)
        self.matrix = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def place(self, position_m: Floats) -> Floats:
        return position_m @ self.matrix.T + self.shift_m

    def at(self, time_s: Floats) -> Poses:
        poses = self.motion.at(time_s)
        return Poses(self.place(poses.position_m), poses.velocity_mps @ self.matrix.T, poses.yaw_rad + self.turn_rad)


@settings(max_examples=25, deadline=None)
@given(point, point, st.tuples(slow, slow, slow), st.floats(-np.pi, np.pi), point)
def test_turning_and_shifting_the_world_changes_nothing(
    fixed: tuple[float, float, float],
    start: tuple[float, float, float],
    velocity: tuple[float, float, float],
    turn: float,
    shift: tuple[float, float, float],
) -> None:
    motion, arm = Line(start, velocity, yaw_rad=0.4), (0.3, -0.2, 0.1)
    moved = _Moved(motion, turn, shift)
    place = tuple(moved.place(np.array([fixed]))[0].tolist())
    before, after = _heard(_site(fixed, arm), motion), _heard(_site(place, arm), moved)
    np.testing.assert_allclose(after, before, atol=1e-6 * max(1.0, float(np.abs(before).max())))


@settings(max_examples=25, deadline=None)
@given(point, point, st.tuples(slow, slow, slow), st.integers(1, 3000))
def test_blocks_join_to_the_same_samples(
    fixed: tuple[float, float, float],
    start: tuple[float, float, float],
    velocity: tuple[float, float, float],
    length: int,
) -> None:
    site, motion = _site(fixed), Line(start, velocity)
    np.testing.assert_array_equal(_heard(site, motion, length, noise_sd=0.1), _heard(site, motion, noise_sd=0.1))


@settings(max_examples=25, deadline=None)
@given(point, point, st.tuples(slow, slow, slow), st.integers(1, 2000))
def test_a_later_world_is_heard_later(
    fixed: tuple[float, float, float],
    start: tuple[float, float, float],
    velocity: tuple[float, float, float],
    samples: int,
) -> None:
    """Motion and sync commands both a while later: the same samples, that while later."""
    late = samples / RATE
    begun = tuple((np.array(start) - late * np.array(velocity)).tolist())
    before = _heard(_site(fixed), Line(start, velocity))
    after = _heard(_site(fixed), Line(begun, velocity), clock_offset_s=late)
    np.testing.assert_allclose(after[samples:], before[:-samples], atol=2e-6 * max(1.0, float(np.abs(before).max())))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 60.0), st.integers(0, 600_000))
def test_delays_solve_their_equation_on_any_table(seed: int, speed_mps: float, first_knot: int) -> None:
    """For tables of random walks, up to a third of the speed of sound; asked of the table's own curve."""
    rng = np.random.default_rng(seed)
    knots = 300

    def table(spread_m: float) -> PoseTable:
        velocity = rng.standard_normal((4, 3))
        velocity *= speed_mps / np.linalg.norm(velocity, axis=1).max()
        t = np.linspace(0.0, 1.0, knots)[:, None]
        v = velocity[0] * (1 - t) ** 3 + 3 * velocity[1] * t * (1 - t) ** 2 + velocity[2] * t**3
        position = spread_m * rng.standard_normal(3) + np.cumsum(v, axis=0) * KNOT_S
        return PoseTable(first_knot, position, v)

    microphone, emitter = table(10.0), table(10.0)
    time_s = (first_knot + rng.uniform(200.0, 298.0, 50)) * KNOT_S
    delay = emission_delay_s(time_s, microphone, emitter, SPEED)
    distance = np.linalg.norm(_hermite(microphone, time_s) - _hermite(emitter, time_s - delay), axis=1)
    # a double at 600 s is known to 1e-13 s
    np.testing.assert_allclose(delay, distance / SPEED, rtol=0, atol=1e-12)


def _hermite(of: PoseTable, time_s: Floats) -> Floats:
    from scipy.interpolate import CubicHermiteSpline

    rows = np.arange(len(of.position_m), dtype=float)
    where = np.clip(time_s / KNOT_S - of.first_knot, 0.0, rows[-1])
    return CubicHermiteSpline(rows, of.position_m, of.velocity_mps * KNOT_S)(where)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(slow, slow, st.floats(0.0, 1.0)), min_size=2, max_size=6), st.floats(0.2, 3.0), slow)
def test_waypoints_keep_their_speed_and_never_jump(
    points: list[tuple[float, float, float]], speed_mps: float, from_s: float
) -> None:
    try:
        drive = Waypoints(tuple(points), speed_mps)
    except ValueError as refusal:
        assert "same" in str(refusal) or "turns back" in str(refusal)  # noqa: PT017
        return
    time_s = np.linspace(from_s, from_s + 5.0, 501)
    poses = drive.at(time_s)
    speeds = np.linalg.norm(poses.velocity_mps, axis=1)
    assert (speeds <= speed_mps * (1 + 1e-9)).all()
    steps = np.linalg.norm(np.diff(poses.position_m, axis=0), axis=1)
    assert (steps <= speed_mps * 0.01 * (1 + 1e-6) + 1e-9).all()
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert drive.length_m <= length + 1e-9
