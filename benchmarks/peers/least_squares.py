"""Least squares epoch by epoch, by scipy.optimize.least_squares."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from peers.problem import Model, Problem
from sonofix.records import Floats


def sweeps(problem: Problem) -> list[slice]:
    """Rows in runs in which no pair of anchor and tag comes twice."""
    out: list[slice] = []
    first, seen = 0, set()
    for row, pair in enumerate(zip(problem.anchor.tolist(), problem.tag.tolist(), strict=True)):
        if pair in seen:
            out.append(slice(first, row))
            first, seen = row, set()
        seen.add(pair)
    return [*out, slice(first, len(problem.time_s))]


def solve(model: Model, rows: slice, begin: Floats) -> Floats | None:
    """Return x, y, z where unknown, yaw where unknown of one sweep; None where too few anchors were heard."""
    problem, n = model.problem, len(begin)
    if len(np.unique(problem.anchor[rows])) < 3:
        return None
    weight, extras = 1 / model.range_sd_m(rows), model.extras()

    def misfit(place: Floats) -> Floats:
        return (model.ranges(place, extras, rows)[0] - problem.range_m[rows]) * weight

    def jacobian(place: Floats) -> Floats:
        return model.ranges(place, extras, rows)[1][:, :n] * weight[:, None]

    return least_squares(misfit, begin, jac=jacobian).x


def middle(model: Model) -> Floats:
    """Where to begin a search: amid the anchors."""
    out = np.zeros(2 + model.rises + model.shows_yaw)
    out[: 2 + model.rises] = model.problem.anchors_m[:, : 2 + model.rises].mean(axis=0)
    return out


def epochs(model: Model) -> tuple[Floats, Floats]:
    """Times (k,) and positions (k, 3) of all sweeps that can be solved, each begun at the answer before."""
    problem, place = model.problem, middle(model)
    times, places = [], []
    for rows in sweeps(problem):
        found = solve(model, rows, place)
        if found is None:
            continue
        place = found
        times.append(float(np.mean(problem.time_s[rows])))
        places.append([*found[:2], found[2] if model.rises else problem.level_m])
    return np.array(times), np.array(places)
