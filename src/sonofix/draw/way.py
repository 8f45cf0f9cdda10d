"""The way a vehicle went: fixes, the track with its ellipses and headings, start and end."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.patches import Ellipse

from sonofix.draw import style
from sonofix.draw.series import FixSeries, TrackSeries
from sonofix.records import Floats

# Radius of the ellipse that holds 95 % of a two-dimensional normal, in standard deviations: sqrt(-2 ln 0.05).
RADIUS_95 = float(np.sqrt(-2.0 * np.log(0.05)))
# From here on a run has so many rows that dots and lines must be finer.
MANY = 600


def draw_fixes(axes: Axes, fixes: FixSeries, clock: Normalize | None, colour: str, size: float) -> None:
    """Draw fixes as fine dots, a few as beads on the track, many as a haze below it; inconsistent ones as crosses."""
    good, many = fixes.sound, len(fixes.time_s) > MANY
    hue = colour if clock is None else style.TIME_MAP(clock(fixes.time_s[good]))
    axes.scatter(
        fixes.position_m[good, 0],
        fixes.position_m[good, 1],
        s=(4 if many else 9) * size,
        color=hue if many or size > 1 else style.INK,
        alpha=0.4 if many else 0.9,
        linewidths=0,
        zorder=4.5 if many else 5.8,
    )
    if not good.all():
        at = fixes.position_m[~good]
        axes.scatter(at[:, 0], at[:, 1], s=20, marker="x", color=style.EXCLUDED, linewidths=0.9, alpha=0.6, zorder=4.4)


def draw_line(axes: Axes, track: TrackSeries, clock: Normalize | None, colour: str, faint: bool = False) -> None:
    """Draw the track's line; stretches without a measurement are dotted."""
    xy = track.position_m[:, :2]
    if len(xy) < 2:
        return
    segments, blind = np.stack([xy[:-1], xy[1:]], axis=1), track.predicted[1:]
    for part, dashes in ((~blind, "solid"), (blind, (0, (1, 1.6)))):
        if part.any():
            lines = LineCollection(
                list(segments[part]),
                linewidths=1.0 if faint else 1.4 if len(xy) > 2 * MANY else 3.0,
                linestyles=dashes,
                colors=[colour] if clock is None else style.TIME_MAP(clock(track.time_s[1:][part])),
                alpha=0.35 if faint else None,
                capstyle="round",
                zorder=5.5,
            )
            axes.add_collection(lines, autolim=False)


def draw_ellipses(
    axes: Axes, track: TrackSeries, rows: list[int], clock: Normalize | None, colour: str, enlarge: int, limit_m: float
) -> None:
    """Draw the 95 % ellipse of the chosen rows; ones wider than ``limit_m`` would hide the picture and are left out."""
    for i in rows:
        shape = ellipse_95(track.covariance_m2[i], enlarge)
        if shape is None or shape[0] > limit_m:
            continue
        width, height, angle = shape
        hue = colour if clock is None else style.TIME_MAP(clock(track.time_s[i]))
        place = (float(track.position_m[i, 0]), float(track.position_m[i, 1]))
        axes.add_patch(Ellipse(place, width, height, angle=angle, fc=hue, ec="none", alpha=0.2, zorder=5))
        axes.add_patch(Ellipse(place, width, height, angle=angle, fc="none", ec=hue, lw=1.3, zorder=5.1))


def ellipse_95(covariance_m2: Floats, enlarge: int) -> tuple[float, float, float] | None:
    """Return full width, full height and angle (degrees) of the enlarged 95 % ellipse; None where x, y are unknown."""
    plane = covariance_m2[:2, :2]
    if not np.isfinite(plane).all():
        return None
    values, vectors = np.linalg.eigh(plane)
    across_m = 2 * RADIUS_95 * enlarge * np.sqrt(np.maximum(values, 0))
    return float(across_m[1]), float(across_m[0]), float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))


def enlargement(tracks: list[TrackSeries], size_m: float) -> int:
    """Return the round factor that makes the median 95 % ellipse about a fortieth of the picture's width in radius."""
    radii = [RADIUS_95 * np.max(track.sd_m()[:, :2], axis=1) for track in tracks if len(track.time_s)]
    known = np.concatenate([np.zeros(0), *radii])
    known = known[np.isfinite(known) & (known > 0)]
    if not len(known):
        return 1
    wanted = 0.022 * size_m / float(np.median(known))
    return 1 if wanted < 2 else int(min(style.round_below(wanted), 500))


def spaced(track: TrackSeries, apart_m: float, most: int, phase: float = 0.5) -> list[int]:
    """Return rows evenly spread along the distance gone, at most so many; the last row alone where nothing moves."""
    xy = track.position_m[:, :2]
    if len(xy) == 0:
        return []
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    if len(xy) < 3 or gone[-1] <= 0:
        return [len(xy) - 1]
    count = int(np.clip(gone[-1] / apart_m, 2, most))
    marks = (np.arange(count) + phase) / count * gone[-1]
    return sorted({int(np.argmin(np.abs(gone - mark))) for mark in marks})


def draw_headings(axes: Axes, track: TrackSeries, rows: list[int]) -> None:
    """Draw chevrons: where the vehicle points, or where it goes where no heading is known."""
    for i in rows:
        yaw = track.yaw_rad[i]
        if not np.isfinite(yaw):
            east, north = track.velocity_mps[i, :2]
            if not np.hypot(east, north) > 0.05:  # also where the velocity is not known
                continue
            yaw = np.arctan2(north, east)
        outline = np.array([[1.0, 0.0], [-0.75, 0.66], [-0.35, 0.0], [-0.75, -0.66], [1.0, 0.0]])
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        axes.plot(
            *track.position_m[i, :2],
            marker=outline @ turn,
            markersize=14,
            color=style.INK,
            markeredgecolor=style.GROUND,
            markeredgewidth=0.8,
            zorder=6.5,
        )


def mark_ends(axes: Axes, track: TrackSeries, colour: str, words: tuple[str, str]) -> None:
    """Mark and name where the track starts (ring) and ends (disc)."""
    for i, word, fill in ((0, words[0], style.GROUND), (-1, words[1], colour)):
        place = (float(track.position_m[i, 0]), float(track.position_m[i, 1]))
        axes.plot(*place, marker="o", ms=10.5, mfc=fill, mec=colour, mew=2.4, zorder=8)
        axes.annotate(
            word,
            place,
            xytext=(0, -14),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=10.5,
            fontweight="bold",
            color=style.INK,
            path_effects=style.HALO,
            annotation_clip=True,
            zorder=8.5,
        )
