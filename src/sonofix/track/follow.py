"""One track a vehicle, from start to end: place it, age it, correct it, and never lock it out."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import SIZE, Links, link, open_arms, row_times, rows_at, turning
from sonofix.records import Estimate, Event, Fix, Floats, Innovation, RangeEpoch
from sonofix.site import Site
from sonofix.track import stated
from sonofix.track.agility import Agility
from sonofix.track.alone import Alone, Silence, apart, unled
from sonofix.track.bank import Bank
from sonofix.track.belief import (
    Belief,
    Motion,
    blank,
    estimate,
    loosen,
    place,
    predict,
    set_out,
    start_at,
    unplaced,
)
from sonofix.track.clock import opened
from sonofix.track.course import Course
from sonofix.track.held import hold
from sonofix.track.inputs import Inputs
from sonofix.track.panel import MOST_PAIRS, ROUGH_M, Panel
from sonofix.track.positions import Positions
from sonofix.track.recent import Recent
from sonofix.track.rest import Rest
from sonofix.track.rival import ASKED_S, TRIED_S, Rival, begun, beside, follows, image
from sonofix.track.slip import slipped
from sonofix.track.update import linear, update
from sonofix.track.wheels import AS_EXPECTED

PATIENCE = 3
"""Epochs in which most rows are refused before the track is put where the ranges say."""

CONTRADICTED = 30.0
"""Squared distance of a fix from the track, over its expected value per axis, at which the fix is followed at once:
noise alone comes there once in three million epochs."""

FORGOTTEN_M = 1e4
"""Deviation at which nothing is left of a place: after an hour of silence, or where the clock was set."""


class Follower:
    """Follows all vehicles of a site through its epochs.

    Parameters
    ----------
    site : Site
    motion : Motion
    free_running : bool
        The clock offset is another in every epoch (a sounding vehicle on its own clock).
    inputs : Inputs or None
        What the vehicles' own sensors tell of their motion.
    held : iterable of str
        What shall not calibrate itself, of `held.CALIBRATIONS`.

    Attributes
    ----------
    belief : Belief
    innovation : Innovation or None
        Of the latest epoch's rows that entered the track; None where none did, or they placed a vehicle.
    """

    def __init__(
        self,
        site: Site,
        motion: Motion | None = None,
        free_running: bool = False,
        inputs: Inputs | None = None,
        held: Iterable[str] = (),
    ) -> None:
        self.site = site
        self.motion = motion or Motion()
        self.free_running = free_running
        self.belief = blank(site, inputs, held)
        self.innovation: Innovation | None = None
        self._arms = open_arms(site)
        self._refused = np.zeros(len(site.vehicles), int)
        self._heard = np.zeros(len(site.vehicles), bool)
        self._recent = Recent(site)
        self._lag_s = 0.0
        self._rival: Rival | None = None
        self._looked_s = -np.inf
        self._agility = Agility()
        self._begun_s = np.full(len(site.vehicles), -np.inf)
        self._given = np.zeros(len(site.vehicles), bool)
        self._stated = np.zeros(len(site.vehicles), bool)
        self._mirrored = np.zeros(len(site.vehicles), bool)
        self._gainsaid = np.zeros(len(site.vehicles), bool)
        self._fixable = np.zeros(len(site.vehicles), bool)
        self._undecided = np.zeros(len(site.vehicles), bool)
        self._course = Course()
        self._banks: dict[int, Bank] = {}
        if inputs is not None and inputs.range_slot >= 0:
            wheeled = np.flatnonzero(inputs.wheel_slot >= 0).tolist()
            self._banks = {who: Bank(self.belief, who) for who in wheeled}
        alone = len(site.vehicles) == 1 and site.clock_known and inputs is not None and not len(inputs.time_s)
        few = inputs is not None and inputs.range_slot >= 0 and len(inputs.pairs) <= MOST_PAIRS
        self._panel = Panel() if alone and few else None
        self._alone: Alone | None = None
        self._silence = Silence()
        self._rest = Rest(site)
        sensed = np.zeros(0, int) if inputs is None else inputs.vehicle
        self._positions = Positions(site, np.isin(np.arange(len(site.vehicles)), sensed))

    def copied(self) -> Follower:
        """Return a follower that is as this one is now, and goes its own way from here."""
        return deepcopy(self, {id(part): part for part in (self.site, self.belief.inputs)})

    def knowing(self, other: Follower, sizes: Floats | None = None) -> Follower:
        """Return this follower, at its beginning, with what another has learnt of the same recording by its end.

        That is how agile vehicles are, how far odometry may be trusted and how ranges err: sizes, not values. ``sizes``
        are those of one of `likely` instead.
        """
        trust, inputs = other.belief.trust, self.belief.inputs
        self._positions.knowing(other._positions)
        if trust is None or inputs is None:
            return self
        motion = other.motion
        if sizes is not None:
            trust, motion = replace(trust, sizes=sizes), replace(motion, acceleration_psd=float(sizes[3]))
        covariance = self.belief.covariance.copy()
        stated.open_pairs(covariance, inputs.range_slot, trust)
        hold(covariance, self.belief.held)
        self.belief = replace(self.belief, covariance=covariance, trust=trust, rough=other.belief.rough)
        self.motion, self._banks, self._panel = motion, {}, None
        return self

    def start(self, vehicle: str, time_s: float, position_m: Floats, yaw_rad: float) -> None:
        """Place a vehicle at a pose known beforehand."""
        who = [v.id for v in self.site.vehicles].index(vehicle)
        known = self.site.vehicles[who].z_m is not None
        self._given[who] = self._stated[who] = True
        inputs = self.belief.inputs
        turns = bool(turning(self.site)[who]) or (inputs is not None and bool(inputs.headed[who]))
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        x, y = self._arms[who]
        position_m = position_m + np.array([cos * x - sin * y, sin * x + cos * y, 0.0])
        self.belief = start_at(
            replace(self.belief, time_s=time_s), who, position_m, yaw_rad, known, turns, self.motion.tilt_pace_radps
        )
        self.belief = set_out(self.belief)

    @property
    def refuted(self) -> NDArray[np.bool_]:
        """Vehicles (V,) that are not, or do not head, as they were stated to start: it was gainsaid, not borne out.

        But for those that nothing else ever placed: they would have no place at all, and may have been pushed.
        """
        return self._gainsaid & self._fixable

    def unstarted(self, vehicles: NDArray[np.bool_]) -> Follower:
        """Return this follower, at its beginning, without the start of these vehicles (V,) that was refuted."""
        for who in np.flatnonzero(vehicles).tolist():
            self.belief = unplaced(self.belief, who)
            self._mirrored[who] = not self._given[who]
            self._given[who] = self._stated[who] = False
        return self

    def step(
        self, epoch: RangeEpoch, fixes: tuple[Fix, ...]
    ) -> tuple[tuple[Estimate, ...], NDArray[np.bool_], tuple[Event, ...]]:
        """Take in one epoch; or, where it has no ranges, fixes that others made.

        Returns
        -------
        estimates : one a vehicle that has a position
        used : bool (n,), rows that entered
        events
        """
        links = link(self.site, epoch.emitter, epoch.receiver)
        time_s = self._time(epoch, links)
        events: list[Event] = []
        self.innovation = None
        loosely = not len(epoch) and any(found.status == "ok" for found in fixes)
        if not self.belief.placed.any() and not len(self._recent):
            # a recording may begin before its clock's zero
            self.belief = replace(self.belief, time_s=min(self.belief.time_s, time_s))
        self.belief = predict(self.belief, max(time_s, self.belief.time_s), self.motion)
        self._forget(events)
        candidates = np.isfinite(epoch.range_m)
        for found in fixes:
            if found.status == "ok":
                candidates &= found.used | np.isnan(found.residual_m)
        if loosely:
            return self._stand(fixes, events), np.zeros(0, bool), tuple(events)
        self.belief = opened(self.belief, epoch, fixes, self.free_running)
        self._recent.take(epoch)
        taken = self._place(links, fixes, events)
        # ranges that placed a vehicle have had their say
        before = self.belief
        self.belief, used, _, self.innovation = update(before, epoch, links, candidates & ~taken)
        if before.inputs is not None and len(before.inputs.time_s) and before.heeded:
            asked, asked_of = candidates & ~taken, ~self._tried(fixes)
            slip = slipped(before, self.site, epoch, links, asked, used, asked_of, self._stated)
            if slip is not None:
                self.belief, used, self.innovation = slip.belief, slip.used, slip.innovation
                events.append(slip.event)
                if self._stated[slip.vehicle]:
                    self._alone = None  # what it gathered was against the heading that was stated
        used |= taken
        if taken.any() or any(event.event in ("slip", "reset") for event in events):
            # a rival knows nothing of that
            self._rival, self._undecided[:] = None, False
        self._try_start(fixes)
        self.motion = self._agility.take(before, self.belief, self.motion)
        used = self._contest(epoch, links, candidates, used, events)
        self._heed(epoch, links, candidates & ~taken, events)
        if self.belief.heeded:
            self.belief = set_out(self._course.head(self.belief))
        self._doubt_wheels(before, epoch, links, candidates, events)
        self._weigh(before, epoch, links, candidates & ~taken, events)
        self._judge(epoch, links, used, fixes, events)
        events += self._rest.take(self.belief)
        self._prove_start(fixes, events, np.full(len(self._stated), self._judges_sensors))
        return self._estimates(links, used), used, tuple(events)

    def _stand(self, fixes: tuple[Fix, ...], events: list[Event]) -> tuple[Estimate, ...]:
        """Take in positions that others computed; return estimates."""
        self.belief, entered, told = self._positions.take(self.belief, self.motion, fixes, self._stated.tolist())
        events += told
        self.innovation = self._positions.innovation
        self._undecided = self._given & self._positions.contested
        self._prove_start(fixes, events, self._positions.judges)
        self._stated &= ~self._positions.borne_out
        if self.belief.heeded:
            self.belief = set_out(self._course.head(self.belief))
        events += self._rest.take(self.belief)
        shown = np.flatnonzero(self.belief.placed & ~self._undecided).tolist()
        return tuple(estimate(self.belief, self.site, who, "fused" if entered[who] else "predicted") for who in shown)

    def time_of(self, epoch: RangeEpoch) -> float:
        """Return the instant an epoch's state will belong to."""
        return self._time(epoch, link(self.site, epoch.emitter, epoch.receiver))

    def _time(self, epoch: RangeEpoch, links: Links) -> float:
        """Instant the epoch's state belongs to; an empty epoch takes the delay that others showed."""
        if not len(epoch):
            return epoch.sync_s + self._lag_s
        moments = epoch.time_s
        if epoch.clock == "known":
            moments = row_times(links, epoch.time_s, epoch.range_m, epoch.sound_speed_mps)
        time_s = float(np.mean(moments))
        self._lag_s = time_s - epoch.sync_s
        return time_s

    def _forget(self, events: list[Event]) -> None:
        """Let vehicles begin anew of whose place nothing is known any more."""
        for who in np.flatnonzero(self.belief.placed).tolist():
            own = slice(SIZE * who, SIZE * who + 2)
            sd_m = float(np.sqrt(np.trace(self.belief.covariance[own, own])))
            if sd_m < FORGOTTEN_M:
                continue
            self.belief = unplaced(self.belief, who)
            self._rival, self._alone, self._undecided[who], self._heard[who] = None, None, False, False
            text = f"not heard for too long: its place is known to {sd_m:.0f} m"
            events.append(Event(self.belief.time_s, self.site.vehicles[who].id, "lost", text))

    def _try_start(self, fixes: tuple[Fix, ...]) -> None:
        """Where the first fix by ranges that others state is far from a stated start, let the two contest."""
        for who in np.flatnonzero(self._given & self.belief.placed).tolist():
            if not self._corrected or self.free_running or fixes[who].status != "ok":
                continue
            self._given[who] = False
            self._rival = self._rival or beside(self.belief, who, fixes[who], self._arms[who])
            self._undecided[who] = self._rival is not None and self._rival.vehicle == who

    def _tried(self, fixes: tuple[Fix, ...]) -> NDArray[np.bool_]:
        """Whose start contests with another, or is about to (V,): misfit is for that to judge."""
        fixed = {found.vehicle for found in fixes if found.status == "ok"}
        contests = self._given & np.array([vehicle.id in fixed for vehicle in self.site.vehicles], bool)
        return (contests & self._corrected) | self._undecided

    def _prove_start(self, fixes: tuple[Fix, ...], events: list[Event], judged: NDArray[np.bool_]) -> None:
        """Note whose stated start is gainsaid before it is borne out; ``judged`` (V,): so are its own sensors."""
        fixed = {found.vehicle for found in fixes if found.status == "ok"}
        anew = {event.vehicle for event in events if event.event == "reset"}
        self._fixable |= np.array([vehicle.id in fixed | anew for vehicle in self.site.vehicles], bool)
        for who in np.flatnonzero(self._stated).tolist():
            name = self.site.vehicles[who].id
            told = {event.event for event in events if event.vehicle == name}
            if told & {"reset", "slip"}:
                self._gainsaid[who], self._stated[who], self._given[who] = True, False, False
            elif name in fixed and not self._undecided[who]:
                # a heading is borne out by sensors that it makes right (`_heed`)
                self._given[who], self._stated[who] = False, bool(judged[who])

    def _doubt_wheels(
        self, before: Belief, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_], events: list[Event]
    ) -> None:
        """Learn how far odometry may be trusted, where ranges are stated by others."""
        anew = {event.vehicle for event in events if event.event in ("slip", "reset", "start")}
        if not self._banks:
            return
        rough = np.tile(AS_EXPECTED, (len(self.site.vehicles), 1))
        for who, bank in self._banks.items():
            if self.site.vehicles[who].id in anew:
                bank.forget()
            bank.take(before, self.belief, epoch, links, asked)
            rough[who] = bank.factors
        self.belief = replace(self.belief, rough=rough)

    def _heed(self, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_], events: list[Event]) -> None:
        """Hear a vehicle's own sensors only as long as ranges that others state are not far likelier without them."""
        inputs, trust, now_s = self.belief.inputs, self.belief.trust, self.belief.time_s
        if trust is None or not self._judges_sensors or not self.belief.placed[0] or not len(epoch):
            return
        if not self.belief.heeded:
            if self._silence.over(now_s):
                self._alone = unled(self.belief, bool(turning(self.site)[0]))
                self.belief = replace(self.belief, heeded=True)
            return
        if self._alone is not None:
            self._alone = self._alone.take(now_s, self.motion, epoch, links, asked, trust.told)
        if self._alone is not None and self._alone.lost:
            self._alone, self._stated[0] = unled(self.belief, bool(turning(self.site)[0])), False
        elif self._alone is None:
            self._alone = apart(self.belief, self._recent.fix(self.site.vehicles[0].id, self.belief), self._arms[0])
        elif self._alone.won:
            self.belief = follows(self.belief, self._alone.belief)
            self._alone, self._rival, self._refused[0], self._undecided[0] = None, None, 0, False
            x, y, z = estimate(self.belief, self.site, 0, "fused").position_m
            if self._stated[0] and inputs is not None and inputs.wheel_slot[0] >= 0:
                # wheels are right only as the heading is that they began with: it is found anew
                self.belief = replace(self.belief, heeded=True)
                self._alone = unled(self.belief, bool(turning(self.site)[0]))
                text = "ranges gainsay how it was stated to start"
            else:
                text = f"ranges gainsay its own sensors, unheard for {self._silence.begin(now_s):g} s"
            text += f": placed at ({x:.3f}, {y:.3f}, {z:.3f}) m"
            events.append(Event(now_s, self.site.vehicles[0].id, "reset", text))

    def _weigh(
        self, before: Belief, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_], events: list[Event]
    ) -> None:
        """Learn how ranges err and how freely a vehicle moves, where others' ranges alone tell of it."""
        panel, trust = self._panel, self.belief.trust
        if panel is None or trust is None or not asked.any():
            return
        if panel.silent(before.time_s):
            panel.forget()
        if not self.belief.placed.all() or any(event.event in ("reset", "start") for event in events):
            panel.forget()
        if not self.belief.placed.all():
            return
        if not panel.begun:
            panel.begin(self.belief)
        else:
            panel.take(before, self.motion, linear(before, epoch, links, asked))
        if trust.sizes is None and trust.rough_m < ROUGH_M:
            return  # each pair's errors are as expected, and best learnt by themselves
        self.belief = replace(self.belief, trust=replace(trust, sizes=panel.sizes))
        self.motion = replace(self.motion, acceleration_psd=float(panel.sizes[3]))
        if len(self.belief.mean) == panel.states + 2:
            self.belief = panel.mixed(self.belief)

    def _contest(
        self,
        epoch: RangeEpoch,
        links: Links,
        asked: NDArray[np.bool_],
        used: NDArray[np.bool_],
        events: list[Event],
    ) -> NDArray[np.bool_]:
        """Where ranges are stated by others, follow a second place beside the track as long as either may be true.

        Returns the rows used.
        """
        trust, rival = self.belief.trust, self._rival
        if trust is None or self.free_running or not len(epoch) or not self.belief.placed.any():
            return used
        if rival is not None:
            rival, heard = rival.take(self.belief.time_s, self.motion, epoch, links, asked, trust.told)
            # a stated start that was not the likelier is not borne out, however alike both are by now
            tried = bool(self._undecided[rival.vehicle] and self._stated[rival.vehicle])
            likelier = rival.won or (tried and rival.lost and rival.ahead > 0.0)
            self._rival = None if rival.lost or likelier else rival
            self._undecided[rival.vehicle] &= self._rival is not None
            if rival.lost and rival.course is not None:
                self._stated[rival.vehicle] = False
            if likelier:
                self.belief, self.innovation = follows(self.belief, rival.belief), None
                self._refused[rival.vehicle] = 0
                x, y, z = estimate(self.belief, self.site, rival.vehicle, "fused").position_m
                text = f"another place is likelier by far: ({x:.3f}, {y:.3f}, {z:.3f}) m"
                events.append(Event(self.belief.time_s, self.site.vehicles[rival.vehicle].id, "reset", text))
                return heard
        elif self.belief.time_s - self._looked_s >= ASKED_S:
            self._looked_s = self.belief.time_s
            for who in np.flatnonzero(self.belief.placed).tolist():
                if self._rival is None and np.any(links.touch(who)):
                    found = self._recent.fix(self.site.vehicles[who].id, self.belief)
                    young = self.belief.time_s - self._begun_s[who] < TRIED_S
                    mirrored = image(self.belief.mean[SIZE * who :][:3], self.belief.free, who, links, found)
                    for other in (found, mirrored)[: 1 + young]:
                        self._rival = self._rival or beside(self.belief, who, other, self._arms[who])
                    if young and self._rival is not None and self._rival.vehicle == who:
                        self._undecided[who] = True
        return used

    @property
    def likely(self) -> list[tuple[float, Floats]]:
        """Weight and sizes of the members that may be right; empty where they were not needed."""
        needed = self._panel is not None and self.belief.trust is not None and self.belief.trust.sizes is not None
        return self._panel.likely() if self._panel is not None and needed else []

    @property
    def weighs(self) -> bool:
        """Whether members of other sizes run beside the track."""
        return self._panel is not None

    @property
    def hidden(self) -> frozenset[int]:
        """Vehicles of which nothing is told yet: a second start may be true."""
        return frozenset(np.flatnonzero(self._undecided).tolist())

    @property
    def _judges_sensors(self) -> bool:
        """Whether a track by ranges alone tells whether the sensors of the only vehicle are right."""
        inputs = self.belief.inputs
        sensed = inputs is not None and len(inputs.time_s) > 0 and len(self.belief.placed) == 1
        return sensed and self._corrected and not self.free_running

    @property
    def _corrected(self) -> bool:
        """Whether the track knows better than a fix how far stated ranges are off."""
        inputs = self.belief.inputs
        return inputs is not None and inputs.range_slot >= 0

    @property
    def _biased(self) -> bool:
        """Whether the track follows biases of our own ranges, which a fix takes for noise."""
        inputs = self.belief.inputs
        return inputs is not None and inputs.bias_slot >= 0

    def _place(self, links: Links, fixes: tuple[Fix, ...], events: list[Event]) -> NDArray[np.bool_]:
        """Give positions to vehicles that have none, or whose track refuses what is heard; return the rows that did."""
        taken = np.zeros(len(links), bool)
        for who, found in enumerate(fixes):
            lost = self._refused[who] >= PATIENCE or self._contradicted(who, found)
            if self.belief.placed[who] and not lost:
                continue
            start = found
            again = lost and self._corrected
            poor = found.status in ("too-few", "ambiguous") and not self.free_running
            if (poor or again) and np.any(links.touch(who)):
                start = self._recent.fix(found.vehicle, self.belief)
            two = None if lost else self._twofold(who, start, links)
            if two is not None:
                start = two[int(self._mirrored[who])]
            if start.status not in ("ok", "inconsistent") or start.position_m is None:
                continue
            aged = replace(self.belief, time_s=self.belief.time_s if self.belief.placed.any() else start.time_s)
            self.belief = predict(
                place(aged, who, start, self._arms[who], self.motion.tilt_pace_radps), self.belief.time_s, self.motion
            )
            self._refused[who], self._heard[who] = 0, True
            if self._corrected or self._biased:
                self.belief = loosen(self.belief, who)
                self._begun_s[who] = self.belief.time_s
                if self._corrected and start is found:
                    taken |= start.used  # with errors open, the very same ranges would only blur their fix
            else:
                taken |= start.used if start is found else links.touch(who)
            if two is not None:
                other = two[1 - int(self._mirrored[who])]
                self._rival = begun(self.belief, who, other, self._arms[who], Course())
                self._undecided[who], self._stated[who] = True, not self._mirrored[who]
            x, y, z = start.position_m
            word, why = ("reset", "ranges disagreed with the track") if lost else ("start", "first position")
            events.append(Event(start.time_s, found.vehicle, word, f"{why}: placed at ({x:.3f}, {y:.3f}, {z:.3f}) m"))
        return taken

    def _twofold(self, who: int, found: Fix, links: Links) -> tuple[Fix, Fix] | None:
        """Return the two places where a vehicle with odometry may be by all ranges of some seconds, if that tells them.

        Beacons on a line leave its mirror image open. A vehicle's turns are the other way round there.
        """
        inputs, place_m = self.belief.inputs, found.mirror_m
        if inputs is None or not self._corrected or self._rival is not None or found.status != "ambiguous":
            return None
        if place_m is None or self.site.vehicles[who].z_m is None or inputs.wheel_slot[who] < 0:
            return None
        if turning(self.site)[who] or (self._recent.early and self._recent.pairs < len(inputs.pairs)):
            return None  # others may yet be heard
        one = replace(found, status="ok", position_m=place_m, covariance=np.eye(2), states=("x", "y"))
        other = image(place_m, self.belief.free, who, links, one)
        return None if other.position_m is None else (one, other)

    def _contradicted(self, who: int, found: Fix) -> bool:
        """Whether a fix with ranges to check by says that a vehicle is not at all where its track has it."""
        position = found.position_m
        if self._corrected:
            return False
        if not self.belief.placed[who] or found.status != "ok" or position is None or found.covariance is None:
            return False
        if np.count_nonzero(found.used) <= len([s for s in found.states if s in ("x", "y", "z", "yaw", "clock")]):
            return False
        here = estimate(predict(self.belief, found.time_s, self.motion), self.site, who, "predicted")
        apart = position[:2] - here.position_m[:2]
        (xx, xy), (_, yy) = here.covariance[:2, :2] + found.covariance[:2, :2]
        squared = yy * apart[0] ** 2 - 2 * xy * apart[0] * apart[1] + xx * apart[1] ** 2
        return bool(squared > CONTRADICTED * (xx * yy - xy**2))

    def _judge(
        self,
        epoch: RangeEpoch,
        links: Links,
        used: NDArray[np.bool_],
        fixes: tuple[Fix, ...],
        events: list[Event],
    ) -> None:
        """Count refusals; tell when a vehicle falls silent, is heard again, or a range was left out."""
        for who, vehicle in enumerate(self.site.vehicles):
            touching = links.touch(who)
            asked, believed = np.count_nonzero(touching), np.count_nonzero(used & touching)
            heard = believed > 0
            if self.belief.placed[who]:
                if believed < 0.5 * asked:
                    self._refused[who] += 1
                else:
                    self._refused[who] = 0
                if self._heard[who] and not heard:
                    events.append(Event(self.belief.time_s, vehicle.id, "lost", "no range believed in this epoch"))
                elif heard and not self._heard[who]:
                    events.append(Event(self.belief.time_s, vehicle.id, "found", f"{believed} ranges"))
                self._heard[who] = heard
        for found in fixes:
            if found.status == "ok":
                for i in np.flatnonzero(~found.used & np.isfinite(found.residual_m)):
                    text = f"{epoch.emitter[i]} to {epoch.receiver[i]}: {100 * found.residual_m[i]:+.1f} cm off"
                    events.append(Event(float(epoch.time_s[i]), found.vehicle, "excluded", text))

    def _estimates(self, links: Links, used: NDArray[np.bool_]) -> tuple[Estimate, ...]:
        out = []
        for who in np.flatnonzero(self.belief.placed & ~self._undecided):
            entered = bool((used & links.touch(int(who))).any())
            out.append(estimate(self.belief, self.site, int(who), "fused" if entered else "predicted"))
        return tuple(out)


def expectations(
    belief: Belief, site: Site, pairs: list[tuple[str, str]], sound_speed_mps: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Range, its deviation, range rate and its deviation that a belief expects of emitter–receiver pairs, each (n,)."""
    n, links = len(pairs), link(site, tuple(p[0] for p in pairs), tuple(p[1] for p in pairs))
    zeros, tilts = np.zeros(n), not belief.upright
    shown, derivative = rows_at(links, belief.mean, zeros, sound_speed_mps, clock=False, rates=True, tilts=tilts)
    sd = np.sqrt(np.maximum(np.einsum("ij,ij->i", derivative @ belief.covariance, derivative), 0.0))
    return shown[:n], np.hypot(sd[:n], links.emitter_sd_m), shown[n:], sd[n:]
