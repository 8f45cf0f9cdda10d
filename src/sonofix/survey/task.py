"""What a survey asks of its rows: the unknowns that all share, what is known of them, and how rows count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.survey.rows import Drive, Guess, show

CAUCHY = 2.4
"""Residuals in deviations beyond which a row's pull weakens: 95 % efficient where errors are Gaussian."""


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What is asked: the rows, which unknowns all share, and what is known of these.

    Attributes
    ----------
    drive : Drive
    movable : int64 (M,)
        Fixed ends that may move, by index in ``drive.names``.
    bias : int64 (n, 2)
        Each row's bias that is asked for, and that which the site states a doubt of; −1: none.
    mean, information : float64 (g,)
        What is known before of the shared unknowns: movable places (3 M), biases, excess of the sound speed, clock (3,
        if common). Excess of information 0: nothing.
    gauge : float64 (g, d)
        Directions that nothing determines, orthonormal: they are held.
    """

    drive: Drive
    movable: NDArray[np.int64]
    bias: NDArray[np.int64]
    mean: Floats
    information: Floats
    gauge: Floats

    @property
    def biases(self) -> int:
        """Number of biases."""
        return int(self.bias.max(initial=-1)) + 1

    @property
    def asked(self) -> int:
        """Number of biases that are asked for: the first ones."""
        return int(self.bias[:, 0].max(initial=-1)) + 1

    @property
    def poses(self) -> int:
        """Number of unknowns of all vehicles' poses."""
        return int(np.sum(np.where(np.isnan(self.drive.level_m), 3, 2) + self.drive.turns))

    @property
    def followed(self) -> int:
        """Number of unknowns that ranges must tell: poses, places of movable ends and biases asked for."""
        return self.poses + 3 * len(self.movable) + self.asked

    def shared(self, guess: Guess) -> Floats:
        """Shared unknowns (g,) of a guess."""
        clock = guess.clock if self.drive.common_clock else np.zeros(0)
        return np.concatenate([guess.place_m[self.movable].ravel(), guess.bias_m, [guess.excess], clock])

    def moved(self, guess: Guess, states: Floats, shared: Floats) -> Guess:
        """Return a guess with steps added to its states (s, 11) and shared unknowns."""
        place, m = guess.place_m.copy(), 3 * len(self.movable)
        place[self.movable] += shared[:m].reshape(-1, 3)
        biases = self.biases
        clock = guess.clock + (shared[m + biases + 1 :] if self.drive.common_clock else 0.0)
        return Guess(
            guess.states + states,
            place,
            guess.bias_m + shared[m : m + biases],
            guess.excess + float(shared[m + biases]),
            clock,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """Deviations of ranges and rates as a stage takes them: ``(n,)`` each, and whether rows pull robustly."""

    range_sd_m: Floats
    rate_sd_mps: Floats
    robust: bool
    used: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Where the adjustment came to rest.

    ``information`` (g, g): Schur complement for the shared unknowns, of data and motion alone; ``residual`` (2, n):
    measured less shown, ranges and rates; ``used`` (n,); ``chi2``; ``degrees``; ``scale``: factors found on the stated
    deviations of ranges and of rates.
    """

    guess: Guess
    information: Floats
    residual: Floats
    used: NDArray[np.bool_]
    chi2: float
    degrees: int
    scale: tuple[float, float]


def residuals(task: Task, guess: Guess) -> Floats:
    """Measured less shown (2, n): ranges and range rates (NaN where there are none)."""
    shown = show(task.drive, guess, task.bias)
    return np.stack([task.drive.range_m, task.drive.rate_mps]) - shown.value


def weights(task: Task, residual: Floats, scale: Scale) -> Floats:
    """Information (2, n) that each measurement counts with; 0 where there is none."""
    sd = np.stack([scale.range_sd_m, scale.rate_sd_mps])
    z = residual / sd
    there = np.isfinite(z) & scale.used
    weight = np.where(there, sd**-2.0, 0.0)
    if scale.robust:
        weight = weight / (1.0 + np.where(there, z / CAUCHY, 0.0) ** 2)
    return np.where(there, weight, 0.0)
