"""`sonofix run`: a recording in, ranges, fixes, track and a picture out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import Stopped, counted, drawing, print_table, progress_bar, speaker, stop_if_asked, watched

if TYPE_CHECKING:
    from rich.progress import Progress

    from sonofix.cli.tally import Tally
    from sonofix.records import Recording, Step

# A picture of more epochs than this looks the same, and would hold a long run in memory.
_MOST_DRAWN = 5000


def run(
    recording: Annotated[
        Path, typer.Argument(help="Recording folder: site.toml, and samples, ranges, exchanges or positions.")
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder to write to. [default: out/ in the recording]")
    ] = None,
    plot: Annotated[bool, typer.Option(help="Draw track.png.")] = True,
    rate: Annotated[
        float | None, typer.Option(help="Rows of track.csv a second (Hz). [default: one an epoch]", min=1e-3, max=1e4)
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Smooth the track, once all is read: each row knows what came after it.")
    ] = False,
    lag: Annotated[
        float | None,
        typer.Option(help="Smooth on the way, looking this far ahead (s); rows leave so much later.", min=0.0),
    ] = None,
    graph: Annotated[
        bool, typer.Option("--graph", help="Smooth by a factor graph (needs gtsam: the extra graph).")
    ] = False,
    hold: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="What shall not calibrate itself: sound-speed, clock-drift, odometry-scale, odometry-bias, "
            "step-length, step-heading, gyro-bias, range-scale, range-bias or pair-bias; may be given several times.",
        ),
    ] = None,
) -> None:
    """Turn a recording into ranges, fixes, a track and a picture.

    \b
    sonofix run FOLDER                  the track as it was known at each moment
    sonofix run FOLDER --smooth         the best track afterwards, by all of the recording
    sonofix run FOLDER --lag 5          the same on the way, five seconds late
    sonofix run FOLDER --smooth --rate 20
    sonofix run FOLDER --hold odometry-scale --hold range-bias
    """
    if hold:
        from sonofix.track.held import places

        places(hold, None)
    if graph:
        require_gtsam()
        if lag is not None:
            raise ValueError("--graph smooths a whole recording, --lag looks ahead by some seconds: leave out either")
    run_folder(recording, out or recording / "out", plot, rate, smooth or graph, lag, graph, tuple(hold or ()))


def require_gtsam() -> None:
    """Raise where gtsam is not installed, before anything is run.

    Raises
    ------
    ValueError
        That names the extra.
    """
    from importlib.util import find_spec

    if find_spec("gtsam") is None:
        raise ValueError("--graph needs gtsam: pip install 'sonofix[graph]', or smooth with --smooth alone")


def run_folder(
    folder: Path,
    out: Path,
    plot: bool,
    rate_hz: float | None,
    smooth: bool = False,
    lag_s: float | None = None,
    graph: bool = False,
    held: tuple[str, ...] = (),
) -> None:
    """Run a recording folder, write everything to `out`, and print the summary.

    The causal track is written on the way, and replaced at the end where it is to be smoothed as a whole.

    Raises
    ------
    RecordingError
        With all mistakes of the recording, or where `out` cannot be written to.
    ValueError
        If the recording holds no epoch, or ``held`` names what nothing calibrates.
    Stopped
        After Ctrl-C, outputs closed.
    """
    from sonofix import files, flow
    from sonofix.cli.tally import Tally
    from sonofix.files.oddities import unused

    recording = files.read_recording(folder, to_run=True)
    truths = files.read_truth(folder)
    tally, sample = Tally(recording.site), _Sample(_MOST_DRAWN)
    whole = smooth and lag_s is None
    steps: list[Step] = []
    try:
        with progress_bar() as bar:
            watched, on_step = _watched(recording, bar)
            stopped: list[bool] = []
            found = _heeded(flow.run(watched, rate_hz, held), None if lag_s is None else stopped)
            if lag_s is not None:
                found = flow.smoothed(recording, found, rate_hz, lag_s, held=held)
            keep = steps.append if whole else sample.add
            files.write_run(out, _seen(found, tally.add, keep, on_step), recording.site)
            if stopped:
                raise KeyboardInterrupt
            if whole and steps:
                on_epoch = _smoothing(bar, len(steps))
                steps = list(flow.smoothed(recording, steps, rate_hz, graph=graph, on_epoch=on_epoch, held=held))
                files.write_track(out, steps, recording.site)
    except KeyboardInterrupt:
        kept = f"{out} holds the first {counted(tally.epochs, 'epoch')}" if tally.epochs else "nothing was kept"
        kept += ", not smoothed" if whole and tally.epochs else ""
        raise Stopped(f"stopped; {kept}") from None
    if whole:
        tally = Tally(recording.site)
        for step in steps:
            tally.add(step)
            sample.add(step)
    picture = out / "track.png"
    picture.unlink(missing_ok=True)
    if not tally.epochs:
        raise ValueError(f"{folder}: holds no whole epoch{_length(recording)}; record at least one burst to its end")
    _summarise(folder, out, tally, scored=bool(truths))
    for line in unused(recording):
        speaker().print(f"Note: {line}")
    if plot:
        _draw(picture, recording, sample.steps(), truths)
    speaker().print(f"Written to {out}")


def _watched(recording: Recording, bar: Progress) -> tuple[Recording, Callable[[Step], None]]:
    """Return the recording with its samples counted as they are read, and what counts rows where it has none."""
    name = recording.site.name
    if recording.blocks is None:
        rows = 0 if recording.ranges is None else len(recording.ranges.time_s)
        task = bar.add_task(name, total=rows or None)
        return recording, lambda step: bar.advance(task, len(step.ranges))
    task = bar.add_task(name, total=recording.sample_count)
    return watched(recording, lambda count: bar.advance(task, count)), lambda step: None


def _smoothing(bar: Progress, epochs: int) -> Callable[[], None]:
    """Show a bar of its own for smoothing; return what counts an epoch of one of its passes."""
    from sonofix.track.smooth import PASSES

    task = bar.add_task("smoothing", total=PASSES * epochs)

    total = PASSES * epochs

    def count() -> None:
        nonlocal total
        bar.advance(task)
        if bar.tasks[bar.task_ids.index(task)].completed >= total:
            # where several sizes of errors are likely, each is smoothed by itself
            total += PASSES * epochs
            bar.update(task, total=total)
        stop_if_asked()

    return count


def _seen(steps: Iterator[Step], *watchers: Callable[[Step], None]) -> Iterator[Step]:
    """Pass steps on; each watcher is shown a step once it has been written."""
    for step in steps:
        yield step
        for watcher in watchers:
            watcher(step)


def _heeded(steps: Iterator[Step], stopped: list[bool] | None) -> Iterator[Step]:
    """Pass steps on until Ctrl-C, which goes on as it came; or into a list where steps that wait are to leave first."""
    try:
        for step in steps:
            yield step
            stop_if_asked()
    except KeyboardInterrupt:
        if stopped is None:
            raise
        stopped.append(True)


class _Sample:
    """A fair sample of a run's steps, of bounded size (Vitter 1985, algorithm R), for the picture.

    Every step is as likely to be kept as any other, so that beacons that take turns are all seen.
    """

    def __init__(self, most: int) -> None:
        import numpy as np

        self._most, self._count = most, 0
        self._kept: list[tuple[int, Step]] = []
        self._rng = np.random.default_rng(0)

    def add(self, step: Step) -> None:
        """Show it the next step."""
        place = int(self._rng.integers(self._count + 1))
        if self._count < self._most:
            self._kept.append((self._count, step))
        elif place < self._most:
            self._kept[place] = (self._count, step)
        self._count += 1

    def steps(self) -> list[Step]:
        """Return the kept steps in their order."""
        return [step for _, step in sorted(self._kept, key=lambda kept: kept[0])]


def _length(recording: Recording) -> str:
    if recording.sample_count is None or not recording.rate_hz:
        return ""
    return f" (it is {recording.sample_count / recording.rate_hz:.3g} s long)"


def _summarise(folder: Path, out: Path, tally: Tally, scored: bool) -> None:
    from sonofix.cli.score import score_run, track_rows

    vehicles = tally.vehicles
    print_table(f"{tally.name}: {tally.headline()}", vehicles or ("",), tally.rows())
    if scored:
        found = score_run(folder, out)
        if found.track:
            rows = track_rows(found.track)
            keep = ("position error, rms", "95 % within", "height error, rms", "heading error, rms", "inside 2 sd")
            rows = {name: rows[name] for name in (*keep, "NEES of x, y (2 is right)")}
            print_table("Against the truth", tuple(found.track), rows)
        if found.ranges is not None and found.ranges.used.count:
            from sonofix.cli.console import length_text

            used = found.ranges.used
            speaker().print(
                f"Ranges used, against the truth: rms {length_text(used.rms_m)}, {used.beyond_5cm} beyond 5 cm"
            )
    for line in tally.remarks():
        speaker().print(line)


def _draw(picture: Path, recording: Recording, steps: list[Step], truths: dict) -> None:
    """Draw the picture; say so where Matplotlib is not installed."""
    with drawing():
        from sonofix.draw.track import draw_track

        draw_track(recording, steps, truths).savefig(picture)
