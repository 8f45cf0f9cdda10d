"""Sites to plan for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sonofix.plan.budget import Budget
from sonofix.plan.quality import Nodes, Terms, nodes_of
from sonofix.records import Walls
from sonofix.signals.codes import primitive_taps
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

ROOM = ((0.0, 0.0, 0.0), (14.0, 9.0, 4.0))
CORNERS = [(0.5, 0.5, 3.8), (13.5, 0.5, 3.8), (13.5, 8.5, 3.5), (0.5, 8.5, 3.5)]
BUDGET = Budget(level=0.5, noise_sd=0.01, rate_hz=96e3)


def made(
    beacons: Sequence[tuple[float, float, float]] = tuple(CORNERS), degree: int = 7, free: bool = False, **changes
) -> Site:
    taps = primitive_taps(degree)
    return Site.model_validate(
        {
            "name": "room",
            "bounds_m": ROOM,
            "air": {"sound_speed_mps": 343.2},
            "schedule": {"period_s": 0.2},
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10.0, "bandwidth_hz": 4e3},
            "vehicle": [{"id": "agv", "max_speed_mps": 0.5, **({} if free else {"z_m": 0.0})}],
            "microphone": [{"id": "M", "channel": 0, "vehicle": "agv", "lever_arm_m": (0.0, 0.0, 0.4)}],
            "beacon": [
                {
                    "id": f"B{i + 1}",
                    "position_m": place,
                    "code": {"family": "m-sequence", "degree": degree, "taps": taps[i]},
                }
                for i, place in enumerate(beacons)
            ],
            **changes,
        }
    )


def ready(site: Site, budget: Budget | None = BUDGET, walls: Walls | None = None, **terms) -> tuple[Nodes, Terms]:
    """Nodes of a site and what places are judged by."""
    nodes = nodes_of(site, budget, waveforms_of(site) if budget else {}, 3.0)
    given = {
        "sound_speed_mps": site.sound_speed_mps,
        "budget": budget,
        "free_level": site.vehicles[0].z_m is None,
        "bounds_m": np.array(site.bounds_m),
        "walls": walls or Walls.none(),
    }
    return nodes, Terms(**{**given, **terms})
