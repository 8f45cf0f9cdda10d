"""A track as ROS 2 messages in an MCAP file, as robots' tools and viewers read it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from sonofix.files.bag import needed
from sonofix.files.problem import Problem, RecordingError
from sonofix.files.results import by_vehicle, column
from sonofix.files.track_tables import positions, quaternions, velocities
from sonofix.files.writing import write_whole
from sonofix.records import Floats, Table

POSE, VELOCITY = "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/Vector3Stamped"

LAST_NS = 2**31 * 1_000_000_000
"""The seconds of a ROS 2 stamp are an int32."""

ANY_ANGLE_RAD2 = np.pi**2 / 3
"""The variance of an angle of which nothing is known."""


def write_mcap(path: Path, track: Table, zero_ns: int, frame: str) -> int:
    """Write a track: for each vehicle poses with covariance on `/ID/pose`, and velocities on `/ID/velocity`.

    Both stand in the world's ``frame``. Covariances are diagonal, as the track states them: of a position on a known
    level the height's is 0, an angle that is not known has the variance of any, and where no deviation is stated all
    are 0, which says "unknown".

    Parameters
    ----------
    path : Path
    track : Table
    zero_ns : int
        The instant of time 0, ns since 1970.
    frame : str
        ``header.frame_id``.

    Returns
    -------
    int
        Messages written.

    Raises
    ------
    RecordingError
        Where it cannot be written, or a time lies before 1970 or after 2038.
    ValueError
        If rosbags and mcap are not installed.
    """
    with needed():
        from mcap.writer import Writer
        from rosbags.typesys import Stores, get_typestore
    first = float(track.columns["time_s"].min())
    if zero_ns + round(first * 1e9) < 0:
        remedy = "MCAP knows no times before 1970; say with --start when time 0 was"
        raise RecordingError([Problem(path.name, "time_s", first, remedy)])
    last = float(track.columns["time_s"].max())
    if zero_ns + round(last * 1e9) >= LAST_NS:
        raise RecordingError([Problem(path.name, "time_s", last, "ROS knows no times after January 2038; see --start")])
    store = get_typestore(Stores.ROS2_JAZZY)
    topics = _topics(dict.fromkeys(track.names["vehicle"]))
    messages: list[tuple[int, str, str, Any]] = []
    for vehicle, rows in by_vehicle(track):
        messages += _messages(store, rows, topics[vehicle], zero_ns, frame)
    messages.sort(key=lambda message: message[0])

    def make(part: Path) -> None:
        with part.open("wb") as file:
            writer = Writer(file)
            writer.start(profile="ros2", library="sonofix")
            channels: dict[str, int] = {}
            for kind in (POSE, VELOCITY):
                text = store.generate_msgdef(kind, ros_version=2)[0]
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                for topic in dict.fromkeys(topic for _, topic, other, _ in messages if other == kind):
                    channels[topic] = writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": ""})
            for time_ns, topic, kind, message in messages:
                writer.add_message(channels[topic], time_ns, bytes(store.serialize_cdr(message, kind)), time_ns)
            writer.finish()

    write_whole(path, make)
    return len(messages)


def _topics(vehicles: dict[str, None]) -> dict[str, str]:
    """Return each vehicle's part of topic names, of the signs that ROS allows there, no two alike."""
    topics: dict[str, str] = {}
    for vehicle in vehicles:
        name = re.sub(r"[^A-Za-z0-9_]", "_", vehicle)
        name = name if name[:1].isalpha() else f"v{name}"
        while name in topics.values():
            name += "_"
        topics[vehicle] = name
    return topics


def _messages(store: Any, track: Table, topic: str, zero_ns: int, frame: str) -> list[tuple[int, str, str, Any]]:
    types = store.types
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    vector = types["geometry_msgs/msg/Vector3"]
    place, turn, covariance = positions(track), quaternions(track), _covariances(track)
    velocity = velocities(track)
    made = []
    for i, time_s in enumerate(track.columns["time_s"].tolist()):
        # a float64 of seconds since 1970 would be off by a tenth of a microsecond
        time_ns = zero_ns + round(time_s * 1e9)
        head = header(stamp(*divmod(time_ns, 1_000_000_000)), frame)
        if np.all(np.isfinite(place[i])):
            pose = types["geometry_msgs/msg/Pose"](
                types["geometry_msgs/msg/Point"](*place[i].tolist()),
                types["geometry_msgs/msg/Quaternion"](*turn[i].tolist()),
            )
            both = types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance[i].ravel())
            made.append((time_ns, f"/{topic}/pose", POSE, types[POSE](head, both)))
        if np.all(np.isfinite(velocity[i])):
            made.append((time_ns, f"/{topic}/velocity", VELOCITY, types[VELOCITY](head, vector(*velocity[i].tolist()))))
    return made


def _covariances(track: Table) -> Floats:
    """Return covariances of x, y, z and turns about x, y, z, (n, 6, 6)."""
    names = ("sd_x_m", "sd_y_m", "sd_z_m", "sd_roll_rad", "sd_pitch_rad", "sd_yaw_rad")
    variance = np.column_stack([column(track, name) ** 2 for name in names])
    unknown = np.isnan(variance[:, :2]).any(axis=1)
    variance[:, 2] = np.nan_to_num(variance[:, 2], nan=0.0)
    variance[:, 3:] = np.nan_to_num(variance[:, 3:], nan=ANY_ANGLE_RAD2)
    variance[unknown] = 0.0
    full = np.zeros((len(variance), 6, 6))
    full[:, range(6), range(6)] = variance
    return full
