"""Runs made up for pictures: linearised fixes about a known path, so that every number in them is consistent."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from sonofix.records import Estimate, Event, Fix, RangeEpoch, Recording, Step, Truth
from sonofix.site import Site

HALL = {
    **{"B1": (0, 0, 3.2), "B2": (6, 0, 3.1), "B3": (12, 0, 3.2)},
    **{"B4": (12, 9, 3.0), "B5": (6, 9, 3.2), "B6": (0, 9, 3.1)},
}


def node(name: str, place: tuple[float, float, float] | str) -> dict:
    """A fixed node at a place, or one on the vehicle of that name."""
    return {"id": name, "vehicle": place} if isinstance(place, str) else {"id": name, "position_m": place}


def hall_site(beacons: dict, microphones: dict, vehicles: tuple[str, ...], **more: object) -> Site:
    return Site.model_validate(
        {
            "site": {"name": "hall", "bounds_m": [[0, 0, 0], [12, 9, 3.5]]},
            "beacon": [node(*item) for item in beacons.items()],
            "microphone": [node(*item) for item in microphones.items()],
            "vehicle": [{"id": vehicle} for vehicle in vehicles],
            **more,
        }
    )


@dataclass(slots=True)
class Run:
    """A made-up run: recording, steps and truths."""

    recording: Recording
    steps: list[Step] = field(default_factory=list)
    truths: dict[str, Truth] = field(default_factory=dict)


Motion = Callable[[np.ndarray], np.ndarray]


def make_run(
    site: Site,
    motions: dict[str, Motion],
    duration_s: float = 24.0,
    period_s: float = 0.5,
    sd_m: float = 0.004,
    heard: float = 0.97,
    outliers: float = 0.01,
    yaw: bool = False,
    level: bool = False,
    seed: int = 1,
) -> Run:
    """Make a run: every beacon and microphone not on one vehicle is a pair, heard with the given probability."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.06, duration_s, period_s)
    run = Run(Recording(site))
    fine = np.linspace(0, duration_s, 2000)
    for name, motion in motions.items():
        way = motion(fine)
        run.truths[name] = Truth(name, fine, way, np.unwrap(_course(motion, fine)) if yaw else None)
    for index, t in enumerate(times):
        run.steps.append(_step(site, motions, index, float(t), sd_m, heard, outliers, yaw, level, rng))
    return run


def _course(motion: Motion, t: np.ndarray) -> np.ndarray:
    ahead = motion(t + 0.01) - motion(t - 0.01)
    return np.arctan2(ahead[:, 1], ahead[:, 0])


def _step(site, motions, index, t, sd_m, heard, outliers, yaw, level, rng) -> Step:
    pairs = [
        (beacon, microphone)
        for beacon in site.beacons
        for microphone in site.microphones
        if beacon.vehicle is None or beacon.vehicle != microphone.vehicle
    ]
    pairs = [pair for pair in pairs if rng.random() < heard]
    now = np.array([t])
    place = {vehicle: motion(now)[0] for vehicle, motion in motions.items()}
    at = lambda thing: np.array(thing.position_m) if thing.vehicle is None else place[thing.vehicle]  # noqa: E731
    apart = np.array([at(microphone) - at(beacon) for beacon, microphone in pairs]).reshape(-1, 3)
    true = np.linalg.norm(apart, axis=1)
    noise = sd_m * rng.standard_normal(len(pairs))
    wild = rng.random(len(pairs)) < outliers
    noise[wild] += 0.6 * rng.random(wild.sum()) + 0.2
    ranges = RangeEpoch(
        index,
        t - 0.06,
        tuple(beacon.id for beacon, _ in pairs),
        tuple(microphone.id for _, microphone in pairs),
        np.full(len(pairs), t),
        true + noise,
        np.eye(len(pairs)) * sd_m**2,
        None,
        None,
        None,
        "known",
        343.2,
    )
    fixes, estimates, used = [], [], np.zeros(len(pairs), bool)
    for name, motion in motions.items():
        own = np.array([name in (beacon.vehicle, microphone.vehicle) for beacon, microphone in pairs], bool)
        sign = np.array([1.0 if microphone.vehicle == name else -1.0 for _, microphone in pairs])
        states = ("x", "y") if level else ("x", "y", "z")
        rows = own & ~wild
        good = rows.sum() >= len(states)
        velocity = (motion(now + 0.01)[0] - motion(now - 0.01)[0]) / 0.02
        residual, position, covariance = np.full(len(pairs), np.nan), None, None
        if good:
            design = (sign[:, None] * apart / true[:, None])[:, : len(states)]
            inverse = np.linalg.inv(design[rows].T @ design[rows])
            error = inverse @ design[rows].T @ noise[rows]
            position = place[name] + np.pad(error, (0, 3 - len(states)))
            covariance = inverse * sd_m**2
            residual = np.where(own, noise - design @ error, np.nan)
            used |= rows
        fixes.append(
            Fix(
                t,
                name,
                "ok" if good else "too-few",
                "" if good else "Only two beacons were heard; a fix needs three: add beacons or bring them closer.",
                states if good else (),
                position,
                None,
                None,
                None,
                covariance,
                float(np.sqrt(np.trace(covariance[:2, :2])) / sd_m) if covariance is not None else None,
                None,
                None,
                None,
                rows & good,
                residual,
            )
        )
        if position is not None and covariance is not None:
            heading = float(_course(motion, now)[0]) if yaw else None
            estimates.append(
                Estimate(t, name, states, place[name] + 0.7 * (position - place[name]), velocity, heading, None,
                         covariance * 0.5, "fused")
            )  # fmt: skip
    events = (Event(t, "agv", "lost", "no fix for 2 s"),) if index == 20 else ()
    return Step(ranges, tuple(fixes), tuple(estimates), events, used, np.zeros(len(pairs)))


