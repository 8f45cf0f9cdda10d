"""The third seed's detector: an adaptive filter steered by what the emitter announced by radio, and a comparator.

LMS (eqs 3, 4) as printed, with its normalised form and recursive least squares beside it; then amplitude matching, and
a rectifier with a comparator that stops the timer. The receiver itself hears by code (`search`); `sonofix study robots`
shows both on the same energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np

from sonofix.records import Floats

MATCH_BAND_V = 0.5
"""Half width of the seed's band about the expected amplitude: 4.5 to 5.5 V for 5 V."""

COMPARATOR_V = 0.5

BOUNDLESS_V = 1e100
"""No output of a filter that converges; far enough below the largest number that its mean can still be taken."""


@dataclass(frozen=True, slots=True)
class Announced:
    """What the emitter says by radio as it sounds, from which the listener predicts what it will hear.

    Attributes
    ----------
    frequency_hz : float
    drive_v : float
        Amplitude at which its transducer is driven.
    form : "square" or "sine"
    gain : float
        Of its transducer: volts heard for a volt sent, the listener's own amplifier left out.
    """

    frequency_hz: float
    drive_v: float
    form: Literal["square", "sine"] = "square"
    gain: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
    """Output y (n,), error e = d − y (n,), and the last taps h (k,): ``taps[k]`` weighs the sample k before."""

    output: Floats
    error: Floats
    taps: Floats

    @property
    def diverged(self) -> bool:
        """Whether the output grew without bound: the step was too large for the input."""
        return not bool((np.abs(self.output) < BOUNDLESS_V).all() and np.isfinite(self.taps).all())


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the seed's detector makes of a stretch of samples.

    Attributes
    ----------
    status : "heard", "overflow"
        "overflow": nothing matched, or the comparator never rose; the timer runs out.
    remedy : str
        What would help; empty where heard.
    mean_v : float
        Mean magnitude of the filter's output; infinite where it diverged.
    time_s, range_m : float or None
        When the comparator first rose, from the first sample on, and the way that is; None unless heard.
    """

    status: Literal["heard", "overflow"]
    remedy: str
    mean_v: float
    time_s: float | None
    range_m: float | None


def desired(announced: Announced, listener_gain: float, time_s: Floats) -> Floats:
    """Signal d(n) that the listener expects at ``time_s`` (n,) from the burst's start on, in volts at its converter."""
    turns = announced.frequency_hz * np.asarray(time_s, np.float64)
    amplitude = announced.drive_v * announced.gain * listener_gain
    if announced.form == "sine":
        return amplitude * np.sin(2 * np.pi * turns)
    return amplitude * np.where(turns % 1.0 < 0.5, 1.0, -1.0)


def lms(heard: Floats, wanted: Floats, step: float, taps: int | Floats) -> Filtered:
    """Least mean squares, the seed's eqs 3 and 4: ``h ← h + Δ e(n) x(n − k)``.

    Parameters
    ----------
    heard, wanted : float64 (n,)
        Input x(n), nothing before its first sample, and desired output d(n).
    step : float
        Δ, one over the square of the input's unit. It diverges above 2 over the input's power times the taps.
    taps : int or float64 (k,)
        How many, from zeros on; or what to begin with.

    Raises
    ------
    ValueError
        If shapes differ, or a setting is not positive.
    """
    x, d, h, length = _prepared(heard, wanted, taps, step=step)
    output, error = np.empty(length), np.empty(length)
    _lms(x, d, step, h, output, error)
    return Filtered(output, error, h[::-1].copy())


def nlms(heard: Floats, wanted: Floats, step: float, taps: int | Floats, floor: float = 1e-6) -> Filtered:
    """Normalised LMS: each step divided by the energy of the samples in the filter, ``floor`` added (Haykin, ch. 6).

    Parameters as of `lms`; ``step`` is a bare number, between 0 and 2.
    """
    x, d, h, length = _prepared(heard, wanted, taps, step=step, floor=floor)
    output, error = np.empty(length), np.empty(length)
    _nlms(x, d, step, floor, h, output, error)
    return Filtered(output, error, h[::-1].copy())


def rls(heard: Floats, wanted: Floats, taps: int | Floats, forgetting: float = 1.0, start: float = 100.0) -> Filtered:
    """Recursive least squares (Haykin, ch. 10): the taps that fit all samples so far best.

    Parameters as of `lms`, and

    forgetting : float
        Weight of a sample against the next, above 0 and 1 at most.
    start : float
        First value on the diagonal of the inverse correlation: how little the first taps are trusted, one over the
        square of the input's unit.
    """
    if not 0.0 < forgetting <= 1.0:
        raise ValueError(f"forgetting = {forgetting}; it must lie above 0 and be 1 at most")
    x, d, h, length = _prepared(heard, wanted, taps, start=start)
    output, error = np.empty(length), np.empty(length)
    _rls(x, d, forgetting, start * np.eye(len(h)), h, output, error)
    return Filtered(output, error, h[::-1].copy())


