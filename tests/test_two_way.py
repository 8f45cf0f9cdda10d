"""Exchanges on two clocks: ranges, what is stated of them, and clocks that are solved for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sonofix.records import Exchange, Floats, RangeEpoch, Table
from sonofix.site import Site
from sonofix.two_way import TwoWay, exchange_epochs, exchanges_of, replied

C = 343.2
SD_S = 5e-6
Way = Callable[[float], Floats]


def site(max_speed_mps: float = 1.0) -> Site:
    names = ("A", "B", "D")
    return Site.model_validate(
        {
            "air": {"sound_speed_mps": C},
            "vehicle": [{"id": name, "z_m": 0.0, "max_speed_mps": max_speed_mps} for name in names],
            "beacon": [{"id": name, "vehicle": name} for name in names],
            "microphone": [{"id": name, "vehicle": name} for name in names],
        }
    )


class World:
    """Robots that move and count time as told; makes exchanges, with noise of `SD_S` where a generator is given."""

    def __init__(self, ways: dict[str, Way], clocks: dict[str, tuple[float, float]], rng=None) -> None:
        self.ways, self.clocks, self.rng = ways, clocks, rng

    def shown(self, robot: str, time_s: float) -> float:
        offset_s, drift = self.clocks.get(robot, (0.0, 0.0))
        return offset_s + (1 + drift) * time_s

    def flight_s(self, a: str, b: str, sent_s: float) -> float:
        flight = 0.0
        for _ in range(30):
            flight = float(np.linalg.norm(self.ways[b](sent_s + flight) - self.ways[a](sent_s))) / C
        return flight

    def exchange(self, a: str, b: str, sent_s: float, wait_s: float = 0.1, stated: bool = True) -> Exchange:
        heard_s = sent_s + self.flight_s(a, b, sent_s)
        reply_s = heard_s + wait_s
        back_s = reply_s + self.flight_s(b, a, reply_s)
        noise = np.zeros(2) if self.rng is None else SD_S * self.rng.standard_normal(2)
        sd = (SD_S, SD_S) if stated else (None, None)
        stamps = (
            self.shown(a, sent_s),
            self.shown(b, heard_s) + float(noise[0]),
            self.shown(b, reply_s),
            self.shown(a, back_s) + float(noise[1]),
        )
        return Exchange(a, b, *stamps, *sd)

    def ranges_m(self, epoch: RangeEpoch) -> Floats:
        """True ranges of rows, as a row defines them; the first robot's clock is right."""
        out = []
        for emitter, receiver, time_s in zip(epoch.emitter, epoch.receiver, epoch.time_s, strict=True):
            way = 0.0
            for _ in range(30):
                way = float(np.linalg.norm(self.ways[receiver](time_s) - self.ways[emitter](time_s - way / C)))
            out.append(way)
        return np.array(out)


def stands(x: float, y: float) -> Way:
    return lambda time_s: np.array([x, y])


STANDING = {"A": stands(0.0, 0.0), "B": stands(9.0, 0.0), "D": stands(4.0, 7.0)}


@pytest.mark.parametrize("clock", [(0.0, 0.0), (0.2, 5e-5), (-86400.0, -8e-5)])
def test_clocks_are_solved_for(clock: tuple[float, float]) -> None:
    """A drift of 80 millionths over a wait of 0.4 s is 5 mm of range until it is known."""
    world, ways = World(STANDING, {"B": clock}), TwoWay(site())
    for k in range(12):
        part = ways.take(world.exchange("A", "B", 0.5 * k, wait_s=0.4))
        miss = part.range_m - 9.0
        assert (np.abs(miss) < 5 * np.sqrt(np.diag(part.covariance_m2))).all()
    # of offsets of a day, float64 leaves a hundredth of a nanosecond
    assert abs(miss.mean()) < 2e-4
    told = ways.told_s("B", world.shown("B", 6.0))
    assert told == pytest.approx(6.0, abs=1e-4)


def test_it_does_not_matter_who_began_nor_who_waited() -> None:
    world = World(STANDING, {"B": (0.3, 3e-5)}, np.random.default_rng(1))
    there, back = TwoWay(site()), TwoWay(site())
    for k in range(6):
        e = world.exchange("A", "B", 0.5 * k, wait_s=-0.02 if k % 2 else 0.2)
        turned = Exchange("B", "A", e.reply_sent_s, e.reply_heard_s, e.sent_s, e.heard_s, SD_S, SD_S)
        one, other = there.take(e), back.take(turned)
        assert one.emitter == other.emitter == ("A", "B")
        np.testing.assert_array_equal(one.range_m, other.range_m)
        np.testing.assert_array_equal(one.covariance_m2, other.covariance_m2)


