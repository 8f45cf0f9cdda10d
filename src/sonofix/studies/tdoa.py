"""The second seed's fix: differences of arrival times from ceiling beacons, the height known (eqs 1 to 4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats

ROUNDS = 20
CLOSE_M = 1e-7
"""Gauss–Newton is done when no fix moves farther."""


def slants(places_m: Floats, beacons_m: Floats, rise_m: float) -> Floats:
    """Ways dᵢ = √(rᵢ² + Δh²) (…, P) from places (…, 2) to beacons (P, 2) that hang ``rise_m`` = Δh higher."""
    apart = places_m[..., None, :] - beacons_m
    return np.sqrt(np.sum(apart**2, axis=-1) + rise_m**2)


def fixes(
    arrivals_s: Floats, beacons_m: Floats, rise_m: float, sound_speed_mps: float, time_sd_s: float, reference: int = 1
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Places from differences of arrival times to the reference beacon's, any number at once.

    With d_i − d_r = c (t_i − t_r) and errors of deviation σ on each time, the rows share the reference's error: their
    covariance is c² σ² (I + 1 1ᵀ), by which least squares are weighted. Gauss–Newton starts amid the beacons.

    Parameters
    ----------
    arrivals_s : float64 (…, P)
        By a clock of any offset.
    beacons_m : float64 (P, 2)
        Three or more.
    rise_m, sound_speed_mps, time_sd_s : float
    reference : int
        The second, as printed.

    Returns
    -------
    places_m : float64 (…, 2)
        NaN where it did not converge.
    covariance_m2 : float64 (…, 2, 2)
    valid : bool (…)
    """
    others = [i for i in range(len(beacons_m)) if i != reference]
    measured = sound_speed_mps * (arrivals_s[..., others] - arrivals_s[..., [reference]])
    weight = np.linalg.inv(np.eye(len(others)) + 1.0) / (sound_speed_mps * time_sd_s) ** 2
    places = np.broadcast_to(beacons_m.mean(axis=0), (*measured.shape[:-1], 2)).copy()
    moved = np.full(places.shape[:-1], np.inf)
    information = np.zeros((*places.shape[:-1], 2, 2))
    for _ in range(ROUNDS):
        ways = slants(places, beacons_m, rise_m)
        slopes = (places[..., None, :] - beacons_m) / ways[..., None]
        rows = slopes[..., others, :] - slopes[..., [reference], :]
        left = measured - (ways[..., others] - ways[..., [reference]])
        weighted = np.swapaxes(rows, -1, -2) @ weight
        information = weighted @ rows
        change = np.linalg.solve(information, (weighted @ left[..., None]))[..., 0]
        # far from the beacons hyperbolas straighten, and a whole step may leave the hall
        change /= np.maximum(1.0, np.linalg.norm(change, axis=-1, keepdims=True) / 5.0)
        places += change
        moved = np.linalg.norm(change, axis=-1)
        if (moved < CLOSE_M).all():
            break
    valid = moved < CLOSE_M
    places[~valid] = np.nan
    return places, np.linalg.inv(information), valid
