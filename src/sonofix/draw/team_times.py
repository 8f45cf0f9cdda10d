"""A team over time: how sure each robot was, a lane a robot, and who stood while who moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from sonofix.draw import style
from sonofix.records import Estimate, Floats, Recording, Step, Truth

STANDING_MPS = 0.01
"""A lower speed is rest."""

ALONE_S = 2.0
"""A robot of which nothing was taken for longer is carried by its odometry alone."""

ROLES = {"explores": (0.62, 1.0), "base": (0.16, 1.0), "alone": (0.62, 0.22)}
"""Height and opacity of the bars of each role."""

SPELLS = 150
"""Roles are told of so many spells, each by what it was mostly: shorter ones could not be seen."""

GAP_S = 5.0
"""Lines break where a robot had no place for longer."""

_LEAST_SHARE = 0.02
"""Errors are drawn down to so small a share of the least deviation."""

_FEW = 6
"""Lanes of more robots are too low for every decade's name."""

_DOUBT = 0.57
"""Share of the height that deviations take; roles have the rest, but for the gap."""

_GAP = 0.11


def draw_times(
    figure: Figure,
    box: tuple[float, float, float, float],
    recording: Recording,
    steps: Sequence[Step],
    tracks: Mapping[str, Sequence[Estimate]],
    truths: Mapping[str, Truth],
    colours: Mapping[str, str],
) -> None:
    """Draw into a part of a figure (left, bottom, width, height): deviations and errors, and roles beneath."""
    left, bottom, width, height = box
    roles = figure.add_axes((left, bottom, width, height * (1 - _DOUBT - _GAP)))
    _draw_roles(roles, recording, steps, tracks, colours)
    roles.set_xlabel("time (s)")
    base, high = bottom + height * (1 - _DOUBT), height * _DOUBT / len(tracks)
    sds = {name: np.array([_sd_m(estimate) for estimate in track]) for name, track in tracks.items()}
    every = np.concatenate(list(sds.values()))
    every = every[np.isfinite(every) & (every > 0)]
    limits = (_LEAST_SHARE * float(np.percentile(every, 1)), 2 * float(every.max())) if len(every) else (1e-3, 1.0)
    for lane, (name, track) in enumerate(tracks.items()):
        axes = figure.add_axes((left, base + high * (len(tracks) - 1 - lane), width, 0.9 * high), sharex=roles)
        _draw_doubt(axes, track, sds[name], truths.get(name), colours[name], limits)
        axes.yaxis.set_major_locator(LogLocator(numticks=4 if len(tracks) <= _FEW else 2))
        told = "line: stated; dots: error against the truth" if truths else ""
        style.dress(axes, "Deviation of position (m)" if lane == 0 else "", told if lane == 0 else "")
        axes.text(0.008, 0.93, name, transform=axes.transAxes, color=colours[name], fontsize=9, va="top", zorder=6)


def parted(time_s: Floats, rows: Floats) -> Floats:
    """Return rows (n, k) with one of NaN in each gap beyond `GAP_S`."""
    return np.insert(rows, np.flatnonzero(np.diff(time_s) > GAP_S) + 1, np.nan, axis=0)


def _sd_m(estimate: Estimate) -> float:
    return float(np.hypot(estimate.sd("x") or 0.0, estimate.sd("y") or 0.0))


def _draw_doubt(
    axes: Axes,
    track: Sequence[Estimate],
    sd_m: Floats,
    truth: Truth | None,
    colour: str,
    limits: tuple[float, float],
) -> None:
    """One robot's deviation, and what it was off by."""
    time = np.array([estimate.time_s for estimate in track])
    if truth is not None:
        inside = (time >= truth.time_s[0]) & (time <= truth.time_s[-1])
        true = np.column_stack([np.interp(time, truth.time_s, truth.position_m[:, i]) for i in range(2)])
        place = np.array([estimate.position_m[:2] for estimate in track])
        off = np.where(inside, np.hypot(*(place - true).T), np.nan)
        axes.plot(time, off, ".", color=colour, markersize=1.6, alpha=0.45, zorder=2)
    axes.plot(*parted(time, np.column_stack([time, sd_m])).T, color=style.INK, linewidth=0.9, zorder=3)
    axes.set_yscale("log")
    axes.set_ylim(*limits)
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.tick_params(labelbottom=False)


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
    begin = min(track[0].time_s for track in tracks.values())
    end = max(track[-1].time_s for track in tracks.values())
    edges = np.linspace(begin, end, SPELLS + 1)
    for lane, (name, track) in enumerate(tracks.items()):
        time = np.array([estimate.time_s for estimate in track])
        moves = [bool(np.hypot(*estimate.velocity_mps[:2]) > STANDING_MPS) for estimate in track]
        for first, last, role in spells(edges, time, roles_of(recording, steps, name, time, moves)):
            height, alpha = ROLES[role]
            axes.broken_barh(
                [(first, last - first)],
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


def spells(edges: Floats, time_s: Floats, roles: Sequence[str]) -> list[tuple[float, float, str]]:
    """Return what a robot mostly did between each two of the edges, neighbours of one kind joined.

    Spells without any row are left out.
    """
    which = np.clip(np.searchsorted(edges, time_s, side="right") - 1, 0, len(edges) - 2)
    out: list[tuple[float, float, str]] = []
    for spell in np.unique(which).tolist():
        own = [roles[i] for i in np.flatnonzero(which == spell).tolist()]
        role = max(ROLES, key=own.count)
        first, last = float(edges[spell]), float(edges[spell + 1])
        if out and out[-1][2] == role and out[-1][1] == first:
            first = out.pop()[0]
        out.append((first, last, role))
    return out
