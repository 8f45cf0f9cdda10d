"""How good the ranges are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sonofix.records import Floats, Truth
from sonofix.score.columns import RangeColumns
from sonofix.score.poses import heard_range_m
from sonofix.site import Site

GROSS_M = 0.05
"""Errors beyond this are no longer the noise of a correlation peak but a wrong peak."""

_RATE_STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class ErrorFigures:
    """Errors (measured less true) in figures; None where there is nothing to tell.

    ``median_m`` keeps its sign: it is the bias. ``p95_m`` is of the absolute errors; ``rms_within_5cm_m`` leaves out
    the ``beyond_5cm`` gross ones.
    """

    count: int
    median_m: float | None
    rms_m: float | None
    p95_m: float | None
    beyond_5cm: int
    rms_within_5cm_m: float | None


@dataclass(frozen=True, slots=True)
class RangeFigures:
    """Figures of all ranges, and of those used.

    ``error_over_sd_rms`` is 1 where stated standard deviations are right. ``share_of_expected`` compares the used rows
    with one row an epoch and pair through the truth's span; None where the site states no period.
    """

    used: ErrorFigures
    every: ErrorFigures
    error_over_sd_rms: float | None
    range_rate_rms_mps: float | None
    share_of_expected: float | None


def score_ranges(site: Site, truths: Mapping[str, Truth], ranges: RangeColumns, sound_speed_mps: float) -> RangeFigures:
    """Score ranges against the truth.

    A row's error is ``range_m − clock_offset_m − |p_microphone(t) − p_beacon(t − range / c)|``; that of its rate is
    against the central difference of the true range over 20 ms. Rows of beacons or microphones that the site lacks, or
    whose vehicle has no truth, are not judged.

    Parameters
    ----------
    site : Site
    truths : mapping from vehicle to Truth
    ranges : RangeColumns
    sound_speed_mps : float
        Matters where beacons move only: it says how long ago the sound left.
    """
    true, rate = _true_ranges(site, truths, ranges, sound_speed_mps)
    error = ranges.range_m - np.nan_to_num(ranges.clock_offset_m) - true
    used = ranges.used
    return RangeFigures(
        used=error_figures(error[used]),
        every=error_figures(error),
        error_over_sd_rms=rms(error[used] / ranges.sd_m[used]),
        range_rate_rms_mps=rms((ranges.range_rate_mps - rate)[used]),
        share_of_expected=_share(site, truths, int(np.count_nonzero(used))),
    )


def error_figures(error_m: Floats) -> ErrorFigures:
    """Return the figures of errors; those not known (NaN) are left out."""
    error_m = error_m[np.isfinite(error_m)]
    if not len(error_m):
        return ErrorFigures(0, None, None, None, 0, None)
    core = error_m[np.abs(error_m) <= GROSS_M]
    return ErrorFigures(
        count=len(error_m),
        median_m=float(np.median(error_m)),
        rms_m=rms(error_m),
        p95_m=float(np.percentile(np.abs(error_m), 95)),
        beyond_5cm=len(error_m) - len(core),
        rms_within_5cm_m=rms(core),
    )


def rms(values: Floats) -> float | None:
    """Return the root of the mean square of the finite values; None where there are none."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _true_ranges(
    site: Site, truths: Mapping[str, Truth], ranges: RangeColumns, sound_speed_mps: float
) -> tuple[Floats, Floats]:
    """Return true ranges and range rates (n,), NaN where they cannot be known."""
    beacons = {node.id: node for node in site.beacons if node.vehicle is None or node.vehicle in truths}
    microphones = {node.id: node for node in site.microphones if node.vehicle is None or node.vehicle in truths}
    true, rate = np.full((2, len(ranges.time_s)), np.nan)
    pairs: dict[tuple[str, str], list[int]] = {}
    for i, pair in enumerate(zip(ranges.emitter, ranges.receiver, strict=True)):
        pairs.setdefault(pair, []).append(i)
    for (emitter, receiver), rows in pairs.items():
        if emitter not in beacons or receiver not in microphones:
            continue
        now = ranges.time_s[rows]
        here, before, after = (
            heard_range_m(beacons[emitter], microphones[receiver], truths, now + step, sound_speed_mps)
            for step in (0.0, -_RATE_STEP_S, _RATE_STEP_S)
        )
        true[rows], rate[rows] = here, (after - before) / (2 * _RATE_STEP_S)
    return true, rate


def _share(site: Site, truths: Mapping[str, Truth], count: int) -> float | None:
    if site.schedule is None or site.schedule.period_s is None or not truths:
        return None
    span_s = max(float(truth.time_s[-1] - truth.time_s[0]) for truth in truths.values())
    pairs = sum(
        1
        for beacon in site.beacons
        for microphone in site.microphones
        if beacon.vehicle is None or beacon.vehicle != microphone.vehicle
    )
    # the last quarter of a second cannot hold a whole burst and its way
    epochs = int((span_s - 0.25) / site.schedule.period_s + 1)
    return count / max(1, pairs * epochs)
