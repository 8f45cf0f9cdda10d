"""Two sets of real recordings of model cars: arrival residuals of the fixes, take by take.

Before: the strongest peak of each microphone's search is the arrival, as a plain matched filter has it.
After: the receiver.

python benchmarks/cars.py [FOLDER]    (FOLDER holds car-2014/ and car-2019-5k_15k/; default ../shared/data)
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from measure import table
from sonofix import flow, receiver
from sonofix.acquire.baseband import downconvert
from sonofix.acquire.plan import Plan
from sonofix.acquire.search import search
from sonofix.files import read_recording
from sonofix.records import Detection, Prediction, Recording

PEAK_SD_S = 30e-6
"""Deviation taken for a bare peak: a centimetre."""


@dataclass(frozen=True, slots=True)
class Result:
    """Fixes and epochs of one take, and the root mean square residual of what they rest on."""

    fixes: int
    epochs: int
    ranges: int
    residual_m: float

    @property
    def cells(self) -> tuple[str, str, str]:
        shown = f"{100 * self.residual_m:.2f} cm" if self.ranges else "-"
        return f"{self.fixes} of {self.epochs}", str(self.ranges), shown


def peaks(
    plan: Plan,
    samples: NDArray[np.float32],
    first_sample: int,
    receiver: str,
    windows: Mapping[str, tuple[float, float]],
    predictions: Mapping[str, Prediction] | None = None,
) -> tuple[tuple[Detection, ...], tuple[str, ...]]:
    """Stand in for `acquire`: of each burst the strongest peak of its search."""
    found: list[Detection] = []
    for band, banks in plan.bands:
        baseband, start_s = downconvert(samples, first_sample, band)
        for bank in banks:
            if bank.emitter not in windows:
                continue
            peak = search(baseband, start_s, bank, band, *windows[bank.emitter], [], plan.false_alarm_rate)
            if peak is None or peak.power < peak.threshold * peak.noise:
                continue
            arrival_s, beta = peak.start_s + bank.waveform.duration_s / 2, peak.range_rate_mps / plan.sound_speed_mps
            covariance = np.diag([PEAK_SD_S**2, (bank.step_mps / plan.sound_speed_mps) ** 2])
            found.append(Detection(bank.emitter, receiver, arrival_s, 1.0 - beta, covariance, np.sqrt(peak.power), 0.0))
    return tuple(found), ()


def result(recording: Recording) -> Result:
    """Run a take and gather what its fixes leave."""
    epochs = fixes = 0
    left: list[float] = []
    for step in flow.run(recording):
        epochs += 1
        for fix in step.fixes:
            if fix.status == "ok":
                fixes += 1
                left += fix.residual_m[fix.used].tolist()
    return Result(fixes, epochs, len(left), float(np.sqrt(np.mean(np.square(left)))) if left else 0.0)


def main() -> None:
    """Print the table."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2] / "shared" / "data"
    takes = sorted(p.parent for name in ("car-2014", "car-2019-5k_15k") for p in (folder / name).glob("*/site.toml"))
    if not takes:
        sys.exit(f"{folder} holds no car-2014/ or car-2019-5k_15k/; name the folder that does")
    rows = []
    for take in takes:
        after = result(read_recording(take))
        whole, receiver.acquire = receiver.acquire, peaks
        try:
            before = result(read_recording(take))
        finally:
            receiver.acquire = whole
        rows.append((f"{take.parent.name} {take.name}", *before.cells, *after.cells))
    columns = ("take", "fixes before", "ranges", "residual rms", "fixes after", "ranges", "residual rms")
    table("Model cars in real rooms: what fixes rest on, and what they leave", columns, rows)


if __name__ == "__main__":
    main()
