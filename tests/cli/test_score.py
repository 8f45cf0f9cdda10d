"""`sonofix score` on files written here."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sonofix.cli.main import app

runner = CliRunner()

SITE = """
format = 1
[[vehicle]]
id = "agv"
[[beacon]]
id = "B1"
position_m = [0.0, 0.0, 0.0]
[[microphone]]
id = "M1"
vehicle = "agv"
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    """A vehicle that stands at (3, 4, 0), one range 1 cm long, one track row 2 cm off east."""
    (tmp_path / "out").mkdir()
    (tmp_path / "site.toml").write_text(SITE)
    (tmp_path / "truth.csv").write_text("time_s,x_m,y_m,z_m,yaw_rad\n0,3,4,0,0.5\n10,3,4,0,0.5\n")
    (tmp_path / "out" / "ranges.csv").write_text("time_s,from,to,range_m,sd_m,used\n1.0,B1,M1,5.01,0.005,1\n")
    (tmp_path / "out" / "track.csv").write_text(
        "time_s,vehicle,x_m,y_m,z_m,vx_mps,vy_mps,vz_mps,yaw_rad,sd_x_m,sd_y_m,sd_z_m,sd_yaw_rad,source\n"
        "1.0,agv,3.02,4.0,0.0,0.1,0.0,0.0,,0.02,0.02,,,fused\n"
    )
    (tmp_path / "out" / "innovations.csv").write_text("time_s,rows,nis\n1.0,2,3.0\n1.5,2,1.0\n")
    return tmp_path


def test_figures_as_json(folder):
    told = runner.invoke(app, ["score", str(folder), "--json"])
    assert told.exit_code == 0, told.stderr
    found = json.loads(told.stdout)
    assert found["ranges"]["used"]["rms_m"] == pytest.approx(0.01)
    assert found["ranges"]["error_over_sd_rms"] == pytest.approx(2.0)
    assert found["ranges"]["range_rate_rms_mps"] is None
    track = found["track"]["agv"]
    assert track["rmse_xy_m"] == pytest.approx(0.02)
    assert track["nees_xy"] == pytest.approx(1.0)
    assert track["velocity_rms_mps"] == pytest.approx(0.1)
    assert track["longest_gap_s"] == pytest.approx(9.0)
    assert track["rmse_yaw_rad"] is None
    assert found["innovations"] == {
        "corrections": 2,
        "rows": 4,
        "nis_per_row": 1.0,
        "inside_95": 1.0,
        "below": 0.0,
        "above": 0.0,
    }


def test_figures_as_table(folder):
    told = runner.invoke(app, ["score", str(folder), str(folder / "out")])
    assert told.exit_code == 0, told.stderr
    for words in ("Ranges", "10.0 mm", "Track", "20.0 mm", "agv", "9.00 s", "100.0 mm/s", "NIS per measurement"):
        assert words in told.stdout
    # what is not known has no row
    assert "heading" not in told.stdout


def test_one_of_the_files_is_enough(folder):
    (folder / "out" / "ranges.csv").unlink()
    found = json.loads(runner.invoke(app, ["score", str(folder), "--json"]).stdout)
    assert found["ranges"] is None
    assert found["track"]["agv"]["rows"] == 1


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda at: (at / "truth.csv").unlink(), "nothing to score against"),
        (lambda at: [path.unlink() for path in (at / "out").iterdir()], "first: sonofix run"),
        (lambda at: (at / "site.toml").unlink(), "site.toml"),
        (lambda at: (at / "out" / "track.csv").write_text("time_s,vehicle,x_m\n1,agv,3\n"), "column y_m is missing"),
        (lambda at: (at / "out" / "ranges.csv").write_text("time_s,from,to,range_m\n1,B1,M1,near\n"),
         'line 2, range_m = "near": must be a number'),
        (lambda at: (at / "out" / "ranges.csv").write_text("time_s,from,to,range_m\n1,B1\n"), "has 2 cells"),
        (lambda at: (at / "out" / "track.csv").write_bytes(b"time_s,\xff\xfe"), "is no CSV text"),
        (lambda at: (at / "out" / "track.csv").write_text(""), "column time_s is missing"),
    ],
)  # fmt: skip
def test_what_cannot_be_scored_is_told(folder, damage, words):
    damage(folder)
    told = runner.invoke(app, ["score", str(folder)])
    assert told.exit_code == 2
    assert words in told.stderr
    assert "Traceback" not in told.stderr


def test_a_track_before_the_truth_has_no_figures(folder):
    text = (folder / "out" / "track.csv").read_text()
    (folder / "out" / "track.csv").write_text(text.replace("\n1.0,", "\n-5.0,"))
    told = runner.invoke(app, ["score", str(folder)])
    assert told.exit_code == 0
    assert "No row of track.csv lies in the time of the truth." in told.stdout
    found = json.loads(runner.invoke(app, ["score", str(folder), "--json"]).stdout)
    assert found["track"] == {}
    assert found["ranges"]["every"]["count"] == 1


def test_roll_and_pitch_are_judged_where_truth_and_track_have_them(folder):
    (folder / "truth.csv").write_text(
        "time_s,x_m,y_m,z_m,yaw_rad,roll_rad,pitch_rad\n0,3,4,0,0.5,0.1,0\n10,3,4,0,0.5,0.1,0\n"
    )
    assert "roll_rad" not in runner.invoke(app, ["score", str(folder)]).stdout
    (folder / "out" / "track.csv").write_text(
        "time_s,vehicle,x_m,y_m,z_m,vx_mps,vy_mps,vz_mps,yaw_rad,sd_x_m,sd_y_m,sd_z_m,sd_yaw_rad,source,"
        "roll_rad,pitch_rad,sd_roll_rad,sd_pitch_rad\n"
        "1.0,agv,3.02,4.0,0.0,0.1,0.0,0.0,0.52,0.02,0.02,,0.02,fused,0.13,-0.01,0.03,0.02\n"
    )
    track = json.loads(runner.invoke(app, ["score", str(folder), "--json"]).stdout)["track"]["agv"]
    assert track["rmse_roll_rad"] == pytest.approx(0.03)
    assert track["rmse_pitch_rad"] == pytest.approx(0.01)
    # each angle's square over its variance: 1 + 0.25 + 1
    assert track["nees_attitude"] == pytest.approx(2.25)
    table = runner.invoke(app, ["score", str(folder)]).stdout
    for words in ("roll error, rms", "pitch error, rms", "1.72 °", "0.57 °", "3 is right"):
        assert words in table


def test_innovations_that_cannot_be_are_named(folder):
    (folder / "out" / "innovations.csv").write_text("time_s,rows,nis\n1.0,2.5,3.0\n1.5,2,-4\n")
    told = runner.invoke(app, ["score", str(folder)])
    assert told.exit_code != 0
    for words in ("innovations.csv", "line 2, rows", "2.5", "line 3, nis", "-4"):
        assert words in told.stderr
