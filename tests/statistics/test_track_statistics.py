"""Tracks over many runs whose truth is drawn from the filter's own model: errors as large as the filter says.

Bands follow from the number of runs, as those of the fixes do; one of E epochs looked at takes its share of the whole
chance of a false alarm. Beacons stand far off, so that ranges bend little over an error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
import pytest
from scipy.stats import chi2

from locate.made_epochs import HALL, SPEED, Drive, make_epoch, make_site, rows_of
from sonofix.geometry import link, model
from sonofix.locate.fix import fix
from sonofix.locate.noise import CLOCK_SPEED_SD
from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site
from sonofix.track.belief import Belief, Motion, estimate, predict
from sonofix.track.follow import Follower
from sonofix.track.many import age, correct
from sonofix.track.update import update

OUTSIDE = 1e-6
PERIOD_S = 0.5
MOTION = Motion(acceleration_psd=0.05, climb_psd=0.01)
YARD = np.array(HALL) * 30.0
MIDDLE = np.array([140.0, 110.0, 45.0])
STATES = ("x", "y", "z", "vx", "vy", "vz")


@dataclass(frozen=True)
class Case:
    rate_sd_mps: float | None = None
    clock: bool = False
    sounding: bool = False
    free_running: bool = False
    level: bool = False
    sd_m: float = 0.05

    @property
    def states(self) -> tuple[str, ...]:
        return tuple(s for s in STATES if "z" not in s or not self.level)

    @property
    def site(self) -> Site:
        return make_site(YARD, level_m=float(MIDDLE[2]) if self.level else None, sounding=self.sounding)


CASES = {
    "ranges": Case(),
    "ranges on a level": Case(level=True),
    "ranges and rates": Case(rate_sd_mps=0.1),
    "TDoA": Case(clock=True),
    "free-running, sounding": Case(rate_sd_mps=0.1, clock=True, sounding=True, free_running=True),
}


def draw_truth(case: Case, epochs: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Positions and velocities (epochs, 3) of the constant-velocity model: it starts at rest within 1 m/s."""
    psd = np.array([MOTION.acceleration_psd, MOTION.acceleration_psd, MOTION.climb_psd])
    half = np.linalg.cholesky(np.array([[PERIOD_S**3 / 3, PERIOD_S**2 / 2], [PERIOD_S**2 / 2, PERIOD_S]]))
    place, velocity = MIDDLE.copy(), rng.standard_normal(3)
    if case.level:
        psd[2] = velocity[2] = 0.0
    places, velocities = [], []
    for _ in range(epochs):
        places.append(place)
        velocities.append(velocity)
        kick = half @ rng.standard_normal((2, 3)) * np.sqrt(psd)
        place, velocity = place + velocity * PERIOD_S + kick[0], velocity + kick[1]
    return np.array(places), np.array(velocities)


