"""Range and range-rate models against the definition of a range, solved by bisection, and a plain NumPy twin."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from sonofix.geometry import (
    POSE,
    SIZE,
    TILT_SD_RAD,
    Links,
    from_arm,
    link,
    model,
    open_arms,
    row_times,
    rows_at,
    tilting,
    turning,
)
from sonofix.records import Floats
from sonofix.site import Site

SPEED = 343.0
UPRIGHT = [0.0] * 4
DRIVING = np.array([3.0, -2.0, 0.4, 0.7, 1.6, -1.1, 0.2, 0.9, 0.4, -0.3, 0.5, -0.8])
CROSSING = np.array([-4.0, 5.0, 1.1, -2.0, -0.8, 1.7, -0.3, -0.6, *UPRIGHT])

# name: emitter (vehicle, point), receiver (vehicle, point); −1 is fixed, points of mounted ends are lever arms
CASES = {
    "both fixed": ((-1, (0.0, 0.0, 3.0)), (-1, (4.0, 3.0, 3.0))),
    "moving receiver": ((-1, (0.0, 0.0, 3.0)), (0, (0.0, 0.0, 0.0))),
    "moving receiver on an arm": ((-1, (9.0, 1.0, 2.5)), (0, (0.6, -0.3, 0.8))),
    "moving emitter": ((0, (0.0, 0.0, 0.0)), (-1, (0.0, 8.0, 2.0))),
    "moving emitter on an arm": ((0, (-0.5, 0.4, 1.1)), (-1, (8.0, 8.0, 2.0))),
    "two vehicles": ((0, (0.2, 0.1, 0.3)), (1, (-0.4, 0.2, 0.9))),
    "two ends of one vehicle": ((0, (0.5, 0.0, 0.3)), (0, (-0.5, 0.2, 0.9))),
}
POSES = np.array([DRIVING, CROSSING])


def links_of(*cases: tuple[tuple[int, tuple], tuple[int, tuple]]) -> Links:
    (ev, ep), (rv, rp) = (zip(*side, strict=True) for side in zip(*cases, strict=True))
    return Links(np.array(ev), np.array(ep, float), np.array(rv), np.array(rp, float), np.zeros(len(cases)))


def place(vehicle: int, point: tuple, poses: Floats, time_s: float) -> Floats:
    """Origin + R arm at an instant, by another library's rotations."""
    if vehicle < 0:
        return np.array(point)
    angles, rates = poses[vehicle, [3, 9, 8]], poses[vehicle, [7, 11, 10]]
    turn = Rotation.from_euler("ZYX", angles + rates * time_s)
    return poses[vehicle, :3] + poses[vehicle, 4:7] * time_s + turn.apply(point)


def heard_range_m(emitter: tuple[int, tuple], receiver: tuple[int, tuple], poses: Floats, time_s: float) -> float:
    """The root of |p_receiver(t) − p_emitter(t − r / c)| − r, which is single as long as nothing outruns sound."""
    here = place(*receiver, poses, time_s)

    def excess(range_m: float) -> float:
        return float(np.linalg.norm(here - place(*emitter, poses, time_s - range_m / SPEED))) - range_m

    return float(brentq(excess, 0.0, 1e3, xtol=1e-14, rtol=1e-15))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("time_s", [-0.3, 0.0, 0.08])
def test_range_solves_its_definition(case: str, time_s: float) -> None:
    range_m, *_ = model(links_of(CASES[case]), POSES, np.array([time_s]), SPEED)
    # each of four rounds contracts by v/c; the emitter's 2 m/s and its turning arm's 0.6 m/s leave 12 m (2.6/343)⁴
    assert range_m[0] == pytest.approx(heard_range_m(*CASES[case], POSES, time_s), abs=4e-8)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("time_s", [-0.3, 0.0, 0.08])
def test_rate_is_the_derivative_of_the_heard_range(case: str, time_s: float) -> None:
    _, rate, *_ = model(links_of(CASES[case]), POSES, np.array([time_s]), SPEED)
    step = 1e-4
    after, before = (heard_range_m(*CASES[case], POSES, time_s + s) for s in (step, -step))
    # bisection leaves 1e-14 m of 10 m: 1e-10 m/s; the third derivative, below 10 m/s³, leaves step²/6 of itself
    assert rate[0] == pytest.approx((after - before) / (2 * step), abs=2e-7)


