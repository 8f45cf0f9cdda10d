"""`sonofix calibrate`: from a bench with a metre between to ranges that are right."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix.channel import Line, simulate
from sonofix.cli.main import app
from sonofix.files import read_recording, write_recording
from sonofix.files.audio import Capture
from sonofix.flow import run
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site
from survey.made_bench import bench, distorted, record

runner = CliRunner()
PLACES = ((0.0, 0.0, 2.6), (5.0, 0.0, 2.4), (2.5, 4.0, 2.5))
DELAYS_S = (2e-4, -5e-5, 3.5e-4)
TAPS = ([1], [5], [1, 2, 5])


def code(i: int) -> dict:
    return {"family": "m-sequence", "degree": 6, "taps": TAPS[i]}


def hall(bandwidth_hz: float, known: bool) -> Site:
    return Site.model_validate(
        {
            "site": {"name": "hall"},
            "air": {"temperature_c": 18.0},
            "schedule": {"period_s": 0.1},
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10, "bandwidth_hz": bandwidth_hz},
            "vehicle": [{"id": "agv", "z_m": 0.0}],
            "beacon": [
                {"id": f"B{i}", "position_m": PLACES[i], "code": code(i), "delay_s": DELAYS_S[i] if known else 0.0}
                for i in range(3)
            ],
            "microphone": [{"id": "M", "channel": 0, "vehicle": "agv", "lever_arm_m": [0.0, 0.0, 0.4]}],
        }
    )


def range_errors_m(folder: Path, motion: Line) -> np.ndarray:
    recording, errors = read_recording(folder), []
    for step in run(recording):
        ranges = step.ranges
        for name, time_s, range_m in zip(ranges.emitter, ranges.time_s, ranges.range_m, strict=True):
            microphone = motion.at(np.array([time_s])).position_m[0] + [0.0, 0.0, 0.4]
            place = recording.site.beacon(name).position_m
            errors.append(range_m - np.linalg.norm(microphone - place))
    return np.array(errors)


def test_bench_to_hall(tmp_path: Path) -> None:
    """Three beacons, narrower than the site file says, each with a delay, learnt on a bench 7 K warmer than the hall.

    Ranges with the nominal bursts are off by delays of up to 0.35 ms and the transducers' own; with the learnt ones
    they are right to the bursts' noise.
    """
    true, told = hall(2.2e3, known=True), hall(4e3, known=False)
    snippets = []
    for i in range(3):
        here = {"id": f"B{i}", "position_m": [0.0, 0.0, 1.0], "code": code(i)}
        sent = Site.model_validate(
            bench(bandwidth_hz=2.2e3).model_dump(by_alias=True, exclude_none=True)
            | {"air": {"temperature_c": 25.0}, "beacon": [here | {"delay_s": DELAYS_S[i]}]}
        )
        thought = Site.model_validate(
            bench().model_dump(by_alias=True, exclude_none=True) | {"air": {"temperature_c": 25.0}, "beacon": [here]}
        )
        write_recording(tmp_path / f"bench{i}", record(sent, thought, beacons=(f"B{i}",), seed=i, bursts=12))
        command = ["calibrate", str(tmp_path / f"bench{i}"), "-o", str(tmp_path / "learnt"), "--no-plot"]
        said = runner.invoke(app, command)
        assert said.exit_code == 0, said.stderr
        text = (tmp_path / "learnt" / f"B{i}.toml").read_text("utf-8")
        assert text in said.stdout
        place = "position_m = [0.0, 0.0, 1.0]"
        assert place in text
        snippets.append(text.replace(place, f"position_m = {list(PLACES[i])}"))

    motion = Line((1.5, 1.0, 0.0), (0.8, 0.5, 0.0))
    recording, truth = simulate(
        true,
        {"agv": motion},
        rate_hz=192e3,
        duration_s=1.0,
        waveforms=waveforms_of(true),
        noise_sd=5e-4,
        level=0.3,
        seed=5,
    )
    write_recording(tmp_path / "nominal", replace(recording, site=told), truth)
    shutil.copytree(tmp_path / "nominal", tmp_path / "hall")
    for path in (tmp_path / "learnt").glob("*.flac"):
        shutil.copy(path, tmp_path / "hall")
    # the user's work: paste the snippets over the beacons
    path = tmp_path / "hall" / "site.toml"
    blocks = [b for b in path.read_text("utf-8").split("\n\n") if not b.startswith("[[beacon]]")]
    path.write_text("\n\n".join([*blocks, *snippets]), "utf-8")

    before, after = range_errors_m(tmp_path / "nominal", motion), range_errors_m(tmp_path / "hall", motion)
    assert np.sqrt(np.mean(before**2)) > 0.05
    assert len(after) >= 28
    assert np.sqrt(np.mean(after**2)) < 0.001
    assert np.abs(after).max() < 0.003


def test_table_says_the_deviation_of_everything(tmp_path: Path) -> None:
    write_recording(tmp_path / "rec", record(distorted(), bench()))
    said = runner.invoke(app, ["calibrate", str(tmp_path / "rec"), "--beacon", "B1", "--distance", "1.0"])
    assert said.exit_code == 0, said.stderr
    for words in ("bursts used", "16 of 16", "by noise and jitter", "with distance and air", "from burst to burst",
                  "likeness to the nominal burst", "carrier off the nominal", "too long", "averaging adds 12.0 dB",
                  "jitter, rms", "± 1.00 mm"):  # fmt: skip
        assert words in said.stdout
    out = tmp_path / "rec" / "calibration"
    assert {path.name for path in out.iterdir()} == {"B1.flac", "B1.toml", "B1.csv", "B1.png"}
    assert (out / "B1.png").read_bytes().startswith(b"\x89PNG")
    # what was read is still a recording, and calibrates again over the old results
    assert runner.invoke(app, ["calibrate", str(tmp_path / "rec"), "--no-plot"]).exit_code == 0
    assert not (out / "B1.png").exists()


def test_free_running_needs_no_distance(tmp_path: Path) -> None:
    site = bench(synchronised=False)
    recording = record(distorted(synchronised=False), site, beacon_drift={"B1": 25e-6})
    write_recording(tmp_path / "rec", recording)
    said = runner.invoke(app, ["calibrate", str(tmp_path / "rec")])
    assert said.exit_code == 0, said.stderr
    assert "+25.0" in said.stdout
    assert "period " in said.stdout
    assert "distance and air" not in said.stdout


def refused(folder: Path, *options: str) -> str:
    said = runner.invoke(app, ["calibrate", str(folder), *options])
    assert said.exit_code == 2, said.stdout
    assert not (folder / "calibration").exists()
    (line,) = said.stderr.splitlines()
    return line


def test_what_is_wrong_is_told_in_a_line(tmp_path: Path) -> None:
    write_recording(tmp_path / "silent", record(bench(), bench(), beacons=()))
    assert "silent; no burst" in refused(tmp_path / "silent")
    assert "--beacon B7: the site has no such beacon; it has B1" in refused(tmp_path / "silent", "--beacon", "B7")
    assert "--microphone X" in refused(tmp_path / "silent", "--microphone", "X")
    site = tmp_path / "silent" / "site.toml"
    text = site.read_text("utf-8")
    site.write_text(text.replace("channel = 0", "channel = 3"), "utf-8")
    assert "on channel 3, but the capture has 1" in refused(tmp_path / "silent")
    site.write_text(text.replace("channel = 0\nposition_m", 'channel = 0\nvehicle = "v"\nlever_arm_m')
                    + '\n[[vehicle]]\nid = "v"\n', "utf-8")  # fmt: skip
    assert "how far is beacon B1 from microphone M? Give --distance" in refused(tmp_path / "silent")
    assert "there is no such folder" in refused(tmp_path / "nowhere")


def test_which_of_several(tmp_path: Path) -> None:
    other = {"id": "B2", "position_m": [0.0, 1.0, 1.0], "code": code(1)}
    two = bench(others=(other,))
    write_recording(tmp_path / "rec", record(two, two))
    assert "which beacon? Name one with --beacon: B1, B2" in refused(tmp_path / "rec")
    assert runner.invoke(app, ["calibrate", str(tmp_path / "rec"), "--beacon", "B1", "--no-plot"]).exit_code == 0


def test_ctrl_c_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_recording(tmp_path / "rec", record(bench(), bench()))
    real = Capture.blocks

    def stopped(capture: Capture, length: int) -> Iterator[np.ndarray]:
        for i, block in enumerate(real(capture, length)):
            if i == 1:
                raise KeyboardInterrupt
            yield block

    monkeypatch.setattr(Capture, "blocks", stopped)
    said = runner.invoke(app, ["calibrate", str(tmp_path / "rec")])
    assert said.exit_code == 130
    assert said.stderr.splitlines() == ["stopped; nothing was written"]
    assert not (tmp_path / "rec" / "calibration").exists()
