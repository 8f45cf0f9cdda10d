"""Where to begin: vehicles placed by rough beacons, or everything from ranges alone.

Doubly centred squares of ranges are −2 times the products of beacon and vehicle places about their means: a matrix of
rank two (a drive on a level) or three, whose factors are both up to a linear map; the ranges' means then give that map
by linear equations (Crocco, Del Bue, Murino, IEEE Trans. SP 60(2), 2012; Pollefeys and Nister, ICASSP 2008).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import open_arms
from sonofix.locate.fix import fix
from sonofix.locate.start import starts
from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site
from sonofix.survey.rows import Drive

Indices = NDArray[np.int64]

MOST_COLUMNS = 400
LEAST_COLUMNS = 12
"""Epochs in which the same beacons are heard together, from which places can be had."""

TRIES = 16
STOOD_M = 0.05
"""A vehicle none of whose ranges changes by more stood still."""

THIN = 0.01
"""Share of its length by which a drive must be wide to tell sideways from along by ranges alone."""


def untellable(drive: Drive, movable: int, biases: int) -> str:
    """Why a drive cannot tell what is asked, by its count of rows; empty where it may.

    A vehicle that stood brings one row for each pair of ends, however often it was heard.

    Parameters
    ----------
    drive : Drive
    movable, biases : int
        Fixed ends that may move, and delays to find.
    """
    kinds = list(zip(drive.emitter, drive.receiver, strict=True))
    pairs = {pair: i for i, pair in enumerate(dict.fromkeys(kinds))}
    pair = np.array([pairs[kind] for kind in kinds])
    range_m = drive.range_m.copy()
    if drive.common_clock:
        for index in np.unique(drive.epoch):
            range_m[drive.epoch == index] -= np.mean(range_m[drive.epoch == index])
    change_m = max(float(np.ptp(range_m[pair == i])) for i in range(len(pairs)))
    stood = change_m < max(STOOD_M, 6.0 * float(np.median(drive.range_sd_m)))
    first = np.unique(drive.state_vehicle, return_index=True)[1]
    places = int(np.sum(np.where(np.isnan(drive.level_m[first]), 3, 2) + drive.turns[first]))
    unknown = 3 * movable + biases + places + drive.common_clock
    count = len(pairs) if stood else int(np.isfinite(drive.range_m).sum() + np.isfinite(drive.rate_mps).sum())
    if count > unknown:
        return ""
    parts = [
        f"{number} {name}{'s' if number > 1 else ''}"
        for number, name in ((movable, "guessed place"), (biases, "delay"), (len(first), "vehicle"))
        if number
    ]
    against = f"{count} different range{'s' if count > 1 else ''} for {unknown} unknowns ({', '.join(parts)})"
    remedy = "record a drive of half a minute or more, all over the hall"
    epochs = len(np.unique(drive.epoch))
    if epochs == 1:
        return f"one epoch alone is heard, which brings {against}; {remedy}"
    if stood:
        told = f"the vehicle stood still: over {epochs} epochs no range changes by more than {1e3 * change_m:.0f} mm"
        return f"{told}, which leaves {against}; {remedy}"
    return f"too little is heard: {count} ranges and range rates for {unknown} unknowns ({', '.join(parts)}); {remedy}"


def placed_states(drive: Drive, site: Site, epochs: Sequence[RangeEpoch]) -> tuple[Floats, Floats] | None:
    """States (s, 11) from fixes by the site's beacons, and the clock (3,); None where no epoch has one.

    Epochs without a fix lie between their neighbours'. Where every epoch has two mirror images that fit alike, those
    below the beacons count: whether the others are the true ones is asked once all is adjusted.
    """
    states = np.full((len(drive.state_time_s), 11), np.nan)
    offsets: list[tuple[float, float]] = []
    names = [v.id for v in site.vehicles]
    arms = open_arms(site)
    asked = [(epochs[k], names[v]) for v, k in zip(drive.state_vehicle, drive.state_epoch, strict=True)]
    fixes = [fix(epoch, site, name) for epoch, name in asked]
    if all(found.position_m is None for found in fixes):
        below = _below(site, drive)
        fixes = [fix(epoch, below, name) for epoch, name in asked]
    for i, found in enumerate(fixes):
        vehicle = drive.state_vehicle[i]
        if found.position_m is None:
            continue
        states[i] = 0.0
        yaw = found.yaw_rad or 0.0
        states[i, :3] = found.position_m
        if found.yaw_rad is None:
            speed = found.velocity_mps if found.velocity_mps is not None else np.zeros(3)
            along = speed[:2] / max(float(np.hypot(*speed[:2])), 1e-9)
            arm = arms[vehicle]
            # back to the microphone's own line, from which `fix` came
            if np.hypot(*speed[:2]) >= 0.1:
                states[i, :2] += arm[0] * along + arm[1] * np.array([-along[1], along[0]])
        if found.velocity_mps is not None:
            states[i, 3:6] = found.velocity_mps
        states[i, 9] = yaw
        if found.clock_offset_m is not None:
            offsets.append((found.time_s, found.clock_offset_m))
    clock = np.zeros(3)
    if offsets:
        time_s, offset = np.array(offsets).T
        slope = float(np.median(np.diff(offset) / np.diff(time_s))) if len(offset) > 4 else 0.0
        slope = slope if abs(slope) < 0.1 else 0.0
        clock[:2] = np.median(offset - slope * time_s), slope
    for vehicle in range(len(names)):
        mine = np.flatnonzero(drive.state_vehicle == vehicle)
        good = mine[np.isfinite(states[mine, 0])]
        if not len(mine):
            continue
        if not len(good):
            return None
        states[good, 9] = np.unwrap(states[good, 9])
        for component in range(11):
            values = np.interp(drive.state_time_s[mine], drive.state_time_s[good], states[good, component])
            states[mine, component] = values
    return states, clock


def _below(site: Site, drive: Drive) -> Site:
    """Return the site with a room that ends at the middle height of its fixed ends, so that a fix lies below them."""
    low, high = (np.full(3, -np.inf), np.full(3, np.inf)) if site.bounds_m is None else np.array(site.bounds_m, float)
    high = np.array([*high[:2], min(high[2], float(np.median(drive.place_m[np.unique(drive.point), 2])))])
    section = site.section.model_copy(update={"bounds_m": (tuple(low.tolist()), tuple(high.tolist()))})
    return site.model_copy(update={"section": section})


def from_ranges(drive: Drive, rng: np.random.Generator) -> tuple[dict[int, Floats], str]:
    """Places of fixed ends in a frame of their own, from ranges alone.

    Returns
    -------
    places : dict from index in ``drive.names`` to float64 (3,)
        With a known level: z in the site's frame, above the microphone. Empty where the drive does not tell.
    why : str
        What was missing then.
    """
    if drive.common_clock:
        return {}, "with an unknown clock, places must be roughly known: give position_m within a metre"
    table, level = _table(drive)
    core = _core(table)
    if core is None:
        columns = table.shape[1]
        if columns < LEAST_COLUMNS:
            return {}, (
                f"{columns} epochs are heard; from ranges alone it takes {LEAST_COLUMNS} or more, from places all over"
                " the hall: record a longer drive, or give position_m within a metre"
            )
        return {}, "too few beacons are heard together; three at least are needed on a known level, else five"
    rows, columns = core
    best: tuple[float, dict[int, Floats]] | None = None
    why = "ranges fit no places; check the sound speed, and that one vehicle drove"
    for attempt in range(TRIES):
        take = columns
        if attempt:
            size = max(LEAST_COLUMNS, int(len(columns) * (0.8 if attempt < 4 else 0.4)))
            take = rng.choice(columns, min(size, len(columns)), replace=False)
        found, reason = _factored(table[np.ix_(rows, take)], level)
        if found is None:
            why = reason
            continue
        ends, drove = found
        places = {int(r): ends[i] for i, r in enumerate(rows)}
        drove_by = dict(zip(take.tolist(), drove, strict=True))
        _fill(table, places, drove_by, level)
        misfit = _misfit(table, places, drove_by)
        if best is None or misfit < best[0]:
            best = misfit, places
    if best is None:
        return {}, why
    # the level is that of the moving end itself
    return best[1], ""


def _table(drive: Drive) -> tuple[Floats, float | None]:
    """Ranges (p, columns) by fixed end, a column an epoch; and the level of the moving end, where known.

    With range rates, ranges are those at the state's instant.
    """
    mobile = drive.state >= 0
    rate = np.nan_to_num(drive.rate_mps)
    range_m = drive.range_m - rate * drive.dt
    arms, arm = np.unique(np.round(drive.arm, 4), axis=0, return_inverse=True)
    # a body with several ends is looked at by the one that is heard most
    kinds = list(zip(drive.state_vehicle[drive.state[mobile]], arm.ravel()[mobile], strict=True))
    vehicle, kind = max(dict.fromkeys(kinds), key=kinds.count)
    keep = mobile.copy()
    keep[mobile] = [k == (vehicle, kind) for k in kinds]
    columns, column = np.unique(drive.state[keep], return_inverse=True)
    table = np.full((len(drive.names), len(columns)), np.nan)
    table[drive.point[keep], column] = range_m[keep]
    level = drive.level_m[columns[0]]
    height = float(arms[kind, 2])
    return table, None if np.isnan(level) else float(level) + height


def _core(table: Floats) -> tuple[Indices, Indices] | None:
    """Fixed ends and epochs such that each of these hears all of those: as many as can be had."""
    heard = np.isfinite(table)
    rows = np.flatnonzero(heard.sum(axis=1) > 0)
    rows = rows[np.argsort(-heard[rows].sum(axis=1), kind="stable")]
    best = None
    for count in range(len(rows), 2, -1):
        columns = np.flatnonzero(heard[rows[:count]].all(axis=0))
        if len(columns) >= max(LEAST_COLUMNS, 30 if best is None else 0) or (
            len(columns) >= LEAST_COLUMNS and count == 3
        ):
            best = rows[:count], columns
            break
        if len(columns) >= LEAST_COLUMNS and best is None:
            best = rows[:count], columns
    if best is None:
        return None
    step = max(1, len(best[1]) // MOST_COLUMNS)
    return best[0], best[1][::step]


def _factored(range_m: Floats, level: float | None) -> tuple[tuple[Floats, Floats] | None, str]:
    """Places of fixed ends (p, 3) and of the moving end (columns, 3) from a full table of ranges."""
    square = range_m**2
    centred = square - square.mean(axis=0) - square.mean(axis=1)[:, None] + square.mean()
    u, size, vt = np.linalg.svd(-0.5 * centred, full_matrices=False)
    # beyond the rank that places give there is noise alone
    beyond = 2 if level is not None else 3
    noise = float(size[beyond]) if len(size) > beyond else 0.0
    least = max(THIN * float(size[0]), 3.0 * noise)
    if size[0] <= 0 or len(size) < 2 or size[1] < least:
        return None, "the drive is straight: it tells how far along it and how far aside beacons are, not on which side"
    flat = level is not None or len(size) < 3 or size[2] < least
    d = 2 if flat else 3
    if len(range_m) < d + 1:
        return None, f"{len(range_m)} beacons are heard together; {d + 1} are needed"
    ends, drove = u[:, :d] * np.sqrt(size[:d]), (np.sqrt(size[:d])[:, None] * vt[:d]).T
    # |M v|² − 2 w·v + k = mean over ends of range², H = MᵀM: linear in H, w and k
    upper = [(i, j) for i in range(d) for j in range(i, d)]
    columns = [drove[:, i] * drove[:, j] * (1.0 if i == j else 2.0) for i, j in upper]
    matrix = np.column_stack([*columns, -2.0 * drove, np.ones(len(drove))])
    weight = np.linalg.norm(matrix, axis=0)
    _, spread, _ = np.linalg.svd(matrix / weight, full_matrices=False)
    if len(matrix) < matrix.shape[1] or spread[-1] < 0.01 * spread[0]:
        text = "the drive lies on one circle or line: a larger drive with nearer beacons fits the same ranges"
        return None, text
    solved = np.linalg.lstsq(matrix / weight, square.mean(axis=0), rcond=None)[0] / weight
    h = np.zeros((d, d))
    for value, (i, j) in zip(solved, upper, strict=False):
        h[i, j] = h[j, i] = value
    if np.linalg.eigvalsh(h)[0] <= 1e-6 * abs(np.trace(h)):
        return None, "ranges fit no places; check the sound speed, and drive a wider, less regular way"
    upgrade = np.linalg.cholesky(h).T
    inverse = np.linalg.inv(upgrade).T
    drove = drove @ upgrade.T
    # centred places of ends, about where the drive's mean sees them
    ends = (ends + solved[len(upper) : len(upper) + d]) @ inverse.T
    if not flat:
        return (ends, drove), ""
    away = square - np.sum((ends[:, None, :] - drove[None]) ** 2, axis=2)
    height = np.sqrt(np.maximum(away.mean(axis=1), 0.0))
    base = level or 0.0
    return (np.column_stack([ends, base + height]), np.column_stack([drove, np.full(len(drove), base)])), ""


def _fill(table: Floats, places: dict[int, Floats], drove: dict[int, Floats], level: float | None) -> None:
    """Place fixed ends that were not heard together with all others, by where the vehicle was."""
    for row in range(len(table)):
        if row in places:
            continue
        there = [c for c in drove if np.isfinite(table[row, c])]
        if len(there) < 6:
            continue
        anchors = np.array([drove[c] for c in there])
        found = starts(anchors, table[row, there], None, False)
        if found:
            places[row] = max((f[:3] for f in found), key=lambda p: p[2])


def _misfit(table: Floats, places: dict[int, Floats], drove: dict[int, Floats]) -> float:
    rows, columns = list(places), list(drove)
    way = np.linalg.norm(np.array(list(places.values()))[:, None] - np.array(list(drove.values()))[None], axis=2)
    off = np.abs(table[np.ix_(rows, columns)] - way)
    # more ends placed is worth more than a slightly better fit
    return float(np.nanmedian(off)) / len(rows)