def test_a_receding_receiver_has_a_positive_rate() -> None:
    pose = np.array([[10.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, *UPRIGHT]])
    links = links_of(((-1, (0.0, 0.0, 0.0)), (0, (0.0, 0.0, 0.0))))
    range_m, rate, *_ = model(links, pose, np.array([0.5]), SPEED)
    assert range_m[0] == pytest.approx(11.0, abs=1e-12)
    assert rate[0] == pytest.approx(2.0, abs=1e-12)


def test_a_receding_emitter_is_heard_nearer_than_it_is() -> None:
    # r = x + v (t − r/c)  →  r = (x + v t) / (1 + v/c), and its derivative v / (1 + v/c)
    pose = np.array([[10.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, *UPRIGHT]])
    links = links_of(((0, (0.0, 0.0, 0.0)), (-1, (0.0, 0.0, 0.0))))
    range_m, rate, *_ = model(links, pose, np.array([0.5]), SPEED)
    assert range_m[0] == pytest.approx(11.0 / (1 + 2.0 / SPEED), abs=2e-8)
    assert rate[0] == pytest.approx(2.0 / (1 + 2.0 / SPEED), abs=1e-9)


def test_a_lever_arm_turns_with_the_yaw() -> None:
    # a vehicle at the origin looking north: one metre forward is one metre north
    pose = np.array([[0.0, 0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0, *UPRIGHT]])
    links = links_of(((-1, (0.0, 5.0, 0.0)), (0, (1.0, 0.0, 0.0))))
    assert model(links, pose, np.zeros(1), SPEED)[0][0] == pytest.approx(4.0, abs=1e-12)


def test_a_turning_arm_moves_although_its_vehicle_stands() -> None:
    # ω × arm: at 2 rad/s a point one metre to the left moves backwards at 2 m/s
    pose = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, *UPRIGHT]])
    links = links_of(((-1, (10.0, 1.0, 0.0)), (0, (0.0, 1.0, 0.0))))
    assert model(links, pose, np.zeros(1), SPEED)[1][0] == pytest.approx(2.0, abs=1e-12)


def test_rows_do_not_mix() -> None:
    links = links_of(*CASES.values())
    times = np.linspace(-0.2, 0.2, len(CASES))
    together = model(links, POSES, times, SPEED)
    for i in range(len(CASES)):
        alone = model(links.rows(np.array([i])), POSES, times[i : i + 1], SPEED)
        for whole, single in zip(together, alone, strict=True):
            np.testing.assert_array_equal(whole[i], single[0])


def test_fixed_ends_have_no_derivatives() -> None:
    _, rate, by_range, by_rate = model(links_of(CASES["both fixed"]), POSES, np.zeros(1), SPEED)
    assert rate[0] == 0.0
    assert not by_range.any()
    assert not by_rate.any()


def test_ends_at_one_place_give_finite_numbers() -> None:
    links = links_of(((-1, (1.0, 2.0, 3.0)), (0, (0.0, 0.0, 0.0))))
    pose = np.array([[1.0, 2.0, 3.0, 0.0, 0.5, 0.5, 0.0, 0.0, *UPRIGHT]])
    results = model(links, pose, np.zeros(1), SPEED)
    assert all(np.isfinite(r).all() for r in results)
    assert results[0][0] == pytest.approx(0.0, abs=1e-5)


def test_no_rows_give_empty_arrays() -> None:
    links = links_of(CASES["moving receiver"]).rows(np.zeros(0, int))
    range_m, rate, by_range, by_rate = model(links, POSES, np.zeros(0), SPEED)
    assert range_m.shape == rate.shape == (0,)
    assert by_range.shape == by_rate.shape == (0, 2, SIZE)


# --- the plain twin of the kernel -------------------------------------------------------------------------------------


