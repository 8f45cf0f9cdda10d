"""The pictures of one epoch as the receiver saw it: an overview a carrier, and maps of its beacons, eight a page."""

from __future__ import annotations

from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sonofix.draw import style
from sonofix.draw.surfaces import MAPS_A_PAGE, draw_surfaces, shown_ways
from sonofix.records import BandInsight, BeaconInsight, Insight

_HEARD, _CLEAN, _LEFT, _QUIET = style.MUTED, style.USED, style.GOOD, style.CATEGORIES[1]
_DEEDS = {
    "as heard": ("o", _HEARD, "as heard"),
    "tones": ("s", style.CATEGORIES[4], "tones"),
    "burst": ("o", style.USED, "bursts"),
    "clicks": ("s", style.EXCLUDED, "clicks"),
    "echo": ("o", style.CATEGORIES[1], "echoes"),
    "dropped": ("x", style.EXCLUDED, "dropped again"),
    "refined": ("o", style.GOOD, "in the end"),
}
_MOST_NAMED = 12
_LINES = 9
_LINE_CHARS = 96


def draw_insight(insight: Insight, name: str = "") -> dict[str, Figure]:
    """Draw what the receiver saw in one epoch.

    Parameters
    ----------
    insight : Insight
    name : str
        Of the site, for the heading.

    Returns
    -------
    mapping from page to Figure
        For each carrier ``"overview"`` and ``"beacons"``, ``"beacons-2"``, … of eight beacons each; with the carrier
        before them where there are several. 16 × 10 inches, on Agg canvases.
    """
    pages: dict[str, Figure] = {}
    for band in insight.bands:
        prefix = f"{band.carrier_hz / 1e3:g}kHz-" if len(insight.bands) > 1 else ""
        pages[f"{prefix}overview"] = _overview(insight, band, name)
        for i, begin in enumerate(range(0, len(band.beacons), MAPS_A_PAGE)):
            page = f"{prefix}beacons" + (f"-{i + 1}" if i else "")
            heading = (f"{_title(insight)}: beacon by beacon", _facts(insight, band, name))
            pages[page] = draw_surfaces(insight, band.beacons[begin : begin + MAPS_A_PAGE], *heading)
    return pages


def _title(insight: Insight) -> str:
    return f"Epoch {insight.epoch} at {insight.sync_s:.3f} s"


def _facts(insight: Insight, band: BandInsight, name: str) -> str:
    how = "warm search, where the track said" if insight.search == "warm" else f"{insight.search}"
    how = how.replace("cold: ", "cold search, as ")
    facts = [name, f"microphone {insight.microphone}", f"{band.carrier_hz / 1e3:g} kHz", how]
    return "  ·  ".join(fact for fact in facts if fact)


def _overview(insight: Insight, band: BandInsight, name: str) -> Figure:
    with style.sheet() as figure:
        left, width, right = 0.05, 0.41, 0.535
        _draw_spectrum(figure.add_axes((left, 0.635, width, 0.19)), insight, band)
        _draw_time(figure.add_axes((left, 0.36, width, 0.165)), band)
        _draw_stages(figure.add_axes((left, 0.085, width, 0.165)), band)
        _draw_paths(figure.add_axes((right, 0.335, 0.325, 0.49)), insight, band)
        _write_left_out(figure, right, 0.248, insight, band)
        ranged = sum(b.reported is not None for b in band.beacons)
        figures = [
            (f"{ranged} of {len(band.beacons)}", "beacons ranged"),
            (f"{band.stages[0].left_db:.0f} dB", "heard, over the quiet"),
            (f"{band.stages[-1].left_db:.1f} dB", "left in the end"),
        ]
        figure.text(left, 0.948, _title(insight), fontsize=26, fontweight="bold", color=style.INK, va="center")
        figure.text(left, 0.902, _facts(insight, band, name), fontsize=12, color=style.MUTED, va="center")
        for i, (value, label) in enumerate(figures[::-1]):
            x, bold = 0.98 - 0.128 * i, {"fontsize": 19, "fontweight": "bold"}
            figure.text(x, 0.952, _minus(value), color=style.GOOD, va="center", ha="right", **bold)
            figure.text(x, 0.920, label, fontsize=9.5, color=style.MUTED, va="center", ha="right")
    return figure


