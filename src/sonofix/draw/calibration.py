"""The picture of a calibration: the burst learnt beside the nominal one, what a chip sounds like, leavings, timing."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sonofix.draw import style
from sonofix.records import Calibration, Floats, Waveform

_LEARNT, _NOMINAL, _QUIET = style.USED, style.CATEGORIES[1], style.MUTED
_ZOOM_S = 4e-3


def draw_calibration(calibration: Calibration, title: str | None = None) -> Figure:
    """Draw a calibration.

    Parameters
    ----------
    calibration : Calibration
    title : str, optional
        The beacon's id unless given.

    Returns
    -------
    Figure
        16 × 10 inches, on an Agg canvas.
    """
    with style.sheet() as figure:
        left, right, wide, half = 0.055, 0.655, 0.52, 0.325
        whole = figure.add_axes((left, 0.52, wide, half))
        near = figure.add_axes((right, 0.52, half, half))
        leavings = figure.add_axes((left, 0.085, wide * 0.46, half))
        response = figure.add_axes((left + wide * 0.57, 0.085, wide * 0.43, half))
        timing = figure.add_axes((right, 0.085, half, half))
        _draw_whole(whole, calibration)
        _draw_near(near, calibration)
        _draw_leavings(leavings, calibration)
        _draw_response(response, calibration)
        _draw_timing(timing, calibration)
        _head(figure, calibration, title or f"Beacon {calibration.beacon}")
    return figure


def _sizes(waveform: Waveform, from_s: float, to_s: float) -> tuple[Floats, Floats]:
    """Times (ms) and moduli of an envelope between two burst times, over its peak."""
    time_s = waveform.start_s + np.arange(len(waveform.envelope)) / waveform.rate_hz
    size = np.abs(waveform.envelope)
    inside = (time_s >= from_s) & (time_s <= to_s)
    # no finer than a screen shows
    step = max(1, int(np.count_nonzero(inside) / 6000))
    return 1e3 * time_s[inside][::step], size[inside][::step] / size.max()


def _draw_whole(axes: Axes, calibration: Calibration) -> None:
    learnt = calibration.waveform
    end_s = learnt.start_s + len(learnt.envelope) / learnt.rate_hz
    time_ms, size = _sizes(learnt, -2e-3, end_s)
    axes.fill_between(time_ms, size, color=_LEARNT, alpha=0.75, linewidth=0, label="learnt")
    if calibration.nominal is not None:
        time_ms, size = _sizes(calibration.nominal, -2e-3, end_s)
        axes.fill_between(time_ms, -size, color=_NOMINAL, alpha=0.75, linewidth=0, label="nominal, below")
    axes.set_xlim(-2, 1e3 * end_s)
    axes.set_xlabel("time of the burst, ms")
    axes.set_ylabel("envelope over its peak")
    axes.legend(loc="upper right", ncols=2, fontsize=9.5)
    axes.set_ylim(-1.1 if calibration.nominal is not None else 0.0, 1.3)
    used = calibration.heard - sum(calibration.left_out.values())
    style.dress(axes, "The burst", f"mean of {used} of {calibration.heard}")


def _draw_near(axes: Axes, calibration: Calibration) -> None:
    time_ms, size = _sizes(calibration.waveform, -1e-3, _ZOOM_S)
    axes.plot(time_ms, size, color=_LEARNT, linewidth=2.2, label="learnt")
    note = ""
    if calibration.nominal is not None:
        time_ms, size = _sizes(calibration.nominal, -1e-3, _ZOOM_S)
        axes.plot(time_ms, size, color=_NOMINAL, linewidth=1.4, linestyle=(0, (4, 2)), label="nominal")
        note = f"likeness {calibration.match:.3f}" if calibration.match is not None else ""
    axes.legend(loc="upper left", fontsize=9.5, ncols=2)
    axes.set_ylim(0.0, 1.25)
    axes.set_xlim(-1, 1e3 * _ZOOM_S)
    axes.set_xlabel("time of the burst, ms")
    style.dress(axes, "Its first chips, laid upon each other", note)


def _draw_leavings(axes: Axes, calibration: Calibration) -> None:
    peak = calibration.amplitude
    step = max(1, len(calibration.residual_s) // 4000)
    cut = len(calibration.residual_s) // step * step
    rms = np.sqrt(np.mean(calibration.residual_rms[:cut].reshape(-1, step) ** 2, axis=1))
    with np.errstate(divide="ignore"):
        level = 20 * np.log10(rms / peak)
    axes.plot(
        1e3 * calibration.residual_s[:cut:step], level, color=_LEARNT, linewidth=0.8, label="each burst less the mean"
    )
    if calibration.noise_rms > 0:
        quiet = 20 * np.log10(calibration.noise_rms / peak)
        axes.axhline(quiet, color=_NOMINAL, linewidth=1.4, linestyle=(0, (4, 2)), label="quiet before the bursts")
    axes.set_xlabel("time of the burst, ms")
    axes.set_ylabel("dB below the burst's peak")
    finite = level[np.isfinite(level)]
    if len(finite):
        axes.set_ylim(np.min(finite) - 6, np.max(finite) + 14)
    axes.legend(loc="upper right", fontsize=9)
    style.dress(axes, "What single bursts leave")


def _draw_response(axes: Axes, calibration: Calibration) -> None:
    if calibration.response is None or calibration.response_s is None:
        style.message(axes, "The code is not known:\nno chip can be told from the burst")
        style.dress(axes, "What one chip sounds like")
        return
    size = np.abs(calibration.response)
    level = 20 * np.log10(np.maximum(size / size.max(), 1e-5))
    time_ms = 1e3 * calibration.response_s
    if calibration.gate_s is not None:
        axes.axvspan(1e3 * calibration.gate_s, float(time_ms[-1]), color=style.EXCLUDED, alpha=0.12, linewidth=0)
        axes.annotate(
            "the room's:\nleft out", (0.97, 0.93), xycoords="axes fraction", ha="right", va="top", color=style.EXCLUDED
        )
    axes.plot(time_ms, level, color=_LEARNT, linewidth=1.4)
    top = float(calibration.response_s[int(np.argmax(size))])
    for echo in calibration.echoes:
        axes.plot(1e3 * (top + echo.delay_s), echo.gain_db, "o", color=style.EXCLUDED, markersize=7, fillstyle="none")
    axes.set_ylim(-70, 5)
    axes.set_xlim(float(time_ms[0]), float(time_ms[-1]))
    axes.set_xlabel("time since the chip began, ms")
    axes.set_ylabel("dB")
    style.dress(axes, "What one chip sounds like")


def _draw_timing(axes: Axes, calibration: Calibration) -> None:
    pace = calibration.pace
    factor, unit = (1e9, "ns") if np.ptp(pace.residual_s[pace.used]) < 1e-6 else (1e6, "µs")
    time_s = pace.scheduled_s - pace.scheduled_s[0]
    residual = factor * pace.residual_s
    axes.plot(time_s[pace.used], residual[pace.used], ".", color=_LEARNT, markersize=5)
    spread = float(np.max(np.abs(residual[pace.used]))) or 1.0
    out = ~pace.used
    shown = np.clip(residual[out], -1.6 * spread, 1.6 * spread)
    if out.any():
        axes.plot(time_s[out], shown, "x", color=style.EXCLUDED, markersize=6, label="left out")
        axes.legend(loc="upper right", fontsize=9)
    axes.axhline(0.0, color=style.EDGE, linewidth=1.0, zorder=1)
    axes.set_ylim(-1.9 * spread, 1.9 * spread)
    axes.set_xlabel("time in the recording, s")
    axes.set_ylabel(f"early (−) or late (+), {unit}")
    jitter = factor * pace.jitter_s
    style.dress(
        axes, "Timing, burst by burst", f"rate {1e6 * pace.rate:+.3f} ppm taken out; {jitter:.3g} {unit} rms left"
    )


def _head(figure: Figure, calibration: Calibration, title: str) -> None:
    figure.text(0.055, 0.948, title, fontsize=26, fontweight="bold", color=style.INK, va="center")
    facts = [f"heard by {calibration.microphone}"]
    if calibration.distance_m is not None:
        facts.append(f"{calibration.distance_m:g} m away")
    facts.append(f"{1e-3 * calibration.band_hz[0]:.1f} to {1e-3 * calibration.band_hz[1]:.1f} kHz")
    figure.text(0.055, 0.902, "  ·  ".join(facts), fontsize=12, color=style.MUTED, va="center")
    figures = []
    if calibration.delay_s is not None:
        figures.append((f"{1e6 * calibration.delay_s:.2f} µs", "delay"))
    if calibration.delay_sd_s is not None:
        figures.append((f"± {1e6 * calibration.delay_sd_s:.2g} µs", "by noise and jitter"))
    if calibration.delay_s is None:
        period_s = calibration.period_s * (1 + calibration.pace.rate)
        figures.append((f"{period_s:.8f} s", "period"))
    figures.append((f"{calibration.snr_db:.0f} dB", "SNR of one burst"))
    figures.append((f"+{calibration.snr_gain_db:.1f} dB", "by averaging"))
    for i, (value, name) in enumerate(figures[::-1]):
        x = 0.98 - 0.128 * i
        figure.text(x, 0.952, value, fontsize=19, fontweight="bold", color=style.GOOD, va="center", ha="right")
        figure.text(x, 0.920, name, fontsize=9.5, color=style.MUTED, va="center", ha="right")
