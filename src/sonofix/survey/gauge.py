"""The frame: which rigid motions no range can tell, and how two sets of places are laid upon each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.survey.motion import chain
from sonofix.survey.rows import Drive, Guess

MOTIONS = ("x", "y", "z", "roll", "pitch", "yaw")
"""Rigid motions, as `generators` orders them: m along the axes, rad about them."""

NOTHING = 1e-9


def generators(place_m: Floats, about_m: Floats) -> Floats:
    """How places (p, 3) move by each of `MOTIONS` about a point: (3 p, 6)."""
    out = np.zeros((len(place_m), 3, 6))
    x, y, z = (place_m - about_m).T
    out[:, [0, 1, 2], [0, 1, 2]] = 1.0
    out[:, 1, 3], out[:, 2, 3] = -z, y
    out[:, 0, 4], out[:, 2, 4] = z, -x
    out[:, 0, 5], out[:, 1, 5] = -y, x
    return out.reshape(-1, 6)


@dataclass(frozen=True, slots=True, eq=False)
class Freedom:
    """Rigid motions that ranges leave open.

    ``motions`` (6, d): combinations of `MOTIONS` about ``about_m`` (3,); ``basis`` (3 M, d): what they do to movable
    places, orthonormal.
    """

    motions: Floats
    about_m: Floats
    basis: Floats

    @property
    def count(self) -> int:
        """How many there are."""
        return self.basis.shape[1]


def freedom(movable_m: Floats, known_m: Floats, level: bool) -> Freedom:
    """Find the rigid motions of movable places (M, 3) that leave known ones (K, 3), and known levels, alone.

    A known level, and bodies that stay upright, allow no tilt; without a level, tilts are open too.
    """
    about = known_m.mean(axis=0) if len(known_m) else movable_m.mean(axis=0)
    rules = [generators(known_m, about)] if len(known_m) else []
    if level:
        rules.append(np.eye(6)[[2, 3, 4]])
    motions = np.eye(6)
    if rules:
        stacked = np.vstack(rules)
        _, size, axes = np.linalg.svd(np.vstack([stacked, np.zeros((6, 6))]))
        motions = axes[size < 1e-6 * max(1.0, size[0])].T
    moves = generators(movable_m, about) @ motions
    u, size, _ = np.linalg.svd(moves, full_matrices=False)
    return Freedom(motions, about, u[:, size > 1e-6 * max(1.0, size.max(initial=0.0))])


def freedom_of(drive: Drive, movable: NDArray[np.int64], place_m: Floats) -> Freedom:
    """Find the rigid motions that a drive's ranges leave open for movable fixed ends, all others being known."""
    if not len(movable):
        return Freedom(np.zeros((6, 0)), np.zeros(3), np.zeros((0, 0)))
    known = np.setdiff1d(np.unique(drive.point), movable)
    return freedom(place_m[movable], place_m[known], upright(drive))


def upright(drive: Drive) -> bool:
    """Whether known levels tell heights and the vertical."""
    return 2 not in chain(drive).free


def rigid(
    source_m: Floats, target_m: Floats, weight: Floats, upright: bool, reflect: bool | None = None
) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and shift (3,) that lay source places upon targets best: R source + t (Kabsch 1976).

    Parameters
    ----------
    weight : float64 (n,)
    upright : bool
        Heights stand: turn about the vertical only, shift on the level only.
    reflect : bool or None
        Whether R is to be a mirror image; None: never.
    """
    w = weight / weight.sum()
    a, b = w @ source_m, w @ target_m
    cross = (source_m - a).T @ ((target_m - b) * w[:, None])
    plane, turn = np.eye(3), cross[:2, :2] if upright else cross
    u, _, vt = np.linalg.svd(turn)
    sign = np.ones(len(turn))
    sign[-1] = np.sign(np.linalg.det(vt.T @ u.T)) * (-1.0 if reflect else 1.0)
    found = vt.T @ np.diag(sign) @ u.T
    if upright:
        plane[:2, :2] = found
    else:
        plane = found
    shift = b - plane @ a
    if upright:
        shift[2] = 0.0
    return plane, shift


def laid_upon(place_m: Floats, target_m: Floats, upright: bool) -> Floats:
    """Places (n, 3) moved rigidly to where they fit the target best: what is left over is no matter of frame."""
    turn, shift = rigid(place_m, target_m, np.ones(len(place_m)), upright)
    return place_m @ turn.T + shift


def moved(guess: Guess, turn: Floats, shift: Floats, which: NDArray[np.int64]) -> Guess:
    """Return a guess with some of its places, and all states, moved by R and t; a mirror image turns headings round."""
    place, states = guess.place_m.copy(), guess.states.copy()
    place[which] = place[which] @ turn.T + shift
    states[:, :3] = states[:, :3] @ turn.T + shift
    states[:, 3:6] = states[:, 3:6] @ turn.T
    states[:, 6:9] = states[:, 6:9] @ turn.T
    mirror = np.linalg.det(turn) < 0
    ahead = np.column_stack([np.cos(states[:, 9]), np.sin(states[:, 9])]) @ turn[:2, :2].T
    states[:, 9] = np.arctan2(ahead[:, 1], ahead[:, 0])
    states[:, 10] *= -1.0 if mirror else 1.0
    return Guess(states, place, guess.bias_m, guess.excess, guess.clock)


def convention(place_m: Floats, upright: bool) -> tuple[Floats, Floats]:
    """R and t into a frame of one's own: the first place at the origin, the second along x, the third on y's side.

    Upright frames keep their level: only x and y of the first are 0. The far side of a mirror is not chosen here.
    """
    turn = np.eye(3)
    to = place_m - place_m[0]
    along = next((v for v in to[1:] if np.hypot(*v[:2]) > NOTHING), np.array([1.0, 0.0, 0.0]))
    if upright:
        along = np.array([*along[:2], 0.0])
    x = along / np.linalg.norm(along)
    side = next((v - (v @ x) * x for v in to[1:] if np.linalg.norm(v - (v @ x) * x) > 1e-3), None)
    if upright:
        y = np.array([-x[1], x[0], 0.0])
    else:
        y = np.array([-x[1], x[0], 0.0]) if side is None else side
        y = y / np.linalg.norm(y)
    turn[:] = np.stack([x, y, np.cross(x, y)])
    shift = -turn @ place_m[0]
    if upright:
        shift[2] = 0.0
    return turn, shift
