"""What every study is made of: work that can be stopped between two runs, and figures with their standard errors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from sonofix.records import Finding, Floats, Sheet

BATCH = 25
"""Runs computed together: enough for whole-array arithmetic, few enough to stop between."""


class Work(Protocol):
    """A study in progress: `work` does a piece at a time, `sheet` shows what is finished."""

    def work(self) -> Iterator[tuple[str, float]]:
        """Compute, and yield after each piece what was worked at and the share of that which is done."""
        ...

    def sheet(self) -> Sheet | None:
        """Return what the finished pieces show, None before the first."""
        ...


def batches(runs: int) -> Iterator[range]:
    """Yield the numbers of all runs in batches."""
    for first in range(0, runs, BATCH):
        yield range(first, min(first + BATCH, runs))


def rms(errors: Floats, case: str, quantity: str, unit: str, claim: str = "") -> Finding:
    """Root mean square over runs, with its standard error.

    Runs are independent while errors within one are not, so the error comes from the runs' own mean squares qᵢ:
    rms = √(mean q), and by the delta method its deviation is sd(q) / (2 rms √n).

    Parameters
    ----------
    errors : float64 (runs, …)
        NaN where there is none.
    case, quantity, unit, claim : str
        As in `Finding`.
    """
    squares = np.nanmean(np.reshape(errors, (len(errors), -1)) ** 2, axis=1)
    value = float(np.sqrt(np.mean(squares)))
    sd = None if len(squares) < 2 or not value else float(np.std(squares, ddof=1) / np.sqrt(len(squares)) / 2 / value)
    return Finding(case, quantity, value, sd, unit, len(squares), claim)


def percentile(errors: Floats, percent: float, case: str, quantity: str, unit: str, claim: str = "") -> Finding:
    """Percentile of all errors (runs, …) together; its standard error from the runs' own percentiles."""
    own = np.nanpercentile(np.reshape(errors, (len(errors), -1)), percent, axis=1)
    sd = None if len(own) < 2 else float(np.std(own, ddof=1) / np.sqrt(len(own)))
    return Finding(case, quantity, float(np.nanpercentile(errors, percent)), sd, unit, len(own), claim)


def share(holds: Floats, case: str, quantity: str, claim: str = "") -> Finding:
    """Share of instants (runs, n) at which something holds (1, else 0), with its standard error over runs."""
    own = holds.mean(axis=1)
    sd = None if len(own) < 2 else float(np.std(own, ddof=1) / np.sqrt(len(own)))
    return Finding(case, quantity, float(own.mean()), sd, "", len(own), claim)
