"""Delay–velocity maps of beacons: as heard, and when all other bursts are taken away."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle

from sonofix.draw import style
from sonofix.draw.codes import LEVEL_MAP
from sonofix.records import BeaconInsight, Floats, Insight

MAPS_A_PAGE = 8
_PAD_M, _LEAST_M = 0.8, 3.0
_PAD_MPS, _LEAST_MPS = 0.5, 2.0
_COLUMNS = 320


def shown_ways(beacon: BeaconInsight) -> tuple[float, float]:
    """Ways worth showing, m: those of the paths kept and of the prediction, with some room; else the whole window."""
    ways = [path.range_m for path in beacon.paths if not path.dropped]
    if not ways:
        return (float(beacon.range_m[0]), float(beacon.range_m[-1])) if len(beacon.range_m) else (0.0, 1.0)
    return _with_room([*ways, *(beacon.predicted[0] if beacon.predicted else ())], _PAD_M, _LEAST_M)


def _shown_rates(beacon: BeaconInsight, half_mps: float) -> tuple[float, float]:
    """As `shown_ways`, for range rates."""
    whole = float(beacon.range_rate_mps[0]) - half_mps, float(beacon.range_rate_mps[-1]) + half_mps
    rates = [path.range_rate_mps for path in beacon.paths if not path.dropped]
    if not rates:
        return whole
    low, high = _with_room([*rates, *(beacon.predicted[1] if beacon.predicted else ())], _PAD_MPS, _LEAST_MPS)
    return max(low, whole[0]), min(high, whole[1])


def _with_room(values: Sequence[float], pad: float, least: float) -> tuple[float, float]:
    low, high = min(values) - pad, max(values) + pad
    more = max(0.0, least - (high - low)) / 2
    return low - more, high + more


def draw_surfaces(insight: Insight, beacons: Sequence[BeaconInsight], title: str, facts: str) -> Figure:
    """Draw two maps for each of at most eight beacons.

    Parameters
    ----------
    insight : Insight
    beacons : sequence of BeaconInsight
    title, facts : str
        Heading, and the line under it.

    Returns
    -------
    Figure
        16 × 10 inches, on an Agg canvas.
    """
    with style.sheet() as figure:
        figure.text(0.05, 0.952, title, fontsize=26, fontweight="bold", color=style.INK, va="center")
        figure.text(0.05, 0.910, facts, fontsize=12, color=style.MUTED, va="center")
        caption = (
            "How well each beacon's burst fits, by way and range rate, in dB over the noise; pale: no less than its own"
            " peak.  Rings: paths; green, with triangle: the range."
        )
        if any(beacon.predicted is not None for beacon in beacons):
            caption += "  Dashed: what the search looked through."
        figure.text(0.05, 0.876, caption, fontsize=10, color=style.MUTED, va="center")
        rows = -(-len(beacons) // 2)
        height = 0.835 / max(rows, 2)
        for i, beacon in enumerate(beacons):
            x, y = 0.05 + 0.48 * (i % 2), 0.86 - height * (i // 2 + 1) + 0.04
            _draw_pair(figure, (x, y, 0.197, height - 0.088), beacon)
            _head(figure, x, y + height - 0.08, beacon, insight)
    return figure


def _draw_pair(figure: Figure, box: tuple[float, float, float, float], beacon: BeaconInsight) -> None:
    """Draw a beacon's two maps, and their scale beside them."""
    x, y, width, height = box
    top_db = max(beacon.threshold_db + 3.0, float(np.max(beacon.alone_db, initial=0.0)))
    # cross-talk and side lobes fill the maps at half the peak's decibels: they are to stay dark
    norm = PowerNorm(2.5, 0.0, top_db, clip=True)
    maps = {"as heard": beacon.heard_db, "all else taken away": beacon.alone_db}
    image: AxesImage | None = None
    for k, (name, level_db) in enumerate(maps.items()):
        axes = figure.add_axes((x + k * (width + 0.012), y, width, height))
        image = _draw_map(axes, beacon, level_db, norm)
        _mark(axes, beacon, alone=k == 1)
        plate = {"facecolor": style.GROUND, "alpha": 0.75, "linewidth": 0, "pad": 2.0}
        axes.text(0.018, 0.94, name, transform=axes.transAxes, fontsize=9, va="top", bbox=plate, zorder=7)
        axes.set_xlabel("way, m", labelpad=0, fontsize=9)
        if k:
            axes.tick_params(labelleft=False)
        else:
            axes.set_ylabel("m/s", labelpad=1, fontsize=9)
    if image is not None:
        bar = figure.colorbar(image, cax=figure.add_axes((x + 2 * width + 0.017, y, 0.005, height)))
        bar.set_ticks([0, round(0.5 * top_db), round(0.75 * top_db), round(top_db - 0.5)])
        bar.ax.tick_params(labelsize=8.5, length=2, pad=2)
        bar.ax.set_title("dB", fontsize=8.5, color=style.MUTED, pad=4)
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]


