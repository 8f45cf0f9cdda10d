"""The picture of a team: all tracks with ellipses, how sure each robot was, and who stood while who moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from sonofix.draw import style
from sonofix.records import Estimate, Floats, Recording, Step, Truth

STANDING_MPS = 0.01
"""A lower speed is rest."""

ELLIPSES = 14
"""Along each track."""

ALONE_S = 2.0
"""A robot of which nothing was taken for longer is carried by its odometry alone."""

ROLES = {"explores": (0.62, 1.0), "base": (0.16, 1.0), "alone": (0.62, 0.22)}
"""Height and opacity of the bars of each role."""


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
        plan = figure.add_axes((0.05, 0.08, 0.54, 0.80))
        draw_landmarks(plan, recording)
        for name, track in tracks.items():
            colour = colours[name]
            if name in truths and len(track):
                true = truths[name].position_m
                plan.plot(true[:, 0], true[:, 1], color=style.TRUTH, linewidth=0.6, alpha=0.5, zorder=2)
            place = places(track)
            plan.plot(*place.T, color=colour, linewidth=1.1, label=name, zorder=3)
            for estimate in track[:: max(1, len(track) // ELLIPSES)]:
                plan.add_patch(ellipse(estimate, colour))
        plan.set_aspect("equal")
        _limits(plan, recording, tracks)
        style.dress(plan, "Tracks", "ellipses: three deviations" + ("; fine: truth" if truths else ""))
        plan.set_xlabel("x (m)")
        plan.set_ylabel("y (m)")
        plan.legend(loc="upper right", fontsize=10)
        error = figure.add_axes((0.66, 0.50, 0.32, 0.38))
        _draw_doubt(error, tracks, truths, colours)
        roles = figure.add_axes((0.66, 0.08, 0.32, 0.33), sharex=error)
        _draw_roles(roles, recording, steps, tracks, colours)
        roles.set_xlabel("time (s)")
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


def _limits(axes: Axes, recording: Recording, tracks: Mapping[str, Sequence[Estimate]]) -> None:
    """Show where the robots were, and no ellipse that leaves the hall."""
    every = [places(track) for track in tracks.values()]
    every += [np.array([b.position_m[:2]]) for b in recording.site.beacons if b.position_m is not None]
    if not every:
        return
    points = np.vstack(every)
    low, high = np.percentile(points, 0.5, axis=0), np.percentile(points, 99.5, axis=0)
    margin = 0.08 * float(np.max(high - low)) + 0.1
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)


def _draw_doubt(
    axes: Axes, tracks: Mapping[str, Sequence[Estimate]], truths: Mapping[str, Truth], colours: Mapping[str, str]
) -> None:
    for name, track in tracks.items():
        time = np.array([estimate.time_s for estimate in track])
        sd = np.array([np.hypot(estimate.sd("x") or 0.0, estimate.sd("y") or 0.0) for estimate in track])
        axes.plot(time, sd, color=colours[name], linewidth=0.9, alpha=0.9)
        if name in truths:
            truth = truths[name]
            inside = (time >= truth.time_s[0]) & (time <= truth.time_s[-1])
            true = np.column_stack([np.interp(time, truth.time_s, truth.position_m[:, i]) for i in range(2)])
            off = np.where(inside, np.hypot(*(places(track) - true).T), np.nan)
            axes.plot(time, off, ".", color=colours[name], markersize=1.2, alpha=0.5)
    axes.set_yscale("log")
    axes.tick_params(labelbottom=False)
    axes.set_ylabel("m")
    style.dress(axes, "Deviation of position", "dots: error against the truth" if truths else "")


def roles_of(
    recording: Recording, steps: Sequence[Step], name: str, time_s: Floats, moves: Sequence[bool]
) -> list[str]:
    """Return what a vehicle did at each of its estimates.

    ``explores``: it moved, and others heard it or it heard; ``base``: it stood, and did; ``alone``: nothing was
    taken of it for `ALONE_S`, so its odometry alone carried it.
    """
    nodes = {node.id for node in (*recording.site.beacons, *recording.site.microphones) if node.vehicle == name}
    nodes.add(name)
    told = [
        step.ranges.sync_s
        for step in steps
        if any(e.vehicle == name and e.source in ("fused", "fix") for e in step.estimates)
        or any(
            used and (emitter in nodes or receiver in nodes)
            for used, emitter, receiver in zip(
                np.asarray(step.range_used, bool).tolist(), step.ranges.emitter, step.ranges.receiver, strict=True
            )
        )
    ]
    at = np.searchsorted(told, time_s + 1e-9) - 1
    since = np.where(at >= 0, time_s - np.array([-np.inf, *told])[at + 1], np.inf)
    return [
        "alone" if gap > ALONE_S else "explores" if moving else "base" for gap, moving in zip(since, moves, strict=True)
    ]


def _draw_roles(
    axes: Axes,
    recording: Recording,
    steps: Sequence[Step],
    tracks: Mapping[str, Sequence[Estimate]],
    colours: Mapping[str, str],
) -> None:
    """One lane a robot: what it did over time, and when it slipped."""
    for lane, (name, track) in enumerate(tracks.items()):
        time = np.array([estimate.time_s for estimate in track])
        moves = [bool(np.hypot(*estimate.velocity_mps[:2]) > STANDING_MPS) for estimate in track]
        roles = np.array(roles_of(recording, steps, name, time, moves))
        apart = np.concatenate([np.diff(time) > 5.0, [True]])
        changes = np.flatnonzero(
            np.concatenate([[True], roles[1:] != roles[:-1]]) | np.concatenate([[True], apart[:-1]])
        )
        for a, b in zip(changes, [*changes[1:], len(time)], strict=True):
            end = time[b] if b < len(time) and not apart[b - 1] else time[b - 1]
            height, alpha = ROLES[roles[a]]
            axes.broken_barh(
                [(time[a], max(end - time[a], 1e-3))],
                (lane - height / 2, height),
                color=colours[name],
                alpha=alpha,
                linewidth=0,
            )
        slips = [
            event.time_s for step in steps for event in step.events if event.vehicle == name and event.event == "slip"
        ]
        if slips:
            axes.plot(slips, [lane] * len(slips), "x", color=style.EXCLUDED, markersize=8, markeredgewidth=2, zorder=5)
    axes.set_yticks(range(len(tracks)), list(tracks))
    axes.set_ylim(len(tracks) - 0.4, -0.6)
    style.dress(axes, "Roles", "thick: explores; thin: base; faint: unheard; ×: pushed")
    axes.grid(False, axis="y")
