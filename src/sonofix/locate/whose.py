"""Whose burst was it? Found by geometry, where one burst may be one of several beacons' or of several periods.

A few of the strongest are tried as all they may be; what the rest says of each position decides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from sonofix.geometry import PITCH, ROLL, SIZE, YAW, link, model, row_times
from sonofix.locate.fix import fix
from sonofix.records import Fix, Floats, RangeEpoch
from sonofix.site import Site

AGREES_M = 0.3
"""Furthest a range may be from a position's to count for it: what a fix of few poor ranges can be off by."""

MOST_TRIED = 400
"""Combinations of the strongest bursts' owners."""

Alternatives = Callable[[str, str], list[tuple[str, float]]]


def tell_whose(epoch: RangeEpoch, site: Site, alternatives: Alternatives) -> tuple[RangeEpoch, str]:
    """Give each range to the beacon, and the period, that all of them together make sense with.

    Parameters
    ----------
    epoch : RangeEpoch
        With known clock; rows of fixed beacons (or fixed microphones) and vehicles are decided upon, others pass.
    alternatives : callable
        From a row's emitter and receiver to (beacon id, seconds of flight more than the row states) of all it may be.

    Returns
    -------
    epoch : RangeEpoch
        Rows that make sense with nothing left out; empty where two positions make as much sense.
    told : str
        What was decided, or why nothing was; empty where there was nothing to decide.
    """
    may_be = [_possible(epoch, row, alternatives) for row in range(len(epoch))]
    if all(len(options) <= 1 for options in may_be):
        return _as(epoch, [(row, *options[0]) for row, options in enumerate(may_be) if options]), ""
    riders = [_rider(epoch, site, row) for row in range(len(epoch))]
    chosen = [(i, epoch.emitter[i], float(epoch.range_m[i])) for i, rider in enumerate(riders) if rider is None]
    for vehicle in site.vehicles:
        own = [i for i, rider in enumerate(riders) if rider == vehicle.id]
        chosen += _of_vehicle(epoch, site, vehicle.id, own, may_be)
    chosen.sort()
    if not chosen:
        return _as(epoch, []), "beacons share codes or periods, and whose bursts these are cannot be told yet"
    return _as(epoch, chosen), f"whose bursts they are was told by geometry: {len(chosen)} of {len(epoch)} make sense"


def _rider(epoch: RangeEpoch, site: Site, row: int) -> str | None:
    """Vehicle that one end of a row rides on while the other stands still; None where both ride, or neither."""
    sent, heard = site.beacon(epoch.emitter[row]).vehicle, site.microphone(epoch.receiver[row]).vehicle
    return sent or heard if (sent is None) != (heard is None) else None


def _possible(epoch: RangeEpoch, row: int, alternatives: Alternatives) -> list[tuple[str, float]]:
    """Beacons and ranges that a row may be: none shorter than nothing."""
    c, stated_m = epoch.sound_speed_mps, float(epoch.range_m[row])
    options = [
        (emitter, stated_m + c * more_s) for emitter, more_s in alternatives(epoch.emitter[row], epoch.receiver[row])
    ]
    return [(emitter, range_m) for emitter, range_m in options if range_m > -AGREES_M]


def _of_vehicle(
    epoch: RangeEpoch, site: Site, vehicle: str, own: list[int], may_be: Sequence[list[tuple[str, float]]]
) -> list[tuple[int, str, float]]:
    """Rows of one vehicle as what they are: (row, beacon, range); none where that stays open."""
    strength = np.zeros(len(epoch)) if epoch.snr_db is None else epoch.snr_db
    own = sorted(own, key=lambda i: -strength[i])
    asked: list[int] = []
    tries = 1
    for i in own:
        if not may_be[i] or tries * len(may_be[i]) > MOST_TRIED or len(asked) == 5:
            break
        asked.append(i)
        tries *= len(may_be[i])
    # a row more than unknowns, or any position would make sense of them
    enough = 4 if site.vehicle(vehicle).z_m is None else 3
    found: list[tuple[int, float, Fix, list[tuple[int, str, float]]]] = []
    for combination in product(*(may_be[i] for i in asked)):
        rows = [(i, *option) for i, option in zip(asked, combination, strict=True)]
        if len({(emitter, epoch.receiver[i]) for i, emitter, _ in rows}) < len(rows):
            continue
        tried = fix(_as(epoch, rows), site, vehicle)
        if tried.status != "ok":
            continue
        sense = _sense(epoch, site, tried, own, may_be)
        if len(sense) < max(enough, len(asked) - 1):
            continue
        whole = fix(_as(epoch, sorted(sense)), site, vehicle)
        if whole.status == "ok":
            # of beacons that share a code the nearest is heard first and loudest
            nearest = sum(_is_nearest(site, whole, emitter, {e for e, _ in may_be[i]}) for i, emitter, _ in sense)
            left_m = float(np.sqrt(np.nanmean(whole.residual_m**2)))
            found.append((int(np.sum(whole.used)) + nearest, left_m, whole, sense))
    if not found:
        return []
    found.sort(key=lambda one: (-one[0], one[1]))
    score, _, best, sense = found[0]
    for other_score, _, other, _ in found[1:]:
        if other_score >= score - 1 and np.linalg.norm(_place(other) - _place(best)) > AGREES_M:
            return []
    return sense