def _minus(text: str) -> str:
    return text.replace("-", "\u2212")


def _headed(axes: Axes, title: str, caption: str) -> None:
    """Give a panel its heading, and under it how to read it."""
    style.dress(axes, title)
    axes.set_title(title, loc="left", color=style.INK, fontsize=11.5, fontweight="bold", pad=22)
    axes.annotate(
        caption, (0.0, 1.0), (0, 6), xycoords="axes fraction", textcoords="offset points", color=style.MUTED, fontsize=9
    )


def _draw_spectrum(axes: Axes, insight: Insight, band: BandInsight) -> None:
    low, high = band.edges_hz
    reach = 0.45 * (high - low)
    near = (insight.frequency_hz >= low - reach) & (insight.frequency_hz <= high + reach)
    frequency = band.frequency_hz / 1e3
    axes.plot(insight.frequency_hz[near] / 1e3, insight.spectrum_db[near], color=_HEARD, linewidth=1.3, label="heard")
    if band.tones_hz or band.aside.any():
        out = " and ".join(["tones"] * bool(band.tones_hz) + ["clicks"] * bool(band.aside.any()))
        axes.plot(frequency, band.clean_db, color=_CLEAN, linewidth=1.3, label=f"{out} taken out")
    axes.plot(frequency, band.left_db, color=_LEFT, linewidth=1.3, label="bursts taken out too")
    values = [insight.spectrum_db[near], band.clean_db, band.left_db]
    if band.quiet_db is not None:
        axes.axhline(band.quiet_db, color=_QUIET, linewidth=1.3, linestyle=(0, (4, 2)), label="quiet margins")
        values.append(np.array([band.quiet_db]))
    for edge in band.edges_hz:
        axes.axvline(edge / 1e3, color=style.INK, linewidth=0.9, linestyle=(0, (1, 2)))
    axes.axvspan((low - reach) / 1e3, low / 1e3, color=style.GROUND, alpha=0.6, linewidth=0)
    axes.axvspan(high / 1e3, (high + reach) / 1e3, color=style.GROUND, alpha=0.6, linewidth=0)
    finite = np.concatenate(values)
    finite = finite[finite > -200]
    if len(finite):
        bottom, top = float(finite.min()), float(finite.max())
        axes.set_ylim(bottom - 3, top + 0.3 * (top - bottom))
        for tone_hz in band.tones_hz:
            axes.annotate(
                f"tone, {tone_hz / 1e3:.2f} kHz", (tone_hz / 1e3, top), (7, -2),
                textcoords="offset points", color=style.EXCLUDED, fontsize=9, va="top", path_effects=style.HALO,
            )  # fmt: skip
    axes.set_xlim((low - reach) / 1e3, (high + reach) / 1e3)
    axes.legend(loc="upper center", ncols=4, fontsize=9, handlelength=1.5, columnspacing=1.2)
    axes.set_xlabel("kHz", labelpad=2)
    axes.set_ylabel("dB of full scale²/Hz")
    _headed(axes, "Spectrum", "The receiver listens between the dotted edges. Once all is explained, the quiet is left")


