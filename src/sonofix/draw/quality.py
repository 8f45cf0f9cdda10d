"""The picture of a plan: the floor in four to six maps, beacons and walls on each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from sonofix.draw import style
from sonofix.draw.codes import LEVEL_MAP
from sonofix.records import Floats, Quality, Walls

GOOD_MAP = LinearSegmentedColormap.from_list("good", ["#123a4a", "#1f8f8a", "#e9d66b", "#f0a050"])
"""From small and good to large and bad: dark green, yellow, orange."""

_NO_FIX = "#5a2430"
_NOTHING = ("0 %", "no fix")
"""Figures that are no success."""

_MOST_NAMED = 24
_SPAN = 50.0
"""A logarithmic map shows at most so many times its least value: what is worse looks alike."""

_OUTER = 5.0
"""Percent of the values at either end that look alike, too."""


@dataclass(frozen=True, slots=True)
class _Panel:
    """One map: ``values`` (ny, nx), NaN where there are none."""

    title: str
    note: str
    values: Floats
    kind: str


def draw_quality(
    quality: Quality,
    beacons: Mapping[str, Floats],
    walls: Walls,
    title: str,
    note: str = "",
    before: Quality | None = None,
    fault_m: float = 0.5,
    added: Sequence[str] = (),
    moved: Mapping[str, Floats] | None = None,
    room_m: tuple[Sequence[float], Sequence[float]] | None = None,
) -> Figure:
    """Draw what a layout promises.

    Parameters
    ----------
    quality : Quality
        What is mapped.
    beacons : mapping from id to float64 (3,)
    walls : Walls
    title, note : str
        Heading, and the line under it.
    before : Quality, optional
        Before an improvement; its figures stand beside those of ``quality``.
    fault_m : float
        Fault whose detection the key figures speak of.
    added : sequence of str
        Ids of new beacons.
    moved : mapping from id to float64 (3,), optional
        Where moved beacons came from.
    room_m : two corners, optional

    Returns
    -------
    Figure
        16 × 10 inches, on an Agg canvas.
    """
    panels = _panels(quality)
    with style.sheet() as figure:
        columns = len(panels) // 2
        left, floor, wide, high = 0.05, 0.095, 0.935, 0.775
        for k, panel in enumerate(panels):
            column, row = k % columns, k // columns
            box = (
                left + column * wide / columns,
                floor + (1 - row) * (high / 2 + 0.015),
                wide / columns - 0.075,
                high / 2 - 0.06,
            )
            axes = figure.add_axes(box)
            _map(figure, axes, panel, quality)
            _ground(axes, walls, room_m)
            _nodes(axes, beacons, added, moved or {}, named=k == 0)
        _legend(figure, quality, walls, added, moved or {})
        _head(figure, quality, before, title, note, fault_m)
    return figure


def _panels(quality: Quality) -> list[_Panel]:
    level = "level known" if quality.vdop is None else "height unknown"
    heard = np.where(quality.floor, quality.heard, np.nan).astype(float)
    dilution = "error over range error"
    fault = np.where(np.isfinite(quality.fault_m), quality.fault_m, np.nan)
    panels = [
        _Panel("Beacons heard", "in reach and in sight", heard, "count"),
        _Panel("HDOP", f"{dilution}, {level}", quality.hdop, "dilution"),
        _Panel("Expected deviation", "of the position, one fix alone", quality.sd_m, "length"),
        _Panel("Fault detected", "of any one range, linear model", fault, "fault"),
    ]
    if quality.vdop is not None and quality.sd_z_m is not None:
        panels.insert(2, _Panel("VDOP", "the same, for the height", quality.vdop, "dilution"))
        panels.insert(4, _Panel("Expected deviation of the height", "", quality.sd_z_m, "length"))
    return panels


def _map(figure: Figure, axes: Axes, panel: _Panel, quality: Quality) -> None:
    style.dress(axes, panel.title, panel.note)
    axes.grid(False)
    half_x, half_y = (0.5 * float(g[1] - g[0]) if len(g) > 1 else 0.5 for g in (quality.x_m, quality.y_m))
    extent = (quality.x_m[0] - half_x, quality.x_m[-1] + half_x, quality.y_m[0] - half_y, quality.y_m[-1] + half_y)
    axes.set_facecolor(style.FLOOR)
    look = {"origin": "lower", "extent": extent, "interpolation": "nearest", "aspect": "equal"}
    lacking = np.zeros((*quality.floor.shape, 4))
    shade = (*(int(_NO_FIX[i : i + 2], 16) / 255 for i in (1, 3, 5)), 1.0)
    lacking[quality.floor & ~np.isfinite(panel.values)] = shade
    axes.imshow(lacking, zorder=1.0, **look)
    known = panel.values[np.isfinite(panel.values)]
    axes.set_xlabel("east x / m")
    axes.set_ylabel("north y / m")
    if not known.size:
        words = "no fix anywhere" if panel.kind != "fault" else "no fault is detected anywhere"
        style.message(axes, words)
        return
    factor, unit = style.length_unit(float(np.median(known))) if panel.kind in ("length", "fault") else (1.0, "")
    shown = panel.values * factor
    if panel.kind == "count":
        low, high = int(known.min()), int(known.max())
        steps = np.arange(low, high + 2) - 0.5
        colours = LEVEL_MAP.resampled(max(high - low + 1, 2))
        norm: Normalize = BoundaryNorm(steps.tolist(), colours.N) if high > low else Normalize(low - 1, high)
    else:
        low, high = (float(v) * factor for v in np.percentile(known, (_OUTER, 100 - _OUTER)))
        low = max(low, 1e-9)
        norm, colours = LogNorm(low, float(np.clip(high, 1.5 * low, _SPAN * low))), GOOD_MAP
    image = axes.imshow(shown, cmap=colours, norm=norm, zorder=1.1, **look)
    # beside the map as it is drawn, not as the axes were asked for: the map keeps its shape
    place = axes.inset_axes((1.015, 0.0, 0.022, 1.0))
    bar = figure.colorbar(image, cax=place)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    if panel.kind == "count":
        every = max(int(np.ceil((high - low + 1) / 8)), 1)
        bar.set_ticks(list(range(int(low), int(high) + 1, every)))
    else:
        _log_ticks(bar.ax, norm)
        bar.set_label(unit, color=style.MUTED)


def _log_ticks(axes: Axes, norm: Normalize) -> None:
    """Write plain numbers at 1, 2 and 5 times powers of ten, or evenly where that leaves fewer than three."""
    low, high = float(norm.vmin or 0.0), float(norm.vmax or 1.0)
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    ticks = sorted({round(float(s * p), 9) for s in (1, 2, 5) for p in powers if low <= s * p <= high})
    if len(ticks) < 3:
        ticks = [float(t) for t in MaxNLocator(5).tick_values(low, high) if low <= t <= high]
    axes.set_yticks(ticks)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_locator(LogLocator(subs=[]))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _ground(axes: Axes, walls: Walls, room_m: tuple[Sequence[float], Sequence[float]] | None) -> None:
    """Draw room, obstacles and walls; what ends below the ceiling is dashed."""
    if room_m is not None:
        (x0, y0), (x1, y1) = room_m[0][:2], room_m[1][:2]
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fc="none", ec=style.MUTED, linewidth=1.6, zorder=2.2))
    for number in np.unique(walls.solid[walls.solid >= 0]):
        edge = walls.solid == number
        axes.add_patch(
            PathPatch(_outline(walls, edge), facecolor=style.EDGE, edgecolor=style.INK, linewidth=0.9, zorder=2.3)
        )
    line = walls.solid < 0
    for full, dash in ((True, "solid"), (False, (0, (3, 1.5)))):
        which = line & (np.isinf(walls.height_m) == full)
        pieces = np.stack([walls.start_m[which], walls.end_m[which]], axis=1)
        axes.add_collection(LineCollection(list(pieces), colors=style.INK, linewidths=1.8, linestyles=dash, zorder=2.4))


def _outline(walls: Walls, edge: NDArray[np.bool_]) -> Outline:
    """Return an obstacle's rings as one path: a piece that does not begin where the last ended begins a ring."""
    vertices, codes = [], []
    last = None
    for start, end in zip(walls.start_m[edge], walls.end_m[edge], strict=True):
        if last is None or np.any(start != last):
            vertices.append(start)
            codes.append(Outline.MOVETO)
        vertices.append(end)
        codes.append(Outline.LINETO)
        last = end
    return Outline(np.array(vertices), codes)


