"""What a drive does not tell: weak directions of the beacons' information, said in words, and how they bend.

Along a weak direction a linear covariance is a tangent: a beacon that may turn about a straight drive moves on a
circle, and leaves the tangent by far more than ranges are uncertain. How far is found by solving again from either
side.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonofix.records import Floats, OpenDirection
from sonofix.survey.bundle import descend
from sonofix.survey.task import Fit, Scale, Task

OPEN_M = 0.05
"""A direction that the drive alone leaves more uncertain than this stays unknown."""

BENT_M = 0.02
"""Deviation from which a direction's bend is looked at."""

STRANGE = 4.5
"""Deviations off its guess from which a beacon is told of."""

HOPELESS = 0.3
"""Share of its nearest range by which a beacon may move along a direction that is still followed."""

MOST_FOLLOWED = 24
"""Directions that are followed; further ones count as if they might lead anywhere as far as they are weak."""

MOST_WORK = 60_000
"""Rows times directions that are followed: some seconds."""

FAR = 0.07
"""Share of its nearest range from which a beacon's deviation is taken to hold in every direction."""

ALONE = 0.8
"""Share of a direction's length that makes it one beacon's own."""

UNDECIDED_CHI2 = 16.0
"""Two solutions whose misfits differ by less are both believed: odds of e⁸ to one."""

_WORDS = (("east", "west"), ("north", "south"), ("up", "down"))


def drive_information(task: Task, fit: Fit) -> Floats:
    """Information (3 M, 3 M) on movable places by the drive alone: guesses taken away, all else let go."""
    p = 3 * len(task.movable)
    full = fit.information.copy()
    full[np.arange(p), np.arange(p)] -= task.information[:p]
    across = full[:p, p:]
    rest = np.linalg.lstsq(full[p:, p:], across.T, rcond=None)[0]
    out = full[:p, :p] - across @ rest
    return (out + out.T) / 2


def open_directions(
    information: Floats, covariance: Floats, basis: Floats, names: list[str], place_m: Floats, least_m: float
) -> list[OpenDirection]:
    """Directions that the drive leaves open, those that matter most first.

    Parameters
    ----------
    information : float64 (3 M, 3 M)
        By the drive alone.
    covariance : float64 (3 M, 3 M)
        With all that was known.
    basis : float64 (3 M, d)
        Rigid motions, which are no matter of the drive.
    names, place_m
        Of the movable beacons, M and (M, 3).
    least_m : float
        What a drive leaves less uncertain is told.
    """
    count = len(names)
    inside = np.linalg.svd(np.hstack([basis, np.zeros((len(information), len(information)))]))[0][:, basis.shape[1] :]
    size, axes = np.linalg.eigh(inside.T @ information @ inside)
    floor = 1e-13 * max(float(size[-1]), 1e-30)
    weak = size < least_m**-2.0
    space, left = inside @ axes[:, weak], np.maximum(size[weak], 0.0)
    moves: list[tuple[Floats, float]] = []
    # what one beacon can do alone is told of it; only the rest of several together
    while space.shape[1]:
        parts = [np.linalg.svd(space[3 * i : 3 * i + 3]) for i in range(count)]
        lone = int(np.argmax([part[1][0] for part in parts]))
        if parts[lone][1][0] < ALONE:
            break
        mix = parts[lone][2]
        moves.append((space @ mix[0], float(mix[0] @ (left * mix[0]))))
        rest = mix[1:] @ np.diag(left) @ mix[1:].T
        values, turn = np.linalg.eigh(rest) if len(rest) else (np.zeros(0), np.zeros((0, 0)))
        space, left = space @ mix[1:].T @ turn, np.maximum(values, 0.0)
    moves += [(space[:, k], float(left[k])) for k in range(space.shape[1])]
    out = []
    for axis, value in moves:
        move = axis.reshape(-1, 3)
        drive_sd = 1.0 / np.sqrt(value) if value > floor else np.inf
        sd = float(np.sqrt(max(0.0, axis @ covariance @ axis)))
        out.append(OpenDirection(move, drive_sd, sd, describe(move, names, place_m)))
    return sorted(out, key=lambda direction: -direction.sd_m)


def describe(move: Floats, names: list[str], place_m: Floats) -> str:
    """Say how beacons move along a direction: which, and which way."""
    length = np.linalg.norm(move, axis=1)
    main = np.flatnonzero(length > (0.35 if length.max() < ALONE else ALONE) * length.max())
    main = main[np.argsort(-length[main])]
    if len(main) >= 4:
        middle = place_m.mean(axis=0)
        out = place_m[:, :2] - middle[:2]
        out = out / np.maximum(np.linalg.norm(out, axis=1), 1e-9)[:, None]
        outward = np.sum(out * move[:, :2], axis=1)
        share = np.abs(outward.sum()) / max(np.linalg.norm(move[:, :2], axis=1).sum(), 1e-9)
        if share > 0.8:
            lift = move[:, 2].sum() * np.sign(outward.sum()) / length.sum()
            also = "" if abs(lift) < 0.15 else (" and up" if lift > 0 else " and down")
            return f"all beacons together, outwards{also} from their middle or back"
    told = [f"{names[i]} {way(move[i])}" for i in main[:4]]
    more = f" and {len(main) - 4} more" if len(main) > 4 else ""
    return ", ".join(told) + more + (" or back" if len(main) == 1 else " together, or back")


