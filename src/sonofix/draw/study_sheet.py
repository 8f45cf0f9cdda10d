"""The picture of a study: its panels row by row, and what was found beneath."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from sonofix.draw import style
from sonofix.records import Panel, Sheet

_LINES = {
    "truth": {"color": style.TRUTH, "linewidth": 1.2, "linestyle": (0, (4, 3)), "zorder": 3},
    "raw": {"color": style.EXCLUDED, "linewidth": 0.9, "marker": "o", "markersize": 2.6, "alpha": 0.9, "zorder": 4},
    "alone": {"color": style.MUTED, "linewidth": 1.3, "zorder": 2},
    "result": {"color": style.USED, "linewidth": 2.0, "zorder": 5},
    "bound": {"color": style.GOOD, "linewidth": 1.1, "linestyle": (0, (2, 2)), "zorder": 1},
    "points": {
        "color": style.CATEGORIES[1],
        "linestyle": "none",
        "marker": "o",
        "markersize": 6,
        "zorder": 6,
        "clip_on": False,
    },
}
_LEFT, _RIGHT, _TOP = 0.05, 1.0, 0.845
_LINE = 0.0205
"""Height of a line of the table, as a share of the figure's."""
_GAP_PX = 18.0
"""Least room between a name and its figure."""


def draw_study(sheet: Sheet, found: Sequence[tuple[str, str, str]] = ()) -> Figure:
    """Draw a study.

    Parameters
    ----------
    sheet : Sheet
    found : sequence of (case, quantity, figure)
        The table beneath, as it is to be written.

    Returns
    -------
    Figure
        16 × 10 inches, on an Agg canvas.
    """
    lines = -(-len(found) // 3)
    floor = 0.085 + _LINE * lines
    rows = -(-len(sheet.panels) // sheet.columns)
    with style.sheet() as figure:
        figure.text(_LEFT, 0.948, sheet.title, fontsize=26, fontweight="bold", color=style.INK, va="center")
        figure.text(_LEFT, 0.902, sheet.note, fontsize=12, color=style.MUTED, va="center")
        wide, high = (_RIGHT - _LEFT) / sheet.columns, (_TOP - floor) / rows
        for k, panel in enumerate(sheet.panels):
            row, column = divmod(k, sheet.columns)
            box = (_LEFT + column * wide, _TOP - (row + 1) * high + 0.06, wide - 0.05, high - 0.085)
            _panel(figure.add_axes(box), panel, 3 if sheet.columns > 2 else 6)
        for k, (case, quantity, figure_text) in enumerate(found):
            column, line = divmod(k, max(lines, 1))
            y = floor - 0.045 - _LINE * line
            x, width = _LEFT + column * (_RIGHT - _LEFT) / 3, (_RIGHT - _LEFT) / 3 - 0.05
            right = figure.text(x + width, y, figure_text, fontsize=9, color=style.INK, va="center", ha="right")
            name = figure.text(x, y, f"{case}: {quantity}", fontsize=8.5, color=style.MUTED, va="center")
            room_px = right.get_window_extent().x0 - _GAP_PX - name.get_window_extent().x0
            name.set_fontsize(8.5 * min(1.0, room_px / name.get_window_extent().width))
    return figure


def _panel(axes: Axes, panel: Panel, most: int) -> None:
    """Draw a panel; a legend above its curves has so many names a line at most."""
    style.dress(axes, panel.title, panel.note)
    for first, last in panel.blind:
        axes.axvspan(first, last, color=style.EDGE, alpha=0.35, linewidth=0, zorder=0)
    for curve in panel.curves:
        axes.plot(curve.x, curve.y, label=curve.name, **_LINES[curve.kind])  # pyright: ignore[reportArgumentType]
    axes.set_xlabel(panel.x_label, fontsize=9.5)
    axes.set_ylabel(panel.y_label, fontsize=9.5)
    if panel.logarithmic:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    if panel.y_limits is not None:
        axes.set_ylim(*panel.y_limits)
    ends = np.concatenate([curve.x[np.isfinite(curve.x)] for curve in panel.curves])
    axes.set_xlim(float(ends.min()), float(ends.max()))
    if (panel.x_label, panel.y_label) == ("x, m", "y, m"):
        # limits count as proposals, which the aspect may widen
        axes.set_autoscale_on(True)
        axes.set_aspect("equal", adjustable="datalim")
    columns = min(len(panel.curves), most) if panel.logarithmic else 1
    axes.legend(loc="upper left" if panel.logarithmic else "best", fontsize=8.5, ncols=columns, handlelength=1.8)
