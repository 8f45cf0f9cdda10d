"""Sites and epochs made from a known motion, for the tests of geometry, locate and track.

Ranges are found here by plain iteration of the definition, on their own: nothing of the package computes them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site

SPEED = 343.0

HALL = ((0.0, 0.0, 3.2), (10.0, 0.0, 2.4), (10.0, 8.0, 3.2), (0.0, 8.0, 2.4), (5.0, 0.0, 0.6), (5.0, 8.0, 0.9))
"""Six beacons on the walls of a hall of 10 m × 8 m, well spread in height."""

BOUNDS = ((0.0, 0.0, 0.0), (10.0, 8.0, 3.2))
ORIGIN_ARM = ((0.0, 0.0, 0.0),)


def make_site(
    fixed_m: ArrayLike,
    *,
    arms_m: Sequence[Sequence[float]] = ORIGIN_ARM,
    level_m: float | None = None,
    bounds_m: tuple | None = None,
    sounding: bool = False,
    position_sd_m: float = 0.0,
) -> Site:
    """One vehicle "v"; beacons B0… fixed and microphones M0… on it, or, sounding, the other way round."""
    walls = [{"position_m": [float(c) for c in p]} for p in np.atleast_2d(fixed_m)]
    arms = [{"vehicle": "v", "lever_arm_m": [float(c) for c in a]} for a in arms_m]
    beacons, microphones = (arms, walls) if sounding else (walls, arms)
    if position_sd_m:
        beacons = [b | {"position_sd_m": position_sd_m} for b in beacons]
    return Site.model_validate(
        {
            "name": "made",
            "bounds_m": bounds_m,
            "air": {"sound_speed_mps": SPEED},
            "vehicle": [{"id": "v"} if level_m is None else {"id": "v", "z_m": level_m}],
            "beacon": [{"id": f"B{i}"} | b for i, b in enumerate(beacons)],
            "microphone": [{"id": f"M{i}"} | m for i, m in enumerate(microphones)],
        }
    )


@dataclass(frozen=True)
class Drive:
    """Straight motion with an even turn, exact at every instant; time 0 is where `position_m` holds."""

    position_m: Sequence[float]
    velocity_mps: Sequence[float] = (0.0, 0.0, 0.0)
    yaw_rad: float = 0.0
    yaw_rate_radps: float = 0.0

    def origin(self, time_s: float) -> Floats:
        return np.asarray(self.position_m, float) + np.asarray(self.velocity_mps, float) * time_s

    def yaw(self, time_s: float) -> float:
        return self.yaw_rad + self.yaw_rate_radps * time_s

    def point(self, arm_m: Sequence[float], time_s: float) -> Floats:
        cos, sin = np.cos(self.yaw(time_s)), np.sin(self.yaw(time_s))
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return self.origin(time_s) + turn @ np.asarray(arm_m, float)


def heard_range_m(receiver: Callable[[float], Floats], emitter: Callable[[float], Floats], time_s: float) -> float:
    """The range by its definition: r = |p_receiver(t) − p_emitter(t − r / c)|, iterated until it stands still."""
    range_m = 0.0
    for _ in range(100):
        again = float(np.linalg.norm(receiver(time_s) - emitter(time_s - range_m / SPEED)))
        if abs(again - range_m) < 1e-14:
            break
        range_m = again
    return range_m


def ends(site: Site, drive: Drive, emitter: str, receiver: str) -> tuple[Callable, Callable]:
    """Return where the receiver and the emitter of a row are, as functions of time."""

    def place(node: object) -> Callable[[float], Floats]:
        if node.vehicle is None:  # type: ignore[attr-defined]
            return lambda t: np.asarray(node.position_m, float)  # type: ignore[attr-defined]
        return lambda t: drive.point(node.lever_arm_m, t)  # type: ignore[attr-defined]

    return place(site.microphone(receiver)), place(site.beacon(emitter))


def make_epoch(
    site: Site,
    drive: Drive,
    time_s: ArrayLike = 0.0,
    *,
    sd_m: float = 0.01,
    rate_sd_mps: float | None = None,
    clock_m: float | None = None,
    rng: np.random.Generator | None = None,
    stated: bool = False,
) -> RangeEpoch:
    """All pairs of a site, heard at ``time_s`` (one for all, or a row each); noise only where a generator is given.

    ``stated`` makes ranges as others state them, without a strength of what was heard.
    """
    pairs = [(b.id, m.id) for b in site.beacons for m in site.microphones]
    times = np.broadcast_to(np.asarray(time_s, float), (len(pairs),)).copy()
    ranges, rates = np.zeros(len(pairs)), np.zeros(len(pairs))
    step = 1e-4
    for i, (pair, t) in enumerate(zip(pairs, times, strict=True)):
        receiver, emitter = ends(site, drive, *pair)
        ranges[i] = heard_range_m(receiver, emitter, t)
        if rate_sd_mps is not None:
            after, before = (heard_range_m(receiver, emitter, t + s) for s in (step, -step))
            rates[i] = (after - before) / (2 * step)
    if rng is not None:
        ranges = ranges + sd_m * rng.standard_normal(len(pairs))
        rates = rates + (rate_sd_mps or 0.0) * rng.standard_normal(len(pairs))
    return RangeEpoch(
        index=0,
        sync_s=float(times.min()) if len(times) else 0.0,
        emitter=tuple(p[0] for p in pairs),
        receiver=tuple(p[1] for p in pairs),
        time_s=times,
        range_m=ranges + (clock_m or 0.0),
        covariance_m2=sd_m**2 * np.eye(len(pairs)),
        range_rate_mps=rates if rate_sd_mps is not None else None,
        range_rate_sd_mps=np.full(len(pairs), rate_sd_mps) if rate_sd_mps is not None else None,
        snr_db=None if stated else np.full(len(pairs), 20.0),
        clock="known" if clock_m is None else "common",
        sound_speed_mps=SPEED,
    )


def rows_of(epoch: RangeEpoch, keep: ArrayLike) -> RangeEpoch:
    """Some rows of an epoch, in the order given."""
    at = np.atleast_1d(np.asarray(keep, int))

    def pick(values: Floats | None) -> Floats | None:
        return None if values is None else values[at]

    return replace(
        epoch,
        emitter=tuple(epoch.emitter[i] for i in at),
        receiver=tuple(epoch.receiver[i] for i in at),
        time_s=epoch.time_s[at],
        range_m=epoch.range_m[at],
        covariance_m2=epoch.covariance_m2[np.ix_(at, at)],
        range_rate_mps=pick(epoch.range_rate_mps),
        range_rate_sd_mps=pick(epoch.range_rate_sd_mps),
        snr_db=pick(epoch.snr_db),
    )


def shifted(epoch: RangeEpoch, row: int, by_m: float) -> RangeEpoch:
    """One row's range made wrong, as an echo makes it."""
    range_m = epoch.range_m.copy()
    range_m[row] += by_m
    return replace(epoch, range_m=range_m)
