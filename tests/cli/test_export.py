"""`sonofix export`: what is written is read back by the readers of others, equal to the track."""

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pynmeagps
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from typer.testing import CliRunner, Result

from made_bags import SITE, TEAM
from sonofix.cli.main import app
from sonofix.files import read_site
from sonofix.files.bag_import import read_bag
from sonofix.files.bag_map import Rule, TopicMap
from sonofix.files.geodesy import ecef_m, on_earth

HEADER = "time_s,vehicle,x_m,y_m,z_m,vx_mps,vy_mps,vz_mps,yaw_rad,sd_x_m,sd_y_m,sd_z_m,sd_yaw_rad,source"
START = "2026-11-22T23:59:58.500000Z"


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def done(*arguments: object) -> str:
    result = call(*arguments)
    assert result.exit_code == 0, result.stderr
    return result.stdout


def mistake(*arguments: object) -> str:
    result = call(*arguments)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    return result.stderr


def numbers(count: int, seed: int = 5) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = 0.25 * np.arange(count) + 0.125
    columns = {"time_s": t, "x_m": 40 * np.cos(t / 5), "y_m": 300 * np.sin(t / 5), "z_m": rng.uniform(-1, 5, count)}
    columns |= {"vx_mps": -8 * np.sin(t / 5), "vy_mps": 60 * np.cos(t / 5), "vz_mps": rng.normal(0, 0.1, count)}
    columns |= {"yaw_rad": rng.uniform(-3, 3, count), "sd_x_m": rng.uniform(0.001, 0.1, count)}
    columns |= {"sd_y_m": rng.uniform(0.001, 0.1, count), "sd_z_m": np.full(count, np.nan)}
    return columns | {"sd_yaw_rad": rng.uniform(0.01, 0.1, count)}


def rows(columns: dict[str, np.ndarray], vehicle: str, sources: list[str]) -> list[str]:
    names = [name for name in HEADER.split(",") if name in columns]
    cells = {name: ["" if np.isnan(v) else f"{v:.9f}" for v in columns[name]] for name in names}
    return [
        ",".join(
            {**{n: cells[n][i] for n in names}, "vehicle": vehicle, "source": source}[n] for n in HEADER.split(",")
        )
        for i, source in enumerate(sources)
    ]


@pytest.fixture
def yard(tmp_path) -> tuple[Path, dict[str, np.ndarray]]:
    """A recording of one vehicle with a track of 12 rows, the third predicted, the fourth's heading unknown."""
    folder = tmp_path / "yard"
    (folder / "out").mkdir(parents=True)
    (folder / "site.toml").write_text(SITE)
    columns = numbers(12)
    columns["yaw_rad"][3] = columns["sd_yaw_rad"][3] = np.nan
    sources = ["fused"] * 12
    sources[2] = "predicted"
    (folder / "out" / "track.csv").write_text("\n".join([HEADER, *rows(columns, "agv", sources)]) + "\n")
    return folder, columns


def messages(path: Path) -> list[tuple[str, str, int, object]]:
    """All messages of a file as rosbags reads them, by the definitions that the file itself holds."""
    with Reader(path) as reader:
        store = get_typestore(Stores.EMPTY)
        for connection in reader.connections:
            store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        return [
            (c.topic, c.msgtype, time_ns, store.deserialize_cdr(data, c.msgtype))
            for c, time_ns, data in reader.messages(list(reader.connections))
        ]