def test_two_exchanges_are_double_sided_ranging() -> None:
    """Round trips Ra, Rb, waits Da, Db, free clocks: (Ra Rb − Da Db) / (Ra + Rb + Da + Db) (Neirynck et al. 2016)."""
    world, ways = World(STANDING, {"B": (1.0, 9e-5)}), TwoWay(site(max_speed_mps=1e-6))
    first, second = world.exchange("A", "B", 0.0, wait_s=0.3), world.exchange("A", "B", 0.7, wait_s=0.3)
    ra, db = first.reply_heard_s - first.sent_s, first.reply_sent_s - first.heard_s
    rb, da = second.heard_s - first.reply_sent_s, second.sent_s - first.reply_heard_s
    double_m = C * (ra * rb - da * db) / (ra + rb + da + db)
    plain_m = C * (ra - db) / 2
    assert abs(plain_m - 9.0) > 4e-3
    assert abs(double_m - 9.0) < 1e-3
    ways.take(first)
    # noiseless, robots that stand, and hearings stated as good: the filter has the drift by the second exchange
    assert abs(ways.take(second).range_m.mean() - 9.0) < 2e-3


def test_the_first_exchange_says_how_little_it_knows() -> None:
    """The sum doubts the drift over the wait, c · 1e-4 · 0.4 s / 2; the difference what robots may move meanwhile."""
    part = TwoWay(site(2.0)).take(World(STANDING, {"B": (0.1, 0.0)}).exchange("A", "B", 0.0, wait_s=0.4))
    half = np.array([0.5, 0.5])
    own = np.hypot(C * SD_S / np.sqrt(2), C * 1e-4 * 0.4 / 2)
    assert np.sqrt(half @ part.covariance_m2 @ half) == pytest.approx(own, rel=1e-3)
    apart = np.array([1.0, -1.0])
    moved = 4.0 * (0.4 + 9.0 / C)
    assert np.sqrt(apart @ part.covariance_m2 @ apart) == pytest.approx(moved, rel=0.01)


def test_ranges_err_as_stated_while_robots_drive() -> None:
    """One drives a circle past two, one of which creeps: sums are judged strictly, rows must not be overconfident."""
    rng = np.random.default_rng(3)
    ways = STANDING | {
        "B": lambda t: np.array([6.0 + 3.0 * np.cos(0.2 * t), 3.0 * np.sin(0.2 * t)]),
        "D": lambda t: np.array([4.0 + 0.1 * t, 7.0]),
    }
    world = World(ways, {"B": (0.3, 4e-5), "D": (-7.0, -3e-5)}, rng)
    solver, sums, squares = TwoWay(site()), [], []
    for k in range(150):
        pairs = (("A", "B", 0.0), ("B", "D", 0.16), ("A", "D", 0.3))
        found = [solver.take(world.exchange(a, b, 0.5 * k + t)) for a, b, t in pairs]
        epoch = solver.epoch(k, found)
        assert epoch is not None
        miss = epoch.range_m - world.ranges_m(epoch)
        if k < 10:
            continue
        squares.append(miss @ np.linalg.solve(epoch.covariance_m2, miss) / len(miss))
        for part in found:
            rows = [i for i, name in enumerate(epoch.emitter) if {name, epoch.receiver[i]} == set(part.robots)]
            spread = epoch.covariance_m2[np.ix_(rows, rows)].sum() / 4
            sums.append(miss[rows].mean() / np.sqrt(spread))
    # normal errors: the mean of n squares scatters by √(2 / n)
    assert abs(np.mean(np.square(sums)) - 1.0) < 4 * np.sqrt(2 / len(sums))
    assert np.mean(squares) < 1.0 + 4 * np.sqrt(2 / (6 * len(squares)))


def test_a_row_is_told_at_the_instant_it_was_heard() -> None:
    """Both drive alike, one behind the other: what is sent ahead goes farther than what is sent back."""
    fast = {"A": lambda t: np.array([2.0 * t, 0.0]), "B": lambda t: np.array([2.0 * t + 10.0, 0.0])}
    world, ways = World(fast, {"B": (0.0, 0.0)}), TwoWay(site(2.0))
    for k in range(60):
        part = ways.take(world.exchange("A", "B", 0.5 * k))
    epoch = ways.epoch(0, [part])
    assert epoch is not None
    true = world.ranges_m(epoch)
    assert true[0] - true[1] == pytest.approx(2 * 2.0 * 10.0 / C, rel=0.02)
    assert epoch.range_m.mean() == pytest.approx(true.mean(), abs=1e-3)
    # which of both it is cannot be told from a clock that is ahead: stated
    assert (np.abs(epoch.range_m - true) < 3 * np.sqrt(np.diag(epoch.covariance_m2))).all()


