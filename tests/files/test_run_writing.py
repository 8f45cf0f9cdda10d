from __future__ import annotations

import csv
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonofix.files import RecordingError, RunWriter, write_run
from sonofix.records import Estimate, Event, Fix, Innovation, RangeEpoch, Step
from sonofix.site import Beacon, Microphone, Site, Vehicle

SITE = Site(
    vehicles=(Vehicle(id="agv"),),
    beacons=tuple(Beacon(id=f"B{i}", position_m=(i, 0, 3)) for i in range(4)),
    microphones=(Microphone(id="M1", vehicle="agv"),),
)
TEAM = Site(
    vehicles=(Vehicle(id="K"), Vehicle(id="R/2")),
    beacons=(Beacon(id="K", vehicle="K"), Beacon(id="R", vehicle="R/2")),
    microphones=(Microphone(id="K", vehicle="K"), Microphone(id="R", vehicle="R/2")),
)
STATES = ("x", "y", "yaw", "vx", "vy")
COVARIANCE = np.diag([0.04, 0.09, 0.01, 1.0, 1.0]) + 0.001


def epoch(index: int, times=(0.2, 0.1, 0.3), rates=True, period_s=0.5) -> RangeEpoch:
    n, sync_s = len(times), period_s * index
    column = np.arange(n, dtype=float)
    return RangeEpoch(
        index=index,
        sync_s=sync_s,
        emitter=tuple(f"B{i}" for i in range(n)),
        receiver=("M1",) * n,
        time_s=sync_s + np.array(times, dtype=float),
        range_m=3.0 + column,
        covariance_m2=np.diag((0.01 * (1 + column)) ** 2),
        range_rate_mps=column / 10 if rates else None,
        range_rate_sd_mps=np.full(n, 0.02) if rates else None,
        snr_db=np.full(n, 12.5) if rates else None,
        clock="known",
        sound_speed_mps=343.2,
    )


def estimate(time_s: float, vehicle="agv", yaw: float | None = 0.5) -> Estimate:
    return Estimate(
        time_s, vehicle, STATES, np.array([1.0, 2.0, 0.5]), np.array([0.1, -0.2, 0.0]), yaw, None, COVARIANCE, "fused"
    )


def fix(time_s: float, used, status="ok", vehicle="agv") -> Fix:
    found = status == "ok"
    return Fix(
        time_s=time_s,
        vehicle=vehicle,
        status=status,
        remedy="",
        states=STATES if found else (),
        position_m=np.array([1.0, 2.0, 0.5]) if found else None,
        velocity_mps=None,
        yaw_rad=0.25 if found else None,
        clock_offset_m=0.125 if found else None,
        covariance=COVARIANCE if found else None,
        hdop=1.5 if found else None,
        vdop=None,
        hpl_m=None,
        vpl_m=None,
        used=np.array(used),
        residual_m=np.full(len(used), np.nan),
    )


def step(index: int, ranges: RangeEpoch | None = None, **parts) -> Step:
    ranges = ranges or epoch(index)
    n = len(ranges)
    return Step(
        ranges=ranges,
        fixes=parts.get("fixes", (fix(ranges.sync_s + 0.2, [True] * n),)),
        estimates=parts.get("estimates", (estimate(ranges.sync_s + 0.2),)),
        events=parts.get("events", ()),
        range_used=parts.get("used", np.ones(n, bool)),
        range_clock_offset_m=parts.get("offset", np.full(n, np.nan)),
        innovations=parts.get("innovations", ()),
    )


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_columns_are_those_of_the_format(tmp_path):
    write_run(tmp_path, [], SITE)
    expected = {
        "ranges.csv": "time_s,from,to,range_m,sd_m,range_rate_mps,range_rate_sd_mps,snr_db,clock_offset_m,used",
        "track.csv": "time_s,vehicle,x_m,y_m,z_m,vx_mps,vy_mps,vz_mps,yaw_rad,sd_x_m,sd_y_m,sd_z_m,sd_yaw_rad,source",
        "fixes.csv": "time_s,vehicle,status,x_m,y_m,z_m,yaw_rad,clock_offset_m,cxx_m2,cxy_m2,cyy_m2,czz_m2,"
        "hdop,vdop,hpl_m,vpl_m,heard,used,excluded",
        "events.csv": "time_s,vehicle,event,detail",
        "innovations.csv": "time_s,rows,nis",
    }
    assert {path.name: path.read_text() for path in tmp_path.glob("*.csv")} == {
        k: v + "\n" for k, v in expected.items()
    }


