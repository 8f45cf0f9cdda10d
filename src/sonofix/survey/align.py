"""Many bursts of one kind: their common form, and the delay, strength and phase of each, estimated together.

A slice of burst k is ``X_k(f) = g_k S(f) exp(−2πi f δ_k) + W_k(f)``. Given S, each δ_k and g_k follow by maximum
likelihood; given those, S is the weighted mean of the bursts laid upon each other. Both are repeated until nothing
moves (alternating maximisation, as in Woody, Med. Biol. Eng. 5, 539 (1967)). A burst is compared with the mean of the
*others*, so that its own noise does not draw it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.survey.slices import Complexes

ROUNDS = 30
STILL_S = 1e-10
CHUNK = 64
SPAN_S = 60e-6
"""How far off the first guess of a delay may be."""


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Bursts laid upon each other.

    Attributes
    ----------
    mean : complex128 (b,)
        S: the common burst's slice, at the bursts' median strength.
    gain : complex128 (k,)
        Of each burst, median modulus 1.
    delay_s, delay_sd_s : float64 (k,)
        Of each burst, mean 0 over used ones, and their deviation from the noise measured.
    noise : float64 (b,)
        Power of one burst's noise in each bin, smoothed.
    misfit : float64 (k,)
        Power each burst leaves, over what the median burst leaves.
    used : bool (k,)
    reason : tuple of str (k,)
        Why a burst is not used; empty where it is.
    """

    mean: Complexes
    gain: Complexes
    delay_s: Floats
    delay_sd_s: Floats
    noise: Floats
    misfit: Floats
    used: NDArray[np.bool_]
    reason: tuple[str, ...]


