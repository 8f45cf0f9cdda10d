"""Faulty rows left out: while the χ² test fails, and only where leaving rows out mends it."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sonofix.locate.integrity import FALSE_ALARM, threshold
from sonofix.locate.rows import Rows, Solution
from sonofix.records import Floats

MOST_PAIRS = 66
"""Pairs of rows tried as both faulty: all of twelve rows."""

MOST_ANEW = 12
"""Choices that are solved from new starts: those that agree best by a descent from the faulty fix."""

APART_SIGMA = 6.0
"""Two selections that both pass the test but put the vehicle this far apart leave the fault undecided: so many
deviations of the better one's position, along its widest axis."""

MENDED = 1e-4
"""Rows that agree worse than this once a row is left out have hardly been mended: two wrong ones may look like one."""


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
    if agrees(solver, len(rows), found[0].chi2) or len(rows) <= solver.needed + 1:
        return rows, found, True
    tried: list[tuple[NDArray[np.int64], Floats, Floats]] = []
    for count in (1, 2):
        if len(rows) - count <= solver.needed or (count == 2 and len(rows) * (len(rows) - 1) // 2 > MOST_PAIRS):
            break
        choices = _leaving(rows, count)
        place_m, chi2 = solver.without(choices, found[0])
        for i in np.argsort(chi2, kind="stable")[:MOST_ANEW]:
            # a descent from where the faulty row drew the fix may end in a wrong valley: begin anew without it, for
            # the true choice to gainsay another that agrees by chance
            anew = solver.candidates(choices[i])
            if anew and anew[0].chi2 < chi2[i]:
                chi2[i], place_m[i] = anew[0].chi2, anew[0].position_m
        tried.append((choices, place_m, chi2))
        mended = _mended(solver, choices, place_m, chi2, MENDED)
        if mended is not None:
            return mended
    for choices, place_m, chi2 in tried:
        mended = _mended(solver, choices, place_m, chi2, FALSE_ALARM)
        if mended is not None:
            return mended
    return *_one_by_one(solver, rows, found), True


def agrees(solver: Rows, count: int, chi2: float) -> bool:
    """Whether the misfit of so many rows is what their deviations allow.

    Where none is left over to tell, noise may still put circles apart that ought to meet, along one axis.
    """
    return chi2 <= threshold(max(1, solver.degrees(count)))


def _mended(
    solver: Rows, choices: NDArray[np.int64], place_m: Floats, chi2: Floats, rate: float
) -> tuple[NDArray[np.int64], list[Solution], bool] | None:
    """Return the choice whose rows agree best, if they do at a false-alarm rate, and whether no rival gainsays it."""
    best, degrees = int(np.argmin(chi2)), solver.degrees(choices.shape[1])
    if not chi2[best] <= threshold(degrees, rate):
        return None
    again = solver.candidates(choices[best])
    if not again:
        return None
    gap_m = np.linalg.norm(place_m[chi2 <= threshold(degrees)] - place_m[best], axis=1)
    return choices[best], again, not np.any(gap_m > APART_SIGMA * _place_sd_m(solver, again[0]))


def _place_sd_m(solver: Rows, found: Solution) -> float:
    """Deviation of the position along its widest axis, all else being unknown too; 0 where a direction is open."""
    covariance = solver.covariance(found)
    if covariance is None:
        return 0.0
    places = 2 if solver.level_m is not None else 3
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:places, :places])[-1]))


def _leaving(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Rows without each choice of ``count`` of them (choices, n − count)."""
    left_out = list(combinations(range(len(rows)), count))
    keep = np.ones((len(left_out), len(rows)), bool)
    keep[np.arange(len(left_out))[:, None], left_out] = False
    return np.broadcast_to(rows, keep.shape)[keep].reshape(len(left_out), -1)


def _one_by_one(
    solver: Rows, rows: NDArray[np.int64], found: list[Solution]
) -> tuple[NDArray[np.int64], list[Solution]]:
    while len(rows) > solver.needed + 1 and not agrees(solver, len(rows), found[0].chi2):
        choices = _leaving(rows, 1)
        _, chi2 = solver.without(choices, found[0])
        best = int(np.argmin(chi2))
        again = solver.candidates(choices[best])
        before = found[0].chi2 / solver.degrees(len(rows))
        if not again or chi2[best] / max(1, solver.degrees(len(rows) - 1)) > 0.5 * before:
            break
        rows, found = choices[best], again
    return rows, found
