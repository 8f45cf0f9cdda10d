"""One look for every picture: night blue, light ink, and colours that the colour-blind can tell apart.

The category colours are those of Okabe and Ito (Color Universal Design, 2008), lightened for a dark ground; time runs
through the upper part of Matplotlib's "plasma", which is perceptually uniform.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

GROUND = "#0a1220"
PANEL = "#0f1a2d"
FLOOR = "#132139"
GRID = "#1f3050"
EDGE = "#33486e"
INK = "#e8eef8"
MUTED = "#8fa1bf"
TRUTH = "#c9d6ea"
USED = "#4cc3e8"
EXCLUDED = "#f08a4b"
GOOD = "#3fd0a4"

CATEGORIES = ("#5bb8f0", "#f2b33d", "#35cda6", "#f07f4f", "#e2a0cc", "#f3ec7c", "#8ea2ff", "#c3cfe2")
TIME_MAP = LinearSegmentedColormap.from_list("time", colormaps["plasma"](np.linspace(0.32, 0.99, 256)))
HALO = [withStroke(linewidth=3, foreground=FLOOR, alpha=0.85)]

SIZE_IN = (16.0, 10.0)
DPI = 100

_SETTINGS = {
    "font.family": "DejaVu Sans",
    "font.size": 10.5,
    "text.color": INK,
    "axes.edgecolor": EDGE,
    "axes.labelcolor": MUTED,
    "axes.facecolor": PANEL,
    "axes.linewidth": 0.8,
    "axes.unicode_minus": True,
    "axes.axisbelow": True,
    "xtick.color": EDGE,
    "ytick.color": EDGE,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "xtick.labelsize": 9.5,
    "ytick.labelsize": 9.5,
    "legend.frameon": False,
    "legend.labelcolor": MUTED,
    "figure.facecolor": GROUND,
    "savefig.facecolor": GROUND,
}


@contextmanager
def sheet() -> Iterator[Figure]:
    """Open an empty figure of 16 × 10 inches in the house style; the style holds inside the ``with`` block only."""
    with rc_context(_SETTINGS):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=SIZE_IN, dpi=DPI, facecolor=GROUND)
        FigureCanvasAgg(figure)
        yield figure


def category_colours(count: int) -> list[str]:
    """Return ``count`` colours to tell things apart: the eight named ones, then round again."""
    return [CATEGORIES[i % len(CATEGORIES)] for i in range(count)]


def dress(axes: Axes, title: str, note: str = "") -> None:
    """Give a panel its heading (with a muted note at its right), a quiet grid and no box."""
    axes.set_title(title, loc="left", color=INK, fontsize=11.5, fontweight="bold", pad=7)
    if note:
        axes.set_title(note, loc="right", color=MUTED, fontsize=9.5, pad=7)
    axes.grid(True, color=GRID, linewidth=0.7)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(length=3)


def message(axes: Axes, text: str) -> None:
    """Say in the middle of a panel why it is empty."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=MUTED, fontsize=11, zorder=9)


def length_unit(size_m: float) -> tuple[float, str]:
    """Return the factor and name of the unit in which a length of this size reads well."""
    if size_m < 0.2:
        return 1e3, "mm"
    if size_m < 1.0:
        return 1e2, "cm"
    return 1.0, "m"


def length_text(size_m: float) -> str:
    """Write a length with three figures and its unit: ``"6.2 mm"``, ``"14.3 cm"``, ``"3.85 m"``."""
    factor, unit = length_unit(abs(size_m))
    return f"{size_m * factor:.3g} {unit}"


def round_below(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above ``value`` (> 0)."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-12)))
