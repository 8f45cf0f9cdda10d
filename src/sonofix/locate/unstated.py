"""Ranges without a stated deviation: what they leave over says how good they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sonofix.geometry import link
from sonofix.ranging import flights_m
from sonofix.records import Fix, RangeEpoch
from sonofix.site import Site

ENOUGH = 8
"""Ranges to spare from which residuals tell a deviation: to a quarter of itself (1/√(2·8))."""


def fix_by_residuals(epoch: RangeEpoch, site: Site, solve: Callable[[RangeEpoch], tuple[Fix, ...]]) -> tuple[Fix, ...]:
    """Solve an epoch, and once more with a smaller deviation where its ranges state none and agree better than assumed.

    The variance is that of the residuals over the ranges to spare (the unbiased estimate of least squares); of several
    vehicles the largest. Ranges that agree worse are left to the test of each fix. Where neighbours err alike there are
    fewer ranges than rows, and covariances are widened by that (`alike`).

    Parameters
    ----------
    epoch : RangeEpoch
    site : Site
    solve : callable
        Gives the fixes of an epoch.
    """
    fixes = solve(epoch)
    if epoch.sd_stated:
        return fixes
    relative = epoch.sound_speed_sd_mps / epoch.sound_speed_mps
    flight_m = flights_m(epoch.range_m, epoch.clock == "common")
    own_m2 = np.diag(epoch.covariance_m2) - (relative * flight_m) ** 2
    shares = [
        float(np.sum(f.residual_m[f.used] ** 2 / own_m2[f.used])) / spare
        for f in fixes
        if f.status == "ok" and (spare := int(np.count_nonzero(f.used)) - len(f.states)) >= ENOUGH
    ]
    share = max(shares, default=1.0)
    if share >= 1.0 or len(shares) < len(fixes):
        return fixes
    again = solve(replace(epoch, covariance_m2=epoch.covariance_m2 - (1.0 - share) * np.diag(own_m2)))
    return tuple(_widened(f, alike(epoch, site, f)) if f.status == "ok" else f for f in again)


def _widened(found: Fix, factor: float) -> Fix:
    """Return a fix with ``factor`` on all variances, and its protection levels as much wider."""
    if found.covariance is None:
        return found
    wider = float(np.sqrt(factor))
    return replace(
        found,
        covariance=factor * found.covariance,
        hpl_m=None if found.hpl_m is None else wider * found.hpl_m,
        vpl_m=None if found.vpl_m is None else wider * found.vpl_m,
    )


def alike(epoch: RangeEpoch, site: Site, found: Fix) -> float:
    """Return by how many rows there are for each that errs on its own, at least 1.

    With ρ the correlation of residuals of neighbours (each row's nearest fixed end), a row in a chain of such rows
    counts as (1 − ρ)/(1 + ρ) (Bartlett 1935). There are at least as many as unknowns and one more.
    """
    links = link(site, epoch.emitter, epoch.receiver)
    rows = np.flatnonzero(found.used)
    place_m = np.where((links.emitter_vehicle < 0)[:, None], links.emitter_point, links.receiver_point)[rows]
    apart = np.linalg.norm(place_m[:, None] - place_m, axis=2)
    np.fill_diagonal(apart, np.inf)
    left_m = found.residual_m[rows]
    together = float(left_m @ left_m[np.argmin(apart, axis=1)] / max(float(left_m @ left_m), 1e-30))
    together = min(max(together, 0.0), 0.99)
    return min((1.0 + together) / (1.0 - together), len(rows) / (len(found.states) + 1))
