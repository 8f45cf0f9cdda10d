"""Fixes a second against scipy.optimize.least_squares on the very same problems."""

from __future__ import annotations

import numba
import numpy as np
from scipy.optimize import least_squares

from measure import beside, millimetres, table
from sonofix.cli.demo import demo_site
from sonofix.geometry import link
from sonofix.locate.dense import spread
from sonofix.locate.fix import fix
from sonofix.locate.noise import row_noise
from sonofix.locate.rows import gather
from sonofix.locate.search import MOST, search
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
    kernels(10 * count, turns)


@numba.njit(error_model="numpy")
def _solved(ends, dt, ranges_m, c, covariance, index, level_m, states, chi2s, jacobians, spreads, places) -> None:
    """Solve epoch after epoch on a known level and clock, without Python in between."""
    for e in range(len(ranges_m)):
        search((ends, dt, ranges_m[e]), c, False, covariance, index, True, level_m, states, chi2s, jacobians)
        spread(jacobians[0], spreads)
        places[e] = states[0, 0], states[0, 1]


def kernels(count: int, turns: int) -> None:
    """Print how many fixes a second the kernels solve where nothing of Python comes between two epochs."""
    site, rng = demo_site(), np.random.default_rng(6)
    places = rng.uniform((1.0, 1.0, 0.0), (11.0, 8.0, 0.0), (count, 3))
    epochs = [_epoch(site, p, np.zeros(3), False, False, rng) for p in places]
    first = epochs[0]
    links = link(site, first.emitter, first.receiver)
    rows, _, dt, ends, *_ = gather(links.ends, 0, first.time_s, first.range_m, False, first.sound_speed_mps)
    covariance = row_noise(first, links, rows, dt)
    ranges_m, index = np.array([e.range_m for e in epochs]), np.array([0, 1])
    level_m, found = float(site.vehicles[0].z_m or 0.0), np.empty((count, 2))
    states, chi2s, jacobians = np.empty((MOST, 10)), np.empty(MOST), np.empty((MOST, len(rows), 2))
    spreads = np.empty((2, 2))

    def ours() -> np.ndarray:
        at = (ends, dt, ranges_m, first.sound_speed_mps, covariance, index, level_m)
        _solved(*at, states, chi2s, jacobians, spreads, found)
        return found

    def whole() -> list[object]:
        return [fix(epoch, site, "agv") for epoch in epochs]

    timed = beside(ours, whole, turns)
    error_m = float(np.sqrt(np.mean(np.sum((ours() - places[:, :2]) ** 2, axis=1))))
    table(
        "Kernels alone: eight ranges of 2 mm, level and clock known, one core",
        ("fixes a second in one compiled loop", "error", "fixes a second by fix()"),
        [[f"{count / timed.job_s:.0f}", f"{millimetres(error_m)} rms", f"{count / timed.floor_s:.0f}"]],
    )
    print("\nThe loop finds its own starts, tells mirror solutions apart and gives covariances; fix() also judges.")


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
