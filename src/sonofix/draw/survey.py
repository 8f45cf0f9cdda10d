"""The picture of a survey: beacons from where they were thought to be to where they are, and the drive among them."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sonofix.draw import style
from sonofix.records import Floats, Survey, SurveyedBeacon

_SCALE_95 = 2.4477
"""Deviations from the middle to a 95 % ellipse: √ of the χ² quantile of two degrees."""

_BEFORE, _AFTER = style.EXCLUDED, style.GOOD
_NUDGE = 0.012


def draw_survey(
    found: Survey, title: str = "", bounds_m: tuple[tuple[float, ...], tuple[float, ...]] | None = None
) -> Figure:
    """Draw a survey.

    Parameters
    ----------
    found : Survey
    title : str
        The site's name.
    bounds_m : two corners or None
        The room.

    Returns
    -------
    Figure
        16 × 10 inches, on an Agg canvas.
    """
    with style.sheet() as figure:
        plan = figure.add_axes((0.05, 0.075, 0.58, 0.79))
        heights = figure.add_axes((0.70, 0.53, 0.28, 0.335))
        deviations = figure.add_axes((0.70, 0.075, 0.28, 0.335))
        _draw_plan(plan, found, bounds_m)
        _draw_moves(heights, found)
        _draw_deviations(deviations, found)
        _head(figure, found, title or "Survey")
    return figure


def _draw_plan(axes: Axes, found: Survey, bounds_m: tuple[tuple[float, ...], tuple[float, ...]] | None) -> None:
    places = [b.position_m[:2] for b in found.beacons] + [b.before_m[:2] for b in found.beacons if _guessed(b)]
    places += [way[:, 1:3] for way in found.drive.values()]
    if bounds_m is not None:
        low, high = np.array(bounds_m)[:, :2]
        places += [low, high]
        axes.add_patch(Rectangle(tuple(low), *(high - low), facecolor=style.FLOOR, edgecolor=style.EDGE, zorder=0))
    everything = np.vstack([np.atleast_2d(p) for p in places])
    low, high = everything.min(axis=0), everything.max(axis=0)
    size = float(max(high - low)) or 1.0
    for vehicle, colour in zip(found.drive, style.category_colours(len(found.drive)), strict=True):
        way = found.drive[vehicle]
        axes.plot(way[:, 1], way[:, 2], "-", color=colour, linewidth=1.1, alpha=0.55, zorder=2)
        axes.plot(way[:, 1], way[:, 2], ".", color=colour, markersize=3.5, zorder=2.1, label=f"drive of {vehicle}")
    factor = _enlargement(found, size)
    middle = everything.mean(axis=0)
    for beacon in found.beacons:
        _draw_beacon(axes, beacon, factor, size, middle)
    for colour, marker, label in ((_BEFORE, "x", "guess"), (_AFTER, "o", "found"), (style.USED, "s", "known")):
        if label == "known" and all(np.any(b.covariance_m2) for b in found.beacons):
            continue
        axes.plot([], [], marker, color=colour, markersize=8, linestyle="none", label=label)
    if any(np.any(b.covariance_m2) for b in found.beacons):
        text = "95 % of where it is" + (f", {factor} times enlarged" if factor > 1 else "")
        axes.plot([], [], color=_AFTER, linewidth=1.4, label=text)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.05), ncols=6, fontsize=9.5, handletextpad=0.5)
    slack = 0.09 * size
    # as much floor as fills the panel at one scale
    box = axes.get_position()
    shape = box.width * style.SIZE_IN[0] / (box.height * style.SIZE_IN[1])
    half = (high - low) / 2 + slack
    half = np.maximum(half, [half[1] * shape, half[0] / shape])
    centre = (low + high) / 2
    axes.set_aspect("equal")
    axes.set_xlim(centre[0] - half[0], centre[0] + half[0])
    axes.set_ylim(centre[1] - half[1], centre[1] + half[1])
    axes.set_xlabel("x, m", labelpad=1)
    axes.set_ylabel("y, m")
    style.dress(axes, "From above", f"{found.rows} ranges, {found.excluded} left out")


def _draw_beacon(axes: Axes, beacon: SurveyedBeacon, factor: int, size: float, middle: Floats) -> None:
    x, y = beacon.position_m[:2]
    free = bool(np.any(beacon.covariance_m2))
    if free and _guessed(beacon):
        axes.annotate(
            "",
            (x, y),
            tuple(beacon.before_m[:2]),
            arrowprops={"arrowstyle": "-|>", "color": _BEFORE, "linewidth": 1.2, "shrinkA": 2, "shrinkB": 3},
            zorder=3,
        )
        axes.plot(*beacon.before_m[:2], "x", color=_BEFORE, markersize=9, markeredgewidth=2, zorder=3.1)
    axes.plot(x, y, "o" if free else "s", color=_AFTER if free else style.USED, markersize=7, zorder=4)
    if free:
        values, axis = np.linalg.eigh(beacon.covariance_m2[:2, :2])
        wide = 2 * _SCALE_95 * factor * np.sqrt(np.maximum(values, 0.0))
        angle = float(np.degrees(np.arctan2(axis[1, 1], axis[0, 1])))
        # one that may be anywhere fills the sheet and no more
        wide = np.minimum(wide, 3 * size)
        patch = Ellipse((x, y), wide[1], wide[0], angle=angle, facecolor=(*_rgb(_AFTER), 0.12), edgecolor=_AFTER)
        axes.add_patch(patch)
    # the name stands off the arrow, or outwards
    off = beacon.position_m[:2] - (beacon.before_m[:2] if free and _guessed(beacon) else middle)
    side = np.where(off >= 0, 1.0, -1.0)
    axes.annotate(
        beacon.id,
        (x, y),
        (9 * float(side[0]), 9 * float(side[1])),
        textcoords="offset points",
        ha="left" if side[0] >= 0 else "right",
        va="bottom" if side[1] >= 0 else "top",
        fontweight="bold",
        fontsize=11,
        path_effects=style.HALO,
        zorder=5,
    )


def _rgb(colour: str) -> tuple[float, float, float]:
    return tuple(int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))  # pyright: ignore[reportReturnType]


def _guessed(beacon: SurveyedBeacon) -> bool:
    """Whether there was a guess to move away from."""
    return bool(beacon.before_sd_m)


def _enlargement(found: Survey, size: float) -> int:
    """Round factor by which ellipses can be seen; 1 where they can as they are."""
    worst = [float(np.sqrt(np.linalg.eigvalsh(b.covariance_m2[:2, :2])[-1])) for b in found.beacons]
    seen = float(np.median([sd for sd in worst if sd > 0] or [size]))
    wanted = 0.02 * size / max(_SCALE_95 * max(seen, max(worst, default=0.0) / 5), 1e-9)
    return int(style.round_below(wanted)) if wanted >= 2 else 1


def _lanes(axes: Axes, found: Survey) -> Floats:
    at = np.arange(len(found.beacons), dtype=float)
    names = [b.id for b in found.beacons]
    step = max(1, len(names) // 24)
    axes.set_xticks(at[::step], names[::step], rotation=0 if len(names) <= 10 else 60)
    axes.set_xlim(-0.6, len(names) - 0.4)
    return at


def _draw_moves(axes: Axes, found: Survey) -> None:
    """Draw how far each beacon moved along the axes, with its deviation."""
    at = _lanes(axes, found)
    if not any(_guessed(b) for b in found.beacons):
        style.message(axes, "No guesses to move away from")
        style.dress(axes, "Found less guessed")
        return
    moves = np.array([b.position_m - b.before_m if _guessed(b) else np.full(3, np.nan) for b in found.beacons])
    sds = np.array([b.sd_m for b in found.beacons])
    factor, unit = style.length_unit(float(np.nanmax(np.abs(moves), initial=1e-3)))
    for axis, (name, colour) in enumerate(zip("xyz", style.CATEGORIES, strict=False)):
        axes.errorbar(
            at + 0.22 * (axis - 1),
            factor * moves[:, axis],
            factor * np.minimum(1.96 * sds[:, axis], 1e3),
            fmt="o",
            color=colour,
            markersize=5,
            linewidth=1.4,
            label=name,
        )
    axes.axhline(0.0, color=style.EDGE, linewidth=1.0, zorder=1)
    most = float(np.nanmax(np.abs(moves), initial=1e-3))
    top = 1.3 * factor * float(np.nanmax(np.abs(moves) + np.minimum(1.96 * sds, 2.0 * most), initial=1e-3))
    axes.set_ylim(-top, top)
    axes.set_ylabel(unit)
    axes.legend(loc="upper right", ncols=3, fontsize=9)
    style.dress(axes, "Found less guessed", "bars: 95 %")


def _draw_deviations(axes: Axes, found: Survey) -> None:
    """Draw each beacon's deviations, logarithmic: what is found and what stays open stand decades apart."""
    at = _lanes(axes, found)
    sds = np.array([b.sd_m for b in found.beacons])
    shown = 1e3 * np.where(sds > 0, sds, np.nan)
    if np.isfinite(shown).any():
        for axis, (name, colour) in enumerate(zip("xyz", style.CATEGORIES, strict=False)):
            axes.plot(at + 0.22 * (axis - 1), shown[:, axis], "o", color=colour, markersize=6, label=f"sd {name}")
        axes.set_yscale("log")
        low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
        axes.set_ylim(0.4 * low, 6.0 * high)
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.legend(loc="upper right", ncols=3, fontsize=9)
        axes.set_ylabel("mm")
    else:
        style.message(axes, "All beacons are known")
    style.dress(axes, "How well each is known", "within the frame")