def align(
    bursts: NDArray[np.complex64], offset_hz: Floats, first: Complexes | None = None, reasons: list[str] | None = None
) -> Aligned:
    """Estimate the common burst and each burst's delay, strength and phase; leave out what does not fit.

    Parameters
    ----------
    bursts : complex64 (k, b)
        Slices, laid upon each other to within `SPAN_S`.
    offset_hz : float64 (b,)
    first : complex128 (b,), optional
        What to begin with; one of the bursts unless given.
    reasons : list of str (k,), optional
        Bursts with a reason are left out from the start.

    Raises
    ------
    ValueError
        If fewer than three bursts are left.
    """
    reason = list(reasons) if reasons is not None else [""] * len(bursts)
    power = np.sum(np.abs(bursts) ** 2, axis=1)
    mean = bursts[int(np.argsort(power)[len(power) // 2])].astype(np.complex128) if first is None else first
    noise = np.ones(len(offset_hz))
    delay_s, gain = np.zeros(len(bursts)), np.ones(len(bursts), np.complex128)
    search = True
    misfit = np.ones(len(bursts))
    misfit = np.ones(len(bursts))
    for attempt in range(6):
        used = np.array([not why for why in reason])
        if np.count_nonzero(used) < 3:
            break
        for _ in range(ROUNDS):
            before = delay_s
            share = None if search else np.conj(gain) * used / np.sum(np.abs(gain[used]) ** 2)
            delay_s, gain = _fit(bursts, offset_hz, mean, noise, delay_s, share)
            delay_s = delay_s - delay_s[used].mean()
            gain = gain / np.median(np.abs(gain[used]))
            mean = _mean(bursts, offset_hz, delay_s, gain, used)
            settled = not search and np.max(np.abs(delay_s - before)[used]) < STILL_S
            search = False
            if settled:
                break
        noise, misfit = _left(bursts, offset_hz, mean, delay_s, gain, used)
        if not _leave_out(reason, used, misfit, gain) and attempt:
            break
    used = np.array([not why for why in reason])
    if np.count_nonzero(used) < 3:
        told = ", ".join(f"{reason.count(why)} {why}" for why in dict.fromkeys(filter(None, reason)))
        raise ValueError(
            f"of {len(bursts)} bursts {np.count_nonzero(used)} can be used{f' ({told})' if told else ''}; at least 3 "
            "are needed: record longer, at rest, with nothing else sounding"
        )
    weight = np.abs(gain[:, None]) ** 2 * (np.abs(mean) ** 2 / noise)[None, :]
    centre = np.sum(weight * offset_hz, axis=1) / np.sum(weight, axis=1)
    curve = np.sum(weight * (2 * np.pi * (offset_hz[None, :] - centre[:, None])) ** 2, axis=1)
    sd = np.sqrt(np.maximum(misfit, 1.0) / (2.0 * curve))
    return Aligned(mean, gain, delay_s, sd, noise, misfit, used, tuple(reason))


def _fit(
    bursts: NDArray[np.complex64],
    offset_hz: Floats,
    mean: Complexes,
    noise: Floats,
    delay_s: Floats,
    share: Complexes | None,
) -> tuple[Floats, Complexes]:
    """Delay and gain of each burst against the mean.

    ``share`` (k,) is the part each burst has in the mean, to be taken out of it; None: search delays from afresh.
    """
    out, gains = delay_s.copy(), np.empty(len(bursts), np.complex128)
    turn = 2j * np.pi * offset_hz
    for begin in range(0, len(bursts), CHUNK):
        rows = slice(begin, begin + CHUNK)
        heard = bursts[rows].astype(np.complex128)
        at = out[rows]
        model = np.broadcast_to(mean, heard.shape)
        if share is not None:
            laid = heard * np.exp(turn * at[:, None])
            part = np.abs(share[rows, None]) ** 2 / np.sum(np.abs(share) ** 2)
            model = (mean - share[rows, None] * laid) / np.maximum(1.0 - part, 0.1)
        product = heard * np.conj(model) / noise
        if share is None:
            grid = np.linspace(-SPAN_S, SPAN_S, 25)
            tried = np.abs(product @ np.exp(np.multiply.outer(turn, grid)))
            at = grid[np.argmax(tried, axis=1)]
        for _ in range(8 if share is None else 3):
            laid = product * np.exp(turn * at[:, None])
            a = laid.sum(axis=1)
            a1, a2 = laid @ turn, laid @ turn**2
            slope = 2.0 * np.real(np.conj(a) * a1)
            bend = 2.0 * (np.abs(a1) ** 2 + np.real(np.conj(a) * a2))
            step = np.where(bend < 0, -slope / np.where(bend < 0, bend, -1.0), np.sign(slope) * 2e-6)
            at = at + np.clip(step, -5e-6, 5e-6)
            if np.max(np.abs(step)) < 0.1 * STILL_S:
                break
        laid = product * np.exp(turn * at[:, None])
        out[rows] = at
        gains[rows] = laid.sum(axis=1) / np.sum(np.abs(model) ** 2 / noise, axis=1)
    return out, gains


def _mean(
    bursts: NDArray[np.complex64], offset_hz: Floats, delay_s: Floats, gain: Complexes, used: NDArray[np.bool_]
) -> Complexes:
    """Least-squares mean of the used bursts, each turned and moved back."""
    total = np.zeros(len(offset_hz), np.complex128)
    for i in np.flatnonzero(used):
        total += np.conj(gain[i]) * bursts[i] * np.exp(2j * np.pi * offset_hz * delay_s[i])
    return total / np.sum(np.abs(gain[used]) ** 2)


def leavings(
    bursts: NDArray[np.complex64], offset_hz: Floats, mean: Complexes, delay_s: Floats, gain: Complexes
) -> Complexes:
    """What bursts (k, b) leave beside the mean, laid upon each other: (k, b)."""
    laid = bursts * np.exp(2j * np.pi * np.multiply.outer(delay_s, offset_hz))
    return laid - gain[:, None] * mean


def _left(
    bursts: NDArray[np.complex64],
    offset_hz: Floats,
    mean: Complexes,
    delay_s: Floats,
    gain: Complexes,
    used: NDArray[np.bool_],
) -> tuple[Floats, Floats]:
    """Noise power in each bin, and each burst's misfit."""
    total, misfit = np.zeros(len(offset_hz)), np.empty(len(bursts))
    for begin in range(0, len(bursts), CHUNK):
        rows = slice(begin, begin + CHUNK)
        power = np.abs(leavings(bursts[rows], offset_hz, mean, delay_s[rows], gain[rows])) ** 2
        misfit[rows] = power.mean(axis=1)
        total += power[used[rows]].sum(axis=0)
    count = np.count_nonzero(used)
    # of each burst a share of 1 / count went into the mean
    noise = total / max(count - 1, 1)
    width = min(31, len(noise))
    pad = np.pad(noise, width // 2, mode="reflect")
    smooth = np.convolve(pad, np.full(width, 1.0 / width), "valid")[: len(noise)]
    middle = max(float(np.median(misfit[used])), 1e-300)
    return np.maximum(smooth, 1e-9 * max(float(smooth.max()), 1e-300)), misfit / middle


def _leave_out(reason: list[str], used: NDArray[np.bool_], misfit: Floats, gain: Complexes) -> bool:
    """Mark bursts that do not fit, at most as many as leave half; say whether any was."""
    found: list[tuple[float, int, str]] = []
    for values, floor, why in (
        (np.log(misfit), 0.15, "disturbed"),
        (np.log(np.abs(gain)), 0.03, "of another strength"),
    ):
        centre = float(np.median(values[used]))
        spread = max(1.4826 * float(np.median(np.abs(values[used] - centre))), floor)
        away = (values - centre) / spread
        if why == "disturbed":
            away = np.maximum(away, 0.0)
        found += [(float(abs(away[i])), int(i), why) for i in np.flatnonzero(used & (np.abs(away) > 6.0))]
    spare = max(0, np.count_nonzero(used) - max(3, len(used) // 3))
    marked = False
    for _, i, why in sorted(found, reverse=True):
        if spare and not reason[i]:
            reason[i], marked, spare = why, True, spare - 1
    return marked


def align_one(burst: Complexes, model: Complexes, noise: Floats, offset_hz: Floats) -> float:
    """Delay (s) of one burst against a model, both slices (b,), to within `SPAN_S` of each other."""
    delay_s, _ = _fit(burst[None].astype(np.complex64), offset_hz, model, noise, np.zeros(1), None)
    return float(delay_s[0])
