"""Made-up fleets: robots that circle among landmarks, with the errors that the filter is told to expect."""

from dataclasses import replace

import numpy as np

from sonofix.records import RangeRows, Recording, Table
from sonofix.site import Site
from sonofix.team.fleet import follow
from sonofix.team.state import SLIP_S, SLIP_SD
from sonofix.track.wheels import SLIP_M, TWIST_M, TWIST_RAD

LANDMARKS = ((0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0))


def fleet(
    robots: int = 3,
    seconds: float = 60.0,
    seed: int = 0,
    hears: tuple[int, ...] | None = None,
    turned_rad: float = 0.0,
    shift_m: tuple[float, float] = (0.0, 0.0),
    silent: dict[int, tuple[float, float]] | None = None,
    pushed: tuple[tuple[int, float, float, float], ...] = (),
    push_takes_s: float = 0.1,
    staying_m: float = 0.0,
    beside: bool = False,
    strays: float = 1.0,
) -> tuple[Recording, dict[str, np.ndarray]]:
    """Return a recording and, of each robot, true rows (time, x, y, yaw).

    ``hears``: robots that hear landmarks; ``silent``: spans in which nothing comes of a robot; ``pushed``: robots,
    when, and how far in x and y (and how long that takes); ``staying_m``: by how much ranges of one pair err
    besides, always the same; ``beside``: each landmark has another beside it, heard with the same such error;
    ``strays``: a factor on the variance of how places stray. Ranges err by 5 cm, bearings by 0.01 rad, and odometry
    as `sonofix.team.kernel` and `.state` have it.
    """
    rng = np.random.default_rng(seed)
    silent, dt = silent or {}, 0.1
    time = np.arange(0.0, seconds, dt)
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    turn = np.array([[cos, -sin], [sin, cos]])
    stand = np.array(LANDMARKS)
    if beside:
        stand = np.vstack([stand, stand + [0.1, 0.1]])
    landmarks = stand @ turn.T + shift_m
    truth, odometry = [], []
    for r in range(robots):
        pose = np.array([2.0 + 1.5 * r, 2.0 + (r % 2), rng.uniform(-3, 3)])
        scale, twist, bias = rng.normal(0.05, 0.05), rng.normal(0.05, 0.05), rng.normal(0, 0.005)
        slips, left = rng.normal(0, SLIP_SD, 2), np.exp(-dt / SLIP_S)
        speed, rate = 0.4, 0.5 + 0.1 * r
        path, told = [], []
        for t in time:
            path.append(pose.copy())
            told.append((speed / (1 - scale - slips[0]), (rate + bias) / (1 - twist - slips[1])))
            slips = left * slips + rng.normal(0, SLIP_SD * np.sqrt(1 - left**2), 2)
            along = speed * dt + rng.normal(0, np.sqrt(strays * SLIP_M * speed * dt))
            across = rng.normal(0, np.sqrt(strays * SLIP_M * speed * dt))
            yaw = pose[2] + rate * dt / 2
            pose = pose + [along * np.cos(yaw) - across * np.sin(yaw), along * np.sin(yaw) + across * np.cos(yaw), 0.0]
            pose[2] += rate * dt + rng.normal(0, np.sqrt((TWIST_RAD * rate + TWIST_M * speed) * dt))
            for who, at_s, *by_m in pushed:
                if who == r and -dt / 2 < t - at_s < push_takes_s - dt / 2:
                    pose[:2] += np.array(by_m) * dt / push_takes_s
        truth.append(np.array(path))
        odometry.append(np.array(told))
    for path in truth:
        path[:, :2] = path[:, :2] @ turn.T + shift_m
        path[:, 2] += turned_rad
    rows = []
    errs = np.random.default_rng(seed + 1000).normal(0, staying_m, (robots, robots + len(LANDMARKS)))
    for k in range(0, len(time), 4):
        for to in range(robots):
            sources = [(f"R{r}", truth[r][k, :2], r) for r in range(robots) if r != to]
            if hears is None or to in hears:
                sources += [(f"L{i}", place, -1) for i, place in enumerate(landmarks)]
            for number, (name, place, who) in enumerate(sources):
                view = who if who >= 0 else robots + (number - robots + 1) % len(LANDMARKS)
                if any(a <= time[k] < b for q in (to, who) for a, b in [silent.get(q, (0.0, 0.0))]):
                    continue
                delta = place - truth[to][k, :2]
                bearing = np.arctan2(delta[1], delta[0]) - truth[to][k, 2]
                bearing -= 2 * np.pi * np.round(bearing / (2 * np.pi))
                noise = rng.normal(0, 0.05) + errs[to, view], rng.normal(0, 0.01)
                if np.hypot(*delta) < 6.0:
                    rows.append((time[k], name, f"R{to}", np.hypot(*delta) + noise[0], bearing + noise[1]))
    site = Site.model_validate(
        {
            "format": 1,
            "vehicle": [{"id": f"R{r}", "z_m": 0.0} for r in range(robots)],
            "beacon": [{"id": f"L{i}", "position_m": [*place, 0.0]} for i, place in enumerate(landmarks.tolist())]
            + [{"id": f"R{r}", "vehicle": f"R{r}", "lever_arm_m": [0, 0, 0]} for r in range(robots)],
            "microphone": [{"id": f"R{r}", "vehicle": f"R{r}", "lever_arm_m": [0, 0, 0]} for r in range(robots)],
        }
    )
    t, emitter, receiver, ranges, bearings = zip(*rows, strict=True)
    kept = {r: ~((time >= silent.get(r, (0, 0))[0]) & (time < silent.get(r, (0, 0))[1])) for r in range(robots)}
    table = Table(
        {
            "time_s": np.concatenate([time[kept[r]] for r in range(robots)]),
            "v_mps": np.concatenate([odometry[r][kept[r], 0] for r in range(robots)]),
            "yaw_rate_radps": np.concatenate([odometry[r][kept[r], 1] for r in range(robots)]),
        },
        {"vehicle": tuple(f"R{r}" for r in range(robots) for _ in range(int(kept[r].sum())))},
    )
    heard = Table({"time_s": np.array(t), "bearing_rad": np.array(bearings)}, {"from": emitter, "to": receiver})
    stated = RangeRows(np.array(t), emitter, receiver, np.maximum(ranges, 0.0), None)
    recording = Recording(site, ranges=stated, tables={"odometry": table, "bearings": heard})
    return recording, {f"R{r}": np.column_stack([time, truth[r]]) for r in range(robots)}


def without_bearings(recording: Recording) -> Recording:
    """Return the recording with ranges alone."""
    return replace(recording, tables={name: t for name, t in recording.tables.items() if name != "bearings"})


def watched(feed):
    """Return the moments of a feed, the filter's means (moments, n) and what it believes at last."""
    moments, means, belief = [], [], None
    for moment, belief in follow(feed):
        moments.append(moment)
        means.append(belief.mean.copy())
    assert belief is not None
    return moments, np.array(means), belief


def errors(moments, truth: dict[str, np.ndarray], after_s: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return position errors (m, 2) and covariances (m, 2, 2) of all robots where they are placed."""
    found, spread = [], []
    for moment in moments:
        for r, rows in enumerate(truth.values()):
            if moment.placed[r] and after_s <= moment.time_s <= rows[-1, 0]:
                true = [np.interp(moment.time_s, rows[:, 0], rows[:, i]) for i in (1, 2)]
                found.append(moment.pose[r, :2] - true)
                spread.append(moment.covariance[r, :2, :2])
    return np.array(found), np.array(spread)


def nees(error: np.ndarray, covariance: np.ndarray) -> float:
    """Return the mean squared error over its covariance, 2 where that is right."""
    return float(np.mean(np.einsum("ij,ij->i", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])))