def mean_magnitude(output: Floats) -> float:
    """Mean |y| over a window: what the seed's amplitude matching looks at."""
    return float(np.mean(np.abs(output)))


def matches(mean_v: float, expected_v: float, half_band_v: float = MATCH_BAND_V) -> bool:
    """Whether a mean magnitude lies within the band about the expected one."""
    return abs(mean_v - expected_v) <= half_band_v


def rises_at(samples: Floats, threshold_v: float = COMPARATOR_V) -> int | None:
    """First sample at which rectified ``samples`` (n,) exceed the comparator's threshold; None where none does."""
    above = np.flatnonzero(np.abs(samples) > threshold_v)
    return int(above[0]) if len(above) else None


def listen(
    samples: Floats,
    filtered: Filtered,
    expected_v: float,
    rate_hz: float,
    sound_speed_mps: float,
    half_band_v: float = MATCH_BAND_V,
    threshold_v: float = COMPARATOR_V,
) -> Verdict:
    """Put both of the seed's branches together: amplitude matching says whether, the comparator says when.

    Parameters
    ----------
    samples : float64 (n,)
        As heard, the first when the radio message came: the timer starts there.
    filtered : Filtered
        What an adaptive filter made of them.
    expected_v : float
        Mean magnitude of the desired signal.
    """
    if filtered.diverged:
        return Verdict("overflow", "the filter diverged: take a smaller step or fewer taps", float("inf"), None, None)
    mean_v = mean_magnitude(filtered.output)
    if not matches(mean_v, expected_v, half_band_v):
        text = f"the mean of {mean_v:.3g} V is not within {half_band_v:g} V of {expected_v:.3g} V: wait for a burst"
        return Verdict("overflow", text, mean_v, None, None)
    first = rises_at(samples, threshold_v)
    if first is None:
        text = f"no sample exceeds the comparator's {threshold_v:g} V: come nearer, or amplify more"
        return Verdict("overflow", text, mean_v, None, None)
    time_s = first / rate_hz
    return Verdict("heard", "", mean_v, time_s, sound_speed_mps * time_s)


def _prepared(
    heard: Floats, wanted: Floats, taps: int | Floats, **positive: float
) -> tuple[Floats, Floats, Floats, int]:
    """Input with zeros before it, desired output, and taps in order of time (so that the loops run forward)."""
    x, d = np.asarray(heard, np.float64), np.ascontiguousarray(wanted, np.float64)
    if x.ndim != 1 or x.shape != d.shape:
        raise ValueError(f"heard has shape {x.shape} and wanted {d.shape}; both must be (n,) alike")
    for name, value in positive.items():
        if not value > 0.0:
            raise ValueError(f"{name} = {value}; it must be positive")
    if isinstance(taps, int):
        if taps < 1:
            raise ValueError(f"taps = {taps}; at least 1 is needed")
        h = np.zeros(taps)
    else:
        h = np.array(taps, np.float64)[::-1].copy()
        if h.ndim != 1 or not len(h):
            raise ValueError(f"taps has shape {h.shape}; (k,) with k of 1 or more is needed")
    return np.concatenate([np.zeros(len(h) - 1), x]), d, h, len(x)


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _lms(x, d, step, h, output, error) -> None:
    k = len(h)
    for n in range(len(d)):
        y = 0.0
        for i in range(k):
            y += h[i] * x[n + i]
        e = d[n] - y
        output[n], error[n] = y, e
        gain = step * e
        for i in range(k):
            h[i] += gain * x[n + i]


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _nlms(x, d, step, floor, h, output, error) -> None:
    k = len(h)
    for n in range(len(d)):
        y, energy = 0.0, floor
        for i in range(k):
            y += h[i] * x[n + i]
            energy += x[n + i] ** 2
        e = d[n] - y
        output[n], error[n] = y, e
        gain = step * e / energy
        for i in range(k):
            h[i] += gain * x[n + i]


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _rls(x, d, forgetting, inverse, h, output, error) -> None:
    k = len(h)
    told = np.empty(k)
    for n in range(len(d)):
        y, total = 0.0, forgetting
        for i in range(k):
            y += h[i] * x[n + i]
            told[i] = 0.0
            for j in range(k):
                told[i] += inverse[i, j] * x[n + j]
            total += told[i] * x[n + i]
        e = d[n] - y
        output[n], error[n] = y, e
        for i in range(k):
            gain = told[i] / total
            h[i] += gain * e
            # one half computed and mirrored: rounding would else unbalance it until it blows up
            for j in range(i + 1):
                value = (inverse[i, j] - gain * told[j]) / forgetting
                inverse[i, j] = value
                inverse[j, i] = value
