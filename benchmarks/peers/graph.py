"""GTSAM over all states at once: ranges and motion as factors of a chain, the extra unknowns as one more variable.

Gauss-Newton whose sparse linear systems are GTSAM's. Factors are linearised here, as GTSAM hands a copy of all
variables to every error function written in Python, at every call: minutes for these recordings, and the same answer.
"""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from peers.kalman import Filtered
from peers.problem import Model
from sonofix.records import Floats

EXTRAS = gtsam.symbol("e", 0)
SETTLED = 1e-3
"""Iterations end when nothing moves by more (m, rad, m/s)."""


def batch(model: Model, begin: Filtered, iterations: int) -> Filtered:
    """Return the most likely states at the filter's instants, begun at what the filter found."""
    states, extras = begin.state.copy(), begin.extras[-1].copy()
    keys = [gtsam.symbol("x", i) for i in range(len(states))]
    # along the chain, what all share last: the elimination stays banded
    ordering = gtsam.Ordering()
    for key in keys + [EXTRAS] * bool(len(extras)):
        ordering.push_back(key)
    for _ in range(iterations):
        found = _linear(model, begin, states, extras, keys).optimize(ordering)
        step = np.array([found.at(key) for key in keys])
        states += step
        moved = np.abs(step).max()
        if len(extras):
            extras += found.at(EXTRAS)
        if moved < SETTLED:
            break
    return Filtered(begin.time_s, states, np.tile(extras, (len(keys), 1)))


def _linear(
    model: Model, begin: Filtered, states: Floats, extras: Floats, keys: list[int]
) -> gtsam.GaussianFactorGraph:
    """All factors about the present states, each divided by its deviation."""
    problem, setting, graph = model.problem, model.setting, gtsam.GaussianFactorGraph()

    def add(parts: list[tuple[int, Floats]], miss: Floats) -> None:
        # what has no derivative is left away
        terms = [term for key, part in parts if part.size for term in (key, part)]
        graph.add(gtsam.JacobianFactor(*terms, miss, gtsam.noiseModel.Unit.Create(len(miss))))

    first, deviation = begin.state[0].copy(), np.full(model.own, 10.0)
    if problem.start is not None:
        first[:3], deviation[:] = problem.start, (0.3, 0.3, setting.heading_sd_rad)
    add([(keys[0], np.diag(1 / deviation))], (first - states[0]) / deviation)
    if len(extras):
        add([(EXTRAS, np.diag(1 / model.extras_sd()))], (model.extras() - extras) / model.extras_sd())
    for key, state, (_, rows) in zip(keys, states, problem.instants(), strict=True):
        shown, by_state, by_extras = model.ranges(state, extras, rows)
        miss, weight = problem.range_m[rows] - shown, 1 / model.range_sd_m(rows)
        # Cauchy's weight of each row, by its miss at present (Triggs et al. 2000)
        weight = weight / np.sqrt(1 + (miss * weight / setting.robust) ** 2)
        add([(key, by_state * weight[:, None]), (EXTRAS, by_extras * weight[:, None])], miss * weight)
    for i in range(len(keys) - 1):
        there, by_state, by_extras, spread = model.moved(states[i], extras, begin.time_s[i], begin.time_s[i + 1])
        root = np.linalg.cholesky(spread)
        parts = solve_triangular(
            root, np.hstack([-by_state, np.eye(model.own), -by_extras, (there - states[i + 1])[:, None]]), lower=True
        )
        own = model.own
        between = [(keys[i], parts[:, :own]), (keys[i + 1], parts[:, own : 2 * own])]
        # only the odometer's scale bears on the motion
        add([*between, (EXTRAS, parts[:, 2 * own : -1])] if setting.odometer_sd else between, parts[:, -1])
    return graph