def _head(figure: Figure, x: float, y: float, beacon: BeaconInsight, insight: Insight) -> None:
    """Write over a pair of maps whose they are and what was found."""
    name = figure.text(x, y, beacon.beacon, fontsize=11.5, fontweight="bold", color=style.INK, va="bottom")
    path = beacon.reported
    text, colour = beacon.verdict, style.EXCLUDED
    if path is not None and path.range_sd_m is not None:
        others = sum(not p.dropped for p in beacon.paths) - 1
        colour = style.MUTED
        text = (
            f"{path.range_m:.4f} m ± {1e3 * path.range_sd_m:.2f} mm   {path.range_rate_mps:+.3f} m/s"
            f"   {path.level_db:.0f} dB"
        ).replace("-", "\u2212")
        text += f"   and {others} later" if others else ""
        if not insight.used.get(beacon.beacon, True):
            text, colour = f"{text}   not used", style.EXCLUDED
    width = name.get_window_extent().width / figure.bbox.width
    figure.text(x + width + 0.01, y, text, fontsize=9.5, color=colour, va="bottom")


def _draw_map(axes: Axes, beacon: BeaconInsight, level_db: Floats, norm: PowerNorm) -> AxesImage | None:
    low, high = shown_ways(beacon)
    rates = beacon.range_rate_mps
    half = 0.5 * float(rates[1] - rates[0]) if len(rates) > 1 else 0.5
    inside = np.flatnonzero((beacon.range_m >= low) & (beacon.range_m <= high))
    axes.grid(False)
    axes.set_xlim(low, high)
    bounds = _shown_rates(beacon, half)
    axes.set_ylim(bounds)
    axes.tick_params(length=2, labelsize=8.5, pad=2)
    if not len(inside):
        style.message(axes, "no samples")
        return None
    cells = level_db[:, inside]
    if cells.shape[1] > _COLUMNS:
        # no finer than the eye: each cell shows the loudest of what falls in it
        cells = np.maximum.reduceat(cells, np.arange(_COLUMNS) * cells.shape[1] // _COLUMNS, axis=1)
    step = 0.5 * float(beacon.range_m[1] - beacon.range_m[0]) if len(beacon.range_m) > 1 else 0.5
    extent = (
        float(beacon.range_m[inside[0]] - step),
        float(beacon.range_m[inside[-1]] + step),
        rates[0] - half,
        rates[-1] + half,
    )
    image = axes.imshow(
        cells, cmap=LEVEL_MAP, norm=norm, aspect="auto", interpolation="nearest", origin="lower", extent=extent
    )
    axes.set_xlim(low, high)
    axes.set_ylim(bounds)
    return image


def _mark(axes: Axes, beacon: BeaconInsight, alone: bool) -> None:
    """Mark prediction and range, and, on the map of the beacon alone, all paths kept."""
    if beacon.predicted is not None:
        (low, high), (slow, fast) = beacon.predicted
        for line in (
            {"linewidth": 3.0, "edgecolor": style.GROUND, "alpha": 0.7},
            {"linewidth": 1.2, "edgecolor": style.INK, "linestyle": (0, (3, 2))},
        ):
            axes.add_patch(Rectangle((low, slow), high - low, fast - slow, fill=False, **line))
    for path in sorted(beacon.paths, key=lambda path: path.is_range):
        place = (path.range_m, path.range_rate_mps)
        if path.is_range:
            across = axes.get_xaxis_transform()
            axes.plot(path.range_m, 1.0, "v", color=style.GOOD, markersize=8, transform=across, clip_on=False, zorder=6)
        if alone and not path.dropped:
            size = 14 if path.is_range else 9
            ring = {"marker": "o", "fillstyle": "none", "markersize": size}
            colour = style.GOOD if path.is_range else style.CATEGORIES[1]
            axes.plot(*place, color=style.GROUND, markeredgewidth=3.0, **ring)
            axes.plot(*place, color=colour, markeredgewidth=1.4, **ring)
