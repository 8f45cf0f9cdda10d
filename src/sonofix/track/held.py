"""Switches of the states that calibrate themselves: which of them a track is to leave as they begin, at zero error."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats
from sonofix.track.inputs import Inputs

AIR = "sound-speed"
"""The one that the street follows, not the track."""

CALIBRATIONS = (
    AIR,
    "clock-drift",
    "odometry-scale",
    "odometry-bias",
    "step-length",
    "step-heading",
    "gyro-bias",
    "range-scale",
    "range-bias",
    "pair-bias",
)
"""What calibrates itself, each unless held: speed of sound (where a thermometer gives it); drift of the recorder's
clock; scale of odometry's speed and bias of its yaw rate; errors of steps' length and heading; a gyro's bias; scale and
bias that all stated ranges share; lasting bias of each pair."""


def places(names: Iterable[str], inputs: Inputs | None) -> NDArray[np.int64]:
    """Where the states of these names stand in a belief, as far as it has them; the clock's are counted from its end.

    Raises
    ------
    ValueError
        If a name is none of `CALIBRATIONS`.
    """
    asked = set(names)
    unknown = sorted(asked - set(CALIBRATIONS))
    if unknown:
        raise ValueError(f"{unknown[0]!r} is nothing that calibrates itself; what does: {', '.join(CALIBRATIONS)}")
    found = [-1] if "clock-drift" in asked else []
    if inputs is not None:
        kinds = ((inputs.step_slot, "step-length", 2), (inputs.step_slot, "step-heading", 3))
        kinds += ((inputs.wheel_slot, "odometry-scale", 3), (inputs.wheel_slot, "odometry-bias", 4))
        kinds += ((inputs.gyro_slot, "gyro-bias", 1),)
        for slots, name, behind in kinds:
            if name in asked:
                found += (slots[slots >= 0] + behind).tolist()
        if inputs.range_slot >= 0:
            at, count = inputs.range_slot, len(inputs.pairs)
            found += [at] * ("range-scale" in asked) + [at + 1] * ("range-bias" in asked)
            found += range(at + 2, at + 2 + count) if "pair-bias" in asked else ()
        if inputs.bias_slot >= 0 and "pair-bias" in asked:
            found += range(inputs.bias_slot, inputs.bias_slot + len(inputs.pairs))
    return np.array(sorted(found), np.int64)


def hold(covariance: Floats, held: NDArray[np.int64] | None, free: NDArray[np.bool_] | None = None) -> None:
    """Take what is not known of held states off a covariance, or a stack of them, in place; ``free`` they are not."""
    if held is None or not len(held):
        return
    covariance[..., held, :] = 0.0
    covariance[..., :, held] = 0.0
    if free is not None:
        free[held] = False