def draw_clock(case: Case, epochs: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Clock offsets in m and speeds in m/s: another pair each epoch where free-running, else a speed that wanders."""
    first = CLOCK_SPEED_SD * SPEED * rng.standard_normal(epochs)
    if case.free_running:
        return rng.uniform(-50, 50, epochs), first
    half = np.linalg.cholesky(np.array([[PERIOD_S**3 / 3, PERIOD_S**2 / 2], [PERIOD_S**2 / 2, PERIOD_S]]))
    kicks = np.sqrt(MOTION.clock_psd) * half @ rng.standard_normal((2, epochs))
    speeds = first[0] + np.concatenate([[0.0], np.cumsum(kicks[1])[:-1]])
    return 12.0 + np.concatenate([[0.0], np.cumsum(speeds * PERIOD_S + kicks[0])[:-1]]), speeds


def epoch_at(
    case: Case,
    site: Site,
    place: Floats,
    velocity: Floats,
    k: int,
    clock: tuple[float, float],
    rng: np.random.Generator,
) -> RangeEpoch:
    """Epoch k: heard, or sent by a vehicle that sounds, at k periods exactly."""
    time_s = PERIOD_S * k
    drive = Drive(place - velocity * time_s, velocity)
    offset_m = clock[0] if case.clock else None
    epoch = make_epoch(site, drive, time_s, sd_m=case.sd_m, rate_sd_mps=case.rate_sd_mps, clock_m=offset_m, rng=rng)
    if case.clock and epoch.range_rate_mps is not None:
        epoch = replace(epoch, range_rate_mps=epoch.range_rate_mps + clock[1])
    return epoch


@dataclass(frozen=True)
class Runs:
    """NEES (runs, epochs) of the estimated states; NIS (innovations) summed, and how many rows that were."""

    nees: Floats
    nis: float
    rows: int


def measure(case: Case, runs: int, epochs: int, rng: np.random.Generator, fix_all: bool = False) -> Runs:
    site = case.site
    nees, nis, rows = np.zeros((runs, epochs)), 0.0, 0
    for r in range(runs):
        places, velocities = draw_truth(case, epochs, rng)
        offsets, speeds = draw_clock(case, epochs, rng)
        follower = Follower(site, MOTION, case.free_running)
        for k in range(epochs):
            epoch = epoch_at(case, site, places[k], velocities[k], k, (offsets[k], speeds[k]), rng)
            if k and not case.free_running:
                value, count = innovation(follower.belief, epoch, site)
                nis, rows = nis + value, rows + count
            # a fix is asked for where the track begins; later ones only point at faulty rows, and there are none
            fixes = (fix(epoch, site, "v"),) if k == 0 or fix_all else ()
            (got,), used, _ = follower.step(epoch, fixes)
            assert used.all()
            index = [got.states.index(s) for s in case.states]
            miss = np.concatenate([got.position_m - places[k], got.velocity_mps - velocities[k]])
            miss = miss[[STATES.index(s) for s in case.states]]
            nees[r, k] = miss @ np.linalg.solve(got.covariance[np.ix_(index, index)], miss)
    return Runs(nees, nis, rows)


def innovation(belief: Belief, epoch: RangeEpoch, site: Site) -> tuple[float, int]:
    """Squared innovation over its covariance, H P Hᵀ + R, of ranges (and rates), and the number of them."""
    aged = predict(belief, float(np.mean(epoch.time_s)), MOTION)
    links = link(site, epoch.emitter, epoch.receiver)
    range_m, rate, by_range, by_rate = model(links, aged.pose(), epoch.time_s - aged.time_s, SPEED)
    n = len(epoch)
    clock = float(epoch.clock == "common")
    h = np.hstack([by_range.reshape(n, -1), np.full((n, 1), clock), np.zeros((n, 1))])
    miss = epoch.range_m - range_m - clock * aged.mean[-2]
    noise = np.diag(epoch.covariance_m2)
    if epoch.range_rate_mps is not None:
        h = np.vstack([h, np.hstack([by_rate.reshape(n, -1), np.zeros((n, 1)), np.full((n, 1), clock)])])
        miss = np.concatenate([miss, epoch.range_rate_mps - rate - clock * aged.mean[-1]])
        noise = np.concatenate([noise, epoch.range_rate_sd_mps**2])
    expected = h @ aged.covariance @ h.T + np.diag(noise)
    return float(miss @ np.linalg.solve(expected, miss)), len(miss)


def check(case: Case, got: Runs) -> None:
    runs, epochs = got.nees.shape
    k = len(case.states)
    low, high = chi2.interval(1 - OUTSIDE / epochs, runs * k)
    each = got.nees.sum(axis=0)
    assert ((low < each) & (each < high)).all(), each / (runs * k)
    if got.rows:
        low, high = chi2.interval(1 - OUTSIDE, got.rows)
        assert low < got.nis < high, got.nis / got.rows


@pytest.mark.parametrize("name", CASES)
def test_tracks_err_as_much_as_they_say(name: str, rng: np.random.Generator) -> None:
    case = CASES[name]
    check(case, measure(case, 40, 16, rng))


def test_an_overconfident_filter_would_be_seen(rng: np.random.Generator) -> None:
    # the same bands refuse a truth that is driven by four times the noise the filter knows of
    case = Case()
    site = case.site
    calm = Motion(acceleration_psd=MOTION.acceleration_psd / 4, climb_psd=MOTION.climb_psd / 4)
    total, runs, epochs = 0.0, 40, 16
    for _ in range(runs):
        places, velocities = draw_truth(case, epochs, rng)
        follower = Follower(site, calm)
        for k in range(epochs):
            epoch = epoch_at(case, site, places[k], velocities[k], k, (0.0, 0.0), rng)
            (got,), *_ = follower.step(epoch, (fix(epoch, site, "v"),) if k == 0 else ())
        miss = np.concatenate([got.position_m - places[-1], got.velocity_mps - velocities[-1]])
        total += miss @ np.linalg.solve(got.covariance, miss)
    assert total > chi2.interval(1 - OUTSIDE / epochs, runs * 6)[1]


def drive_on(updates: int, rng: np.random.Generator) -> tuple[Belief, float, float]:
    """Predict and update again and again, with gaps, lone rows and bursts; smallest eigenvalue and asymmetry seen."""
    site = make_site(HALL)
    epochs = [make_epoch(site, Drive((3.0, 5.5, 1.1)), sd_m=sd, rate_sd_mps=0.05, rng=rng) for sd in (1e-3, 0.02, 0.3)]
    follower = Follower(site)
    follower.step(epochs[1], (fix(epochs[1], site, "v"),))
    belief = follower.belief
    own = np.flatnonzero(belief.free)
    smallest, skew, time_s = np.inf, 0.0, 0.0
    for k in range(updates):
        time_s += float(rng.choice([0.0, 0.01, 0.5, 5.0], p=[0.1, 0.2, 0.69, 0.01]))
        belief = predict(belief, time_s, MOTION)
        epoch = epochs[int(rng.integers(3))]
        epoch = replace(epoch, time_s=np.full(6, time_s))
        if k % 3 == 0:
            epoch = rows_of(epoch, [int(rng.integers(6))])
        links = link(site, epoch.emitter, epoch.receiver)
        belief, *_ = update(belief, epoch, links, np.ones(len(epoch), bool))
        if k % 10 == 0:
            part = belief.covariance[np.ix_(own, own)]
            smallest = min(smallest, float(np.linalg.eigvalsh(part).min()))
            skew = max(skew, float(np.abs(part - part.T).max()))
    return belief, smallest, skew


def check_sound(belief: Belief, smallest: float, skew: float) -> None:
    assert smallest > 0
    assert skew == 0.0
    assert np.isfinite(belief.mean).all()
    assert np.linalg.norm(belief.mean[:3] - [3.0, 5.5, 1.1]) < 0.2


def test_covariance_stays_positive_over_thousands_of_updates(rng: np.random.Generator) -> None:
    check_sound(*drive_on(2000, rng))


@pytest.mark.prove
def test_covariance_stays_positive_over_a_hundred_thousand_updates(rng: np.random.Generator) -> None:
    belief, smallest, skew = drive_on(100_000, rng)
    site = make_site(HALL)
    sd = estimate(belief, site, 0, "fused").sd("x")
    print("\n| updates | smallest eigenvalue seen | asymmetry seen | sd of x at the end |\n|---|---|---|---|")
    print(f"| 100 000 | {smallest:.1e} | {skew:.0e} | {1000 * (sd or 0):.1f} mm |")
    check_sound(belief, smallest, skew)


@numba.njit(error_model="numpy")
def wear(mean, covariance, place, anchors, updates, rng):
    """As `drive_on`, of one vehicle of many, compiled; smallest eigenvalue, asymmetry and number of ranges used."""
    count, densities = len(anchors), np.array([0.05, 0.05, 0.01])
    limits = np.full(count + 1, 40.0)
    ranges, variance, used = np.empty(count), np.empty(count), np.zeros(count, np.bool_)
    smallest, skew, heard = np.inf, 0.0, 0
    for k in range(updates):
        drawn = rng.random()
        dt = 0.0 if drawn < 0.1 else 0.01 if drawn < 0.3 else 0.5 if drawn < 0.99 else 5.0
        sd = (1e-3, 0.02, 0.3)[int(3 * rng.random())]
        lone = int(count * rng.random()) if k % 3 == 0 else -1
        for i in range(count):
            ranges[i] = np.sqrt(np.sum((place - anchors[i]) ** 2)) + sd * rng.standard_normal()
            variance[i] = sd**2
            if lone >= 0 and i != lone:
                ranges[i] = np.nan
        age(mean, covariance, dt, densities)
        correct(mean, covariance, anchors, ranges, variance, 0.0, limits, used)
        heard += used.sum()
        if k % 10 == 0:
            smallest = min(smallest, np.linalg.eigvalsh(covariance)[0])
            skew = max(skew, np.max(np.abs(covariance - covariance.T)))
    return smallest, skew, heard


def worn(updates: int, rng: np.random.Generator) -> tuple[float, float, int, Floats]:
    place, mean, covariance = np.array([3.0, 5.5, 1.1]), np.zeros(6), np.diag([0.01] * 3 + [1.0] * 3)
    mean[:3] = place
    smallest, skew, heard = wear(mean, covariance, place, np.array(HALL), updates, rng)
    assert smallest > 0
    assert skew == 0.0
    assert np.linalg.norm(mean[:3] - place) < 0.2
    return smallest, skew, heard, np.sqrt(np.diag(covariance))


@pytest.mark.prove
def test_one_of_many_keeps_its_covariance_positive_over_ten_million_updates(rng: np.random.Generator) -> None:
    smallest, skew, heard, sd = worn(10_000_000, rng)
    # two epochs of three tell all ranges, one a single range; hardly any is left out
    assert heard > 0.98 * 10_000_000 * (2 * len(HALL) + 1) / 3
    print("\nOne vehicle of `follow_many`: gaps of up to 5 s, lone ranges, deviations of 1 mm to 0.3 m.\n")
    print(
        "| updates | ranges | smallest eigenvalue seen | asymmetry seen | sd of x at the end |\n|---|---|---|---|---|"
    )
    print(f"| 10 000 000 | {heard} | {smallest:.1e} | {skew:.0e} | {1000 * sd[0]:.1f} mm |")


@pytest.mark.prove
def test_tracks_over_hundreds_of_runs(rng: np.random.Generator) -> None:
    runs, epochs = 200, 25
    print(f"\nTracks of the filter's own model, {runs} runs of {epochs} epochs a row.\n")
    print("| case | NEES / states, first epoch | all epochs | last epoch | epochs in their 95 % band | NIS / rows |")
    print("|---|---|---|---|---|---|")
    for name, case in CASES.items():
        got = measure(case, runs, epochs, rng, fix_all=True)
        k = len(case.states)
        low, high = chi2.interval(0.95, runs * k)
        each = got.nees.sum(axis=0)
        inside = int(((low < each) & (each < high)).sum())
        mean = got.nees.mean(axis=0) / k
        nis = f"{got.nis / got.rows:.3f}" if got.rows else "–"
        cells = f"{mean[0]:.3f} | {mean.mean():.3f} | {mean[-1]:.3f} | {inside} of {epochs} | {nis}"
        print(f"| {name} | {cells} |")
        check(case, got)
