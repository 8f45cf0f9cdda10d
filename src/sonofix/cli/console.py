"""What all commands share in speaking to the user: lines, lengths, tables, progress, and how a stop is told."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console
    from rich.progress import Progress

    from sonofix.records import Recording


class Stopped(KeyboardInterrupt):
    """Ctrl-C after the outputs were closed; the message says what was kept."""


_asked_to_stop: list[int] = []


def heed_ctrl_c() -> None:
    """Remember Ctrl-C as well as raise it: loops that are just being compiled lose the exception on its way."""
    import signal

    def stop(number: int, _frame: object) -> None:
        _asked_to_stop.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, stop)


def stop_if_asked() -> None:
    """Raise a Ctrl-C that was lost.

    Raises
    ------
    KeyboardInterrupt
    """
    if _asked_to_stop:
        raise KeyboardInterrupt


def speaker() -> Console:
    """Return a console on stdout that prints text as it is."""
    from rich.console import Console

    console = Console(highlight=False, markup=False, soft_wrap=True)
    if not console.is_terminal:
        console.width = 160  # a file or pipe has no edge at which a table should break
    return console


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Open a bar on stderr that vanishes at the end; nothing is shown where stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=40),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield bar


def watched(recording: Recording, seen: Callable[[int], None]) -> Recording:
    """Return the recording with its samples counted as they are read; as it is where it has none."""
    blocks = recording.blocks
    if blocks is None:
        return recording

    def counted_blocks(length: int) -> Iterator[NDArray[np.float32]]:
        for block in blocks(length):
            yield block
            seen(len(block))

    return replace(recording, blocks=counted_blocks)


@contextmanager
def drawing() -> Iterator[None]:
    """Import what draws, and draw, within; where Matplotlib is not installed that is said and the rest goes on."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or not error.name.startswith("matplotlib"):
            raise
        speaker().print("No picture: drawing needs Matplotlib; pip install 'sonofix[plot]', or run with --no-plot")


def print_table(title: str, columns: Sequence[str], rows: Mapping[str, Sequence[str]]) -> None:
    """Print a table: a name and a figure for each column a row; rows without any figure are left out."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    heading = Text(title, style="bold")
    table = Table(title=heading, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("", no_wrap=True)
    for column in columns:
        table.add_column(Text(column), justify="right", no_wrap=True)
    for name, cells in rows.items():
        if any(cells):
            table.add_row(Text(name), *(Text(cell) for cell in cells))
    say = speaker()
    say.print()
    say.print(table)


def length_text(length_m: float | None) -> str:
    """Write a length to three figures in the unit in which it reads well; empty where it is not known."""
    if length_m is None:
        return ""
    size = abs(length_m)
    factor, unit = (1e3, "mm") if size < 0.2 else (1e2, "cm") if size < 1.0 else (1.0, "m")
    value = length_m * factor
    digits = 0 if abs(value) >= 99.95 else 1 if abs(value) >= 9.995 else 2
    return f"{value:.{digits}f} {unit}"


def figure_text(value: float | None, form: str, unit: str = "") -> str:
    """Write a figure in the given format with its unit; empty where it is not known."""
    return "" if value is None else f"{value:{form}} {unit}".rstrip()


def counted(count: int, name: str) -> str:
    """Write a count with its noun: "1 epoch", "3 epochs"."""
    return f"{count} {name}" + ("" if count == 1 else "s")
