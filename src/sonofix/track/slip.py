"""A vehicle that moved unnoticed by its own sensors: pushed, or on wheels that spin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import Links, turning
from sonofix.records import Event, Innovation, RangeEpoch
from sonofix.site import Site
from sonofix.track.belief import Belief, lift_heading, reopen
from sonofix.track.update import strangeness, update, weighed_rows

SLIPPED_M = 1.0
"""How far aside a vehicle may be found at once that was pushed, one sigma per axis."""

SLIPS = float(np.log(1e-3))
"""Logarithm of how likely a slip is in an epoch."""


@dataclass(frozen=True, slots=True, eq=False)
class Slip:
    """Who slipped, the belief once its place was opened and the epoch taken in anew, and that epoch's rows used."""

    vehicle: int
    belief: Belief
    used: NDArray[np.bool_]
    innovation: Innovation | None
    event: Event


def slipped(
    before: Belief,
    site: Site,
    epoch: RangeEpoch,
    links: Links,
    asked: NDArray[np.bool_],
    used: NDArray[np.bool_],
    asked_of: NDArray[np.bool_],
    unproven: NDArray[np.bool_],
) -> Slip | None:
    """Find the vehicle that slipped, where many ranges are refused.

    It is the one of those ``asked_of`` (V,) whose place, once opened, makes the epoch as a whole most likely; the
    epoch is then taken in anew. Ranges that others state may as well be outliers: a slip must be the likelier.

    Parameters
    ----------
    before : Belief
        Predicted to the epoch.
    asked, used : bool (n,)
        Rows that were asked, and that were believed.
    unproven : bool (V,)
        Vehicles that may not head as they were stated to start.
    """
    refused = asked & ~used
    best: tuple[float, int, Belief] | None = None
    for who in np.flatnonzero(before.placed & asked_of).tolist():
        own = asked & links.touch(who)
        if np.count_nonzero(refused & own) < max(2, np.count_nonzero(own) / 2):
            continue
        opened = reopen(before, who, SLIPPED_M)
        odds = strangeness(opened, epoch, links, asked)
        if best is None or odds < best[0]:
            best = odds, who, opened
    if best is None:
        return None
    _, who, opened = best
    if before.trust is not None:
        stays = weighed_rows(before, epoch, links, asked)
        moved = weighed_rows(opened, epoch, links, asked)
        if moved + SLIPS < stays:
            return None
    inputs = before.inputs
    if unproven[who] and inputs is not None and inputs.wheel_slot[who] >= 0 and not turning(site)[who]:
        # it may not head as was stated; the way driven will tell
        mean, covariance, free = opened.mean.copy(), opened.covariance.copy(), opened.free.copy()
        lift_heading(mean, covariance, free, who)
        opened = replace(opened, mean=mean, covariance=covariance, free=free)
    opened, again, _, innovation = update(opened, epoch, links, asked, pushed=who)
    if np.count_nonzero(again) <= np.count_nonzero(used):
        return None
    apart = np.hypot(*(opened.pose()[who, :2] - before.pose()[who, :2]))
    text = f"{np.count_nonzero(refused)} ranges disagreed: {apart:.2f} m from where its own sensors had it"
    return Slip(who, opened, again, innovation, Event(before.time_s, site.vehicles[who].id, "slip", text))
