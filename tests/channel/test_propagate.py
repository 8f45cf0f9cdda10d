"""The kernel of retarded time against a plain NumPy twin, its own equation, and theory."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.channel import Circle, Line, Motion, Still
from sonofix.channel.propagate import NEAREST_M, PoseTable, add_sound, emission_delay_s
from sonofix.channel.scene import mirrored, pose_table, position_at
from sonofix.records import Floats, Waveform
from sonofix.signals.waveform import waveform_of
from sonofix.site import Beacon, Microphone, Site

SPEED = 343.2
RATE = 192e3
Levers = tuple[tuple[float, float, float], tuple[float, float, float]]


def _beacon(lever: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Beacon:
    return Beacon(id="B", vehicle="a", lever_arm_m=lever)


def _mic(lever: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Microphone:
    return Microphone(id="M", vehicle="b", lever_arm_m=lever, channel=0)


def _tables(emitter: Motion, microphone: Motion, from_s: float, to_s: float) -> tuple[PoseTable, PoseTable]:
    motions = {"a": emitter, "b": microphone}
    return (
        pose_table(_mic(), motions, from_s, to_s, SPEED),
        pose_table(_beacon(), motions, from_s - 0.5, to_s, SPEED),
    )


def _coded() -> Waveform:
    site = Site.model_validate(
        {
            "schedule": {"period_s": 0.1},
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10, "bandwidth_hz": 4e3},
            "beacon": [
                {"id": "B", "position_m": (0.0, 0.0, 0.0), "code": {"family": "m-sequence", "degree": 5, "taps": [2]}}
            ],
        }
    )
    return waveform_of(site, site.beacons[0])


def _tone(carrier_hz: float = 40e3, duration_s: float = 0.3) -> Waveform:
    envelope = np.ones(int(duration_s * 1000), complex)
    return Waveform(envelope, envelope, 1000.0, 0.0, carrier_hz, duration_s)


def _twin(
    time_s: Floats,
    emitter: Motion,
    microphone: Motion,
    w: Waveform,
    starts_s: list[float],
    absorption: float,
    stretch: float,
    levers: Levers,
) -> Floats:
    """The same in plain NumPy, straight from the motions: fixed-point iteration, four-point Lagrange."""
    motions = {"a": emitter, "b": microphone}
    at = position_at(_mic(levers[1]), motions, time_s)
    delay = np.zeros(len(time_s))
    for _ in range(60):
        distance = np.linalg.norm(at - position_at(_beacon(levers[0]), motions, time_s - delay), axis=1)
        delay = distance / SPEED
    out = np.zeros(len(time_s))
    for start in starts_s:
        tau = (time_s - start - delay) / stretch
        where = (tau - w.start_s) * w.rate_hz
        i = np.floor(where).astype(int)
        inside = (i >= 1) & (i <= len(w.envelope) - 3)
        i, x = np.where(inside, i, 1), where - i
        nodes = (-1, 0, 1, 2)
        value = sum(w.envelope[i + j] * np.prod([(x - m) / (j - m) for m in nodes if m != j], axis=0) for j in nodes)
        sound = np.real(value * np.exp(2j * np.pi * w.carrier_hz * tau))
        out += np.where(inside, 10 ** (-absorption * distance / 20) / distance * sound, 0.0)
    return out


@pytest.mark.parametrize(
    ("emitter", "microphone", "levers"),
    [
        (Still((0.0, 0.0, 3.0)), Circle((3.0, 2.0, 0.4), 1.0, 1.8), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))),
        (Circle((3.0, 2.0, 0.4), 1.0, -1.8), Still((0.0, 0.0, 3.0)), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))),
        (
            Line((0.0, 0.0, 1.0), (9.0, 4.0, -1.0)),
            Circle((3.0, 2.0, 0.4), 1.0, 2.5),
            ((0.2, 0.1, 0.3), (0.3, -0.2, 0.1)),
        ),
    ],
    ids=["moving microphone", "moving emitter", "both, on lever arms"],
)
@pytest.mark.parametrize("stretch", [1.0, 1.0001])
def test_kernel_equals_its_numpy_twin(emitter: Motion, microphone: Motion, levers: Levers, stretch: float) -> None:
    w, first, count, delay = _coded(), 5000, 20000, 0.0003
    time_s = (first + np.arange(count)) / RATE - delay
    motions = {"a": emitter, "b": microphone}
    table_m = pose_table(_mic(levers[1]), motions, time_s[0], time_s[-1], SPEED)
    table_e = pose_table(_beacon(levers[0]), motions, time_s[0] - 0.2, time_s[-1], SPEED)
    starts = [-0.05, 0.0201, 0.0699]
    out = np.zeros(count)
    add_sound(
        out,
        first,
        RATE,
        table_m,
        table_e,
        w,
        np.array(starts),
        sound_speed_mps=SPEED,
        gain=0.7,
        absorption_db_per_m=1.3,
        stretch=stretch,
        microphone_delay_s=delay,
    )
    expected = 0.7 * _twin(time_s, emitter, microphone, w, starts, 1.3, stretch, levers)
    assert np.abs(expected).max() > 0.02
    # knots on lever arms take the yaw rate from differences: below 1e-8 m of position, 1e-5 rad of carrier
    np.testing.assert_allclose(out, expected, atol=2e-6 * np.abs(expected).max())


def test_kernel_adds_to_what_is_there() -> None:
    mic, emitter = _tables(Still((0, 0, 1)), Still((2, 0, 1)), 0.0, 0.1)
    once, twice = np.zeros(19200), np.zeros(19200)
    for out, times in ((once, 1), (twice, 2)):
        for _ in range(times):
            add_sound(
                out,
                0,
                RATE,
                mic,
                emitter,
                _coded(),
                np.zeros(1),
                sound_speed_mps=SPEED,
                gain=1.0,
                absorption_db_per_m=0.0,
            )
    assert np.abs(once).max() > 0.1
    np.testing.assert_array_equal(twice, 2 * once)


@pytest.mark.parametrize("speed_mps", [0.0, 2.0, 30.0, 100.0])
def test_retarded_time_solves_its_equation(speed_mps: float) -> None:
    emitter, microphone = (
        Circle((5, 0, 3), 2.0, -speed_mps),
        Line((-100 * speed_mps, -30.0, -10.0), (speed_mps, 0.3, 0.1)),
    )
    from_s, to_s = 100.0, 100.2
    mic_table, emit_table = _tables(emitter, microphone, from_s, to_s)
    time_s = np.linspace(from_s, to_s, 2001)
    delay = emission_delay_s(time_s, mic_table, emit_table, SPEED)
    # ask the equation of the motions themselves, not of the tables
    distance = np.linalg.norm(microphone.at(time_s).position_m - emitter.at(time_s - delay).position_m, axis=1)
    # a Hermite curve through knots h apart is off by |d⁴p/dt⁴| h⁴ / 384
    knots_s = 2.0 * (speed_mps / 2.0) ** 4 * 1e-12 / 384 / SPEED
    np.testing.assert_allclose(delay, distance / SPEED, rtol=0, atol=1e-12 + knots_s)
    assert (np.diff(time_s - delay) > 0).all()


def _heard_hz(emitter: Motion, microphone: Motion, expected_hz: float) -> float:
    """Frequency of a tone as heard, by the phase's slope against the expectation."""
    mic, emit = _tables(emitter, microphone, 0.0, 0.3)
    out = np.zeros(int(0.2 * RATE))
    first = int(0.05 * RATE)
    add_sound(
        out,
        first,
        RATE,
        mic,
        emit,
        _tone(duration_s=0.6),
        np.array([-0.3]),
        sound_speed_mps=SPEED,
        gain=1.0,
        absorption_db_per_m=0.0,
    )
    t = np.arange(len(out)) / RATE
    base = (out * np.exp(-2j * np.pi * expected_hz * t)).reshape(-1, 1920).mean(axis=1)
    phase = np.unwrap(np.angle(base))
    return expected_hz + float(np.polyfit(t[960::1920], phase, 1)[0]) / (2 * np.pi)