def _nodes(
    axes: Axes, beacons: Mapping[str, Floats], added: Sequence[str], moved: Mapping[str, Floats], named: bool
) -> None:
    crowd = len(beacons) > _MOST_NAMED
    middle = float(np.mean(axes.get_ylim()))
    for name, place in beacons.items():
        new = name in added
        colour = style.GOOD if new else style.EXCLUDED if name in moved else style.USED
        axes.plot(
            *place[:2],
            marker="*" if new else "^",
            markersize=(15 if new else 9) * (0.7 if crowd else 1.0),
            color=colour,
            markeredgecolor=style.GROUND,
            markeredgewidth=1.2,
            clip_on=False,
            zorder=6,
        )
        if name in moved and named:
            axes.annotate(
                "",
                tuple(place[:2]),
                tuple(moved[name][:2]),
                arrowprops={"arrowstyle": "->", "color": style.EXCLUDED, "linewidth": 1.4},
                zorder=5,
            )
        if named and (not crowd or new):
            # names keep out of the heading above the map
            over = float(place[1]) < middle
            axes.annotate(
                name,
                (float(place[0]), float(place[1])),
                xytext=(0, 8 if over else -8),
                textcoords="offset points",
                ha="center",
                va="bottom" if over else "top",
                fontsize=9,
                fontweight="bold",
                color=colour,
                path_effects=style.HALO,
                zorder=7,
            )


