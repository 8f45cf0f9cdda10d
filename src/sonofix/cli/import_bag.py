"""`sonofix import`: a rosbag2 or MCAP recording in, the files of a recording folder out."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import Stopped, counted, print_table, progress_bar, speaker, stop_if_asked

if TYPE_CHECKING:
    from sonofix.files.bag_import import Imported


class Clock(StrEnum):
    """Which times rows stand at."""

    stamp = "stamp"
    received = "received"


def import_bag(
    bag: Annotated[Path, typer.Argument(help="Bag: a rosbag2 folder, or a .mcap or .db3 file.")],
    folder: Annotated[Path, typer.Argument(help="Recording folder to write into; made where there is none.")],
    site: Annotated[
        Path | None,
        typer.Option(help="Site file of a new recording. [default: the site.toml in the folder]"),
    ] = None,
    topic_map: Annotated[
        Path | None, typer.Option("--map", help="TOML file that says what topics are and whose, where names do not.")
    ] = None,
    clock: Annotated[
        Clock, typer.Option(help="Times of rows: header stamps, or when the recorder received the messages.")
    ] = Clock.stamp,
    zero: Annotated[
        str | None,
        typer.Option(help="The instant that becomes time 0, s since 1970. [default: that of the earliest message]"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
) -> None:
    """Bring a robot's bag into a recording: ranges, odometry, inertial sensors and, if asked for, truth.

    Needs no ROS, but the extra: pip install 'sonofix[robotics]'. For example, a drive, and then its track:

    sonofix import drive_bag hall --site hall.toml

    sonofix run hall

    Read are nav_msgs/Odometry, sensor_msgs/Imu and sensor_msgs/Range. A frame or a part of a topic's name that is the
    id of a vehicle, beacon or microphone tells whose it is. For all else there is --map, a file such as

    [[topic]]  name = "/uwb/a1"  from = "B1"  to = "M1"

    [[topic]]  name = "/mocap/pose"  as = "truth"  vehicle = "agv"

    with each key on its own line; as = [] leaves a topic out.
    """
    from sonofix import files
    from sonofix.files.bag_import import read_bag
    from sonofix.files.bag_map import read_map
    from sonofix.files.import_writing import site_of_import, write_import, zero_of_import

    site_file = site_of_import(folder, site)
    plan = files.read_site(site_file)
    topics = None if topic_map is None else read_map(topic_map, plan)
    zero_ns = zero_of_import(folder) if zero is None else _nanoseconds(zero)
    try:
        with progress_bar() as bar:
            task = bar.add_task(bag.name, total=None)

            def on_message(count: int) -> None:
                bar.update(task, completed=count)
                stop_if_asked()

            imported = read_bag(bag, plan, topics, clock=clock.value, zero_ns=zero_ns, on_message=on_message)
        written = write_import(folder, imported, site_file, force=force)
    except KeyboardInterrupt:
        raise Stopped("stopped; nothing was written") from None
    _summarise(imported)
    speaker().print(f"Written to {folder}: {', '.join(written)}")


def _nanoseconds(text: str) -> int:
    """Read seconds as nanoseconds, exactly."""
    from decimal import Decimal

    try:
        return int((Decimal(text) * 1_000_000_000).to_integral_value())
    except (ArithmeticError, ValueError):
        raise ValueError(f"--zero {text}: must be seconds since 1970, such as 1700000000.25") from None


def _summarise(imported: Imported) -> None:
    rows = {}
    for topic in imported.topics:
        became = ", ".join(f"{stem}.csv {count}" for stem, count in topic.rows.items()) or "not read"
        left_out = ", ".join(f"{count} {reason}" for reason, count in topic.left_out.items())
        rows[topic.name] = (topic.kind, str(topic.messages), became, left_out)
    print_table(imported.source, ("type", "messages", "rows of", "left out"), rows)
    times = [table.columns["time_s"] for table in imported.tables.values()]
    times += [truth.time_s for truth in imported.truth.values()]
    times += [] if imported.ranges is None else [imported.ranges.time_s]
    length_s = max(float(t[-1]) for t in times) - min(float(t[0]) for t in times)
    speaker().print(f"{counted(sum(map(len, times)), 'row')} over {length_s:.3f} s")
    for note in imported.notes:
        speaker().print(f"Note: {note}.")
