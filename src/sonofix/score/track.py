"""How good a track is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, Truth
from sonofix.score.columns import TrackColumns
from sonofix.score.poses import pose_at, tilt_at, within
from sonofix.score.ranges import rms

_VELOCITY_STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class TrackFigures:
    """Figures of one vehicle's track over the rows inside the truth's span; None where there is nothing to tell.

    ``inside_2sd`` is the share of rows with both x and y within two standard deviations (0.911 where these are right
    and x and y independent); ``nees_xy`` the mean normalised squared error of x and y (2 where the covariances are
    right; Bar-Shalom, Li and Kirubarajan 2001, section 5.4). ``longest_gap_s`` counts the truth's ends as rows. Roll
    and pitch are judged where both truth and track have them, with ``nees_attitude``, of roll, pitch and yaw by their
    deviations alone (3 where these are right).
    """

    rows: int
    rmse_xy_m: float
    median_xy_m: float
    p95_xy_m: float
    max_xy_m: float
    rmse_z_m: float | None
    rmse_yaw_rad: float | None
    velocity_rms_mps: float | None
    inside_2sd: float | None
    nees_xy: float | None
    longest_gap_s: float
    rmse_roll_rad: float | None = None
    rmse_pitch_rad: float | None = None
    nees_attitude: float | None = None


def score_track(truth: Truth, track: TrackColumns) -> TrackFigures | None:
    """Score a track against its vehicle's truth; None where no row lies inside the truth's span.

    Velocity (x and y) is against the central difference of the true position over 20 ms.
    """
    keep = within(truth, track.time_s) & np.isfinite(track.position_m[:, 0])
    if not keep.any():
        return None
    time, position = track.time_s[keep], track.position_m[keep]
    true_position, true_yaw = pose_at(truth, time)
    error = position - true_position
    away = np.hypot(error[:, 0], error[:, 1])
    moving = truth.time_s[-1] > truth.time_s[0]
    sd = np.sqrt(np.diagonal(track.covariance_m2[keep], axis1=1, axis2=2))
    turned = track.yaw_rad[keep] - true_yaw
    return TrackFigures(
        rows=int(keep.sum()),
        rmse_xy_m=float(np.sqrt(np.mean(away**2))),
        median_xy_m=float(np.median(away)),
        p95_xy_m=float(np.percentile(away, 95)),
        max_xy_m=float(away.max()),
        rmse_z_m=rms(error[:, 2]),
        rmse_yaw_rad=rms(np.angle(np.exp(1j * turned))) if truth.yaw_rad is not None else None,
        velocity_rms_mps=_velocity_rms_mps(truth, time, track.velocity_mps[keep]) if moving else None,
        inside_2sd=_inside(error, sd),
        nees_xy=_nees(error[:, :2], track.covariance_m2[keep][:, :2, :2]),
        longest_gap_s=_longest_gap_s(truth, time) if moving else 0.0,
        **_attitude(truth, time, track, keep),
    )


def _attitude(truth: Truth, time_s: Floats, track: TrackColumns, keep: NDArray[np.bool_]) -> dict[str, float | None]:
    """Figures of roll and pitch; none where truth or track has none."""
    if truth.roll_rad is None or truth.pitch_rad is None or truth.yaw_rad is None:
        return {}
    if track.roll_rad is None or track.pitch_rad is None or track.attitude_sd_rad is None:
        return {}
    told = np.column_stack([track.roll_rad, track.pitch_rad, track.yaw_rad])[keep]
    true = np.column_stack([*tilt_at(truth, time_s), pose_at(truth, time_s)[1]])
    wrong = np.angle(np.exp(1j * (told - true)))
    weighted = np.sum((wrong / track.attitude_sd_rad[keep]) ** 2, axis=1)
    known = np.isfinite(weighted)
    return {
        "rmse_roll_rad": rms(wrong[:, 0]),
        "rmse_pitch_rad": rms(wrong[:, 1]),
        "nees_attitude": float(np.mean(weighted[known])) if known.any() else None,
    }


def _velocity_rms_mps(truth: Truth, time_s: Floats, velocity_mps: Floats) -> float | None:
    before, after = (pose_at(truth, time_s + step)[0] for step in (-_VELOCITY_STEP_S, _VELOCITY_STEP_S))
    wrong = velocity_mps[:, :2] - (after - before)[:, :2] / (2 * _VELOCITY_STEP_S)
    of_one_axis = rms(wrong)
    return None if of_one_axis is None else of_one_axis * float(np.sqrt(2.0))


def _inside(error_m: Floats, sd_m: Floats) -> float | None:
    if not np.isfinite(sd_m[:, :2]).any():
        return None
    return float(np.mean((np.abs(error_m[:, :2]) < 2 * sd_m[:, :2]).all(axis=1)))


def _nees(error_m: Floats, covariance_m2: Floats) -> float | None:
    """Mean of ``eᵀ P⁻¹ e`` over the rows whose covariance is known and positive."""
    xx, yy, xy = covariance_m2[:, 0, 0], covariance_m2[:, 1, 1], covariance_m2[:, 0, 1]
    known = (xx > 0) & (yy > 0) & (xx * yy > xy**2)
    if not known.any():
        return None
    weighted = np.linalg.solve(covariance_m2[known], error_m[known][:, :, None])[:, :, 0]
    return float(np.mean(np.sum(error_m[known] * weighted, axis=1)))


def _longest_gap_s(truth: Truth, time_s: Floats) -> float:
    return float(np.max(np.diff(np.concatenate([truth.time_s[:1], np.sort(time_s), truth.time_s[-1:]]))))
