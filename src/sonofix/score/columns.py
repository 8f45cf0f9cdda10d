"""What is scored: ranges and tracks as columns of equal length, NaN where a row does not tell."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Estimate, Floats, Step


@dataclass(frozen=True, slots=True, eq=False)
class RangeColumns:
    """Ranges as a run states them, shape (n,) each.

    ``time_s`` is when the receiver hears the middle of the burst; ``range_m`` still holds ``clock_offset_m``; ``sd_m``,
    ``range_rate_mps`` and ``clock_offset_m`` are NaN where unknown; ``used`` marks rows that a position rests on.
    """

    time_s: Floats
    emitter: tuple[str, ...]
    receiver: tuple[str, ...]
    range_m: Floats
    sd_m: Floats
    range_rate_mps: Floats
    clock_offset_m: Floats
    used: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class TrackColumns:
    """The track of one vehicle's origin: ``time_s`` and ``yaw_rad`` (n,), ``position_m`` and ``velocity_mps`` (n, 3).

    ``covariance_m2`` (n, 3, 3) is that of the position; NaN in all that is not known. Where a file holds only standard
    deviations it is diagonal. ``roll_rad``, ``pitch_rad`` (n,) and ``attitude_sd_rad`` (n, 3), of roll, pitch and yaw,
    are None where no vehicle tilts.
    """

    time_s: Floats
    position_m: Floats
    velocity_mps: Floats
    yaw_rad: Floats
    covariance_m2: Floats
    roll_rad: Floats | None = None
    pitch_rad: Floats | None = None
    attitude_sd_rad: Floats | None = None


def range_columns(steps: Iterable[Step]) -> RangeColumns:
    """Return all ranges of a run, in the order of its steps."""
    steps = list(steps)

    def joined(parts: list[Floats]) -> Floats:
        return np.concatenate([np.zeros(0), *parts])

    return RangeColumns(
        time_s=joined([step.ranges.time_s for step in steps]),
        emitter=tuple(name for step in steps for name in step.ranges.emitter),
        receiver=tuple(name for step in steps for name in step.ranges.receiver),
        range_m=joined([step.ranges.range_m for step in steps]),
        sd_m=joined([np.sqrt(np.diagonal(step.ranges.covariance_m2)) for step in steps]),
        range_rate_mps=joined(
            [
                np.full(len(step.ranges), np.nan) if step.ranges.range_rate_mps is None else step.ranges.range_rate_mps
                for step in steps
            ]
        ),
        clock_offset_m=joined([step.range_clock_offset_m for step in steps]),
        used=np.concatenate([np.zeros(0, bool), *(step.range_used for step in steps)]),
    )


def track_columns(steps: Iterable[Step]) -> dict[str, TrackColumns]:
    """Return the track of each vehicle of a run, in order of time."""
    estimates: dict[str, list[Estimate]] = {}
    for step in steps:
        for estimate in step.estimates:
            estimates.setdefault(estimate.vehicle, []).append(estimate)
    return {vehicle: _columns(sorted(rows, key=lambda row: row.time_s)) for vehicle, rows in estimates.items()}


def _columns(rows: list[Estimate]) -> TrackColumns:
    covariance = np.full((len(rows), 3, 3), np.nan)
    for i, row in enumerate(rows):
        axes = [k for k, name in enumerate("xyz") if name in row.states]
        places = [row.states.index("xyz"[k]) for k in axes]
        covariance[i][np.ix_(axes, axes)] = row.covariance[np.ix_(places, places)]
    tilt: dict[str, Floats] = {}
    if any(row.roll_rad is not None for row in rows):
        sds = [_known(row.sd(state) for row in rows) for state in ("roll", "pitch", "yaw")]
        tilt = {
            "roll_rad": _known(row.roll_rad for row in rows),
            "pitch_rad": _known(row.pitch_rad for row in rows),
            "attitude_sd_rad": np.column_stack(sds),
        }
    return TrackColumns(
        time_s=np.array([row.time_s for row in rows]),
        position_m=np.array([row.position_m for row in rows]),
        velocity_mps=np.array([row.velocity_mps for row in rows]),
        yaw_rad=_known(row.yaw_rad for row in rows),
        covariance_m2=covariance,
        **tilt,
    )


def _known(values: Iterable[float | None]) -> Floats:
    return np.array([np.nan if value is None else value for value in values], float)
