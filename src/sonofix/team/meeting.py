"""What two robots that meet make of it: one's estimate corrected by the other's word, whatever they already share.

An error is split in two (Julier and Uhlmann 2001; Li and Nashashibi 2013): e = d + i, where d may be shared with others
to any degree and i is a robot's own. What a partner makes use of is no more than a few numbers, T e: after that,
others may share T e, and all that goes with it; what of i is not correlated with T i is still a robot's own. So what a
robot knows of its odometry, which others learn of through its place alone, mostly stays its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.team.hear import REFUSED
from sonofix.team.state import POSE
from sonofix.track.wheels import ROBUST

SHARES = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98)
"""Weights w of a robot's own estimate that are tried; the one that leaves its place best known is taken."""

GAIN = 0.8
"""The determinant of a pose's covariance must fall to so much of itself, or nothing is changed."""

LEAST = 1e-9
"""A share of what is told, below which nothing of it is a robot's own."""


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """An error's covariance (n, n), and the part of it that others may share; the rest is a robot's own."""

    whole: Floats
    shared: Floats

    def within(self, rows: Floats) -> Split:
        """Return what is so of some combinations ``rows`` (k, n) of it."""
        return Split(rows @ self.whole @ rows.T, rows @ self.shared @ rows.T)

    def widened(self, by: float) -> Floats:
        """Return the covariance with the part that may be shared so many times as large."""
        return self.whole + (by - 1.0) * self.shared

    def told(self, rows: Floats) -> Split:
        """Return the same error once combinations ``rows`` (k, n) of it are known to others."""
        own = self.whole - self.shared
        values, vectors = np.linalg.eigh(rows @ own @ rows.T)
        # what was told before is no more than rounding errors now
        new = values > LEAST * np.trace(rows @ self.whole @ rows.T)
        gain = own @ rows.T @ (vectors[:, new] / values[new]) @ vectors[:, new].T
        left = np.eye(len(own)) - gain @ rows
        return Split(self.whole, _even(self.whole - left @ own @ left.T))


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """What k numbers that were measured, of a robot and its partner, say of the robot.

    Attributes
    ----------
    off : float64 (k,)
        Measured less expected.
    rows : float64 (k, n)
        Derivatives by the robot's states.
    partner : Split
        Of what the partner's error makes of them (k, k).
    noise : float64 (k,)
        Their variances.
    bent : float64 (k, 2, 2)
        Second derivatives by where the two stand to each other, in m.
    place : Split
        Of the partner's place (2, 2).
    """

    off: Floats
    rows: Floats
    partner: Split
    noise: Floats
    bent: Floats
    place: Split


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """What a correction makes of a robot's error.

    Attributes
    ----------
    moved : float64 (n,)
        By how much its states move.
    left : float64 (n, n)
        What is left of the error there was.
    whole : float64 (n, n)
        The covariance now.
    """

    moved: Floats
    left: Floats
    whole: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What is made of what was heard: the correction, None where it brings too little or is refused.

    ``expected``, ``taken`` (k,): variances of its misses, by what both know, and of noise.
    """

    corrected: Corrected | None
    used: NDArray[np.bool_]
    expected: Floats
    taken: Floats


def judge(error: Split, heard: Heard) -> Judged:
    """Correct a robot by what was heard, which holds whatever it and its partner share.

    With w that leaves the pose best known, the shared part of its error is taken 1/w times as large and its partner's
    1/(1 − w); so is noise, as errors of a view last from one meeting to the next. It is widened besides by what a
    straight line misses, ½ tr(B S B S) with S the covariance of where the two stand to each other (Bar-Shalom, Li and
    Kirubarajan 2001, section 10.3.2).
    """
    best: tuple[float, float] | None = None
    for share in SHARES:
        whole, expected, noise = _widened(error, heard, share)
        across = whole[:POSE] @ heard.rows.T
        pose = whole[:POSE, :POSE] - across @ np.linalg.solve(expected + np.diag(noise), across.T)
        size = float(np.linalg.det(pose))
        if best is None or size < best[0]:
            best = size, share
    assert best is not None
    whole, expected, noise = _widened(error, heard, best[1])
    square = heard.off**2 / (np.diag(expected) + noise)
    if (square > REFUSED).any():
        return Judged(None, np.zeros(len(square), bool), np.diag(expected), noise)
    noise = noise * np.maximum(1.0, np.sqrt(square) / ROBUST)
    partner = expected - heard.rows @ whole @ heard.rows.T
    gain = np.linalg.solve(expected + np.diag(noise), heard.rows @ whole).T
    left = np.eye(len(whole)) - gain @ heard.rows
    new = _even(left @ whole @ left.T + gain @ (partner + np.diag(noise)) @ gain.T)
    judged = np.ones(len(square), bool), np.diag(expected), noise
    before = float(np.linalg.det(error.whole[:POSE, :POSE]))
    if float(np.linalg.det(new[:POSE, :POSE])) > GAIN * before:
        return Judged(None, *judged)
    return Judged(Corrected(gain @ heard.off, left, new), *judged)


def settle(error: Split, corrected: Corrected | None, partner_took: bool, rows: Floats) -> Split:
    """Return a robot's error after a meeting, at which its partner was told ``rows`` (k, n) of it, if that took them.

    What a correction brings in, noise too, is shared.
    """
    if partner_took:
        error = error.told(rows)
    if corrected is None:
        return error
    own = corrected.left @ (error.whole - error.shared) @ corrected.left.T
    return Split(corrected.whole, _even(corrected.whole - own))


def bends(dx: float, dy: float) -> Floats:
    """Return second derivatives (2, 2, 2) of range and bearing by where a source stands from its listener, in m."""
    square = max(dx * dx + dy * dy, 1e-6)
    along, across = np.array([dx, dy]) / np.sqrt(square), np.array([-dy, dx]) / np.sqrt(square)
    turned = np.outer(along, across) + np.outer(across, along)
    return np.array([np.outer(across, across) / np.sqrt(square), -turned / square])


def _widened(error: Split, heard: Heard, share: float) -> tuple[Floats, Floats, Floats]:
    """Return covariances of the robot's error and of the misses that both make, and variances of noise."""
    whole = error.widened(1.0 / share)
    expected = heard.rows @ whole @ heard.rows.T + heard.partner.widened(1.0 / (1.0 - share))
    apart = heard.bent @ (whole[:2, :2] + heard.place.widened(1.0 / (1.0 - share)))
    return whole, expected, heard.noise / (1.0 - share) + 0.5 * np.einsum("kij,kji->k", apart, apart)


def _even(square: Floats) -> Floats:
    return 0.5 * (square + square.T)
