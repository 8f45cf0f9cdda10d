"""filterpy's extended Kalman filter, instant by instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from peers.least_squares import middle, solve, sweeps
from peers.problem import Model
from sonofix.records import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
    """After the ranges of each instant: ``time_s`` (k,), ``state`` (k, own), ``extras`` (k, e)."""

    time_s: Floats
    state: Floats
    extras: Floats


class Filter(ExtendedKalmanFilter):
    """filterpy's filter with our peers' motion in place of its linear one."""

    def __init__(self, model: Model) -> None:
        extras = model.extras()
        super().__init__(dim_x=model.own + len(extras), dim_z=1)
        self._model, self._span = model, (0.0, 0.0)
        self.x = np.concatenate([np.zeros(model.own), extras])
        self.P = np.zeros((self.dim_x, self.dim_x))
        self.P[model.own :, model.own :] = np.diag(model.extras_sd() ** 2)

    def step(self, from_s: float, to_s: float) -> None:
        """Predict from one time to another."""
        self._span, own = (from_s, to_s), self._model.own
        _, by_state, by_extras, noise = self._model.moved(self.x[:own], self.x[own:], from_s, to_s)
        self.F, self.Q = np.eye(self.dim_x), np.zeros((self.dim_x, self.dim_x))
        self.F[:own, :own], self.F[:own, own:], self.Q[:own, :own] = by_state, by_extras, noise
        self.predict()

    def predict_x(self, u: float = 0) -> None:
        own = self._model.own
        self.x[:own] = self._model.moved(self.x[:own], self.x[own:], *self._span)[0]

    def hear(self, rows: slice, gate: float) -> None:
        """Correct by the ranges of one instant, leaving out those beyond the gate."""
        model, own = self._model, self._model.own
        shown, by_state, by_extras = model.ranges(self.x[:own], self.x[own:], rows)
        derivative, variance = np.hstack([by_state, by_extras]), model.range_sd_m(rows) ** 2
        measured = model.problem.range_m[rows]
        expected = np.einsum("ij,jk,ik->i", derivative, self.P, derivative) + variance
        near = (measured - shown) ** 2 <= gate**2 * expected
        if near.any():
            self.update(measured[near], lambda x: derivative[near], lambda x: shown[near], R=np.diag(variance[near]))


def run(model: Model) -> Filtered:
    """Run the filter through all ranges, from the start pose or the first sweep that least squares can solve."""
    problem, setting, ekf = model.problem, model.setting, Filter(model)
    own = model.own
    deviation = np.append(np.full(model.places, 1.0), np.full(own - model.places, setting.speed_sd_mps))
    if problem.start is not None:
        ekf.x[:3], now_s = problem.start, float(problem.odometry[0, 0])
        deviation[:] = (0.05, 0.05, setting.heading_sd_rad)
    else:
        first = next(rows for rows in sweeps(problem) if solve(model, rows, middle(model)) is not None)
        found = solve(model, first, middle(model))
        assert found is not None
        ekf.x[: len(found)], now_s = found, float(problem.time_s[0])
        if model.wheels:
            ekf.x[2], deviation[2] = setting.heading_rad, setting.heading_sd_rad
    ekf.P[:own, :own] = np.diag(deviation**2)
    times, states = [], []
    for time_s, rows in problem.instants():
        if time_s > now_s:
            ekf.step(now_s, time_s)
            now_s = time_s
        ekf.hear(rows, setting.gate)
        times.append(time_s)
        states.append(ekf.x.copy())
    return Filtered(np.array(times), np.array(states)[:, :own], np.array(states)[:, own:])
