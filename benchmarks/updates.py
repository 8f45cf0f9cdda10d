"""One predict and update of a filter, ours beside filterpy's and Stone Soup's on the very same numbers.

python benchmarks/updates.py [--quick] [--into docs/benchmarks.md]: prints one table, and puts it between its marks.
"""

from __future__ import annotations

import os

# products of small matrices: threads would only wait for each other; set before NumPy is loaded
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402

import numba  # noqa: E402
import numpy as np  # noqa: E402

from measure import in_turns, machine, renew, table  # noqa: E402
from peers.single import Linear, Task, Wheels, filterpy_step, stonesoup_step  # noqa: E402
from sonofix.geometry import POSE, Links  # noqa: E402
from sonofix.records import Floats, RangeEpoch  # noqa: E402
from sonofix.track.belief import Belief, Motion, predict  # noqa: E402
from sonofix.track.kernel import absorb  # noqa: E402
from sonofix.track.many import Crowd, age, correct, follow_many  # noqa: E402
from sonofix.track.update import update  # noqa: E402

VEHICLES = 1000
PERIOD_S = 0.1
RANGE_SD_M = 2e-3
ANCHORS_M = np.array([[x, y, z] for x in (0.5, 11.5) for y in (0.5, 8.5) for z in (1.0, 3.0)]) + np.array(
    [[0.0, 0.1 * i, 0.0] for i in range(8)]
)

Step = Callable[[], tuple[Floats, Floats]]
"""One predict and update; returns mean and covariance of the task's states."""


def driven_task(rng: np.random.Generator) -> Task:
    """Three states x, y, yaw, moved by odometry, and one range."""
    state, way, turn = np.array([4.0, 3.0, 0.7]), 0.1, 0.05
    covariance = np.diag([0.02, 0.02, 0.05]) ** 2
    noise = np.diag([2e-3, 2e-3, 1e-2]) ** 2
    return _task(state, covariance, Wheels(way, turn, noise), ANCHORS_M[:1], rng)


def flown_task(rng: np.random.Generator) -> Task:
    """Six states, position and velocity, disturbed by white acceleration, and eight ranges."""
    state = np.array([4.0, 3.0, 1.6, 0.8, -0.4, 0.1])
    covariance = np.diag([0.02, 0.02, 0.02, 0.1, 0.1, 0.05]) ** 2
    motion = Motion()
    density = np.array([motion.acceleration_psd, motion.acceleration_psd, motion.climb_psd])
    return _task(state, covariance, Linear(PERIOD_S, density), ANCHORS_M, rng)


def _task(
    state: Floats, covariance: Floats, motion: Wheels | Linear, anchors_m: Floats, rng: np.random.Generator
) -> Task:
    place = np.append(motion.moved(state)[0][:2], 0.0 if isinstance(motion, Wheels) else motion.moved(state)[0][2])
    range_m = np.linalg.norm(place - anchors_m, axis=1) + RANGE_SD_M * rng.standard_normal(len(anchors_m))
    return Task(state, covariance, motion, anchors_m, range_m, np.full(len(anchors_m), RANGE_SD_M))


def kernel_step(task: Task) -> Step:
    """Our compiled step: what `track.many` does for each vehicle; with wheels, `absorb` after a textbook prediction."""
    mean, covariance = np.empty_like(task.state), np.empty_like(task.covariance)
    variance, used = task.range_sd_m**2, np.zeros(len(task.range_m), bool)
    if isinstance(task.motion, Wheels):
        way, turn, noise = task.motion.way_m, task.motion.turn_rad, task.motion.noise
        return lambda: _driven(task.state, task.covariance, way, turn, noise, task.anchors_m, task.range_m, variance)
    dt, density = task.motion.dt_s, task.motion.density
    limits = np.full(len(variance) + 1, np.inf)

    def step() -> tuple[Floats, Floats]:
        mean[:], covariance[:] = task.state, task.covariance
        age(mean, covariance, dt, density)
        correct(mean, covariance, task.anchors_m, task.range_m, variance, 0.0, limits, used)
        return mean, covariance

    return step


@numba.njit(error_model="numpy")
def _driven(state, before, way_m, turn_rad, noise, anchors_m, range_m, variance):
    mean, covariance, row, work = state.copy(), before.copy(), np.zeros(3), np.empty((3, 3))
    middle = state[2] + turn_rad / 2
    along, across = way_m * np.cos(middle), way_m * np.sin(middle)
    mean[0] += along
    mean[1] += across
    mean[2] += turn_rad
    for k in range(3):
        covariance[0, k] -= across * covariance[2, k]
        covariance[1, k] += along * covariance[2, k]
    for k in range(3):
        covariance[k, 0] -= across * covariance[k, 2]
        covariance[k, 1] += along * covariance[k, 2]
    covariance += noise
    for i in range(len(range_m)):
        row[0], row[1] = mean[0] - anchors_m[i, 0], mean[1] - anchors_m[i, 1]
        distance = np.sqrt(row[0] ** 2 + row[1] ** 2 + anchors_m[i, 2] ** 2)
        row /= distance
        absorb(mean, covariance, row, range_m[i] - distance, variance[i], work)
    return mean, covariance


