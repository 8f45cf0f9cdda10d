"""The normal equations of a survey.

States only touch their neighbours in time, so their part is banded; it is eliminated by a banded Cholesky factor, and
what all rows share is left: a small dense system, the Schur complement (Triggs et al., "Bundle adjustment", 2000,
section 6.1), whose inverse is the covariance of what a survey asks for.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from sonofix.records import Floats
from sonofix.survey.motion import chain
from sonofix.survey.rows import STATE, Guess, Shown, show
from sonofix.survey.task import Scale, Task, weights

HELD = 1e-7
"""Deviation, in m, by which the frame is held where nothing else holds it: takes no part in what fits."""


MOST_AT_ONCE = 4_000_000
"""Numbers that one product of derivatives may hold."""


def motion_residuals(task: Task, guess: Guess) -> tuple[Floats, Floats]:
    """Whitened residuals of ties between states (m, 11) and of states by themselves (s, 11)."""
    known = chain(task.drive)
    one, two = guess.states[known.first], guess.states[known.then].copy()
    two[:, 9] = one[:, 9] + (two[:, 9] - one[:, 9] + np.pi) % (2 * np.pi) - np.pi
    tied = np.einsum("mij,mj->mi", known.before, one) + np.einsum("mij,mj->mi", known.after, two)
    return tied, known.root * (guess.states - known.target)


class Normal:
    """Normal equations at a guess: the states' banded part A, its coupling W with shared unknowns, and theirs S."""

    def __init__(self, task: Task, guess: Guess, scale: Scale) -> None:
        drive = task.drive
        self._free = chain(drive).free
        self._k, self._states = len(self._free), len(guess.states)
        self._gauge = task.gauge
        shown = show(drive, guess, task.bias)
        residual = np.stack([drive.range_m, drive.rate_mps]) - shown.value
        weight = weights(task, residual, scale)
        residual = np.where(weight > 0, residual, 0.0)
        g, k = len(task.mean), self._k
        by_shared = _by_shared(task, shown)
        blocks, pull = np.zeros((self._states, k, k)), np.zeros((self._states, k))
        coupling = np.zeros((self._states, k, g))
        self._s = np.diag(task.information)
        self._shared_pull = -task.information * (task.shared(guess) - task.mean)
        rows = np.flatnonzero(drive.state >= 0)
        starts = np.flatnonzero(np.diff(drive.state[rows], prepend=-1)) if len(rows) else rows
        for at in range(2):
            if not weight[at].any():
                continue
            weighed = weight[at][:, None] * by_shared[at]
            self._s = self._s + weighed.T @ by_shared[at]
            self._shared_pull = self._shared_pull + weighed.T @ residual[at]
            if len(rows):
                own = shown.by_state[at][np.ix_(rows, self._free)]
                heavy = own * weight[at][rows, None]
                owners = drive.state[rows][starts]
                blocks[owners] += np.add.reduceat(heavy[:, :, None] * own[:, None, :], starts)
                pull[owners] += np.add.reduceat(heavy * residual[at][rows, None], starts)
                # so many columns at once as stay small beside the rest
                step = max(1, MOST_AT_ONCE // max(heavy.size, 1))
                for first in range(0, g, step):
                    touched = by_shared[at][rows, first : first + step]
                    both = heavy[:, :, None] * touched[:, None, :]
                    coupling[owners, :, first : first + step] += np.add.reduceat(both, starts)
        self._w, self._pull = coupling.reshape(-1, g), pull
        self._band = np.zeros((2 * k, self._states * k))
        self._tie(task, guess, blocks)

    def _tie(self, task: Task, guess: Guess, blocks: Floats) -> None:
        """Add what ties states to each other and to what vehicles do; lay A out as upper bands."""
        known = chain(task.drive)
        tied, own = motion_residuals(task, guess)
        k, free = self._k, self._free
        root = known.root[:, free]
        blocks[:, np.arange(k), np.arange(k)] += root**2
        self._pull = self._pull - root * own[:, free]
        beyond = np.zeros((self._states, k, k))
        before, after = known.before[:, :, free], known.after[:, :, free]
        # a state is followed, and follows, once at most
        blocks[known.first] += np.einsum("mij,mil->mjl", before, before)
        blocks[known.then] += np.einsum("mij,mil->mjl", after, after)
        beyond[known.first] = np.einsum("mij,mil->mjl", before, after)
        self._pull[known.first] -= np.einsum("mij,mi->mj", before, tied)
        self._pull[known.then] -= np.einsum("mij,mi->mj", after, tied)
        top = 2 * k - 1
        column = k * np.arange(self._states)
        for i in range(k):
            for j in range(k):
                if j >= i:
                    self._band[top + i - j, column + j] = blocks[:, i, j]
                if self._states > 1:
                    self._band[top + i - (k + j), column[1:] + j] = beyond[:-1, i, j]

    def solve(self, damping: float) -> tuple[Floats, Floats] | None:
        """Return the step of states (s, 11) and of shared unknowns (g,); None where the system is not positive."""
        band = self._band.copy()
        band[-1] *= 1.0 + damping
        s = self._s + self._gauge @ self._gauge.T / HELD**2
        s = s + np.diag(damping * np.diag(s) + 1e-12 * max(1.0, float(np.trace(s))) / max(1, len(s)))
        full = np.zeros((self._states, STATE))
        try:
            if not self._states:
                return full, cho_solve(cho_factor(s), self._shared_pull)
            factor = cholesky_banded(band, check_finite=False)
            solved = cho_solve_banded((factor, False), np.column_stack([self._w, self._pull.ravel()]))
            reduced = s - self._w.T @ solved[:, :-1]
            step = cho_solve(cho_factor((reduced + reduced.T) / 2), self._shared_pull - self._w.T @ solved[:, -1])
        except np.linalg.LinAlgError:
            return None
        full[:, self._free] = (solved[:, -1] - solved[:, :-1] @ step).reshape(self._states, self._k)
        return full, step

    def schur(self) -> Floats:
        """Information (g, g) on shared unknowns, states eliminated, with what is known before."""
        if not self._states:
            return self._s
        band = self._band.copy()
        band[-1] *= 1.0 + 1e-12
        solved = cho_solve_banded((cholesky_banded(band), False), self._w)
        reduced = self._s - self._w.T @ solved
        return (reduced + reduced.T) / 2


def _by_shared(task: Task, shown: Shown) -> Floats:
    """Derivatives (2, n, g) by the shared unknowns."""
    drive = task.drive
    n, places = len(drive), 3 * len(task.movable)
    out = np.zeros((2, n, len(task.mean)))
    slot = np.full(len(drive.names), -1)
    slot[task.movable] = np.arange(len(task.movable))
    mine = slot[drive.point]
    rows = np.flatnonzero(mine >= 0)
    for axis in range(3):
        out[:, rows, 3 * mine[rows] + axis] = shown.by_place[:, rows, axis]
    for bias in task.bias.T:
        rows = np.flatnonzero(bias >= 0)
        out[0, rows, places + bias[rows]] = 1.0
    out[:, :, places + task.biases] = shown.by_excess
    if drive.common_clock:
        out[:, :, places + task.biases + 1 :] = shown.by_clock
    return out
