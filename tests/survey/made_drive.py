"""Drives as a receiver would range them: made ranges and range rates, each at its own moment, with stated noise."""

from collections.abc import Callable

import numpy as np

from sonofix.records import RangeEpoch
from sonofix.site import Site

C = 343.2
BURST_S = 0.128
HALL = np.array(
    [[0, 0, 3.2], [5, 0.2, 2.9], [10, -0.1, 3.4], [10.2, 4, 3.0], [9.9, 8, 3.3], [5.1, 8.1, 2.8], [0, 7.9, 3.1]]
)


def wander(t):
    """Fill the hall: two incommensurate swings."""
    return np.stack([5 + 4.2 * np.sin(0.31 * t + 0.3), 4 + 3.1 * np.sin(0.47 * t), 0 * t], axis=-1)


def straight(t):
    return np.stack([0.5 + 0.22 * t, 2.5 + 0.08 * t, 0 * t], axis=-1)


def circle(t):
    return np.stack([5.2 + 2.5 * np.cos(0.35 * t), 4.1 + 2.5 * np.sin(0.35 * t), 0 * t], axis=-1)


def hall(places=HALL, sd_m=0.3, level=True, arms=((0.0, 0.0, 0.4),), **air) -> Site:
    sds = np.broadcast_to(sd_m, len(places))
    return Site.model_validate(
        {
            "name": "made",
            "air": {"sound_speed_mps": C, **air},
            "beacon": [
                {"id": f"B{i + 1}", "position_m": [float(v) for v in place], "position_sd_m": float(sd)}
                for i, (place, sd) in enumerate(zip(places, sds, strict=True))
            ],
            "vehicle": [{"id": "cart", **({"z_m": 0.0} if level else {})}],
            "microphone": [
                {"id": f"M{k + 1}", "vehicle": "cart", "lever_arm_m": list(arm)} for k, arm in enumerate(arms)
            ],
        }
    )


def heard(
    site: Site,
    places,
    way: Callable,
    count: int,
    rng: np.random.Generator,
    *,
    range_sd_m=7e-4,
    rate_sd_mps=3e-4,
    bias_m=0.0,
    sound_speed_mps=C,
    clock=None,
    rates=True,
    heard_share=1.0,
    period_s=0.5,
    yaw: Callable = lambda t: 0.0 * t,
) -> list[RangeEpoch]:
    """Range a drive; ``clock`` (offset in m, drift in m/s) makes it one with an unknown clock.

    ``sound_speed_mps`` is the true one; ranges are made with the site's.
    """
    stated = site.sound_speed_mps
    bias = np.broadcast_to(bias_m, len(places))
    epochs = []
    for index in range(count):
        sync = index * period_s
        times, ranges, speeds, emitters, receivers = [], [], [], [], []
        for microphone in site.microphones:
            arm = np.array(microphone.lever_arm_m)

            def at(t, arm=arm):
                turn = float(yaw(np.asarray(t)))
                cos, sin = np.cos(turn), np.sin(turn)
                return way(np.asarray(t)) + np.array([cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1], arm[2]])

            for i, place in enumerate(places):
                if rng.random() > heard_share:
                    continue
                t = sync + 0.02
                for _ in range(6):
                    t = sync + np.linalg.norm(at(t) - place) / sound_speed_mps
                h = 1e-4
                rate = (np.linalg.norm(at(t + h) - place) - np.linalg.norm(at(t - h) - place)) / (2 * h)
                scale = stated / sound_speed_mps
                offset = (0.0, 0.0) if clock is None else clock
                times.append(t)
                ranges.append(np.linalg.norm(at(t) - place) * scale + bias[i] + offset[0] + offset[1] * t)
                speeds.append(rate * scale + offset[1])
                emitters.append(site.beacons[i].id)
                receivers.append(microphone.id)
        n = len(times)
        if not n:
            continue
        epochs.append(
            RangeEpoch(
                index=index,
                sync_s=sync,
                emitter=tuple(emitters),
                receiver=tuple(receivers),
                time_s=np.array(times),
                range_m=np.array(ranges) + range_sd_m * rng.standard_normal(n),
                covariance_m2=np.eye(n) * range_sd_m**2,
                range_rate_mps=np.array(speeds) + rate_sd_mps * rng.standard_normal(n) if rates else None,
                range_rate_sd_mps=np.full(n, rate_sd_mps) if rates else None,
                snr_db=None,
                clock="known" if clock is None else "common",
                sound_speed_mps=stated,
            )
        )
    return epochs
