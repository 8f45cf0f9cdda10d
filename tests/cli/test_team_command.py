"""`sonofix team`: what it writes, draws and says, and how it refuses."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix.cli.main import app
from team.made_fleet import fleet


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write a made-up fleet as a recording folder."""
    place = tmp_path_factory.mktemp("fleet")
    recording, truth = fleet(seconds=12)
    lines = ["format = 1", "[site]", 'name = "fleet"']
    for vehicle in recording.site.vehicles:
        lines += ["[[vehicle]]", f'id = "{vehicle.id}"', "z_m = 0.0"]
    for kind, nodes in (("beacon", recording.site.beacons), ("microphone", recording.site.microphones)):
        for node in nodes:
            stands = f"position_m = {list(node.position_m or ())}"
            lines += [f"[[{kind}]]", f'id = "{node.id}"', stands if node.position_m else f'vehicle = "{node.vehicle}"']
    (place / "site.toml").write_text("\n".join(lines), "utf-8")

    def write(name, header, *columns):
        with (place / name).open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(header.split(","))
            rows.writerows(zip(*columns, strict=True))

    heard, odometry = recording.ranges, recording.tables["odometry"]
    assert heard is not None
    write("ranges.csv", "time_s,from,to,range_m", heard.time_s, heard.emitter, heard.receiver, heard.range_m)
    bearing = recording.tables["bearings"].columns["bearing_rad"]
    write("bearings.csv", "time_s,from,to,bearing_rad", heard.time_s, heard.emitter, heard.receiver, bearing)
    told = odometry.columns
    order = np.argsort(told["time_s"], kind="stable")
    whose = np.array(odometry.names["vehicle"])
    values = (told["time_s"][order], whose[order], told["v_mps"][order], told["yaw_rate_radps"][order])
    write("odometry.csv", "time_s,vehicle,v_mps,yaw_rate_radps", *values)
    rows = sorted((t, name, x, y, 0.0, yaw) for name, path in truth.items() for t, x, y, yaw in path)
    write("truth.csv", "time_s,vehicle,x_m,y_m,z_m,yaw_rad", *zip(*rows, strict=True))
    return place


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.parametrize("option", ["--smooth", "--decentralised", "--odometry-alone"])
def test_a_team_is_written_drawn_and_scored(folder, tmp_path, option):
    done = run("team", folder, "-o", tmp_path / "out", option)
    assert done.exit_code == 0, done.stderr
    assert "NEES" in done.stdout
    assert (tmp_path / "out" / "team.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "out" / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["vehicle"] for row in rows} == {"R0", "R1", "R2"}
    assert ({row["source"] for row in rows} == {"smoothed"}) == (option == "--smooth")
    scored = run("score", folder, tmp_path / "out", "--json")
    worst = max(track["rmse_xy_m"] for track in json.loads(scored.stdout)["track"].values())
    assert worst < (2.0 if option == "--odometry-alone" else 0.25)


def test_an_animation_is_drawn(folder, tmp_path):
    done = run("team", folder, "-o", tmp_path / "out", "--no-plot", "--animate", tmp_path / "team.gif")
    assert done.exit_code == 0, done.stderr
    assert (tmp_path / "team.gif").read_bytes().startswith(b"GIF8")
    assert not (tmp_path / "out" / "team.png").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--landmarks-of", "R7"], "no vehicle of the site; it has R0, R1, R2"),
        (["--smooth", "--decentralised"], "leave out either"),
        (["--smooth", "--odometry-alone"], "leave out either"),
        (["--odometry-alone", "--decentralised"], "leave out either"),
        (["--animate", "team.mp4"], "must end in .gif"),
    ],
)
def test_what_cannot_be_is_refused(folder, tmp_path, words, told):
    done = run("team", folder, "-o", tmp_path, *words)
    assert done.exit_code == 2
    assert told in done.stderr
