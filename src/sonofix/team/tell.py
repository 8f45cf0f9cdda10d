"""What a team's filter believes, as the records that files and pictures are made of."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from sonofix.ranging import RANGES_WITHOUT_SD_M
from sonofix.records import Estimate, RangeEpoch, RangeRows, Source, Step
from sonofix.team.feed import Feed
from sonofix.team.fleet import Moment


def ranges_of(epochs: Iterable[RangeEpoch]) -> RangeRows:
    """Return the ranges that a receiver made of samples, or that exchanges are, each with its deviation."""
    found = [
        (float(e.time_s[i]), e.emitter[i], e.receiver[i], float(e.range_m[i]), float(np.sqrt(e.covariance_m2[i, i])))
        for e in epochs
        for i in range(len(e))
    ]
    time_s, emitter, receiver, range_m, sd_m = zip(*found, strict=True) if found else ((), (), (), (), ())
    return RangeRows(np.array(time_s), tuple(emitter), tuple(receiver), np.array(range_m), np.array(sd_m))


def steps_of(feed: Feed, moments: Iterable[Moment], smoothed: bool = False) -> Iterator[Step]:
    """Return a `Step` for each moment: the ranges heard then, whether each was used, and an estimate a placed robot."""
    for index, moment in enumerate(moments):
        first, last = moment.rows
        heard = [i for i in range(first, last) if np.isfinite(feed.range_m[i])]
        sd = feed.range_sd_m[heard]
        epoch = RangeEpoch(
            index=index,
            sync_s=moment.time_s,
            emitter=tuple(feed.ends[i][0] for i in heard),
            receiver=tuple(feed.ends[i][1] for i in heard),
            time_s=feed.time_s[heard],
            range_m=feed.range_m[heard],
            covariance_m2=np.diag(np.where(np.isnan(sd), RANGES_WITHOUT_SD_M, sd) ** 2),
            range_rate_mps=None,
            range_rate_sd_mps=None,
            snr_db=None,
            clock="known",
            sound_speed_mps=feed.sound_speed_mps,
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
        yield Step(epoch, (), tuple(estimates), moment.events, used, np.zeros(len(heard)))


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
