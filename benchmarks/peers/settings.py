"""What peers are told about each recording: each on its own, by someone who has seen its truth.

Noise and biases are round figures near what this very recording's truth shows, heading at the start included; the rest
is what brought them furthest of a handful tried. Ours is told nothing and runs on one set of defaults.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, pi

from peers.problem import Setting


@dataclass(frozen=True, slots=True)
class Told:
    """Settings of one recording: the plain filter, the filter with extra unknowns, and the batch."""

    plain: Setting
    extra: Setting
    graph: Setting


_LABYRINTH = Setting(0.1, way_sd=0.02, side_sd=0.02, turn_sd=0.05, gate=3.0, heading_rad=pi)
_LABYRINTH_EXTRA = replace(_LABYRINTH, bias="anchor", bias_m=0.1, bias_sd_m=0.1)
_PLAZA1 = Setting(0.5, way_sd=0.05, side_sd=0.02, turn_sd=0.0016, scale_sd=0.1)
_CARPARK = Setting(2.0, acceleration_psd=1e-4, gate=2.0, bias="anchor", bias_m=0.5, bias_sd_m=0.5, speed_sd_mps=0.1)
_TABLE = Setting(0.1, acceleration_psd=0.1)
_TABLE_EXTRA = replace(_TABLE, gate=3.0, bias="pair", bias_m=0.18, bias_sd_m=0.1)

TOLD = {
    "labyrinth": Told(_LABYRINTH, _LABYRINTH_EXTRA, replace(_LABYRINTH_EXTRA, robust=1.0)),
    "plaza1": Told(Setting(3.0, way_sd=0.02, side_sd=0.01, turn_sd=0.004), _PLAZA1, _PLAZA1),
    "carpark-513": Told(replace(_CARPARK, bias="", bias_m=0.0, gate=inf), _CARPARK, replace(_CARPARK, robust=1.5)),
    "table-fast": Told(_TABLE, _TABLE_EXTRA, _TABLE_EXTRA),
}
