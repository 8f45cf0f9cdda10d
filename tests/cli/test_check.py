from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import soundfile
from typer.testing import CliRunner

from sonofix.cli.main import app

SITE = """format = 1
[site]
name = "room [7]"
bounds_m = [[0, 0, 0], [6, 5, 3]]
[schedule]
period_s = 0.25
[signal]
carrier_hz = 20000
cycles_per_chip = 10
[[vehicle]]
id = "cart"
z_m = 0.1
[[microphone]]
id = "M1"
channel = 0
vehicle = "cart"
lever_arm_m = [0, 0, 0.4]
[[beacon]]
id = "B1"
position_m = [0, 0, 3]
code = { family = "m-sequence", degree = 7, taps = [1] }
[[beacon]]
id = "B2"
position_m = [6, 0, 3]
code = { family = "gold", degree = 7, index = 5 }
[[beacon]]
id = "B3"
position_m = [6, 5, 2.9]
code = { chips = "1110010" }
[[beacon]]
id = "B4"
position_m = [0, 5, 2.8]
code = { family = "chirp", start_hz = 18000, stop_hz = 22000, duration_s = 0.02 }
"""


@pytest.fixture
def room(tmp_path):
    (tmp_path / "site.toml").write_text(SITE)
    buzz = 0.1 * (-1.0) ** np.arange(96000)
    buzz[1000] = 0.5
    soundfile.write(tmp_path / "capture.flac", buzz, 96000)
    (tmp_path / "truth.csv").write_text("time_s,x_m,y_m,z_m\n0,1,1,0.1\n1,1,1,0.1\n")
    (tmp_path / "odometry.csv").write_text("time_s,v_mps,yaw_rate_radps\n0,0,0\n0.5,0,0\n0.75,0,0\n")
    return tmp_path


def check(folder) -> str:
    result = CliRunner().invoke(app, ["check", str(folder)])
    assert result.exit_code == 0, result.output
    return result.output


def test_says_in_plain_words_what_is_there(room):
    output = check(room)
    for words in (
        "room [7]",
        "6 x 5 x 3 m",
        "343.98 m/s (air at 20 °C)",  # Cramer's at 20 °C and half humidity
        "20000 Hz, on-off keyed, 10 cycles a chip",
        "every 0.25 s, synchronised",
        "4 beacons",
        "1 microphone, 1 vehicle",
        "on cart at (0, 0, 0.4) m",
        "moves on level 0.1 m",
        "1.000 s, 96000 samples at 96000 Hz, 1 channel",
        "peak -6.0 dB, rms -20.0 dB of full scale",
        "Epochs: 4 (one a period)",
        "odometry.csv: 3 rows, 0.8 s",
        "Truth of cart: 2 rows, 1.0 s",
        "Coverage of level 0.5 m (cart): a fix at 100 % of the places",
        "Nothing odd",
    ):
        assert words in output, words


@pytest.mark.parametrize(
    ("beacon", "code", "burst"),
    [
        ("B1", "m-sequence", "63.5 ms"),
        ("B2", "gold 5", "63.5 ms"),
        ("B3", "given chips", "3.5 ms"),
        ("B4", "chirp", "20 ms"),
    ],
)
def test_each_beacon_with_its_code_and_the_length_of_its_burst(room, beacon, code, burst):
    row = next(line for line in check(room).splitlines() if f" {beacon} " in line)
    assert code in row
    assert burst in row


def test_epochs_are_counted_in_the_sync_file(room):
    (room / "sync.csv").write_text("time_s\n0.1\n0.4\n0.6\n7.0\n")
    output = check(room)
    assert "Epochs: 3 (sync.csv)" in output
    assert "1 of 4 sync instants lie outside the capture" in output


def test_ranges_are_described(room):
    (room / "capture.flac").unlink()
    rows = "".join(f"{t},{b},M1,{r}\n" for t in (0.0, 0.5) for b, r in (("B1", 3.5), ("B2", 4.25)))
    (room / "ranges.csv").write_text("time_s,from,to,range_m\n" + rows)
    assert "4 rows of 2 pairs, at 2 instants in 0.5 s, 3.50 to 4.25 m" in check(room)


@pytest.mark.parametrize(
    ("old", "new", "odd"),
    [
        ("[6, 0, 3]", "[6, 5, 2.93]", "beacons stand nearly in one place: B2 and B3 (30 mm)"),
        ("[6, 0, 3]", "[6.5, 0, 3]", "beacon B2 stands outside the site's bounds_m"),
        ("period_s = 0.25", "period_s = 0.05", "beacon B1 sends for 0.064 s, longer than the period of 0.05 s"),
        ("period_s = 0.25", "period_s = 0.07", "it may be heard in the next epoch"),
        ("carrier_hz = 20000", "carrier_hz = 45000", "cuts off the upper side"),
        ('id = "B2"', 'id = "B2"\nposition_sd_m = 0.1', "the places of B2 are guesses"),
        ("[[microphone]]", '[[vehicle]]\nid = "idle"\n[[microphone]]', "vehicle idle carries neither"),
        ("period_s = 0.25", "period_s = 0.25\nsynchronised = false", "Nothing odd"),
    ],
)
def test_oddities(room, old, new, odd):
    if "idle" in new:
        (room / "truth.csv").unlink()
        (room / "odometry.csv").unlink()
    (room / "site.toml").write_text(SITE.replace(old, new))
    assert odd in check(room).replace("\n", " ")


def test_beacons_in_one_plane_matter_only_where_the_height_is_unknown(room):
    flat = SITE.replace("[6, 5, 2.9]", "[6, 5, 3]").replace("[0, 5, 2.8]", "[0, 5, 3]")
    (room / "site.toml").write_text(flat)
    assert "one plane" not in check(room)
    (room / "site.toml").write_text(flat.replace("z_m = 0.1", ""))
    assert "one plane" in check(room)


def test_mistakes_go_to_stderr_one_a_line_with_exit_code_2(room):
    (room / "site.toml").write_text(SITE.replace("channel = 0", "chanel = 0").replace("z_m", "zm"))
    result = CliRunner().invoke(app, ["check", str(room)])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.splitlines() == [
        'site.toml: vehicle 1 "cart" zm = 0.1: unknown key; did you mean z_m?',
        'site.toml: microphone 1 "M1" chanel = 0: unknown key; did you mean channel?',
    ]


def test_recordings_beside_the_project(captures):
    output = check(captures / "rough")
    assert "8 beacons" in output
    assert "511 given chips" in output
    assert "samples are clipped" in output


def test_importing_the_command_is_quick_and_light():
    """What `sonofix --help` pays: neither pydantic nor soundfile nor scipy."""
    heavy = ("pydantic", "soundfile", "scipy", "numpy")
    code = f"import sys, sonofix.cli.check; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_peak_of_silence_is_told_without_a_warning(room):
    soundfile.write(room / "capture.flac", np.zeros((96000, 1)), 96000)
    output = check(room)
    assert "silent throughout" in output
