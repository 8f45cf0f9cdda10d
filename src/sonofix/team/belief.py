"""What a team's joint filter believes: one Gaussian over all robots, and what is told of it at an instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Event, Floats, Innovation
from sonofix.team.feed import Feed
from sonofix.team.hear import TOLD, hear, learn
from sonofix.team.kernel import advance
from sonofix.team.noise import Noise, noise
from sonofix.team.placing import Placed
from sonofix.team.pushed import Push
from sonofix.team.state import POSE, SIZE, prior, wander_psd
from sonofix.team.watch import Odds

START_SD = (0.05, 0.05, 0.1)
"""Of a stated start pose, in m and rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """What is believed of V robots at one instant.

    Attributes
    ----------
    time_s : float
    pose : float64 (V, 3)
        x, y, yaw of each.
    covariance : float64 (V, 3, 3)
        Of each robot's pose.
    speed_mps : float64 (V,)
    placed : bool (V,)
        Whether the pose means anything.
    rows : (first, last)
        Rows of the feed that were heard now.
    used : bool (rows, 2)
        Their ranges and bearings taken.
    events : tuple of Event
    pushes : tuple of Push
        That were found out now, or that robots were lost by.
    odds : tuple of Odds
        Robots that contradict each other now.
    innovation : Innovation or None
        Of what was taken in now; None where nothing was.
    gainsaid : tuple of int
        Robots whose stated starts were found wrong now.
    unheard : tuple of int
        Pairs of the feed that were found wrong now, and are not believed.
    anew : bool
        What is believed is not what came of the moment before: another belief took its place.
    """

    time_s: float
    pose: Floats
    covariance: Floats
    speed_mps: Floats
    placed: NDArray[np.bool_]
    rows: tuple[int, int]
    used: NDArray[np.bool_]
    events: tuple[Event, ...] = ()
    pushes: tuple[Push, ...] = ()
    odds: tuple[Odds, ...] = ()
    innovation: Innovation | None = None
    gainsaid: tuple[int, ...] = ()
    unheard: tuple[int, ...] = ()
    anew: bool = False


@dataclass(eq=False, slots=True)
class Belief:
    """Joint Gaussian over all robots, changed in place.

    Attributes
    ----------
    mean, covariance : float64 (SIZE V,), (SIZE V, SIZE V)
        Of robots not placed the mean alone is carried on, in the frame of their own odometry.
    placed : bool (V,)
    noise : Noise
    speed : float64 (V,)
    rough : float64 (V, 3)
        Factors on the noise of each robot's odometry.
    last : float64 (W, 2)
        When each view's error was last followed, and at which range.
    """

    mean: Floats
    covariance: Floats
    placed: NDArray[np.bool_]
    noise: Noise
    speed: Floats
    rough: Floats
    last: Floats
    by: Floats = field(init=False)
    drive_noise: Floats = field(init=False)

    def __post_init__(self) -> None:
        """Make room for what kernels write."""
        self.by = np.zeros((len(self.placed), POSE, SIZE))
        self.drive_noise = np.zeros((len(self.placed), POSE, POSE))

    @classmethod
    def blank(cls, feed: Feed) -> Belief:
        """Return what is believed before anything was heard: nothing but how large errors may be."""
        robots = len(feed.robots)
        views = 0 if feed.own_ranges else feed.views
        covariance = np.eye(SIZE * robots + views)
        covariance[: SIZE * robots, : SIZE * robots] = prior(robots, feed.own_ranges, feed.scale_sd)
        return cls(
            np.concatenate([np.zeros(SIZE * robots), np.zeros(views)]),
            covariance,
            np.zeros(robots, bool),
            noise(robots, feed.views, feed.own_ranges, feed.stated_sd_m),
            np.zeros(robots),
            np.ones((robots, 4)),
            np.full((views, 2), np.nan),
        )

    def at(self, robot: int) -> slice:
        """Where a robot's pose stands."""
        return slice(SIZE * robot, SIZE * robot + POSE)

    def drive(self, feed: Feed, from_s: float, until_s: float) -> None:
        """Carry all robots on."""
        psd = wander_psd(feed.own_ranges)
        advance(
            self.mean, self.covariance, self.mean, self.placed, feed.first, feed.odometry_s, feed.odometry,
            from_s, until_s, self.rough, psd, self.by, self.drive_noise, self.speed,
        )  # fmt: skip

    def hear(self, feed: Feed, rows: tuple[int, int], about: Floats | None = None) -> tuple[NDArray[np.bool_], Floats]:
        """Take measurements in; return which ranges and bearings were, and what `hear.hear` tells of them.

        They are linearised ``about`` some state, or else at the mean as it moves.
        """
        count = rows[1] - rows[0]
        used = np.zeros((count, 2), bool)
        found = np.full((count, 2, TOLD), np.nan)
        told = self.noise
        hear(
            self.mean, self.covariance, self.mean if about is None else about, about is None, self.placed, rows,
            feed.time_s, feed.kind, feed.listener, feed.source,
            feed.listener_point, feed.source_point, feed.range_m, feed.range_sd_m, feed.bearing_rad, feed.view,
            told.known, told.fading, told.swell, self.last, told.believed, 1.0 / feed.sound_speed_mps, self.speed, used,
            found, np.empty((3, len(self.mean))),
        )  # fmt: skip
        return used, found

    def learn(self, feed: Feed, rows: tuple[int, int], used: NDArray[np.bool_], found: Floats) -> None:
        """Learn how good measurements are from those just taken in."""
        told = self.noise
        learn(
            rows, feed.time_s, feed.kind, feed.listener, feed.range_m, feed.range_sd_m, feed.view, told.known,
            told.runs, told.swell, told.believed, used, found,
        )  # fmt: skip

    def put(self, robot: int, found: Placed) -> None:
        """Place a robot, with what its place shares with those of the robots it was found by."""
        at = self.at(robot)
        shared = np.zeros((POSE, len(self.mean)))
        for who, by in found.by.items():
            shared += by @ self.covariance[self.at(who)]
        own = found.covariance.copy()
        for who, by in found.by.items():
            own += shared[:, self.at(who)] @ by.T
        shared[:, at] = 0.5 * (own + own.T)
        self.mean[at] = found.pose
        self.covariance[at, :] = shared
        self.covariance[:, at] = shared.T
        self.placed[robot] = True

    def lift(self, robot: int) -> None:
        """Take a robot's place away; what is known of its odometry stays."""
        self.covariance[self.at(robot), :] = 0.0
        self.covariance[:, self.at(robot)] = 0.0
        self.placed[robot] = False

    def loosen(self, robot: int, sd: tuple[float, ...]) -> None:
        """Open a robot's pose by so much."""
        at = self.at(robot)
        self.covariance[at, at] += np.diag(np.square(sd))

    def moment(
        self,
        time_s: float,
        rows: tuple[int, int],
        used: NDArray[np.bool_],
        events: Sequence[Event],
        pushes: Sequence[Push] = (),
    ) -> Moment:
        """Return what is believed now."""
        robots = range(len(self.placed))
        pose = np.array([self.mean[self.at(r)] for r in robots])
        covariance = np.array([self.covariance[self.at(r), self.at(r)] for r in robots])
        speed, placed = self.speed.copy(), self.placed.copy()
        return Moment(time_s, pose, covariance, speed, placed, rows, used, tuple(events), tuple(pushes))