def test_ranges_in_order_of_time_with_their_figures(tmp_path):
    used, offset = np.array([True, False, True]), np.array([0.5, np.nan, 0.25])
    write_run(tmp_path, [step(0, used=used, offset=offset)], SITE)
    found = rows(tmp_path / "ranges.csv")
    assert [row["from"] for row in found] == ["B1", "B0", "B2"]
    assert [float(row["time_s"]) for row in found] == [0.1, 0.2, 0.3]
    assert [float(row["range_m"]) for row in found] == [4.0, 3.0, 5.0]
    assert [float(row["sd_m"]) for row in found] == pytest.approx([0.02, 0.01, 0.03])
    assert [row["clock_offset_m"] for row in found] == ["", "0.500000", "0.250000"]
    assert [row["used"] for row in found] == ["0", "1", "1"]


def test_unknown_rates_are_empty_cells(tmp_path):
    write_run(tmp_path, [step(0, epoch(0, rates=False))], SITE)
    row = rows(tmp_path / "ranges.csv")[0]
    assert [row[key] for key in ("range_rate_mps", "range_rate_sd_mps", "snr_db")] == ["", "", ""]


def test_small_figures_keep_their_digits(tmp_path):
    """A deviation of a micrometre must not be written as zero."""
    tiny = epoch(0)
    tiny.covariance_m2[:] = np.eye(3) * 1e-14
    write_run(tmp_path, [step(0, tiny)], SITE)
    assert float(rows(tmp_path / "ranges.csv")[0]["sd_m"]) == pytest.approx(1e-7)


def test_a_row_heard_after_the_next_epoch_began_is_put_in_order(tmp_path):
    """Sound of one epoch may arrive after the first sound of the next."""
    late = [step(i, epoch(i, times=(0.1, 0.3, 0.7))) for i in range(4)]
    write_run(tmp_path, late, SITE)
    times = [float(row["time_s"]) for row in rows(tmp_path / "ranges.csv")]
    assert len(times) == 12
    assert times == sorted(times)


def test_a_fix_in_full(tmp_path):
    write_run(tmp_path, [step(0, fixes=(fix(0.2, [True, False, True]),))], SITE)
    (row,) = rows(tmp_path / "fixes.csv")
    assert (row["status"], row["hdop"], row["vdop"], row["hpl_m"]) == ("ok", "1.5", "", "")
    assert [float(row[key]) for key in ("x_m", "y_m", "z_m", "yaw_rad", "clock_offset_m")] == [1, 2, 0.5, 0.25, 0.125]
    assert [float(row[key]) for key in ("cxx_m2", "cxy_m2", "cyy_m2")] == pytest.approx([0.041, 0.001, 0.091])
    assert row["czz_m2"] == ""
    assert (row["heard"], row["used"], row["excluded"]) == ("3", "2", "1")


def test_an_epoch_without_a_fix_has_its_row(tmp_path):
    write_run(tmp_path, [step(0, fixes=(fix(0.2, [False] * 3, "too-few"),))], SITE)
    (row,) = rows(tmp_path / "fixes.csv")
    assert row["status"] == "too-few"
    assert row["x_m"] == row["cxx_m2"] == row["hdop"] == ""
    assert (row["heard"], row["used"], row["excluded"]) == ("3", "0", "0")


def test_heard_counts_what_concerns_the_vehicle(tmp_path):
    ends = RangeEpoch(
        0, 0.0, ("R", "K"), ("K", "R"), np.array([0.1, 0.2]), np.ones(2), np.eye(2), None, None, None, "known", 343.2
    )
    fixes = (fix(0.1, [True, False], vehicle="K"), fix(0.2, [True, True], vehicle="R/2"))
    write_run(tmp_path, [step(0, ends, fixes=fixes, estimates=())], TEAM)
    assert [(row["heard"], row["used"]) for row in rows(tmp_path / "fixes.csv")] == [("2", "1"), ("2", "2")]


def test_a_track_row(tmp_path):
    write_run(tmp_path, [step(0)], SITE)
    (row,) = rows(tmp_path / "track.csv")
    assert [float(row[key]) for key in ("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps")] == [1, 2, 0.5, 0.1, -0.2, 0]
    assert float(row["sd_x_m"]) == pytest.approx(np.sqrt(0.041), rel=1e-5)
    assert row["sd_z_m"] == ""
    assert float(row["sd_yaw_rad"]) == pytest.approx(np.sqrt(0.011), rel=1e-5)
    assert row["source"] == "fused"


def test_a_tum_trajectory_per_vehicle(tmp_path):
    write_run(tmp_path / "one", [step(0)], SITE)
    values = np.loadtxt(tmp_path / "one" / "track.tum")
    np.testing.assert_allclose(values, [0.2, 1, 2, 0.5, 0, 0, np.sin(0.25), np.cos(0.25)], atol=1e-9)
    pair = (estimate(0.2, "K"), estimate(0.2, "R/2", yaw=None))
    write_run(tmp_path / "two", [step(0, estimates=pair, fixes=())], TEAM)
    assert np.loadtxt(tmp_path / "two" / "track-K.tum").shape == (8,)
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "two" / "track-R_2.tum")[4:], [0, 0, 0, 1])


