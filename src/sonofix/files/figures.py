"""What a recording's numbers look like before anything is computed from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Recording, ReferenceBurst
from sonofix.signals.waveform import chips_of
from sonofix.site import Beacon, ChirpCode, ReferenceCode, Site

BLOCK = 65536

# A 16-bit recorder's highest level is 1 - 2^-15; a clipped sound rarely reaches exactly that after resampling.
_FULL_SCALE = 0.9995
_FLAT_SHARE_OF_PEAK = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class CaptureFigures:
    """A capture's samples in figures, each array of shape (channels,).

    Attributes
    ----------
    sample_count : int
        That could be read.
    peak : float64
        Largest finite magnitude, full scale 1.
    rms : float64
    clipped : float64
        Share of samples at full scale, or in a flat run of three or more near the channel's peak.
    not_finite : int64
        Samples that are NaN or infinite.
    """

    sample_count: int
    peak: NDArray[np.float64]
    rms: NDArray[np.float64]
    clipped: NDArray[np.float64]
    not_finite: NDArray[np.int64]


def capture_figures(blocks: Callable[[int], Iterator[NDArray[np.float32]]]) -> CaptureFigures:
    """Read all samples once and return their figures."""
    count = 0
    peak = power = np.zeros(0)
    clipped = not_finite = np.zeros(0, np.int64)
    for block in blocks(BLOCK):
        if not count:
            peak, power = np.zeros(block.shape[1]), np.zeros(block.shape[1])
            clipped, not_finite = np.zeros(block.shape[1], np.int64), np.zeros(block.shape[1], np.int64)
        count += len(block)
        finite = np.isfinite(block)
        not_finite += np.count_nonzero(~finite, axis=0)
        level = np.abs(np.where(finite, block, 0.0)).astype(np.float64)
        peak = np.maximum(peak, level.max(axis=0))
        power += np.sum(level**2, axis=0)
        flat = np.zeros(level.shape, bool)
        same = (block[1:] == block[:-1]) & (level[1:] > _FLAT_SHARE_OF_PEAK * peak) & (peak > 0)
        flat[2:] = same[1:] & same[:-1]
        clipped += np.count_nonzero(flat | (level >= _FULL_SCALE), axis=0)
    return CaptureFigures(count, peak, np.sqrt(power / max(count, 1)), clipped / max(count, 1), not_finite)


def burst_s(site: Site, beacon: Beacon, reference: ReferenceBurst | None = None) -> float:
    """Return how long a beacon's burst lasts.

    Raises
    ------
    ValueError
        Where the beacon has no code, or its recorded reference is not given.
    """
    if isinstance(beacon.code, ChirpCode):
        return beacon.code.duration_s
    if isinstance(beacon.code, ReferenceCode) and reference is not None:
        return len(reference.samples) / reference.rate_hz - (beacon.code.start_s or 0.0)
    chips, signal = chips_of(beacon), site.signal_of(beacon)
    if chips is None or signal.cycles_per_chip is None:
        raise ValueError(f"beacon {beacon.id}: no code whose length could be told; give it chips, or its reference")
    return len(chips) * signal.cycles_per_chip / signal.carrier_hz


def epoch_count(recording: Recording, sample_count: int) -> int | None:
    """Return how many epochs the samples hold, None where the recording has none or states no period."""
    schedule = recording.site.schedule
    if recording.rate_hz is None:
        return None
    duration_s = sample_count / recording.rate_hz
    if recording.sync_s is not None:
        return int(np.count_nonzero((recording.sync_s >= 0) & (recording.sync_s < duration_s)))
    if schedule is None or schedule.period_s is None:
        return None
    return int(np.ceil(duration_s / schedule.period_s))