def _head(figure: Figure, found: Survey, title: str) -> None:
    figure.text(0.05, 0.948, title, fontsize=26, fontweight="bold", color=style.INK, va="center")
    facts = [f"{len(found.beacons)} beacons surveyed", f"sound speed {found.sound_speed_mps:.2f} m/s"]
    facts.append({"ok": "all directions told"}.get(found.status, _open_text(len(found.open))))
    if found.mirror:
        facts.append("mirror image undecided")
    figure.text(0.05, 0.902, "  ·  ".join(facts), fontsize=12, color=style.MUTED, va="center")
    free = [float(np.sqrt(np.linalg.eigvalsh(b.covariance_m2)[-1])) for b in found.beacons if np.any(b.covariance_m2)]
    figures = [(style.length_text(found.after_m), "residual after, rms")] if np.isfinite(found.after_m) else []
    if np.isfinite(found.before_m):
        figures.insert(0, (style.length_text(found.before_m), "residual before survey"))
    if free:
        figures.append((style.length_text(max(free)), "worst deviation"))
    for i, (value, name) in enumerate(figures[::-1]):
        x = 0.98 - 0.128 * i
        colour = _AFTER if found.status == "ok" else _BEFORE
        figure.text(x, 0.952, value, fontsize=19, fontweight="bold", color=colour, va="center", ha="right")
        figure.text(x, 0.920, name, fontsize=9.5, color=style.MUTED, va="center", ha="right")


def _open_text(count: int) -> str:
    return "1 direction stays unknown" if count == 1 else f"{count} directions stay unknown" if count else "undecided"
