"""How a team went, as an animation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import BinaryIO

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from sonofix.draw import style
from sonofix.draw.team import draw_landmarks, ellipse, places, tracks_of
from sonofix.records import Recording, Step, Truth

FRAMES = 80
"""At most."""

LEAST_S = 0.5
"""Frames are no closer than this."""

FRAME_MS = 80

TAIL_SHARE = 0.08
"""Of the recording, that each track's tail shows."""


def write_film(
    file: BinaryIO, recording: Recording, steps: Sequence[Step], truths: Mapping[str, Truth] | None = None
) -> None:
    """Write a GIF of a team's estimates, their ellipses and tails; hollow marks are the truth.

    Raises
    ------
    ValueError
        If no robot has a place.
    """
    tracks = tracks_of(recording, steps)
    if not tracks:
        raise ValueError("no robot was placed, so there is nothing to animate")
    truths = truths or {}
    times = {name: np.array([estimate.time_s for estimate in track]) for name, track in tracks.items()}
    begin, end = min(t[0] for t in times.values()), max(t[-1] for t in times.values())
    colours = dict(zip(tracks, style.category_colours(len(tracks)), strict=True))
    points = np.vstack([places(track) for track in tracks.values()])
    low, high = np.percentile(points, 0.5, axis=0), np.percentile(points, 99.5, axis=0)
    margin = 0.1 * float(np.max(high - low)) + 0.2
    with style.sheet() as figure:
        figure.set_size_inches(7.0, 7.0)
        axes = figure.add_axes((0.09, 0.07, 0.87, 0.86))
        figure.set_dpi(72)
        canvas = FigureCanvasAgg(figure)
        frames: list[Image.Image] = []
        for now in np.linspace(begin, end, min(FRAMES, max(2, int((end - begin) / LEAST_S)))):
            axes.clear()
            draw_landmarks(axes, recording)
            for name, track in tracks.items():
                last = int(np.searchsorted(times[name], now, side="right")) - 1
                if last < 0 or now - times[name][last] > 5.0:
                    continue
                first = int(np.searchsorted(times[name], now - TAIL_SHARE * (end - begin)))
                axes.plot(*places(track[first : last + 1]).T, color=colours[name], linewidth=1.0, alpha=0.6)
                axes.add_patch(ellipse(track[last], colours[name]))
                x, y = track[last].position_m[:2]
                yaw = track[last].yaw_rad or 0.0
                axes.plot(x, y, "o", color=colours[name], markersize=6)
                axes.plot([x, x + margin * np.cos(yaw) / 2], [y, y + margin * np.sin(yaw) / 2], color=colours[name])
                axes.annotate(name, (x, y), xytext=(6, 6), textcoords="offset points", color=colours[name], fontsize=9)
                if name in truths and truths[name].time_s[0] <= now <= truths[name].time_s[-1]:
                    truth = truths[name]
                    true = [np.interp(now, truth.time_s, truth.position_m[:, i]) for i in range(2)]
                    axes.plot(*true, "o", color=style.TRUTH, markersize=8, fillstyle="none", markeredgewidth=0.8)
            axes.set_aspect("equal")
            axes.set_xlim(low[0] - margin, high[0] + margin)
            axes.set_ylim(low[1] - margin, high[1] + margin)
            style.dress(axes, recording.site.name or "team", f"{now:.0f} s")
            canvas.draw()
            frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3]).quantize(64))
        frames[0].save(file, format="GIF", save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0)
