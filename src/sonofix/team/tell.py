"""What a team's filter believes, as the records that files and pictures are made of."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sonofix.acquire import tones
from sonofix.ranging import RANGES_WITHOUT_SD_M, with_sound_speed
from sonofix.records import Estimate, Event, Floats, RangeEpoch, RangeRows, Source, Step
from sonofix.team.belief import Moment
from sonofix.team.feed import Feed
from sonofix.team.instants import instants

CHANGED_DB = 3.0
"""By so much a tone's level must change to be told of again."""

ALIKE_HZ = 50.0
"""Tones of one microphone, from epoch to epoch, that are no further apart are one."""


@dataclass(frozen=True, slots=True, eq=False)
class Listened:
    """What a receiver made of samples besides ranges.

    Attributes
    ----------
    shown : mapping from (time_s, emitter, receiver) to (3,)
        Of a range: range rate and its deviation (m/s), and the signal to noise ratio (dB); NaN where not told.
    events : tuple of Event
        Of samples (clipped, missing; a tone that begins, ends or changes by `CHANGED_DB`) and what could be made of
        them, in order of time.
    """

    shown: Mapping[tuple[float, str, str], Floats]
    events: tuple[Event, ...]


def listened(steps: Iterable[Step]) -> Listened:
    """Return what a receiver's steps tell besides ranges; what they tell of vehicles is of another track."""
    shown: dict[tuple[float, str, str], Floats] = {}
    events: list[Event] = []
    sounding: list[_Tone] = []
    for step in steps:
        epoch = step.ranges
        untold = np.full(len(epoch), np.nan)
        columns = (epoch.range_rate_mps, epoch.range_rate_sd_mps, epoch.snr_db)
        told = np.column_stack([untold if column is None else column for column in columns])
        ends = zip(epoch.time_s.tolist(), epoch.emitter, epoch.receiver, strict=True)
        shown.update(zip(ends, told, strict=True))
        new, sounding = _news([event for event in step.events if not event.vehicle], sounding, epoch.sync_s)
        events += new
    return Listened(shown, tuple(sorted(events, key=lambda event: event.time_s)))


_Tone = tuple[str, float, float]
"""Who hears it, its frequency in Hz, and its level in dB as last told."""


def _news(events: Sequence[Event], before: Sequence[_Tone], time_s: float) -> tuple[list[Event], list[_Tone]]:
    """Return an epoch's events without tones that go on as told ``before``, with those that ended, and its tones."""
    news: list[Event] = []
    now: list[_Tone] = []
    left = list(before)
    for event in events:
        found = tones.TOLD.search(event.detail)
        if found is None:
            news.append(event)
            continue
        who, hz = event.detail[: found.start()], 1e3 * float(found["khz"])
        level_db = float(found["db"]) * (1.0 if found["way"] == "over" else -1.0)
        same = min((t for t in left if t[0] == who), key=lambda t: abs(t[1] - hz), default=None)
        if same is None or abs(same[1] - hz) > ALIKE_HZ:
            told_db = np.inf
        else:
            left.remove(same)
            told_db = same[2]
        if abs(level_db - told_db) >= CHANGED_DB:
            news.append(event)
            told_db = level_db
        now.append((who, hz, told_db))
    ended = [Event(time_s, "", "samples", f"{who}the tone at {hz / 1e3:.3f} kHz has ended") for who, hz, _ in left]
    return news + ended, now


def ranges_of(epochs: Iterable[RangeEpoch]) -> RangeRows:
    """Return the ranges that a receiver made of samples, or that exchanges are, each with its deviation.

    What all share, as the sound speed is off, is left out of these: it is `RangeRows.speed_sd_mps`.
    """
    found: list[tuple[float, str, str, float, float]] = []
    speed_sd_mps = 0.0
    for epoch in epochs:
        speed_sd_mps = max(speed_sd_mps, epoch.sound_speed_sd_mps)
        sd_m = np.sqrt(np.diag(with_sound_speed(epoch, epoch.sound_speed_mps, 0.0).covariance_m2))
        ends = zip(epoch.time_s.tolist(), epoch.emitter, epoch.receiver, strict=True)
        found += [(*end, r, sd) for end, r, sd in zip(ends, epoch.range_m.tolist(), sd_m.tolist(), strict=True)]
    time_s, emitter, receiver, range_m, sd_m = zip(*found, strict=True) if found else ((), (), (), (), ())
    told = np.array(time_s), tuple(emitter), tuple(receiver), np.array(range_m), np.array(sd_m)
    return RangeRows(*told, speed_sd_mps=speed_sd_mps)