def street_step(task: Task) -> Step:
    """What a run does epoch by epoch, with room for attitude, sensors, clock and rows that share noise."""
    own = [0, 1, 2, 4, 5, 6]
    size = len(POSE) + 2
    mean, covariance, free = np.zeros(size), np.zeros((size, size)), np.zeros(size, bool)
    free[own] = True
    mean[own], covariance[np.ix_(own, own)] = task.state, task.covariance
    belief = Belief(0.0, mean, covariance, free, np.ones(1, bool))
    n = len(task.range_m)
    links = Links(np.full(n, -1), task.anchors_m, np.zeros(n, np.int64), np.zeros((n, 3)), np.zeros(n))
    epoch = RangeEpoch(
        index=0,
        sync_s=0.0,
        emitter=tuple(f"B{i}" for i in range(n)),
        receiver=("M",) * n,
        time_s=np.full(n, PERIOD_S),
        range_m=task.range_m,
        covariance_m2=np.diag(task.range_sd_m**2),
        range_rate_mps=None,
        range_rate_sd_mps=None,
        snr_db=np.zeros(n),
        clock="known",
        sound_speed_mps=343.0,
    )
    motion, asked, index = Motion(), np.ones(n, bool), np.ix_(own, own)

    def step() -> tuple[Floats, Floats]:
        after, *_ = update(predict(belief, PERIOD_S, motion), epoch, links, asked, iterations=1)
        return after.mean[own], after.covariance[index]

    return step


def crowd_step(tasks: list[Task]) -> Callable[[], Crowd]:
    """Our step of many vehicles in one call."""
    crowd = Crowd(
        0.0,
        np.array([task.state for task in tasks]),
        np.array([task.covariance for task in tasks]),
        np.zeros(len(tasks), np.int64),
    )
    ranges, anchors, variance = np.array([task.range_m for task in tasks]), tasks[0].anchors_m, tasks[0].range_sd_m ** 2
    return lambda: follow_many(crowd, PERIOD_S, anchors, ranges, variance)[0]


def rows(turns: int, repeats: int) -> list[list[str]]:
    """Time all on both tasks, and many vehicles at once."""
    rng, out = np.random.default_rng(7), []
    wheels, flight = driven_task(rng), flown_task(rng)
    for name, task, mine, goal in (
        ("3 states, 1 range", wheels, kernel_step(wheels), " (wanted: 5)"),
        ("6 states, 8 ranges", flight, kernel_step(flight), " (wanted: 15)"),
        ("the same in a run's own track", flight, street_step(flight), ""),
    ):
        steps = {"ours": mine, "filterpy": filterpy_step(task), "Stone Soup": stonesoup_step(task)}
        answers = {who: tuple(part.copy() for part in step()) for who, step in steps.items()}
        times = in_turns({who: _again(step, repeats) for who, step in steps.items()}, turns)
        us = {who: 1e6 * float(np.median(t)) / repeats for who, t in times.items()}
        over = {who: float(np.median(times[who] / times["ours"])) for who in ("filterpy", "Stone Soup")}
        out.append(
            [
                name,
                f"{us['ours']:.1f} µs{goal}",
                *(f"{us[who]:.0f} µs, {over[who]:.1f} ×" for who in over),
                f"{_apart(answers['ours'], answers['filterpy']):.0e}",
                f"{_apart(answers['Stone Soup'], answers['filterpy']):.0e}",
            ]
        )
    tasks = [flown_task(rng) for _ in range(VEHICLES)]
    few = [filterpy_step(task) for task in tasks[:50]]
    crowd = crowd_step(tasks)
    after = crowd()
    apart = max(_apart((after.mean[i], after.covariance[i]), step()) for i, step in enumerate(few))
    times = in_turns({"ours": crowd, "filterpy": lambda: [step() for step in few]}, max(9, turns // 2))
    took = float(np.median(times["ours"]))
    over = np.median(times["filterpy"] / times["ours"]) * len(tasks) / len(few)
    pace = VEHICLES * len(ANCHORS_M) / took
    cells = [
        f"{1e6 * took / VEHICLES:.2g} µs a vehicle: {pace:.3g} ranges a second (wanted: 1e+06)",
        f"{over:.0f} ×",
        "",
        f"{apart:.0e}",
        "",
    ]
    out.append([f"{VEHICLES} vehicles at once, 6 states, 8 ranges each", *cells])
    return out


def _again(step: Step, repeats: int) -> Callable[[], None]:
    def job() -> None:
        for _ in range(repeats):
            step()

    return job


def _apart(one: tuple[Floats, Floats], other: tuple[Floats, Floats]) -> float:
    """Largest difference of mean (m, m/s) and, by its largest element, covariance."""
    return max(
        float(np.abs(a - b).max() / s) for a, b, s in zip(one, other, (1.0, np.abs(other[1]).max()), strict=True)
    )


def print_table(turns: int, repeats: int) -> None:
    """Print the table and what it rests on."""
    table(
        "One predict and update",
        ("problem", "ours", "filterpy", "Stone Soup", "ours apart from filterpy", "Stone Soup apart from it"),
        rows(turns, repeats),
    )
    print(
        f"\nMedians of {turns} turns of {repeats} calls; ×: times ours, turn by turn. All in double precision with "
        "Joseph's form and the same analytic derivatives, one linearisation; apart: largest difference in the mean "
        "(m, m/s), or in the covariance by its largest element. Peers step one vehicle after the "
        "other, on one core; many vehicles at once use all cores."
    )


def main() -> None:
    """Print the table, and put it between its marks of a page where one is given."""
    parser = argparse.ArgumentParser(description="One predict and update beside peers; a Markdown table on stdout.")
    parser.add_argument("--quick", action="store_true", help="fewer turns")
    parser.add_argument("--into", type=Path, help="page whose table to replace, between its marks")
    told = parser.parse_args()
    with renew(told.into, "benchmarks/updates.py"):
        print(f"Machine: {machine()}.")
        print_table(*((5, 50) if told.quick else (41, 200)))


if __name__ == "__main__":
    main()