def _arm_m(site: Site, epoch: RangeEpoch, row: int) -> float:
    beacon, microphone = site.beacon(epoch.emitter[row]), site.microphone(epoch.receiver[row])
    return float(np.hypot(*(beacon if beacon.vehicle else microphone).lever_arm_m[:2]))


def _place(at: Fix) -> Floats:
    assert at.position_m is not None
    return at.position_m


def _is_nearest(site: Site, at: Fix, emitter: str, rivals: set[str]) -> bool:
    if len(rivals) == 1:
        return True

    def away_m(e: str) -> float:
        return float(np.linalg.norm(np.array(site.beacon(e).position_m) - _place(at)))

    return all(away_m(emitter) <= away_m(rival) + AGREES_M for rival in rivals)


def _sense(
    epoch: RangeEpoch, site: Site, at: Fix, own: list[int], may_be: Sequence[list[tuple[str, float]]]
) -> list[tuple[int, str, float]]:
    """Each row as that of what it may be which a position explains best, if any."""
    pose = np.zeros((len(site.vehicles), SIZE))
    who = [v.id for v in site.vehicles].index(at.vehicle)
    pose[who, :3], pose[who, YAW] = _place(at), at.yaw_rad or 0.0
    pose[who, ROLL], pose[who, PITCH] = at.roll_rad or 0.0, at.pitch_rad or 0.0
    if at.velocity_mps is not None:
        pose[who, 4:7] = at.velocity_mps
    # where the heading is open, an end off the axis may be anywhere round it
    arm_m = {i: 2 * _arm_m(site, epoch, i) for i in own}
    out: list[tuple[int, str, float]] = []
    for i in own:
        if not may_be[i]:
            continue
        links = link(site, tuple(emitter for emitter, _ in may_be[i]), (epoch.receiver[i],) * len(may_be[i]))
        range_m = np.array([m for _, m in may_be[i]])
        dt = row_times(links, np.full(len(links), epoch.time_s[i]), range_m, epoch.sound_speed_mps) - at.time_s
        predicted_m = model(links, pose, dt, epoch.sound_speed_mps)[0]
        off = [abs(range_m - p) for (_, range_m), p in zip(may_be[i], predicted_m, strict=True)]
        k = int(np.argmin(off))
        if off[k] < AGREES_M + (arm_m[i] if at.yaw_rad is None else 0.0):
            out.append((i, *may_be[i][k]))
    return out


def _as(epoch: RangeEpoch, rows: list[tuple[int, str, float]]) -> RangeEpoch:
    """Return the epoch with these rows alone, each of that beacon and range."""
    at = np.array([i for i, _, _ in rows], int)
    range_m = np.array([m for _, _, m in rows])
    # what all share, the sound speed, scales with the range
    shared = (epoch.sound_speed_sd_mps / epoch.sound_speed_mps) ** 2
    own = np.diag(epoch.covariance_m2)[at] - shared * epoch.range_m[at] ** 2
    return replace(
        epoch,
        emitter=tuple(emitter for _, emitter, _ in rows),
        receiver=tuple(epoch.receiver[i] for i in at),
        time_s=epoch.time_s[at],
        range_m=range_m,
        covariance_m2=np.diag(own) + shared * np.outer(range_m, range_m),
        range_rate_mps=None if epoch.range_rate_mps is None else epoch.range_rate_mps[at],
        range_rate_sd_mps=None if epoch.range_rate_sd_mps is None else epoch.range_rate_sd_mps[at],
        snr_db=None if epoch.snr_db is None else epoch.snr_db[at],
        bias_sd_m=None if epoch.bias_sd_m is None else epoch.bias_sd_m[at],
    )
