"""How large a bias of one range must be for a fix to notice it, the bend of ranges and their mirrors included."""

from __future__ import annotations

import numpy as np

from sonofix.geometry import link, tilting
from sonofix.locate.integrity import MISSED
from sonofix.locate.rows import Rows
from sonofix.records import Fix, Floats, RangeEpoch
from sonofix.site import Site


def detectable_biases(epoch: RangeEpoch, site: Site, found: Fix, missed_rate: float = MISSED) -> tuple[Floats, Floats]:
    """Return the least bias of each range alone, of either sign, that the χ² test of a fix notices at its place.

    With a range or two to spare a bias moves the fix far before it shows, ranges bend on the way, and the others may
    have a second place that fits (a mirror image): about the bias that leads there none is noticed. `curved` tells how
    both are found.

    Parameters
    ----------
    epoch : RangeEpoch
    site : Site
    found : Fix
        Of that epoch.
    missed_rate : float
        How often a bias that counts as noticed may slip through.

    Returns
    -------
    least_m : float64 (n,)
        Biases from this one on are noticed, up to where another place fits. Infinite where a bias may hide at any
        size; NaN for rows that the fix does not rest on.
    sure_m : float64 (n,)
        No larger bias than this one hides. The same as ``least_m`` where no other place fits.

    Raises
    ------
    ValueError
        If the fix has no position, or the rate does not lie between 0 and 1.
    """
    if found.position_m is None:
        raise ValueError(f"found.status is {found.status!r}: there is no position to tell biases at; {found.remedy}")
    if not 0 < missed_rate < 1:
        raise ValueError(f"missed_rate {missed_rate}: give a probability between 0 and 1")
    who = [v.id for v in site.vehicles].index(found.vehicle)
    links = link(site, epoch.emitter, epoch.receiver)
    solver = Rows(epoch, links, who, site.vehicles[who].z_m, float(tilting(site)[who]))
    kept = np.flatnonzero(found.used[solver.rows])
    solutions = solver.candidates(kept)
    away_m = [float(np.linalg.norm(s.position_m - found.position_m)) for s in solutions]
    told = solver.least_biases(kept, solutions[int(np.argmin(away_m))], missed_rate)
    least_m, sure_m = np.full(len(epoch), np.nan), np.full(len(epoch), np.nan)
    least_m[solver.rows[kept]], sure_m[solver.rows[kept]] = told.T
    return least_m, sure_m
