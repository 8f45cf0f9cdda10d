"""`sonofix run` on recordings made here: what it writes, says and refuses."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix.channel import Line, noise_for_snr, simulate
from sonofix.channel.levels import direct_gains
from sonofix.cli.main import app
from sonofix.cli.run import _Sample
from sonofix.files import write_recording
from sonofix.records import RangeEpoch, RangeRows, Recording, Step, Truth
from sonofix.signals.codes import primitive_taps
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

runner = CliRunner()
CORNERS = {
    "B1": (0.0, 0.0, 3.0),
    "B2": (8.0, 0.0, 2.6),
    "B3": (8.0, 6.0, 3.1),
    "B4": (0.0, 6.0, 2.7),
    "B5": (4.0, 3.0, 3.3),
}
OUTPUTS = {"ranges.csv", "fixes.csv", "track.csv", "events.csv", "innovations.csv", "track.tum"}


def hall() -> dict:
    taps = primitive_taps(7)
    return {
        "site": {"name": "small hall", "bounds_m": [[-0.5, -0.5, 0], [8.5, 6.5, 3.5]]},
        "air": {"sound_speed_mps": 343.0},
        "schedule": {"period_s": 0.2},
        "signal": {"carrier_hz": 20e3, "cycles_per_chip": 8, "bandwidth_hz": 4e3},
        "vehicle": [{"id": "agv", "z_m": 0.0}],
        "beacon": [
            {"id": name, "position_m": place, "code": {"family": "m-sequence", "degree": 7, "taps": taps[i]}}
            for i, (name, place) in enumerate(CORNERS.items())
        ],
        "microphone": [{"id": "M1", "channel": 0, "vehicle": "agv", "lever_arm_m": [0.0, 0.0, 0.4]}],
    }


def ranged(folder: Path, epochs: int, sd_m: float = 0.005) -> Path:
    """Write a recording that states ranges to a vehicle on a circle."""
    rng = np.random.default_rng(5)
    time_s = np.repeat(np.arange(epochs) * 0.5, len(CORNERS))
    places = np.tile(np.array(list(CORNERS.values())), (epochs, 1))
    way = np.column_stack([4 + 2 * np.cos(time_s / 5), 3 + 2 * np.sin(time_s / 5), 0 * time_s])
    range_m = np.linalg.norm(way + [0, 0, 0.4] - places, axis=1) + rng.normal(0, sd_m, len(time_s))
    rows = RangeRows(time_s, tuple(CORNERS) * epochs, ("M1",) * len(time_s), range_m, np.full(len(time_s), sd_m))
    truth = Truth("agv", time_s[:: len(CORNERS)], way[:: len(CORNERS)], None)
    write_recording(folder, Recording(Site.model_validate(hall()), ranges=rows), {"agv": truth})
    return folder


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_ranges_in_everything_out(tmp_path):
    folder = ranged(tmp_path / "rec", 40)
    told = runner.invoke(app, ["run", str(folder)])
    assert told.exit_code == 0, told.stderr
    out = folder / "out"
    assert {path.name for path in out.iterdir()} == OUTPUTS | {"track.png"}
    assert (out / "track.png").read_bytes().startswith(b"\x89PNG")
    assert len(rows_of(out / "fixes.csv")) == 40
    track = rows_of(out / "track.csv")
    assert len(track) == 40
    error = [np.hypot(float(r["x_m"]) - 4 - 2 * np.cos(float(r["time_s"]) / 5),
                      float(r["y_m"]) - 3 - 2 * np.sin(float(r["time_s"]) / 5)) for r in track]  # fmt: skip
    assert np.sqrt(np.mean(np.square(error))) < 0.02
    for words in (
        "small hall: 40 epochs",
        "200 of 200 ranges used",
        "40 / 40",
        "position error, rms",
        "HDOP, median",
        "NIS per",
    ):
        assert words in told.stdout
    assert f"Written to {out}" in told.stdout


def test_positions_beside_ranges_are_not_used_and_told(tmp_path):
    folder = ranged(tmp_path / "rec", 3)
    (folder / "positions.csv").write_text("time_s,x_m,y_m\n0.0,90.0,90.0\n1.0,90.0,90.0\n")
    ran = runner.invoke(app, ["run", str(folder), "--no-plot"])
    assert "Note: positions.csv is not used: the track is made of ranges.csv" in ran.stdout.replace("\n", " ")
    assert all(float(row["x_m"]) < 10 for row in rows_of(folder / "out" / "track.csv"))
    checked = runner.invoke(app, ["check", str(folder)]).stdout
    assert "positions.csv is not used: the track is made of ranges.csv" in checked
    (folder / "ranges.csv").unlink()
    ran = runner.invoke(app, ["run", str(folder), "--no-plot"])
    assert "positions.csv" not in ran.stdout
    assert all(float(row["x_m"]) == 90 for row in rows_of(folder / "out" / "track.csv"))


def test_a_site_of_vehicles_alone_has_positions(tmp_path):
    (tmp_path / "site.toml").write_text('format = 1\n[site]\nname = "yard"\n[[vehicle]]\nid = "agv"\nz_m = 0.0\n')
    (tmp_path / "positions.csv").write_text("time_s,x_m,y_m\n0.0,1.0,2.0\n1.0,1.1,2.0\n")
    checked = runner.invoke(app, ["check", str(tmp_path)])
    assert checked.exit_code == 0
    assert "Odd: 1\n  - there is no truth.csv" in checked.stdout
    assert runner.invoke(app, ["run", str(tmp_path)]).exit_code == 0
    assert len(rows_of(tmp_path / "out" / "track.csv")) == 2
    (tmp_path / "positions.csv").unlink()
    told = runner.invoke(app, ["run", str(tmp_path)])
    assert told.exit_code == 2
    assert "nothing to compute positions from" in told.stderr


def test_an_open_height_asks_for_the_level(tmp_path):
    site = hall()
    site["vehicle"] = [{"id": "agv"}]
    site["beacon"] = [{"id": name, "position_m": (x, y, 0.4)} for name, (x, y, _) in CORNERS.items()]
    ways = [np.hypot(3.0 - x, 2.5 - y) for x, y, _ in CORNERS.values()]
    rows = RangeRows(np.zeros(5), tuple(CORNERS), ("M1",) * 5, np.array(ways), np.full(5, 0.1))
    write_recording(tmp_path / "flat", Recording(Site.model_validate(site), ranges=rows))
    told = runner.invoke(app, ["run", str(tmp_path / "flat")])
    assert told.exit_code == 0
    assert "1 epoch without a sound fix: beacons and vehicle near one level leave the height open" in told.output
    assert "z_m of its [[vehicle]]" in told.output


def test_samples_in_positions_out(tmp_path):
    site = Site.model_validate(hall())
    waveforms = waveforms_of(site)
    motions = {"agv": Line((2.0, 2.0, 0.0), (0.6, 0.3, 0.0))}
    noise = noise_for_snr(10.0, 0.1, direct_gains(site, motions, waveforms, 1.0), waveforms)
    recording, truth = simulate(
        site, motions, rate_hz=64000, duration_s=1.0, waveforms=waveforms, level=0.1, noise_sd=noise, seed=3
    )
    write_recording(tmp_path / "rec", recording, truth)
    out = tmp_path / "elsewhere"
    told = runner.invoke(app, ["run", str(tmp_path / "rec"), "-o", str(out), "--no-plot"])
    assert told.exit_code == 0, told.stderr
    assert {path.name for path in out.iterdir()} == OUTPUTS
    assert not (tmp_path / "rec" / "out").exists()
    fixes = [row for row in rows_of(out / "fixes.csv") if row["status"] == "ok"]
    assert len(fixes) >= 4
    for row in fixes:
        assert abs(float(row["x_m"]) - 2.0 - 0.6 * float(row["time_s"])) < 0.05
        assert abs(float(row["y_m"]) - 2.0 - 0.3 * float(row["time_s"])) < 0.05
    assert "Ranges used, against the truth: rms" in told.stdout


def test_no_truth_no_comparison(tmp_path):
    folder = ranged(tmp_path / "rec", 6)
    (folder / "truth.csv").unlink()
    told = runner.invoke(app, ["run", str(folder), "--no-plot"])
    assert told.exit_code == 0, told.stderr
    assert "Against the truth" not in told.stdout


def test_rate_sets_the_rows_of_the_track(tmp_path):
    folder = ranged(tmp_path / "rec", 20)
    told = runner.invoke(app, ["run", str(folder), "--no-plot", "--rate", "10"])
    assert told.exit_code == 0, told.stderr
    times = np.array([float(row["time_s"]) for row in rows_of(folder / "out" / "track.csv")])
    assert len(times) >= 85
    assert np.median(np.diff(times)) == pytest.approx(0.1, abs=1e-6)
    assert runner.invoke(app, ["run", str(folder), "--rate", "0"]).exit_code == 2


def test_an_old_picture_does_not_outlive_its_numbers(tmp_path):
    folder = ranged(tmp_path / "rec", 4)
    assert runner.invoke(app, ["run", str(folder)]).exit_code == 0
    assert (folder / "out" / "track.png").exists()
    assert runner.invoke(app, ["run", str(folder), "--no-plot"]).exit_code == 0
    assert not (folder / "out" / "track.png").exists()


def test_never_over_the_recording(tmp_path):
    folder = ranged(tmp_path / "rec", 4)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (tmp_path / "alias").symlink_to(folder)
    for out in (folder, folder / ".." / "rec", tmp_path / "alias"):
        told = runner.invoke(app, ["run", str(folder), "-o", str(out)])
        assert told.exit_code == 2
        assert "is a recording" in told.stderr
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_missing_folder(tmp_path):
    told = runner.invoke(app, ["run", str(tmp_path / "nowhere")])
    assert told.exit_code == 2
    assert told.stderr.splitlines() == [f"{tmp_path / 'nowhere'}: there is no such folder"]


def test_all_mistakes_at_once(tmp_path):
    folder = ranged(tmp_path / "rec", 4)
    text = (folder / "site.toml").read_text()
    (folder / "site.toml").write_text(text.replace('"B2"', '"B1"').replace("[[vehicle]]", "colour = 1\n[[vehicle]]", 1))
    (folder / "ranges.csv").write_text("time_s,from,to,range_m\n0.0,B1,M1,far\n")
    told = runner.invoke(app, ["run", str(folder)])
    assert told.exit_code == 2
    lines = told.stderr.splitlines()
    assert len(lines) >= 3
    for word in ("B1", "colour", '"far"'):
        assert any(word in line for line in lines)
    assert not (folder / "out").exists()


def test_full_disk_is_one_line(tmp_path):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    folder = ranged(tmp_path / "rec", 4)
    out = tmp_path / "out"
    out.mkdir()
    (out / "ranges.csv").symlink_to("/dev/full")
    told = runner.invoke(app, ["run", str(folder), "-o", str(out)])
    assert told.exit_code == 2
    assert len(told.stderr.splitlines()) == 1
    assert "No space left" in told.stderr


@pytest.mark.skipif(os.name != "posix", reason="signals as on POSIX")
def test_ctrl_c_keeps_what_is_done(tmp_path):
    folder = ranged(tmp_path / "rec", 40_000)
    command = [sys.executable, "-c", "from sonofix.cli.main import main; main()", "run", str(folder), "--no-plot"]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    fixes = folder / "out" / "fixes.csv"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (fixes.exists() and fixes.stat().st_size > 3000):
        time.sleep(0.05)
    running.send_signal(signal.SIGINT)
    _, told = running.communicate(timeout=60)
    assert running.returncode == 130
    assert told.startswith(f"stopped; {folder / 'out'} holds the first ")
    epochs = int(told.split("first ")[1].split()[0])
    # the step under way when the signal came may be written and not yet counted
    assert 0 <= len(rows_of(fixes)) - epochs <= 1
    assert (folder / "out" / "track.csv").read_text().endswith("\n")


def _step(index: int) -> Step:
    nothing = np.zeros(0)
    epoch = RangeEpoch(
        index, float(index), (), (), nothing, nothing, np.zeros((0, 0)), None, None, None, "known", 343.0
    )
    return Step(epoch, (), (), (), np.zeros(0, bool), nothing)


def test_sample_is_bounded_ordered_and_fair():
    """Each of 2000 steps is kept with chance 1/4: the mean index of 500 has sd 577/sqrt(500) = 26."""
    sample = _Sample(500)
    for index in range(2000):
        sample.add(_step(index))
    kept = [step.ranges.index for step in sample.steps()]
    assert len(kept) == 500
    assert kept == sorted(set(kept))
    assert abs(np.mean(kept) - 999.5) < 5 * 26
    odd = np.mean(np.array(kept) % 2)
    assert abs(odd - 0.5) < 5 * 0.5 / np.sqrt(500)
    few = _Sample(500)
    for index in range(20):
        few.add(_step(index))
    assert [step.ranges.index for step in few.steps()] == list(range(20))
