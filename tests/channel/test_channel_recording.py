"""Whole recordings: same samples however they are read, echoes from where images stand, clocks, noise, truth."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sonofix.channel import Circle, Line, Motion, Sampled, Still, Tone, simulate
from sonofix.channel.simulate import PAGE
from sonofix.records import Recording, Waveform
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

RATE = 96e3
SPEED = 343.2
BOUNDS = ((0.0, 0.0, 0.0), (6.0, 5.0, 3.0))


def _code(index: int) -> dict[str, Any]:
    return {"family": "gold", "degree": 5, "index": index}


def _site(beacons: list[dict[str, Any]], microphones: list[dict[str, Any]], **others: Any) -> Site:
    sections: dict[str, Any] = {
        "site": {"name": "hall", "bounds_m": BOUNDS},
        "air": {"sound_speed_mps": SPEED},
        "schedule": {"period_s": 0.1},
        "signal": {"carrier_hz": 30e3, "cycles_per_chip": 10, "bandwidth_hz": 4e3},
        "vehicle": [{"id": "v"}],
        "beacon": [{"code": _code(i)} | b for i, b in enumerate(beacons)],
        "microphone": [{"channel": i} | m for i, m in enumerate(microphones)],
    }
    return Site.model_validate(sections | others)


def _waveforms(site: Site) -> dict[str, Waveform]:
    return waveforms_of(site)


def _samples(recording: Recording, length: int = 10_000) -> NDArray[np.float32]:
    assert recording.blocks is not None
    return np.concatenate(list(recording.blocks(length)))


def _simulated(site: Site, motions: dict[str, Motion], duration_s: float = 0.3, **how: Any) -> NDArray[np.float32]:
    how = {"rate_hz": RATE, "waveforms": _waveforms(site), "absorption_db_per_m": 1.0} | how
    return _samples(simulate(site, motions, duration_s=duration_s, **how)[0])


HALL = _site(
    [{"id": "A", "position_m": (0.1, 0.2, 2.9)}, {"id": "B", "position_m": (5.9, 0.1, 2.8)}],
    [{"id": "M", "vehicle": "v", "lever_arm_m": (0.2, 0.0, 0.3)}, {"id": "N", "position_m": (3.0, 4.8, 1.0)}],
)
DRIVE: dict[str, Motion] = {"v": Circle((3.0, 2.5, 0.2), 1.0, 1.5)}


@pytest.mark.parametrize("length", [1009, PAGE, 50_000, 10**6])
def test_block_length_does_not_change_samples(length: int) -> None:
    recording, _ = simulate(
        HALL,
        DRIVE,
        rate_hz=RATE,
        duration_s=1.0,
        waveforms=_waveforms(HALL),
        noise_sd=0.01,
        echo=0.5,
        seed=4,
        tone=Tone(31e3, 0.02, 50.0),
        clip=0.1,
    )
    assert recording.blocks is not None
    blocks = list(recording.blocks(length))
    assert all(len(b) == length for b in blocks[:-1])
    assert blocks[0].dtype == np.float32
    assert sum(map(len, blocks)) == recording.sample_count == 96_000
    np.testing.assert_array_equal(np.concatenate(blocks), _samples(recording, 7777))


def test_a_longer_recording_begins_with_the_same_samples() -> None:
    short = _simulated(HALL, DRIVE, 0.2, noise_sd=0.01)
    long = _simulated(HALL, DRIVE, 0.5, noise_sd=0.01)
    np.testing.assert_array_equal(long[: len(short)], short)


def test_the_seed_decides_the_noise() -> None:
    one, same, other = (_simulated(HALL, DRIVE, 0.1, noise_sd=0.01, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.std(one - other) == pytest.approx(0.01 * np.sqrt(2), rel=0.05)


def test_noise_is_white_and_as_loud_as_told() -> None:
    x = _simulated(HALL, DRIVE, 2.0, noise_sd=0.02, waveforms={}).astype(float)
    n = x.size
    assert x.std() == pytest.approx(0.02, rel=5 / np.sqrt(2 * n))
    assert abs(x.mean()) < 5 * 0.02 / np.sqrt(n)
    for lag in (1, 2, PAGE):
        assert abs(np.mean(x[lag:] * x[:-lag])) < 5 * 0.02**2 / np.sqrt(n)
    assert abs(np.mean(x[:, 0] * x[:, 1])) < 5 * 0.02**2 / np.sqrt(len(x))


def test_memory_does_not_grow_with_the_recording() -> None:
    peaks = []
    for duration_s in (2.0, 12.0):
        recording, _ = simulate(
            HALL, DRIVE, rate_hz=RATE, duration_s=duration_s, waveforms=_waveforms(HALL), noise_sd=0.01
        )
        assert recording.blocks is not None
        blocks = recording.blocks(20_000)
        next(blocks)
        tracemalloc.start()
        for _ in blocks:
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


def test_beacons_add_up_and_levels_scale() -> None:
    w = _waveforms(HALL)
    alone = [_simulated(HALL, DRIVE, waveforms={b: w[b]}).astype(float) for b in "AB"]
    both = _simulated(HALL, DRIVE, level={"A": 1.0, "B": 0.25})
    assert np.abs(alone[0]).max() > 0.02
    np.testing.assert_allclose(both, 2 * alone[0] + 0.5 * alone[1], atol=1e-7)


@pytest.mark.parametrize("moving", ["microphone", "beacon"])
def test_echoes_come_from_the_images(moving: str) -> None:
    drive, fixed = Line((2.0, 1.5, 1.0), (1.5, 0.7, 0.2)), (4.5, 4.0, 2.5)
    on, at = {"vehicle": "v"}, {"position_m": fixed}
    site = _site([{"id": "A"} | (on if moving == "beacon" else at)], [{"id": "M"} | (at if moving == "beacon" else on)])
    echoed = _simulated(site, {"v": drive}, echo=0.6).astype(float)
    direct = _simulated(site, {"v": drive}).astype(float)
    expected = direct.copy()
    for axis in range(3):
        for wall in (BOUNDS[0][axis], BOUNDS[1][axis]):
            start, velocity, place = (np.array(v) for v in (drive.start_m, drive.velocity_mps, fixed))
            if moving == "beacon":
                start[axis], velocity[axis] = 2 * wall - start[axis], -velocity[axis]
                image = site
            else:
                place[axis] = 2 * wall - place[axis]
                image = _site([{"id": "A", "position_m": tuple(place.tolist())}], [{"id": "M", "vehicle": "v"}])
            motion = Line(tuple(start.tolist()), tuple(velocity.tolist()))
            expected += 0.6 * _simulated(image, {"v": motion})
    assert np.abs(echoed - direct).max() > 0.01
    np.testing.assert_allclose(echoed, expected, atol=1e-7)


def test_the_first_echo_arrives_at_the_images_distance() -> None:
    site = _site([{"id": "A", "position_m": (3.0, 2.5, 2.0)}], [{"id": "M", "vehicle": "v"}])
    motions: dict[str, Motion] = {"v": Still((3.0, 2.5, 1.0))}
    # the burst's own sound ends (table's rounding aside) where it starts: nothing is heard before τ = 0
    echo = _simulated(site, motions, 0.09, echo=0.6) - _simulated(site, motions, 0.09)
    first = int(np.flatnonzero(np.abs(echo[:, 0]) > 1e-4)[0])
    # ceiling and floor: 3 m both, of the six images the nearest
    assert 0 <= first / RATE - 3.0 / SPEED < 1.5e-4


def test_echoes_need_a_room_and_everything_in_it() -> None:
    outside = {"v": Line((3.0, 2.5, 1.0), (20.0, 0.0, 0.0))}
    with pytest.raises(
        ValueError, match=r"microphone M is at \(6\.20, 2\.50, 1\.30\) m at 0\.15 s, outside site\.bounds_m"
    ):
        _simulated(HALL, outside, echo=0.5)
    open_air = HALL.model_copy(update={"section": HALL.section.model_copy(update={"bounds_m": None})})
    with pytest.raises(ValueError, match=r"bounds_m is missing"):
        _simulated(open_air, DRIVE, echo=0.5)


def test_robots_hear_one_another_but_not_themselves() -> None:
    site = _site(
        [{"id": "P", "vehicle": "p"}, {"id": "Q", "vehicle": "q"}],
        [{"id": "P", "vehicle": "p"}, {"id": "Q", "vehicle": "q"}],
        vehicle=[{"id": "p"}, {"id": "q"}],
    )
    motions: dict[str, Motion] = {"p": Still((1.0, 1.0, 0.5)), "q": Circle((3.0, 2.0, 0.5), 0.5, 1.0)}
    x = _simulated(site, motions, waveforms={"P": _waveforms(site)["P"]})
    assert np.abs(x[:, 0]).max() == 0.0
    assert np.abs(x[:, 1]).max() > 0.05


def test_two_microphones_of_a_vehicle_hear_its_turn() -> None:
    arms = ((0.3, 0.0, 0.0), (-0.3, 0.0, 0.0))
    site = _site(
        [{"id": "A", "position_m": (5.0, 2.0, 1.0)}],
        [{"id": f"M{i}", "vehicle": "v", "lever_arm_m": arm} for i, arm in enumerate(arms)],
    )
    apart = {}
    for yaw in (0.0, np.pi / 2, np.pi):
        x = np.abs(_simulated(site, {"v": Still((2.0, 2.0, 1.0), yaw)}, 0.09)) > 0.01
        apart[yaw] = (int(x[:, 1].argmax()) - int(x[:, 0].argmax())) / RATE * SPEED
    # with the front towards the beacon the front hears it 0.6 m earlier
    assert [round(apart[yaw], 1) for yaw in (0.0, np.pi / 2, np.pi)] == pytest.approx([0.6, 0.0, -0.6], abs=0.05)


def test_a_channel_without_a_microphone_holds_noise_alone() -> None:
    site = _site(
        [{"id": "A", "position_m": (1.0, 1.0, 1.0)}], [{"id": "M", "position_m": (2.0, 2.0, 1.0), "channel": 2}]
    )
    x = _simulated(site, DRIVE)
    assert x.shape[1] == 3
    assert np.abs(x[:, :2]).max() == 0.0
    assert np.abs(x[:, 2]).max() > 0.05


@pytest.mark.parametrize("delay", ["beacon offset", "beacon delay", "microphone delay", "clock offset"])
def test_delays_and_offsets_shift_the_samples(delay: str) -> None:
    shift = 480
    late = shift / RATE
    beacon: dict[str, Any] = {"id": "A", "position_m": (1.0, 1.0, 1.0)}
    microphone: dict[str, Any] = {"id": "M", "position_m": (4.0, 2.0, 1.0)}
    before = _simulated(_site([beacon], [microphone]), DRIVE)
    beacon |= {"beacon offset": {"offset_s": late}, "beacon delay": {"delay_s": late}}.get(delay, {})
    microphone |= {"delay_s": late} if delay == "microphone delay" else {}
    offset = late if delay == "clock offset" else 0.0
    after = _simulated(_site([beacon], [microphone]), DRIVE, clock_offset_s=offset)
    np.testing.assert_allclose(after[shift:], before[:-shift], atol=1e-6)


def test_truth_is_the_motion_two_hundred_times_a_second() -> None:
    _, truth = simulate(HALL, DRIVE, rate_hz=RATE, duration_s=1.0, waveforms=_waveforms(HALL))
    pose = truth["v"]
    assert pose.vehicle == "v"
    assert len(pose.time_s) == 200
    assert pose.time_s[[0, -1]] == pytest.approx([0.0, 0.995])
    np.testing.assert_allclose(np.hypot(*(pose.position_m[:, :2] - [3.0, 2.5]).T), 1.0, rtol=1e-12)
    assert pose.yaw_rad is not None
    np.testing.assert_allclose(pose.yaw_rad, np.pi / 2 + 1.5 * pose.time_s, atol=1e-12)


def test_truth_makes_the_same_recording_again() -> None:
    recording, truth = simulate(
        HALL, DRIVE, rate_hz=RATE, duration_s=0.6, waveforms=_waveforms(HALL), absorption_db_per_m=1.0
    )
    pose = truth["v"]
    again = _simulated(HALL, {"v": Sampled(pose.time_s, pose.position_m, pose.yaw_rad)}, 0.6)
    first = _samples(recording)
    # away from its ends, rows 5 ms apart hold this circle to 1e-7 m, a hundred-thousandth of a wavelength
    inner = slice(int(0.05 * RATE), int(0.55 * RATE))
    np.testing.assert_allclose(again[inner], first[inner], atol=1e-4 * np.abs(first).max())


def test_sound_speed_and_absorption_follow_the_air() -> None:
    warm = _site(
        [{"id": "A", "position_m": (0.5, 2.5, 1.0)}],
        [{"id": "M", "position_m": (5.5, 2.5, 1.0)}],
        air={"temperature_c": 35.0, "humidity": 0.2},
    )
    cold = warm.model_copy(update={"air": warm.air.model_copy(update={"temperature_c": -5.0})})
    heard = {}
    for name, site in (("warm", warm), ("cold", cold)):
        x = _simulated(site, DRIVE, 0.09, absorption_db_per_m=None)[:, 0]
        heard[name] = (int((np.abs(x) > 0.1 * np.abs(x).max()).argmax()) / RATE, float(np.abs(x).max()))
    # Cramer: 352.4 m/s at 35 °C and 20 %, 328.3 m/s at −5 °C and 20 %, both within 0.1 %
    assert heard["cold"][0] - heard["warm"][0] == pytest.approx(5.0 / 328.3 - 5.0 / 352.4, abs=3e-5)
    # ISO 9613-1 at 30 kHz differs by some dB over these 5 m
    assert heard["cold"][1] != pytest.approx(heard["warm"][1], rel=0.05)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"motions": {}}, "none for vehicle v"),
        ({"motions": DRIVE | {"w": Still((0, 0, 0))}}, "motions: w is not in the site; it has v"),
        ({"waveforms": {"X": _waveforms(HALL)["A"]}}, "waveforms: X is not in the site; it has A, B"),
        ({"rate_hz": 50e3}, "beacon A sends on 30000 Hz"),
        ({"duration_s": 0.0}, "duration_s = 0"),
        ({"noise_sd": float("nan")}, "noise_sd = nan"),
        ({"echo": 1.5}, "echo = 1.5"),
        ({"clip": 0.0}, "clip = 0; it must lie"),
        ({"seed": -1}, "seed = -1"),
        ({"level": {"A": 1.0}}, "level: none for beacon B"),
        ({"sync_jitter_s": 0.05}, "sync_jitter_s = 0.05"),
        ({"site": HALL.model_copy(update={"schedule": None})}, "period_s is missing"),
        ({"site": HALL.model_copy(update={"microphones": ()})}, "no microphone has a channel"),
    ],
)
def test_misuse_names_the_value_and_the_remedy(change: dict[str, Any], told: str) -> None:
    how: dict[str, Any] = {"site": HALL, "motions": DRIVE, "rate_hz": RATE, "duration_s": 0.1}
    how |= {"waveforms": _waveforms(HALL)} | change
    site, motions = how.pop("site"), how.pop("motions")
    with pytest.raises(ValueError, match=told):
        simulate(site, motions, **how)


def test_blocks_need_a_length() -> None:
    recording, _ = simulate(HALL, DRIVE, rate_hz=RATE, duration_s=0.1, waveforms={})
    assert recording.blocks is not None
    with pytest.raises(ValueError, match="blocks of 0 samples"):
        next(recording.blocks(0))
