"""When positions of a vehicle stop, and come back.

They come when others send them, and each vehicle's at its own times: silence is what lasts far longer than they take
from one to the next.
"""

from __future__ import annotations

from collections.abc import Sequence

from sonofix.records import Event, Fix

SILENT = 5.0
"""So many times as long as positions usually take from one to the next."""

USUAL = 0.2
"""How fast that follows, per position."""


class Gaps:
    """Follows which vehicles positions tell of."""

    def __init__(self, ids: Sequence[str]) -> None:
        self._ids = list(ids)
        self._last_s: list[float | None] = [None] * len(self._ids)
        self._usual_s: list[float | None] = [None] * len(self._ids)
        self._lost = [False] * len(self._ids)

    def take(self, time_s: float, fixes: Sequence[Fix]) -> list[Event]:
        """Look at the fixes of an instant; return an event "lost" or "found" of each vehicle that has changed.

        A vehicle is lost from the last position on, which is known later.
        """
        events = []
        for who, (name, found) in enumerate(zip(self._ids, fixes, strict=True)):
            last_s, usual_s = self._last_s[who], self._usual_s[who]
            since_s = 0.0 if last_s is None else time_s - last_s
            if last_s is not None and usual_s is not None and since_s > SILENT * usual_s and not self._lost[who]:
                self._lost[who] = True
                events.append(Event(last_s, name, "lost", f"no position for {since_s:.3g} s and more"))
            if found.status != "ok":
                continue
            if self._lost[who]:
                self._lost[who] = False
                events.append(Event(time_s, name, "found", f"a position again, after {since_s:.3g} s"))
            elif last_s is not None:
                self._usual_s[who] = since_s if usual_s is None else usual_s + USUAL * (since_s - usual_s)
            self._last_s[who] = time_s
        return events
