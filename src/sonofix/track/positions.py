"""Vehicles that are followed by positions which others computed: what these gainsay, and what gainsays them.

Beside the track runs at most one other of each vehicle, where positions put it that the track did not believe, until
either is likelier by far. Whether a vehicle's own sensors are right is told by a track that hears none: of a site's
only vehicle one that keeps all else that is known (`alone`), of several the small filters of each (`scatter`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE, turning
from sonofix.records import Event, Fix, Innovation
from sonofix.site import Site
from sonofix.track import loose
from sonofix.track.alone import BORNE_OUT, OUTDONE, Alone, Silence, unled
from sonofix.track.belief import Belief, Motion, place, predict, unheard
from sonofix.track.gaps import Gaps
from sonofix.track.loose import Elsewhere, Taken
from sonofix.track.rival import bare, follows
from sonofix.track.spreads import Spreads, spreads


class Positions:
    """Follows all vehicles of a site by positions.

    Attributes
    ----------
    judges : bool (V,)
        Vehicles of which positions tell whether their own sensors are right.
    contested : bool (V,)
        Vehicles that positions put elsewhere, with neither place decided for.
    borne_out : bool (V,)
        Vehicles whose sensors, and so the heading that they began with, positions have borne out.
    innovation : Innovation or None
        Of the latest positions that entered together.
    """

    def __init__(self, site: Site, sensed: NDArray[np.bool_]) -> None:
        """Begin; ``sensed`` (V,) are vehicles with sensors of their own."""
        count = len(site.vehicles)
        self.judges = sensed
        self.contested = np.zeros(count, bool)
        self.borne_out = np.zeros(count, bool)
        self._ids = [vehicle.id for vehicle in site.vehicles]
        self._speed_sd_mps = [v.max_speed_mps or loose.SPEED_SD_MPS for v in site.vehicles]
        self._turns = bool(count and turning(site)[0])
        self._scatter = [spreads()] * count
        self._elsewhere: list[Elsewhere | None] = [None] * count
        self._behind, self._sum = np.zeros(count), np.zeros(count)
        self._alone: tuple[Alone, Spreads] | None = None
        self._silence = [Silence() for _ in range(count)]
        self._gaps = Gaps(self._ids)
        self.innovation: Innovation | None = None

    def knowing(self, other: Positions) -> None:
        """Begin with how positions erred by another's end."""
        self._scatter = [known.kept() for known in other._scatter]

    def take(
        self, belief: Belief, motion: Motion, fixes: Sequence[Fix], unproven: Sequence[bool]
    ) -> tuple[Belief, NDArray[np.bool_], list[Event]]:
        """Take in positions of one instant, to which a belief has been aged; return which entered (V,), and events.

        ``unproven`` (V,): vehicles with a stated start that nothing has borne out yet.
        """
        events = self._gaps.take(belief.time_s, fixes)
        entered = np.zeros(len(fixes), bool)
        rows, nis = 0, 0.0
        for who, found in enumerate(fixes):
            if found.status != "ok":
                continue
            if not belief.placed[who]:
                belief, self._scatter[who] = loose.put(belief, self._scatter[who], who, found, self._speed_sd_mps[who])
                self._settle(who)
                entered[who] = True
                self._tell(events, belief, who, "start", "first position")
                continue
            known = self._scatter[who]
            track = loose.take(belief, known, who, found)
            belief, self._scatter[who] = track.belief, track.scatter
            if track.believed:
                rows, nis = rows + track.rows, nis + track.off**2
            belief, entered[who] = self._contest(track, known, who, found, motion, events)
            if not entered[who]:
                text = f"a position {track.off_m:.2f} m, {track.off:.1f} deviations from the track: not believed"
                events.append(Event(belief.time_s, self._ids[who], "excluded", text))
            if len(fixes) > 1:
                belief = self._doubt(belief, track, who, found, bool(unproven[who]), events)
            elif self.judges[who]:
                belief = self._heed(belief, track, found, motion, bool(unproven[who]), events)
        self.innovation = Innovation(belief.time_s, rows, nis) if rows else None
        return belief, entered, events

    def _contest(
        self, track: Taken, known: Spreads, who: int, found: Fix, motion: Motion, events: list[Event]
    ) -> tuple[Belief, bool]:
        """Follow another place that positions tell, as long as either may be true; return whether this one entered."""
        # by how much positions in a row that the track did not believe were likelier without it
        if not track.led:
            self._behind[who] = 0.0 if track.believed else self._behind[who] + track.free - track.told
        other = self._elsewhere[who]
        if other is not None:
            other = other.taken(track, who, found, motion)
        if other is not None and other.won:
            self._settle(who)
            self._scatter[who] = other.scatter
            belief = place(track.belief, who, other.fix(who, found), np.zeros(2))
            self._tell(events, belief, who, "reset", "positions disagreed with the track")
            return belief, True
        if not track.led and self._behind[who] > loose.DECIDED:
            self._settle(who)
            belief = place(track.belief, who, loose.freely(track.scatter, found), np.zeros(2))
            self._tell(events, belief, who, "reset", f"positions err {track.scatter.scale:.1f} times as stated")
            return belief, True
        doubted = known.begins and track.off > loose.DOUBTED
        if (other is None or other.lost) and (doubted or not track.believed):
            other = Elsewhere.begun(track, known, who, found, self._speed_sd_mps[who])
        elif other is not None and other.lost:
            other = None
        self._elsewhere[who], self.contested[who] = other, other is not None
        return track.belief, track.believed

    def _heed(
        self, belief: Belief, track: Taken, found: Fix, motion: Motion, unproven: bool, events: list[Event]
    ) -> Belief:
        """Hear the only vehicle's own sensors only as long as positions are not far likelier without them."""
        now_s = belief.time_s
        if not belief.heeded:
            if self._silence[0].over(now_s):
                belief = replace(belief, heeded=True)
                self._alone = unled(belief, self._turns), self._scatter[0]
            return belief
        if not loose.led(belief, 0):
            self._alone = None
            return belief
        if self._alone is None:
            begun = bare(replace(belief, heeded=False))
            begun, known = loose.put(begun, self._scatter[0], 0, found, self._speed_sd_mps[0])
            self._alone = Alone(begun), known
            return belief
        alone, known = self._alone
        taken = loose.take(predict(alone.belief, now_s, motion), known, 0, found)
        alone = alone.told(taken.belief, taken.told - track.told)
        self._alone = alone, taken.scatter
        if alone.lost:
            self._alone = unled(belief, self._turns), self._scatter[0]
            self.borne_out[0] = True
        elif alone.won:
            belief, self._scatter[0] = follows(belief, alone.belief), taken.scatter
            self._elsewhere[0], self.contested[0] = None, False
            if unproven and belief.inputs is not None and belief.inputs.wheel_slot[0] >= 0:
                # wheels are right only as the heading is that they began with: it is found anew
                belief = replace(belief, heeded=True)
                self._alone = unled(belief, self._turns), taken.scatter
                why = "positions gainsay how it was stated to start"
            else:
                why = f"positions gainsay its own sensors, unheard for {self._silence[0].begin(now_s):g} s"
            self._tell(events, belief, 0, "reset", why)
        return belief

    def _doubt(self, belief: Belief, track: Taken, who: int, found: Fix, unproven: bool, events: list[Event]) -> Belief:
        """Put one of several vehicles where its positions have it, where these are far likelier without its sensors."""
        if not track.led or self.contested[who]:
            return belief
        news = track.free - track.told
        self._behind[who], self._sum[who] = max(self._behind[who] + news, 0.0), self._sum[who] + news
        if self._sum[who] < -BORNE_OUT:
            self.borne_out[who] = True
        if self._behind[who] <= OUTDONE:
            return belief
        self._settle(who)
        known = track.scatter.led(None)
        self._scatter[who] = known
        belief = place(belief, who, loose.freely(known, found), np.zeros(2))
        driven = belief.inputs is not None and bool(belief.inputs.wheel_slot[who] >= 0)
        why = "positions gainsay how it was stated to start" if unproven else "positions gainsay its own sensors"
        if driven and not unproven:
            silent_s = self._silence[who].begin(belief.time_s)
            belief = unheard(belief, who, silent_s)
            why += f", unheard for {silent_s:g} s"
        self._tell(events, belief, who, "reset", why)
        return belief

    def _settle(self, who: int) -> None:
        """Forget what gainsaid a vehicle's track, which begins anew."""
        self._elsewhere[who], self.contested[who], self._alone = None, False, None
        self._behind[who], self._sum[who] = 0.0, 0.0

    def _tell(self, events: list[Event], belief: Belief, who: int, word: str, why: str) -> None:
        """Tell where a vehicle was put."""
        x, y, z = belief.mean[SIZE * who : SIZE * who + 3]
        events.append(Event(belief.time_s, self._ids[who], word, f"{why}: placed at ({x:.3f}, {y:.3f}, {z:.3f}) m"))
