"""The loops over samples of the joint refinement. Each has a plain twin in the tests."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.signals.interpolate import read, read_slope

RENEWED = 256
"""Samples over which a turning phase is carried on by multiplication before it is computed afresh."""


@numba.njit(cache=True, inline="always")
def _sounding(size, table_rate_hz, table_start_s, half_s, start_s, rate_hz, count, arrival_s, beta, kappa):
    """First and past-the-last sample at which a burst's own time lies inside its table (monotonic: |β| ≪ 1)."""
    low = table_start_s + 1.0 / table_rate_hz - half_s
    high = table_start_s + (size - 3.0) / table_rate_hz - half_s
    # u − β u − κ/2 u² = edge, by three rounds of substitution; κ u ≪ 1
    u_low, u_high = low, high
    for _ in range(3):
        u_low = (low + 0.5 * kappa * u_low * u_low) / (1.0 - beta)
        u_high = (high + 0.5 * kappa * u_high * u_high) / (1.0 - beta)
    first = int(np.ceil((arrival_s + u_low - start_s) * rate_hz)) + 1
    last = int(np.floor((arrival_s + u_high - start_s) * rate_hz)) - 1
    first = min(max(first, 0), count)
    return first, max(first, min(last, count))


@numba.njit(cache=True, inline="always")
def _turned(carrier_hz, beta, kappa, u):
    phase = -2.0 * np.pi * carrier_hz * (beta * u + 0.5 * kappa * u * u)
    return complex(np.cos(phase), np.sin(phase))


@numba.njit(cache=True)
def columns(
    table: NDArray[np.complex128],
    table_rate_hz: float,
    table_start_s: float,
    half_s: float,
    carrier_hz: float,
    start_s: float,
    rate_hz: float,
    arrival_s: float,
    beta: float,
    kappa: float,
    out: NDArray[np.float32],
) -> tuple[int, int]:
    """Model of one burst of unit gain and its derivatives by arrival, β and κ into ``out`` (4, 2, n).

    Real and imaginary parts apart, 0 where it is silent. Returns the first and past-the-last sample that sounds.
    """
    count = out.shape[2]
    out[:] = 0.0
    first, last = _sounding(
        table.shape[0], table_rate_hz, table_start_s, half_s, start_s, rate_hz, count, arrival_s, beta, kappa
    )
    turn = -2j * np.pi * carrier_hz
    step_s = 1.0 / rate_hz
    carrier = 1.0 + 0.0j
    ahead = 1.0 + 0.0j
    bend = _turned(carrier_hz, 0.0, 2.0 * kappa, step_s)
    for n in range(first, last):
        u = start_s + n / rate_hz - arrival_s
        if (n - first) % RENEWED == 0:
            carrier = _turned(carrier_hz, beta, kappa, u)
            ahead = _turned(carrier_hz, beta, kappa, u + step_s) * np.conj(carrier)
        tau = half_s + u - beta * u - 0.5 * kappa * u * u
        position = (tau - table_start_s) * table_rate_hz
        model = read(table, position) * carrier
        slope = read_slope(table, position) * table_rate_hz * carrier
        inward = turn * model - slope
        # u falls as the arrival grows
        moved = -(1.0 - beta - kappa * u) * slope - turn * (beta + kappa * u) * model
        out[0, 0, n] = model.real
        out[0, 1, n] = model.imag
        out[1, 0, n] = moved.real
        out[1, 1, n] = moved.imag
        out[2, 0, n] = u * inward.real
        out[2, 1, n] = u * inward.imag
        out[3, 0, n] = 0.5 * u * u * inward.real
        out[3, 1, n] = 0.5 * u * u * inward.imag
        carrier *= ahead
        ahead *= bend
    return first, last


@numba.njit(cache=True)
def add_model(
    total: NDArray[np.complex128],
    table: NDArray[np.complex128],
    table_rate_hz: float,
    table_start_s: float,
    half_s: float,
    carrier_hz: float,
    start_s: float,
    rate_hz: float,
    arrival_s: float,
    beta: float,
    kappa: float,
    gain: complex,
) -> None:
    """Add ``gain`` times one burst's model to ``total`` (n,)."""
    first, last = _sounding(
        table.shape[0], table_rate_hz, table_start_s, half_s, start_s, rate_hz, total.shape[0], arrival_s, beta, kappa
    )
    step_s = 1.0 / rate_hz
    carrier = 1.0 + 0.0j
    ahead = 1.0 + 0.0j
    bend = _turned(carrier_hz, 0.0, 2.0 * kappa, step_s)
    for n in range(first, last):
        u = start_s + n / rate_hz - arrival_s
        if (n - first) % RENEWED == 0:
            carrier = gain * _turned(carrier_hz, beta, kappa, u)
            ahead = _turned(carrier_hz, beta, kappa, u + step_s) * np.conj(_turned(carrier_hz, beta, kappa, u))
        tau = half_s + u - beta * u - 0.5 * kappa * u * u
        total[n] += read(table, (tau - table_start_s) * table_rate_hz) * carrier
        carrier *= ahead
        ahead *= bend


