"""The hall from above, to scale: what stands where, and the way the vehicles went."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from sonofix.draw import style, way
from sonofix.draw.nodes import draw_nodes, draw_rings
from sonofix.draw.series import Series, TrackSeries
from sonofix.draw.zoom import open_zoom, scale_bar
from sonofix.records import Floats, Recording, Truth


def draw_plan(axes: Axes, recording: Recording, series: Series, truths: Mapping[str, Truth]) -> list[Line2D]:
    """Draw the plan and return handles for its legend.

    One vehicle's track is coloured by time, several by vehicle. Ellipses (95 %) are enlarged by the round factor named
    in the legend where they would be too small to see; a vehicle that hardly moves is shown again, enlarged.
    """
    beacons, microphones = _places(recording)
    standing = [*beacons.values(), *microphones.values()]
    sounding = {name: track.position_m[-1] for name, track in series.tracks.items()}
    size_m = _frame(axes, recording, series, truths, beacons | microphones)
    _floor(axes, recording)
    draw_rings(axes, beacons or sounding, size_m)
    draw_nodes(axes, beacons, microphones, size_m)
    vehicles = list(dict.fromkeys([*series.tracks, *series.fixes, *truths]))
    colours = dict(zip(vehicles, style.category_colours(len(vehicles)), strict=True))
    clock = Normalize(*_wide(series.span_s)) if len(vehicles) == 1 else None
    zoom = open_zoom(axes, series, truths, standing) if len(vehicles) == 1 else None
    enlarge = 1 if zoom else way.enlargement(list(series.tracks.values()), size_m)
    apart_m, most = 0.08 * size_m, max(18 // max(len(vehicles), 1), 5)
    for vehicle, colour in colours.items():
        if vehicle in truths:
            _true_path(axes, truths[vehicle])
        if vehicle in series.fixes:
            way.draw_fixes(axes, series.fixes[vehicle], clock, colour, 1.0)
        if vehicle in series.tracks and zoom is None:
            track = series.tracks[vehicle]
            way.draw_line(axes, track, clock, colour)
            way.draw_ellipses(axes, track, way.spaced(track, apart_m, most), clock, colour, enlarge, 0.3 * size_m)
            way.draw_headings(axes, track, way.spaced(track, apart_m, most, 0.0)[1:])
            way.mark_ends(axes, track, style.INK if clock else colour, _end_names(track, clock, vehicle, size_m))
    if zoom is not None:
        _parked(axes, zoom, series, truths, clock)
    if not any(len(track.time_s) for track in series.tracks.values()) and not any(
        len(fix.time_s) for fix in series.fixes.values()
    ):
        _say_no_fix(axes, series)
    scale_bar(axes, standing)
    return _legend(series, truths, colours, clock is not None, enlarge, bool(beacons), bool(microphones))


def _places(recording: Recording) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return where the fixed beacons and the fixed microphones stand."""
    site = recording.site
    beacons = {node.id: np.asarray(node.position_m, float) for node in site.beacons if node.position_m is not None}
    microphones = {
        node.id: np.asarray(node.position_m, float) for node in site.microphones if node.position_m is not None
    }
    return beacons, microphones


def _end_names(track: TrackSeries, clock: Normalize | None, vehicle: str, size_m: float) -> tuple[str, str]:
    """Return what to write at the start and the end; one label where they would stand on each other."""
    if clock is None:
        return "", vehicle
    near = float(np.linalg.norm(track.position_m[-1, :2] - track.position_m[0, :2])) < 0.035 * size_m
    return ("", "start, end") if near else ("start", "end")


def _wide(span: tuple[float, float]) -> tuple[float, float]:
    """Return the span, opened to a second where it has no length."""
    return span if span[1] > span[0] else (span[0] - 0.5, span[0] + 0.5)


def _frame(
    axes: Axes, recording: Recording, series: Series, truths: Mapping[str, Truth], nodes: Mapping[str, Floats]
) -> float:
    """Set the limits so that all fits, to scale, and fills the axes; return the larger side in m.

    Of long tracks the outermost hundredth may leave the picture; where the truth is known the frame is laid about it,
    so that a stray estimate does not shrink the picture.
    """
    clouds = [np.array(list(nodes.values())).reshape(-1, 3)[:, :2]]
    clouds += [truth.position_m[:, :2] for truth in truths.values()]
    if recording.site.bounds_m is not None:
        clouds.append(np.asarray(recording.site.bounds_m, float)[:, :2])
    known = np.concatenate(clouds)
    for track in series.tracks.values():
        xy = track.position_m[:, :2]
        xy = np.percentile(xy, (1, 99), axis=0) if len(xy) > 200 else xy
        if truths and np.ptp(known, axis=0).max() > 0:
            slack = 0.1 * np.ptp(known, axis=0).max()
            xy = np.clip(xy, known.min(axis=0) - slack, known.max(axis=0) + slack)
        clouds.append(xy)
    points = np.concatenate(clouds)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.095 * max(float(max(high - low)), 0.1)
    box = axes.get_window_extent()
    shape = np.array([box.width, box.height])
    half = shape * float(max(((high - low) / 2 + margin) / shape))
    low, high = (low + high) / 2 - half, (low + high) / 2 + half
    axes.set_xlim(float(low[0]), float(high[0]))
    axes.set_ylim(float(low[1]), float(high[1]))
    axes.set_autoscale_on(False)
    axes.grid(True, color=style.GRID, linewidth=0.6)
    axes.set_xlabel("east x / m")
    axes.set_ylabel("north y / m")
    axes.tick_params(length=3)
    return float(max(high - low))


