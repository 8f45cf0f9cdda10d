"""What a run amounts to, counted step by step in little memory."""

from __future__ import annotations

from array import array
from collections import Counter
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from sonofix.cli.console import counted, length_text

if TYPE_CHECKING:
    from sonofix.records import Fix, RangeEpoch, Step
    from sonofix.site import Site


class Tally:
    """Counts of a run; `add` takes its steps, `rows` are for a table with a column a vehicle."""

    def __init__(self, site: Site) -> None:
        self.name = site.name
        self.vehicles = tuple(vehicle.id for vehicle in site.vehicles)
        self.epochs = 0
        self._of = {vehicle: _VehicleTally(site, vehicle) for vehicle in self.vehicles}
        self._heard = self._used = 0
        self._first_s: float | None = None
        self._last_s = -np.inf
        self._events: Counter[str] = Counter()
        self._remarks: Counter[str] = Counter()
        self._nis_rows, self._nis = array("d"), array("d")

    def add(self, step: Step) -> None:
        """Count one step."""
        self.epochs += 1
        self._heard += len(step.ranges)
        self._used += int(np.count_nonzero(step.range_used))
        self._first_s = step.ranges.sync_s if self._first_s is None else self._first_s
        self._last_s = max(self._last_s, step.ranges.sync_s, *step.ranges.time_s.tolist())
        self._events.update(event.event for event in step.events)
        for one in step.innovations:
            self._nis_rows.append(one.rows)
            self._nis.append(one.nis)
        for tally in self._of.values():
            tally.add(step)
        self._remarks.update(fix.remedy for fix in step.fixes if fix.status != "ok" and fix.remedy)

    def headline(self) -> str:
        """Return one line: epochs, time, ranges."""
        span_s = 0.0 if self._first_s is None else self._last_s - self._first_s
        span = f"{span_s:.1f}" if span_s < 100 else f"{span_s:.0f}"
        share = f" ({100 * self._used / self._heard:.0f} %)" if self._heard else ""
        return f"{counted(self.epochs, 'epoch')} in {span} s, {self._used} of {self._heard} ranges used{share}"

    def rows(self) -> dict[str, list[str]]:
        """Return the figures of each vehicle, by name."""
        every = list(self._of.values())
        return {
            "epochs with a fix": [f"{tally.fixed} / {self.epochs}" for tally in every],
            "heard an epoch (least … most)": [tally.heard_text() for tally in every],
            "ranges used / not used": [f"{tally.used} / {tally.rows - tally.used}" for tally in every],
            "range residuals, rms": [length_text(tally.residual_rms_m()) for tally in every],
            "HDOP, median": [_median(tally.hdop, ".2f") for tally in every],
            "sd of position (x, y), median": [length_text(median(tally.sd_m)) if tally.sd_m else "" for tally in every],
        }

    def remarks(self) -> list[str]:
        """Return lines on innovations, on events and on epochs without a fix."""
        from sonofix.score import score_innovations

        lines = []
        found = score_innovations(np.array(self._nis_rows), np.array(self._nis))
        if found is not None:
            above = f"{100 * found.above:.1f} % of corrections above their 95 % band"
            lines.append(
                f"NIS per measurement: {found.nis_per_row:.2f} (beyond 1 errors are stated too small), {above}"
            )
        if self._events:
            named = ", ".join(f"{count} {name}" for name, count in self._events.most_common())
            lines.append(f"Events: {named} (events.csv)")
        for remedy, count in self._remarks.most_common(3):
            lines.append(f"{counted(count, 'epoch')} without a sound fix: {remedy}")
        return lines


class _VehicleTally:
    """The counts of one vehicle."""

    def __init__(self, site: Site, vehicle: str) -> None:
        self._vehicle = vehicle
        self._sounds = {beacon.id for beacon in site.beacons if beacon.vehicle == vehicle}
        self._listens = {microphone.id for microphone in site.microphones if microphone.vehicle == vehicle}
        self.fixed = self.used = self.rows = self._residuals = 0
        self._residual_square_m2 = 0.0
        self._partners: Counter[int] = Counter()
        self.hdop, self.sd_m = array("d"), array("d")

    def add(self, step: Step) -> None:
        concerned = self._concerned(step.ranges)
        self.rows += len(concerned)
        self.used += int(np.count_nonzero(step.range_used[concerned]))
        ranges = step.ranges
        self._partners[
            len({ranges.emitter[i] if ranges.receiver[i] in self._listens else ranges.receiver[i] for i in concerned})
        ] += 1
        for fix in step.fixes:
            if fix.vehicle == self._vehicle:
                self._add_fix(fix)
        for estimate in step.estimates:
            sx, sy = estimate.sd("x"), estimate.sd("y")
            if estimate.vehicle == self._vehicle and sx is not None and sy is not None:
                self.sd_m.append(float(np.hypot(sx, sy)))

    def _concerned(self, ranges: RangeEpoch) -> list[int]:
        """Return the rows one of whose ends rides on the vehicle."""
        ends = zip(ranges.emitter, ranges.receiver, strict=True)
        return [i for i, (a, b) in enumerate(ends) if a in self._sounds or b in self._listens]

    def _add_fix(self, fix: Fix) -> None:
        if fix.status == "ok":
            self.fixed += 1
            if fix.hdop is not None:
                self.hdop.append(fix.hdop)
        residual = fix.residual_m[fix.used]
        residual = residual[np.isfinite(residual)]
        self._residuals += len(residual)
        self._residual_square_m2 += float(residual @ residual)

    def residual_rms_m(self) -> float | None:
        """Root mean square of the residuals that fixes rest on."""
        return (self._residual_square_m2 / self._residuals) ** 0.5 if self._residuals else None

    def heard_text(self) -> str:
        """Mean count of partners heard in an epoch, and the extremes."""
        total = sum(self._partners.values())
        if not total:
            return ""
        mean = sum(count * times for count, times in self._partners.items()) / total
        least, most = min(self._partners), max(self._partners)
        return f"{mean:.1f} ({least} … {most})" if least < most else f"{most}"


def _median(values: array[float], form: str) -> str:
    return f"{median(values):{form}}" if values else ""
