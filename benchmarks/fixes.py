"""Fixes a second against scipy.optimize.least_squares on the very same problems."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from measure import beside, millimetres, table
from sonofix.cli.demo import demo_site
from sonofix.locate.fix import fix
from sonofix.locate.many import Fixes, fix_many
from sonofix.records import RangeEpoch
from sonofix.site import Site

RANGE_SD_M, RATE_SD_MPS = 2e-3, 5e-3


def positions(count: int, turns: int) -> None:
    """Print both solvers' speed and error: level known with range rates, and 3-D with an unknown clock."""
    rows = []
    for name, site, clock, rates in (
        ("level known; ranges and range rates", demo_site(), False, True),
        ("3-D, clock unknown; ranges", _free(demo_site()), True, False),
    ):
        rng = np.random.default_rng(5)
        places = rng.uniform((1.0, 1.0, 0.0), (11.0, 8.0, 0.0 if site.vehicles[0].z_m is not None else 1.5), (count, 3))
        velocity = rng.uniform(-1.0, 1.0, (count, 3)) * (1.0, 1.0, 0.0 if site.vehicles[0].z_m is not None else 1.0)
        if not rates:
            velocity[:] = 0.0
        epochs = [_epoch(site, p, v, clock, rates, rng) for p, v in zip(places, velocity, strict=True)]
        unknowns = [0, 1] if site.vehicles[0].z_m is not None else [0, 1, 2]

        def ours(epochs: list[RangeEpoch] = epochs, site: Site = site) -> np.ndarray:
            found = [fix(epoch, site, "agv") for epoch in epochs]
            return np.array([np.full(3, np.nan) if f.position_m is None else f.position_m for f in found])

        def peer(epochs: list[RangeEpoch] = epochs, site: Site = site, clock: bool = clock) -> np.ndarray:
            return np.array([_least_squares(epoch, site, clock) for epoch in epochs])

        timed = beside(ours, peer, turns)
        error = [np.linalg.norm((job() - places)[:, unknowns], axis=1) for job in (ours, peer)]
        rows.append(
            [
                name,
                f"{count / timed.job_s:.0f}",
                f"{count / timed.floor_s:.0f}",
                f"{1 / timed.ratio:.2f} ×",
                *(
                    f"{np.count_nonzero(np.isfinite(e))} / {count}, {millimetres(float(np.sqrt(np.nanmean(e**2))))} rms"
                    for e in error
                ),
            ]
        )
    table(
        "Fixes: eight ranges of 2 mm, one core",
        ("problem", "fixes a second", "least_squares a second", "ratio", "ours: solved, error", "least_squares: same"),
        rows,
    )
    print(
        "\nA fix finds its own starting points and includes the tests for mirror solutions and for faulty ranges, "
        "covariance and DOP; least_squares is given the room's centre to start from and an analytic Jacobian (method "
        "lm), and gives the position alone."
    )
    many(max(20 * count, 10_000), turns)


