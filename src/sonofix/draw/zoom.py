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


def open_zoom(axes: Axes, series: Series, truths: Mapping[str, Truth]) -> Axes | None:
    """Return an enlarged inset where all that happened fits in a fortieth of the picture, None elsewhere.

    The inset stands beside the vehicle, on the side with more room, and is tied to it by two fine lines.
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
    box = axes.get_window_extent()
    wide, tall = 0.36, 0.36 * box.width / box.height
    right = place[0] < 0.5
    x = min(place[0] + 0.10, 0.86 - wide) if right else max(place[0] - 0.10 - wide, 0.14)
    y = float(np.clip(place[1] - tall / 2, 0.20, 0.82 - tall))
    inset = axes.inset_axes((float(x), y, wide, tall), zorder=20)
    inset.set_xlim(centre[0] - half, centre[0] + half)
    inset.set_ylim(centre[1] - half, centre[1] + half)
    inset.set_facecolor(style.GROUND)
    inset.grid(True, color=style.GRID, linewidth=0.6)
    inset.tick_params(length=0, labelbottom=False, labelleft=False)
    for spine in inset.spines.values():
        spine.set_edgecolor(style.MUTED)
    for corner in (0.0, 1.0):
        axes.annotate(
            "",
            xy=(float(centre[0]), float(centre[1])),
            xytext=(0.0 if right else 1.0, corner),
            textcoords=inset.transAxes,
            arrowprops={"arrowstyle": "-", "color": style.MUTED, "lw": 0.9, "alpha": 0.7, "shrinkA": 0, "shrinkB": 8},
            zorder=7,
        )
    factor = max(high - low) / (2 * half) * wide
    power = 10 ** max(0, int(np.floor(np.log10(max(factor, 1)))) - 1)
    words = f"enlarged {round(factor / power) * power:,} times".replace(",", "\u2009")
    inset.set_title(words, loc="left", color=style.MUTED, fontsize=10, pad=5)
    return inset


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
