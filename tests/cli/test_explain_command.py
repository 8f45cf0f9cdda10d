"""`sonofix explain`: tables, files and refusals."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cli.test_run import ranged
from sonofix import flow
from sonofix.cli.main import app
from sonofix.files import read_recording, write_recording
from sonofix.files.audio import Capture
from test_flow import made, site_of

runner = CliRunner()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("explain") / "rec"
    write_recording(place, made(site_of(2), 1.1)[0])
    return place


def test_pictures_table_and_paths(folder: Path, tmp_path: Path) -> None:
    said = runner.invoke(app, ["explain", str(folder), "--epoch", "3", "--microphone", "M1", "-o", str(tmp_path)])
    assert said.exit_code == 0, said.stderr
    names = {path.name for path in tmp_path.iterdir()}
    stem = "epoch-3-M1"
    assert names == {f"{stem}-overview.png", f"{stem}-beacons.png", f"{stem}-paths.csv"}
    for name in names:
        if name.endswith("png"):
            assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    told = flow.explain(read_recording(folder), 3, "M1")
    assert "microphone M1; warm" in said.stdout
    shown = [b for band in told.bands for b in band.beacons]
    assert len(shown) == 5
    for beacon in shown:
        assert beacon.reported is not None
        assert f"{beacon.reported.range_m:.4f} m" in said.stdout
    for words in ("as heard", "bursts cancelled", "refined to the end", "Left out, and why:", "over the quiet"):
        assert words in said.stdout
    with (tmp_path / f"{stem}-paths.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(b.paths) for b in shown)
    for beacon in shown:
        (row,) = [r for r in rows if r["beacon"] == beacon.beacon and r["is_range"] == "1"]
        path = beacon.reported
        assert path is not None
        assert path.range_sd_m is not None
        assert float(row["range_m"]) == pytest.approx(path.range_m, abs=1e-6)
        assert float(row["sd_m"]) == pytest.approx(path.range_sd_m, abs=1e-6)
        assert float(row["range_rate_mps"]) == pytest.approx(path.range_rate_mps, abs=1e-5)
        assert float(row["level_db"]) == pytest.approx(path.level_db, abs=0.01)


def test_some_beacons_and_no_picture(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "epoch-1-M0-overview.png").write_bytes(b"old")
    command = ["explain", str(folder), "--epoch", "1", "--beacon", "B2", "--beacon", "B4", "--no-plot"]
    said = runner.invoke(app, [*command, "-o", str(tmp_path)])
    assert said.exit_code == 0, said.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"epoch-1-M0-paths.csv"}
    with (tmp_path / "epoch-1-M0-paths.csv").open(newline="") as file:
        assert {r["beacon"] for r in csv.DictReader(file)} == {"B2", "B4"}
    table = said.stdout.split("What was cancelled")[0]
    assert "B4" in table
    assert "B1" not in table


def refused(folder: Path, *options: str) -> str:
    said = runner.invoke(app, ["explain", str(folder), *options])
    assert said.exit_code == 2, said.stdout
    assert not (folder / "explain").exists()
    (line,) = said.stderr.splitlines()
    return line


def test_what_is_wrong_is_told_in_a_line(folder: Path, tmp_path: Path) -> None:
    count = len(list(flow.run(read_recording(folder))))
    assert refused(folder, "--epoch", "99") == f"epoch 99: the recording has epochs 0 to {count - 1}"
    assert "--microphone Q: the capture has no channel" in refused(folder, "--epoch", "0", "--microphone", "Q")
    line = refused(folder, "--epoch", "0", "--beacon", "Q")
    assert line == "--beacon Q: the site has no such beacon with a code; it has B0, B1, B2, B3, B4"
    assert "has no samples" in refused(ranged(tmp_path / "rec", 3), "--epoch", "0")
    assert runner.invoke(app, ["explain", str(folder)]).exit_code == 2
    assert runner.invoke(app, ["explain", str(folder), "--epoch", "-1"]).exit_code == 2


def test_ctrl_c_leaves_nothing_behind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Capture.blocks

    def stopped(capture: Capture, length: int) -> Iterator[np.ndarray]:
        yield next(real(capture, length))[:1000]
        raise KeyboardInterrupt

    monkeypatch.setattr(Capture, "blocks", stopped)
    said = runner.invoke(app, ["explain", str(folder), "--epoch", "4"])
    assert said.exit_code == 130
    assert said.stderr.splitlines() == ["stopped; nothing was written"]
    assert not (folder / "explain").exists()