def many(count: int, turns: int) -> None:
    """Print how many fixes a second one call for many epochs solves, beside least_squares epoch by epoch."""
    site, rng = demo_site(), np.random.default_rng(6)
    anchors, rows = _anchors(site), []
    for name, missing, faulty, wrong in (
        ("eight ranges each", 0.0, 0.0, 0),
        ("one range in ten not heard", 0.1, 0.0, 0),
        ("one epoch in a hundred with a wrong range", 0.0, 0.01, 1),
        ("every epoch with a wrong range", 0.0, 1.0, 1),
        ("every epoch with two wrong ranges", 0.0, 1.0, 2),
    ):
        places = rng.uniform((1.0, 1.0, 0.0), (11.0, 8.0, 0.0), (count, 3))
        ranges_m = np.linalg.norm(places[:, None] - anchors, axis=2)
        ranges_m += RANGE_SD_M * rng.standard_normal(ranges_m.shape)
        who = np.flatnonzero(rng.random(count) < faulty)
        hit = rng.permuted(np.tile(np.arange(len(anchors)), (len(who), 1)), axis=1)[:, :wrong]
        ranges_m[who[:, None], hit] += rng.uniform(0.1, 2.0, hit.shape)
        ranges_m[rng.random(ranges_m.shape) < missing] = np.nan
        variance = np.full(len(anchors), RANGE_SD_M**2)
        some = ranges_m[: count // 100]

        def ours(ranges_m: np.ndarray = ranges_m, variance: np.ndarray = variance) -> Fixes:
            return fix_many(anchors, ranges_m, variance, level_m=0.0)

        def peer(some: np.ndarray = some) -> np.ndarray:
            return np.array([_level_least_squares(anchors, r) for r in some])

        timed = beside(ours, peer, turns)
        found = ours()
        theirs = peer(np.where(found.used[: len(some)], some, np.nan)[found.status[: len(some)] == 0])
        apart_m = np.abs(found.position_m[: len(some), :2][found.status[: len(some)] == 0] - theirs).max()
        error_m = np.sqrt(np.nanmean(np.sum((found.position_m - places) ** 2, axis=1)))
        ours_hz, theirs_hz = count / timed.job_s, len(some) / timed.floor_s
        rows.append(
            [
                name,
                f"{ours_hz:.0f}",
                f"{theirs_hz:.0f}",
                f"{ours_hz / theirs_hz:.0f} ×",
                f"{apart_m:.0e} m",
                f"{np.count_nonzero(found.status == 0)} / {count}, {millimetres(float(error_m))} rms",
            ]
        )
    table(
        "Fixes by the thousand: `fix_many`, eight anchors, ranges of 2 mm, level and clock known, one core",
        ("epochs", "fixes a second", "least_squares a second", "ratio", "answers apart at most", "solved, error"),
        rows,
    )
    print(
        "\nWrong ranges are 0.1 to 2 m too long. Finding them is part of a fix's time; least_squares takes all ranges "
        "for good, once. Answers are compared where both take the same ranges: those that the fix has left."
    )


def _level_least_squares(anchors: np.ndarray, ranges_m: np.ndarray) -> np.ndarray:
    """Position on level 0 by scipy.optimize.least_squares, from the room's middle, analytic Jacobian."""
    heard = np.isfinite(ranges_m)
    anchors, ranges_m = anchors[heard], ranges_m[heard]

    def miss(place: np.ndarray) -> np.ndarray:
        return (np.sqrt(np.sum((place - anchors[:, :2]) ** 2, axis=1) + anchors[:, 2] ** 2) - ranges_m) / RANGE_SD_M

    def jacobian(place: np.ndarray) -> np.ndarray:
        away = place - anchors[:, :2]
        return away / np.sqrt(np.sum(away**2, axis=1) + anchors[:, 2] ** 2)[:, None] / RANGE_SD_M

    return least_squares(miss, [6.0, 4.5], jac=jacobian, method="lm", xtol=1e-12, ftol=1e-12).x


def _free(site: Site) -> Site:
    """Return the hall with a vehicle that flies and a clock that nobody knows; two beacons hang low for its height."""
    low = {"B2": 0.6, "B6": 0.4}
    beacons = [
        b.model_copy(update={"position_m": (*b.position_m[:2], low.get(b.id, b.position_m[2]))})
        for b in site.beacons
        if b.position_m is not None
    ]
    vehicles = [v.model_copy(update={"z_m": None}) for v in site.vehicles]
    schedule = site.schedule and site.schedule.model_copy(update={"synchronised": False})
    return site.model_copy(update={"beacons": tuple(beacons), "vehicles": tuple(vehicles), "schedule": schedule})


def _anchors(site: Site) -> np.ndarray:
    return np.array([b.position_m for b in site.beacons]) - np.array(site.microphones[0].lever_arm_m)


def _epoch(
    site: Site, place: np.ndarray, velocity: np.ndarray, clock: bool, rates: bool, rng: np.random.Generator
) -> RangeEpoch:
    away = place - _anchors(site)
    distance = np.linalg.norm(away, axis=1)
    n = len(distance)
    return RangeEpoch(
        index=0,
        sync_s=0.0,
        emitter=tuple(b.id for b in site.beacons),
        receiver=(site.microphones[0].id,) * n,
        time_s=np.full(n, 0.1),
        range_m=distance + (4.2 if clock else 0.0) + RANGE_SD_M * rng.standard_normal(n),
        covariance_m2=np.diag(np.full(n, RANGE_SD_M**2)),
        range_rate_mps=away @ velocity / distance + RATE_SD_MPS * rng.standard_normal(n) if rates else None,
        range_rate_sd_mps=np.full(n, RATE_SD_MPS) if rates else None,
        snr_db=None,
        clock="common" if clock else "known",
        sound_speed_mps=343.0,
    )


def _least_squares(epoch: RangeEpoch, site: Site, clock: bool) -> np.ndarray:
    """Position by scipy.optimize.least_squares, rows weighted as in the fix."""
    anchors = _anchors(site)
    flat = site.vehicles[0].z_m is not None
    rates = epoch.range_rate_mps
    dims = 2 if flat else 3

    def parts(state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        place = np.append(state[:2], 0.0) if flat else state[:3]
        away = place - anchors
        distance = np.sqrt(np.sum(away**2, axis=1))
        return away, distance, away / distance[:, None]

    def misfit(state: np.ndarray) -> np.ndarray:
        _, distance, unit = parts(state)
        miss = (epoch.range_m - distance - (state[dims] if clock else 0.0)) / RANGE_SD_M
        if rates is None:
            return miss
        return np.concatenate([miss, (rates - unit[:, :dims] @ state[dims:]) / RATE_SD_MPS])

    def jacobian(state: np.ndarray) -> np.ndarray:
        _, distance, unit = parts(state)
        block = -unit[:, :dims] / RANGE_SD_M
        if rates is None:
            return np.hstack([block, np.full((len(unit), 1), -1 / RANGE_SD_M)]) if clock else block
        speed = state[dims:]
        across = (speed - (unit[:, :dims] @ speed)[:, None] * unit[:, :dims]) / distance[:, None]
        upper = np.hstack([block, np.zeros_like(block)])
        return np.vstack([upper, -np.hstack([across, unit[:, :dims]]) / RATE_SD_MPS])

    start = np.array([6.0, 4.5, 0.8][:dims] + [0.0] * (1 if clock else dims if rates is not None else 0))
    found = least_squares(misfit, start, jac=jacobian, method="lm")
    return np.append(found.x[:2], 0.0) if flat else found.x[:3]
