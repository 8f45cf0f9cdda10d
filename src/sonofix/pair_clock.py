"""Another robot's clock, followed over exchanges with it: what two ways of sound tell of range and clock.

A burst from A to B takes z1 = r1 + b as told by both clocks, one from B to A takes z2 = r2 − b, where b is c times what
B's clock is ahead of A's. The sum knows nothing of b but what its drift makes of the time between both bursts; the
difference tells b. So a clock is followed for each pair by a Kalman filter over successive exchanges. (With two
exchanges, and robots that stand, that is double-sided two-way ranging: Neirynck, Luk & McLaughlin 2016.) What leaves is
each exchange's own two ranges, A to B and B to A, each at the instant it was heard, and their covariance: the sum is as
good as what was heard, and the difference as good as the clock is known.

Robots that drive one behind the other make r1 and r2 differ as an offset does: r1 − r2 = (r / c) u · (v_A + v_B), u
from A to B, beside what the range changes in between. That is followed too, and limits what is known of the clock.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from sonofix.records import Floats

DRIFT_SD = 1e-4
"""Deviation of one clock's speed from another's before anything was heard: two cheap crystals."""

DRIFT_WANDER = 1e-8
"""How far the speed of one wanders from the other's, per √s (oven-less crystals, warming up)."""

ACCELERATION_PSD = 0.5
"""Of range, m²/s³: as briskly as a track takes vehicles to move."""

CRUISE, CRUISE_S = 0.5, 60.0
"""Deviation of the sum of both velocities along the line between, a share of the sum of highest speeds; and how long
one holds: a first-order Gauss-Markov process."""

UNSTATED_SD_M = 0.1
"""Deviation of a hearing that states none, until `ENOUGH` of them have told theirs."""

ENOUGH = 5
"""Exchanges with neighbours on both sides, by which a pair's unstated deviations may be judged."""

REMEMBERED = 40
"""The latest exchanges, by which they are."""

REFUSED = 36.0
"""Squared deviations beyond which an exchange says nothing of the clock; three such in a row begin it anew."""


