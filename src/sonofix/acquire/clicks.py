"""Clicks and drop-outs: what is far above the rest of what is left, for far shorter than a burst."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

STANDS_UP = 10.0
"""Power over the median of what is left, both smoothed over ``SMOOTHED`` samples, that no burst leaves so briefly."""

SMOOTHED = 8

SHARE = 0.15
"""Of a burst's length: the longest click; of an epoch: the most that is set aside."""


def runs(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """First and past-the-last index (k, 2) of each run of True."""
    return np.flatnonzero(np.diff(np.pad(mask, 1))).reshape(-1, 2)


def find_clicks(left: NDArray[np.complexfloating], burst: float) -> NDArray[np.int64]:
    """Clicks (k, 2), first and past-the-last sample, in what bursts leave (n,); none where they do not explain it.

    Parameters
    ----------
    left : complex128 (n,)
    burst : float
        Length of the shortest burst, in samples.
    """
    power = np.abs(left) ** 2
    smooth = np.convolve(power, np.ones(SMOOTHED) / SMOOTHED, "same")
    found = runs(smooth > STANDS_UP * np.median(smooth[smooth > 0]))
    lengths = found[:, 1] - found[:, 0]
    found, lengths = found[lengths <= SHARE * burst], lengths[lengths <= SHARE * burst]
    held = sum(float(np.sum(power[begin:end])) for begin, end in found)
    # what echoes leave has its peaks too, but not most of its power in them
    return found if np.sum(lengths) <= SHARE * len(left) and held >= 0.5 * np.sum(power) else found[:0]