def loop(t: np.ndarray) -> np.ndarray:
    """A figure of eight through the hall, once in 24 s."""
    a = 2 * np.pi * t / 24
    return np.column_stack([6 + 4.4 * np.sin(a), 4.5 + 3.0 * np.sin(2 * a), np.full(np.shape(t), 0.4)])


def parked(t: np.ndarray) -> np.ndarray:
    return np.tile([3.1, 5.5, 0.4], (len(t), 1))


@pytest.fixture(scope="session")
def driving() -> Run:
    return make_run(hall_site(HALL, {"M1": "agv"}, ("agv",)), {"agv": loop}, yaw=True)


@pytest.fixture(scope="session")
def standing() -> Run:
    return make_run(hall_site(HALL, {"M1": "agv"}, ("agv",)), {"agv": parked}, sd_m=0.0008, duration_s=6)


@pytest.fixture(scope="session")
def lost() -> Run:
    two = dict(list(HALL.items())[:2])
    return make_run(hall_site(two, {"M1": "agv"}, ("agv",)), {"agv": loop}, duration_s=6)


@pytest.fixture(scope="session")
def team() -> Run:
    names = ("K", "R1", "R2")
    ways = {
        "K": lambda t: loop(t),
        "R1": lambda t: loop(np.asarray(t) * 0.5 + 9) * [0.8, 0.9, 1],
        "R2": lambda t: loop(-np.asarray(t) * 0.3 + 14) + [0.7, 0.3, 0],
    }
    site = hall_site(HALL, {f"m{name}": name for name in names}, names)
    return make_run(site, ways, sd_m=0.03)


@pytest.fixture(scope="session")
def sounding() -> Run:
    walls = {f"M{i}": place for i, place in enumerate([(2.3, -2.3, 0.5), (-2.3, -2.3, 0.5), (-2.3, 2.3, 0.5),
                                                         (2.3, 2.3, 0.5), (0.0, 2.3, 0.8)], 1)}  # fmt: skip
    site = hall_site({"car": "car"}, walls, ("car",), site={"name": "car"})
    way = lambda t: np.column_stack([1.5 * np.cos(t / 3), 1.1 * np.sin(t / 3), 0 * t + 0.3])  # noqa: E731
    run = make_run(site, {"car": way}, duration_s=12, sd_m=0.02, level=True)
    run.truths.clear()
    return run


@pytest.fixture(scope="session")
def long() -> Run:
    site = hall_site(HALL, {"M1": "agv"}, ("agv",))
    way = lambda t: loop(np.asarray(t) * 0.7) * (0.8 + 0.2 * np.cos(np.asarray(t) / 400))[:, None]  # noqa: E731
    return make_run(site, {"agv": way}, duration_s=2000, period_s=0.5, sd_m=0.06, heard=0.7)
