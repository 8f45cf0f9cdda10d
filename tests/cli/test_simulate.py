"""`sonofix simulate`: a folder that reads back as what was made, and mistakes told in a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile
from typer.testing import CliRunner, Result

from sonofix.channel import Circle, Waypoints, simulate
from sonofix.cli.main import app
from sonofix.files import read_recording, read_site, read_truth
from sonofix.signals.waveform import waveform_of, waveforms_of

SITE = """format = 1
[site]
name = "hall"
bounds_m = [[0.0, 0.0, 0.0], [10.0, 8.0, 3.2]]
[air]
sound_speed_mps = 343.2
[schedule]
period_s = 0.1
[signal]
carrier_hz = 20000.0
cycles_per_chip = 10
bandwidth_hz = 4000.0
[[vehicle]]
id = "agv"
z_m = 0.4
[[beacon]]
id = "B1"
position_m = [0.0, 0.0, 3.2]
code = { family = "m-sequence", degree = 5, taps = [2] }
[[beacon]]
id = "B2"
position_m = [10.0, 0.0, 3.2]
code = { family = "m-sequence", degree = 5, taps = [3] }
[[microphone]]
id = "M1"
channel = 0
vehicle = "agv"
lever_arm_m = [0.3, 0.0, 0.1]
"""
SECOND = """[[vehicle]]
id = "cart"
[[microphone]]
id = "M2"
channel = 1
vehicle = "cart"
"""
QUICK = ("--duration", "0.4", "--rate", "96000")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    path = tmp_path / "hall.toml"
    path.write_text(SITE)
    return path


def _run(*words: str | Path) -> Result:
    return CliRunner().invoke(app, ["simulate", *map(str, words)])


def _samples(folder: Path) -> np.ndarray:
    blocks = read_recording(folder).blocks
    assert blocks is not None
    return np.concatenate(list(blocks(10_000)))


def test_the_folder_holds_what_was_simulated(site: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("--level", "0.5", "--noise-db", "-40", "--absorption", "0.5", "--echo", "0.6", "--seed", "7")
    result = _run(site, out, *QUICK, "--motion", "circle:5,4,1.5,1.2", *words)
    assert result.exit_code == 0, result.output
    assert "0.4 s at 96000 Hz, 2 beacons, 1 microphone, 1 vehicle" in result.output
    plan = read_site(site)
    recording, truth = simulate(
        plan,
        {"agv": Circle((5.0, 4.0, 0.4), 1.5, 1.2)},
        rate_hz=96e3,
        duration_s=0.4,
        waveforms=waveforms_of(plan),
        noise_sd=0.01,
        level=0.5,
        absorption_db_per_m=0.5,
        echo=0.6,
        seed=7,
    )
    assert recording.blocks is not None
    made = np.concatenate(list(recording.blocks(10**6)))
    np.testing.assert_allclose(_samples(out), made, atol=1.01 / 32768)
    assert read_recording(out).site == plan
    pose = read_truth(out)["agv"]
    np.testing.assert_allclose(pose.position_m, truth["agv"].position_m, atol=1e-8)
    assert pose.yaw_rad is not None
    np.testing.assert_allclose(pose.yaw_rad, truth["agv"].yaw_rad, atol=1e-8)


@pytest.mark.parametrize(
    ("motion", "start", "end"),
    [
        ("still:2,3", (2.0, 3.0, 0.4), (2.0, 3.0, 0.4)),
        ("still:2,3,1.5", (2.0, 3.0, 1.5), (2.0, 3.0, 1.5)),
        ("line:1,1,0.5,-0.5", (1.0, 1.0, 0.4), (1.1975, 0.8025, 0.4)),
        ("waypoints:1,1;5,1;5,4@2", (1.0, 1.0, 0.4), (1.79, 1.0, 0.4)),
        ("waypoints:1,1,1;5,1,1@2", (1.0, 1.0, 1.0), (1.79, 1.0, 1.0)),
    ],
)
def test_motions_are_driven_as_told(
    site: Path, tmp_path: Path, motion: str, start: tuple[float, ...], end: tuple[float, ...]
) -> None:
    assert _run(site, tmp_path / "out", *QUICK, "--motion", motion).exit_code == 0
    position = read_truth(tmp_path / "out")["agv"].position_m
    np.testing.assert_allclose(position[[0, -1]], [start, end], atol=1e-8)


def test_a_closed_way_is_lapped(site: Path, tmp_path: Path) -> None:
    corners = ((1.0, 1.0, 0.4), (2.0, 1.0, 0.4), (2.0, 2.0, 0.4), (1.0, 1.0, 0.4))
    assert _run(site, tmp_path / "out", "--motion", "waypoints:1,1;2,1;2,2;1,1@2", "--duration", "2.5").exit_code == 0
    pose = read_truth(tmp_path / "out")["agv"]
    np.testing.assert_allclose(pose.position_m, Waypoints(corners, 2.0).at(pose.time_s).position_m, atol=1e-8)
    assert Waypoints(corners, 2.0).length_m < 2.5 * 2.0


def test_truth_drives_again(site: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    quiet = (*QUICK, "--noise-db", "-inf", "--level", "0.5")
    assert _run(site, first, *quiet, "--motion", "circle:5,4,1.5,1.2").exit_code == 0
    assert _run(site, second, *quiet, "--motion", f"csv:{first / 'truth.csv'}").exit_code == 0
    inner = slice(4800, -4800)
    np.testing.assert_allclose(_samples(second)[inner], _samples(first)[inner], atol=2.1 / 32768)


def test_each_vehicle_has_its_motion(tmp_path: Path) -> None:
    site, out = tmp_path / "two.toml", tmp_path / "out"
    site.write_text(SITE + SECOND)
    motions = ("--vehicle", "cart", "--motion", "still:6,6", "--vehicle", "agv", "--motion", "still:2,2")
    assert _run(site, out, *QUICK, *motions, "--z", "0.7", "--flac").exit_code == 0
    assert (out / "capture.flac").exists()
    truth = read_truth(out)
    np.testing.assert_allclose(truth["cart"].position_m[0], [6.0, 6.0, 0.7])
    np.testing.assert_allclose(truth["agv"].position_m[0], [2.0, 2.0, 0.4])
    assert _samples(out).shape == (38400, 2)


def test_sync_instants_go_beside_the_samples_where_they_are_irregular(site: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert _run(site, out, *QUICK, "--motion", "still:5,4", "--clock-offset", "0.03").exit_code == 0
    np.testing.assert_allclose(read_recording(out).sync_s, [0.03, 0.13, 0.23, 0.33], atol=1e-9)
    assert _run(site, out, *QUICK, "--motion", "still:5,4", "--force").exit_code == 0
    assert read_recording(out).sync_s is None


def test_levels_and_tone_are_as_told(site: Path, tmp_path: Path) -> None:
    quiet, toned = tmp_path / "quiet", tmp_path / "toned"
    assert _run(site, quiet, *QUICK, "--motion", "still:5,4", "--noise-db", "-inf").exit_code == 0
    assert 0.1 < np.abs(_samples(quiet)).max() <= 0.5
    words = ("--noise-db", "-inf", "--tone-hz", "21000", "--tone-db", "-12")
    assert _run(site, toned, *QUICK, "--motion", "still:5,4", *words).exit_code == 0
    tone = _samples(toned)[:, 0].astype(float) - _samples(quiet)[:, 0]
    assert np.sqrt(2 * np.mean(tone**2)) == pytest.approx(10 ** (-12 / 20), rel=1e-3)


def test_a_recorded_reference_is_played(site: Path, tmp_path: Path) -> None:
    plan = read_site(site)
    burst, distance, rate = waveform_of(plan, plan.beacons[0]), 0.5, 96000
    t = np.arange(int(0.03 * rate)) / rate - distance / 343.2
    table = burst.start_s + np.arange(len(burst.envelope)) / burst.rate_hz
    envelope = np.interp(t, table, burst.envelope.real) + 1j * np.interp(t, table, burst.envelope.imag)
    soundfile.write(tmp_path / "ref.wav", np.real(envelope * np.exp(2j * np.pi * 20e3 * t)) * 0.5, rate, "PCM_24")
    text = SITE.replace(
        '{ family = "m-sequence", degree = 5, taps = [2] }', '{ reference = "ref.wav", distance_m = 0.5 }'
    )
    (tmp_path / "ref.toml").write_text(text)
    words = (*QUICK, "--motion", "still:5,4", "--noise-db", "-inf", "--level", "1")
    assert _run(site, tmp_path / "chips", *words).exit_code == 0
    result = _run(tmp_path / "ref.toml", tmp_path / "played", *words)
    assert result.exit_code == 0, result.output
    assert (tmp_path / "played" / "ref.wav").exists()
    # the reference is half as strong; what differs is one beacon's half, and what interpolation cost
    chips, played = _samples(tmp_path / "chips"), _samples(tmp_path / "played")
    assert np.std(played) / np.std(chips) == pytest.approx(np.sqrt(0.625), rel=0.05)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "--motion is given 0 times, for 1 vehicle of the site's (agv)"),
        (("--motion", "still:1"), '--motion still:1: "1" holds 1 numbers; 2 or 3 are needed'),
        (("--motion", "line:1,1,one,1"), '"1,1,one,1" is not numbers'),
        (("--motion", "hop:1,1"), "--motion hop:1,1: no such motion; write still:x,y or"),
        (("--motion", "waypoints:1,1;2,2"), "no speed; end it with @"),
        (("--motion", "waypoints:1,1;1,1@1"), "points 1 and 2 are the same"),
        (("--motion", "circle:1,1,0,1"), "radius_m = 0"),
        (("--motion", "csv:nowhere.csv"), "nowhere.csv: there is no such file"),
        (("--motion", "still:1,1", "--vehicle", "x"), "--vehicle x: the site has no such vehicle; it has agv"),
        (("--motion", "still:11,1", "--echo", "0.5"), "outside site.bounds_m"),
        (("--motion", "still:1,1", "--echo", "2"), "--echo 2"),
        (("--motion", "still:1,1", "--rate", "30000"), "beacon B1 sends on 20000 Hz"),
        (("--motion", "still:1,1", "--duration", "-1"), "--duration -1"),
        (("--motion", "still:1,1", "--snr", "3", "--noise-db", "-40"), "--snr and --noise-db both"),
        (("--motion", "still:1,1", "--snr", "nan"), "not a number"),
        (("--motion", "still:1,1", "--seed", "-1"), "seed = -1"),
    ],
)
def test_mistakes_are_told_in_a_line(site: Path, tmp_path: Path, words: tuple[str, ...], told: str) -> None:
    result = _run(site, tmp_path / "out", *words)
    assert result.exit_code == 2
    assert told in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_all_mistakes_of_the_site_are_told(tmp_path: Path) -> None:
    site = tmp_path / "bad.toml"
    site.write_text(SITE.replace("period_s", "periods").replace('"B2"', '"B1"'))
    result = _run(site, tmp_path / "out", "--motion", "still:1,1")
    assert result.exit_code == 2
    assert "periods" in result.stderr
    assert "its own id" in result.stderr


def test_rows_of_a_motion_file_are_judged(site: Path, tmp_path: Path) -> None:
    (tmp_path / "way.csv").write_text("time_s,x_m,y_m\n0,1,1\n1,two,1\n")
    result = _run(site, tmp_path / "out", "--motion", f"csv:{tmp_path / 'way.csv'}")
    assert result.exit_code == 2
    assert "way.csv: line 3, x_m" in result.stderr


def test_a_recording_is_replaced_only_by_force(site: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = (site, out, *QUICK, "--motion", "still:5,4")
    assert _run(*words).exit_code == 0
    before = _samples(out)
    result = _run(*words, "--seed", "9")
    assert result.exit_code == 2
    assert "is a recording already" in result.stderr
    np.testing.assert_array_equal(_samples(out), before)
    assert _run(*words, "--seed", "9", "--force").exit_code == 0
    assert (_samples(out) != before).any()


def test_what_somebody_measured_is_never_mixed_with_made_up_samples(site: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = (site, out, *QUICK, "--motion", "still:5,4", "--force")
    assert _run(*words).exit_code == 0
    (out / "odometry.csv").write_text("time_s,v_mps,yaw_rate_radps\n0,1,0\n")
    result = _run(*words)
    assert result.exit_code == 2
    assert "odometry.csv" in result.stderr


def test_the_site_file_itself_is_never_rewritten(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text(SITE)
    result = _run(tmp_path / "site.toml", tmp_path, *QUICK, "--motion", "still:5,4", "--force")
    assert result.exit_code == 2
    assert "holds the site file itself" in result.stderr
    assert (tmp_path / "site.toml").read_text() == SITE


def test_odometry_is_written_where_it_is_asked_for_and_again_with_force(site: Path, tmp_path: Path) -> None:
    words = ["simulate", str(site), str(tmp_path / "o"), "--motion", "line:2,2,0.5,0", *QUICK, "--odometry", "0"]
    for more in ([], ["--force"]):
        told = CliRunner().invoke(app, [*words, *more])
        assert told.exit_code == 0, told.output
    columns = read_recording(tmp_path / "o").tables["odometry"].columns
    np.testing.assert_allclose(columns["v_mps"], 0.5)
    np.testing.assert_allclose(columns["time_s"], np.arange(5) / 10)
    # without, samples of another drive would not fit it
    told = CliRunner().invoke(app, [*words[:-2], "--force"])
    assert told.exit_code == 2
    assert "odometry.csv" in told.stderr
    told = CliRunner().invoke(app, [*words[:2], str(tmp_path / "n"), *words[3:-1], "2"])
    assert "below 1" in told.stderr
