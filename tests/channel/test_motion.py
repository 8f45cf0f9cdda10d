"""Motions: velocities are derivatives, paths are smooth, yaw looks ahead."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.channel import Circle, Line, Motion, Sampled, Still, Waypoints

SQUARE = ((0.0, 0.0, 0.4), (4.0, 0.0, 0.4), (4.0, 3.0, 0.4), (0.0, 3.0, 0.4), (0.0, 0.0, 0.4))
RAMP = ((0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 2.0, 1.0), (-1.0, 2.5, 1.0))


def _rows() -> Sampled:
    time_s = np.linspace(-0.5, 6.5, 71)
    position = np.stack([np.sin(time_s), np.cos(0.7 * time_s), 0.3 * np.sin(2 * time_s)], axis=1)
    return Sampled(time_s, position)


MOTIONS: dict[str, Motion] = {
    "still": Still((1.0, 2.0, 3.0), 0.5),
    "line": Line((1.0, 2.0, 0.0), (-0.5, 0.3, 0.1)),
    "circle": Circle((2.0, 3.0, 0.4), 1.5, 1.2, phase_rad=1.0),
    "clockwise": Circle((2.0, 3.0, 0.4), 0.5, -2.0),
    "lap": Waypoints(SQUARE, 1.5),
    "ramp": Waypoints(RAMP, 1.2, radius_m=0.8),
    "sampled": _rows(),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_velocity_is_the_derivative_of_position(name: str) -> None:
    time_s, h = np.linspace(0.0, 6.0, 1201), 1e-5
    motion = MOTIONS[name]
    slope = (motion.at(time_s + h).position_m - motion.at(time_s - h).position_m) / (2 * h)
    # where acceleration jumps by a, the central difference is off by a h / 4
    np.testing.assert_allclose(motion.at(time_s).velocity_mps, slope, atol=2e-5)


@pytest.mark.parametrize("name", MOTIONS)
def test_velocity_and_yaw_are_continuous(name: str) -> None:
    time_s = np.arange(-0.4, 6.4, 1e-4)
    poses = MOTIONS[name].at(time_s)
    # none accelerates above 8 m/s² or turns faster than 4 rad/s (but the sampled one, where it nearly stands)
    assert np.linalg.norm(np.diff(poses.velocity_mps, axis=0), axis=1).max() < 8.5e-4
    if name != "sampled":
        assert np.abs(np.diff(poses.yaw_rad)).max() < 4.5e-4


@pytest.mark.parametrize("name", ["line", "circle", "clockwise", "lap", "ramp"])
def test_yaw_looks_where_the_vehicle_goes(name: str) -> None:
    poses = MOTIONS[name].at(np.linspace(0.0, 5.0, 501))
    ahead = poses.velocity_mps[:, :2] / np.linalg.norm(poses.velocity_mps[:, :2], axis=1)[:, None]
    np.testing.assert_allclose(np.stack([np.cos(poses.yaw_rad), np.sin(poses.yaw_rad)], axis=1), ahead, atol=1e-9)


def test_given_yaw_wins() -> None:
    time_s = np.linspace(0, 2, 5)
    assert (Line((0, 0, 0), (1, 1, 0), yaw_rad=2.0).at(time_s).yaw_rad == 2.0).all()
    assert (Circle((0, 0, 0), 1, 1, yaw_rad=2.0).at(time_s).yaw_rad == 2.0).all()


def test_a_lap_comes_round() -> None:
    lap = Waypoints(SQUARE, 1.5)
    # a rectangle of 14 m whose four corners of radius 0.5 each cut 2r off and drive πr/2
    assert lap.length_m == pytest.approx(14 - 4 * (2 * 0.5 - np.pi * 0.5 / 2), abs=1e-12)
    time_s = np.linspace(0, 5, 100)
    before, after = lap.at(time_s), lap.at(time_s + 3 * lap.length_m / 1.5)
    np.testing.assert_allclose(after.position_m, before.position_m, atol=1e-9)
    np.testing.assert_allclose(after.yaw_rad, before.yaw_rad + 3 * 2 * np.pi, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(before.velocity_mps, axis=1), 1.5, rtol=1e-12)


def test_an_open_path_brakes_to_rest_at_its_last_point() -> None:
    drive = Waypoints(RAMP, 1.2, braking_mps2=0.5)
    end_s = drive.length_m / 1.2 + 1.2 / (2 * 0.5)
    poses = drive.at(np.array([end_s - 1.0, end_s, end_s + 10.0]))
    np.testing.assert_allclose(poses.position_m[1:], [RAMP[-1], RAMP[-1]], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(poses.velocity_mps, axis=1), [0.5, 0.0, 0.0], atol=1e-9)


def test_a_path_too_short_to_brake_on_is_braked_on_all_along() -> None:
    short = Waypoints(((0, 0, 0), (0.2, 0, 0)), 2.0, braking_mps2=1.0)
    poses = short.at(np.array([0.0, 0.2, 5.0]))
    np.testing.assert_allclose(poses.position_m[:, 0], [0.0, 0.2, 0.2], atol=1e-12)
    np.testing.assert_allclose(poses.velocity_mps[:, 0], [2.0, 0.0, 0.0], atol=1e-12)


def test_straight_through_waypoints_changes_nothing() -> None:
    direct, through = Waypoints(((0, 0, 0), (4, 2, 0)), 1.0), Waypoints(((0, 0, 0), (1, 0.5, 0), (4, 2, 0)), 1.0)
    time_s = np.linspace(-1, 8, 50)
    np.testing.assert_allclose(through.at(time_s).position_m, direct.at(time_s).position_m, atol=1e-12)


@pytest.mark.parametrize(
    ("points", "told"),
    [
        (((0, 0, 0),), "two points"),
        (((0, 0, 0), (0, 0, 0), (1, 0, 0)), "points 1 and 2 are the same"),
        (((0, 0, 0), (1, 0, 0), (0, 0, 0)), "turns back on itself"),
        (((0, 0, 0), (np.nan, 0, 0)), "finite"),
    ],
)
def test_impossible_waypoints_are_refused(points: tuple[tuple[float, float, float], ...], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        Waypoints(points, 1.0)


def test_impossible_speeds_and_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="speed_mps = -1"):
        Waypoints(SQUARE, -1.0)
    with pytest.raises(ValueError, match="radius_m = 0"):
        Circle((0, 0, 0), 0.0, 1.0)
    with pytest.raises(ValueError, match="position_m"):
        Still((0.0, float("inf"), 0.0))


def test_sampled_passes_through_its_rows_and_stands_outside() -> None:
    motion = _rows()
    np.testing.assert_allclose(motion.at(motion.time_s).position_m, motion.position_m, atol=1e-12)
    outside = motion.at(np.array([-9.0, 99.0]))
    np.testing.assert_allclose(outside.position_m, motion.position_m[[0, -1]], atol=1e-12)
    assert (outside.velocity_mps == 0).all()


def test_sampled_is_third_order() -> None:
    circle = Circle((0, 0, 0), 1.0, 2.0)
    middle = np.linspace(0.5, 1.5, 333)
    errors = []
    for step in (0.1, 0.05, 0.025):
        rows = np.arange(0.0, 2.0 + step / 2, step)
        through = Sampled(rows, circle.at(rows).position_m)
        errors.append(np.abs(through.at(middle).position_m - circle.at(middle).position_m).max())
    ratios = np.array(errors[:-1]) / errors[1:]
    assert (ratios > 7.0).all()


def test_linear_rows_are_joined_straight() -> None:
    motion = Sampled(np.array([0.0, 1.0, 3.0]), np.array([[0.0, 0, 0], [1, 0, 0], [1, 4, 0]]), interpolation="linear")
    poses = motion.at(np.array([0.25, 2.0]))
    np.testing.assert_allclose(poses.position_m, [[0.25, 0, 0], [1, 2, 0]])
    np.testing.assert_allclose(poses.velocity_mps, [[1, 0, 0], [0, 2, 0]])


def test_sampled_heading_survives_a_stop_and_a_turn_past_pi() -> None:
    time_s = np.arange(0.0, 9.0, 0.01)
    angle = np.where(time_s < 4, time_s, np.where(time_s < 6, 4.0, time_s - 2))
    position = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    yaw = Sampled(time_s, position).at(np.array([1.0, 3.0, 5.0, 8.0])).yaw_rad
    np.testing.assert_allclose(yaw - np.pi / 2, [1.0, 3.0, 4.0, 6.0], atol=0.01)


def test_disordered_rows_are_refused() -> None:
    with pytest.raises(ValueError, match="from 2 to 1 s in row 2"):
        Sampled(np.array([0.0, 2.0, 1.0]), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="shape"):
        Sampled(np.array([0.0, 2.0]), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="yaw_rad must be finite"):
        Sampled(np.array([0.0, 2.0]), np.zeros((2, 3)), np.array([0.0, np.nan]))
