"""Faulty rows left out: while the χ² test fails, and only where leaving rows out mends it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sonofix.locate.rows import Rows
from sonofix.locate.solve import Solution, solve

FALSE_ALARM = 1e-5
"""Of the χ² test, per epoch."""

MOST_PAIRS = 66
"""Pairs of rows tried as both faulty: all of twelve rows."""

APART_SIGMA = 6.0
"""Two selections that both pass the test but put the vehicle this far apart leave the fault undecided."""


def exclude(
    solver: Rows, rows: NDArray[np.int64], found: list[Solution]
) -> tuple[NDArray[np.int64], list[Solution], bool]:
    """Leave out one row, or two, so that the rest agree; one row stays to check by.

    Where no such choice makes the rest agree within their deviations, rows are left out one by one as long as each
    halves the misfit per degree of freedom.

    Returns
    -------
    rows, found : what is left and its solutions
    isolated : bool
        False where different choices mend the test alike but disagree on the position.
    """
    if agrees(solver, rows, found[0]) or len(rows) <= solver.needed + 1:
        return rows, found, True
    for count in (1, 2):
        if len(rows) - count <= solver.needed or (count == 2 and len(rows) * (len(rows) - 1) // 2 > MOST_PAIRS):
            break
        passing = [(s, fewer) for s, fewer in _without(solver, rows, found[0], count) if agrees(solver, fewer, s)]
        if passing:
            passing.sort(key=lambda trial: trial[0].chi2)
            best, fewer = passing[0]
            again = solver.candidates(fewer)
            if again:
                return fewer, again, not any(_apart(best, other) for other, _ in passing[1:])
    return *_one_by_one(solver, rows, found), True


def agrees(solver: Rows, rows: NDArray[np.int64], solution: Solution) -> bool:
    """Whether the misfit of rows is what their deviations allow (true where none is left over to tell)."""
    from scipy.special import chdtri

    dof = solver.count(rows) - solution.jacobian.shape[1]
    return dof <= 0 or solution.chi2 <= float(chdtri(dof, FALSE_ALARM))


def _without(
    solver: Rows, rows: NDArray[np.int64], best: Solution, count: int
) -> Iterator[tuple[Solution, NDArray[np.int64]]]:
    """Solve again without each choice of ``count`` rows."""
    for left_out in combinations(range(len(rows)), count):
        fewer = np.delete(rows, left_out)
        try:
            yield solve(solver.problem(fewer), best.pose, best.clock_m), fewer
        except np.linalg.LinAlgError:
            continue


def _apart(a: Solution, b: Solution) -> bool:
    size = np.sqrt(np.sum(a.jacobian**2, axis=0))
    deviation = float(np.max(1.0 / np.maximum(size, 1e-9)))
    return bool(np.linalg.norm(a.pose[:3] - b.pose[:3]) > APART_SIGMA * deviation)


def _one_by_one(
    solver: Rows, rows: NDArray[np.int64], found: list[Solution]
) -> tuple[NDArray[np.int64], list[Solution]]:
    while len(rows) > solver.needed + 1 and not agrees(solver, rows, found[0]):
        best = found[0]
        dof = solver.count(rows) - best.jacobian.shape[1]
        each = solver.count(rows) // len(rows)
        trials = list(_without(solver, rows, best, 1))
        if not trials:
            break
        mended, fewer = min(trials, key=lambda trial: trial[0].chi2)
        again = solver.candidates(fewer)
        if not again or mended.chi2 / max(1, dof - each) > 0.5 * best.chi2 / dof:
            break
        rows, found = fewer, again
    return rows, found
