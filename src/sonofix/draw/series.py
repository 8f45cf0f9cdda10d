"""What a picture needs of a run: steps laid out as arrays over time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Estimate, Event, Fix, Floats, Step


@dataclass(frozen=True, slots=True, eq=False)
class TrackSeries:
    """The estimates of one vehicle in time order.

    ``position_m``, ``velocity_mps`` (n, 3); ``yaw_rad`` (n,) NaN where unknown; ``covariance_m2`` (n, 3, 3) of the
    position, NaN in the rows of what is not estimated; ``predicted`` (n,) marks estimates without a measurement.
    """

    time_s: Floats
    position_m: Floats
    velocity_mps: Floats
    yaw_rad: Floats
    covariance_m2: Floats
    predicted: NDArray[np.bool_]

    def sd_m(self) -> Floats:
        """Return the standard deviations of x, y and z, shape (n, 3)."""
        return np.sqrt(np.diagonal(self.covariance_m2, axis1=1, axis2=2))


@dataclass(frozen=True, slots=True, eq=False)
class FixSeries:
    """The fixes of one vehicle that have a position: ``position_m`` (n, 3); ``sound`` (n,) where the status is ok."""

    time_s: Floats
    position_m: Floats
    sound: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class RangeSeries:
    """All range rows of a run, shape (n,) each.

    ``lane`` indexes ``Series.lanes``; ``residual_m`` is NaN where no fix judged the row.
    """

    time_s: Floats
    lane: NDArray[np.int64]
    residual_m: Floats
    used: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A run laid out for drawing."""

    tracks: dict[str, TrackSeries]
    fixes: dict[str, FixSeries]
    ranges: RangeSeries
    lanes: tuple[str, ...]
    lane_kind: str
    events: tuple[Event, ...]
    hdop: Floats
    remedies: tuple[str, ...]
    epoch_count: int
    fixed_epoch_count: int
    span_s: tuple[float, float]


def gather(steps: Sequence[Step]) -> Series:
    """Lay the steps of a run out as arrays.

    Rows of ranges are put in lanes: by emitter where several are heard by one receiver, by receiver where one emitter
    is heard by several, by pair otherwise; beyond 40 pairs by emitter.
    """
    estimates: dict[str, list[Estimate]] = {}
    fixes: dict[str, list[Fix]] = {}
    for step in steps:
        for estimate in step.estimates:
            estimates.setdefault(estimate.vehicle, []).append(estimate)
        for fix in step.fixes:
            fixes.setdefault(fix.vehicle, []).append(fix)
    ranges, lanes, kind = _ranges(steps)
    every_fix = [fix for of_vehicle in fixes.values() for fix in of_vehicle]
    moments = [step.ranges.sync_s for step in steps]
    moments += [float(t) for step in steps for t in step.ranges.time_s]
    moments += [estimate.time_s for of_vehicle in estimates.values() for estimate in of_vehicle]
    return Series(
        tracks={vehicle: _track(estimates[vehicle]) for vehicle in sorted(estimates, key=_by_number)},
        fixes={vehicle: _fixes(fixes[vehicle]) for vehicle in sorted(fixes, key=_by_number)},
        ranges=ranges,
        lanes=lanes,
        lane_kind=kind,
        events=tuple(event for step in steps for event in step.events),
        hdop=np.array([fix.hdop for fix in every_fix if fix.hdop is not None and fix.status == "ok"], np.float64),
        remedies=tuple(fix.remedy for fix in every_fix if fix.status != "ok" and fix.remedy),
        epoch_count=len(steps),
        fixed_epoch_count=sum(any(fix.status == "ok" for fix in step.fixes) for step in steps),
        span_s=(min(moments), max(moments)) if moments else (0.0, 0.0),
    )


def _track(rows: list[Estimate]) -> TrackSeries:
    rows = sorted(rows, key=lambda estimate: estimate.time_s)
    covariance = np.full((len(rows), 3, 3), np.nan)
    predicted = np.array([estimate.source == "predicted" for estimate in rows], bool)
    for i, estimate in enumerate(rows):
        axes = [k for k, name in enumerate("xyz") if name in estimate.states]
        places = [estimate.states.index("xyz"[k]) for k in axes]
        covariance[i][np.ix_(axes, axes)] = estimate.covariance[np.ix_(places, places)]
    return TrackSeries(
        time_s=np.array([estimate.time_s for estimate in rows]),
        position_m=np.array([estimate.position_m for estimate in rows]).reshape(-1, 3),
        velocity_mps=np.array([estimate.velocity_mps for estimate in rows]).reshape(-1, 3),
        yaw_rad=np.array([np.nan if estimate.yaw_rad is None else estimate.yaw_rad for estimate in rows]),
        covariance_m2=covariance,
        predicted=predicted & ~predicted.all(),  # on a grid of its own every row is predicted: nothing to tell apart
    )


def _fixes(rows: list[Fix]) -> FixSeries:
    placed = [fix for fix in rows if fix.position_m is not None]
    return FixSeries(
        time_s=np.array([fix.time_s for fix in placed], np.float64),
        position_m=np.array([fix.position_m for fix in placed], np.float64).reshape(-1, 3),
        sound=np.array([fix.status == "ok" for fix in placed], bool),
    )


def _ranges(steps: Sequence[Step]) -> tuple[RangeSeries, tuple[str, ...], str]:
    pairs = [pair for step in steps for pair in zip(step.ranges.emitter, step.ranges.receiver, strict=True)]
    emitters = list(dict.fromkeys(emitter for emitter, _ in pairs))
    receivers = list(dict.fromkeys(receiver for _, receiver in pairs))
    if len(receivers) > 1 and len(emitters) == 1:
        kind, keys = "microphone", [receiver for _, receiver in pairs]
    elif len(receivers) > 1 and len(set(pairs)) <= 40:
        kind, keys = "pair", [f"{emitter} → {receiver}" for emitter, receiver in pairs]
    else:
        kind, keys = "beacon", [emitter for emitter, _ in pairs]
    lanes = tuple(sorted(set(keys), key=_by_number))
    place = {key: i for i, key in enumerate(lanes)}
    residuals = [_residual(step) for step in steps]
    return (
        RangeSeries(
            time_s=np.concatenate([np.zeros(0), *(step.ranges.time_s for step in steps)]),
            lane=np.array([place[key] for key in keys], np.int64),
            residual_m=np.concatenate([np.zeros(0), *residuals]),
            used=np.concatenate([np.zeros(0, bool), *(np.asarray(step.range_used, bool) for step in steps)]),
        ),
        lanes,
        kind,
    )


def _residual(step: Step) -> Floats:
    """Return each row's residual against the fix that judged it, NaN where none did."""
    residual = np.full(len(step.ranges), np.nan)
    for fix in step.fixes:
        if fix.residual_m.shape == residual.shape:
            residual = np.where(np.isnan(residual), fix.residual_m, residual)
    return residual


def _by_number(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts B10 after B9."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]
