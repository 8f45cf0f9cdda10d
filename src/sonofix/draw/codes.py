"""The picture of a set of codes: how loud each is in the search for each, and where the worst pair is worst."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sonofix.draw import style
from sonofix.records import Floats

LEVEL_MAP = LinearSegmentedColormap.from_list("level", [style.PANEL, "#23507f", style.USED, "#fbf3c4"])
"""From quiet to loud, ever lighter."""

# A map of more cells than this is no finer to the eye; each cell shows the loudest of what falls in it.
_COLUMNS, _ROWS = 560, 300
_MOST_WRITTEN = 24
_DEPTH_DB = 18.0
_HEADING = {"loc": "left", "color": style.INK, "fontsize": 11.5, "fontweight": "bold", "pad": 7}


def draw_codes(
    names: Sequence[str],
    level_db: Floats,
    surface_db: Floats,
    difference_mps: Floats,
    delay_s: Floats,
    sound_speed_mps: float,
    title: str,
    note: str = "",
) -> Figure:
    """Draw a set of codes.

    Parameters
    ----------
    names : sequence of str
        Of n ≥ 2 codes.
    level_db : float64 (n, n)
        ``[i, j]``: worst level of burst i in the search for j, dB of j's own peak; on the diagonal the side lobes.
    surface_db : float64 (m, k)
        Level of the worst pair at each difference of range rate and each delay of the search behind the burst.
    difference_mps : float64 (m,)
    delay_s : float64 (k,)
        Ascending.
    sound_speed_mps : float
        For the ways that delays stand for.
    title, note : str
        Heading, and the line under it.

    Returns
    -------
    Figure
        16 × 10 inches, on an Agg canvas.
    """
    apart = np.where(np.eye(len(names), dtype=bool), -np.inf, level_db)
    sent, listened = (int(k) for k in np.unravel_index(int(np.argmax(apart)), apart.shape))
    rate, delay = (int(k) for k in np.unravel_index(int(np.argmax(surface_db)), surface_db.shape))
    place = (float(delay_s[delay]) * sound_speed_mps, float(difference_mps[rate]))
    with style.sheet() as figure:
        figure.text(0.05, 0.948, title, fontsize=26, fontweight="bold", color=style.INK, va="center")
        figure.text(0.05, 0.902, note, fontsize=12, color=style.MUTED, va="center")
        figures = [
            (f"{np.diag(level_db).max():.1f} dB", "worst own side lobe"),
            (f"{apart[sent, listened]:.1f} dB", "worst pair"),
        ]
        for i, (value, name) in enumerate(figures):
            x, size = 0.98 - 0.135 * i, {"fontsize": 19, "fontweight": "bold"}
            figure.text(x, 0.952, _minus(value), color=style.GOOD, va="center", ha="right", **size)
            figure.text(x, 0.920, name, fontsize=9.5, color=style.MUTED, va="center", ha="right")
        _matrix(figure.add_axes((0.11, 0.15, 0.41, 0.68)), names, level_db, (sent, listened))
        plane = figure.add_axes((0.60, 0.39, 0.335, 0.44))
        _surface(figure, plane, surface_db, difference_mps, delay_s * sound_speed_mps, place)
        plane.set_title(f"{names[sent]}  in the search for  {names[listened]}", **_HEADING)
        _by_rate(figure.add_axes((0.60, 0.085, 0.335, 0.185)), surface_db, difference_mps)
    return figure


def _matrix(axes: Axes, names: Sequence[str], level_db: Floats, worst: tuple[int, int]) -> None:
    count = len(names)
    style.dress(axes, "Worst level, dB of the peak", "diagonal: own side lobes; ringed: worst pair")
    axes.grid(False)
    apart = level_db[~np.eye(count, dtype=bool)]
    norm = Normalize(float(min(apart.min(), level_db.min())) - 0.5, float(level_db.max()))
    axes.imshow(level_db, cmap=LEVEL_MAP, norm=norm, aspect="auto", interpolation="nearest")
    for i in range(1, count):
        axes.axhline(i - 0.5, color=style.GROUND, linewidth=1.5 if count <= 16 else 0.5)
        axes.axvline(i - 0.5, color=style.GROUND, linewidth=1.5 if count <= 16 else 0.5)
    if count <= _MOST_WRITTEN:
        size = float(np.clip(110 / count, 5.5, 11))
        for i in range(count):
            for j in range(count):
                red, green, blue, _ = LEVEL_MAP(norm(level_db[i, j]))
                light = 0.3 * red + 0.59 * green + 0.11 * blue > 0.5
                ink = style.GROUND if light else style.INK
                text = _minus(f"{level_db[i, j]:.1f}")
                slant = "italic" if i == j else "normal"
                axes.text(j, i, text, ha="center", va="center", color=ink, fontsize=size, fontstyle=slant)
    axes.add_patch(_frame(worst))
    every = int(np.ceil(count / 40))
    size = float(np.clip(150 / count, 6, 9.5))
    axes.set_yticks(range(0, count, every), names[::every], fontsize=size)
    axes.set_xticks(range(0, count, every), names[::every], fontsize=size, rotation=40, ha="right")
    axes.tick_params(length=0)
    axes.set_ylabel("sent")
    axes.set_xlabel("listened for")
    for side in ("bottom", "left"):
        axes.spines[side].set_visible(False)


def _frame(worst: tuple[int, int]) -> Rectangle:
    return Rectangle(
        (worst[1] - 0.5, worst[0] - 0.5), 1, 1, fill=False, edgecolor=style.EXCLUDED, linewidth=2.6, zorder=5
    )


def _surface(
    figure: Figure, axes: Axes, surface_db: Floats, difference_mps: Floats, path_m: Floats, place: tuple[float, float]
) -> None:
    """Draw the map of one pair, ringed where it is loudest."""
    style.dress(axes, "")
    axes.grid(False)
    cells = _loudest(_loudest(surface_db, _ROWS).T, _COLUMNS).T
    top = float(surface_db.max())
    half = 0.5 if len(difference_mps) == 1 else 0.5 * float(difference_mps[1] - difference_mps[0])
    extent = (path_m[0], path_m[-1], difference_mps[0] - half, difference_mps[-1] + half)
    norm = Normalize(top - _DEPTH_DB, top)
    image = axes.imshow(
        cells, cmap=LEVEL_MAP, norm=norm, aspect="auto", interpolation="nearest", origin="lower", extent=extent
    )
    ring = {"marker": "o", "markersize": 15, "fillstyle": "none", "clip_on": False}
    axes.plot(*place, color=style.GROUND, markeredgewidth=5, **ring)
    axes.plot(*place, color=style.EXCLUDED, markeredgewidth=2.4, **ring)
    words = f"loudest at {place[0]:+.2f} m, {place[1]:+.2f} m/s"
    axes.text(1.0, -0.1, _minus(words), transform=axes.transAxes, color=style.EXCLUDED, fontsize=10, ha="right")
    if len(difference_mps) == 1:
        axes.set_yticks([0.0])
    axes.set_xlabel("looked for later by, m of way", loc="left")
    axes.set_ylabel("difference of range rate, m/s")
    box = axes.get_position()
    bar = figure.colorbar(image, cax=figure.add_axes((box.x1 + 0.008, box.y0, 0.008, box.height)))
    bar.set_label("dB of the peak", color=style.MUTED)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]


def _minus(text: str) -> str:
    return text.replace("-", "\u2212")


def _loudest(values: Floats, most: int) -> Floats:
    """Gather rows into ``most`` at most, each the largest of those it stands for."""
    if len(values) <= most:
        return values
    return np.maximum.reduceat(values, np.arange(most) * len(values) // most, axis=0)


def _by_rate(axes: Axes, surface_db: Floats, difference_mps: Floats) -> None:
    style.dress(axes, "Its worst delay at each difference", "dB of the peak")
    worst = surface_db.max(axis=1)
    if len(difference_mps) == 1:
        style.message(axes, _minus(f"nothing moves: {worst[0]:.1f} dB at rest"))
        axes.set_yticks([])
        axes.set_xticks([])
        return
    axes.plot(difference_mps, worst, color=style.USED, linewidth=1.4)
    axes.axhline(float(worst.max()), color=style.EXCLUDED, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_xlim(difference_mps[0], difference_mps[-1])
    axes.set_xlabel("difference of range rate, m/s")
