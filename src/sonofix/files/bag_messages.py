"""The messages of one topic as columns of numbers, and when each was measured on the recorder's clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sonofix.files.bag import Topic
from sonofix.files.problem import Problem, RecordingError
from sonofix.records import Floats

Clock = Literal["stamp", "received"]

DAY_NS = 86_400_000_000_000
MOST_STRAY = 0.1
BACKWARDS_NS = 1_000_000_000

_PLACE = ("x", "y", "z", "qx", "qy", "qz", "qw")
FIELDS: Mapping[str, tuple[str, ...]] = {
    "nav_msgs/msg/Odometry": ("v", "side", "yaw_rate", *_PLACE),
    "sensor_msgs/msg/Imu": ("gx", "gy", "gz", "ax", "ay", "az", "qx", "qy", "qz", "qw"),
    "sensor_msgs/msg/Range": ("range", "least", "most", "variance"),
    "sensor_msgs/msg/Temperature": ("temperature",),
    "geometry_msgs/msg/PoseStamped": _PLACE,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _PLACE,
}


@dataclass(slots=True)
class Heard:
    """What came on one topic, in the order it was received: stamps (0: none), times of receipt, frames, numbers."""

    topic: Topic
    stamps_ns: list[int] = field(default_factory=list)
    received_ns: list[int] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)

    def take(self, file: str, received_ns: int, message: Any) -> None:
        """Add a message.

        Raises
        ------
        RecordingError
            Where it lacks a field of its standard type.
        """
        try:
            stamp = message.header.stamp
            # body frames name the vehicle; poses are stated in a world's
            frame = message.child_frame_id if self.topic.kind.endswith("/Odometry") else message.header.frame_id
            row = _READ[self.topic.kind](message)
            self.stamps_ns.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        except AttributeError as error:
            remedy = f"the bag's {self.topic.kind} is not the standard one: {error}"
            raise RecordingError([Problem(file, self.topic.name, None, remedy)]) from None
        self.received_ns.append(received_ns)
        self.frames.append(frame)
        self.rows.append(row)

    def columns(self) -> dict[str, Floats]:
        """Return the numbers by name, (n,) each."""
        names = FIELDS[self.topic.kind]
        table = np.array(self.rows, np.float64).reshape(-1, len(names))
        return {name: table[:, i] for i, name in enumerate(names)}


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """When the messages of a topic were measured: ``time_ns`` (n,), and which to keep, ``keep`` (n,).

    ``lag_ns`` is the median time from measurement to receipt.
    """

    time_ns: NDArray[np.int64]
    keep: NDArray[np.bool_]
    lag_ns: int
    notes: tuple[str, ...]


def timed(file: str, heard: Heard, clock: Clock) -> Timed:
    """Judge the stamps of a topic.

    A topic that is never stamped has its times of receipt. A stamp further from the topic's median stamp than a day and
    ten times the recording's length is of a clock that was not set yet, and is not kept.

    Raises
    ------
    RecordingError
        Where a tenth of the stamps or more are such, or where the clock was set back by more than a second.
    """
    name = heard.topic.name
    received, stamps = np.array(heard.received_ns, np.int64), np.array(heard.stamps_ns, np.int64)
    every = np.ones(len(stamps), bool)
    if clock == "received":
        return Timed(received, every, 0, ())
    if not np.any(stamps):
        return Timed(received, every, 0, (f"{name} has no stamps: its times are those of receipt",))
    usual = int(np.median(stamps))
    keep = np.abs(stamps - usual) <= DAY_NS + 10 * int(np.ptp(received))
    notes: list[str] = []
    if not np.all(keep):
        count, first = np.count_nonzero(~keep), int(stamps[~keep][0])
        told = f"{count} of {len(keep)} stamps are far from the others ({seconds(usual)})"
        if count > MOST_STRAY * len(keep):
            remedy = f"{told}; if the sensor's clock was never set, --clock received takes times of receipt"
            raise RecordingError([Problem(file, f"{name}, header.stamp", seconds(first), remedy)])
        notes.append(f"{name}: {told}, such as {seconds(first)}; those messages are left out")
    order = np.argsort(received[keep], kind="stable")
    sequence = stamps[keep][order]
    steps = np.diff(sequence)
    back = np.flatnonzero(steps < 0)
    if len(back):
        worst = int(back[np.argmin(steps[back])])
        if steps[worst] < -BACKWARDS_NS:
            remedy = (
                f"is {-steps[worst] / 1e9:.3f} s before the message before: the clock was set back; "
                "cut the bag there, or take times of receipt with --clock received"
            )
            value = seconds(int(sequence[worst + 1]))
            raise RecordingError([Problem(file, f"{name}, header.stamp", value, remedy)])
        notes.append(
            f"{name}: {len(back)} of {len(sequence)} messages came after a later stamp; rows are sorted by stamp"
        )
    return Timed(stamps, keep, int(np.median(received[keep] - stamps[keep])), tuple(notes))


def seconds(time_ns: int) -> str:
    """Write a time as seconds since 1970, exactly."""
    sign, size = ("-" if time_ns < 0 else ""), abs(time_ns)
    return f"{sign}{size // 1_000_000_000}.{size % 1_000_000_000:09d}"


def yaw_rad(columns: Mapping[str, Floats]) -> Floats:
    """Return the heading of quaternions, ZYX angles; NaN where one is not of length 1 to a hundredth."""
    x, y, z, w = (columns[name] for name in ("qx", "qy", "qz", "qw"))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    length = np.sqrt(x * x + y * y + z * z + w * w)
    return np.where(np.abs(length - 1) < 0.01, yaw, np.nan)


def _odometry(message: Any) -> tuple[float, ...]:
    twist = message.twist.twist
    return twist.linear.x, twist.linear.y, twist.angular.z, *_pose(message.pose.pose)


def _imu(message: Any) -> tuple[float, ...]:
    """A first covariance of −1 says that the sensor does not measure this (sensor_msgs/Imu)."""

    def given(covariance: Any, *values: float) -> tuple[float, ...]:
        return values if covariance[0] != -1 else (math.nan,) * len(values)

    rate, pull, turn = message.angular_velocity, message.linear_acceleration, message.orientation
    return (
        *given(message.angular_velocity_covariance, rate.x, rate.y, rate.z),
        *given(message.linear_acceleration_covariance, pull.x, pull.y, pull.z),
        *given(message.orientation_covariance, turn.x, turn.y, turn.z, turn.w),
    )


def _range(message: Any) -> tuple[float, ...]:
    # the variance came with Iron; 0 means that it is not known
    return message.range, message.min_range, message.max_range, getattr(message, "variance", 0.0)


def _pose(pose: Any) -> tuple[float, ...]:
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


_READ: Mapping[str, Callable[[Any], tuple[float, ...]]] = {
    "nav_msgs/msg/Odometry": _odometry,
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/Range": _range,
    "sensor_msgs/msg/Temperature": lambda message: (message.temperature,),
    "geometry_msgs/msg/PoseStamped": lambda message: _pose(message.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: _pose(message.pose.pose),
}
