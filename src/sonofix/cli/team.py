"""`sonofix team`: robots that place each other, as one team or each by itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import (
    Stopped,
    counted,
    drawing,
    length_text,
    print_table,
    progress_bar,
    speaker,
    stop_if_asked,
    watched,
)

if TYPE_CHECKING:
    from rich.progress import Progress

    from sonofix.records import Floats, Recording, Step
    from sonofix.team.belief import Moment
    from sonofix.team.feed import Feed
    from sonofix.team.tell import Listened


def team(
    recording: Annotated[Path, typer.Argument(help="Recording folder of several vehicles with odometry.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder to write to. [default: out/ in the recording]")
    ] = None,
    landmarks_of: Annotated[
        list[str] | None,
        typer.Option(help="Vehicle that hears landmarks; the others hear peers alone. Can be repeated. [default: all]"),
    ] = None,
    odometry_alone: Annotated[
        bool, typer.Option("--odometry-alone", help="Listen until all are placed; then drive by odometry alone.")
    ] = False,
    decentralised: Annotated[
        bool, typer.Option("--decentralised", help="Each robot by itself, by messages of those it meets.")
    ] = False,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Smooth, once all is read: each row knows what came after it.")
    ] = False,
    plot: Annotated[bool, typer.Option(help="Draw team.png.")] = True,
    animate: Annotated[Path | None, typer.Option(help="Draw how it went as an animation: a .gif file.")] = None,
) -> None:
    """Place a team of robots by odometry, landmarks and each other; draw tracks and roles.

    \b
    sonofix team FOLDER                          all robots at once, as known at each moment
    sonofix team FOLDER --smooth                 by all of the recording
    sonofix team FOLDER --landmarks-of robot1    one hears landmarks, the others are carried by it
    sonofix team FOLDER --decentralised          each by its own sensors and others' messages
    sonofix team FOLDER --animate team.gif
    """
    if smooth and decentralised:
        raise ValueError("--smooth looks at all robots at once, --decentralised at each by itself: leave out either")
    if smooth and odometry_alone:
        raise ValueError("--odometry-alone leaves nothing to smooth by: leave out either")
    if odometry_alone and decentralised:
        raise ValueError("--odometry-alone sends no messages: leave out either it or --decentralised")
    if animate is not None and animate.suffix.lower() != ".gif":
        raise ValueError(f"--animate: {animate}; the file's name must end in .gif")
    _run(recording, out or recording / "out", landmarks_of, odometry_alone, decentralised, smooth, plot, animate)


def _run(
    folder: Path,
    out: Path,
    landmarks_of: list[str] | None,
    odometry_alone: bool,
    decentralised: bool,
    smooth: bool,
    plot: bool,
    animate: Path | None,
) -> None:
    import numpy as np

    from sonofix import files
    from sonofix.team.feed import heard_by
    from sonofix.team.instants import instants
    from sonofix.team.tell import steps_of

    recording = files.read_recording(folder, to_run="bearings" not in _stems(folder))
    _check(recording, landmarks_of)
    _check_clock(recording)
    truths = files.read_truth(folder)
    kept: list[Step] = []
    moments: list[Moment] = []
    means: list[Floats] = []
    try:
        with progress_bar() as bar:
            feed, receiver = _feed(recording, bar)
            if landmarks_of:
                feed = heard_by(feed, landmarks_of)
                if not len(feed.time_s):
                    raise ValueError(f"--landmarks-of {', '.join(landmarks_of)}: then nothing at all is heard")
            task = bar.add_task(recording.site.name or "team", total=len(instants(feed)))

            def seen() -> Iterator[Moment]:
                from sonofix.team.apart import follow_apart
                from sonofix.team.fleet import follow

                behind = None
                found = follow_apart(feed) if decentralised else follow(feed, odometry_alone)
                for moment, behind in found:
                    moments.append(moment)
                    if smooth:
                        means.append(behind.mean.copy())  # pyright: ignore[reportAttributeAccessIssue]
                    bar.advance(task)
                    stop_if_asked()
                    yield moment
                last.append(behind)

            last: list = []

            def steps() -> Iterator[Step]:
                for step in steps_of(feed, seen(), receiver=receiver):
                    kept.append(step)
                    yield step

            files.write_run(out, steps(), recording.site)
            if smooth and last and last[0] is not None:
                from sonofix.team.smooth import PASSES
                from sonofix.team.smooth import smooth as smoothed

                again = bar.add_task("smoothing", total=PASSES * len(moments))

                def passed() -> None:
                    bar.advance(again)
                    stop_if_asked()

                moments = smoothed(feed, moments, last[0], np.array(means), on_moment=passed)
                kept = list(steps_of(feed, moments, smoothed=True, receiver=receiver))
                files.write_run(out, kept, recording.site)
    except KeyboardInterrupt:
        held = f"{out} holds the first {counted(len(kept), 'moment')}" if kept else "nothing was kept"
        raise Stopped(f"stopped; {held}" + (", not smoothed" if smooth and kept else "")) from None
    picture = out / "team.png"
    picture.unlink(missing_ok=True)
    _summarise(folder, out, feed, moments, kept, scored=bool(truths), smoothed=smooth)
    if decentralised and last and last[0] is not None:
        from sonofix.team.message import BYTES

        speaker().print(f"{last[0].told} messages of {BYTES} bytes")
    if plot:
        with drawing():
            from sonofix.draw.team import draw_team

            draw_team(recording, kept, truths).savefig(picture)
    if animate is not None and not any(step.estimates for step in kept):
        speaker().print("No animation: no robot was placed")
    elif animate is not None:
        with drawing():
            from sonofix.draw.team_film import write_film
            from sonofix.files.writing import write_whole

            def film(part: Path) -> None:
                with part.open("wb") as file:
                    write_film(file, recording, kept, truths)

            write_whole(animate, film)
            speaker().print(f"Animation: {animate}")
    speaker().print(f"Written to {out}")


def _stems(folder: Path) -> set[str]:
    return {path.stem for path in folder.glob("*.csv")} if folder.is_dir() else set()


def _check(recording: Recording, landmarks_of: list[str] | None) -> None:
    ids = [vehicle.id for vehicle in recording.site.vehicles]
    if len(ids) < 2:
        raise ValueError(
            f"site.toml: holds {counted(len(ids), 'vehicle')}; a team has two or more; for one: sonofix run"
        )
    for name in landmarks_of or ():
        if name not in ids:
            raise ValueError(f"--landmarks-of {name}: no vehicle of the site; it has {', '.join(ids)}")


def _check_clock(recording: Recording) -> None:
    """Raise ValueError where ranges hold an unknown offset, which robots' filters have no state for."""
    site = recording.site
    if site.clock_known or (recording.blocks is None and recording.ranges is None):
        return
    free = site.schedule is not None and not site.schedule.synchronised
    field = "schedule.synchronised = false" if free else "beacon.code.distance_m is not stated"
    made = "those of samples" if recording.blocks is not None else "ranges.csv"
    raise ValueError(
        f"site.toml: {field}, so ranges ({made}) are known but for an offset, and a team needs whole ones; "
        + ("set it to true where no offset is left, give exchanges.csv alone, " if free else "state it, ")
        + "let robots range each other two-way (own_clocks = true), or run it with: sonofix run"
    )


