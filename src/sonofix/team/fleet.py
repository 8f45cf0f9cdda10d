"""The team as one: a joint filter over all robots, with every measurement taken in at its own time, exactly."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Event, Floats
from sonofix.team.feed import SIGHTING, Feed
from sonofix.team.hear import TOLD, hear, learn
from sonofix.team.kernel import advance
from sonofix.team.noise import Noise, noise
from sonofix.team.placing import Placed, place
from sonofix.team.pushed import SLIPPED, Before, Push, search, still_s
from sonofix.team.recent import Recent
from sonofix.team.rough import Rough
from sonofix.team.state import POSE, SIZE, prior, wander_psd
from sonofix.team.watch import Odds, Watch

START_SD = (0.05, 0.05, 0.1)
"""Of a stated start pose, in m and rad."""

FILL_S = 1.0
"""Where nothing is heard for longer, a row tells how the doubt grows."""

ASK_S = 1.0
"""How often it is tried to place a robot."""

LEFT_S = 10.0
"""A robot of which nothing comes for so long has left."""

WAITED_S = 2.0
"""One that was pushed and is not found by then is lost."""

REWOUND_S = 4.0
"""A push is looked for so far back."""


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


def instants(feed: Feed) -> list[tuple[float, int, int]]:
    """Return the instants of a feed with their rows (first, last); empty ones fill silences of `FILL_S`.

    Where no odometry comes either, they end once all have left, and begin again as long before something comes.
    """
    changes = np.flatnonzero(np.diff(feed.time_s) > 0) + 1
    edges = [0, *changes.tolist(), len(feed.time_s)] if len(feed.time_s) else [0]
    begin, end = float(feed.odometry_s.min()), float(feed.odometry_s.max())
    out: list[tuple[float, int, int]] = []
    told_s = np.sort(feed.odometry_s)
    last = min(begin, float(feed.time_s[0])) if len(feed.time_s) else begin
    for a, b in pairwise(edges):
        time = float(feed.time_s[a])
        out += [(t, a, a) for t in _between(last, time, told_s)]
        out.append((time, a, b))
        last = time
    return out + [(t, len(feed.time_s), len(feed.time_s)) for t in _between(last, end + 1e-9, told_s)]


def _between(after_s: float, before_s: float, told_s: Floats) -> list[float]:
    """Return instants between two, but none far from both and from those at which odometry told something."""
    count = int(np.ceil((before_s - after_s) / FILL_S)) - 1
    between = told_s[np.searchsorted(told_s, after_s) : np.searchsorted(told_s, before_s)]
    near = np.concatenate([[after_s], between, [before_s]])
    # who leaves is told at the second instant after that at the latest
    reach_s = LEFT_S + 2 * FILL_S
    gaps = np.flatnonzero(np.diff(near) > 2 * reach_s)
    first = [1, *np.ceil((near[gaps + 1] - reach_s - after_s) / FILL_S).astype(int).tolist()]
    last = [*np.floor((near[gaps] + reach_s - after_s) / FILL_S).astype(int).tolist(), count]
    return [after_s + FILL_S * i for a, b in zip(first, last, strict=True) for i in range(max(a, 1), min(b, count) + 1)]


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


def follow(feed: Feed, until_placed: bool = False) -> Iterator[tuple[Moment, Belief]]:
    """Run the joint filter over a feed, causally.

    Parameters
    ----------
    feed : Feed
    until_placed : bool
        A robot listens until it is placed, then drives by its odometry alone: what odometry is worth.

    Yields
    ------
    Moment, one an instant, and the belief behind it, which goes on changing
    """
    belief = Belief.blank(feed)
    watch, recent = Watch(len(feed.robots)), Recent(feed)
    for robot, start in feed.starts.items():
        belief.put(robot, Placed(np.array(start), np.diag(np.square(START_SD)), {}))
    rough = Rough(feed)
    past: deque[Before] = deque()
    now: float | None = None
    asked_s = left_s = -np.inf
    steps, told_of = instants(feed), set()
    for time_s, first, last in steps:
        events: list[Event] = []
        pushes: list[Push] = []
        rows = (first, last)
        belief.drive(feed, time_s if now is None else now, time_s)
        now = time_s
        if time_s - left_s >= ASK_S:
            left_s = time_s
            for robot in leave(feed, belief.placed, recent, time_s, time_s - steps[0][0], events):
                belief.lift(robot)
                watch.clear(robot)
        frozen = until_placed and belief.placed.all()
        count = last - first
        used, told = np.zeros((count, 2), bool), np.full((count, 2, TOLD), np.nan)
        if count and not until_placed:
            before = belief.mean.copy(), belief.covariance.copy(), belief.last.copy(), belief.rough.copy()
            past.append(Before(time_s, rows, *before, rough.learnt(), np.zeros(len(feed.robots), bool)))
            while time_s - past[0].time_s > REWOUND_S:
                past.popleft()
            ends = {int(end) for i in range(*rows) for end in (feed.listener[i], feed.source[i])} - {-1}
            for robot in ends:
                rough.take(feed, belief, belief.noise, rows, robot, time_s)
            used, told = belief.hear(feed, rows)
            for robot in ends:
                rough.slipped(belief, robot, time_s)
            watch.see(feed, rows, used, told)
            if (feed.kind[first:last] == SIGHTING).any():
                _seek(belief, feed, watch, recent, rough, past, events, pushes)
            belief.learn(feed, rows, used, told)
        if not frozen:
            recent.add(belief.mean, belief.placed, rows)
            if not belief.placed.all() and time_s - asked_s >= ASK_S:
                asked_s = time_s
                _place(belief, feed, recent, time_s, events)
        if any(event.event in ("joined", "left", "lost") for event in events):
            past.clear()  # it was before that
        odds = watch.at_odds()
        events += [event for one in odds if one.robots not in told_of for event in _odd(feed, one, now)]
        told_of = {one.robots for one in odds}
        moment = replace(belief.moment(time_s, rows, used, events, pushes), odds=odds)
        for one in odds:
            moment.covariance[list(one.robots), :2, :2] += one.variance_m2 * np.eye(2)
        for robot, _ in watch.astray():
            # moved aside, and nobody knows yet where to
            moment.covariance[robot] += np.diag(np.square(SLIPPED))
        yield moment, belief


def leave(
    feed: Feed, placed: NDArray[np.bool_], recent: Recent, time_s: float, since_s: float, events: list[Event]
) -> list[int]:
    """Return the placed robots of which nothing came for `LEFT_S`, and tell of them.

    A robot that has no odometry is with the others as long as it is heard, or hears. ``since_s``: how long ago all
    began, as nobody has left before anybody could be heard.
    """
    gone = [
        robot
        for robot in np.flatnonzero(placed).tolist()
        if min(time_s - recent.told_s(robot, time_s), since_s) > LEFT_S
    ]
    for robot in gone:
        recent.forget(robot)
        events.append(Event(time_s, feed.robots[robot], "left", f"nothing came of it for {LEFT_S:g} s"))
    return gone


def _place(belief: Belief, feed: Feed, recent: Recent, time_s: float, events: list[Event]) -> None:
    """Place the robots that now can be."""
    for robot in np.flatnonzero(~belief.placed).tolist():
        clues = recent.clues(robot, time_s, belief.placed)
        found = None if clues is None else place(clues, belief.mean[belief.at(robot)])
        if found is not None:
            belief.put(robot, found)
            x, y, yaw = found.pose
            text = f"placed at ({x:.3f}, {y:.3f}) m, heading {np.degrees(yaw) % 360:.0f}°"
            events.append(Event(time_s, feed.robots[robot], "joined", text))


def _odd(feed: Feed, odds: Odds, time_s: float) -> list[Event]:
    if odds.refused:
        whose = " and ".join(feed.robots[robot] for robot in odds.refused)
        why = f"and most of what else is heard of {whose} is refused: are start poses right, and ranges in metres?"
    elif odds.alone:
        why = "and little else is heard of them: one of them is elsewhere"
    else:
        why = "while all else agrees: one of them is elsewhere"
    names = [feed.robots[robot] for robot in odds.robots]
    return [
        Event(time_s, name, "excluded", f"its ranges with {other} are off by {odds.miss_m:.2f} m, {why}")
        for name, other in zip(names, names[::-1], strict=True)
    ]


def _seek(
    belief: Belief,
    feed: Feed,
    watch: Watch,
    recent: Recent,
    rough: Rough,
    past: deque[Before],
    events: list[Event],
    pushes: list[Push],
) -> None:
    """Find robots that are not where their tracks have them, or take away their places."""
    for _ in feed.robots:
        astray = watch.astray()
        for robot, first in astray:
            others = [other for other, _ in astray if other != robot]
            if _reopen(belief, feed, robot, first, others, watch, recent, rough, past, events, pushes):
                break
        else:
            return


def _reopen(
    belief: Belief,
    feed: Feed,
    robot: int,
    first: int,
    others: Sequence[int],
    watch: Watch,
    recent: Recent,
    rough: Rough,
    past: deque[Before],
    events: list[Event],
    pushes: list[Push],
) -> bool:
    """Find a robot, first as if it alone were astray, or take its place away; return whether that is decided."""
    now_s, name = past[-1].time_s, feed.robots[robot]
    told = None
    # it alone, it and one more, or all
    for doubtful in dict.fromkeys([(), *((other,) for other in others), tuple(others)]):
        told = search(belief, feed, robot, first, list(past), doubtful)
        if told is not None:
            break
    if told is None:
        if now_s - feed.time_s[first] < WAITED_S:
            return False
        if not watch.refused(robot):
            # measurements are worse than they were, and no other place explains them
            watch.clear(robot)
            return False
        was = next((one for one in past if one.rows[1] > first), past[-1])
        pushes.append(Push(robot, still_s(belief, feed, robot, first, list(past)), now_s))
        belief.lift(robot)
        recent.forget(robot)
        events.append(Event(now_s, name, "lost", "what is heard disagrees with its track: to be placed anew"))
    else:
        found, push = told
        was = found.past[0]
        pushes.append(push)
        belief.mean[:], belief.covariance[:], belief.last[:] = found.mean, found.covariance, found.last
        for _ in found.past:
            past.pop()
        past.extend(found.past)
        apart = float(np.hypot(*found.shift[:2]))
        text = f"what is heard disagrees with its odometry: {apart:.2f} m from where that had it"
        events.append(Event(now_s, name, "slip", text))
    for one in (robot, *others):
        rough.unlearn(belief, one, was.learnt, was.rough)
    watch.clear(robot)
    return True
