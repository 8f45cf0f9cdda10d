"""Two vehicles in one belief: what one knows of itself reaches the other by the range between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from locate.made_epochs import BOUNDS, HALL, Drive, heard_range_m, make_epoch, make_site
from sonofix.locate.fix import fix
from sonofix.records import Floats, RangeEpoch
from sonofix.site import Site
from sonofix.track.follow import Follower

PERIOD_S = 0.5


def two_robots() -> Site:
    return Site.model_validate(
        {
            "bounds_m": BOUNDS,
            "vehicle": [{"id": "a", "z_m": 0.0}, {"id": "b", "z_m": 0.0}],
            "beacon": [{"id": f"B{i}", "position_m": p} for i, p in enumerate(HALL)] + [{"id": "H", "vehicle": "b"}],
            "microphone": [{"id": "A", "vehicle": "a"}, {"id": "B", "vehicle": "b"}],
        }
    )


def robots_epoch(site: Site, a: Drive, b: Drive, time_s: float, rng: np.random.Generator, drop: str = "") -> RangeEpoch:
    """All that a and b hear of the walls' beacons, and a of b's."""
    ways: dict[str, Callable[[float], Floats]] = {"A": a.origin, "B": b.origin, "H": b.origin}
    ways |= {f"B{i}": (lambda t, p=p: np.array(p)) for i, p in enumerate(HALL)}
    pairs = [(f"B{i}", m) for m in "AB" for i in range(6) if m != drop] + [("H", "A")]
    n = len(pairs)
    ranges = np.array([heard_range_m(ways[m], ways[e], time_s) for e, m in pairs])
    plain = make_epoch(make_site(HALL), a, time_s)
    return replace(
        plain,
        emitter=tuple(p[0] for p in pairs),
        receiver=tuple(p[1] for p in pairs),
        time_s=np.full(n, time_s),
        range_m=ranges + 0.01 * rng.standard_normal(n),
        covariance_m2=0.01**2 * np.eye(n),
        snr_db=np.full(n, 20.0),
    )


def test_two_vehicles_are_followed_together_and_their_own_range_helps(rng: np.random.Generator) -> None:
    site = two_robots()
    a, b = Drive((2.0, 2.0, 0.0), (0.3, 0.2, 0.0)), Drive((8.0, 6.0, 0.0), (-0.2, 0.0, 0.0))
    follower = Follower(site)
    both = [robots_epoch(site, a, b, PERIOD_S * k, rng) for k in range(6)]
    deaf = [robots_epoch(site, a, b, PERIOD_S * k, rng, drop="A") for k in range(6, 10)]
    last = None
    for epoch in both + deaf:
        estimates, used, _ = follower.step(epoch, tuple(fix(epoch, site, v.id) for v in site.vehicles))
        assert used.all()
        for got, drive in zip(estimates, (a, b), strict=True):
            miss = (got.position_m - drive.origin(got.time_s))[:2]
            assert miss @ np.linalg.solve(got.covariance[:2, :2], miss) < 25
        last = estimates[0]
    # a hears only b at last: along their line it is known by that range, across it drifts
    assert last is not None
    line = a.origin(last.time_s) - b.origin(last.time_s)
    line = line[:2] / np.linalg.norm(line[:2])
    own = last.covariance[:2, :2]
    assert np.sqrt(line @ own @ line) < 0.03
    assert np.sqrt(np.trace(own) - line @ own @ line) > 0.3
