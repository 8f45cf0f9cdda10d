"""What a team's filter estimates of each robot, and what is known of that before anything was heard."""

from __future__ import annotations

import numpy as np

from sonofix.track.stated import BIAS_SD_M, SCALE_SD
from sonofix.track.wheels import BIAS_PSD, BIAS_SD_RADPS

STATES = (
    "x",
    "y",
    "yaw",
    "speed_scale",
    "turn_scale",
    "turn_bias",
    "lag",
    "range_scale",
    "range_bias",
    "bearing_offset",
    "speed_slip",
    "turn_slip",
)
"""Of one robot, in m and rad: its pose; by what shares of themselves its odometry tells speed and yaw rate too high,
and the yaw rate that it tells at rest (rad/s); how much later (s) than told its wheels move it; and the errors of what
it hears: ranges are (1 + range_scale) r + range_bias, bearings bearing_offset too far left."""

SIZE = len(STATES)
X, Y, YAW, SPEED, TURN, DRIFT, LAG, SCALE, BIAS, OFFSET, SPEED_SLIP, TURN_SLIP = range(SIZE)

POSE = 3
"""The first so many are its pose."""

WHEEL_SCALE_SD = 0.1
"""Of either scale of odometry: tyres, loads and a slip that is always there."""

LAG_SD_S = 0.3
"""A controller and its motors take some tenths of a second, unless the wheels themselves are measured."""

OFFSET_SD_RAD = 0.05
"""How straight a receiver that tells directions is mounted."""

SCALE_PSD = 1e-5
"""In 1/s, how the scales wander: floors, loads and batteries change."""

SLIP_SD = 0.1
"""Of the share by which a robot slips, more or less than it mostly does."""

SLIP_S = 3.0
"""How long it does so: a turn, a start, a patch of floor."""

SETTLED_PSD = 1e-10
"""In units² a second: what stays as it is may still change so much, which keeps covariances well conditioned."""


def prior(robots: int, own_ranges: bool, scale_sd: float = 0.0) -> np.ndarray:
    """Return the covariance (SIZE V, SIZE V) of V robots' errors before anything was heard; of poses it holds nothing.

    ``own_ranges``: ranges are the receiver's own, whose errors the site file states, so none are sought but one that
    all ranges share, as their sound speed is off: a scale of deviation ``scale_sd``, the same for all robots.
    """
    scale, bias = (scale_sd, 0.0) if own_ranges else (SCALE_SD, BIAS_SD_M)
    errors = (WHEEL_SCALE_SD, WHEEL_SCALE_SD, BIAS_SD_RADPS, LAG_SD_S, scale, bias, OFFSET_SD_RAD, SLIP_SD, SLIP_SD)
    covariance = np.diag(np.tile([0.0, 0.0, 0.0, *np.square(errors)], robots))
    if own_ranges:
        covariance[SCALE::SIZE, SCALE::SIZE] = scale_sd**2
    return covariance


def wander_psd(own_ranges: bool) -> np.ndarray:
    """Return how fast each state wanders by itself (SIZE,), in units² a second; the pose does not."""
    heard = 0.0 if own_ranges else SETTLED_PSD
    return np.array([0.0, 0.0, 0.0, SCALE_PSD, SCALE_PSD, BIAS_PSD, SETTLED_PSD, heard, heard, SETTLED_PSD, 0.0, 0.0])
