"""Timing side by side, and tables."""

from __future__ import annotations

import io
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True, slots=True)
class Beside:
    """A job and its floor (or peer): the best time of each in s, and the median of their ratios, turn by turn."""

    job_s: float
    floor_s: float
    ratio: float


def beside(job: Callable[[], object], floor: Callable[[], object], turns: int) -> Beside:
    """Time two jobs in turns, so that whatever else the machine does falls on both alike; one turn warms up."""
    job()
    floor()
    times = np.array([(once(job), once(floor)) for _ in range(turns)])
    return Beside(float(times[:, 0].min()), float(times[:, 1].min()), float(np.median(times[:, 0] / times[:, 1])))


def in_turns(jobs: Mapping[str, Callable[[], object]], turns: int) -> dict[str, np.ndarray]:
    """Time several jobs in turns, as `beside` does two: the times of each, s (turns,)."""
    for job in jobs.values():
        job()
    times = np.array([[once(job) for job in jobs.values()] for _ in range(turns)])
    return dict(zip(jobs, times.T, strict=True))


def once(job: Callable[[], object]) -> float:
    """Return the wall time of one call, s."""
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def machine() -> str:
    """Name the machine as far as figures depend on it."""
    return (
        f"{os.cpu_count()} cores, {platform.machine().replace('_', '-')}, Python {platform.python_version()}, "
        f"NumPy {np.__version__}, one BLAS thread"
    )


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a Markdown table under a heading."""
    print(f"\n### {title}\n")
    print("| " + " | ".join(columns) + " |")
    print("|" + "---|" * len(columns))
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)


@contextmanager
def renew(page: Path | None, program: str) -> Iterator[None]:
    """Show what is printed and, where a page is given, put it between that program's marks there once all is done.

    Raises
    ------
    ValueError
        If the page lacks the marks; before anything is printed.
    """
    begin, end = f"<!-- printed by {program} -->\n", f"<!-- end of {program} -->"
    if page is not None and (begin not in page.read_text("utf-8") or end not in page.read_text("utf-8")):
        raise ValueError(f"{page}: has no lines {begin.strip()!r} and {end!r}; add them where the tables belong")
    both = _Both()
    with redirect_stdout(both):
        yield
    if page is not None:
        before, rest = page.read_text("utf-8").split(begin, 1)
        page.write_text(before + begin + both.getvalue().lstrip("\n") + end + rest.split(end, 1)[1], "utf-8")


class _Both(io.StringIO):
    """What is printed, kept and shown."""

    def __init__(self) -> None:
        super().__init__()
        self._screen = sys.stdout

    def write(self, text: str) -> int:
        self._screen.write(text)
        self._screen.flush()
        return super().write(text)


def milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"


def millimetres(length_m: float) -> str:
    return f"{1e3 * length_m:.2f} mm"


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