class TestMcap:
    def test_poses_and_velocities_come_back(self, yard):
        folder, columns = yard
        assert "24 messages" in done("export", folder, "--as", "mcap", "--start", "2026-01-31T12:00:00Z")
        found = messages(folder / "out" / "track.mcap")
        zero_ns = 1_769_860_800_000_000_000
        poses = [m for m in found if m[0] == "/agv/pose"]
        assert [m[2] for m in poses] == [zero_ns + round(t * 1e9) for t in columns["time_s"]]
        for i, (_, kind, time_ns, message) in enumerate(poses):
            assert kind == "geometry_msgs/msg/PoseWithCovarianceStamped"
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time_ns
            assert message.header.frame_id == "map"
            p, q = message.pose.pose.position, message.pose.pose.orientation
            np.testing.assert_allclose([p.x, p.y, p.z], [columns[f"{a}_m"][i] for a in "xyz"], atol=1e-8)
            yaw = np.nan_to_num(columns["yaw_rad"][i])
            np.testing.assert_allclose([q.x, q.y, q.z, q.w], [0, 0, np.sin(yaw / 2), np.cos(yaw / 2)], atol=1e-8)
            any_angle = np.pi**2 / 3
            diagonal = [columns["sd_x_m"][i] ** 2, columns["sd_y_m"][i] ** 2, 0, any_angle, any_angle]
            diagonal.append(any_angle if i == 3 else columns["sd_yaw_rad"][i] ** 2)
            np.testing.assert_allclose(message.pose.covariance.reshape(6, 6), np.diag(diagonal), atol=1e-9)
        velocities = [m[3] for m in found if m[0] == "/agv/velocity"]
        for axis in "xyz":
            sent = [getattr(message.vector, axis) for message in velocities]
            np.testing.assert_allclose(sent, columns[f"v{axis}_mps"], atol=1e-8)

    def test_our_own_import_reads_it(self, yard):
        folder, columns = yard
        done("export", folder, "--as", "mcap", "--start", "2026-01-31T12:00:00Z")
        site = read_site(folder)
        found = read_bag(folder / "out" / "track.mcap", site, TopicMap(site, [Rule("/agv/pose", uses=("truth",))]))
        truth = found.truth["agv"]
        np.testing.assert_allclose(truth.position_m[:, 0], columns["x_m"], atol=1e-8)
        np.testing.assert_allclose(truth.time_s, columns["time_s"] - columns["time_s"][0], atol=1e-9)

    def test_roll_and_pitch_where_the_track_has_them(self, yard):
        from scipy.spatial.transform import Rotation

        folder, columns = yard
        path = folder / "out" / "track.csv"
        head, *lines = path.read_text().splitlines()
        path.write_text("\n".join([f"{head},roll_rad,pitch_rad", *(f"{line},0.2,-0.4" for line in lines)]) + "\n")
        done("export", folder, "--as", "mcap")
        done("export", folder, "--as", "tum")
        poses = [m[3] for m in messages(folder / "out" / "track.mcap") if m[0] == "/agv/pose"]
        q = poses[5].pose.pose.orientation
        yaw = columns["yaw_rad"][5]
        expected = Rotation.from_euler("ZYX", [yaw, -0.4, 0.2]).as_quat()
        sign = np.sign(expected[3] * q.w)
        np.testing.assert_allclose([q.x, q.y, q.z, q.w], sign * expected, atol=1e-8)
        tum = np.loadtxt(folder / "out" / "track.tum")
        np.testing.assert_allclose(tum[5, 4:], sign * expected, atol=1e-8)

    def test_times_before_1970_are_told(self, yard):
        folder, _ = yard
        text = (folder / "out" / "track.csv").read_text().replace("\n0.125", "\n-0.125")
        (folder / "out" / "track.csv").write_text(text)
        assert "MCAP knows no times before 1970" in mistake("export", folder, "--as", "mcap")
        done("export", folder, "--as", "mcap", "--start", "1970-01-01T00:00:01Z")
        assert "no times after January 2038" in mistake(
            "export", folder, "--as", "mcap", "--start", "2038-01-19T03:14:06Z"
        )

    def test_odd_names_become_topics(self, tmp_path):
        (tmp_path / "site.toml").write_text(TEAM.replace('"r1"', '"Ü/1"').replace('"r2"', '"__1"'))
        lines = [line for v in ("Ü/1", "__1") for line in rows(numbers(2), v, ["fused"] * 2)]
        (tmp_path / "track.csv").write_text("\n".join([HEADER, *lines]))
        done("export", tmp_path, tmp_path / "track.csv", "--as", "mcap")
        topics = {m[0] for m in messages(tmp_path / "track.mcap")}
        assert topics == {"/v__1/pose", "/v__1/velocity", "/v__1_/pose", "/v__1_/velocity"}


def test_parquet_comes_back_equal(yard):
    folder, columns = yard
    done("export", folder, "--as", "parquet", "--start", START)
    table = pq.read_table(folder / "out" / "track.parquet")
    assert set(table.column_names) == set(HEADER.split(","))
    for name, values in columns.items():
        found = [np.nan if v is None else v for v in table[name].to_pylist()]
        np.testing.assert_array_equal(found, np.round(values, 9))
    assert table["vehicle"].to_pylist() == ["agv"] * 12
    assert table["source"].to_pylist()[1:4] == ["fused", "predicted", "fused"]
    assert table["sd_z_m"].null_count == 12
    assert table.schema.metadata[b"sonofix.zero_ns"] == b"1795391998500000000"


