"""The picture of a run: plan and track, what was heard, residuals, error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from sonofix.draw import panels, style
from sonofix.draw.plan import draw_plan
from sonofix.draw.series import Series, gather
from sonofix.records import Recording, Step, Truth


def draw_track(
    recording: Recording, steps: Sequence[Step], truths: Mapping[str, Truth] | None = None, title: str | None = None
) -> Figure:
    """Draw a run.

    Parameters
    ----------
    recording : Recording
        Only its site is looked at.
    steps : sequence of Step
        As ``flow.run`` yields them, all or a fair sample of a long run; may be empty.
    truths : mapping from vehicle to Truth, optional
        Adds the true path and the error panel.
    title : str, optional
        The site's name unless given.

    Returns
    -------
    Figure
        16 × 10 inches, on an Agg canvas; ``figure.savefig(path)`` writes it.
    """
    truths = truths or {}
    series = gather(steps)
    with style.sheet() as figure:
        plan = figure.add_axes((0.05, 0.105, 0.565, 0.755))
        handles = draw_plan(plan, recording, series, truths)
        figure.legend(
            handles=handles,
            loc="lower left",
            bbox_to_anchor=(0.043, 0.006),
            ncols=max(len(handles), 1),
            fontsize=10 if len(handles) <= 9 else 9,
            handletextpad=0.5,
            columnspacing=1.6,
        )
        lanes = len(series.lanes)
        # the strip grows with its lanes, the other two share the rest
        left, wide, floor, height, gap = 0.665, 0.315, 0.105, 0.735, 0.068
        strip = (height - 2 * gap) * float(np.clip(0.16 + 0.015 * lanes, 0.16, 0.42))
        half = (height - 2 * gap - strip) / 2
        error = figure.add_axes((left, floor, wide, half))
        residual = figure.add_axes((left, floor + half + gap, wide, half), sharex=error)
        heard = figure.add_axes((left, floor + 2 * (half + gap), wide, strip), sharex=error)
        panels.draw_heard(heard, series)
        panels.draw_residuals(residual, series)
        panels.draw_deviation(error, series, truths)
        start, stop = series.span_s
        slack = 0.012 * (stop - start) or 0.5
        error.set_xlim(start - slack, stop + slack)
        for upper in (heard, residual):
            upper.tick_params(labelbottom=False)
        panels.mark_time(error, series, coloured=len(series.tracks) == 1)
        _mark_events([heard, residual, error], series)
        _head(figure, series, truths, title or recording.site.name or "sonofix")
    return figure


def _mark_events(sheets: Sequence, series: Series) -> None:
    """Rule a fine line where the track was lost, reset or the samples broke off."""
    moments = [event.time_s for event in series.events if event.event in ("lost", "reset", "gap")]
    if len(moments) > 60:
        return
    for sheet in sheets:
        for moment in moments:
            sheet.axvline(moment, color=style.EXCLUDED, linewidth=0.8, linestyle=(0, (2, 2)), alpha=0.7, zorder=1.4)


def _head(figure: Figure, series: Series, truths: Mapping[str, Truth], title: str) -> None:
    """Write the title, what was run, and its key figures."""
    figure.text(0.05, 0.948, title, fontsize=26, fontweight="bold", color=style.INK, va="center")
    span = series.span_s[1] - series.span_s[0]
    facts = [
        *([f"{span:.1f} s" if span < 100 else f"{span:.0f} s"] if span > 0 else []),
        _counted(series.epoch_count, "epoch"),
        _counted(len(series.lanes), series.lane_kind),
        f"{len(series.ranges.time_s)} ranges",
    ]
    figure.text(0.05, 0.902, "  ·  ".join(facts), fontsize=12, color=style.MUTED, va="center")
    figures = _key_figures(series, truths)
    for i, (value, name) in enumerate(figures[::-1]):
        x = 0.98 - 0.112 * i
        figure.text(x, 0.952, value, fontsize=19, fontweight="bold", color=style.GOOD, va="center", ha="right")
        figure.text(x, 0.920, name, fontsize=9.5, color=style.MUTED, va="center", ha="right")


def _counted(count: int, name: str) -> str:
    return f"{count} {name}" + ("" if count == 1 else "s")


def _key_figures(series: Series, truths: Mapping[str, Truth]) -> list[tuple[str, str]]:
    """Return up to five figures and their names, the most telling first."""
    figures = []
    errors = [
        np.hypot(*panels.error_m(track, truths[name])[:, :2].T)
        for name, track in series.tracks.items()
        if name in truths
    ]
    error = np.concatenate([*errors, np.zeros(0)])
    error = error[np.isfinite(error)]
    if len(error):
        figures.append((style.length_text(float(np.sqrt(np.mean(error**2)))), "position error, rms"))
    residual = series.ranges.residual_m[series.ranges.used & np.isfinite(series.ranges.residual_m)]
    if len(residual):
        figures.append((style.length_text(float(np.sqrt(np.mean(residual**2)))), "range residual, rms"))
    if len(series.hdop):
        figures.append((f"{np.median(series.hdop):.2f}", "HDOP, median"))
    if len(series.ranges.used):
        figures.append((f"{100 * np.mean(series.ranges.used):.0f} %", "of ranges used"))
    if series.epoch_count:
        fixed, count = series.fixed_epoch_count, series.epoch_count
        figures.append((f"{fixed} / {count}" if count < 1000 else f"{100 * fixed / count:.0f} %", "epochs with a fix"))
    return figures
