"""A site with beacons added and moved: what to write into the site file once places are chosen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from sonofix.plan.codes import FAMILIES, family_candidates
from sonofix.records import Floats
from sonofix.signals.waveform import chips_of
from sonofix.site import Beacon, Code, Microphone, Site

STEP_M = 0.01
"""Places are written to the centimetre: nobody drills closer."""


def rounded(position_m: Floats) -> Floats:
    """Round places to `STEP_M`."""
    return np.round(np.round(np.asarray(position_m, float) / STEP_M) * STEP_M, 6)


def free_ids(site: Site, count: int) -> list[str]:
    """Return ids for new beacons (or microphones, where only these are fixed): B1, B2, … as far as they are free."""
    letter, taken = ("B", site.beacons) if _beacons_stand(site) else ("M", site.microphones)
    known = {node.id for node in taken}
    free = (f"{letter}{k}" for k in range(1, len(known) + count + 1))
    return [name for name in free if name not in known][:count]


def extended(site: Site, moved: Mapping[str, Floats], added: Mapping[str, Floats]) -> Site:
    """Return the site with beacons (or fixed microphones) moved and added.

    A moved one is no guess any more: its ``position_sd_m`` is 0. A new beacon sends as the first fixed one does, with
    the next code of that family which nobody has; or with none, where there is no family or none left. A new microphone
    takes the next channel.

    Parameters
    ----------
    site : Site
    moved, added : mapping from id to float64 (3,)
    """

    def to(place: Floats) -> tuple[float, float, float]:
        x, y, z = (float(v) for v in place)
        return x, y, z

    if not _beacons_stand(site):
        heard = [m.model_copy(update={"position_m": to(moved[m.id])}) if m.id in moved else m for m in site.microphones]
        free = 1 + max((m.channel for m in site.microphones if m.channel is not None), default=-1)
        new = [Microphone(id=name, channel=free + k, position_m=to(p)) for k, (name, p) in enumerate(added.items())]
        return site.model_copy(update={"microphones": (*heard, *new)})
    sounding = [
        b.model_copy(update={"position_m": to(moved[b.id]), "position_sd_m": 0.0}) if b.id in moved else b
        for b in site.beacons
    ]
    like = next(b for b in (*site.coded_beacons, *site.beacons) if b.position_m is not None)
    codes = unused_codes(site, like)
    fresh = {"position_sd_m": 0.0, "offset_s": 0.0, "delay_s": 0.0}
    for name, place in added.items():
        update = {"id": name, "position_m": to(place), "code": next(codes, None), **fresh}
        sounding.append(like.model_copy(update=update))
    return site.model_copy(update={"beacons": tuple(sounding)})


def _beacons_stand(site: Site) -> bool:
    return any(b.position_m is not None for b in site.beacons)


def unused_codes(site: Site, like: Beacon) -> Iterator[Code]:
    """Yield codes as long as a beacon's that no beacon of the site has: of its own family first."""
    family, degree = getattr(like.code, "family", None), getattr(like.code, "degree", None)
    if family not in FAMILIES or degree is None or chips_of(like) is None:
        return
    taken = {chips.tobytes() for b in site.coded_beacons if (chips := chips_of(b)) is not None}
    for names in ([family], [name for name in FAMILIES if name != family]):
        try:
            candidates = family_candidates(degree, names)
        except ValueError:  # the family has no codes of this degree, or too many to list
            continue
        for candidate in candidates:
            if candidate.chips.tobytes() not in taken:
                taken.add(candidate.chips.tobytes())
                yield candidate.code
