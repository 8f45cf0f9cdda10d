"""The same figures as the scorer that stands outside the project, on the same files."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sonofix.cli.score import score_run
from sonofix.files import read_site, read_truth
from sonofix.score import heard_range_m, pose_at

MM = 1e-3
TOLERANCE = 1e-9


@pytest.fixture(scope="module")
def scorer() -> Path:
    path = Path(__file__).parents[2].parent / "shared" / "tools" / "score.py"
    if not path.is_file():
        pytest.skip(f"no scorer at {path}")
    return path


def write(path: Path, header: str, rows: list[list]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header.split(","), *rows])


def make_up(recording: Path, out: Path, rng: np.random.Generator) -> None:
    """Write a run of noisy truth: some rows unused, some gross, some cells empty."""
    site, truths = read_site(recording / "site.toml"), read_truth(recording)
    out.mkdir()
    pairs = [(b, m) for b in site.beacons for m in site.microphones if b.vehicle is None or b.vehicle != m.vehicle]
    ranges = []
    for time in np.sort(rng.uniform(0.1, 5.0, 120)):
        beacon, microphone = pairs[rng.integers(len(pairs))]
        true = heard_range_m(beacon, microphone, truths, np.array([time]), 343.2)[0]
        error = rng.normal(0, 0.01) + (0.4 if rng.random() < 0.1 else 0.0)
        rate = "" if rng.random() < 0.1 else rng.normal()
        offset = rng.choice(["", "0.25"])
        stated = true + error + (float(offset) if offset else 0.0)
        ranges.append([time, beacon.id, microphone.id, stated, 0.01, rate, "", "", offset, int(rng.random() < 0.8)])
    header = "time_s,from,to,range_m,sd_m,range_rate_mps,range_rate_sd_mps,snr_db,clock_offset_m,used"
    write(out / "ranges.csv", header, ranges)
    track = []
    for name, truth in truths.items():
        for time in np.sort(rng.uniform(-0.5, 5.0, 40)):
            place, yaw = pose_at(truth, np.array([time]))
            place = place[0] + rng.normal(0, 0.01, 3)
            turned = "" if rng.random() < 0.2 else float(yaw[0]) + rng.normal(0, 0.02) + 2 * np.pi
            track.append([time, name, *place, *rng.normal(0, 1, 3), turned, 0.01, 0.012, "", "", "fused"])
    header = "time_s,vehicle,x_m,y_m,z_m,vx_mps,vy_mps,vz_mps,yaw_rad,sd_x_m,sd_y_m,sd_z_m,sd_yaw_rad,source"
    write(out / "track.csv", header, track)


# where beacons ride, the outside scorer stops after four rounds of its iteration: (v/c)^4 of a few metres
@pytest.mark.parametrize(("name", "way_m"), [("drive", 0.0), ("pair", 0.0), ("walk", 0.0), ("team", 1e-7)])
def test_figures_agree(name, way_m, captures, scorer, tmp_path, rng):
    out = tmp_path / "out"
    make_up(captures / name, out, rng)
    told = subprocess.run(
        [sys.executable, str(scorer), str(captures / name), str(out)], capture_output=True, text=True, check=True
    )
    theirs = json.loads(told.stdout)
    ours = score_run(captures / name, out)
    assert ours.ranges is not None
    near = TOLERANCE + way_m
    for found, expected in ((ours.ranges.used, theirs["ranges_used"]), (ours.ranges.every, theirs["ranges_all"])):
        assert (found.count, found.beyond_5cm) == (expected["n"], expected["beyond_5cm"])
        assert found.median_m == pytest.approx(expected["median_mm"] * MM, abs=near)
        assert found.rms_m == pytest.approx(expected["rms_mm"] * MM, abs=near)
        assert found.p95_m == pytest.approx(expected["p95_mm"] * MM, abs=near)
        assert found.rms_within_5cm_m == pytest.approx(expected["rms_within_5cm_mm"] * MM, abs=near)
    used = theirs["ranges_used"]
    assert ours.ranges.error_over_sd_rms == pytest.approx(used["rms_of_error_over_sd"], abs=100 * near)
    assert ours.ranges.range_rate_rms_mps == pytest.approx(used["range_rate_rms_mps"], abs=100 * near)
    assert ours.ranges.share_of_expected == pytest.approx(used["share_of_expected"], abs=TOLERANCE)
    assert set(ours.track) == set(theirs["track"])
    for vehicle, found in ours.track.items():
        expected = theirs["track"][vehicle]
        assert found.rows == expected["rows"]
        for figure in ("rmse_xy_m", "median_xy_m", "p95_xy_m", "max_xy_m", "rmse_z_m", "inside_2sd", "longest_gap_s"):
            assert getattr(found, figure) == pytest.approx(expected[figure], abs=TOLERANCE), figure
        assert found.velocity_rms_mps == pytest.approx(expected["velocity_rms_mps"], abs=TOLERANCE)
        assert np.degrees(found.rmse_yaw_rad) == pytest.approx(expected["rmse_yaw_deg"], abs=TOLERANCE)