def way(vector: Floats) -> str:
    """Say in words where a vector points: "east and up"."""
    unit = vector / np.linalg.norm(vector)
    order = np.argsort(-np.abs(unit))
    words = [_WORDS[i][0 if unit[i] > 0 else 1] for i in order if abs(unit[i]) > 0.35]
    return " and ".join(words[:2])


def bends(task: Task, fit: Fit, scale: Scale, covariance: Floats, free: Floats) -> Floats:
    """Covariance (3 M, 3 M) to add for directions that bend: each weak one is followed two deviations to both sides.

    How far that ends from the tangent is then no more than two deviations of what is added. The bends of all directions
    are added up before they are squared, as directions of alike weakness mix.

    Parameters
    ----------
    covariance : float64 (3 M, 3 M)
        Without rigid motions ``free`` (3 M, d).
    """
    p = 3 * len(task.movable)
    size, axes = np.linalg.eigh(covariance)
    total, followed_so_far = np.zeros(p), 0
    most = min(MOST_FOLLOWED, MOST_WORK // len(task.drive))
    nearest = nearest_m(task)
    middle = task.shared(fit.guess)[:p]
    for value, axis in zip(size[::-1], axes.T[::-1], strict=True):
        sd = float(np.sqrt(max(value, 0.0)))
        if sd < BENT_M:
            break
        reach = sd * np.linalg.norm(axis.reshape(-1, 3), axis=1)
        followed_so_far += 1
        if followed_so_far > most or np.any(reach > HOPELESS * nearest):
            total += np.repeat(reach, 3)  # too far to be followed: anywhere that far
            continue
        held = np.zeros((len(task.mean), 1 + free.shape[1]))
        held[:p, 0], held[:p, 1:] = axis, free
        followed = replace(task, gauge=np.hstack([task.gauge, held]))
        ends = []
        for side in (1.0, -1.0):
            shift = np.zeros(len(task.mean))
            shift[:p] = 2.0 * side * sd * axis
            begin = task.moved(fit.guess, np.zeros_like(fit.guess.states), shift)
            end = task.shared(descend(followed, begin, scale, 8)[0])[:p]
            ends.append(np.abs(end - middle - shift[:p]))
        total += np.maximum(ends[0], ends[1]) / 2.0
    return np.diag(total**2)


def nearest_m(task: Task) -> Floats:
    """Shortest range (M,) heard of each movable end."""
    drive = task.drive
    return np.array([np.min(drive.range_m[drive.point == i], initial=np.inf) for i in task.movable])


def widened(task: Task, covariance: Floats) -> Floats:
    """Covariance with every direction as uncertain as the worst for a beacon that may be almost anywhere round it."""
    out = covariance.copy()
    for i, nearest in enumerate(nearest_m(task)):
        at = slice(3 * i, 3 * i + 3)
        worst = float(np.linalg.eigvalsh(covariance[at, at])[-1])
        if np.sqrt(worst) > FAR * nearest:
            out[at, at] += worst * np.eye(3)
    return out


def bounded(task: Task, fit: Fit, covariance: Floats) -> Floats:
    """Covariance that leaves no beacon farther off than its guess: both it and the place found agree with that.

    A beacon that was found far off its guess shows that the guess was worse than stated, and counts as such.
    """
    scale = np.ones(len(covariance))
    for i, index in enumerate(task.movable):
        at = slice(3 * i, 3 * i + 3)
        if not task.information[at].any():
            continue
        moved = float(np.linalg.norm(fit.guess.place_m[index] - task.mean[at]))
        most = 2.0 * max(1.0 / float(task.information[at].min()), moved**2)
        worst = float(np.linalg.eigvalsh(covariance[at, at])[-1])
        scale[at] = np.sqrt(min(1.0, most / max(worst, 1e-30)))
    return scale[:, None] * covariance * scale[None, :]


def image_m(task: Task, fit: Fit, slot: int, bounds_m: tuple[Floats, Floats] | None) -> Floats | None:
    """Where a beacon may be as well (3,): beyond the drive's plane, if that fits and no guess nor room forbids it."""
    drive, guess = task.drive, fit.guess
    index = task.movable[slot]
    rows = np.flatnonzero((drive.point == index) & fit.used & (drive.state >= 0))
    if len(rows) < 3:
        return None
    heard = guess.states[drive.state[rows], :3] + np.array([0.0, 0.0, 1.0]) * drive.arm[rows, 2:3]
    middle = heard.mean(axis=0)
    _, _, axes = np.linalg.svd(np.vstack([heard - middle, np.zeros((3, 3))]), full_matrices=False)
    place = guess.place_m[index]
    height = float((place - middle) @ axes[2])
    image = place - 2.0 * height * axes[2]
    off = 2.0 * ((heard - middle) @ axes[2]) * height / np.maximum(drive.range_m[rows], 0.1)
    sd = drive.range_sd_m[rows] * fit.scale[0]
    at = slice(3 * slot, 3 * slot + 3)
    mean, information = task.mean[at], task.information[at]
    more = float(np.sum(information * ((image - mean) ** 2 - (place - mean) ** 2)) + np.sum((off / sd) ** 2))
    inside = bounds_m is None or bool(np.all((image >= bounds_m[0] - 0.1) & (image <= bounds_m[1] + 0.1)))
    return image if inside and more < UNDECIDED_CHI2 and abs(height) > OPEN_M else None