def steps_of(
    feed: Feed, moments: Iterable[Moment], smoothed: bool = False, receiver: Listened | None = None
) -> Iterator[Step]:
    """Return a `Step` for each moment: the ranges heard then, whether each was used, and an estimate a placed robot.

    ``receiver``: what it told besides; its events are those of the first moment that is no earlier, or of the last.
    """
    events = deque(receiver.events if receiver is not None else ())
    end_s = instants(feed)[-1][0]
    for index, moment in enumerate(moments):
        first, last = moment.rows
        heard = [i for i in range(first, last) if np.isfinite(feed.range_m[i])]
        sd = feed.range_sd_m[heard]
        rate, rate_sd, snr_db = _shown(feed, heard, receiver)
        shared_m = feed.scale_sd * feed.range_m[heard]
        before: list[Event] = []
        while events and (events[0].time_s <= moment.time_s or moment.time_s >= end_s):
            before.append(events.popleft())
        epoch = RangeEpoch(
            index=index,
            sync_s=moment.time_s,
            emitter=tuple(feed.ends[i][0] for i in heard),
            receiver=tuple(feed.ends[i][1] for i in heard),
            time_s=feed.time_s[heard],
            range_m=feed.range_m[heard],
            covariance_m2=np.diag(np.where(np.isnan(sd), RANGES_WITHOUT_SD_M, sd) ** 2) + np.outer(shared_m, shared_m),
            range_rate_mps=rate,
            range_rate_sd_mps=rate_sd,
            snr_db=snr_db,
            clock="known",
            sound_speed_mps=feed.sound_speed_mps,
            sound_speed_sd_mps=feed.scale_sd * feed.sound_speed_mps,
            sd_stated=not np.isnan(sd).any(),
        )
        entered = {
            int(robot)
            for i, taken in zip(range(first, last), np.any(moment.used, axis=1).tolist(), strict=True)
            if taken
            for robot in (feed.listener[i], feed.source[i])
        }
        estimates = []
        for robot in np.flatnonzero(moment.placed).tolist():
            source: Source = "smoothed" if smoothed else "fused" if robot in entered else "predicted"
            estimates.append(_estimate(feed, moment, robot, source))
        used = moment.used[[i - first for i in heard], 0]
        told = (moment.innovation,) if moment.innovation is not None else ()
        all_events = (*before, *moment.events)
        yield Step(epoch, (), tuple(estimates), all_events, used, np.zeros(len(heard)), innovations=told)


def _shown(
    feed: Feed, rows: Sequence[int], receiver: Listened | None
) -> tuple[Floats, Floats, Floats] | tuple[None, None, None]:
    """Return rates, their deviations and signal to noise ratios of ranges; None where samples were not listened to."""
    if receiver is None:
        return None, None, None
    untold = np.full(3, np.nan)
    told = [receiver.shown.get((float(feed.time_s[i]), *feed.ends[i]), untold) for i in rows]
    rate, rate_sd, snr_db = np.array(told).reshape(-1, 3).T
    return rate, rate_sd, snr_db


def _estimate(feed: Feed, moment: Moment, robot: int, source: Source) -> Estimate:
    x, y, yaw = moment.pose[robot].tolist()
    speed = float(moment.speed_mps[robot])
    return Estimate(
        time_s=moment.time_s,
        vehicle=feed.robots[robot],
        states=("x", "y", "yaw"),
        position_m=np.array([x, y, feed.level_m[robot]]),
        velocity_mps=np.array([speed * np.cos(yaw), speed * np.sin(yaw), 0.0]),
        yaw_rad=float(np.angle(np.exp(1j * yaw))),
        clock_offset_m=None,
        covariance=moment.covariance[robot],
        source=source,
    )
