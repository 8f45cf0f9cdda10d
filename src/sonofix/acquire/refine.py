"""Joint maximum likelihood of all heard bursts: arrival, time scale, curvature and complex gain of each.

Heard about its middle t₀, a burst's own time is ``τ = T/2 + (t − t₀) − β (t − t₀) − κ/2 (t − t₀)²`` with β the range
rate and κ the range acceleration over the sound speed. The carrier's phase follows the same τ, so that motion within
the burst is seen by the carrier, and the arrival by the envelope alone (its phase at t₀ is free: the bound is that for
unknown carrier phase).

Bursts join one by one. The derivatives of a burst that has hardly moved are kept, and so are their inner products, so
that another one among fifty costs little; what is left over is always that of the bursts as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from sonofix.acquire.kernels import add_model, assemble, columns, left_around, matched_parts
from sonofix.records import Floats, Waveform

Complexes = NDArray[np.complex128]

STEP_LIMIT = np.array([1e-4, 3e-4, 1e-1])
"""Of one iteration in arrival (s), β and κ (1/s)."""

STALE_RAD = 0.3
FRESH_RAD = 0.03
"""Derivatives are renewed when a burst's phase, at any frequency and moment that counts, has turned by this: while
bursts are still being found, and when it is to be exact."""

SETTLED_RAD = 3e-4
"""A step that turns no phase by more changes nothing: 10 µm."""

UNCHANGED = 1e-7
"""Of the misfit: a step that changes it by less, either way, ends the descent."""

MOST_DAMPING = 1e3

PLAUSIBLE = 3.0
"""Deviations of κ that `Joint.straighten` looks through."""

BEND_STEP_RAD = 1.2
MOST_BEND_RAD = 24.0
"""What steps and limits of curvature turn a burst's end by, against its middle."""

PARTS = 128
"""Of a burst, within each of which no plausible curvature turns the phase far."""

WOBBLES = 4
"""Degrees beyond a parabola's that `Joint.wobble` looks for."""

MUCH_MORE = 1.6
"""Power explained, over that of the present fit, at which another curvature is taken."""

ROUNDING = 1e-6
"""Of the normal matrix's unit diagonal: what single precision leaves uncertain of inner products."""


@dataclass(frozen=True, slots=True, eq=False)
class Burst:
    """One burst in the base band: ``arrival_s`` of its middle, β, κ (1/s) and complex gain.

    ``swing`` is what β at the middle is more than β, the slope there of a wobble that the waveform was turned by;
    ``swing_sd`` how surely: half of what that slope is all along, root mean square.
    """

    waveform: Waveform
    arrival_s: float
    beta: float
    kappa: float
    gain: complex
    swing: float = 0.0
    swing_sd: float = 0.0

    @property
    def state(self) -> Floats:
        """Arrival, β and κ."""
        return np.array([self.arrival_s, self.beta, self.kappa])


