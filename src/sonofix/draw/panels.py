"""The small panels beside the plan: what was heard, what the ranges left over, how far the track was off."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba

from sonofix.draw import style
from sonofix.draw.series import Series, TrackSeries
from sonofix.draw.way import MANY
from sonofix.records import Floats, Truth

_COLUMNS = 240


def draw_heard(axes: Axes, series: Series) -> None:
    """Draw a strip a lane: bright where its bursts were used, orange where heard but not used, dark where silent.

    Long runs are gathered into 240 columns; the more of a column's epochs were heard, the brighter the cell.
    """
    style.dress(axes, f"Heard, by {series.lane_kind}")
    axes.grid(False)
    ranges, lanes = series.ranges, len(series.lanes)
    if not len(ranges.time_s):
        style.message(axes, "nothing heard")
        axes.set_yticks([])
        return
    start, stop = series.span_s
    columns = int(np.clip(series.epoch_count, 1, _COLUMNS))
    width = (stop - start) / columns or 1.0
    column = np.clip(((ranges.time_s - start) / width).astype(int), 0, columns - 1)
    used, excluded = np.zeros((lanes, columns)), np.zeros((lanes, columns))
    np.add.at(used, (ranges.lane[ranges.used], column[ranges.used]), 1)
    np.add.at(excluded, (ranges.lane[~ranges.used], column[~ranges.used]), 1)
    heard = used + excluded
    usual = max(float(np.percentile(heard[heard > 0], 75)), 1.0)
    bright = np.where(heard > 0, 0.4 + 0.6 * np.minimum(heard / usual, 1.0), 0.0)
    share = used / np.maximum(heard, 1)
    hue = share[..., None] * np.array(to_rgba(style.USED)[:3]) + (1 - share[..., None]) * np.array(
        to_rgba(style.EXCLUDED)[:3]
    )
    ground = np.array(to_rgba(style.PANEL)[:3])
    image = ground + bright[..., None] * (hue - ground)
    edge = start if stop > start else start - 0.5
    axes.imshow(
        image,
        aspect="auto",
        interpolation="nearest",
        extent=(edge, edge + columns * width, lanes - 0.5, -0.5),
        zorder=1,
    )
    for i in range(1, lanes):
        axes.axhline(i - 0.5, color=style.GROUND, linewidth=2.0 if lanes <= 16 else 0.8, zorder=2)
    if columns <= 80:
        for i in range(1, columns):
            axes.axvline(edge + i * width, color=style.GROUND, linewidth=1.2, zorder=2)
    every = int(np.ceil(lanes / 16))
    axes.set_yticks(range(0, lanes, every), series.lanes[::every], fontsize=9.5 if lanes <= 10 else 7.5)
    axes.tick_params(length=0)
    axes.spines["bottom"].set_visible(False)
    axes.spines["left"].set_visible(False)
    _note(axes, [("used", style.USED), ("not used", style.EXCLUDED)])


def draw_residuals(axes: Axes, series: Series) -> None:
    """Draw measured less computed range of every row, a colour a lane; excluded rows are small crosses."""
    ranges = series.ranges
    known = np.isfinite(ranges.residual_m)
    if not known.any():
        style.dress(axes, "Range residuals")
        style.message(axes, "no fix, so no residuals")
        axes.set_yticks([])
        return
    inside = known & ranges.used
    reach = np.percentile(np.abs(ranges.residual_m[inside if inside.any() else known]), 99.5)
    limit = max(1.25 * float(reach), 1e-4)
    factor, unit = style.length_unit(limit)
    style.dress(axes, f"Range residuals, {unit}")
    colours = np.array([to_rgba(colour) for colour in style.category_colours(len(series.lanes))])
    many = int(inside.sum()) > 1500
    shown = np.clip(ranges.residual_m, -limit, limit) * factor
    axes.axhline(0, color=style.EDGE, linewidth=1.0, zorder=1.5)
    outside = known & ~ranges.used
    axes.scatter(
        ranges.time_s[outside],
        shown[outside],
        s=14,
        marker="x",
        color=style.EXCLUDED,
        linewidths=0.8,
        alpha=0.3 if many else 0.7,
        zorder=2,
    )
    axes.scatter(
        ranges.time_s[inside],
        shown[inside],
        s=3 if many else 13,
        c=colours[ranges.lane[inside]],
        linewidths=0,
        alpha=0.45 if many else 0.85,
        zorder=3,
    )
    axes.set_ylim(-1.08 * limit * factor, 1.08 * limit * factor)
    if 1 < len(series.lanes) <= 10:
        _note(axes, list(zip(series.lanes, style.category_colours(len(series.lanes)), strict=True)))


def draw_deviation(axes: Axes, series: Series, truths: Mapping[str, Truth]) -> None:
    """Draw the track's error against the truth; without a truth, how far the fixes scatter about the track.

    For one vehicle east and north (and up where it is estimated) with two standard deviations; for several
    the horizontal distance, a colour a vehicle.
    """
    known = {name: track for name, track in series.tracks.items() if name in truths}
    curves = {name: (track, error_m(track, truths[name])) for name, track in known.items()}
    heading = "Track error" if known else "Fixes about the track"
    if not known:
        curves = _scatter_about_track(series)
    curves = {name: curve for name, curve in curves.items() if np.isfinite(curve[1][:, :2]).any()}
    if not curves:
        style.dress(axes, heading)
        style.message(axes, "no track, so nothing to compare")
        axes.set_yticks([])
    elif len(curves) == 1:
        _one_by_axis(axes, heading, *next(iter(curves.values())), lines=bool(known))
    else:
        _many_by_distance(axes, heading, curves, dict(zip(series.tracks, style.category_colours(99), strict=False)))


def _one_by_axis(axes: Axes, heading: str, track: TrackSeries, error: Floats, lines: bool) -> None:
    """Draw east, north and, where it is estimated, up; with ``lines`` also two standard deviations, dotted."""
    names = ["east", "north"] + (["up"] if np.isfinite(track.covariance_m2[:, 2, 2]).any() else [])
    colours = [style.CATEGORIES[0], style.CATEGORIES[1], style.CATEGORIES[4]]
    limit = 1.35 * max(float(np.nanpercentile(np.abs(error[:, k]), 98)) for k in range(len(names)))
    sd = track.sd_m()
    if lines and np.isfinite(sd[:, :2]).any():
        limit = max(limit, min(2.4 * float(np.nanmedian(sd[:, :2])), 5 * limit))
    limit = max(limit, 1e-5)
    factor, unit = style.length_unit(limit)
    style.dress(axes, f"{heading}, {unit}")
    axes.axhline(0, color=style.EDGE, linewidth=1.0, zorder=1.2)
    fine = len(track.time_s) > MANY
    for k in reversed(range(len(names))):
        dots = not lines or len(track.time_s) == 1
        axes.plot(
            track.time_s,
            error[:, k] * factor,
            color=colours[k],
            linestyle="" if dots else "-",
            linewidth=0.8 if fine else 1.6,
            marker="o" if dots else "",
            markersize=1.5 if fine else 3.5,
            zorder=3,
        )
        if lines and not dots:
            look = {"color": colours[k], "linewidth": 0.9, "linestyle": (0, (1, 2)), "alpha": 0.7, "zorder": 2}
            if fine:
                look |= {"linewidth": 0.6, "linestyle": "-", "alpha": 0.35}
            axes.plot(track.time_s, np.outer(sd[:, k], (-2, 2)) * factor, **look)
    axes.set_ylim(-limit * factor, limit * factor)
    _note(axes, list(zip(names, colours, strict=False)), ("faint" if fine else "dotted") + ": 2 sd" if lines else "")


def _many_by_distance(
    axes: Axes, heading: str, curves: Mapping[str, tuple[TrackSeries, Floats]], colours: Mapping[str, str]
) -> None:
    """Draw the horizontal distance, a colour a vehicle."""
    away = {name: np.hypot(error[:, 0], error[:, 1]) for name, (_, error) in curves.items()}
    limit = max(1.35 * max(float(np.nanpercentile(distance, 98)) for distance in away.values()), 1e-5)
    factor, unit = style.length_unit(limit)
    style.dress(axes, f"{heading}, {unit}")
    for name, (track, _) in curves.items():
        width = 0.8 if len(track.time_s) > MANY else 1.6
        axes.plot(track.time_s, away[name] * factor, color=colours[name], linewidth=width, alpha=0.9, zorder=3)
    axes.set_ylim(0, limit * factor)
    _note(axes, [(name, colours[name]) for name in curves] if len(curves) <= 8 else [], "horizontal")


def mark_time(axes: Axes, series: Series, coloured: bool) -> None:
    """Label the time axis under the lowest panel, with the colours that time has on the plan."""
    axes.set_xlabel("time / s")
    if coloured:
        ramp = axes.inset_axes((0.0, -0.055, 1.0, 0.035))
        ramp.imshow(np.linspace(0, 1, 256)[None], aspect="auto", cmap=style.TIME_MAP)
        ramp.set_axis_off()
        axes.tick_params(axis="x", pad=9)
        axes.spines["bottom"].set_visible(False)


def error_m(track: TrackSeries, truth: Truth) -> Floats:
    """Return estimated less true position, shape (n, 3); NaN outside the truth's span (one row holds for ever)."""
    if len(truth.time_s) == 1:
        return track.position_m - truth.position_m[0]
    true = np.column_stack([np.interp(track.time_s, truth.time_s, truth.position_m[:, k]) for k in range(3)])
    outside = (track.time_s < truth.time_s[0]) | (track.time_s > truth.time_s[-1])
    return np.where(outside[:, None], np.nan, track.position_m - true)