def _legend(figure: Figure, quality: Quality, walls: Walls, added: Sequence[str], moved: Mapping[str, Floats]) -> None:
    def dot(label: str, marker: str, size: float, colour: str) -> Line2D:
        return Line2D([], [], linestyle="", marker=marker, markersize=size, color=colour, label=label)

    handles: list[Line2D | Patch] = [dot("beacon", "^", 9, style.USED)]
    if added:
        handles.append(dot("new beacon", "*", 14, style.GOOD))
    if moved:
        handles.append(dot("moved beacon", "^", 9, style.EXCLUDED))
    if np.any(walls.solid >= 0):
        handles.append(Patch(facecolor=style.EDGE, edgecolor=style.INK, label="obstacle"))
    line = walls.solid < 0
    if np.any(line & np.isinf(walls.height_m)):
        handles.append(Line2D([], [], color=style.INK, linewidth=1.8, label="wall to the ceiling"))
    if np.any(line & np.isfinite(walls.height_m)):
        handles.append(Line2D([], [], color=style.INK, linewidth=1.8, linestyle=(0, (3, 1.5)), label="lower wall"))
    if np.any(quality.floor & ~np.isfinite(quality.fault_m)):
        handles.append(Patch(facecolor=_NO_FIX, label="no fix there, or no fault detected"))
    figure.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.043, 0.006), ncols=len(handles), columnspacing=1.8
    )


def _head(figure: Figure, quality: Quality, before: Quality | None, title: str, note: str, fault_m: float) -> None:
    figure.text(0.05, 0.948, title, fontsize=26, fontweight="bold", color=style.INK, va="center")
    figure.text(0.05, 0.888, note.replace(" -", " \u2212"), fontsize=10.5, color=style.MUTED, va="center")
    now = _key_figures(quality, fault_m)
    then = [None] * len(now) if before is None else [value for value, _ in _key_figures(before, fault_m)]
    for i, ((value, name), was) in enumerate(zip(now[::-1], then[::-1], strict=True)):
        x = 0.985 - (0.13 if before is None else 0.19) * i
        text = value if was is None or was == value else f"{was} → {value}"
        colour = style.EXCLUDED if value in _NOTHING else style.GOOD
        figure.text(x, 0.952, text, fontsize=17, fontweight="bold", color=colour, va="center", ha="right")
        figure.text(x, 0.922, name, fontsize=9.5, color=style.MUTED, va="center", ha="right")


def _key_figures(quality: Quality, fault_m: float) -> list[tuple[str, str]]:
    within = quality.over_floor(quality.sd_m, 95)
    return [
        (_percent(quality.share(quality.fix)), "of the floor with a fix"),
        (_two_figures(within) if np.isfinite(within) else _NOTHING[1], "deviation, 95 % of it within"),
        (
            _percent(quality.share(quality.fault_m <= fault_m)),
            f"detects a fault of {style.length_text(fault_m)}",
        ),
    ]


def _percent(share: float) -> str:
    """Write a share in per cent, and with a decimal where 100 would be said of less than all."""
    return f"{100 * share:.0f} %" if share == 1.0 or share < 0.99 else f"{min(100 * share, 99.9):.1f} %"


def _two_figures(length_m: float) -> str:
    factor, unit = style.length_unit(length_m)
    value = length_m * factor
    return f"{value:.2g} {unit}" if value < 99.5 else f"{value:.0f} {unit}"
