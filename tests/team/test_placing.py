import numpy as np

from sonofix.team.feed import gather
from sonofix.team.fleet import follow
from sonofix.team.placing import Clues, Shared, place
from team.made_fleet import fleet, without_bearings

ANCHORS = np.array([[0.0, 0.0, 0.3], [4.0, 1.0, 2.0]])
SPREAD = np.diag([0.15, 0.15, 0.1]) ** 2


def clues(rng, known: bool) -> tuple[Clues, np.ndarray, np.ndarray]:
    """Return what two robots that err alike all the time tell one that passes, its pose in its own frame, and truly."""
    m = 8
    along = np.linspace(0.0, 2.0, m)
    own = np.column_stack([along, 0.3 * along**2, np.arctan(0.6 * along)])
    yaw = rng.uniform(-np.pi, np.pi)
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, -sin], [sin, cos]])
    true = np.column_stack([own[:, :2] @ turn.T + [1.0, 2.5], own[:, 2] + yaw])
    which = np.arange(m) % 2
    told = ANCHORS + rng.multivariate_normal(np.zeros(3), SPREAD, 2)
    delta = ANCHORS[which, :2] - true[:, :2]
    listens = np.arange(m) % 4 < 2
    bearing = np.where(
        listens,
        np.arctan2(delta[:, 1], delta[:, 0]) - true[:, 2],
        np.arctan2(-delta[:, 1], -delta[:, 0]) - ANCHORS[which, 2],
    )
    shared = Shared(np.tile(SPREAD, (m, 1, 1)), np.zeros((m, 3, 1)), np.zeros((m, 3, 3)))
    heard = Clues(
        own=own,
        other=told[which],
        anchor=which,
        listens=listens,
        arm=np.zeros((m, 3)),
        range_m=np.hypot(*delta.T) + rng.normal(0, 0.05, m),
        bearing_rad=bearing + rng.normal(0, 0.02, m),
        compass=np.zeros(m, bool),
        pair=which + 2 * listens,
        shared=shared if known else None,
    )
    return heard, own[-1], true[-1]


def nees(known: bool) -> list[float]:
    rng = np.random.default_rng(5)
    found = []
    for _ in range(60):
        heard, now, true = clues(rng, known)
        placed = place(heard, now, (1.0, 0.5))
        if placed is not None:
            off = placed.pose - true
            off[2] -= 2 * np.pi * np.round(off[2] / (2 * np.pi))
            found.append(float(off @ np.linalg.solve(placed.covariance, off)))
    return found


def test_a_place_by_robots_that_err_is_no_surer_than_it_may_be():
    sure, blind = nees(True), nees(False)
    assert len(sure) > 50
    # 3 where it is right; a bound that holds whatever is shared is wider
    assert np.mean(sure) < 3.0
    assert np.mean(blind) > 2 * np.mean(sure)


def test_robots_that_know_nothing_place_nobody():
    heard, now, _ = clues(np.random.default_rng(6), True)
    assert heard.shared is not None
    heard.shared.spread[:] *= 100.0
    assert place(heard, now, (1.0, 0.5)) is None


def test_a_place_is_found_from_afar_where_ranges_alone_tell():
    off = []
    for seed, seconds in ((722, 14.0), (704, 60.0), (700, 14.0)):
        recording, truth = fleet(seconds=seconds, seed=seed)
        for moment, _ in follow(gather(without_bearings(recording))):
            for event in moment.events:
                rows = truth[event.vehicle]
                robot = int(event.vehicle[1:])
                true = [np.interp(moment.time_s, rows[:, 0], rows[:, i]) for i in (1, 2)]
                off.append(np.hypot(*(moment.pose[robot, :2] - true)))
            if moment.time_s > 10.0:
                break
    assert len(off) >= 9
    assert max(off) < 0.5
