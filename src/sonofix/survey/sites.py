"""Sites before and after a survey: how a drive is listened to, which beacons may move, and where they then stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sonofix.records import RangeEpoch, Survey
from sonofix.site import Pair, Site

NOWHERE_M = 1000.0
"""Deviation at which a beacon's place tells nothing, so that no fix comes of it and every search is cold."""

FARTHEST_M = 20.0
"""A guess is no farther off than this when one asks how far bursts may have come."""

GRAIN_M = 1e-4
"""To which places are written; deviations are rounded up to it."""


def unplaced(site: Site) -> Site:
    """Return the site as a drive is listened to: no place is believed, so that none misleads the search."""
    fixed = [b for b in site.beacons if b.vehicle is None]
    low, high = [], []
    for beacon in fixed:
        place, off = np.array(beacon.position_m, float), min(3.0 * beacon.position_sd_m, FARTHEST_M)
        low.append(place - off)
        high.append(place + off)
    if site.bounds_m is not None:
        low.append(np.array(site.bounds_m[0]))
        high.append(np.array(site.bounds_m[1]))
    bounds = site.bounds_m
    if low and np.all(np.max(high, axis=0) > np.min(low, axis=0)):
        bounds = tuple(np.min(low, axis=0).tolist()), tuple(np.max(high, axis=0).tolist())
    beacons = tuple(
        b if b.vehicle is not None else b.model_copy(update={"position_sd_m": NOWHERE_M}) for b in site.beacons
    )
    section = site.section.model_copy(update={"bounds_m": bounds})
    return site.model_copy(update={"beacons": beacons, "section": section})


def marked(site: Site, guess_sd_m: float | None, known: Sequence[str]) -> Site:
    """Return the site with its fixed beacons taken as guesses of one deviation, or as known.

    Raises
    ------
    ValueError
        If a beacon that is to be known is not in the site, or rides on a vehicle.
    """
    fixed = [b.id for b in site.beacons if b.vehicle is None]
    for name in known:
        if name not in fixed:
            raise ValueError(f"--known {name}: the site has no such fixed beacon; it has {', '.join(fixed) or 'none'}")
    beacons = []
    for beacon in site.beacons:
        sd = beacon.position_sd_m if guess_sd_m is None or beacon.vehicle is not None else guess_sd_m
        beacons.append(beacon.model_copy(update={"position_sd_m": 0.0 if beacon.id in known else sd}))
    return site.model_copy(update={"beacons": tuple(beacons)})


def corrected(site: Site, found: Survey, delays: bool) -> Site:
    """Return the site as it should be from now on.

    Parameters
    ----------
    site : Site
        As the survey took it.
    found : Survey
    delays : bool
        Whether biases of beacons become delays: where ranges were made with the site's delays. A beacon's bias is added
        to its ``delay_s``, since it sounds so much later.

    Notes
    -----
    A beacon's ``position_sd_m`` becomes its largest deviation along any direction, within the survey's frame. Biases of
    pairs are added to what the site states of theirs, which was taken off the ranges; pairs not surveyed stay.
    """
    by_id = {beacon.id: beacon for beacon in found.beacons}
    beacons = []
    for beacon in site.beacons:
        seen = by_id.get(beacon.id)
        changes: dict[str, object] = {}
        if seen is not None and seen.heard and np.any(seen.covariance_m2):
            worst = float(np.sqrt(np.linalg.eigvalsh(seen.covariance_m2)[-1]))
            changes["position_m"] = tuple(round(float(v), 4) + 0.0 for v in seen.position_m)
            changes["position_sd_m"] = round(float(np.ceil(worst / GRAIN_M)) * GRAIN_M, 4)
        if seen is not None and delays and seen.bias_m is not None:
            changes["delay_s"] = round(beacon.delay_s + seen.bias_m / found.sound_speed_prior_mps, 9)
        beacons.append(beacon.model_copy(update=changes))
    heard_late = {p.receiver: p.bias_m for p in found.pairs if not p.emitter and delays}
    microphones = tuple(
        m.model_copy(update={"delay_s": round(m.delay_s + heard_late[m.id] / found.sound_speed_prior_mps, 9)})
        if m.id in heard_late
        else m
        for m in site.microphones
    )
    update = {"beacons": tuple(beacons), "microphones": microphones, "pairs": _paired(site, found)}
    return site.model_copy(update=update)


def _paired(site: Site, found: Survey) -> tuple[Pair, ...]:
    pairs = {(p.emitter, p.receiver): p for p in site.pairs}
    for p in found.pairs:
        if not p.emitter:
            continue
        key = (p.emitter, p.receiver)
        bias_m = round((pairs[key].bias_m if key in pairs else 0.0) + p.bias_m, 4) + 0.0
        sd_m = round(float(np.ceil(p.sd_m / GRAIN_M)) * GRAIN_M, 4)
        pairs[key] = Pair.model_validate({"from": p.emitter, "to": p.receiver, "bias_m": bias_m, "bias_sd_m": sd_m})
    return tuple(pairs.values())


def without_biases(epoch: RangeEpoch, found: Survey) -> RangeEpoch:
    """Return ranges less the biases that a survey found, by pair or by beacon; their deviations stay."""
    pairs = {(p.emitter, p.receiver): p.bias_m for p in found.pairs}
    single = {b.id: b.bias_m or 0.0 for b in found.beacons}
    rows = zip(epoch.emitter, epoch.receiver, strict=True)
    bias = np.array([pairs.get((e, r), pairs.get(("", r), single.get(e, 0.0))) for e, r in rows], float)
    return replace(epoch, range_m=epoch.range_m - bias)