def test_innovations_are_rows(tmp_path):
    write_run(tmp_path, [step(0, innovations=(Innovation(0.21, 8, 7.25),)), step(1)], SITE)
    assert (tmp_path / "innovations.csv").read_text() == "time_s,rows,nis\n0.210000000,8,7.25\n"


def test_an_events_detail_may_hold_anything(tmp_path):
    write_run(tmp_path, [step(0, events=(Event(0.3, "agv", "reset", 'jumped, "far"\nand away'),))], SITE)
    (row,) = rows(tmp_path / "events.csv")
    assert row["detail"] == 'jumped, "far" and away'
    assert len((tmp_path / "events.csv").read_text().splitlines()) == 2


def test_rows_are_on_disk_while_the_run_goes_on(tmp_path):
    with RunWriter(tmp_path, SITE) as writer:
        for index in range(3):
            writer.write(step(index))
        assert len(rows(tmp_path / "track.csv")) == 3


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ZeroDivisionError])
def test_nothing_is_lost_when_a_run_is_stopped(tmp_path, stop):
    def steps():
        yield step(0)
        yield step(1, epoch(1, times=(0.1, 0.2, 0.9)))
        raise stop

    with pytest.raises(stop):
        write_run(tmp_path, steps(), SITE)
    assert len(rows(tmp_path / "ranges.csv")) == 6
    assert len(rows(tmp_path / "track.csv")) == 2


def test_earlier_outputs_are_replaced(tmp_path):
    write_run(tmp_path, [step(0), step(1)], SITE)
    write_run(tmp_path, [step(0)], SITE)
    assert len(rows(tmp_path / "track.csv")) == 1


def test_never_into_a_recording(tmp_path):
    (tmp_path / "site.toml").write_text("format = 1")
    (tmp_path / "ranges.csv").write_text("measured")
    with pytest.raises(RecordingError, match="is a recording"):
        write_run(tmp_path, [step(0)], SITE)
    assert (tmp_path / "ranges.csv").read_text() == "measured"


def test_never_over_a_recordings_files_through_links(tmp_path):
    """`-o` into a folder that links back to what the recording holds."""
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "site.toml").write_text("format = 1")
    (tmp_path / "out").symlink_to(tmp_path / "rec")
    with pytest.raises(RecordingError, match="is a recording"):
        write_run(tmp_path / "out", [step(0)], SITE)


def test_a_file_in_the_way(tmp_path):
    (tmp_path / "out").write_text("x")
    with pytest.raises(RecordingError, match="is a file"):
        write_run(tmp_path / "out", [], SITE)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("name", ["ranges.csv", "track.csv", "track.tum"])
def test_a_full_disk_is_one_clear_line(tmp_path, name):
    (tmp_path / name).symlink_to("/dev/full")
    with pytest.raises(RecordingError) as caught:
        write_run(tmp_path, [step(0), step(1)], SITE)
    (problem,) = caught.value.problems
    assert name in str(problem)
    assert "No space left" in str(problem)


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_folder_that_may_not_be_written(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(RecordingError, match="cannot be written"):
        write_run(tmp_path / "out", [], SITE)


def test_a_body_that_tilts_has_its_roll_and_pitch_behind_all_else(tmp_path):
    vehicle = SITE.vehicles[0].model_copy(update={"tilt_sd_rad": 0.2})
    tilting = SITE.model_copy(update={"vehicles": (vehicle,)})
    covariance = np.diag([1e-4, 1e-4, 4e-4, 9e-4])
    leaning = replace(
        estimate(0.2), states=("x", "y", "roll", "pitch"), covariance=covariance, roll_rad=0.25, pitch_rad=-0.125
    )
    write_run(tmp_path, [step(0, estimates=(leaning,))], tilting)
    (row,) = rows(tmp_path / "track.csv")
    assert list(row)[-5:] == ["source", "roll_rad", "pitch_rad", "sd_roll_rad", "sd_pitch_rad"]
    assert [float(row[name]) for name in list(row)[-4:]] == pytest.approx([0.25, -0.125, 0.02, 0.03])
    (row,) = rows(tmp_path / "fixes.csv")
    assert list(row)[-5:] == ["excluded", "roll_rad", "pitch_rad", "sd_roll_rad", "sd_pitch_rad"]
    assert list(row.values())[-4:] == ["", "", "", ""]
