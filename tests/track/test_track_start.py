"""Starts that are wrong, or not known: what was stated is left where ranges gainsay it, and two places contest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locate.made_epochs import HALL, Drive, make_epoch, make_site
from sonofix.records import Estimate, Floats, Table
from sonofix.site import Site
from sonofix.street import Street
from sonofix.track.follow import Follower
from sonofix.track.passage import Heard
from sonofix.track.smooth import smooth

TURN_RADPS, SPEED_MPS, PERIOD_S, SD_M = 0.3, 0.8, 0.25, 0.1
BEGIN = np.array([5.0, 2.2, 0.0])


def pose(time_s: float, turn_radps: float = TURN_RADPS) -> Floats:
    """Return where a vehicle is that drives an even bend from `BEGIN`: x, y, heading."""
    turned = turn_radps * time_s
    chord = SPEED_MPS * time_s * np.sinc(turned / (2 * np.pi))
    yaw = BEGIN[2] + turned
    return BEGIN + [chord * np.cos(BEGIN[2] + turned / 2), chord * np.sin(BEGIN[2] + turned / 2), yaw - BEGIN[2]]


class Outing:
    """A drive with odometry, its ranges, and a start that is off by (dx, dy, turn); None: none is stated."""

    def __init__(
        self,
        site: Site,
        off: tuple[float, float, float] | None,
        rng: np.random.Generator,
        seconds: float = 18.0,
        turn_radps: float = TURN_RADPS,
    ) -> None:
        times = np.arange(0.0, seconds + 0.1, 0.1)
        self._site, self._turn_radps = site, turn_radps
        self.pairs = tuple((b.id, m.id) for b in site.beacons for m in site.microphones)
        self._table = Table(
            {
                "time_s": times,
                "v_mps": SPEED_MPS + 0.02 * rng.standard_normal(len(times)),
                "yaw_rate_radps": turn_radps + 0.01 * rng.standard_normal(len(times)),
            },
            {},
        )
        self.start = None
        if off is not None:
            x, y, yaw = BEGIN + off
            self.start = Table({"x_m": np.array([x]), "y_m": np.array([y]), "yaw_rad": np.array([yaw])}, {})
        street = self._street()
        self.heard: list[Heard] = []
        self.told: list[tuple[Estimate, ...]] = []
        self.events = []
        for at_s in np.arange(0.05, seconds, PERIOD_S).tolist():
            x, y, _ = pose(at_s, turn_radps)
            epoch = make_epoch(site, Drive((x, y, 0.0)), sd_m=SD_M, rng=rng, stated=True)
            step = street.walk(replace(epoch, time_s=np.full(len(self.pairs), at_s), sync_s=at_s))
            self.heard.append((step.ranges, step.fixes))
            self.told.append(step.estimates)
            self.events += step.events

    def _street(self) -> Street:
        street = Street(self._site, self.start)
        street.sense({"odometry": self._table}, stated=self.pairs)
        return street

    def begin(self) -> Follower:
        street = self._street()
        street.begin(0.05)
        return street.follower

    def judge(self, track: list[tuple[Estimate, ...]], after_s: float = 0.0) -> tuple[float, float, float]:
        """Return rms of the place (m), its mean NEES (2 is right) and the worst heading (rad)."""
        miss, nees, turned = [], [], [0.0]
        for got in [one for some in track for one in some if one.time_s >= after_s]:
            there = pose(got.time_s, self._turn_radps)
            off = got.position_m[:2] - there[:2]
            miss.append(float(off @ off))
            nees.append(float(off @ np.linalg.solve(got.covariance[:2, :2], off)))
            if got.yaw_rad is not None:
                turned.append(abs(float(np.angle(np.exp(1j * (got.yaw_rad - there[2]))))))
        return float(np.sqrt(np.mean(miss))), float(np.mean(nees)), max(turned)


HALL_SITE = make_site(HALL, level_m=0.0)
WALL_SITE = make_site(((0.0, -1.0, 0.3), (10.0, -1.0, 0.3)), level_m=0.0)


@pytest.mark.parametrize("off", [(3.0, 2.0, 0.0), (0.0, 0.0, 2.2), (1.0, 1.0, -2.9)])
def test_a_wrong_start_is_found_out_and_not_smoothed_from(
    off: tuple[float, float, float], rng: np.random.Generator
) -> None:
    outing = Outing(HALL_SITE, off, rng)
    assert [e.event for e in outing.events if e.event in ("slip", "reset")] == ["reset"]
    # told of its place only where two starts contest, of its heading once the vehicle has gone some metres
    rms_m, nees, turned_rad = outing.judge(outing.told, after_s=5.0)
    assert rms_m < SD_M
    assert nees < 4.0
    assert turned_rad < 0.3
    track = smooth(outing.begin, outing.heard)
    rms_m, nees, turned_rad = outing.judge(track)
    assert len([e for some in track for e in some]) == len(outing.heard)
    assert rms_m < SD_M / 2
    assert nees < 4.0
    assert turned_rad < 0.1


def test_a_start_that_is_right_is_kept(rng: np.random.Generator) -> None:
    outing = Outing(HALL_SITE, (0.02, -0.02, 0.05), rng)
    assert not [e for e in outing.events if e.event in ("slip", "reset")]
    assert outing.judge(outing.told)[2] < 0.3
    before = outing.begin()
    assert before.belief.placed.all()
    for one in outing.heard:
        before.step(*one)
    assert not before.refuted.any()


@pytest.mark.parametrize("below", [False, True])
def test_two_beacons_and_odometry_tell_the_place_once_a_bend_is_driven(below: bool, rng: np.random.Generator) -> None:
    """Whichever of the two places the track begins at: that does not depend on where the vehicle is."""
    site = make_site(((0.0, 12.0, 0.3), (10.0, 12.0, 0.3)), level_m=0.0) if below else WALL_SITE
    outing = Outing(site, None, rng)
    first_s = next(e.time_s for some in outing.told for e in some)
    assert 1.0 < first_s < 15.0
    rms_m, nees, turned_rad = outing.judge(outing.told)
    assert rms_m < 0.3
    assert nees < 6.0
    assert turned_rad < 0.5
    track = smooth(outing.begin, outing.heard)
    rms_m, nees, turned_rad = outing.judge(track)
    assert len([e for some in track for e in some]) == len(outing.heard)
    assert rms_m < 0.2
    assert nees < 6.0
    assert turned_rad < 0.2


def test_on_a_straight_way_two_beacons_tell_nothing(rng: np.random.Generator) -> None:
    """The mirror image drives as straight: neither is told."""
    outing = Outing(WALL_SITE, None, rng, seconds=12.0, turn_radps=0.0)
    assert not any(outing.told)
    assert not any(smooth(outing.begin, outing.heard))


@pytest.mark.parametrize("pushed", [False, True])
def test_outliers_are_no_slip_and_a_push_is(pushed: bool, rng: np.random.Generator) -> None:
    """One range in ten is 5 m long; four are heard at once, so in one epoch of twenty half of them gainsay wheels."""
    site, seconds = make_site(HALL[:4], level_m=0.0), 30.0
    outing = Outing(site, (0.0, 0.0, 0.0), rng, seconds=0.0)
    times = np.arange(0.0, seconds + 0.1, 0.1)
    turns = TURN_RADPS + 0.01 * rng.standard_normal(len(times))
    speeds = SPEED_MPS + 0.02 * rng.standard_normal(len(times))
    street = Street(site, outing.start)
    odometry = Table({"time_s": times, "v_mps": speeds, "yaw_rate_radps": turns}, {})
    street.sense({"odometry": odometry}, stated=outing.pairs)
    slips, miss = [], []
    for at_s in np.arange(0.05, seconds, PERIOD_S).tolist():
        place = pose(at_s)[:2] + ([1.2, 1.2] if pushed and at_s > 20.0 else [0.0, 0.0])
        epoch = make_epoch(site, Drive((*place, 0.0)), sd_m=SD_M, rng=rng, stated=True)
        late = 5.0 * (rng.random(4) < 0.1)
        heard = replace(epoch, time_s=np.full(4, at_s), sync_s=at_s, range_m=epoch.range_m + late)
        step = street.walk(heard)
        slips += [e.time_s for e in step.events if e.event in ("slip", "reset")]
        miss += [np.hypot(*(e.position_m[:2] - place)) for e in step.estimates if not 20.0 < at_s < 22.0]
    assert len(slips) == pushed
    assert all(20.0 < at_s < 21.0 for at_s in slips)
    assert max(miss) < 0.5


def test_a_pushed_vehicle_that_no_fix_ever_places_keeps_its_start(rng: np.random.Generator) -> None:
    # two beacons leave its mirror image open: without its start it would have no place at all
    times = np.arange(0.0, 10.0, 0.1)
    table = Table({"time_s": times, "v_mps": 0.5 + 0 * times, "yaw_rate_radps": 0 * times})
    start = Table({"x_m": np.array([1.0]), "y_m": np.array([3.0]), "yaw_rad": np.array([0.0])})

    def street() -> Street:
        made = Street(WALL_SITE, start)
        made.sense({"odometry": table})
        return made

    def begin() -> Follower:
        made = street()
        made.begin(0.05)
        return made.follower

    causal, heard, events = street(), [], []
    for k in range(19):
        at_s = 0.05 + 0.5 * k
        place = (1.0 + 0.5 * at_s, 3.0 if k < 10 else 4.0, 0.0)
        step = causal.walk(make_epoch(WALL_SITE, Drive(place), at_s, sd_m=0.005, rng=rng))
        heard.append((step.ranges, step.fixes))
        events += [event.event for event in step.events]
        assert not any(found.status == "ok" for found in step.fixes)
    assert events.count("slip") == 1
    assert not causal.follower.refuted.any()
    track = smooth(begin, heard)
    assert [len(some) for some in track] == [1] * len(heard)
    assert abs(track[-1][0].position_m[1] - 4.0) < 0.05
    assert abs(track[0][0].position_m[1] - 3.0) < 0.05
