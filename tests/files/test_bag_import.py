"""Bags read into tables: every storage gives the same rows; what is of no use is counted, what is unclear asked."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores

from made_bags import (
    IMU,
    ODOMETRY,
    POSE,
    RANGE,
    SITE,
    STAMPED,
    START_NS,
    TEAM,
    TEMPERATURE,
    TEXT,
    drive,
    header,
    imu,
    make,
    odometry,
    posed,
    ranged,
    write_bag,
    write_mcap,
)
from sonofix.files.bag_import import read_bag
from sonofix.files.bag_map import Rule, TopicMap, read_map
from sonofix.files.problem import RecordingError
from sonofix.files.site_file import parse_site

YARD, ROBOTS = parse_site(SITE), parse_site(TEAM)
MS = 1_000_000
MESSAGES, _ = drive(4.0, noise_m=0.02)


def told(call, *args, **options) -> str:
    with pytest.raises(RecordingError) as error:
        call(*args, **options)
    return str(error.value)


def odom(count: int, topic: str = "/odom", first_ns: int = START_NS, **more) -> list:
    times = [first_ns + 100 * MS * k for k in range(count)]
    return [(topic, ODOMETRY, t, odometry(t, 1.0 + 0.1 * k, -0.2, **more)) for k, t in enumerate(times)]


@pytest.fixture(scope="module")
def direct():
    """What the messages say, without any bag between."""
    odometries = [m for m in MESSAGES if m[1] == ODOMETRY]
    ranges = [m for m in MESSAGES if m[1] == RANGE]
    return odometries, ranges


def as_is(path: Path) -> Path:
    return write_bag(path / "bag", MESSAGES, "mcap")


STORAGES = {
    "rosbag2 mcap": as_is,
    "rosbag2 sqlite3": lambda path: write_bag(path / "bag", MESSAGES, "sqlite3"),
    "messages compressed": lambda path: write_bag(path / "bag", MESSAGES, "sqlite3", compressed="MESSAGE"),
    "file compressed": lambda path: write_bag(path / "bag", MESSAGES, "mcap", compressed="FILE"),
    "file of rosbag2": lambda path: next(as_is(path).glob("*.mcap")),
    "db3 file": lambda path: next(write_bag(path / "bag", MESSAGES, "sqlite3").glob("*.db3")),
    "plain mcap": lambda path: write_mcap(path / "a.mcap", MESSAGES),
    "mcap without index": lambda path: write_mcap(path / "a.mcap", MESSAGES, index=False),
}


@pytest.mark.parametrize("storage", STORAGES)
def test_every_storage_gives_the_same_rows(storage, tmp_path, direct):
    found = read_bag(STORAGES[storage](tmp_path), YARD)
    odometries, ranges = direct
    assert found.zero_ns == START_NS
    table = found.tables["odometry"]
    assert table.names["vehicle"] == ("agv",) * len(odometries)
    np.testing.assert_allclose(table.columns["time_s"], np.arange(len(odometries)) / 20, atol=1e-12)
    assert np.all(table.columns["v_mps"] == 0.9)
    assert np.all(table.columns["yaw_rate_radps"] == 0.25)
    assert found.ranges is not None
    assert found.ranges.emitter == tuple(m[0].split("/")[-1] for m in ranges)
    assert set(found.ranges.receiver) == {"M1"}
    np.testing.assert_allclose(found.ranges.range_m, [m[3].range for m in ranges], rtol=1e-7)  # float32
    assert found.ranges.sd_m is not None
    np.testing.assert_allclose(found.ranges.sd_m, 0.02, rtol=1e-6)
    assert found.notes == ()
    assert {t.name: sum(t.rows.values()) for t in found.topics} == {t.name: t.messages for t in found.topics}


def test_bags_of_humble_hold_no_definitions(tmp_path):
    """Before Iron a db3 file has no table of definitions, and a Range no variance."""
    import sqlite3

    messages = [("/range/B2", RANGE, START_NS, ranged(START_NS, 3.5, "x", variance=None))]
    bag = write_bag(tmp_path / "bag", messages, "sqlite3", Stores.ROS2_HUMBLE)
    file = next(bag.glob("*.db3"))
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("DROP TABLE schema")
    database.close()
    found = read_bag(file, YARD)
    assert found.ranges is not None
    assert found.ranges.range_m.tolist() == [3.5]
    assert found.ranges.sd_m is None


class TestDamage:
    def test_a_cut_off_mcap_gives_what_comes_before(self, tmp_path):
        path = write_mcap(tmp_path / "a.mcap", MESSAGES)
        whole = path.read_bytes()
        counts = []
        for share in (0.2, 0.4):
            path.write_bytes(whole[: int(share * len(whole))])
            found = read_bag(path, YARD)
            (note,) = found.notes
            assert note.startswith("a.mcap is cut off or damaged after ")
            assert note.endswith(" messages (it ends too early); those are read")
            counts.append(sum(t.messages for t in found.topics))
        assert 0 < counts[0] < counts[1] < len(MESSAGES)

    def test_a_flipped_bit_is_found(self, tmp_path):
        path = write_mcap(tmp_path / "a.mcap", MESSAGES)
        data = bytearray(path.read_bytes())
        data[len(data) // 4] ^= 0x10
        path.write_bytes(data)
        found = read_bag(path, YARD)
        assert "cut off or damaged" in found.notes[0]

    @pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
    def test_a_cut_off_bag_folder_is_told(self, tmp_path, storage):
        bag = write_bag(tmp_path / "bag", MESSAGES, storage)
        file = next(f for f in bag.iterdir() if f.suffix in (".mcap", ".db3"))
        file.write_bytes(file.read_bytes()[:5000])
        text = told(read_bag, bag, YARD)
        assert text.startswith(f"{bag}: cannot be read: ")
        assert ("may be read by giving its file" in text) == (storage == "mcap")

    def test_a_folder_whose_recorder_was_killed_is_told(self, tmp_path):
        bag = write_bag(tmp_path / "bag", MESSAGES)
        (bag / "metadata.yaml").unlink()
        assert "has no metadata.yaml: its recorder was stopped" in told(read_bag, bag, YARD)
        assert "bag.mcap" in told(read_bag, bag, YARD)

    def test_what_is_no_bag_is_told(self, tmp_path):
        assert "there is no such file or folder" in told(read_bag, tmp_path / "no.mcap", YARD)
        assert "is no rosbag2 folder" in told(read_bag, tmp_path, YARD)
        for name, remedy in (("a.bag", "is a ROS 1 bag"), ("a.txt", "is no bag"), ("a.mcap", "cannot be read")):
            (tmp_path / name).write_bytes(b"nothing of use")
            assert remedy in told(read_bag, tmp_path / name, YARD)

    def test_messages_that_do_not_fit_their_definition_are_told(self, tmp_path):
        import sqlite3

        bag = write_bag(tmp_path / "bag", odom(3), "sqlite3")
        with sqlite3.connect(next(bag.glob("*.db3"))) as database:
            database.execute("UPDATE messages SET data = x'0001000001020304' WHERE id = 2")
        database.close()
        assert "/odom: 8 bytes are no nav_msgs/msg/Odometry as the bag defines it" in told(read_bag, bag, YARD)


class TestTimes:
    def test_a_topic_without_stamps_has_times_of_receipt(self, tmp_path):
        messages = [("/odom", ODOMETRY, START_NS + k * MS, odometry(0, 1, 0)) for k in range(5)]
        found = read_bag(write_mcap(tmp_path / "a.mcap", messages), YARD)
        assert found.notes == ("/odom has no stamps: its times are those of receipt",)
        np.testing.assert_allclose(found.tables["odometry"].columns["time_s"], np.arange(5) / 1e3)

    def test_stamps_of_a_clock_not_set_yet_are_left_out(self, tmp_path):
        messages = odom(40)
        messages[0] = ("/odom", ODOMETRY, START_NS, odometry(5_000 * MS, 1, 0))
        found = read_bag(write_mcap(tmp_path / "a.mcap", messages), YARD)
        (note,) = found.notes
        assert "1 of 40 stamps are far from the others" in note
        assert "5.000000000" in note
        assert found.topics[0].left_out == {"wrong stamp": 1}
        assert found.zero_ns == START_NS + 100 * MS

    def test_many_such_stamps_are_a_mistake(self, tmp_path):
        messages = [("/odom", ODOMETRY, t, odometry(t if k < 6 else k, 1, 0)) for k, (_, _, t, _) in enumerate(odom(9))]
        text = told(read_bag, write_mcap(tmp_path / "a.mcap", messages), YARD)
        assert "/odom, header.stamp" in text
        assert "--clock received" in text

    def test_small_disorder_is_sorted_and_noted(self, tmp_path):
        messages = odom(5)
        stamps = [START_NS + 100 * MS * k for k in (0, 2, 1, 3, 4)]
        messages = [(*m[:3], odometry(t, k, 0)) for k, (m, t) in enumerate(zip(messages, stamps, strict=True))]
        found = read_bag(write_mcap(tmp_path / "a.mcap", messages), YARD)
        assert found.notes == ("/odom: 1 of 5 messages came after a later stamp; rows are sorted by stamp",)
        assert found.tables["odometry"].columns["v_mps"].tolist() == [0, 2, 1, 3, 4]

    def test_a_clock_set_back_is_a_mistake(self, tmp_path):
        again = [(t, k, r + 4000 * MS, m) for t, k, r, m in odom(3, first_ns=START_NS - 3000 * MS)]
        bag = write_mcap(tmp_path / "a.mcap", odom(3) + again)
        text = told(read_bag, bag, YARD)
        assert "the clock was set back" in text
        assert "1699999997.000000000" in text
        found = read_bag(bag, YARD, clock="received")
        assert len(found.tables["odometry"].columns["time_s"]) == 6

    def test_two_clocks_are_a_mistake(self, tmp_path):
        simulated = [("/imu", IMU, t, imu(t - START_NS)) for _, _, t, _ in odom(5)]
        bag = write_bag(tmp_path / "bag", odom(5) + simulated)
        text = told(read_bag, bag, YARD)
        assert "/odom, header.stamp" in text
        assert "two clocks" in text
        assert set(read_bag(bag, YARD, clock="received").tables) == {"odometry", "imu"}

    def test_late_messages_are_noted(self, tmp_path):
        late = [("/imu", IMU, t + 3000 * MS, imu(t)) for _, _, t, _ in odom(5)]
        found = read_bag(write_bag(tmp_path / "bag", odom(5) + late), YARD)
        assert "messages come /imu 3.000 s and /odom 0.000 s after their stamps" in found.notes[0]

    def test_time_zero_can_be_given(self, tmp_path):
        found = read_bag(write_bag(tmp_path / "bag", odom(3)), YARD, zero_ns=START_NS + 250 * MS)
        np.testing.assert_allclose(found.tables["odometry"].columns["time_s"], [-0.25, -0.15, -0.05], atol=1e-12)

    @pytest.mark.parametrize(
        ("zero_ns", "shown"),
        [
            (10**39, "1.000000000000000000000000000E+30"),
            (-(10**39), "-1.000000000000000000000000000E+30"),
            (2 * 10**18, "2000000000"),
            (START_NS + 200 * MS + 86_400 * 10**9 + 1, "1700086400.200000001"),
            (START_NS - 86_400 * 10**9 - 1, "1699913599.999999999"),
        ],
    )
    def test_a_time_zero_far_from_the_messages_is_told(self, tmp_path, zero_ns, shown):
        text = told(read_bag, write_bag(tmp_path / "bag", odom(3)), YARD, zero_ns=zero_ns)
        assert f'--zero = "{shown}": lies over a day' in text
        assert "the earliest of which is of 1700000000.000000000 s" in text

    @pytest.mark.parametrize("zero_ns", [START_NS + 200 * MS + 86_400 * 10**9, START_NS - 86_400 * 10**9])
    def test_time_zero_may_lie_a_day_off(self, tmp_path, zero_ns):
        found = read_bag(write_bag(tmp_path / "bag", odom(3)), YARD, zero_ns=zero_ns)
        expected = [(START_NS + k * 100 * MS - zero_ns) / 1e9 for k in range(3)]
        np.testing.assert_array_equal(found.tables["odometry"].columns["time_s"], expected)

    def test_rows_of_one_time_stand_once(self, tmp_path):
        messages = odom(3)
        found = read_bag(write_bag(tmp_path / "bag", [*messages, messages[-1]]), YARD)
        assert found.notes == ("odometry: 1 of 4 messages had the time of another and are left out",)


class TestMessages:
    def test_ranges_beyond_limits_are_counted(self, tmp_path):
        values = [3.0, np.inf, -np.inf, np.nan, 0.05, 60.0, 4.0]
        times = [START_NS + k * MS for k in range(len(values))]
        messages = [("/range/B1", RANGE, t, ranged(t, r, "tag")) for t, r in zip(times, values, strict=True)]
        found = read_bag(write_bag(tmp_path / "bag", messages), YARD)
        assert found.ranges is not None
        assert found.ranges.range_m.tolist() == [3.0, 4.0]
        assert found.topics[0].left_out == {
            "not a number": 1,
            "infinite: nothing in reach": 2,
            "outside min_range and max_range": 2,
        }

    def test_limits_that_are_not_set_do_not_judge(self, tmp_path):
        messages = [
            ("/range/B1", RANGE, START_NS + k, ranged(START_NS + k, r, "tag", (0, 0))) for k, r in enumerate((7, -1))
        ]
        found = read_bag(write_bag(tmp_path / "bag", messages), YARD)
        assert found.ranges is not None
        assert found.ranges.range_m.tolist() == [7.0]
        assert found.topics[0].left_out == {"below 0": 1}
        free = parse_site(SITE + "[schedule]\nperiod_s = 1.0\nsynchronised = false\n")
        found = read_bag(tmp_path / "bag", free)
        assert found.ranges is not None
        assert found.ranges.range_m.tolist() == [7.0, -1.0]

    def test_what_an_imu_does_not_measure_stays_empty(self, tmp_path):
        messages = [
            ("/imu", IMU, START_NS, imu(START_NS)),
            ("/imu", IMU, START_NS + 1, imu(START_NS + 1, measured=False)),
        ]
        found = read_bag(write_bag(tmp_path / "bag", messages), YARD)
        columns = found.tables["imu"].columns
        assert [columns[c].tolist() for c in ("gz_radps", "ax_mps2", "az_mps2")] == [[0.1], [0.1], [9.81]]
        assert found.topics[0].left_out == {"no rate nor acceleration": 1}
        assert "compass" not in found.tables

    def test_headings_on_request_are_those_of_the_site(self, tmp_path):
        messages = [("/imu", IMU, START_NS + k, imu(START_NS + k, yaw=y)) for k, y in enumerate((0.5, None, -3.1))]
        bag = write_bag(tmp_path / "bag", messages)
        found = read_bag(bag, YARD, TopicMap(YARD, [Rule("/imu", uses=("compass",))]))
        assert set(found.tables) == {"compass"}
        # the site's x axis lies 0.3 rad from east
        np.testing.assert_allclose(found.tables["compass"].columns["heading_rad"], [0.2, 2 * np.pi - 3.4])
        assert found.topics[0].left_out == {"no orientation": 1}

    def test_poses_and_temperatures_on_request(self, tmp_path):
        t = START_NS
        pose = posed(1, 2, 3, 0.7)
        messages = [
            ("/mocap", STAMPED, t, make(STAMPED, header(t, "map"), pose.pose)),
            ("/fix", POSE, t, make(POSE, header(t, "map"), pose)),
            ("/air", TEMPERATURE, t, make(TEMPERATURE, header(t, "x"), 21.5, 0.0)),
            ("/air", TEMPERATURE, t + 1, make(TEMPERATURE, header(t + 1, "x"), 300.0, 0.0)),
        ]
        bag = write_bag(tmp_path / "bag", messages)
        text = told(read_bag, bag, YARD)
        assert "holds nothing to take; its messages are " in text
        assert "1 /mocap (geometry_msgs/msg/PoseStamped)" in text
        for name in ("/mocap", "/fix"):
            rules = TopicMap(YARD, [Rule(name, uses=("truth",)), Rule("/air", uses=("temperature",))])
            found = read_bag(bag, YARD, rules)
            truth = found.truth["agv"]
            assert truth.position_m.tolist() == [[1, 2, 3]]
            assert truth.yaw_rad is not None
            np.testing.assert_allclose(truth.yaw_rad, [0.7])
            assert found.tables["temperature"].columns["temperature_c"].tolist() == [21.5]

    def test_odometry_of_poses_alone_is_a_mistake(self, tmp_path):
        times = [START_NS + k * MS for k in range(5)]
        messages = [("/odom", ODOMETRY, t, odometry(t, 0, 0, posed(k))) for k, t in enumerate(times)]
        assert "is 0 throughout while the pose moves by 4.0 m" in told(
            read_bag, write_bag(tmp_path / "a", messages), YARD
        )

    def test_speed_to_the_side_is_noted(self, tmp_path):
        found = read_bag(write_bag(tmp_path / "bag", odom(3, side=-0.4)), YARD)
        assert "speed to the side, up to 0.40 m/s, is left out" in found.notes[0]

    def test_other_types_and_empty_topics_are_named(self, tmp_path):
        messages = [*odom(2), ("/talk", TEXT, START_NS, make(TEXT, "hello")), ("/imu", IMU, 0, None)]
        found = read_bag(write_bag(tmp_path / "bag", messages), YARD)
        assert [(t.name, t.kind, t.messages, dict(t.rows)) for t in found.topics] == [
            ("/imu", IMU, 0, {}),
            ("/odom", ODOMETRY, 2, {"odometry": 2}),
            ("/talk", TEXT, 1, {}),
        ]
        assert found.notes == ("/imu has no messages",)

    def test_nothing_that_can_be_used_is_a_mistake(self, tmp_path):
        bag = write_bag(tmp_path / "bag", [("/range/B1", RANGE, START_NS, ranged(START_NS, np.inf, "tag"))])
        assert "no message of it can be used (/range/B1: 1 infinite: nothing in reach)" in told(read_bag, bag, YARD)


class TestWhose:
    @pytest.mark.parametrize(
        ("topic", "frame", "pair"),
        [
            ("/uwb", "B3", ("B3", "M1")),
            ("/uwb/B3/range", "tag", ("B3", "M1")),
            ("/uwb/B3", "anchors/B2", ("B2", "M1")),  # the frame goes first
        ],
    )
    def test_names_tell_the_pair(self, tmp_path, topic, frame, pair):
        found = read_bag(write_bag(tmp_path / "bag", [(topic, RANGE, START_NS, ranged(START_NS, 4, frame))]), YARD)
        assert found.ranges is not None
        assert (*found.ranges.emitter, *found.ranges.receiver) == pair

    def test_one_topic_of_many_frames(self, tmp_path):
        messages = [("/uwb", RANGE, START_NS + k, ranged(START_NS + k, 4, f"B{1 + k % 4}")) for k in range(8)]
        found = read_bag(write_bag(tmp_path / "bag", messages), YARD)
        assert found.ranges is not None
        assert found.ranges.emitter == ("B1", "B2", "B3", "B4") * 2

    def test_what_names_do_not_tell_is_asked(self, tmp_path):
        messages = [("/uwb", RANGE, START_NS + k, ranged(START_NS + k, 4, frame)) for k, frame in enumerate("ab")]
        text = told(read_bag, write_bag(tmp_path / "bag", messages), YARD).splitlines()
        assert len(text) == 2
        assert text[0].startswith(
            'bag: /uwb, header.frame_id = "a": of which beacon and which microphone does this tell?'
        )
        assert '[[topic]] name = "/uwb" frame = "a" from = "…" to = "…"' in text[0]

    def test_a_map_tells_it(self, tmp_path):
        messages = [("/uwb", RANGE, START_NS + k, ranged(START_NS + k, 4, frame)) for k, frame in enumerate("abc")]
        bag = write_bag(tmp_path / "bag", [*messages, *odom(2), *odom(2, "/wheels")])
        assert "/odom: /wheels tells odometry.csv of agv as well" in told(
            read_bag, bag, YARD, TopicMap(YARD, [Rule("/uwb", emitter="B1")])
        )
        (tmp_path / "map.toml").write_text(
            """
            [[topic]]
            name = "/uwb"
            to = "M1"
            [[topic]]
            name = "/uwb"
            frame = "a"
            from = "B1"
            [[topic]]
            name = "/uwb"
            frame = "b"
            from = "B4"
            [[topic]]
            name = "/uwb"
            frame = "c"
            as = []
            [[topic]]
            name = "/wheels"
            as = "truth"
            """
        )
        found = read_bag(bag, YARD, read_map(tmp_path / "map.toml", YARD))
        assert found.ranges is not None
        assert found.ranges.emitter == ("B1", "B4")
        assert set(found.tables) == {"odometry"}
        assert set(found.truth) == {"agv"}

    def test_several_robots(self, tmp_path):
        messages = [m for r in ("r1", "r2") for m in odom(2, f"/{r}/odom", child="base_link")]
        messages += odom(2, "/third", child="r3/base_link")
        messages += [("/r1/range", RANGE, START_NS, ranged(START_NS, 5, "r2"))]
        text = told(read_bag, write_bag(tmp_path / "bag", messages), ROBOTS)
        assert text.count("\n") == 0
        assert "/r1/range, header.frame_id" in text  # sent by r2, heard by r2? that robot does not hear itself
        rules = TopicMap(ROBOTS, [Rule("/r1/range", receiver="r1")])
        found = read_bag(tmp_path / "bag", ROBOTS, rules)
        assert found.ranges is not None
        assert (found.ranges.emitter, found.ranges.receiver) == (("r2",), ("r1",))
        assert found.tables["odometry"].names["vehicle"] == ("r1", "r2", "r3") * 2

    def test_mistakes_of_a_map_are_told_at_once(self, tmp_path):
        (tmp_path / "map.toml").write_text(
            'size = 1\n[[topic]]\nname = "/odom"\nvehicel = "agv"\nvehicle = "agw"\n'
            '[[topic]]\nframe = 3\nas = "odometri"\n[[topic]]\nname = "/odom"\n'
        )
        lines = told(read_map, tmp_path / "map.toml", YARD).splitlines()
        assert lines == [
            "map.toml: size: unknown key; a map is a list of [[topic]]",
            'map.toml: topic 1 vehicel = "agv": unknown key; did you mean vehicle?',
            'map.toml: topic 1 vehicle = "agw": the site has no [[vehicle]] of this id; did you mean agv?',
            "map.toml: topic 2 frame = 3: must be text in quotation marks",
            'map.toml: topic 2 name: name the topic, such as "/odom"',
            'map.toml: topic 2 as = "odometri": no file that a topic can become; did you mean odometry?',
            'map.toml: topic 3 name = "/odom": stands there twice; join the two',
        ]

    def test_rules_that_do_not_fit_the_bag_are_told(self, tmp_path):
        bag = write_bag(tmp_path / "bag", odom(2))
        text = told(read_bag, bag, YARD, TopicMap(YARD, [Rule("/odm")], "m.toml"))
        assert text == 'm.toml: topic 1 name = "/odm": the bag has no such topic; did you mean /odom?'
        text = told(read_bag, bag, YARD, TopicMap(YARD, [Rule("/odom", uses=("imu",))], "m.toml"))
        assert text == 'm.toml: topic 1 as = "imu": nav_msgs/msg/Odometry can be odometry or truth'


def test_other_encodings_are_told(tmp_path):
    from mcap.writer import Writer

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/Range", "jsonschema", b"{}")
        channel = writer.register_channel("/range", "json", schema)
        writer.add_message(channel, START_NS, b"{}", START_NS)
        writer.finish()
    text = told(read_bag, tmp_path / "a.mcap", YARD)
    assert text == 'a.mcap: /range, encoding = "json": cannot be read; ROS 2 writes its messages as cdr'
