"""The picture of a team: all tracks with ellipses, how sure each robot was, and who stood while who moved.

A long recording's tracks cover each other: then all are shown of its last minute, and each robot's whole track by
itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from sonofix.draw import style
from sonofix.draw.team_times import draw_times, parted
from sonofix.records import Estimate, Floats, Recording, Step, Truth

ELLIPSES = 14
"""Along each track."""

LATEST_S = 60.0
"""A longer recording is too much for one plan: that shows so much of its end."""

_AREA = (0.05, 0.07, 0.56, 0.80)
"""Of plans: left, bottom, width, height."""

_FRAME = (0.035, 0.065)
"""Room beside each plan and above it, for labels."""


def draw_team(recording: Recording, steps: Sequence[Step], truths: Mapping[str, Truth] | None = None) -> Figure:
    """Draw a team's tracks, deviations and roles.

    Parameters
    ----------
    recording : Recording
        Only its site is looked at.
    steps : sequence of Step
    truths : mapping from vehicle to Truth, optional
        Adds the true paths and errors.

    Returns
    -------
    Figure
        16 × 10 inches, on an Agg canvas; where no robot was placed it says so.
    """
    truths = truths or {}
    tracks = tracks_of(recording, steps)
    colours = dict(zip(tracks, style.category_colours(len(tracks)), strict=True))
    with style.sheet() as figure:
        title = recording.site.name or "team"
        figure.text(0.05, 0.948, title, fontsize=26, fontweight="bold", color=style.INK, va="center")
        if not tracks:
            figure.text(0.5, 0.5, "no robot was placed", fontsize=20, color=style.MUTED, ha="center", va="center")
            return figure
        begin = min(track[0].time_s for track in tracks.values())
        end = max(track[-1].time_s for track in tracks.values())
        limits = _limits(recording, tracks)
        if end - begin <= LATEST_S:
            plan = figure.add_axes(_box(0, 1, 1))
            _draw_plan(plan, recording, tracks, truths, colours, limits)
            style.dress(plan, "Tracks", "ellipses: three deviations" + ("; fine: truth" if truths else ""))
            plan.set_xlabel("x (m)")
            plan.set_ylabel("y (m)")
            plan.legend(loc="upper right", fontsize=10)
        else:
            _draw_plans(figure, recording, tracks, truths, colours, limits, end)
        draw_times(figure, (0.66, 0.07, 0.32, 0.80), recording, steps, tracks, truths, colours)
    return figure


def tracks_of(recording: Recording, steps: Sequence[Step]) -> dict[str, list[Estimate]]:
    """Return each vehicle's estimates in their order."""
    tracks: dict[str, list[Estimate]] = {vehicle.id: [] for vehicle in recording.site.vehicles}
    for step in steps:
        for estimate in step.estimates:
            tracks[estimate.vehicle].append(estimate)
    return {name: track for name, track in tracks.items() if track}


def places(track: Sequence[Estimate]) -> Floats:
    """Return positions (n, 2)."""
    return np.array([estimate.position_m[:2] for estimate in track]).reshape(-1, 2)


def ellipse(estimate: Estimate, colour: str) -> Ellipse:
    """Return the ellipse of three deviations."""
    value, vector = np.linalg.eigh(estimate.covariance[:2, :2])
    width, height = 6 * np.sqrt(np.maximum(value, 0.0))
    angle = float(np.degrees(np.arctan2(vector[1, 0], vector[0, 0])))
    x, y = estimate.position_m[:2]
    return Ellipse(
        (float(x), float(y)), width, height, angle=angle, fill=False, edgecolor=colour, linewidth=0.8, alpha=0.8
    )


def draw_landmarks(axes: Axes, recording: Recording) -> None:
    """Mark beacons that stand."""
    fixed = np.array([beacon.position_m[:2] for beacon in recording.site.beacons if beacon.position_m is not None])
    if len(fixed):
        axes.plot(*fixed.T, "^", color=style.MUTED, markersize=6, zorder=4, label="landmarks")


