"""`sonofix import`: from a robot's bag to a track that is as good as from CSV files, and folders that stay whole."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
from typer.testing import CliRunner, Result

from made_bags import RANGE, SITE, START_NS, drive, ranged, write_bag, write_mcap
from sonofix.cli.main import app
from sonofix.files import read_recording, read_site, read_truth
from sonofix.files.results import read_track

SHORT, _ = drive(1.0, noise_m=0.02)


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def bag(tmp_path) -> Path:
    (tmp_path / "yard.toml").write_text(SITE)
    return write_bag(tmp_path / "bag", SHORT)


def test_a_bag_becomes_a_track_as_good_as_from_csv(tmp_path):
    messages, truth = drive(12.0, noise_m=0.02)
    (tmp_path / "yard.toml").write_text(SITE)
    bag = write_bag(tmp_path / "bag", messages, "sqlite3")
    done = call("import", bag, tmp_path / "a", "--site", tmp_path / "yard.toml")
    assert done.exit_code == 0, done.stderr
    assert "Written to" in done.stdout
    # the same drive written by hand, from the numbers themselves
    other = tmp_path / "b"
    other.mkdir()
    (other / "site.toml").write_text(SITE)
    rows = [(m[2] - START_NS - 5e6, m[0].split("/")[-1], m[3]) for m in messages]
    ranges = [f"{t / 1e9:.9f},{name},M1,{m.range:.9f},0.02\n" for t, name, m in rows if name != "odom"]
    wheels = [f"{t / 1e9:.9f},0.9,0.25\n" for t, name, _ in rows if name == "odom"]
    (other / "ranges.csv").write_text("time_s,from,to,range_m,sd_m\n" + "".join(ranges))
    (other / "odometry.csv").write_text("time_s,v_mps,yaw_rate_radps\n" + "".join(wheels))
    tracks = []
    for folder in ("a", "b"):
        done = call("run", tmp_path / folder, "--no-plot")
        assert done.exit_code == 0, done.stderr
        tracks.append(read_track(tmp_path / folder / "out" / "track.csv", read_site(tmp_path / folder)).columns)
    for name in ("time_s", "x_m", "y_m"):
        np.testing.assert_allclose(tracks[0][name], tracks[1][name], atol=2e-5)
    late = tracks[0]["time_s"] > 4
    errors = [tracks[0][f"{a}_m"] - np.interp(tracks[0]["time_s"], truth["time_s"], truth[a]) for a in "xy"]
    # with ranges to 2 cm and wheels between them
    assert np.sqrt(np.mean(np.square(errors)[:, late].sum(axis=0))) < 0.03


def test_the_folder_holds_what_the_contract_says(tmp_path, bag):
    folder = tmp_path / "deep" / "run"
    (tmp_path / "map.toml").write_text('[[topic]]\nname = "/odom"\nas = ["odometry", "truth"]\n')
    site = tmp_path / "yard.toml"
    done = call("import", bag, folder, "--site", site, "--map", tmp_path / "map.toml")
    assert done.exit_code == 0, done.stderr
    assert sorted(p.name for p in folder.iterdir()) == [
        "import.toml",
        "odometry.csv",
        "ranges.csv",
        "site.toml",
        "truth.csv",
    ]
    assert sorted(p.name for p in folder.parent.iterdir()) == ["run"]
    assert (folder / "site.toml").read_bytes() == site.read_bytes()  # comments and all
    recording = read_recording(folder, to_run=True)
    assert recording.ranges is not None
    assert len(recording.ranges.time_s) == 9
    assert len(recording.tables["odometry"].columns["time_s"]) == 21
    assert len(read_truth(folder)["agv"].time_s) == 21
    note = (folder / "import.toml").read_text()
    assert note.splitlines()[0].endswith("2023-11-14T22:13:20.000000000Z")
    assert "\nzero_ns = 1700000000000000000 " in note
    assert call("check", folder).exit_code == 0


def test_rows_and_losses_are_shown(tmp_path, bag):
    messages = [*SHORT, ("/range/B1", RANGE, START_NS + 7, ranged(START_NS + 7, np.inf, "tag"))]
    done = call("import", write_mcap(tmp_path / "a.mcap", messages), tmp_path / "run", "--site", tmp_path / "yard.toml")
    text = " ".join(done.stdout.split())
    assert "/odom nav_msgs/msg/Odometry 21 odometry.csv 21" in text
    assert "/range/B1 sensor_msgs/msg/Range 4 ranges.csv 3 1 infinite: nothing in reach" in text
    assert "30 rows over 1.000 s" in text


class TestFolders:
    def test_sensors_beside_a_capture_need_time_zero(self, tmp_path, bag):
        folder = tmp_path / "run"
        folder.mkdir()
        (folder / "site.toml").write_text(SITE)
        soundfile.write(folder / "capture.wav", np.zeros(100), 48000)
        wheels = write_bag(tmp_path / "wheels", [m for m in SHORT if m[0] == "/odom"])
        done = call("import", wheels, folder)
        assert done.exit_code == 2
        assert "say with --zero when that was" in done.stderr
        done = call("import", wheels, folder, "--zero", "1699999999.25")
        assert done.exit_code == 0, done.stderr
        lines = (folder / "odometry.csv").read_text().splitlines()
        assert lines[1] == "0.750000000,agv,0.900000000,0.250000000"
        # the next bag goes by the same clock
        ranges = write_bag(tmp_path / "ranges", [m for m in SHORT if m[0] != "/odom"])
        assert "leave --zero away" in call("import", ranges, folder, "--zero", "1699999999").stderr
        assert call("import", ranges, folder).exit_code == 0
        assert (folder / "ranges.csv").read_text().splitlines()[1].startswith("0.750000000,B1,M1,")

    def test_files_that_are_there_stay(self, tmp_path, bag):
        folder = tmp_path / "run"
        assert call("import", bag, folder, "--site", tmp_path / "yard.toml").exit_code == 0
        (folder / "odometry.csv").write_text("mine")
        done = call("import", bag, folder)
        assert done.exit_code == 2
        assert f"{folder / 'odometry.csv'}: is there already; give --force" in done.stderr
        assert (folder / "odometry.csv").read_text() == "mine"
        assert call("import", bag, folder, "--force").exit_code == 0
        assert len((folder / "odometry.csv").read_text().splitlines()) == 22
        assert not list(folder.glob(".import*"))

    def test_one_site_file(self, tmp_path, bag):
        done = call("import", bag, tmp_path / "run")
        assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
        assert "say what stands where with --site" in done.stderr
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "site.toml").write_text(SITE)
        done = call("import", bag, tmp_path / "run", "--site", tmp_path / "yard.toml")
        assert "the folder has its own site.toml" in done.stderr
        done = call("import", bag, bag / "metadata.yaml", "--site", tmp_path / "yard.toml")
        assert "is a file; give a folder" in done.stderr

    def test_mistakes_write_nothing(self, tmp_path, bag):
        unknown = write_bag(tmp_path / "other", [("/uwb", RANGE, START_NS, ranged(START_NS, 3.0, "tag"))])
        zeros = ("noon", "1e30", "2000000000", "1e999999")
        for path, options in (*((bag, ("--zero", zero)) for zero in zeros), (unknown, ()), (tmp_path / "no", ())):
            done = call("import", path, tmp_path / "run", "--site", tmp_path / "yard.toml", *options)
            assert done.exit_code == 2
            assert done.stderr.count("\n") == 1
            assert not (tmp_path / "run").exists()

    def test_ctrl_c_writes_nothing(self, tmp_path, bag, monkeypatch):
        import sonofix.cli.import_bag as command

        seen = []

        def third() -> None:
            seen.append(1)
            if len(seen) == 3:
                raise KeyboardInterrupt

        monkeypatch.setattr(command, "stop_if_asked", third)
        done = call("import", bag, tmp_path / "run", "--site", tmp_path / "yard.toml")
        assert done.exit_code == 130
        assert "stopped; nothing was written" in done.stderr
        assert not (tmp_path / "run").exists()

    def test_a_full_disk_leaves_the_folder_as_it_was(self, tmp_path):
        messages, _ = drive(20.0)
        (tmp_path / "yard.toml").write_text(SITE)
        bag = write_bag(tmp_path / "bag", messages)
        limit = (6000, 6000)  # bytes a file: less than odometry.csv takes
        program = (
            "import resource, sys; "
            f"resource.setrlimit(resource.RLIMIT_FSIZE, {limit}); "
            "from sonofix.cli.main import app; app(sys.argv[1:])"
        )
        assert resource.getrlimit(resource.RLIMIT_FSIZE)[1] == resource.RLIM_INFINITY
        arguments = ["import", str(bag), str(tmp_path / "run"), "--site", str(tmp_path / "yard.toml")]
        done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 2, done.stderr
        assert "cannot be written: File too large" in done.stderr
        assert not (tmp_path / "run").exists()
        assert not list(tmp_path.glob(".import*"))


def test_without_the_extra_it_says_what_to_install(tmp_path):
    """In a process of its own, where rosbags cannot be found."""
    (tmp_path / "yard.toml").write_text(SITE)
    program = "import sys; sys.modules['rosbags'] = None; from sonofix.cli.main import app; app(sys.argv[1:])"
    arguments = ["import", str(tmp_path), str(tmp_path / "run"), "--site", str(tmp_path / "yard.toml")]
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "pip install 'sonofix[robotics]'" in done.stderr
