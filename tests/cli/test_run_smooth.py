"""`sonofix run --smooth`, `--lag` and `--graph`: what they write, and what a stop leaves."""

import importlib.util
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from typer.testing import CliRunner

from cli.test_run import OUTPUTS, ranged, rows_of
from sonofix import flow
from sonofix.cli.console import Stopped
from sonofix.cli.main import app
from sonofix.cli.run import run_folder

runner = CliRunner()


def error_m(rows):
    miss = [
        np.hypot(
            float(r["x_m"]) - 4 - 2 * np.cos(float(r["time_s"]) / 5),
            float(r["y_m"]) - 3 - 2 * np.sin(float(r["time_s"]) / 5),
        )
        for r in rows
    ]
    return float(np.sqrt(np.mean(np.square(miss))))


def told(folder, *options):
    said = runner.invoke(app, ["run", str(folder), "--no-plot", *options])
    assert said.exit_code == 0, said.stderr
    out = folder / "out"
    assert {path.name for path in out.iterdir()} == OUTPUTS
    return {name: (out / name).read_text() for name in OUTPUTS}, rows_of(out / "track.csv")


@pytest.mark.parametrize("options", [["--smooth"], ["--lag", "5"], ["--graph"]])
def test_the_track_is_smoothed_and_nothing_else(tmp_path, options):
    if options == ["--graph"]:
        pytest.importorskip("gtsam")
    folder = ranged(tmp_path / "rec", 60, sd_m=0.2)
    plain, before = told(folder)
    files, after = told(folder, *options)
    for name in ("ranges.csv", "fixes.csv", "events.csv"):
        assert files[name] == plain[name]
    assert [row["time_s"] for row in after] == [row["time_s"] for row in before]
    assert {row["source"] for row in after} == {"smoothed"}
    assert error_m(after) < 0.85 * error_m(before)
    tum = [line.split() for line in files["track.tum"].splitlines()]
    assert [row[0] for row in tum] == [row["time_s"] for row in after]
    assert [row[1] for row in tum] == [row["x_m"] for row in after]


def test_rows_at_a_rate(tmp_path):
    folder = ranged(tmp_path / "rec", 20)
    for options in (["--smooth"], ["--lag", "3"]):
        _, rows = told(folder, *options, "--rate", "10")
        times = np.array([float(row["time_s"]) for row in rows])
        np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-6)
        assert len(times) >= 90
        assert {row["source"] for row in rows} == {"smoothed"}


def test_the_picture_shows_it(tmp_path):
    folder = ranged(tmp_path / "rec", 10)
    assert runner.invoke(app, ["run", str(folder), "--smooth"]).exit_code == 0
    assert (folder / "out" / "track.png").read_bytes().startswith(b"\x89PNG")


def test_lag_and_graph_exclude_each_other(tmp_path):
    pytest.importorskip("gtsam")
    folder = ranged(tmp_path / "rec", 4)
    said = runner.invoke(app, ["run", str(folder), "--graph", "--lag", "2"])
    assert said.exit_code == 2
    assert "leave out either" in said.stderr
    assert not (folder / "out").exists()
    assert runner.invoke(app, ["run", str(folder), "--lag", "-1"]).exit_code == 2


def test_without_gtsam_the_extra_is_named_before_anything_is_run(tmp_path, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "gtsam" else found(name))
    folder = ranged(tmp_path / "rec", 4)
    said = runner.invoke(app, ["run", str(folder), "--graph"])
    assert said.exit_code == 2
    assert "sonofix[graph]" in said.stderr
    assert not (folder / "out").exists()


def test_ctrl_c_lets_what_waits_for_its_lag_leave(tmp_path, monkeypatch):
    folder, flow_run = ranged(tmp_path / "rec", 60), flow.run

    def stopping(*given):
        for k, step in enumerate(flow_run(*given)):
            if k == 25:
                raise KeyboardInterrupt
            yield step

    monkeypatch.setattr(flow, "run", stopping)
    with pytest.raises(Stopped, match="holds the first 25 epochs"):
        run_folder(folder, folder / "out", plot=False, rate_hz=None, lag_s=1000.0)
    rows = rows_of(folder / "out" / "track.csv")
    assert len(rows) == 25
    assert {row["source"] for row in rows} == {"smoothed"}


@pytest.mark.skipif(os.name != "posix", reason="signals as on POSIX")
def test_ctrl_c_while_smoothing_keeps_the_causal_track(tmp_path):
    epochs = 1200
    folder = ranged(tmp_path / "rec", epochs)
    command = [sys.executable, "-c", "from sonofix.cli.main import main; main()"]
    running = subprocess.Popen(
        [*command, "run", str(folder), "--no-plot", "--smooth", "--rate", "40"],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    fixes, deadline = folder / "out" / "fixes.csv", time.monotonic() + 100
    while time.monotonic() < deadline and not (fixes.exists() and len(fixes.read_text().splitlines()) == epochs + 1):
        time.sleep(0.05)
    time.sleep(0.2)
    running.send_signal(signal.SIGINT)
    _, said = running.communicate(timeout=60)
    assert running.returncode == 130
    assert said == f"stopped; {folder / 'out'} holds the first {epochs} epochs, not smoothed\n"
    rows = rows_of(folder / "out" / "track.csv")
    assert len(rows) > 20 * epochs * 0.9
    assert "smoothed" not in {row["source"] for row in rows}
    assert {path.name for path in (folder / "out").iterdir()} == OUTPUTS