def _draw_time(axes: Axes, band: BandInsight) -> None:
    time_ms = [1e3 * (t - float(band.time_s[0])) for t in band.time_s.tolist()]
    axes.fill_between(time_ms, band.heard_power_db, -30, color=_HEARD, alpha=0.45, linewidth=0, label="heard")
    axes.plot(time_ms, band.left_power_db, color=_LEFT, linewidth=1.0, label="left in the end")
    axes.axhline(0.0, color=_QUIET, linewidth=1.3, linestyle=(0, (4, 2)), label="quiet margins")
    edges = np.flatnonzero(np.diff(np.concatenate([[False], band.aside, [False]]).astype(int))).reshape(-1, 2)
    for i, (begin, end) in enumerate(edges):
        name = "set aside" if not i else None
        axes.axvspan(time_ms[begin], time_ms[end - 1] + 0.3, color=style.EXCLUDED, alpha=0.5, linewidth=0, label=name)
    top = float(np.max(band.heard_power_db, initial=0.0))
    axes.set_ylim(-12, 1.4 * top + 14)
    axes.set_xlim(0.0, max(time_ms, default=1.0))
    axes.legend(loc="upper right", ncols=4, fontsize=9, handlelength=1.5, columnspacing=1.2)
    axes.set_xlabel("ms", labelpad=2)
    axes.set_ylabel("dB over the quiet")
    _headed(
        axes,
        "Power over time",
        "What rises above the quiet in the end is not explained: paths that were missed, noises",
    )