def test_unstated_hearings_are_judged_by_the_clock() -> None:
    world, ways = World(STANDING, {"B": (0.2, 2e-5)}, np.random.default_rng(5)), TwoWay(site())
    parts = [ways.take(world.exchange("A", "B", 0.5 * k, stated=False)) for k in range(60)]
    half = np.array([0.5, 0.5])
    sd = [float(np.sqrt(half @ part.covariance_m2 @ half)) for part in parts]
    assert sd[0] == pytest.approx(0.1 / np.sqrt(2), rel=0.01)
    # a median of forty squares is good to a fifth, of neighbours that share noise somewhat worse
    assert sd[-1] == pytest.approx(C * SD_S / np.sqrt(2), rel=0.5)
    assert not parts[-1].stated


def test_an_exchange_gone_wrong_moves_no_clock_and_a_clock_that_jumped_is_begun_anew() -> None:
    world, ways = World(STANDING, {"B": (0.2, 2e-5)}), TwoWay(site(0.5))
    for k in range(20):
        ways.take(world.exchange("A", "B", 0.5 * k))
    e = world.exchange("A", "B", 10.0)
    wrong = Exchange("A", "B", e.sent_s, e.heard_s + 0.02, e.reply_sent_s, e.reply_heard_s, SD_S, SD_S)
    bad = ways.take(wrong)
    assert abs(bad.range_m[0] - bad.range_m[1]) > 1.0  # seven metres late one way
    after = ways.take(world.exchange("A", "B", 10.5))
    np.testing.assert_allclose(after.range_m, 9.0, atol=0.01)
    world.clocks["B"] = (0.9, 2e-5)
    for k in range(10):
        after = ways.take(world.exchange("A", "B", 11.0 + 0.5 * k))
    np.testing.assert_allclose(after.range_m, 9.0, atol=0.02)


def table(exchanges: list[Exchange]) -> Table:
    names = ("sent_s", "heard_s", "reply_sent_s", "reply_heard_s", "heard_sd_s", "reply_heard_sd_s")
    return Table(
        {name: np.array([getattr(e, name) for e in exchanges], np.float64) for name in names},
        {"from": tuple(e.emitter for e in exchanges), "to": tuple(e.receiver for e in exchanges)},
    )


def test_epochs_are_sweeps_and_times_those_of_the_first_robot() -> None:
    world = World(STANDING, {"B": (3000.0, 2e-5), "D": (-500.0, -1e-5)})
    # A never hears D: B's clock joins them
    rows = [world.exchange(a, b, 0.5 * k + t) for k in range(4) for a, b, t in (("A", "B", 0.0), ("D", "B", 0.2))]
    assert exchanges_of(table(rows))[0] == rows[0]
    epochs = list(exchange_epochs(table(rows), site()))
    assert [len(epoch) for epoch in epochs] == [4] * 4
    for k, epoch in enumerate(epochs):
        assert epoch.index == k
        assert (np.diff(epoch.time_s) >= 0).all()
        assert set(epoch.emitter) == {"A", "B", "D"}
        assert epoch.sync_s == pytest.approx(0.5 * k + 9.0 / C, abs=0.01)
        np.testing.assert_allclose(epoch.covariance_m2, epoch.covariance_m2.T)
        assert np.linalg.eigvalsh(epoch.covariance_m2).min() > 0
    alone = [world.exchange("D", "B", 0.2), world.exchange("D", "B", 0.7)]
    assert list(exchange_epochs(table(alone), site())) == []


@pytest.mark.parametrize(
    ("change", "ends", "words"),
    [
        ({"beacon": [{"id": "A", "position_m": [0, 0, 0]}, {"id": "B", "vehicle": "B"}]}, ("A", "B"), "A is fixed"),
        ({"beacon": [{"id": "A", "vehicle": "A"}]}, ("A", "B"), "vehicle B never sounds"),
        ({"microphone": [{"id": "B", "vehicle": "B"}]}, ("A", "B"), "vehicle A never listens"),
    ],
)
def test_ends_that_cannot_exchange_are_told(change: dict, ends: tuple[str, str], words: str) -> None:
    whole = {
        "vehicle": [{"id": "A"}, {"id": "B"}],
        "beacon": [{"id": "A", "vehicle": "A"}, {"id": "B", "vehicle": "B"}],
        "microphone": [{"id": "A", "vehicle": "A"}, {"id": "B", "vehicle": "B"}],
    }
    with pytest.raises(ValueError, match=words):
        replied(Site.model_validate(whole | change), *ends)
