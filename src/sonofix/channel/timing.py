"""When bursts leave, on the recorder's clock.

The recorder's clock is the measure of everything: motions, truth and samples are told in it. Other clocks are
described as seen from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sonofix.records import Floats
from sonofix.site import Beacon


@dataclass(frozen=True, slots=True, eq=False)
class Timing:
    """Sync commands and the beacons' clocks.

    Sync command k comes at ``offset_s + k · period_s · (1 + drift)``, from k = ``first`` on at ``sync_s[k − first]``.

    Attributes
    ----------
    period_s : float
    synchronised : bool
        Whether each sync command starts the beacons afresh; else they run on their own after k = 0.
    offset_s, drift : float
        Of the beacons' common clock; a drift of 1e-6 makes its second a millionth longer than the recorder's.
    beacon_drift : mapping from beacon id to float
        What one beacon's clock adds to the drift.
    beacon_offset_s : mapping from beacon id to float
        By how much later than the common clock says one that runs on its own begins.
    first : int
    sync_s : float64 (epochs,)
        The sync commands from the recording's start to its end.
    """

    period_s: float
    synchronised: bool
    offset_s: float
    drift: float
    beacon_drift: Mapping[str, float] = field(default_factory=dict)
    first: int = 0
    sync_s: Floats = field(default_factory=lambda: np.zeros(0))
    beacon_offset_s: Mapping[str, float] = field(default_factory=dict)

    def stretch(self, beacon: Beacon) -> float:
        """Return the recorder's seconds for each second of the beacon's clock."""
        return 1.0 + self.drift + self.beacon_drift.get(beacon.id, 0.0)

    def starts_s(self, beacon: Beacon, from_s: float, to_s: float) -> Floats:
        """When bursts leave a beacon, at least all between two times, in order, (k,)."""
        stretch = self.stretch(beacon)
        late_s = self.beacon_offset_s.get(beacon.id, 0.0)
        slack = 2.0 * self.period_s + abs(beacon.offset_s) + abs(beacon.delay_s) + abs(late_s)
        low = int(np.floor((from_s - self.offset_s - slack) / (self.period_s * stretch)))
        high = int(np.ceil((to_s - self.offset_s + slack) / (self.period_s * stretch)))
        k = np.arange(low, high + 1).astype(np.float64)
        if not self.synchronised:
            return self.offset_s + late_s + (k * self.period_s + beacon.offset_s) * stretch + beacon.delay_s
        sync = self.offset_s + k * self.period_s * (1.0 + self.drift)
        listed = (k >= self.first) & (k < self.first + len(self.sync_s))
        sync[listed] = self.sync_s[k[listed].astype(int) - self.first]
        return sync + beacon.offset_s * stretch + beacon.delay_s


def timing_of(
    period_s: float,
    synchronised: bool,
    duration_s: float,
    *,
    offset_s: float = 0.0,
    drift: float = 0.0,
    beacon_drift: Mapping[str, float] | None = None,
    jitter_s: float = 0.0,
    beacon_offset_s: Mapping[str, float] | None = None,
    seed: int = 0,
) -> Timing:
    """Lay out the sync commands of one recording.

    ``jitter_s`` is the standard deviation of each sync command about its regular time (Gaussian, independent; cut at
    three). The beacons follow the command as it came.

    Raises
    ------
    ValueError
        If commands could overtake one another, or there are no sync commands to jitter.
    """
    if jitter_s < 0 or jitter_s > period_s / 10:
        raise ValueError(
            f"sync_jitter_s = {jitter_s:g}; it must lie from 0 to a tenth of the period, {period_s / 10:g} s"
        )
    if jitter_s and not synchronised:
        raise ValueError(f"sync_jitter_s = {jitter_s:g}, but the site's beacons are not synchronised; set it to 0")
    spacing = period_s * (1.0 + drift)
    first = int(np.ceil(-offset_s / spacing - 1e-9))
    last = max(int(np.ceil((duration_s - offset_s) / spacing - 1e-9)), first)
    k = np.arange(first, last).astype(np.float64)
    sync = offset_s + k * spacing
    if jitter_s:
        noise = np.random.default_rng([seed, 1]).standard_normal(len(k))
        sync = sync + jitter_s * np.clip(noise, -3.0, 3.0)
    late = dict(beacon_offset_s or {})
    return Timing(period_s, synchronised, offset_s, drift, dict(beacon_drift or {}), first, sync, late)