def test_tum_comes_back(yard):
    folder, columns = yard
    done("export", folder, "--as", "tum", "-o", folder / "a.tum")
    tum = np.loadtxt(folder / "a.tum")
    np.testing.assert_allclose(tum[:, :4].T, [columns[n] for n in ("time_s", "x_m", "y_m", "z_m")], atol=6e-7)
    yaw = np.nan_to_num(columns["yaw_rad"])
    np.testing.assert_allclose(2 * np.arctan2(tum[:, 6], tum[:, 7]), yaw, atol=1e-8)


class TestNmea:
    FIXES = "time_s,vehicle,status,x_m,used,hdop\n0.1,agv,ok,1.0,7,1.26\n0.35,agv,too-few,,2,\n"

    def parsed(self, path: Path) -> list:
        data = path.read_bytes()
        assert all(len(line) <= 82 for line in data.splitlines(keepends=True))
        assert data.endswith(b"\r\n")
        reader = pynmeagps.NMEAReader(io.BytesIO(data), validate=pynmeagps.VALCKSUM, quitonerror=2)
        return [message for _, message in reader]

    def test_it_comes_back_within_a_millimetre(self, yard):
        folder, columns = yard
        (folder / "out" / "fixes.csv").write_text(self.FIXES)
        assert "12 positions" in done("export", folder, "--as", "nmea", "--start", START)
        found = self.parsed(folder / "out" / "track.nmea")
        assert [m.identity for m in found] == ["INGGA", "INRMC"] * 12
        origin = read_site(folder).origin
        assert origin is not None
        place = np.column_stack([columns[f"{a}_m"] for a in "xyz"])
        velocity = np.column_stack([columns[f"v{a}_mps"] for a in "xyz"])
        lat, lon, height, there = on_earth(origin, place, velocity)
        exact = ecef_m(np.radians(lat), np.radians(lon), height)
        gga, rmc = found[::2], found[1::2]
        # the text itself: pynmeagps rounds what it reads
        lines = (folder / "out" / "track.nmea").read_text().splitlines()[::2]
        cells = [line.split(",") for line in lines]
        back = [[float(c[k][:w]) + float(c[k][w:]) / 60 for c in cells] for k, w in ((2, 2), (4, 3))]
        read = ecef_m(np.radians(back[0]), np.radians(back[1]), np.array([m.alt + m.sep for m in gga]))
        assert np.max(np.linalg.norm(read - exact, axis=1)) < 1e-3
        np.testing.assert_allclose([m.lat for m in gga], lat, atol=1e-8)
        np.testing.assert_allclose([m.lon for m in rmc], lon, atol=1e-8)
        np.testing.assert_allclose([m.spd * 1852 / 3600 for m in rmc], np.hypot(*there[:, :2].T), atol=3e-4)
        course = np.degrees(np.arctan2(there[:, 0], there[:, 1]))
        assert np.max(np.abs((np.array([m.cog for m in rmc]) - course + 180) % 360 - 180)) <= 0.051
        # past midnight, to the millisecond
        assert [str(rmc[i].time) for i in (0, 6)] == ["23:59:58.625000", "00:00:00.125000"]
        assert [str(rmc[i].date) for i in (0, 6)] == ["2026-11-22", "2026-11-23"]
        assert [m.quality for m in gga] == [1, 1, 6] + [1] * 9
        assert [m.posMode for m in rmc] == ["A", "A", "E"] + ["A"] * 9
        # the fix before each row, while it is no older than an epoch and a half
        assert [c[7] for c in cells] == ["07", "02", "02"] + [""] * 9
        assert [c[8] for c in cells] == ["1.3", "", ""] + [""] * 9

    def test_fixes_without_a_row_are_as_none(self, yard):
        folder, _ = yard
        done("export", folder, "--as", "nmea", "--start", START, "-o", folder / "without.nmea")
        (folder / "out" / "fixes.csv").write_text(self.FIXES.splitlines()[0] + "\n")
        done("export", folder, "--as", "nmea", "--start", START, "-o", folder / "empty.nmea")
        assert (folder / "empty.nmea").read_bytes() == (folder / "without.nmea").read_bytes()

    def test_a_start_before_2000_is_not_laid_to_the_import(self, yard):
        folder, _ = yard
        text = mistake("export", folder, "--as", "nmea", "--start", "1970-01-01T00:00:01Z")
        assert "--start 1970-01-01T00:00:01Z: NMEA states years by two digits" in text
        assert "import.toml" not in text

    def test_minutes_round_up_to_whole_degrees(self):
        from sonofix.files.track_nmea import angle_field

        assert angle_field(-(12 - 1e-10), 2, "NS") == "1200.0000000,S"
        assert angle_field(179.99999999999, 3, "EW") == "18000.0000000,E"
        assert angle_field(0.5 / 60, 3, "EW") == "00000.5000000,E"

    def test_a_standing_vehicle_has_no_course(self, yard):
        folder, columns = yard
        columns |= {"vx_mps": np.full(12, 0.02), "vy_mps": np.full(12, 0.01)}
        (folder / "out" / "track.csv").write_text("\n".join([HEADER, *rows(columns, "agv", ["fused"] * 12)]))
        done("export", folder, "--as", "nmea", "--start", START, "--talker", "GP")
        found = self.parsed(folder / "out" / "track.nmea")
        assert {m.identity for m in found} == {"GPGGA", "GPRMC"}
        assert all(m.cog == "" for m in found[1::2])

    def test_what_is_missing_is_told(self, yard):
        folder, _ = yard
        nmea = ("export", folder, "--as", "nmea")
        assert "say with --start when time 0 was" in mistake(*nmea)
        assert "--start noon: must be a time such as" in mistake(*nmea, "--start", "noon")
        assert "end it with Z where it is UTC" in mistake(*nmea, "--start", "2026-01-31T12:00:00")
        assert "must be two capital letters" in mistake(*nmea, "--start", START, "--talker", "gps")
        (folder / "import.toml").write_text("zero_ns = 5000\n")
        assert "is no time of day" in mistake(*nmea)
        (folder / "import.toml").write_text("zero_ns = 1795391998500000000\n")
        done(*nmea)
        assert str(self.parsed(folder / "out" / "track.nmea")[0].time) == "23:59:58.625000"
        (folder / "import.toml").write_text('zero_ns = "noon"\n')
        assert "must be a whole number" in mistake(*nmea)
        text = (folder / "site.toml").read_text()
        (folder / "site.toml").write_text(
            text.replace("[origin]", "[air]").split("latitude_deg")[0] + "[[vehicle]]" + text.split("[[vehicle]]", 1)[1]
        )
        assert "site.toml: origin: is missing" in mistake(*nmea, "--start", START)


