"""What holds for any rows: derivatives are those of the values, and moving the world moves no range."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonofix.geometry import Links, model
from sonofix.records import Floats

SPEED = 343.0
STEP = 1e-5


def draws(low: float, high: float, *shape: int) -> st.SearchStrategy[Floats]:
    count = int(np.prod(shape))
    one = st.floats(low, high)
    return st.lists(one, min_size=count, max_size=count).map(lambda values: np.array(values, float).reshape(shape))


@st.composite
def worlds(draw: st.DrawFn, sounding: bool = True) -> tuple[Links, Floats, Floats]:
    """Three rows among two vehicles and fixed ends, poses, and moments; emitters stand still unless ``sounding``."""
    n = 3
    carriers = st.lists(st.sampled_from([-1, 0, 1]), min_size=n, max_size=n).map(np.array)
    emitter_vehicle = draw(carriers) if sounding else np.full(n, -1)
    receiver_vehicle = draw(carriers)
    points = draw(draws(-8, 8, 2, n, 3))
    for side, vehicle in zip(points, (emitter_vehicle, receiver_vehicle), strict=True):
        side[vehicle >= 0] *= 0.1  # lever arms up to 0.8 m
    motion = [draw(draws(-8, 8, 2, 3)), draw(draws(-7, 7, 2)), draw(draws(-3, 3, 2, 4)), draw(draws(-1.5, 1.5, 2, 4))]
    poses = np.column_stack(motion)
    return (
        Links(emitter_vehicle, points[0], receiver_vehicle, points[1], np.zeros(n)),
        poses,
        draw(draws(-0.2, 0.2, n)),
    )


def differences(links: Links, poses: Floats, dt: Floats) -> tuple[Floats, Floats]:
    """Central differences of ranges and rates by every component of every pose."""
    by_range, by_rate = np.zeros((2, len(links), *poses.shape))
    for where in np.ndindex(poses.shape):
        ahead, back = poses.copy(), poses.copy()
        ahead[where] += STEP
        back[where] -= STEP
        after, before = model(links, ahead, dt, SPEED), model(links, back, dt, SPEED)
        by_range[(slice(None), *where)] = (after[0] - before[0]) / (2 * STEP)
        by_rate[(slice(None), *where)] = (after[1] - before[1]) / (2 * STEP)
    return by_range, by_rate


def away(range_m: Floats) -> Floats:
    """Rows whose ends are half a metre apart: nearer, curvature outgrows any finite difference."""
    return range_m > 0.5


@given(worlds())
def test_range_derivatives_are_those_of_the_range(world: tuple[Links, Floats, Floats]) -> None:
    links, poses, dt = world
    range_m, _, by_range, _ = model(links, poses, dt, SPEED)
    # the ranges themselves hold to about 1e-8 m and smoothly so; second derivatives below 10/m leave 1e-9
    np.testing.assert_allclose(by_range[away(range_m)], differences(*world)[0][away(range_m)], atol=2e-6)


@given(worlds(sounding=False))
def test_rate_derivatives_are_those_of_the_rate(world: tuple[Links, Floats, Floats]) -> None:
    links, poses, dt = world
    range_m, _, _, by_rate = model(links, poses, dt, SPEED)
    np.testing.assert_allclose(by_rate[away(range_m)], differences(*world)[1][away(range_m)], atol=1e-5)


@given(worlds())
def test_rate_derivatives_of_moving_emitters_hold_to_the_order_of_v_over_c(
    world: tuple[Links, Floats, Floats],
) -> None:
    links, poses, dt = world
    range_m, _, _, by_rate = model(links, poses, dt, SPEED)
    # left out is how the moment of sending and the lag answer: (v/c) times speeds over ranges, speeds up to 8 m/s with
    # an arm of 1.4 m that turns and tilts, ranges from 0.5 m, and an acceleration of the arm up to 40 m/s²
    order = 12.0 / SPEED * (1 + 12.0 / 0.5) * np.maximum(1.0, 1.4)
    gap = np.abs(by_rate - differences(*world)[1])[away(range_m)]
    assert gap.max(initial=0.0) < 3 * order


@given(worlds(), draws(-20, 20, 3), st.floats(-7, 7))
def test_moving_the_world_moves_no_range(world: tuple[Links, Floats, Floats], shift: Floats, turn_rad: float) -> None:
    links, poses, dt = world
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def moved(vehicle: Floats, point: Floats) -> Floats:
        return np.where((vehicle < 0)[:, None], point @ turn.T + shift, point)

    elsewhere = Links(
        links.emitter_vehicle,
        moved(links.emitter_vehicle, links.emitter_point),
        links.receiver_vehicle,
        moved(links.receiver_vehicle, links.receiver_point),
        links.emitter_sd_m,
    )
    turned = poses.copy()
    turned[:, :3] = poses[:, :3] @ turn.T + shift
    turned[:, 3] += turn_rad
    turned[:, 4:7] = poses[:, 4:7] @ turn.T
    before, after = model(links, poses, dt, SPEED), model(elsewhere, turned, dt, SPEED)
    apart = away(before[0])
    np.testing.assert_allclose(after[0][apart], before[0][apart], atol=1e-9)
    np.testing.assert_allclose(after[1][apart], before[1][apart], atol=1e-9)


@given(worlds(), st.floats(-5, 5))
def test_only_time_from_the_reference_instant_matters(world: tuple[Links, Floats, Floats], later_s: float) -> None:
    links, poses, dt = world
    later = poses.copy()
    later[:, :3] += later_s * poses[:, 4:7]
    later[:, 3] += later_s * poses[:, 7]
    later[:, 8:10] += later_s * poses[:, 10:]
    before, after = model(links, poses, dt, SPEED), model(links, later, dt - later_s, SPEED)
    np.testing.assert_allclose(after[0], before[0], atol=1e-9)


@given(worlds(), draws(-3, 3, 3))
def test_turning_arms_and_body_the_other_way_moves_no_range(
    world: tuple[Links, Floats, Floats], angles: Floats
) -> None:
    # R arm = (R Q⁻¹)(Q arm): a body whose axes are drawn on it otherwise is the same body
    links, poses, dt = world
    still = poses.copy()
    still[:, [7, 10, 11]] = 0.0
    turn = Rotation.from_euler("ZYX", angles)
    other = still.copy()
    for pose in other:
        pose[[3, 9, 8]] = (Rotation.from_euler("ZYX", pose[[3, 9, 8]]) * turn.inv()).as_euler("ZYX")

    def drawn(vehicle: Floats, point: Floats) -> Floats:
        return np.where((vehicle < 0)[:, None], point, turn.apply(point))

    elsewhere = Links(
        links.emitter_vehicle,
        drawn(links.emitter_vehicle, links.emitter_point),
        links.receiver_vehicle,
        drawn(links.receiver_vehicle, links.receiver_point),
        links.emitter_sd_m,
    )
    before, after = model(links, still, dt, SPEED), model(elsewhere, other, dt, SPEED)
    apart = away(before[0])
    np.testing.assert_allclose(after[0][apart], before[0][apart], atol=1e-9)
    np.testing.assert_allclose(after[1][apart], before[1][apart], atol=1e-8)
