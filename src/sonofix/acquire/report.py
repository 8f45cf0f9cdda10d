"""What is told of a burst outside: a `Detection` from its fit."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from sonofix.acquire.refine import Burst
from sonofix.records import Detection, Floats, Path, Waveform


@lru_cache(maxsize=256)
def mean_power(w: Waveform) -> float:
    """Of a burst of unit gain, from its first chip to its last."""
    inside = slice(int(-w.start_s * w.rate_hz), int((w.duration_s - w.start_s) * w.rate_hz))
    return float(np.mean(np.abs(w.envelope[inside]) ** 2))


def detection_of(
    emitter: str, waveform: Waveform, burst: Burst, own: list[Burst], covariance: Floats, noise: float, receiver: str
) -> Detection:
    """Report an emitter by one path.

    Parameters
    ----------
    waveform : Waveform
        That the emitter sends.
    burst : Burst
        The path that is the range.
    own : list of Burst
        All paths of this emitter, that one among them.
    covariance : float64 (2, 2)
        Of arrival (s) and β.
    noise : float
        Power in the pass band.
    receiver : str
        The microphone's id.
    """
    power = abs(burst.gain) ** 2 * mean_power(waveform)
    swung = np.diag([0.0, burst.swing_sd**2])
    paths = tuple(
        Path(
            b.arrival_s - burst.arrival_s,
            float(20 * np.log10(max(abs(b.gain), 1e-12) / max(abs(burst.gain), 1e-12))),
        )
        for b in own
    )
    return Detection(
        emitter=emitter,
        receiver=receiver,
        arrival_s=burst.arrival_s,
        time_scale=1.0 - burst.beta - burst.swing,
        # β and the time scale differ in sign
        covariance=covariance * np.array([[1.0, -1.0], [-1.0, 1.0]]) + swung,
        amplitude=abs(burst.gain),
        snr_db=float(10 * np.log10(max(power, 1e-30) / noise)),
        paths=paths,
    )