class PairClock:
    """One robot's clock as another's sees it.

    The state is range, its rate, c times the offset, c times the drift, and the sum of both velocities along the line
    from A to B (m, m/s), at ``time_s`` on A's clock.
    """

    def __init__(self, sound_speed_mps: float, max_rate_mps: float) -> None:
        self._c, self._max_rate_mps = sound_speed_mps, max_rate_mps
        self.time_s = -np.inf
        self.mean = np.zeros(5)
        self.covariance = np.zeros((5, 5))
        self._halves: deque[tuple[float, float]] = deque(maxlen=REMEMBERED)
        self._refused = 0

    @property
    def known(self) -> bool:
        """Whether anything was heard."""
        return bool(np.isfinite(self.time_s))

    def ahead_s(self, time_s: float) -> float:
        """What B's clock shows beyond A's, at a time on A's."""
        return float(self.mean[2] + self.mean[3] * (time_s - self.time_s)) / self._c

    def behind_s(self, shown_s: float) -> float:
        """What A's clock shows less than B's, when B's shows a time."""
        drift = float(self.mean[3]) / self._c
        at_s = (shown_s - float(self.mean[2]) / self._c + drift * self.time_s) / (1.0 + drift)
        return shown_s - at_s

    def take(
        self, sent_s: float, heard_s: float, reply_sent_s: float, reply_heard_s: float, sd_m: Floats | None
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Take in what A sent and B heard, and what B sent and A heard, whichever came first.

        Parameters
        ----------
        sent_s, reply_heard_s : float
            On A's clock.
        heard_s, reply_sent_s : float
            On B's.
        sd_m : float64 (2,) or None
            c times the deviations of what B heard, and A; None: not stated.

        Returns
        -------
        heard_s : float64 (2,)
            When B heard A, and A heard B, on A's clock.
        range_m : float64 (2,)
            A to B, B to A.
        covariance_m2 : float64 (2, 2)
        drift_mps : float64 (2,)
            c times the drift, and its deviation.
        """
        c = self._c
        way = np.array([c * (heard_s - sent_s), c * (reply_heard_s - reply_sent_s)])
        flight_s = float(way.sum()) / 2 / c
        when = np.array([sent_s + flight_s, reply_heard_s])
        if sd_m is None:
            sd_m = np.full(2, self._judged((when[0] + when[1]) / 2, float(way[0] - way[1]) / 2))
        clock, known = self._clock_at(float(when[0]))
        # B heard A at the first instant, and sent at another: its clock drifts between
        between_s = float(when[1]) - flight_s - float(when[0])
        moved_m = self._max_rate_mps * np.hypot(float(when[1] - when[0]), CRUISE * flight_s) + 1e-6
        table = np.array(
            [
                [1.0, 0.0, 1.0, 0.0],
                [0.0, 1.0, -1.0, -between_s],
                [-1.0, 1.0, 0.0, 0.0],
            ]
        )
        weight = 1.0 / np.array([sd_m[0], sd_m[1], moved_m]) ** 2
        information = (table.T * weight) @ table
        information[2:, 2:] += known
        spread = np.linalg.inv(information)
        # solved for what the clock differs by from what was expected, so that long offsets cost no digits
        gap = np.array([way[0] - clock[0], way[1] + clock[0] + between_s * clock[1], 0.0])
        solved = spread @ (table.T @ (weight * gap))
        self._learn(when, way, sd_m, flight_s)
        drift = np.array([self.mean[3], np.sqrt(self.covariance[3, 3])])
        return when, solved[:2], spread[:2, :2], drift

    def _clock_at(self, time_s: float) -> tuple[Floats, Floats]:
        """Offset and drift expected (2,), in m and m/s, and the information (2, 2) in that."""
        if not self.known:
            return np.zeros(2), np.diag([0.0, 1.0 / (DRIFT_SD * self._c) ** 2])
        mean, covariance = self._aged(time_s)
        return mean[2:4], np.linalg.inv(covariance[2:4, 2:4])

    def _aged(self, time_s: float) -> tuple[Floats, Floats]:
        dt = time_s - self.time_s
        step = np.eye(5)
        step[0, 1] = step[2, 3] = dt
        step[4, 4] = np.exp(-abs(dt) / CRUISE_S)
        noise = np.zeros((5, 5))
        shape = np.array([[abs(dt) ** 3 / 3, dt * abs(dt) / 2], [dt * abs(dt) / 2, abs(dt)]])
        noise[:2, :2] = ACCELERATION_PSD * shape
        noise[2:4, 2:4] = (DRIFT_WANDER * self._c) ** 2 * shape
        noise[4, 4] = (CRUISE * self._max_rate_mps) ** 2 * (1.0 - step[4, 4] ** 2)
        return step @ self.mean, step @ self.covariance @ step.T + noise

    def _learn(self, when: Floats, way: Floats, sd_m: Floats, flight_s: float) -> None:
        """Follow range and clock: both ways in the order they were heard."""
        if not self.known:
            self._begin(when, way, sd_m)
            return
        before = self.time_s, self.mean, self.covariance
        strange = 0.0
        for k in np.argsort(when).tolist():
            self.mean, self.covariance = self._aged(float(when[k]))
            self.time_s = float(when[k])
            # B's clock as it was when it sent
            late_s = flight_s / 2
            shows = np.array([1.0, 0.0, 1.0, 0.0, late_s] if k == 0 else [1.0, 0.0, -1.0, flight_s, -late_s])
            crossed = self.covariance @ shows
            spread = float(shows @ crossed) + sd_m[k] ** 2
            miss = float(way[k] - shows @ self.mean)
            strange = max(strange, miss**2 / spread)
            gain = crossed / spread
            keep = np.eye(5) - np.outer(gain, shows)
            self.mean = self.mean + gain * miss
            self.covariance = keep @ self.covariance @ keep.T + sd_m[k] ** 2 * np.outer(gain, gain)
        if strange <= REFUSED:
            self._refused = 0
            return
        self._refused += 1
        self.time_s, self.mean, self.covariance = before
        if self._refused >= 3:
            self._begin(when, way, sd_m)

    def _begin(self, when: Floats, way: Floats, sd_m: Floats) -> None:
        """Begin with one exchange of robots that may move as they can."""
        self.time_s, self._refused = float(when.max()), 0
        self.mean = np.array([way.sum() / 2, 0.0, (way[0] - way[1]) / 2, 0.0, 0.0])
        own, drift = float(sd_m @ sd_m) / 4, DRIFT_SD * self._c
        # taken for independent, which they are not: a few exchanges later it does not matter
        moved = (self._max_rate_mps**2 + drift**2) * float(np.ptp(when)) ** 2
        cruise = (CRUISE * self._max_rate_mps) ** 2
        moved += cruise * float(way.sum() / 4 / self._c) ** 2
        self.covariance = np.diag([own + moved, self._max_rate_mps**2, own + moved, drift**2, cruise])

    def _judged(self, time_s: float, half_m: float) -> float:
        """Deviation of hearings that state none: half-differences against straight lines between their neighbours.

        A half-difference has the same noise as a range, a hearing's over √2; a clock drifts, and does not jump.
        """
        self._halves.append((time_s, half_m))
        if len(self._halves) < ENOUGH + 2:
            return UNSTATED_SD_M
        t, h = np.array(self._halves).T
        share = (t[1:-1] - t[:-2]) / np.maximum(t[2:] - t[:-2], 1e-9)
        off = h[1:-1] - (1 - share) * h[:-2] - share * h[2:]
        # a median of squares, for outliers; 0.455 is that of chi-squared
        return float(np.sqrt(2 * np.median(off**2 / (1 + share**2 + (1 - share) ** 2)) / 0.455))
