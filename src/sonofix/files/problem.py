"""Mistakes in what a user gave: each names file, field, value and remedy, and all are told at once."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

LONGEST_VALUE = 60


@dataclass(frozen=True, slots=True)
class Problem:
    """One mistake.

    Attributes
    ----------
    file : str
        Name of the file, as inside its folder.
    field : str
        Where in the file: a key, or a row and column; empty where the file as a whole is meant.
    value : object
        What came; None where nothing did.
    remedy : str
        What would be right, in one sentence.
    """

    file: str
    field: str
    value: object
    remedy: str

    def __str__(self) -> str:
        """Return the mistake in one line."""
        where = f"{self.file}: {self.field}" if self.field else self.file
        if self.value is None:
            return f"{where}: {one_line(self.remedy)}"
        return f"{where} = {shown(self.value)}: {one_line(self.remedy)}"


class RecordingError(Exception):
    """A recording, or what was asked of it, holds mistakes.

    Attributes
    ----------
    problems : tuple of Problem
        All of them, in the order of the files.
    """

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(map(str, self.problems)))


def one_line(text: str) -> str:
    """Return the text with line breaks and control characters made spaces."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def shown(value: object) -> str:
    """Return a value as a user wrote it, in one line of bounded length."""
    text = repr(value) if not isinstance(value, str) else '"' + one_line(value) + '"'
    if isinstance(value, bool):
        text = str(value).lower()
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 1] + "…"


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """Return "did you mean x?" where a known word is near, else the known words."""
    plain = {name.lower(): name for name in known}
    near = difflib.get_close_matches(word.lower(), plain, n=1, cutoff=0.6)
    return f"did you mean {plain[near[0]]}?" if near else f"known are {', '.join(known)}"
