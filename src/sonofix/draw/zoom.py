"""Scale: the bar of a round length, and the inset that shows a vehicle which hardly moves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from matplotlib.axes import Axes

from sonofix.draw import style
from sonofix.draw.series import Series
from sonofix.draw.way import ellipse_95
from sonofix.records import Floats, Truth

# A run that stays within this share of the picture is shown enlarged.
_SMALL = 1 / 40


def open_zoom(axes: Axes, series: Series, truths: Mapping[str, Truth], keep_clear: Iterable[Floats]) -> Axes | None:
    """Return an enlarged inset where all that happened fits in a fortieth of the picture, None elsewhere.

    The inset stands where it covers as few of the given places as it can, near the vehicle, tied to it by fine lines.
    """
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    points = _inner(
        [track.position_m[:, :2] for track in series.tracks.values()]
        + [fix.position_m[fix.sound, :2] for fix in series.fixes.values()]
    )
    if not len(points) or max(np.ptp(points, axis=0)) > _SMALL * max(high - low):
        return None
    # a truth far off must not hide that the track itself stands still
    near = np.concatenate([points, *(truth.position_m[:, :2] for truth in truths.values())])
    if max(np.ptp(near, axis=0)) > _SMALL * max(high - low):
        near = points
    corners = [near.min(axis=0), near.max(axis=0)]
    for track in series.tracks.values():
        shape = ellipse_95(track.covariance_m2[-1], 1)
        if shape is not None and shape[0] < 2 * _SMALL * max(high - low):
            corners += [track.position_m[-1, :2] - shape[0] / 2, track.position_m[-1, :2] + shape[0] / 2]
    centre, reach = (np.min(corners, axis=0) + np.max(corners, axis=0)) / 2, max(np.ptp(corners, axis=0)) / 2
    half = max(1.15 * float(reach), 1e-4)

    place = (centre - low) / (high - low)
    others = [(np.asarray(other, float)[:2] - low) / (high - low) for other in keep_clear]
    box = axes.get_window_extent()
    span = np.array([0.36, 0.36 * box.width / box.height])
    corner = _free_corner(place, span, others)
    inset = axes.inset_axes((corner[0], corner[1], span[0], span[1]), zorder=20)
    inset.set_xlim(centre[0] - half, centre[0] + half)
    inset.set_ylim(centre[1] - half, centre[1] + half)
    inset.set_facecolor(style.GROUND)
    inset.grid(True, color=style.GRID, linewidth=0.6)
    inset.tick_params(length=0, labelbottom=False, labelleft=False)
    for spine in inset.spines.values():
        spine.set_edgecolor(style.MUTED)
    away = (corner + span / 2 - place) / span
    for k in (0.0, 1.0):
        beside = abs(away[0]) >= abs(away[1])
        side = 0.0 if away[0 if beside else 1] > 0 else 1.0
        axes.annotate(
            "",
            xy=(float(centre[0]), float(centre[1])),
            xytext=(side, k) if beside else (k, side),
            textcoords=inset.transAxes,
            arrowprops={"arrowstyle": "-", "color": style.MUTED, "lw": 0.9, "alpha": 0.7, "shrinkA": 0, "shrinkB": 8},
            zorder=7,
        )
    factor = max(high - low) / (2 * half) * span[0]
    power = 10 ** max(0, int(np.floor(np.log10(max(factor, 1)))) - 1)
    words = f"enlarged {round(factor / power) * power:,} times".replace(",", "\u2009")
    inset.set_title(words, loc="left", color=style.MUTED, fontsize=10, pad=5)
    return inset


def _free_corner(place: Floats, span: Floats, others: list[Floats]) -> Floats:
    """Return the lower left corner, in shares of the axes, of a box that keeps clear of a place and most others."""
    grid = [
        np.array([x, y]) for x in np.linspace(0.05, 0.95 - span[0], 9) for y in np.linspace(0.09, 0.92 - span[1], 9)
    ]

    def cost(corner: Floats) -> float:
        middle = corner + span / 2
        covered = sum(bool((np.abs(other - middle) < span / 2 + 0.06).all()) for other in others)
        gap = float(np.max(np.abs(place - middle) - span / 2))
        return 3.0 * covered + (30.0 if gap < 0.06 else 0.0) + float(np.linalg.norm(place - middle))

    return min(grid, key=cost)


def _inner(clouds: Iterable[Floats]) -> Floats:
    """Join point clouds, of long ones only the middle 98 %: a few wild fixes are not the way."""
    kept = []
    for cloud in clouds:
        finite = cloud[np.isfinite(cloud).all(axis=1)]
        if len(finite) >= 100:
            low, high = np.percentile(finite, (1, 99), axis=0)
            finite = finite[((finite >= low) & (finite <= high)).all(axis=1)]
        kept.append(finite)
    return np.concatenate([*kept, np.zeros((0, 2))])


def scale_bar(axes: Axes, keep_clear: Iterable[Floats]) -> None:
    """Draw a bar of a round length at the foot of the axes, as far from the given places as it can be."""
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    size = high - low
    length = style.round_below(0.22 * float(size[0]))
    others = [np.asarray(place, float)[:2] for place in keep_clear]
    y = float(low[1] + 0.03 * size[1])
    lefts = [float(low[0] + share * size[0]) for share in (0.03, 0.2, 0.37, 0.54, 0.71)]
    lefts = [left for left in lefts if left + length < high[0] - 0.02 * size[0]]

    def room(left: float) -> float:
        bar = np.column_stack([np.linspace(left, left + length, 5), np.full(5, y)])
        return min((float(np.linalg.norm(bar - place, axis=1).min()) for place in others), default=1.0)

    x = max(lefts, key=lambda left: min(room(left), 0.12 * float(max(size))))
    axes.plot([x, x + length], [y, y], color=style.INK, linewidth=3, solid_capstyle="butt", zorder=12)
    factor, unit = style.length_unit(length)
    axes.annotate(
        f"{length * factor:g} {unit}",
        (x + length / 2, y),
        xytext=(0, 5),
        textcoords="offset points",
        ha="center",
        color=style.INK,
        fontsize=10,
        path_effects=style.HALO,
        zorder=12,
    )