def _draw_stages(axes: Axes, band: BandInsight) -> None:
    left = [stage.left_db for stage in band.stages]
    number = np.arange(len(left))
    axes.plot(number, left, color=style.EDGE, linewidth=1.3, drawstyle="steps-post", zorder=1)
    for deed, (marker, colour, label) in _DEEDS.items():
        at = [i for i, stage in enumerate(band.stages) if stage.deed == deed]
        if at:
            axes.plot(at, [left[i] for i in at], marker, color=colour, markersize=6, label=label)
    axes.axhline(0.0, color=_QUIET, linewidth=1.3, linestyle=(0, (4, 2)))
    if len(left) <= _MOST_NAMED:
        for i, stage in enumerate(band.stages):
            text = "\n".join(wrap(" ".join(dict.fromkeys(stage.beacons)), 150 // max(len(left), 8)))
            axes.annotate(
                text, (i, left[i]), (5, 4), textcoords="offset points", fontsize=8.5, color=style.INK,
                path_effects=style.HALO,
            )  # fmt: skip
    top, bottom = max(*left, 0.0), min(*left, 0.0)
    axes.set_ylim(bottom - 0.1 * (top - bottom) - 0.5, top + 0.42 * (top - bottom) + 1)
    axes.set_xlim(-0.4, len(left) - 1 + 0.06 * len(left) + 0.4)
    axes.set_xticks(number if len(left) <= _MOST_NAMED else number[:: -(-len(left) // _MOST_NAMED)])
    axes.legend(loc="upper right", ncols=7, fontsize=9, handletextpad=0.1, columnspacing=0.9)
    axes.set_xlabel("stage", labelpad=2)
    axes.set_ylabel("dB over the quiet")
    _headed(
        axes, "What was cancelled", "Power left while bursts sound, after each stage; at 0 dB nothing is left to find"
    )


def _draw_paths(axes: Axes, insight: Insight, band: BandInsight) -> None:
    """Draw a row a beacon: its loudest replica by way when all others are gone, and the paths that explain it."""
    low, high = _common_ways(band)
    tallest = max([float(np.max(b.alone_db, initial=10.0)) for b in band.beacons] or [10.0])
    count = len(band.beacons)
    size = float(np.clip(90 / max(count, 1), 6.0, 9.5))
    for row, beacon in enumerate(band.beacons):
        _draw_row(axes, beacon, count - 1 - row, 0.86 / tallest, (low, high), size)
    for shown, marker, colour, label in (
        (True, "v", style.GOOD, "the range: first path of weight"),
        (True, "o", style.CATEGORIES[1], "later path"),
        (True, "x", style.EXCLUDED, "tried and dropped"),
        (any(b.predicted for b in band.beacons), "s", style.EDGE, "predicted"),
    ):
        if shown:
            axes.plot([], [], marker, color=colour, label=label, markersize=6)
    axes.legend(loc="upper left", bbox_to_anchor=(-0.03, -0.07), ncols=4, fontsize=9, handletextpad=0.1)
    axes.set_yticks(range(count), [b.beacon for b in band.beacons][::-1], fontsize=max(size, 7.0))
    axes.tick_params(axis="y", labelcolor=style.INK, length=0)
    axes.set_ylim(-0.12, count + 0.02)
    axes.set_xlim(low, high)
    clock = "; all with one unknown offset" if insight.clock == "common" else ""
    axes.set_xlabel(f"way, m{clock}", labelpad=2)
    _headed(
        axes, "Paths found",
        f"A row a beacon: level over the noise, 0 to {tallest:.0f} dB, all other beacons taken away",
    )  # fmt: skip
    axes.grid(False, axis="y")


def _common_ways(band: BandInsight) -> tuple[float, float]:
    """Ways worth showing of any beacon, m."""
    with_paths = [b for b in band.beacons if any(not path.dropped for path in b.paths)]
    shown = [shown_ways(beacon) for beacon in with_paths or band.beacons]
    shown += [b.predicted[0] for b in band.beacons if b.predicted is not None]
    return (min(low for low, _ in shown), max(high for _, high in shown)) if shown else (0.0, 1.0)


def _draw_row(
    axes: Axes, beacon: BeaconInsight, base: int, scale: float, ways_m: tuple[float, float], size: float
) -> None:
    inside = (beacon.range_m >= ways_m[0]) & (beacon.range_m <= ways_m[1])
    axes.axhline(base, color=style.GRID, linewidth=0.8, zorder=1)
    if beacon.predicted is not None:
        low, high = beacon.predicted[0]
        axes.fill_between([low, high], base, base + 0.9, color=style.EDGE, alpha=0.6, linewidth=0, zorder=1)
    if inside.any():
        best = np.maximum(beacon.alone_db[:, inside].max(axis=0), 0.0)
        axes.fill_between(beacon.range_m[inside], base, base + scale * best, color=style.USED, alpha=0.3, linewidth=0)
        axes.plot(beacon.range_m[inside], base + scale * best, color=style.USED, linewidth=0.8, alpha=0.8)
    for path in beacon.paths:
        if not ways_m[0] <= path.range_m <= ways_m[1]:
            continue
        top = base + scale * max(path.level_db, 0.0)
        if path.dropped:
            axes.plot(path.range_m, top, "x", color=style.EXCLUDED, markersize=4, alpha=0.8)
            continue
        colour = style.GOOD if path.is_range else style.CATEGORIES[1]
        axes.vlines(path.range_m, base, top, color=colour, linewidth=1.6 if path.is_range else 1.0)
        axes.plot(path.range_m, top, "v" if path.is_range else "o", color=colour, markersize=8 if path.is_range else 4)
    reported, mark = beacon.reported, style.GOOD
    if reported is None or reported.range_sd_m is None:
        words = "\n  ".join(wrap(beacon.verdict, 62))
        ink = {"color": style.EXCLUDED, "fontsize": size, "path_effects": style.HALO}
        axes.text(ways_m[0], base + 0.68, f"  {words}", va="center", zorder=8, **ink)
        figures, mark = "no range", style.EXCLUDED
    else:
        parts = f"{reported.level_db:.0f} dB", f"{reported.range_rate_mps:+.2f} m/s"
        figures = f"{reported.range_m:.3f} m ± {1e3 * reported.range_sd_m:.2f} mm"
        figures = _minus(("\n" if size > 7.0 else "  ").join([figures, ", ".join(parts)]))
    place = (1.015, base + 0.4)
    axes.annotate(figures, place, xycoords=("axes fraction", "data"), va="center", fontsize=size, color=mark)


def _write_left_out(figure: Figure, left: float, top: float, insight: Insight, band: BandInsight) -> None:
    """Write down what was excluded and why, a reason a line."""
    figure.text(left, top, "Left out, and why", color=style.INK, fontsize=11.5, fontweight="bold", va="top")
    lines = [line for text in insight.left_out(band.beacons) for line in wrap(text, _LINE_CHARS)] or ["Nothing."]
    if len(lines) > _LINES:
        lines = [*lines[: _LINES - 1], f"… and {len(lines) - _LINES + 1} lines more"]
    figure.text(left, top - 0.033, "\n".join(lines), color=style.MUTED, fontsize=9.5, va="top", linespacing=1.45)
