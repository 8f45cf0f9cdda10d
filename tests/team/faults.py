"""Faults for made-up fleets: what is stated of them is made wrong."""

from dataclasses import replace

import numpy as np

from sonofix.records import Recording, Table
from sonofix.team.feed import gather
from team.made_fleet import watched


def with_start(recording: Recording, truth: dict[str, np.ndarray], off: dict[int, tuple[float, float, float]]):
    """Return the recording with start poses, those of some robots ``off`` by x, y and heading."""
    starts = np.array([rows[0, 1:] for rows in truth.values()])
    for robot, by in off.items():
        starts[robot] += by
    table = Table(dict(zip(("x_m", "y_m", "yaw_rad"), starts.T, strict=True)), {"vehicle": tuple(truth)})
    return replace(recording, tables={**recording.tables, "start": table})


def with_compass(recording: Recording, truth: dict[str, np.ndarray], from_north: tuple[str, ...]):
    """Return the recording with compasses that err by 0.03 rad, those of some robots clockwise from north."""
    rng = np.random.default_rng(0)
    time_s, heading, whose = [], [], []
    for name, rows in truth.items():
        told = rows[::5, 3] + rng.normal(0, 0.03, len(rows[::5]))
        time_s.append(rows[::5, 0])
        heading.append(np.angle(np.exp(1j * (np.pi / 2 - told if name in from_north else told))))
        whose += [name] * len(told)
    columns = {"time_s": np.concatenate(time_s), "heading_rad": np.concatenate(heading)}
    return replace(recording, tables={**recording.tables, "compass": Table(columns, {"vehicle": tuple(whose)})})


def with_longer(recording: Recording, landmark: str, by_m: float):
    """Return the recording with one landmark's ranges too long."""
    heard = recording.ranges
    assert heard is not None
    wrong = np.array([name == landmark for name in heard.emitter])
    return replace(recording, ranges=replace(heard, range_m=heard.range_m + by_m * wrong))


def followed(recording: Recording):
    """Return the moments of a recording, the filter's means, its last belief and its feed."""
    feed = gather(recording)
    return *watched(feed), feed


def told(moments) -> list[tuple[str, str]]:
    """Return events other than that robots have joined, with whom they are of."""
    return [(e.event, e.vehicle) for m in moments for e in m.events if e.event != "joined"]
