"""The heading of a vehicle that only its odometry tells: from the direction in which its track goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonofix.records import Floats
from sonofix.track.belief import SIZE, Belief
from sonofix.track.inputs import reckoned
from sonofix.track.wheels import open_heading

COURSE_SD_RAD = 0.2
"""How well a direction must be known before it gives a heading; which then begins with twice that."""

TRAIL = 50
"""Epochs of a track without heading that are remembered."""


class Course:
    """Compares the path by odometry with the track until one must be turned on the other in a way that is known."""

    def __init__(self) -> None:
        self._trails: dict[int, list[tuple[float, Floats, float]]] = {}

    def head(self, belief: Belief) -> Belief:
        """Begin to follow the heading of each vehicle that has odometry, a place and no heading, where it is known."""
        if belief.inputs is not None:
            for who in np.flatnonzero(belief.placed & (belief.inputs.wheel_slot >= 0)).tolist():
                if belief.free[SIZE * who + 3] or belief.deaf(who, belief.time_s):
                    self._trails.pop(who, None)
                else:
                    belief = self._look(belief, who)
        return belief

    def _look(self, belief: Belief, who: int) -> Belief:
        if belief.inputs is None:
            return belief
        own = slice(SIZE * who, SIZE * who + 2)
        sd_m = float(np.sqrt(np.trace(belief.covariance[own, own])))
        trail = self._trails.setdefault(who, [])
        trail.append((belief.time_s, belief.mean[own].copy(), sd_m))
        del trail[:-TRAIL]
        path = reckoned(belief.inputs, who, belief.time_s)
        for time_s, place_m, before_m in trail if len(path) else ():
            begun = path[max(int(np.searchsorted(path[:, 0], time_s, side="right")) - 1, 0)]
            driven, moved = path[-1, 1:3] - begun[1:3], belief.mean[own] - place_m
            way = float(np.hypot(*driven))
            if np.hypot(sd_m, before_m) > COURSE_SD_RAD * way or abs(np.hypot(*moved) - way) > way / 2:
                continue
            turned = np.arctan2(moved[1], moved[0]) - np.arctan2(driven[1], driven[0])
            mean, covariance, free = belief.mean.copy(), belief.covariance.copy(), belief.free.copy()
            open_heading(mean, covariance, free, who, float(path[-1, 3] + turned), 2 * COURSE_SD_RAD)
            return replace(belief, mean=mean, covariance=covariance, free=free)
        return belief
