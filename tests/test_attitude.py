"""Turned arms, spins and quaternions against another library's rotations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sonofix.attitude import quaternion, spin, turned


def test_arms_turn_as_another_library_turns_them(rng: np.random.Generator) -> None:
    roll, pitch, yaw = rng.uniform(-3, 3, (3, 50))
    arm = rng.standard_normal(3)
    turn = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
    np.testing.assert_allclose(turned(arm, roll, pitch, yaw), turn.apply(arm), atol=1e-14)
    upright = Rotation.from_euler("Z", yaw[:, None]).apply(arm)
    np.testing.assert_allclose(turned(arm, None, None, yaw), upright, atol=1e-14)
    for i in range(50):
        ours, theirs = np.array(quaternion(roll[i], pitch[i], yaw[i])), turn[i].as_quat()
        np.testing.assert_allclose(ours * np.sign(ours @ theirs), theirs, atol=1e-14)


def test_left_side_up_and_nose_down_are_above_zero() -> None:
    tenth, level = np.array([0.1]), np.zeros(1)
    assert turned((0.0, 1.0, 0.0), tenth, None, level)[0, 2] > 0.09
    assert turned((1.0, 0.0, 0.0), None, tenth, level)[0, 2] < -0.09


def test_spin_is_how_arms_move(rng: np.random.Generator) -> None:
    (roll, pitch, yaw), rates = rng.uniform(-1.5, 1.5, (3, 20)), rng.uniform(-2, 2, (3, 20))
    arm, step = rng.standard_normal(3), 1e-5
    after, before = (turned(arm, roll + s * rates[0], pitch + s * rates[1], yaw + s * rates[2]) for s in (step, -step))
    moves = np.cross(spin(pitch, yaw, tuple(rates)), turned(arm, roll, pitch, yaw))
    np.testing.assert_allclose(moves, (after - before) / (2 * step), atol=1e-8)