@numba.njit(cache=True)
def matched_parts(
    heard: NDArray[np.complex128],
    table: NDArray[np.complex128],
    table_rate_hz: float,
    table_start_s: float,
    half_s: float,
    carrier_hz: float,
    start_s: float,
    rate_hz: float,
    arrival_s: float,
    beta: float,
    kappa: float,
    left_out: NDArray[np.bool_],
    parts: int,
) -> tuple[NDArray[np.complex128], Floats, Floats]:
    """Inner products (parts,) of a burst's model of unit gain with ``heard`` (n,), part by part of its length.

    Also the middle of each part, from the arrival, and the model's energy in it (parts,). What is left out counts as
    neither.
    """
    first, last = _sounding(
        table.shape[0], table_rate_hz, table_start_s, half_s, start_s, rate_hz, heard.shape[0], arrival_s, beta, kappa
    )
    seen, middle_s, energy = np.zeros(parts, np.complex128), np.zeros(parts), np.full(parts, 1e-300)
    step_s = 1.0 / rate_hz
    carrier = 1.0 + 0.0j
    ahead = 1.0 + 0.0j
    bend = _turned(carrier_hz, 0.0, 2.0 * kappa, step_s)
    size = max(1, -(-(last - first) // parts))
    for n in range(first, last):
        u = start_s + n / rate_hz - arrival_s
        if (n - first) % RENEWED == 0:
            carrier = _turned(carrier_hz, beta, kappa, u)
            ahead = _turned(carrier_hz, beta, kappa, u + step_s) * np.conj(carrier)
        tau = half_s + u - beta * u - 0.5 * kappa * u * u
        model = read(table, (tau - table_start_s) * table_rate_hz) * carrier
        if not left_out[n]:
            seen[(n - first) // size] += np.conj(model) * heard[n]
            energy[(n - first) // size] += model.real**2 + model.imag**2
        carrier *= ahead
        ahead *= bend
    for p in range(parts):
        middle_s[p] = start_s + (first + p * size + (size - 1) / 2.0) / rate_hz - arrival_s
    return seen, middle_s, energy


@numba.njit(cache=True)
def left_around(
    left: NDArray[np.complex128], left_out: NDArray[np.bool_], support: NDArray[np.int64]
) -> tuple[Floats, int]:
    """Mean power of ``left`` (n,) over each burst's ``support`` (k, 2), and how many samples lie in any or between.

    What is left out counts as neither power nor sample.
    """
    out = np.zeros(support.shape[0])
    begin, end = left.shape[0], 0
    for i in range(support.shape[0]):
        first, last = support[i]
        begin, end = min(begin, first), max(end, last)
        total, samples = 0.0, 0
        for n in range(first, last):
            if not left_out[n]:
                total += left[n].real ** 2 + left[n].imag ** 2
                samples += 1
        out[i] = total / max(samples, 1)
    counted = 0
    for n in range(begin, end):
        counted += not left_out[n]
    return out, counted


@numba.njit(cache=True)
def assemble(products: NDArray[np.complex128], gain: NDArray[np.complex128]) -> Floats:
    """Real normal matrix (5 k, 5 k) of gain (real, imaginary), arrival, β and κ from inner products of unit columns."""
    count = gain.shape[0]
    out = np.empty((5 * count, 5 * count))
    factor = np.empty((count, 5), np.complex128)
    for i in range(count):
        factor[i, 0] = 1.0
        factor[i, 1] = 1j
        factor[i, 2:] = gain[i]
    for i in range(count):
        for j in range(i + 1):
            for a in range(5):
                for b in range(5):
                    value = products[4 * i + max(a - 1, 0), 4 * j + max(b - 1, 0)]
                    weighed = (np.conj(factor[i, a]) * factor[j, b] * value).real
                    out[5 * i + a, 5 * j + b] = weighed
                    out[5 * j + b, 5 * i + a] = weighed
    return out
