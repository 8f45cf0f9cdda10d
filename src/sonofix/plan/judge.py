"""What a set of ranges tells of each of many places: dilution, deviation, and the fault that would go unseen.

At a place, range i with deviation σᵢ has the row gᵢ = (u, 1, r): the unit vector u of its way, the clock's column where
that is unknown, and its length r, which the doubt about the sound speed scales. With W = diag(1/σᵢ²) and the sound
speed's prior P, C = (GᵀWG + P)⁻¹ is the covariance of all unknowns: the same as with that doubt as noise that all rows
share, but of five rows and columns however many beacons are heard. A fault ∇ in range i moves the χ² of the residuals
by ∇² (Wᵢᵢ − Wᵢᵢ² gᵢᵀ C gᵢ) (Baarda 1968; Teunissen 2006, Testing Theory, chapter 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.plan.mirror import inverse, undecided
from sonofix.records import Floats

NO_FIX_HDOP = 1e4
"""Beyond this dilution a millimetre of range error is ten metres of position: no fix in any useful sense."""

WEAK = 0.5
"""Of the nearest range: a fix of a larger deviation than this means nothing (as `locate` has it)."""


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Of each of p places; NaN where there is no fix.

    Attributes
    ----------
    heard : int64 (p,)
    hdop, vdop : float64 (p,)
        ``vdop`` is 0 where the level is known.
    sd_m, sd_z_m : float64 (p,)
    fault_m : float64 (p,)
        Infinite where a fault of some range is never detected. The linear model's, in which ranges do not bend and no
        other place fits: `locate.detectable` follows both, at ten thousand times the work.
    """

    heard: NDArray[np.int64]
    hdop: Floats
    vdop: Floats
    sd_m: Floats
    sd_z_m: Floats
    fault_m: Floats


def judged(
    places_m: Floats,
    nodes_m: Floats,
    weight: Floats,
    *,
    free_level: bool = False,
    clock: bool = False,
    speed_sd: float = 0.0,
    mirrors: bool = False,
    bounds_m: Floats | None = None,
    shift: Floats | None = None,
    weak: float = np.inf,
) -> Judgement:
    """Judge places by the ranges there.

    Parameters
    ----------
    places_m : float64 (p, 3)
    nodes_m : float64 (b, 3)
    weight : float64 (p, b)
        1/σ² of each range, 1/m²; 0 where it is not heard.
    free_level, clock : bool
        Whether the height, and an offset of all ranges, are unknown too.
    speed_sd : float
        Relative deviation of the sound speed.
    mirrors : bool
        Whether a place is no fix where the mirror image behind the plane (the line, where the level is known) of the
        beacons heard fits alike, as `locate.fix` judges it. Other twins (three beacons and an unknown clock) are not
        looked for.
    bounds_m : float64 (2, 3), optional
        Corners of the room. They decide where one of the two lies inside, and nothing where both do.
    shift : float64 (k,), optional
        ``[d]``: shift of the residuals, in deviations, that is detected with d degrees of freedom; without it no
        faults are judged. Beyond its end the last one holds.
    weak : float
        A place is no fix where x, y or height has a deviation of more than this share of the nearest range.

    Returns
    -------
    Judgement
    """
    weight = np.ascontiguousarray(weight, dtype=np.float64)
    if weight.shape != (len(places_m), len(nodes_m)):
        raise ValueError(f"weight has shape {weight.shape}; {len(places_m)} places and {len(nodes_m)} nodes need that")
    box = np.full((2, 3), np.nan) if bounds_m is None else np.array(bounds_m, float)
    if box.shape != (2, 3):
        raise ValueError(f"bounds_m has shape {box.shape}; give two corners of the room: (2, 3)")
    heard, out = np.zeros(len(places_m), np.int64), np.full((len(places_m), 5), np.nan)
    table = np.zeros(0) if shift is None else np.asarray(shift, float)
    places, nodes = (np.ascontiguousarray(a, dtype=np.float64) for a in (places_m, nodes_m))
    unknown = (3 if free_level else 2, clock, float(speed_sd))
    _judge(places, nodes, weight, unknown, (mirrors, box), table, float(weak), heard, out)
    return Judgement(heard, *out.T)


@numba.njit(cache=True, error_model="numpy")
def _judge(places, nodes, weight, unknowns, twins, shift, weak, heard, out):
    places_unknown, clock, speed_sd = unknowns
    free_level = places_unknown == 3
    mirrors, box = twins
    unknown = places_unknown + (1 if clock else 0)
    states = unknown + (1 if speed_sd > 0.0 else 0)
    rows = np.zeros((len(nodes), 5))
    plain, full = np.zeros((5, 5)), np.zeros((5, 5))
    unit_covariance, covariance = np.zeros((5, 5)), np.zeros((5, 5))
    for p in range(len(places)):
        n = 0
        nearest = np.inf
        plain[:], full[:] = 0.0, 0.0
        for b in range(len(nodes)):
            w = weight[p, b]
            if w <= 0.0:
                continue
            dx, dy, dz = places[p, 0] - nodes[b, 0], places[p, 1] - nodes[b, 1], places[p, 2] - nodes[b, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            # a node at the very place tells no direction
            over = 1.0 / distance if distance > 0.0 else 0.0
            g = rows[n]
            g[0], g[1] = dx * over, dy * over
            if free_level:
                g[2] = dz * over
            if clock:
                g[places_unknown] = 1.0
            if speed_sd > 0.0:
                g[unknown] = distance
            for i in range(states):
                for j in range(i + 1):
                    product = g[i] * g[j]
                    full[i, j] += w * product
                    if i < unknown:
                        plain[i, j] += product
            nearest = min(nearest, distance)
            n += 1
        heard[p] = n
        if n < unknown or not inverse(plain, unknown, unit_covariance):
            continue
        hdop2 = unit_covariance[0, 0] + unit_covariance[1, 1]
        vdop2 = unit_covariance[2, 2] if free_level else 0.0
        if hdop2 + vdop2 > NO_FIX_HDOP**2:
            continue
        if speed_sd > 0.0:
            full[unknown, unknown] += 1.0 / speed_sd**2
        if not inverse(full, states, covariance):
            continue
        worst = max(covariance[0, 0], covariance[1, 1])
        if free_level:
            worst = max(worst, covariance[2, 2])
        if worst > (weak * max(nearest, 0.2)) ** 2:
            continue
        half = 0.0
        if mirrors:
            unsure, half = undecided(places[p], nodes, weight[p], n, unknowns, box)
            if unsure:
                continue
        out[p, 0], out[p, 1] = np.sqrt(hdop2), np.sqrt(vdop2)
        out[p, 2] = np.sqrt(covariance[0, 0] + covariance[1, 1])
        out[p, 3] = np.sqrt(covariance[2, 2] + half**2) if free_level else 0.0
        if not len(shift):
            continue
        if n == unknown:
            out[p, 4] = np.inf
            continue
        detected = shift[min(n - unknown, len(shift) - 1)]
        most = 0.0
        k = 0
        for b in range(len(nodes)):
            w = weight[p, b]
            if w <= 0.0:
                continue
            g = rows[k]
            k += 1
            leverage = 0.0
            for i in range(states):
                for j in range(states):
                    leverage += g[i] * covariance[i, j] * g[j]
            seen = 1.0 - w * leverage
            # what rounding leaves of a range that nothing else checks
            most = np.inf if seen < 1e-9 else max(most, detected / np.sqrt(w * seen))
        out[p, 4] = most
