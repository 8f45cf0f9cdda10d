"""What stands still: beacons, the sound that leaves them, and fixed microphones."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from sonofix.draw import style
from sonofix.records import Floats

_CROWD = 24


def draw_rings(axes: Axes, emitters: Mapping[str, Floats], size_m: float) -> None:
    """Draw the sound that leaves the beacons: circles that fade with distance."""
    if len(emitters) > _CROWD:
        return
    for place in emitters.values():
        for i in range(1, 10):
            axes.add_patch(
                Circle(
                    (float(place[0]), float(place[1])),
                    i * size_m / 36,
                    facecolor="none",
                    edgecolor=style.USED,
                    linewidth=0.9,
                    alpha=0.38 * (1 - i / 10) ** 1.4,
                    zorder=1,
                )
            )


def draw_nodes(axes: Axes, beacons: Mapping[str, Floats], microphones: Mapping[str, Floats], size_m: float) -> None:
    """Mark and name beacons and fixed microphones; neighbours too close to write at share one label.

    Names stand above the nodes, below those in the south, so that they keep out of the way; heights below the names.
    """
    everything = [*beacons.values(), *microphones.values()]
    if not everything:
        return
    centre = (np.min(everything, axis=0) + np.max(everything, axis=0))[:2] / 2
    for nodes, marker, colour in ((beacons, "^", style.USED), (microphones, "s", style.GOOD)):
        if not nodes:
            continue
        at, crowd = np.array(list(nodes.values())), len(nodes) > _CROWD
        axes.scatter(at[:, 0], at[:, 1], s=70 if crowd else 330, color=colour, alpha=0.17, linewidths=0, zorder=5)
        axes.scatter(
            at[:, 0],
            at[:, 1],
            s=30 if crowd else 85,
            marker=marker,
            color=colour,
            edgecolors=style.GROUND,
            linewidths=1.0,
            zorder=6,
        )
        heights = bool(np.any(at[:, 2] != 0)) and not crowd
        for names, place in _clusters(nodes, (0.05 if crowd else 0.03) * size_m):
            _label(axes, names, place, place[:2] - centre, colour, heights, 9 if crowd else 11)


def _label(
    axes: Axes, names: list[str], place: Floats, away: Floats, colour: str, height: bool, size_pt: float
) -> None:
    outward = 1 if away[1] >= -0.35 * np.linalg.norm(away) else -1
    lines = [(names[0] if len(names) == 1 else f"{names[0]} … {names[-1]}", size_pt, colour, "bold")]
    if height:
        lines.append((f"z {place[2]:.2f} m", 8.5, style.MUTED, "normal"))
    y = 11.0 * outward
    rows = lines[::-1] if outward > 0 else lines
    for text, points, ink, weight in rows:
        axes.annotate(
            text,
            (float(place[0]), float(place[1])),
            xytext=(0.0, y),
            textcoords="offset points",
            ha="center",
            va="bottom" if outward > 0 else "top",
            fontsize=points,
            fontweight=weight,
            color=ink,
            path_effects=style.HALO,
            zorder=7,
        )
        y += (points + 3.5) * outward


def _clusters(nodes: Mapping[str, Floats], reach_m: float) -> list[tuple[list[str], Floats]]:
    """Return chains of neighbours, each with its names and its middle; in the order of the first names."""
    chains: list[dict[str, Floats]] = []
    for name, place in nodes.items():
        near = [chain for chain in chains if min(np.linalg.norm(place[:2] - at[:2]) for at in chain.values()) < reach_m]
        joined = {key: at for chain in near for key, at in chain.items()} | {name: place}
        chains = [chain for chain in chains if not any(chain is other for other in near)] + [joined]
    return [(list(chain), np.mean(list(chain.values()), axis=0)) for chain in chains]