def test_moving_emitter_and_moving_microphone_shift_the_pitch_differently() -> None:
    v, far = 20.0, 8.0
    emitter_leaves = 40e3 / (1 + v / SPEED)
    microphone_leaves = 40e3 * (1 - v / SPEED)
    assert abs(emitter_leaves - microphone_leaves) > 100
    heard = _heard_hz(Line((0, 0, 0), (-v, 0, 0)), Still((far, 0, 0)), emitter_leaves)
    assert heard == pytest.approx(emitter_leaves, abs=1e-3)
    heard = _heard_hz(Still((0, 0, 0)), Line((far, 0, 0), (v, 0, 0)), microphone_leaves)
    assert heard == pytest.approx(microphone_leaves, abs=1e-3)


def test_moving_together_leaves_the_pitch_alone() -> None:
    heard = _heard_hz(Line((0, 0, 0), (15.0, 0, 0)), Line((8, 0, 0), (15.0, 0, 0)), 40e3)
    assert heard == pytest.approx(40e3, abs=1e-3)


def _amplitude(distance_m: float, absorption: float) -> float:
    mic, emit = _tables(Still((0, 0, 0)), Still((distance_m, 0, 0)), 0.0, 0.3)
    out = np.zeros(9600)
    add_sound(
        out,
        19200,
        RATE,
        mic,
        emit,
        _tone(),
        np.zeros(1),
        sound_speed_mps=SPEED,
        gain=0.8,
        absorption_db_per_m=absorption,
    )
    return float(np.sqrt(2 * np.mean(out**2)))


@pytest.mark.parametrize("distance_m", [0.5, 1.0, 3.0, 12.0])
def test_level_falls_with_distance_and_absorption(distance_m: float) -> None:
    expected = 0.8 / distance_m * 10 ** (-1.3 * distance_m / 20)
    assert _amplitude(distance_m, 1.3) == pytest.approx(expected, rel=1e-6)
    assert _amplitude(distance_m, 0.0) == pytest.approx(0.8 / distance_m, rel=1e-6)


def test_spreading_is_bounded_up_close() -> None:
    assert _amplitude(0.0, 0.0) == pytest.approx(0.8 / NEAREST_M, rel=1e-6)


def test_the_image_in_a_wall_is_the_mirrored_motion() -> None:
    table = pose_table(_beacon(), {"a": Line((1.0, 2.0, 0.5), (0.3, -0.2, 0.1))}, 0.0, 1.0, SPEED)
    image = mirrored(table, 1, 6.0)
    expected = pose_table(_beacon(), {"a": Line((1.0, 10.0, 0.5), (0.3, 0.2, 0.1))}, 0.0, 1.0, SPEED)
    np.testing.assert_allclose(image.position_m, expected.position_m, atol=1e-12)
    np.testing.assert_allclose(image.velocity_mps, expected.velocity_mps, atol=1e-12)


def test_near_sonic_vehicles_are_refused() -> None:
    with pytest.raises(ValueError, match="vehicle a moves at 200 m/s"):
        pose_table(_beacon(), {"a": Line((0, 0, 0), (200.0, 0, 0))}, 0.0, 0.1, SPEED)
