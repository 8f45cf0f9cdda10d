"""Samples as they come: only those kept that an epoch still needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Stream:
    """The latest samples of a capture.

    Parameters
    ----------
    rate_hz : float
    lead_s : float
        Silence put before the first sample.

    Attributes
    ----------
    samples : float32 (n, channels)
    first : int
        Index of ``samples[0]`` in the capture; below 0 for the silence before it.
    """

    def __init__(self, rate_hz: float, lead_s: float = 0.0) -> None:
        self.rate_hz, self._lead = rate_hz, int(np.ceil(lead_s * rate_hz))
        self.samples = np.zeros((0, 0), np.float32)
        self.first = 0

    @property
    def end_s(self) -> float:
        """Up to when samples have come."""
        return (self.first + len(self.samples)) / self.rate_hz

    def add(self, block: NDArray[np.float32]) -> None:
        """Take in samples (n, channels)."""
        if not self.samples.size:
            self.samples, self.first = np.zeros((self._lead, block.shape[1]), np.float32), -self._lead
        self.samples = np.concatenate([self.samples, block])

    def between(self, begin_s: float, end_s: float) -> tuple[NDArray[np.float32], int]:
        """Return what there is of a stretch, and the index of its first sample in the capture."""
        begin = max(0, round(begin_s * self.rate_hz) - self.first)
        return self.samples[begin : round(end_s * self.rate_hz) - self.first], self.first + begin

    def forget(self, before_s: float = np.inf) -> None:
        """Let go of samples before an instant; the last one always stays."""
        drop = len(self.samples) - 1
        if np.isfinite(before_s):
            drop = min(drop, round(before_s * self.rate_hz) - self.first)
        if drop > 0:
            self.samples, self.first = self.samples[drop:], self.first + drop