def twin_ends(vehicle: Floats, point: Floats, pose: Floats, dt: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    state = np.where((vehicle >= 0)[:, None], pose[vehicle], 0.0)
    angles = state[:, [3, 9, 8]] + state[:, [7, 11, 10]] * dt[:, None]
    mounted = (vehicle >= 0)[:, None]
    whole = Rotation.from_euler("ZYX", angles)
    heading = Rotation.from_euler("Z", angles[:, :1])
    # the axes that yaw, pitch and roll turn about; each turns those after it
    axes = [np.tile([0.0, 0.0, 1.0], (len(point), 1)), heading.apply([0.0, 1.0, 0.0]), whole.apply([1.0, 0.0, 0.0])]
    arm = whole.apply(point) * mounted
    by = [np.cross(axis, arm) for axis in axes]
    rates = state[:, [7, 11, 10]].T[:, :, None]
    twice = [
        sum(rates[j] * np.cross(axes[min(i, j)], np.cross(axes[max(i, j)], arm)) for j in range(3)) for i in range(3)
    ]
    here = np.where(mounted, state[:, :3] + state[:, 4:7] * dt[:, None] + arm, point)
    moves = state[:, 4:7] + sum(rate * moved for rate, moved in zip(rates, by, strict=True))
    return here, moves, np.stack(by, axis=-1), np.stack(twice, axis=-1)


def twin_model(links: Links, pose: Floats, dt: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Whole-array formulas; derivatives of a rate leave out that of the lag, which is of order v/c."""
    ends: dict[str, Callable[[Floats], tuple]] = {
        "emitter": lambda t: twin_ends(links.emitter_vehicle, links.emitter_point, pose, t),
        "receiver": lambda t: twin_ends(links.receiver_vehicle, links.receiver_point, pose, t),
    }
    receiver, receiver_v, receiver_turn, receiver_v_turn = ends["receiver"](dt)
    sent = dt
    for _ in range(30):
        sent = dt - np.linalg.norm(receiver - ends["emitter"](sent)[0], axis=1) / SPEED
    emitter, emitter_v, emitter_turn, emitter_v_turn = ends["emitter"](sent)
    range_m = np.linalg.norm(receiver - emitter, axis=1)
    unit = (receiver - emitter) / range_m[:, None]
    lag = 1.0 / (1.0 - np.sum(unit * emitter_v, axis=1) / SPEED)
    relative = receiver_v - emitter_v
    closing = np.sum(unit * relative, axis=1)
    across = (relative - closing[:, None] * unit) / range_m[:, None]
    by_range, by_rate = np.zeros((2, len(links), len(pose), SIZE))
    for i in range(len(links)):
        for vehicle, sign, t, turn, v_turn in (
            (links.receiver_vehicle[i], 1.0, dt[i], receiver_turn[i], receiver_v_turn[i]),
            (links.emitter_vehicle[i], -1.0, sent[i], emitter_turn[i], emitter_v_turn[i]),
        ):
            if vehicle < 0:
                continue
            k, u, a = sign * lag[i], unit[i], across[i]
            yaw, pitch, roll = u @ turn
            by_range[i, vehicle] += k * np.array([*u, yaw, *(t * u), t * yaw, roll, pitch, t * roll, t * pitch])
            rates = a @ turn + u @ v_turn
            yaw_rate, pitch_rate, roll_rate = u @ turn + t * rates
            by_rate[i, vehicle] += k * np.array(
                [*a, rates[0], *(u + t * a), yaw_rate, rates[2], rates[1], roll_rate, pitch_rate]
            )
    return range_m, lag * closing, by_range, by_rate


def test_kernel_matches_its_plain_twin(rng: np.random.Generator) -> None:
    for _ in range(20):
        n = 24
        vehicles = rng.integers(-1, 3, (2, n))
        points = rng.uniform(-9, 9, (2, n, 3))
        points[vehicles >= 0] *= 0.03
        links = Links(vehicles[0], points[0], vehicles[1], points[1], np.zeros(n))
        poses = np.column_stack([rng.uniform(-9, 9, (3, 3)), rng.uniform(-4, 4, 3), rng.uniform(-2, 2, (3, 8))])
        poses[2, 8:] = 0.0
        dt = rng.uniform(-0.2, 0.2, n)
        # four rounds of contraction by v/c ≤ 4.3/343 from at most 31 m leave 8e-7 m; derivatives follow in proportion
        for built, plain in zip(model(links, poses, dt, SPEED), twin_model(links, poses, dt), strict=True):
            np.testing.assert_allclose(built, plain, atol=1e-6)


@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("clock", [False, True])
def test_rows_at_stacks_ranges_and_rates_and_adds_the_clock(clock: bool, rates: bool) -> None:
    links, times = links_of(*CASES.values()), np.linspace(-0.2, 0.2, len(CASES))
    state, n = np.append(POSES, [3.5, 0.25]), len(CASES)
    value, derivative = rows_at(links, state, times, SPEED, clock, rates)
    range_m, rate, by_range, by_rate = model(links, POSES, times, SPEED)
    offset, drift = (3.5, 0.25) if clock else (0.0, 0.0)
    np.testing.assert_array_equal(value, np.concatenate([range_m + offset, rate + drift])[: n * (1 + rates)])
    whole, poses = np.zeros((2 * n, 2 * SIZE + 2)), slice(0, 2 * SIZE)
    whole[:n, poses], whole[n:, poses] = by_range.reshape(n, -1), by_rate.reshape(n, -1)
    whole[:n, -2] = whole[n:, -1] = clock
    np.testing.assert_array_equal(derivative, whole[: n * (1 + rates)])


# --- looking rows up --------------------------------------------------------------------------------------------------


def make_site() -> Site:
    return Site.model_validate(
        {
            "vehicle": [{"id": "a"}, {"id": "b"}],
            "beacon": [
                {"id": "wall", "position_m": [1.0, 2.0, 3.0], "position_sd_m": 0.02},
                {"id": "horn", "vehicle": "b", "lever_arm_m": [0.1, 0.2, 0.3]},
            ],
            "microphone": [
                {"id": "ear", "vehicle": "a", "lever_arm_m": [0.4, 0.0, 0.5]},
                {"id": "post", "position_m": [0.0, 0.0, 0.0]},
                {"id": "rear", "vehicle": "b", "lever_arm_m": [-0.4, 0.0, 0.2]},
            ],
        }
    )


def test_link_finds_both_ends_of_each_row() -> None:
    links = link(make_site(), ("wall", "horn", "horn"), ("ear", "post", "ear"))
    assert links.emitter_vehicle.tolist() == [-1, 1, 1]
    assert links.receiver_vehicle.tolist() == [0, -1, 0]
    assert links.emitter_point.tolist() == [[1.0, 2.0, 3.0], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3]]
    # a microphone at the frame's very origin is fixed there, and not taken for a lever arm; of a vehicle's only end,
    # whose heading nothing tells, the horizontal arm is left out: the motion is followed there
    assert links.receiver_point.tolist() == [[0.0, 0.0, 0.5], [0.0, 0.0, 0.0], [0.0, 0.0, 0.5]]
    assert links.emitter_sd_m.tolist() == [0.02, 0.0, 0.0]
    assert len(links) == 3


def test_sites_with_the_same_names_are_not_mixed_up() -> None:
    site = make_site()
    moved = site.model_copy(
        update={"beacons": (site.beacons[0].model_copy(update={"position_m": (7.0, 8.0, 9.0)}), site.beacons[1])}
    )
    for _ in range(2):
        assert link(site, ("wall",), ("ear",)).emitter_point.tolist() == [[1.0, 2.0, 3.0]]
        assert link(moved, ("wall",), ("ear",)).emitter_point.tolist() == [[7.0, 8.0, 9.0]]


def test_links_and_arms_are_the_callers_own() -> None:
    site = make_site()
    link(site, ("wall",), ("ear",)).emitter_point[:] = 0.0
    assert link(site, ("wall",), ("ear",)).emitter_point.tolist() == [[1.0, 2.0, 3.0]]
    with pytest.raises(ValueError, match="read-only"):
        open_arms(site)[0] = 1.0


def test_link_of_no_rows_is_empty() -> None:
    links = link(make_site(), (), ())
    assert len(links) == 0
    assert links.emitter_point.shape == links.receiver_point.shape == (0, 3)


@pytest.mark.parametrize(
    ("emitter", "receiver", "named"), [("well", "ear", "wall, horn"), ("wall", "eye", "ear, post, rear")]
)
def test_link_names_an_unknown_id_and_those_that_exist(emitter: str, receiver: str, named: str) -> None:
    with pytest.raises(KeyError, match=named):
        link(make_site(), (emitter,), (receiver,))


def test_a_lone_end_tells_no_heading_and_leaves_its_arm_open() -> None:
    site = make_site()
    assert turning(site).tolist() == [False, True]
    np.testing.assert_array_equal(open_arms(site), [[0.4, 0.0], [0.0, 0.0]])
    mast = Site.model_validate(
        {
            "vehicle": [{"id": "a"}, {"id": "b"}],
            "beacon": [{"id": "low", "vehicle": "a", "lever_arm_m": [0.2, 0.1, 0.3]}],
            "microphone": [{"id": "high", "vehicle": "a", "lever_arm_m": [0.2, 0.1, 1.3]}],
        }
    )
    # two ends above each other are as one; a vehicle without ends has nothing open
    assert turning(mast).tolist() == [False, False]
    np.testing.assert_array_equal(open_arms(mast), [[0.2, 0.1], [0.0, 0.0]])


CORNERS = ((0.3, 0.0, 0.1), (-0.2, 0.2, 0.1), (-0.2, -0.2, 0.1))


@pytest.mark.parametrize(
    ("vehicle", "arms", "tilt_sd_rad"),
    [
        ({}, CORNERS, TILT_SD_RAD),
        ({"z_m": 0.0}, CORNERS, 0.0),
        ({}, CORNERS[:2], 0.0),
        ({}, [(0.1 * k, 0.2 * k, 0.05 * k) for k in range(4)], 0.0),
        ({"tilt_sd_rad": 0.0}, CORNERS, 0.0),
        ({"tilt_sd_rad": 0.1, "z_m": 0.0}, CORNERS[:2], 0.1),
    ],
    ids=["three", "known level", "two", "on a line", "stated upright", "stated"],
)
def test_a_body_tilts_where_its_ends_can_tell_and_nothing_else_is_stated(
    vehicle: dict, arms: tuple, tilt_sd_rad: float
) -> None:
    site = Site.model_validate(
        {
            "vehicle": [{"id": "a"} | vehicle],
            "beacon": [{"id": "wall", "position_m": [1.0, 2.0, 3.0]}],
            "microphone": [{"id": f"M{i}", "vehicle": "a", "lever_arm_m": arm} for i, arm in enumerate(arms)],
        }
    )
    assert tilting(site).tolist() == [tilt_sd_rad]


def test_a_pose_without_its_tilt_is_refused() -> None:
    with pytest.raises(ValueError, match="12 components"):
        model(links_of(CASES["moving receiver"]), POSES[:, :8], np.zeros(1), SPEED)


@pytest.mark.parametrize("yaw_rad", [0.0, 1.1, -2.5])
def test_an_open_arm_lies_the_way_the_vehicle_drives(yaw_rad: float) -> None:
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    arm = np.array([0.3, -0.2])
    shift, sd_m = from_arm(arm, 0.8 * np.array([cos, sin, 0.0]))
    np.testing.assert_allclose(shift, -np.array([[cos, -sin], [sin, cos]]) @ arm, atol=1e-15)
    assert sd_m == pytest.approx(0.1 * np.hypot(0.3, 0.2))


def test_an_open_arm_of_a_standing_vehicle_may_lie_any_way() -> None:
    shift, sd_m = from_arm(np.array([0.3, -0.4]), np.array([0.0, 0.0, 2.0]))
    np.testing.assert_array_equal(shift, 0.0)
    assert sd_m == pytest.approx(0.5)
    assert from_arm(np.zeros(2), np.array([1.0, 0.0, 0.0]))[1] == 0.0


@pytest.mark.parametrize("keep", [np.array([2, 0]), np.array([True, False, True])])
def test_rows_picks_the_same_rows_of_everything(keep: Floats) -> None:
    links = link(make_site(), ("wall", "horn", "horn"), ("ear", "post", "ear"))
    some = links.rows(keep)
    assert len(some) == 2
    for name in Links.__slots__:
        np.testing.assert_array_equal(getattr(some, name), getattr(links, name)[keep])


def test_rows_speak_of_when_heard_or_of_when_sent_where_only_the_emitter_moves() -> None:
    links = link(make_site(), ("wall", "horn", "horn", "wall"), ("ear", "post", "ear", "post"))
    moments = row_times(links, np.full(4, 10.0), np.full(4, SPEED / 4), SPEED)
    np.testing.assert_allclose(moments, [10.0, 9.75, 10.0, 10.0], rtol=1e-15)


def test_pose_names_are_those_of_the_derivatives() -> None:
    # each component moved by itself changes the range by its own column and no other's
    links = links_of(CASES["moving emitter on an arm"])
    dt = np.array([0.2])
    _, _, by_range, _ = model(links, POSES, dt, SPEED)
    for i, name in enumerate(POSE):
        ahead, back = POSES.copy(), POSES.copy()
        ahead[0, i] += 1e-5
        back[0, i] -= 1e-5
        difference = (model(links, ahead, dt, SPEED)[0] - model(links, back, dt, SPEED)[0]) / 2e-5
        assert by_range[0, 0, i] == pytest.approx(difference[0], abs=1e-6), name