class Joint:
    """Bursts fitted together to one stretch of base band.

    Parameters
    ----------
    baseband : complex128 (n,)
        First sample at ``start_s``.
    kappa_sd : float
        Prior deviation of each κ, 1/s: what acceleration across the line of sight is plausible, over c.
    whiteness : float
        `Band.whiteness`: noise inside the pass band is denser than the same power spread over the whole base band.

    Attributes
    ----------
    bursts : list of Burst
    residual : complex128 (n,)
        What they leave.
    """

    def __init__(
        self, baseband: Complexes, start_s: float, rate_hz: float, kappa_sd: float, whiteness: float, room: int = 8
    ) -> None:
        self.bursts: list[Burst] = []
        self.residual: NDArray[np.complex128] = np.array(baseband, np.complex128)
        self._baseband = baseband
        self._left_out = np.zeros(len(baseband), bool)
        self._start_s, self._rate_hz = start_s, rate_hz
        self._kappa_sd, self._whiteness = kappa_sd, whiteness
        count = len(baseband)
        # real and imaginary part of the model and its derivatives by arrival, β and κ, for each burst
        self._columns = np.zeros((room, 4, 2, count), np.float32)
        self._products = np.zeros((4 * room, 4 * room), np.complex128)
        self._support = np.zeros((room, 2), np.int64)
        self._made = np.zeros((room, 3))  # arrival, β and κ that the columns are of
        self._turn = np.zeros((room, 3))  # phase that a unit of each turns

    def add(self, burst: Burst) -> None:
        """Take in another burst; its gain is solved for in what the others leave."""
        i = len(self.bursts)
        if i == len(self._support):
            self._grow()
        half_s = burst.waveform.duration_s / 2
        turn = 2 * np.pi * burst.waveform.carrier_hz
        self._turn[i] = 2 * np.pi * rms_hz(burst.waveform), turn * half_s, turn * half_s**2 / 2
        self.bursts.append(burst)
        self._renew(i)
        self._solve_gain(i)

    def keep(self, which: list[int]) -> None:
        """Drop all bursts but these; `settle` what is left."""
        rows = (4 * np.array(which, int)[:, None] + np.arange(4)).ravel()
        count = len(which)
        self._products[: 4 * count, : 4 * count] = self._products[np.ix_(rows, rows)]
        for table in (self._columns, self._support, self._made, self._turn):
            table[:count] = table[which]
        self.bursts = [self.bursts[i] for i in which]
        self.residual = self._left(self.bursts)

    def replace_baseband(self, baseband: Complexes) -> None:
        """Fit the same bursts to other samples of the same stretch (a tone was followed anew)."""
        self._baseband = baseband
        self.residual = self._left(self.bursts)

    def leave_out(self, which: NDArray[np.bool_]) -> None:
        """Fit without some samples (n,): what happens in them tells nothing of bursts."""
        self._left_out = which
        self.residual = self._left(self.bursts)
        for i in range(len(self.bursts)):
            self._renew(i)

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Samples that are not left out (n,)."""
        return ~self._left_out

    def settle(self, iterations: int, stale_rad: float = STALE_RAD) -> None:
        """Gauss–Newton on all bursts at once, Levenberg-damped where a step does not lower the misfit."""
        if not self.bursts:
            return
        state = np.stack([b.state for b in self.bursts])
        gain = np.array([b.gain for b in self.bursts])
        damping = 0.0
        for _ in range(iterations):
            # κ² counts beside |residual|² by the noise, which is known the better the further this has come
            weight = self.noise() / (2 * self._kappa_sd**2)
            cost = _power(self.residual) + float(np.sum(weight * state[:, 2] ** 2))
            self._renew_stale(stale_rad)
            normal, size = self._normal(gain, weight)
            seen = self._seen(0, len(self.bursts))
            right = self._right(seen, gain)
            right[4::5] -= weight * state[:, 2]
            normal[np.diag_indices(len(normal))] += damping
            step = (np.linalg.solve(normal, right / size) / size).reshape(-1, 5)
            # half a chip and a tenth of a metre a second bound what the linearisation can be trusted for
            move = np.clip(step[:, 2:], -STEP_LIMIT, STEP_LIMIT)
            moved = [
                Burst(b.waveform, row[0], row[1], row[2], complex(g), b.swing, b.swing_sd)
                for b, row, g in zip(
                    self.bursts, (state + move).tolist(), gain + step[:, 0] + 1j * step[:, 1], strict=True
                )
            ]
            residual = self._left(moved)
            tried = _power(residual) + float(np.sum(weight * (state[:, 2] + move[:, 2]) ** 2))
            if tried > cost * (1 + 1e-12):
                if tried < cost * (1 + UNCHANGED):
                    break
                damping = max(4 * damping, 0.05)
                if damping > MOST_DAMPING:
                    break
                continue
            self.bursts, self.residual = moved, residual
            state, gain = state + move, np.array([b.gain for b in moved])
            settled = cost - tried < UNCHANGED * cost or np.max(np.abs(move) * self._turn[: len(moved)]) < SETTLED_RAD
            damping /= 4
            if settled:
                break

    def residual_with(self, i: int) -> Complexes:
        """What all bursts but one leave (n,)."""
        out = self.residual.copy()
        self._subtract(out, replace(self.bursts[i], gain=-self.bursts[i].gain))
        return out

    def straighten(self, i: int) -> bool:
        """Look for burst i's curvature over all that is plausible; say whether another explains much more.

        A long burst from a source that speeds up turns its phase by many radians off any straight line, and a descent
        that began on one ends in a side valley.
        """
        burst = self.bursts[i]
        _, by_beta, by_kappa = self._turn[i]
        most = min(PLAUSIBLE * self._kappa_sd, MOST_BEND_RAD / by_kappa)
        kappas = np.linspace(-most, most, 2 * int(np.ceil(most * by_kappa / BEND_STEP_RAD)) + 1)
        # a line along one half of a parabola is off by half the bend it leaves out
        reach = most * burst.waveform.duration_s / 4
        betas = burst.beta + np.linspace(-reach, reach, 2 * int(np.ceil(reach * by_beta / BEND_STEP_RAD)) + 1)
        heard, fixed = self.residual_with(i), self._fixed(burst.waveform, burst.waveform.envelope)
        # what another line or parabola turns is turned part by part; the code's own stretch by it is small
        seen, u_s, _ = matched_parts(heard, *fixed, burst.arrival_s, burst.beta, burst.kappa, self._left_out, PARTS)
        turn = 2j * np.pi * burst.waveform.carrier_hz
        bends = np.exp(turn / 2 * np.outer(kappas - burst.kappa, u_s**2))
        power = np.abs(bends * seen @ np.exp(turn * np.outer(u_s, betas - burst.beta))) ** 2
        k, b = np.unravel_index(int(np.argmax(power)), power.shape)
        now = self._explained(heard, burst, burst.waveform.envelope)
        better = replace(burst, beta=float(betas[b]), kappa=float(kappas[k]))
        if not self._explained(heard, better, burst.waveform.envelope) > MUCH_MORE * now:
            return False
        self.bursts[i] = better
        self._renew(i)
        self.residual = heard
        self._solve_gain(i)
        return True

    def wobble(self, i: int) -> tuple[Floats, float]:
        """Phase by which burst i leaves its parabola, as a source does that starts or ends a turn meanwhile.

        Returns
        -------
        coefficients : float64 (k,)
            In rad, of the Legendre polynomials from degree 3 on, over the burst's length.
        gained : float
            Power explained more with it than without; noise alone gives half its power a coefficient.
        """
        burst = self.bursts[i]
        fixed = self._fixed(burst.waveform, burst.waveform.envelope)
        state = burst.arrival_s, burst.beta, burst.kappa
        seen, u_s, energy = matched_parts(self.residual_with(i), *fixed, *state, self._left_out, PARTS)
        basis = legendre.legvander(2 * u_s / burst.waveform.duration_s, 2 + WOBBLES)
        weight = np.sqrt(energy / np.sum(energy))[:, None]
        before, phase = float(abs(np.sum(seen)) ** 2), np.zeros(WOBBLES)
        for _ in range(3):
            turned = seen * np.exp(-1j * basis[:, 3:] @ phase)
            total = complex(np.sum(turned))
            # an imaginary part, over what its share of the whole has, is a phase
            across = (turned * np.conj(total)).imag / max(abs(total) ** 2, 1e-300)
            phase = phase + np.linalg.lstsq(weight * basis, across / weight[:, 0], rcond=None)[0][3:]
        after = float(abs(np.sum(seen * np.exp(-1j * basis[:, 3:] @ phase))) ** 2)
        return phase, (after - before) / float(np.sum(energy))

    def follow(self, i: int, wobble: Floats) -> None:
        """Turn burst i's waveform by a phase as `wobble` returns it; `settle` all then."""
        burst = self.bursts[i]
        w = burst.waveform
        tau = w.start_s + np.arange(len(w.envelope)) / w.rate_hz
        # beyond its length, where it rings on, a polynomial would run away
        inside = np.clip(2 * tau / w.duration_s - 1.0, -1.0, 1.0)
        turn = np.exp(1j * legendre.legval(inside, np.concatenate([np.zeros(3), wobble])))
        signature = w.signature * turn
        envelope = signature if w.signature is w.envelope else w.envelope * turn
        slopes = legendre.legval(np.linspace(-1.0, 1.0, 65), legendre.legder(np.concatenate([np.zeros(3), wobble])))
        slopes *= -2 / w.duration_s / (2 * np.pi * w.carrier_hz)
        swing = burst.swing + float(slopes[32])
        swing_sd = float(np.hypot(burst.swing_sd, 0.5 * np.sqrt(np.mean(slopes**2))))
        self.bursts[i] = replace(
            burst, waveform=replace(w, envelope=envelope, signature=signature), swing=swing, swing_sd=swing_sd
        )
        self._renew(i)
        self.residual = self._left(self.bursts)

    def matched(self, i: int) -> float:
        """Power that burst i's signature, without the bare carrier that all bursts share, explains of what is its own.

        That of a burst is its energy; a fit that took other bursts' carrier for its own has less.
        """
        burst = self.bursts[i]
        return self._explained(self.residual_with(i), burst, burst.waveform.signature)

    def noise(self) -> Floats:
        """White-equivalent power left per sample around each burst (k,)."""
        support = self._support[: len(self.bursts)]
        power, counted = left_around(self.residual, self._left_out, support)
        power *= self._whiteness
        # what went into the fit, five real numbers a burst, is missing from what is left
        share = max(1.0 - 2.5 * len(self.bursts) / max(counted, 1), 0.1)
        return np.maximum(power / share, 1e-24)

    def covariances(self, noise: Floats) -> list[Floats]:
        """Of (arrival_s, β) of each burst, marginal over all else: (2, 2) each."""
        if not self.bursts:
            return []
        self._renew_stale(FRESH_RAD)
        self._link_all()
        gain = np.array([b.gain for b in self.bursts])
        normal, size = self._normal(gain, noise / (2 * self._kappa_sd**2))
        normal[np.diag_indices(len(normal))] += ROUNDING
        spread = np.linalg.solve(normal, np.eye(len(normal))) / np.outer(size, size)
        return [noise[i] / 2 * spread[5 * i + 2 : 5 * i + 4, 5 * i + 2 : 5 * i + 4] for i in range(len(self.bursts))]

    def _normal(self, gain: Complexes, weight: Floats) -> tuple[Floats, Floats]:
        """Normal matrix (5 k, 5 k) of gain (two parts), arrival, β and κ, scaled to a unit diagonal, and its scale."""
        normal = assemble(self._products, gain)
        kappa = np.arange(4, len(normal), 5)
        normal[kappa, kappa] += weight
        size = np.sqrt(np.diag(normal))
        size[size == 0] = 1.0
        normal /= np.outer(size, size)
        normal[np.diag_indices(len(normal))] += 1e-9
        return normal, size

    def _seen(self, first: int, last: int) -> Complexes:
        """Inner products (last − first, 4) of some bursts' columns with what is left."""
        count = len(self.residual)
        parts = np.ascontiguousarray(self.residual, np.complex128).view(np.float64).reshape(count, 2)
        seen = self._columns[first:last].reshape(-1, count) @ parts.astype(np.float32)
        return _inner(seen.reshape(last - first, 4, 2, 2))

    def _right(self, seen: Complexes, gain: Complexes) -> Floats:
        right = np.empty((len(gain), 5))
        right[:, 0], right[:, 1] = seen[:, 0].real, seen[:, 0].imag
        right[:, 2:] = (np.conj(gain)[:, None] * seen[:, 1:]).real
        return right.ravel()

    def _left(self, bursts: list[Burst]) -> Complexes:
        out = np.array(self._baseband, np.complex128)
        self._subtract(out, *bursts)
        return out

    def _solve_gain(self, i: int) -> None:
        """Give burst i, which is not yet taken from what is left, the gain that fits it best; take it away."""
        energy = self._products[4 * i, 4 * i].real
        gain = complex(self._seen(i, i + 1)[0, 0] / energy) if energy > 0 else 0j
        self.bursts[i] = replace(self.bursts[i], gain=gain)
        self._subtract(self.residual, self.bursts[i])

    def _subtract(self, residual: Complexes, *bursts: Burst) -> None:
        for burst in bursts:
            fixed = self._fixed(burst.waveform, burst.waveform.envelope)
            add_model(residual, *fixed, burst.arrival_s, burst.beta, burst.kappa, -burst.gain)
        residual[self._left_out] = 0.0

    def _explained(self, heard: Complexes, burst: Burst, table: Complexes) -> float:
        """Power that a burst, heard with one of its waveform's tables, explains of ``heard`` (n,), its gain free."""
        fixed = self._fixed(burst.waveform, table)
        state = burst.arrival_s, burst.beta, burst.kappa
        seen, _, energy = matched_parts(heard, *fixed, *state, self._left_out, 1)
        return float(abs(seen[0]) ** 2 / energy[0])

    def _fixed(self, w: Waveform, table: Complexes) -> tuple[Complexes, float, float, float, float, float, float]:
        """What the kernels ask of a burst and of the samples, whatever the burst does."""
        return table, w.rate_hz, w.start_s, w.duration_s / 2, w.carrier_hz, self._start_s, self._rate_hz

    def _renew_stale(self, stale_rad: float) -> None:
        state = np.stack([b.state for b in self.bursts])
        moved = np.max(np.abs(state - self._made[: len(state)]) * self._turn[: len(state)], axis=1)
        for i in np.flatnonzero(moved > stale_rad):
            self._renew(int(i))

    def _renew(self, i: int) -> None:
        """Columns of burst i, and their products with all others'."""
        burst = self.bursts[i]
        fixed = self._fixed(burst.waveform, burst.waveform.envelope)
        self._support[i] = columns(*fixed, burst.arrival_s, burst.beta, burst.kappa, self._columns[i])
        self._columns[i][..., self._left_out] = 0.0
        self._made[i] = burst.state
        first, last = self._support[i]
        bursts, count = len(self.bursts), len(self.residual)
        others = self._columns[:bursts].reshape(-1, count)[:, first:last]
        mixed = others @ self._columns[i].reshape(8, count)[:, first:last].T
        block = _inner(mixed.reshape(bursts, 4, 2, 4, 2).transpose(0, 1, 3, 2, 4)).reshape(4 * bursts, 4)
        self._products[: 4 * bursts, 4 * i : 4 * i + 4] = block
        self._products[4 * i : 4 * i + 4, : 4 * bursts] = np.conj(block.T)

    def _link_all(self) -> None:
        """All inner products, of columns as they are: together they are positive definite."""
        bursts, count = len(self.bursts), len(self.residual)
        rows = self._columns[:bursts].reshape(-1, count)
        mixed = (rows @ rows.T).reshape(bursts, 4, 2, bursts, 4, 2)
        block = _inner(mixed.transpose(0, 1, 3, 4, 2, 5)).reshape(4 * bursts, 4 * bursts)
        self._products[: 4 * bursts, : 4 * bursts] = block

    def _grow(self) -> None:
        room = len(self._support)
        for name in ("_columns", "_support", "_made", "_turn"):
            table = getattr(self, name)
            setattr(self, name, np.concatenate([table, np.zeros_like(table)]))
        wider = np.zeros((8 * room, 8 * room), np.complex128)
        wider[: 4 * room, : 4 * room] = self._products
        self._products = wider


@lru_cache(maxsize=256)
def rms_hz(waveform: Waveform) -> float:
    """Root mean square offset from the carrier of a burst's envelope."""
    slope = np.diff(waveform.envelope) * waveform.rate_hz
    power = float(np.sum(np.abs(waveform.envelope) ** 2))
    return float(np.sqrt(np.sum(np.abs(slope) ** 2) / max(power, 1e-300)) / (2 * np.pi))


def _inner(parts: NDArray[np.float32]) -> Complexes:
    """Σ conj(a) b from the products (…, 2, 2) of a's real and imaginary part with b's."""
    return (parts[..., 0, 0] + parts[..., 1, 1]) + 1j * (parts[..., 0, 1] - parts[..., 1, 0])


def _power(values: Complexes) -> float:
    return float(np.vdot(values, values).real)
