"""What robots tell each other: a pose with its doubt, in a packet that a radio of a few kilobits could carry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonofix.records import Floats
from sonofix.team.state import BIAS, OFFSET, SCALE, YAW, X, Y

SENT = (X, Y, YAW, SCALE, BIAS, OFFSET)
"""States that are told: the pose, and the errors of what the robot hears; besides, that of the range it just measured,
which stays with its pair."""

TOLD = len(SENT) + 1

_UPPER = np.triu_indices(TOLD)
_LAYOUT = np.dtype(
    [
        ("sender", "<u2"),
        ("time_s", "<f8"),
        ("mean", "<f8", 3),
        ("errors", "<f4", TOLD - 3),
        ("covariance", "<f4", len(_UPPER[0])),
        ("dependent", "<f4", len(_UPPER[0])),
        ("measured", "<f4", 4),
    ]
)
BYTES = _LAYOUT.itemsize
"""Size of a message."""

ROUNDING = 1e-5
"""By so much of itself a covariance is widened for what single precision rounds off."""


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One robot's word.

    Attributes
    ----------
    sender : int
    time_s : float
    mean : float64 (TOLD,)
        Of `SENT` and the pair's error; zeros for that where nothing was measured.
    covariance, dependent : float64 (TOLD, TOLD)
        Of these; and the part of it that others may share, since it was told before or came from them.
    measured : float64 (4,)
        Range and bearing that it measured of whom it answers, and the variances it takes for them; NaN: nothing.
    """

    sender: int
    time_s: float
    mean: Floats
    covariance: Floats
    dependent: Floats
    measured: Floats

    def pack(self) -> bytes:
        """Return the packet."""
        row = np.zeros((), _LAYOUT)
        row["sender"], row["time_s"] = self.sender, self.time_s
        row["mean"], row["errors"] = self.mean[:3], self.mean[3:]
        row["covariance"], row["dependent"] = self.covariance[_UPPER], self.dependent[_UPPER]
        row["measured"] = self.measured
        return row.tobytes()


def unpack(packet: bytes) -> Message:
    """Read a packet."""
    row = np.frombuffer(packet, _LAYOUT)[0]

    def square(values: Floats) -> Floats:
        out = np.zeros((TOLD, TOLD))
        out[_UPPER] = values
        return out + np.triu(out, 1).T

    covariance = square(row["covariance"].astype(float))
    covariance += ROUNDING * np.diag(np.diag(covariance))
    mean = np.concatenate([row["mean"], row["errors"].astype(float)])
    dependent = square(row["dependent"].astype(float))
    return Message(int(row["sender"]), float(row["time_s"]), mean, covariance, dependent, row["measured"].astype(float))
