"""Bags as robots record them, written by rosbags or mcap themselves, and a small site."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

START_NS = 1_700_000_000_000_000_000
ODOMETRY, IMU, RANGE = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "sensor_msgs/msg/Range"
POSE, STAMPED = "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseStamped"
TEMPERATURE, TEXT = "sensor_msgs/msg/Temperature", "std_msgs/msg/String"

SITE = """format = 1
[site]
name = "yard"
[origin]
latitude_deg = 48.1
longitude_deg = 11.6
height_m = 520.0
heading_rad = 0.3
# a comment that stays
[[vehicle]]
id = "agv"
z_m = 0.0
[[microphone]]
id = "M1"
vehicle = "agv"
lever_arm_m = [0.3, 0.1, 0.5]
""" + "".join(
    f'[[beacon]]\nid = "{name}"\nposition_m = {place}\n'
    for name, place in {"B1": [0, 0, 2.5], "B2": [12, 0, 2.4], "B3": [12, 9, 2.5], "B4": [0, 9, 2.3]}.items()
)

ENDS = ("beacon", "microphone")
TEAM = """format = 1
[site]
name = "team"
""" + "".join(
    f'[[vehicle]]\nid = "{r}"\nz_m = 0.0\n' + "".join(f'[[{k}]]\nid = "{r}"\nvehicle = "{r}"\n' for k in ENDS)
    for r in ("r1", "r2", "r3")
)

Message = tuple[str, str, int, Any]
"""Topic, type, time of receipt (ns), message."""


@cache
def store(distro: Stores = Stores.ROS2_JAZZY) -> Any:
    return get_typestore(distro)


def make(kind: str, *values: Any, distro: Stores = Stores.ROS2_JAZZY) -> Any:
    return store(distro).types[kind](*values)


def header(stamp_ns: int, frame: str) -> Any:
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000)), frame)


def vector(*values: float) -> Any:
    return make("geometry_msgs/msg/Vector3", *map(float, values))


def turned(yaw_rad: float) -> Any:
    return make("geometry_msgs/msg/Quaternion", 0.0, 0.0, float(np.sin(yaw_rad / 2)), float(np.cos(yaw_rad / 2)))


def posed(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw_rad: float = 0.0) -> Any:
    point = make("geometry_msgs/msg/Point", float(x), float(y), float(z))
    return make(
        "geometry_msgs/msg/PoseWithCovariance", make("geometry_msgs/msg/Pose", point, turned(yaw_rad)), zeros(36)
    )


def zeros(count: int) -> np.ndarray:
    return np.zeros(count)


def odometry(t_ns: int, v: float, rate: float, pose: Any = None, side: float = 0.0, child: str = "base_link") -> Any:
    twist = make("geometry_msgs/msg/Twist", vector(v, side, 0), vector(0, 0, rate))
    both = make("geometry_msgs/msg/TwistWithCovariance", twist, zeros(36))
    return make(ODOMETRY, header(t_ns, "odom"), child, pose or posed(), both)


def ranged(t_ns: int, range_m: float, frame: str, limits=(0.1, 50.0), variance: float | None = 0.0) -> Any:
    values = (header(t_ns, frame), 0, 0.1, *limits, float(range_m))
    if variance is None:
        return make(RANGE, *values, distro=Stores.ROS2_HUMBLE)
    return make(RANGE, *values, float(variance))


def imu(t_ns: int, gyro=(0.0, 0.0, 0.1), pull=(0.1, 0.0, 9.81), yaw: float | None = 0.5, measured=True) -> Any:
    unknown, known = np.array([-1.0] + [0.0] * 8), zeros(9)
    return make(
        IMU,
        header(t_ns, "imu_link"),
        turned(yaw or 0.0),
        known if yaw is not None else unknown,
        vector(*gyro),
        known if measured else unknown,
        vector(*pull),
        known if measured else unknown,
    )


def write_bag(
    path: Path, messages: list[Message], storage: str = "mcap", distro=Stores.ROS2_JAZZY, compressed=""
) -> Path:
    """Write a rosbag2 folder."""
    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compressed:
        writer.set_compression(CompressionMode[compressed], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, received_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store(distro))
            if message is not None:
                writer.write(connections[topic], received_ns, store(distro).serialize_cdr(message, kind))
    return path


def write_mcap(path: Path, messages: list[Message], index: bool = True, profile: str = "", chunk: int = 2000) -> Path:
    """Write a plain MCAP file, as other programs than rosbag2 do."""
    with path.open("wb") as file:
        writer = McapWriter(
            file,
            chunk_size=chunk,
            compression=CompressionType.LZ4,
            index_types=IndexType.ALL if index else IndexType.NONE,
            repeat_channels=index,
            repeat_schemas=index,
            use_statistics=index,
            use_summary_offsets=index,
        )
        writer.start(profile=profile)
        channels: dict[str, int] = {}
        for topic, kind, received_ns, message in messages:
            if topic not in channels:
                text = store().generate_msgdef(kind, ros_version=2)[0]
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], received_ns, bytes(store().serialize_cdr(message, kind)), received_ns)
        writer.finish()
    return path


def drive(seconds: float = 20.0, noise_m: float = 0.0, seed: int = 3) -> tuple[list[Message], dict[str, np.ndarray]]:
    """Messages of a drive round the yard of SITE, and its truth: time_s, x, y, yaw by name.

    Ranges of the four beacons in turn at 8 a second, odometry at 20, each message received 5 ms after its stamp.
    """
    rng = np.random.default_rng(seed)
    rate, v = 0.25, 0.9

    def pose(t: float) -> tuple[float, float, float]:
        yaw = rate * t
        return 6.0 + v / rate * np.sin(yaw), 1.0 + v / rate * (1 - np.cos(yaw)), yaw

    places = {"B1": (0, 0, 2.5), "B2": (12, 0, 2.4), "B3": (12, 9, 2.5), "B4": (0, 9, 2.3)}
    messages: list[Message] = []
    for k in range(round(20 * seconds) + 1):
        t_ns = START_NS + k * 50_000_000
        messages.append(("/odom", ODOMETRY, t_ns + 5_000_000, odometry(t_ns, v, rate, posed(*pose(k / 20)[:2]))))
    for k in range(round(8 * seconds) + 1):
        t, name = k / 8, list(places)[k % 4]
        x, y, yaw = pose(t)
        c, s = np.cos(yaw), np.sin(yaw)
        ear = np.array([x + 0.3 * c - 0.1 * s, y + 0.3 * s + 0.1 * c, 0.5])
        far = float(np.linalg.norm(ear - places[name])) + noise_m * rng.standard_normal()
        t_ns = START_NS + k * 125_000_000
        messages.append((f"/range/{name}", RANGE, t_ns + 5_000_000, ranged(t_ns, far, "uwb_tag", variance=noise_m**2)))
    messages.sort(key=lambda message: message[2])
    times = np.arange(0, seconds + 0.01, 0.05)
    return messages, dict(zip(("time_s", "x", "y", "yaw"), (times, *np.array([pose(t) for t in times]).T), strict=True))