def test_an_unknown_vertical_speed_counts_as_none(yard):
    folder, columns = yard
    velocities = []
    for name, value in (("unknown", np.nan), ("none", 0.0)):
        columns["vz_mps"] = np.full(12, value)
        (folder / "out" / "track.csv").write_text("\n".join([HEADER, *rows(columns, "agv", ["fused"] * 12)]))
        done("export", folder, "--as", "nmea", "--start", START, "-o", folder / f"{name}.nmea")
        done("export", folder, "--as", "mcap", "-o", folder / f"{name}.mcap")
        found = [m[3].vector for m in messages(folder / f"{name}.mcap") if m[0] == "/agv/velocity"]
        velocities.append([(v.x, v.y, v.z) for v in found])
    assert (folder / "unknown.nmea").read_bytes() == (folder / "none.nmea").read_bytes()
    assert velocities[0] == velocities[1]
    assert len(velocities[0]) == 12
    columns["vx_mps"] = np.full(12, np.nan)
    (folder / "out" / "track.csv").write_text("\n".join([HEADER, *rows(columns, "agv", ["fused"] * 12)]))
    assert "12 messages" in done("export", folder, "--as", "mcap")


class TestFiles:
    def test_one_of_several_vehicles_goes_where_it_is_told_to(self, tmp_path):
        (tmp_path / "site.toml").write_text(TEAM)
        track, other, out = (tmp_path / name for name in ("track.csv", "a-r1.tum", "a.tum"))
        track.write_text("\n".join([HEADER, *rows(numbers(3), "r1", ["fused"] * 3)]))
        other.write_text("mine")
        done("export", tmp_path, track, "--as", "tum", "-o", out)
        assert len(out.read_text().splitlines()) == 3
        assert other.read_text() == "mine"
        out.write_text("mine")
        assert "is there already; give --force" in mistake("export", tmp_path, track, "--as", "tum", "-o", out)
        assert out.read_text() == "mine"
        done("export", tmp_path, track, "--as", "tum", "-o", out, "--force")
        assert len(out.read_text().splitlines()) == 3

    def test_names_that_files_spell_alike_lose_no_vehicle(self, tmp_path):
        (tmp_path / "site.toml").write_text(TEAM.replace('"r1"', '"r/1"').replace('"r2"', '"r_1"'))
        track = tmp_path / "track.csv"
        lines = [line for v, n in (("r_1", 2), ("r/1", 3)) for line in rows(numbers(n), v, ["fused"] * n)]
        track.write_text("\n".join([HEADER, *lines]))
        done("export", tmp_path, track, "--as", "tum")
        found = {p.name: len(p.read_text().splitlines()) for p in tmp_path.glob("*.tum")}
        assert found == {"track-r_1.tum": 3, "track-r_1_.tum": 2}
        # alone a vehicle has the same file as among others
        done("export", tmp_path, track, "--as", "tum", "--vehicle", "r_1")
        assert {p.name: len(p.read_text().splitlines()) for p in tmp_path.glob("*.tum")} == found

    def test_several_vehicles(self, tmp_path):
        (tmp_path / "site.toml").write_text(TEAM)
        (tmp_path / "out").mkdir()
        lines = [line for v in ("r1", "r2") for line in rows(numbers(3), v, ["fused"] * 3)]
        (tmp_path / "out" / "track.csv").write_text("\n".join([HEADER, *lines]))
        done("export", tmp_path, "--as", "tum")
        assert sorted(p.name for p in (tmp_path / "out").glob("*.tum")) == ["track-r1.tum", "track-r2.tum"]
        assert "tum holds one vehicle a file" in mistake("export", tmp_path, "--as", "tum", "-o", tmp_path / "a.tum")
        done("export", tmp_path, "--as", "tum", "-o", tmp_path / "a.tum", "--vehicle", "r2")
        assert (tmp_path / "a.tum").read_bytes() == (tmp_path / "out" / "track-r2.tum").read_bytes()
        done("export", tmp_path, "--as", "parquet")
        assert pq.read_table(tmp_path / "out" / "track.parquet")["vehicle"].to_pylist() == ["r1"] * 3 + ["r2"] * 3
        assert "has no row of it; it has r1, r2" in mistake("export", tmp_path, "--as", "tum", "--vehicle", "r3")

    def test_a_file_that_is_there_stays(self, yard):
        folder, _ = yard
        site = folder / "site.toml"
        before = site.read_bytes()
        assert "is there already; give --force" in mistake("export", folder, "--as", "tum", "-o", site)
        assert "is a folder; name a file" in mistake("export", folder, "--as", "tum", "-o", folder)
        assert site.read_bytes() == before

    def test_mistakes_of_a_track_are_told(self, yard):
        folder, _ = yard
        track = folder / "out" / "track.csv"
        text = track.read_text()
        for old, new, remedy in (
            ("0.125", "noon", 'track.csv: line 2, time_s = "noon000000": must be a number'),
            ("time_s,", "time,", "column time_s is missing; is this a file of sonofix run?"),
            (",agv,", ",avg,", "no vehicle of the site; did you mean agv?"),
            ("fused\n", "fused,1\n", "has 15 cells where line 1 names 14 columns"),
        ):
            track.write_text(text.replace(old, new, 1))
            assert remedy in mistake("export", folder, "--as", "tum")
        track.write_text(HEADER + "\n")
        assert "has no rows below its first line" in mistake("export", folder, "--as", "tum")
        track.unlink()
        assert "there is no such file; first: sonofix run" in mistake("export", folder, "--as", "tum")

    @pytest.mark.parametrize("form", ["tum", "mcap", "parquet", "nmea"])
    def test_a_full_disk_leaves_no_half_file(self, yard, form):
        folder, _ = yard
        program = (
            "import resource, sys; from sonofix.cli.main import app; "
            "resource.setrlimit(resource.RLIMIT_FSIZE, (300, 300)); app(sys.argv[1:])"
        )
        arguments = ["export", str(folder), "--as", form, "--start", START]
        run = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False)
        assert run.returncode == 2, run.stderr
        assert "cannot be written: " in run.stderr
        assert sorted(p.name for p in (folder / "out").iterdir()) == ["track.csv"]


@pytest.mark.parametrize(("form", "module", "extra"), [("mcap", "mcap", "robotics"), ("parquet", "pyarrow", "parquet")])
def test_without_the_extra_it_says_what_to_install(yard, form, module, extra):
    folder, _ = yard
    program = f"import sys; sys.modules[{module!r}] = None; from sonofix.cli.main import app; app(sys.argv[1:])"
    arguments = ["export", str(folder), "--as", form]
    run = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert f"pip install 'sonofix[{extra}]'" in run.stderr