def _feed(recording: Recording, bar: Progress) -> tuple[Feed, Listened | None]:
    """Gather what the receiver makes of a recording's samples, or what it states: ranges, or else exchanges."""
    from sonofix import flow
    from sonofix.team.feed import gather
    from sonofix.team.tell import listened, ranges_of
    from sonofix.two_way import exchange_epochs

    if recording.blocks is not None:
        task = bar.add_task("listening", total=recording.sample_count)
        heard = list(flow.run(watched(recording, lambda count: bar.advance(task, count))))
        return gather(recording, ranges_of(step.ranges for step in heard), own_ranges=True), listened(heard)
    if recording.ranges is not None or "exchanges" not in recording.tables:
        return gather(recording), None
    epochs = list(exchange_epochs(recording.tables["exchanges"], recording.site))
    return gather(recording, ranges_of(epochs), own_ranges=all(epoch.sd_stated for epoch in epochs)), None


def _summarise(
    folder: Path, out: Path, feed: Feed, moments: list[Moment], kept: list[Step], scored: bool, smoothed: bool
) -> None:
    import numpy as np

    listener, source = feed.listener, feed.source
    used = np.concatenate([moment.used for moment in moments]) if moments else np.zeros((0, 2), bool)
    rows = np.concatenate([np.arange(*moment.rows) for moment in moments]).astype(int)
    rows_of = {"ranges used / not used": 0, "bearings used / not used": 1}
    measured = (np.isfinite(feed.range_m[rows]), np.isfinite(feed.bearing_rad[rows]) & (feed.kind[rows] == 0))
    table: dict[str, list[str]] = {"first placed": [], "sd of position (x, y), median": []}
    for name, column in rows_of.items():
        table[name] = []
        for robot in range(len(feed.robots)):
            own = ((listener[rows] == robot) | (source[rows] == robot)) & measured[column]
            table[name].append(f"{int(used[own, column].sum())} / {int((~used[own, column]).sum())}")
    for robot in range(len(feed.robots)):
        placed = [moment for moment in moments if moment.placed[robot]]
        table["first placed"].append(f"{placed[0].time_s:.1f} s" if placed else "never")
        sd = [float(np.sqrt(m.covariance[robot, 0, 0] + m.covariance[robot, 1, 1])) for m in placed]
        table["sd of position (x, y), median"].append(length_text(float(np.median(sd))) if sd else "")
    span = moments[-1].time_s - moments[0].time_s if moments else 0.0
    kind = "smoothed" if smoothed else "causal"
    never = [name for name, told in zip(feed.robots, table["first placed"], strict=True) if told == "never"]
    print_table(f"{counted(len(feed.robots), 'robot')} over {span:.0f} s, {kind}", feed.robots, table)
    if never:
        remedy = "state start poses (start.csv), or let them hear landmarks or robots that are placed"
        speaker().print(f"Never placed: {', '.join(never)}; {remedy}")
    if scored:
        from sonofix.cli.score import score_run, track_rows

        found = score_run(folder, out)
        if found.track:
            every = track_rows(found.track)
            keep = (
                "position error, rms",
                "95 % within",
                "heading error, rms",
                "inside 2 sd",
                "NEES of x, y (2 is right)",
            )
            print_table("Against the truth", tuple(found.track), {name: every[name] for name in keep})
    events = [event for step in kept for event in step.events]
    if events:
        from collections import Counter

        named = ", ".join(f"{count} {name}" for name, count in Counter(e.event for e in events).most_common())
        speaker().print(f"Events: {named} (events.csv)")