def _scatter_about_track(series: Series) -> dict[str, tuple[TrackSeries, Floats]]:
    """Return, for each vehicle, its track at the moments of its fixes and the fixes' distance from it."""
    curves = {}
    for name, track in series.tracks.items():
        fixes = series.fixes.get(name)
        if fixes is None or not fixes.sound.any() or not len(track.time_s):
            continue
        at = fixes.time_s[fixes.sound]
        near = np.clip(np.searchsorted(track.time_s, at), 0, len(track.time_s) - 1)
        expected = np.column_stack([np.interp(at, track.time_s, track.position_m[:, k]) for k in range(3)])
        there = TrackSeries(
            at,
            expected,
            track.velocity_mps[near],
            track.yaw_rad[near],
            track.covariance_m2[near],
            track.predicted[near],
        )
        curves[name] = (there, fixes.position_m[fixes.sound] - expected)
    return curves


def _note(axes: Axes, names: list[tuple[str, str]], tail: str = "") -> None:
    """Write coloured words at the right of a panel's heading: its legend."""
    x = 1.0
    for text, colour in [(tail, style.MUTED)] * bool(tail) + names[::-1]:
        written = axes.annotate(
            text,
            (x, 1.0),
            xycoords="axes fraction",
            xytext=(0, 8),
            textcoords="offset points",
            ha="right",
            va="bottom",
            color=colour,
            fontsize=9.5,
            fontweight="bold" if colour != style.MUTED else "normal",
        )
        canvas = axes.figure.canvas
        size = written.get_window_extent(canvas.get_renderer())  # pyright: ignore[reportAttributeAccessIssue]
        x -= (size.width + 9) / axes.get_window_extent().width
