"""Leap-frog (third seed; Kurazume 1994): robots advance while most of them stand, placed by ranges among themselves.

One robot goes ahead, the others stand and are its landmarks; then it stands for them. What is known is kept as one
state, the places of all robots and a share k by which all ranges are too long (a wrong speed of sound), so that the
covariance holds what each leg hands on to the next. A range from i to j is (1 + k) |p_j − p_i| and noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from sonofix.locate.triangle import triangle
from sonofix.records import Floats
from sonofix.track.kernel import joseph

SETTLED_M = 1e-9
"""Iterations end when no place moves by more."""

MOST_ITERATIONS = 30

STRANGE = 1e-6
"""Chance of ranges so far from what is expected, below which a robot must have moved that should have stood."""

FLAT = 1e6
"""Condition of the start's equations beyond which places are open."""

Status = Literal["ok", "ambiguous", "flat", "no-triangle", "short-base", "contradicted"]
Pair = tuple[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Formation:
    """What is known of a team.

    Attributes
    ----------
    robots : tuple of str
    place_m : float64 (N, 2)
        In the frame that the start defined.
    scale : float
        The share k by which ranges are too long: above 0 where sound is slower than it was taken for.
    covariance : float64 (2 N + 1, 2 N + 1)
        Of x and y of each robot in turn, then of ``scale``.
    """

    robots: tuple[str, ...]
    place_m: Floats
    scale: float
    covariance: Floats

    def index(self, robot: str) -> int:
        """Return a robot's row; raise ValueError naming those there are."""
        if robot not in self.robots:
            raise ValueError(f"robot {robot}: the team has {', '.join(self.robots)}")
        return self.robots.index(robot)

    def covariance_m2(self, robot: str) -> Floats:
        """Covariance (2, 2) of one robot's place."""
        own = slice(2 * self.index(robot), 2 * self.index(robot) + 2)
        return self.covariance[own, own]

    def sd_m(self, robot: str) -> float:
        """Deviation of one robot's place, √(σx² + σy²)."""
        return float(np.sqrt(np.trace(self.covariance_m2(robot))))

    @property
    def scale_sd(self) -> float:
        """Deviation of ``scale``."""
        return float(np.sqrt(self.covariance[-1, -1]))

    def by_scale_m(self, robot: str) -> Floats:
        """How a robot's place errs with the scale, in m for an error of 1, (2,): the regression of one on the other.

        Zero where the scale is known.
        """
        own = slice(2 * self.index(robot), 2 * self.index(robot) + 2)
        variance = self.covariance[-1, -1]
        return self.covariance[own, -1] / variance if variance else np.zeros(2)


@dataclass(frozen=True, slots=True, eq=False)
class Leap:
    """A team after ranges were taken in.

    Attributes
    ----------
    status : str
        "ok"; "contradicted": ranges are far from what was expected of robots that stand; else as in `TriangleFix`.
    remedy : str
        What would help; empty where ok.
    formation : Formation
        As it was before where not ok.
    strangeness : float
        Squared distance of ranges from what was expected, in its own deviations: chi-squared, a degree of freedom a
        range. NaN where none were taken in.
    """

    status: Status
    remedy: str
    formation: Formation
    strangeness: float


def begin(
    robots: Sequence[str],
    place_m: Floats,
    pairs: Sequence[Pair],
    range_m: Floats,
    covariance_m2: Floats,
    scale_sd: float,
    base: tuple[float, float] | None = None,
) -> Leap:
    """Begin with ranges among all: the first robot's place is kept, and so is the second's direction from it.

    These define the frame and are not in doubt. All else is told by the ranges: least squares, by QR.

    Parameters
    ----------
    robots : sequence of str, three or more
    place_m : float64 (N, 2)
        Where they stand, roughly: of two mirror images the nearer one is found.
    pairs, range_m, covariance_m2
        As in `ranged`.
    scale_sd : float
        Deviation of the speed of sound, a share of it.
    base : (distance_m, sd_m), optional
        From the first robot to the second, measured by other means: that tells the speed of sound.

    Returns
    -------
    Leap
        "flat" where the ranges leave places open.

    Raises
    ------
    ValueError
        If robots are fewer than three or not each once, shapes differ, or a deviation is not what one can be.
    """
    place = np.array(place_m, np.float64)
    heard, noise = np.asarray(range_m, np.float64), np.asarray(covariance_m2, np.float64)
    if len(robots) < 3 or len(set(robots)) != len(robots):
        raise ValueError(f"robots {', '.join(robots)}: leap-frog needs three or more, each once")
    if place.shape != (len(robots), 2) or not np.isfinite(place).all():
        raise ValueError(f"place_m has shape {place.shape}; ({len(robots)}, 2) finite numbers are needed")
    if scale_sd < 0 or (base is not None and base[1] <= 0):
        raise ValueError(f"scale_sd {scale_sd:g}, base {base}: deviations below 0, or none of a base")
    _check(pairs, heard, noise)
    along = place[1] - place[0]
    if not np.any(along):
        raise ValueError(f"{robots[0]} and {robots[1]} stand at one place: no direction for the frame")
    along = along / np.hypot(*along)
    size = 2 * len(robots) + 1
    free = np.zeros((size, size - 3 - (scale_sd == 0)))  # what moves with each unknown
    free[2:4, 0] = along
    free[4 : size - 1, 1 : size - 4] = np.eye(size - 5)
    if scale_sd:
        free[-1, -1] = 1.0
    known = np.zeros((0, size))
    if scale_sd:
        known = np.eye(size)[-1:] / scale_sd
    root_noise = np.linalg.cholesky(noise)
    none = Formation(tuple(robots), place, 0.0, np.zeros((size, size)))
    state = np.append(place.ravel(), 0.0)
    root = np.zeros((0, 0))
    for _ in range(MOST_ITERATIONS):
        shown, derivative = _expected(none, state, pairs)
        rows = [np.linalg.solve(root_noise, derivative), known]
        miss = [np.linalg.solve(root_noise, heard - shown), -(known @ state)]
        if base is not None:
            rows.append((np.concatenate([-along, along, np.zeros(size - 4)]) / base[1])[None])
            miss.append(np.array([(base[0] - along @ (state[2:4] - state[:2])) / base[1]]))
        table = np.concatenate(rows) @ free
        sizes = np.linalg.norm(table, axis=0)
        if len(table) < free.shape[1] or not sizes.all() or np.linalg.cond(table / sizes) > FLAT:
            text = "ranges leave places open: let all range each other, and none stand on the line of two others"
            return Leap("flat", text, none, np.nan)
        orthogonal, root = np.linalg.qr(table)
        step = free @ np.linalg.solve(root, orthogonal.T @ np.concatenate(miss))
        state = state + step
        if np.abs(step).max() < SETTLED_M:
            break
    spread = np.linalg.solve(root.T, free.T).T
    return Leap(
        "ok", "", Formation(tuple(robots), state[:-1].reshape(-1, 2), float(state[-1]), spread @ spread.T), np.nan
    )


def ranged(formation: Formation, pairs: Sequence[Pair], range_m: Floats, covariance_m2: Floats) -> Leap:
    """Take in ranges among robots that stand.

    Parameters
    ----------
    pairs : sequence of (robot, robot), length n
    range_m : float64 (n,)
        Horizontal distances as measured, not corrected for the scale.
    covariance_m2 : float64 (n, n)
        Of their noise alone, without what the scale's error makes.

    Raises
    ------
    ValueError
        If shapes differ, or a robot is not of the team.
    """
    return _updated(formation, pairs, range_m, covariance_m2, formation.place_m)


def leapt(
    formation: Formation,
    robot: str,
    moved_m: Floats,
    moved_covariance_m2: Floats,
    pairs: Sequence[Pair],
    range_m: Floats,
    covariance_m2: Floats,
) -> Leap:
    """Place a robot that went ahead while all others stood.

    Its odometry tells which of two places is true, and hardly anything else.

    Parameters
    ----------
    robot : str
    moved_m, moved_covariance_m2 : float64 (2,), (2, 2)
        Its way since it was placed, by its own sensors, in the team's frame.
    pairs, range_m, covariance_m2
        As in `ranged`: the mover's ranges, and any among those that stand, which are checked and made surer by them.

    Returns
    -------
    Leap
        Not ok where fewer than two robots range the mover ("ambiguous"), where the best two make no triangle with it,
        where odometry cannot tell its sides, and where ranges contradict what is known.
    """
    who = formation.index(robot)
    aged = opened(formation, robot, moved_m, moved_covariance_m2)
    heard, noise = np.asarray(range_m, np.float64), np.asarray(covariance_m2, np.float64)
    _check(pairs, heard, noise)
    anchors, rows = _base(aged, robot, pairs)
    if len(rows) < 2:
        text = f"fewer than two robots range {robot}: let it come nearer"
        return Leap("ambiguous", text, formation, np.nan)
    both = [2 * a + c for a in anchors for c in (0, 1)]
    own = slice(2 * who, 2 * who + 2)
    own_m = heard[rows] / (1.0 + aged.scale)
    found = triangle(
        aged.place_m[anchors],
        aged.covariance[np.ix_(both, both)],
        own_m,
        noise[np.ix_(rows, rows)] + aged.covariance[-1, -1] * np.outer(own_m, own_m),
        expected=(aged.place_m[who], aged.covariance[own, own]),
    )
    if found.status != "ok" or found.chosen is None:
        return Leap(found.status, found.remedy, formation, np.nan)
    start = aged.place_m.copy()
    start[who] = found.chosen.position_m
    done = _updated(aged, pairs, heard, noise, start)
    return done if done.status == "ok" else replace(done, formation=formation)


def opened(formation: Formation, robot: str, moved_m: Floats, moved_covariance_m2: Floats) -> Formation:
    """Return what is known once a robot has moved, before any range: dead reckoning."""
    who = formation.index(robot)
    own = slice(2 * who, 2 * who + 2)
    place, covariance = formation.place_m.copy(), formation.covariance.copy()
    place[who] += np.asarray(moved_m, np.float64)
    covariance[own, own] += np.asarray(moved_covariance_m2, np.float64)
    return replace(formation, place_m=place, covariance=covariance)


def _updated(formation: Formation, pairs: Sequence[Pair], range_m: Floats, noise_m2: Floats, start_m: Floats) -> Leap:
    """Do an iterated Kalman update, linearised first at ``start_m`` (Bell & Cathey 1993: Gauss-Newton)."""
    heard, noise = np.asarray(range_m, np.float64), np.asarray(noise_m2, np.float64)
    _check(pairs, heard, noise)
    if not len(heard):
        return Leap("ok", "", formation, np.nan)
    before = np.append(formation.place_m.ravel(), formation.scale)
    state = np.append(start_m.ravel(), formation.scale)
    for _ in range(MOST_ITERATIONS):
        shown, derivative = _expected(formation, state, pairs)
        gain, _ = _corrected(formation.covariance, derivative, noise)
        miss = heard - shown - derivative @ (before - state)
        last, state = state, before + gain @ miss
        if np.abs(state - last).max() < SETTLED_M:
            break
    shown, derivative = _expected(formation, state, pairs)
    miss = heard - shown - derivative @ (before - state)
    strange = float(miss @ np.linalg.solve(derivative @ formation.covariance @ derivative.T + noise, miss))
    if _chance(strange, len(heard)) < STRANGE:
        text = f"ranges are {np.sqrt(strange / len(heard)):.0f} of their deviations from what was expected"
        return Leap("contradicted", f"{text}: a robot that should stand has moved; begin anew", formation, strange)
    _, covariance = _corrected(formation.covariance, derivative, noise)
    place = state[:-1].reshape(-1, 2)
    return Leap("ok", "", replace(formation, place_m=place, scale=float(state[-1]), covariance=covariance), strange)


def _expected(formation: Formation, state: Floats, pairs: Sequence[Pair]) -> tuple[Floats, Floats]:
    """Ranges (n,) that a state shows, and their derivative (n, 2 N + 1)."""
    ends = np.array([(formation.index(a), formation.index(b)) for a, b in pairs], np.int64).reshape(-1, 2)
    place, rows = state[:-1].reshape(-1, 2), np.arange(len(pairs))
    apart = place[ends[:, 1]] - place[ends[:, 0]]
    distance = np.maximum(np.hypot(apart[:, 0], apart[:, 1]), 1e-9)
    unit = (1.0 + state[-1]) * apart / distance[:, None]
    derivative = np.zeros((len(pairs), len(state)))
    for axis in (0, 1):
        derivative[rows, 2 * ends[:, 1] + axis] = unit[:, axis]
        derivative[rows, 2 * ends[:, 0] + axis] = -unit[:, axis]
    derivative[:, -1] = distance
    return (1.0 + state[-1]) * distance, derivative


def _corrected(covariance: Floats, derivative: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Kalman gain, and the covariance after, in Joseph form."""
    crossed = derivative @ covariance
    gain = np.linalg.solve(crossed @ derivative.T + noise, crossed).T
    return gain, joseph(covariance, gain, derivative, noise)


def _base(formation: Formation, robot: str, pairs: Sequence[Pair]) -> tuple[list[int], list[int]]:
    """Two robots that range the mover, seen from it most nearly at a right angle, and the rows of their ranges."""
    who = formation.index(robot)
    by_anchor = {formation.index(b if a == robot else a): row for row, (a, b) in enumerate(pairs) if robot in (a, b)}
    ways = {a: formation.place_m[a] - formation.place_m[who] for a in by_anchor}
    seen = {a: way / max(float(np.hypot(*way)), 1e-9) for a, way in ways.items()}
    best = max(
        combinations(sorted(by_anchor), 2),
        key=lambda two: abs(seen[two[0]][0] * seen[two[1]][1] - seen[two[0]][1] * seen[two[1]][0]),
        default=(),
    )
    return list(best), [by_anchor[a] for a in best]


def _chance(squared: float, freedom: int) -> float:
    """Chance of a chi-squared variable as large."""
    from scipy.special import gammaincc

    return float(gammaincc(freedom / 2, squared / 2))


def _check(pairs: Sequence[Pair], range_m: Floats, covariance_m2: Floats) -> None:
    if range_m.shape != (len(pairs),) or covariance_m2.shape != (len(pairs), len(pairs)):
        shapes = f"range_m of shape {range_m.shape} and covariance_m2 of {covariance_m2.shape}"
        raise ValueError(f"{len(pairs)} pairs, {shapes}: a row a pair is needed")
    if not np.isfinite(range_m).all():
        raise ValueError(f"range_m = {range_m.tolist()}; all must be finite")
