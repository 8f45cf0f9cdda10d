"""Joint maximum likelihood of all heard bursts: arrival, time scale, curvature and complex gain of each.

Heard about its middle t₀, a burst's own time is ``τ = T/2 + (t − t₀) − β (t − t₀) − κ/2 (t − t₀)²`` with β the range
rate and κ the range acceleration over the sound speed. The carrier's phase follows the same τ, so that motion within
the burst is seen by the carrier, and the arrival by the envelope alone (its phase at t₀ is free: the bound is that for
unknown carrier phase).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, Waveform
from sonofix.signals.interpolate import read, read_slope

Complexes = NDArray[np.complexfloating]

STEP_LIMIT = np.array([1e-4, 3e-4, 1e-1])
"""Of one iteration in arrival (s), β and κ (1/s)."""


@dataclass(frozen=True, slots=True, eq=False)
class Burst:
    """One burst in the base band: ``arrival_s`` of its middle, β, κ (1/s) and complex gain."""

    waveform: Waveform
    arrival_s: float
    beta: float
    kappa: float
    gain: complex


@numba.njit(cache=True)
def columns(
    table: NDArray[np.complex128],
    table_rate_hz: float,
    table_start_s: float,
    half_s: float,
    carrier_hz: float,
    start_s: float,
    rate_hz: float,
    count: int,
    arrival_s: float,
    beta: float,
    kappa: float,
) -> NDArray[np.complex128]:
    """Model of one burst of unit gain and its derivatives by arrival, β and κ: (4, count), 0 where it is silent."""
    out = np.zeros((4, count), np.complex128)
    turn = -2j * np.pi * carrier_hz
    for n in range(count):
        u = start_s + n / rate_hz - arrival_s
        tau = half_s + u - beta * u - 0.5 * kappa * u * u
        position = (tau - table_start_s) * table_rate_hz
        if position < 1.0 or position > table.shape[0] - 3.0:
            continue
        phase = -2.0 * np.pi * carrier_hz * (beta * u + 0.5 * kappa * u * u)
        carrier = complex(np.cos(phase), np.sin(phase))
        model = read(table, position) * carrier
        slope = read_slope(table, position) * table_rate_hz * carrier
        out[0, n] = model
        # u falls as the arrival grows
        out[1, n] = -(1.0 - beta - kappa * u) * slope - turn * (beta + kappa * u) * model
        out[2, n] = u * (turn * model - slope)
        out[3, n] = 0.5 * u * u * (turn * model - slope)
    return out


@numba.njit(cache=True, fastmath=True)
def gram(rows: Floats) -> Floats:
    """``rows @ rows.T`` in blocks that stay in the cache.

    A threaded matrix product of this size spends its time waiting for threads as soon as the machine does other work.
    """
    count, length = rows.shape
    out = np.zeros((count, count))
    for begin in range(0, length, 512):
        end = min(begin + 512, length)
        for i in range(count):
            for j in range(i + 1):
                total = 0.0
                for k in range(begin, end):
                    total += rows[i, k] * rows[j, k]
                out[i, j] += total
    for i in range(count):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


def burst_columns(burst: Burst, start_s: float, rate_hz: float, count: int) -> NDArray[np.complex128]:
    """`columns` of a burst."""
    w = burst.waveform
    return columns(
        w.envelope,
        w.rate_hz,
        w.start_s,
        w.duration_s / 2,
        w.carrier_hz,
        start_s,
        rate_hz,
        count,
        burst.arrival_s,
        burst.beta,
        burst.kappa,
    )


def refine(
    baseband: Complexes,
    start_s: float,
    rate_hz: float,
    bursts: list[Burst],
    kappa_sd: float,
    whiteness: float,
    iterations: int = 12,
) -> tuple[list[Burst], list[Floats], Complexes, Floats]:
    """Gauss–Newton on all bursts at once, Levenberg-damped where a step does not lower the misfit.

    Parameters
    ----------
    baseband : complex128 (n,)
    bursts : list of Burst
        Starting values; gains are solved for.
    kappa_sd : float
        Prior deviation of each κ, 1/s: what acceleration across the line of sight is plausible, over c.
    whiteness : float
        `Band.whiteness`: noise inside the pass band is denser than the same power spread over the whole base band.

    Returns
    -------
    bursts : list of Burst
    covariances : list of float64 (2, 2)
        Of (arrival_s, β), marginal over all else.
    residual : complex128 (n,)
    noise : float64 (len(bursts),)
        White-equivalent noise power per sample around each burst.
    """
    count, n_bursts = len(baseband), len(bursts)
    state = np.array([[b.arrival_s, b.beta, b.kappa] for b in bursts])
    kappa_rows = 5 * np.arange(n_bursts) + 4

    def evaluate(state: Floats) -> tuple[Complexes, Complexes, Complexes]:
        """Model columns (n, 4, count), best gains (n,) and what they leave (count,)."""
        parts = np.stack(
            [
                burst_columns(_moved(burst, row, 0j), start_s, rate_hz, count)
                for burst, row in zip(bursts, state, strict=True)
            ]
        )
        basis = parts[:, 0]
        normal = np.einsum("in,jn->ij", np.conj(basis), basis)
        normal[np.diag_indices(n_bursts)] += 1e-9 * np.trace(normal).real / n_bursts + 1e-300
        gain = np.linalg.solve(normal, np.einsum("in,n->i", np.conj(basis), baseband))
        return parts, gain, baseband - np.einsum("i,in->n", gain, basis)

    parts, gain, residual = evaluate(state)
    noise = _noise(residual, parts[:, 0], whiteness)
    weight = noise / (2 * kappa_sd**2)  # of κ² beside |residual|²

    def misfit(residual: Complexes, state: Floats) -> float:
        return float(np.sum(np.abs(residual) ** 2) + np.sum(weight * state[:, 2] ** 2))

    cost = misfit(residual, state)
    damping = 0.0
    for _ in range(iterations):
        jacobian = _jacobian(parts, gain)
        normal = np.asarray(gram(jacobian))
        right = np.einsum("in,n->i", jacobian, _plain(residual))
        normal[kappa_rows, kappa_rows] += weight
        right[kappa_rows] -= weight * state[:, 2]
        size = np.sqrt(np.diag(normal))
        size[size == 0] = 1.0
        scaled = normal / np.outer(size, size)
        scaled[np.diag_indices(len(scaled))] += damping + 1e-12
        step = (np.linalg.solve(scaled, right / size) / size).reshape(n_bursts, 5)[:, 2:]
        # half a chip and a tenth of a metre a second bound what the linearisation can be trusted for
        step = np.clip(step, -STEP_LIMIT, STEP_LIMIT)
        tried = evaluate(state + step)
        cost_tried = misfit(tried[2], state + step)
        if cost_tried > cost * (1 + 1e-12):
            damping = max(4 * damping, 0.05)
            if damping > 1e3:
                break
            continue
        state = state + step
        parts, gain, residual = tried
        settled = cost - cost_tried < 1e-7 * cost or np.max(np.abs(step[:, 0])) < 1e-9
        cost = cost_tried
        damping /= 4
        if settled:
            break
    noise = _noise(residual, parts[:, 0], whiteness)
    jacobian = _jacobian(parts, gain)
    normal = np.asarray(gram(jacobian))
    normal[kappa_rows, kappa_rows] += noise / (2 * kappa_sd**2)
    size = np.sqrt(np.diag(normal))
    size[size == 0] = 1.0
    scaled = normal / np.outer(size, size)
    scaled[np.diag_indices(len(scaled))] += 1e-12
    spread = np.linalg.solve(scaled, np.eye(len(scaled))) / np.outer(size, size)
    covariances = [noise[i] / 2 * spread[5 * i + 2 : 5 * i + 4, 5 * i + 2 : 5 * i + 4] for i in range(n_bursts)]
    refined = [_moved(burst, row, complex(g)) for burst, row, g in zip(bursts, state, gain, strict=True)]
    return refined, covariances, residual, noise


def _moved(burst: Burst, row: Floats, gain: complex) -> Burst:
    """Return a burst at another arrival, β and κ, of another gain."""
    return Burst(burst.waveform, float(row[0]), float(row[1]), float(row[2]), gain)


def _plain(values: Complexes) -> Floats:
    """Complex values as real and imaginary parts in turn: Re(aᴴ b) becomes a plain product."""
    return np.ascontiguousarray(values).view(np.float64)


def _jacobian(parts: Complexes, gain: Complexes) -> Floats:
    """Rows: for each burst real gain, imaginary gain, arrival, β, κ; columns as `_plain`."""
    n_bursts, _, count = parts.shape
    jacobian = np.empty((n_bursts, 5, count), np.complex128)
    jacobian[:, 0] = parts[:, 0]
    jacobian[:, 1] = 1j * parts[:, 0]
    jacobian[:, 2:] = parts[:, 1:] * gain[:, None, None]
    return _plain(jacobian.reshape(5 * n_bursts, count))


def _noise(residual: Complexes, models: Complexes, whiteness: float) -> Floats:
    """White-equivalent residual power per sample where each burst sounds."""
    sounding = models != 0
    heard = np.maximum(np.sum(sounding, axis=1), 1)
    return np.maximum(whiteness * (sounding @ np.abs(residual) ** 2) / heard, 1e-24)