def _limits(recording: Recording, tracks: Mapping[str, Sequence[Estimate]]) -> tuple[Floats, Floats]:
    """Show where the robots were, and no ellipse that leaves the hall: least and greatest (2,)."""
    points = np.vstack([places(track) for track in tracks.values()])
    fixed = [np.array(beacon.position_m[:2]) for beacon in recording.site.beacons if beacon.position_m is not None]
    low = np.min([np.percentile(points, 0.5, axis=0), *fixed], axis=0)
    high = np.max([np.percentile(points, 99.5, axis=0), *fixed], axis=0)
    margin = 0.08 * float(np.max(high - low)) + 0.1
    return low - margin, high + margin


def _box(cell: int, columns: int, rows: int) -> tuple[float, float, float, float]:
    """Where one of so many plans goes: left, bottom, width, height."""
    left, bottom, width, height = _AREA
    row, column = divmod(cell, columns)
    wide, high = width / columns, height / rows
    x, y = left + column * wide, bottom + (rows - 1 - row) * high
    return x, y, wide - _FRAME[0], high - (_FRAME[1] if rows > 1 else 0.0)


def _grid(count: int, limits: tuple[Floats, Floats]) -> tuple[int, int]:
    """Columns and rows in which plans are drawn at the largest scale."""
    wide, high = limits[1] - limits[0]

    def scale(columns: int) -> float:
        rows = -(-count // columns)
        _, _, width, height = _box(0, columns, rows)
        return min(width * style.SIZE_IN[0] / float(wide), height * style.SIZE_IN[1] / float(high))

    columns = max(range(1, count + 1), key=scale)
    return columns, -(-count // columns)


def _draw_plans(
    figure: Figure,
    recording: Recording,
    tracks: Mapping[str, Sequence[Estimate]],
    truths: Mapping[str, Truth],
    colours: Mapping[str, str],
    limits: tuple[Floats, Floats],
    end_s: float,
) -> None:
    """Draw the last minute of all, and the whole track of each."""
    latest = {name: [e for e in track if e.time_s >= end_s - LATEST_S] for name, track in tracks.items()}
    cells = [(f"Last {LATEST_S:g} s", latest), *((name, {name: track}) for name, track in tracks.items())]
    columns, rows = _grid(len(cells), limits)
    for cell, (title, shown) in enumerate(cells):
        plan = figure.add_axes(_box(cell, columns, rows))
        _draw_plan(plan, recording, shown, truths, colours, limits, ends=cell == 0)
        style.dress(plan, title)
        if cell:
            plan.set_title(title, loc="left", color=colours[title], fontsize=11.5, fontweight="bold", pad=7)
        if cell // columns == rows - 1:
            plan.set_xlabel("x (m)")
        if cell % columns == 0:
            plan.set_ylabel("y (m)")
    told = "ellipses: three deviations; triangles: landmarks" + ("; fine: truth" if truths else "")
    figure.text(_AREA[0], 0.902, told, fontsize=10, color=style.MUTED, va="center")


def _draw_plan(
    plan: Axes,
    recording: Recording,
    tracks: Mapping[str, Sequence[Estimate]],
    truths: Mapping[str, Truth],
    colours: Mapping[str, str],
    limits: tuple[Floats, Floats],
    ends: bool = False,
) -> None:
    """Draw tracks, their truth and ellipses; with ``ends`` a dot and a name where each robot is at last."""
    draw_landmarks(plan, recording)
    for name, track in tracks.items():
        if not track:
            continue
        if name in truths:
            truth = truths[name]
            true = truth.position_m[(truth.time_s >= track[0].time_s) & (truth.time_s <= track[-1].time_s)]
            plan.plot(true[:, 0], true[:, 1], color=style.TRUTH, linewidth=0.6, alpha=0.5, zorder=2)
        place = places(track)
        way = parted(np.array([estimate.time_s for estimate in track]), place)
        plan.plot(*way.T, color=colours[name], linewidth=1.1, label=name, zorder=3)
        for estimate in track[:: max(1, len(track) // ELLIPSES)] if not ends else track[-1:]:
            plan.add_patch(ellipse(estimate, colours[name]))
        if ends:
            plan.plot(*place[-1], "o", color=colours[name], markersize=5, zorder=5)
            at, colour = (float(place[-1, 0]), float(place[-1, 1])), colours[name]
            plan.annotate(
                name, at, xytext=(5, 5), textcoords="offset points", color=colour, fontsize=9, path_effects=style.HALO
            )
    (left, low), (right, high) = limits
    plan.set_aspect("equal")
    plan.set_xlim(left, right)
    plan.set_ylim(low, high)