def _floor(axes: Axes, recording: Recording) -> None:
    """Draw the room where the site file states one."""
    if recording.site.bounds_m is None:
        return
    (x0, y0, _), (x1, y1, _) = recording.site.bounds_m
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=style.FLOOR, edgecolor="none", zorder=0.3))
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fc="none", ec=style.MUTED, linewidth=1.8, zorder=2.2))


def _true_path(axes: Axes, truth: Truth) -> None:
    path = truth.position_m
    axes.plot(path[:, 0], path[:, 1], color=style.TRUTH, linewidth=1.1, alpha=0.85, zorder=4)
    if len(path) == 1:
        axes.plot(path[:, 0], path[:, 1], marker="+", ms=13, mew=1.6, color=style.TRUTH, zorder=5.9)


def _parked(axes: Axes, zoom: Axes, series: Series, truths: Mapping[str, Truth], clock: Normalize | None) -> None:
    """Draw a vehicle that hardly moves: a ring on the plan; line, fixes, last ellipse and truth in the inset."""
    for vehicle, track in series.tracks.items():
        axes.plot(*track.position_m[-1, :2], marker="o", ms=17, mfc="none", mec=style.INK, mew=1.5, zorder=6)
        colour = style.CATEGORIES[0]
        way.draw_line(zoom, track, clock, colour, faint=True)
        way.draw_ellipses(zoom, track, [len(track.time_s) - 1], clock, colour, 1, np.inf)
        zoom.plot(*track.position_m[-1, :2], marker="o", ms=9, mfc=style.INK, mec=style.GROUND, zorder=8)
        if vehicle in truths:
            true = np.median(truths[vehicle].position_m[:, :2], axis=0)
            zoom.plot(*true, marker="+", ms=22, mew=2.0, color=style.TRUTH, zorder=7)
    for fixes in series.fixes.values():
        way.draw_fixes(zoom, fixes, clock, style.CATEGORIES[0], 3.0)
    zoom.set_autoscale_on(False)
    scale_bar(zoom, [])


def _say_no_fix(axes: Axes, series: Series) -> None:
    """Say across the plan that nothing was fixed, and the commonest remedy."""
    why = max(set(series.remedies), key=series.remedies.count) if series.remedies else ""
    if not series.epoch_count:
        why = "The recording holds no whole epoch."
    place = {"transform": axes.transAxes, "ha": "center", "path_effects": style.HALO, "zorder": 15}
    axes.text(0.5, 0.53, "No fix", va="bottom", fontsize=34, fontweight="bold", color=style.EXCLUDED, **place)
    axes.text(0.5, 0.50, _folded(why), va="top", fontsize=12.5, color=style.INK, linespacing=1.5, **place)


def _folded(text: str, columns: int = 72) -> str:
    """Break a sentence into lines of at most so many characters."""
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) >= columns:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


def _legend(
    series: Series,
    truths: Mapping[str, Truth],
    colours: Mapping[str, str],
    by_time: bool,
    enlarge: int,
    beacons: bool,
    microphones: bool,
) -> list[Line2D]:
    """Return handles for what the plan shows, in the order in which one looks for them."""
    handles: list[Line2D] = []
    middle = style.TIME_MAP(0.62)

    def dot(label: str, marker: str, size: float, **look: object) -> None:
        handles.append(Line2D([], [], linestyle="", marker=marker, markersize=size, label=label, **look))  # pyright: ignore[reportArgumentType]

    if series.tracks and by_time:
        handles.append(Line2D([], [], color=middle, linewidth=3, label="track, coloured by time"))
    elif len(series.tracks) > 8:
        handles.append(Line2D([], [], color=style.INK, linewidth=3, label="tracks, coloured by vehicle"))
    elif series.tracks:
        handles += [Line2D([], [], color=colours[name], linewidth=3, label=name) for name in series.tracks]
    if any(np.isfinite(track.covariance_m2[:, 0, 0]).any() for track in series.tracks.values()):
        dot(
            "95 % ellipse" if enlarge == 1 else f"95 % ellipse × {enlarge}",
            "o",
            12,
            markerfacecolor="none",
            color=middle,
        )
    if any(len(fix.time_s) for fix in series.fixes.values()):
        dot("fix of one epoch", "o", 3.5, color=style.INK)
    if truths:
        handles.append(Line2D([], [], color=style.TRUTH, linewidth=1.2, label="true path"))
    if beacons:
        dot("beacon", "^", 8, color=style.USED)
    if microphones:
        dot("microphone", "s", 7, color=style.GOOD)
    return handles
