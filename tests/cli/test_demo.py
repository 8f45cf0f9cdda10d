"""`sonofix demo`: the whole street in one command."""

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix.cli.demo import demo_motion, demo_site
from sonofix.cli.main import app
from sonofix.cli.score import score_run

runner = CliRunner()


def test_short_demo_ends_in_a_picture_and_good_figures(tmp_path):
    out = tmp_path / "demo"
    told = runner.invoke(app, ["demo", "-o", str(out), "--seconds", "2"])
    assert told.exit_code == 0, told.stderr
    picture = out / "out" / "track.png"
    assert f"Picture: {picture}" in told.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    scored = score_run(out, out / "out")
    assert scored.ranges is not None
    assert scored.ranges.used.beyond_5cm == 0
    assert scored.track["agv"].rmse_xy_m < 0.02


def test_foreign_folders_are_left_alone(tmp_path):
    (tmp_path / "diary.txt").write_text("mine")
    told = runner.invoke(app, ["demo", "-o", str(tmp_path), "--seconds", "2"])
    assert told.exit_code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["diary.txt"]


def test_hall_is_as_described():
    site = demo_site()
    assert site.bounds_m is not None
    assert np.ptp(np.array(site.bounds_m), axis=0)[:2].tolist() == [12.0, 9.0]
    assert len(site.coded_beacons) == 8
    assert len({str(beacon.code) for beacon in site.beacons}) == 8


@pytest.mark.parametrize("seconds", [20.0, 40.0])
def test_round_closes_and_stays_inside(seconds):
    poses = demo_motion(seconds).at(np.linspace(0, seconds, 500))
    np.testing.assert_allclose(poses.position_m[0], poses.position_m[-1], atol=0.05)
    assert (poses.position_m[:, :2] > 0.5).all()
    assert (poses.position_m[:, 0] < 11.5).all()
    assert (poses.position_m[:, 1] < 8.5).all()
