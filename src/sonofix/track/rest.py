"""Stop and go: when a vehicle comes to rest, and when it sets off again.

Told by the velocity that is believed and its covariance, and only where that is known well enough to tell rest from a
creep; a change must last, so that one epoch's noise tells nothing.
"""

from __future__ import annotations

import numpy as np

from sonofix.geometry import SIZE
from sonofix.records import Event
from sonofix.site import Site
from sonofix.track.belief import Belief

RESTS_MPS, DRIVES_MPS = 0.02, 0.05
"""A vehicle is at rest below the one speed and drives above the other; between them it does what it did."""

KNOWN_MPS = 0.02
"""Deviation of a velocity that tells rest from a creep."""

LASTS_S = 0.9
"""For so long it must be so; two epochs of half a second."""


class Rest:
    """Follows which vehicles of a site are at rest."""

    def __init__(self, site: Site) -> None:
        self._ids = [vehicle.id for vehicle in site.vehicles]
        self._rests: list[bool | None] = [None] * len(self._ids)
        self._since_s: list[tuple[bool, float] | None] = [None] * len(self._ids)

    def take(self, belief: Belief) -> list[Event]:
        """Look at an epoch's belief; return an event "stop" or "go" of each vehicle that has changed.

        What it does when it is first known is no change. An event's time is that since when it is so.
        """
        events = []
        for who, name in enumerate(self._ids):
            now = self._now(belief, who) if belief.placed[who] else None
            if now is None:
                self._since_s[who] = None
                continue
            since = self._since_s[who]
            if since is None or since[0] != now:
                since = self._since_s[who] = (now, belief.time_s)
            if self._rests[who] != now and belief.time_s - since[1] >= LASTS_S:
                if self._rests[who] is not None:
                    x, y = belief.mean[SIZE * who : SIZE * who + 2]
                    word, text = ("stop", "at rest at") if now else ("go", "drives again, from")
                    events.append(Event(since[1], name, word, f"{text} ({x:.2f}, {y:.2f}) m"))
                self._rests[who] = now
        return events

    def _now(self, belief: Belief, who: int) -> bool | None:
        """Whether a vehicle is at rest; None: that cannot be told."""
        own = np.array([SIZE * who + 4, SIZE * who + 5])
        speed = float(np.hypot(*belief.mean[own]))
        sd_mps = float(np.sqrt(np.max(np.linalg.eigvalsh(belief.covariance[np.ix_(own, own)]))))
        if speed > DRIVES_MPS + 3 * sd_mps:
            return False
        return True if sd_mps < KNOWN_MPS and speed < RESTS_MPS else None
