"""The receiver against the bare time of its own inverse FFTs and against the first seed's search; a run in real time.

python benchmarks/receiver.py [--quick]
"""

from __future__ import annotations

import os

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
# one core, and products of small matrices, for which threads would only wait; set before NumPy is loaded
for name in THREADS:
    os.environ.setdefault(name, "1")

import argparse  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
import scipy.fft  # noqa: E402

from hall import LAP_S, PERIOD_S, RATE_HZ, laps, recorded  # noqa: E402
from measure import in_turns, machine, millimetres, milliseconds, once, rms, table  # noqa: E402
from sonofix.acquire.baseband import downconvert  # noqa: E402
from sonofix.acquire.epochs import reach_s  # noqa: E402
from sonofix.acquire.literal import analytic, column, search_literally, window_of  # noqa: E402
from sonofix.acquire.plan import Plan, acquire, make_plan  # noqa: E402
from sonofix.acquire.search import search  # noqa: E402
from sonofix.channel import Line  # noqa: E402
from sonofix.records import Detection, Floats, Prediction, Truth, Waveform  # noqa: E402
from sonofix.score import heard_range_m  # noqa: E402
from sonofix.signals.waveform import waveforms_of  # noqa: E402
from sonofix.site import Site  # noqa: E402

MAX_RATE_MPS = 2.2
EPOCH_S = 1.0
"""Start of the epoch looked at."""


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """One epoch of the hall's eight beacons, heard at 2 m/s, and what it takes to search it."""

    site: Site
    truth: Truth
    waveforms: dict[str, Waveform]
    plan: Plan
    samples: np.ndarray
    first: int
    reach: float

    @property
    def windows(self) -> dict[str, tuple[float, float]]:
        return {beacon: (EPOCH_S, EPOCH_S + self.reach) for beacon in self.waveforms}

    def range_error_m(self, beacon: str, starts_s: float) -> float:
        """Of a burst whose first chip is believed to be heard at ``starts_s``."""
        c = self.site.sound_speed_mps
        middle_s = starts_s + self.waveforms[beacon].duration_s / 2
        ends = self.site.beacon(beacon), self.site.microphone("M1")
        true_m = float(heard_range_m(*ends, {"agv": self.truth}, np.array([middle_s]), c)[0])
        return c * (starts_s - EPOCH_S) - true_m

    def errors_m(self, heard: tuple[Detection, ...]) -> Floats:
        half_s = {beacon: w.duration_s / 2 for beacon, w in self.waveforms.items()}
        return np.array([self.range_error_m(d.emitter, d.arrival_s - half_s[d.emitter]) for d in heard])


def one_epoch() -> Epoch:
    recording, truth = recorded(2.0, Line((2.0, 3.0, 0.0), (1.9, 0.6, 0.0)))
    site = recording.site
    waveforms, reach = waveforms_of(site), reach_s(site, site.sound_speed_mps)
    plan = make_plan(waveforms, RATE_HZ, site.sound_speed_mps, MAX_RATE_MPS)
    assert recording.blocks is not None
    samples = np.concatenate(list(recording.blocks(RATE_HZ)))[:, 0]
    begin = round((EPOCH_S - plan.margin_s) * RATE_HZ)
    end = round((EPOCH_S + reach + plan.burst_s + plan.margin_s) * RATE_HZ)
    return Epoch(site, truth, waveforms, plan, np.ascontiguousarray(samples[begin:end]), begin, reach)


def acquisition(turns: int) -> None:
    """Print search, cold epoch, warm epoch and the first seed's search, all over the same bare inverse FFTs."""
    epoch = one_epoch()
    plan, c = epoch.plan, epoch.site.sound_speed_mps
    ((band, banks),) = plan.bands
    baseband, start_s = downconvert(epoch.samples, epoch.first, band)

    def search_all() -> dict[str, float]:
        span = (EPOCH_S, EPOCH_S + epoch.reach)
        found = {b.emitter: search(baseband, start_s, b, band, *span, [], plan.false_alarm_rate) for b in banks}
        return {beacon: peak.start_s for beacon, peak in found.items() if peak is not None}

    # the transforms that a search cannot do without: one for each beacon and range rate, as long as its own
    length = banks[0].length(round(epoch.reach * band.rate_hz) + 1)
    rng = np.random.default_rng(0)
    rows = [rng.standard_normal((len(b.replicas), 2 * length), np.float32).view(np.complex64) for b in banks]
    count = sum(len(b.replicas) for b in banks)

    def floor() -> None:
        for surface in rows:
            scipy.fft.ifft(surface, axis=-1)

    cold, _ = acquire(plan, epoch.samples, epoch.first, "M1", epoch.windows)
    expected = {
        d.emitter: Prediction(d.emitter, "M1", d.arrival_s + 1e-4, 2e-4, c * (1 - d.time_scale) + 0.05, 0.1)
        for d in cold
    }
    warm, _ = acquire(plan, epoch.samples, epoch.first, "M1", epoch.windows, expected)
    times = in_turns(
        {
            "floor": floor,
            "cold search": search_all,
            "cold epoch": lambda: acquire(plan, epoch.samples, epoch.first, "M1", epoch.windows),
            "warm epoch": lambda: acquire(plan, epoch.samples, epoch.first, "M1", epoch.windows, expected),
        },
        turns,
    )
    alone = np.array([epoch.range_error_m(*found) for found in search_all().items()])
    errors = {"cold search": alone, "cold epoch": epoch.errors_m(cold), "warm epoch": epoch.errors_m(warm)}
    rates = len(banks[0].replicas)
    table(
        f"Acquisition, one core: one microphone, {len(banks)} beacons, ±{MAX_RATE_MPS:g} m/s ({rates} range rates), "
        "vehicle at 2 m/s",
        (
            "job",
            "time",
            "over its inverse FFTs",
            f"faster than real time ({PERIOD_S:g} s epochs)",
            "right",
            "range rms",
        ),
        [
            [
                job,
                milliseconds(float(np.median(times[job]))),
                f"{np.median(times[job] / times['floor']):.2f} ×",
                f"{PERIOD_S / np.median(times[job]):.1f} ×",
                *_right(error, len(banks)),
            ]
            for job, error in errors.items()
        ],
    )
    print(
        f"\nMedians of {turns} turns. Floor: {count} inverse transforms of {length} points (scipy.fft, complex64), "
        f"{milliseconds(float(np.median(times['floor'])))}. The search alone names the first sample of the highest "
        "peak, before any refinement or cancellation; it is right where within 10 cm."
    )
    _literal(epoch, banks[0].range_rate_mps, {job: float(np.median(t)) for job, t in times.items()}, whole=turns > 5)


def _right(error_m: Floats, count: int) -> list[str]:
    sure = np.abs(error_m) < 0.1
    return [f"{np.sum(sure)} / {count}", millimetres(rms(error_m[sure]))]


def _literal(epoch: Epoch, rates_mps: Floats, ours_s: dict[str, float], whole: bool) -> None:
    """Print the first seed's search of the same epoch, the same delays and range rates, at the full rate."""
    samples = epoch.samples[round(EPOCH_S * RATE_HZ) - epoch.first :]
    delays = round(epoch.reach * RATE_HZ)
    windows = {beacon: window_of(w, RATE_HZ) for beacon, w in epoch.waveforms.items()}
    carrier_hz = next(iter(epoch.waveforms.values())).carrier_hz
    frequencies_hz = carrier_hz * (1 - rates_mps / epoch.site.sound_speed_mps)
    found: dict[str, float] = {}

    def by_rows() -> None:
        for beacon, window in windows.items():
            cell = search_literally(samples, RATE_HZ, window, frequencies_hz, delays)
            found[beacon] = EPOCH_S + cell.delay / RATE_HZ

    positive, stride = analytic(samples), 1 if whole else 500
    searched = np.arange(0, delays, stride)
    by_delay: dict[str, float] = {}

    def by_columns() -> None:
        for beacon, window in windows.items():
            length = int(scipy.fft.next_fast_len(len(window)) or 0)
            inside = np.searchsorted(np.arange(length) * RATE_HZ / length, np.sort(frequencies_hz)[[0, -1]])
            near = slice(inside[0], inside[1])
            height = [column(positive, window, delay, length)[near].max() for delay in searched.tolist()]
            by_delay[beacon] = EPOCH_S + float(searched[np.argmax(height)]) / RATE_HZ

    rows_s, columns_s = once(by_rows), once(by_columns) * delays / len(searched)
    printed = _right(np.array([epoch.range_error_m(*one) for one in by_delay.items()]), len(windows))
    errors = np.array([epoch.range_error_m(*one) for one in found.items()])
    table(
        f"The first seed's search (eqs 4–6) of the same epoch: {RATE_HZ / 1e3:g} kHz, no stretch, {delays} delays",
        ("way", "time", "over our cold epoch", "over our warm epoch", "right", "range rms"),
        [
            [
                name,
                f"{seconds:.1f} s",
                f"{seconds / ours_s['cold epoch']:.0f} ×",
                f"{seconds / ours_s['warm epoch']:.0f} ×",
                *right,
            ]
            for name, seconds, right in (
                (
                    "as printed: a short-time Fourier transform, delay by delay",
                    columns_s,
                    printed if whole else [""] * 2,
                ),
                (
                    f"rearranged: {len(rates_mps)} frequencies, all delays of each at once",
                    rows_s,
                    _right(errors, len(windows)),
                ),
            )
        ],
    )
    reckoned = "" if whole else f" Delay by delay is reckoned from every {stride}th delay."
    print(
        "\nOne measurement. Delay by delay, its frequencies are a burst's reciprocal length apart; rearranged, those "
        f"of our range rates.{reckoned} Right: within 10 cm."
    )


def whole_run(length_s: float = 120.0, turns: int = 3) -> None:
    """Print `sonofix run` on a simulated recording, from start to exit, and what its parts take."""
    from sonofix.cli.score import score_run
    from sonofix.files import write_recording

    cases = {"without picture": "--no-plot", "with picture": "--plot"}
    # as a user starts it
    environment = {key: value for key, value in os.environ.items() if key not in THREADS}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "laps"
        recording, truth = laps(round(length_s / LAP_S))
        write_recording(folder, recording, {truth.vehicle: truth})

        def started(option: str) -> Callable[[], object]:
            command = [str(Path(sys.executable).with_name("sonofix")), "run", str(folder), option]
            return lambda: subprocess.run(command, check=True, capture_output=True, env=environment)

        times = in_turns({case: started(option) for case, option in cases.items()}, turns)
        scored = score_run(folder, folder / "out")
        parts = _parts(folder)
    assert scored.ranges is not None
    used, track = scored.ranges.used, scored.track["agv"]
    table(
        f"`sonofix run`, start to exit: {length_s:g} s of eight beacons at 192 kHz, {1 / PERIOD_S:g} epochs a second",
        ("", "wall time", "faster than real time", "ranges", "position"),
        [
            [
                case,
                f"{np.median(seconds):.2f} s",
                f"{length_s / np.median(seconds):.1f} ×",
                f"{used.count}, {millimetres(used.rms_m or 0.0)} rms, {used.beyond_5cm} beyond 5 cm",
                f"{millimetres(track.rmse_xy_m)} rms",
            ]
            for case, seconds in times.items()
        ],
    )
    rest = float(np.median(times["without picture"])) - sum(parts.values())
    shown = {**parts, "start, planning, summary and the rest": max(rest, 0.0)}
    print(
        "\nOf this, without picture: " + "; ".join(f"{part} {seconds:.2f} s" for part, seconds in shown.items()) + "."
    )


def _parts(folder: Path) -> dict[str, float]:
    """Time the parts of a run in this process, s, each call of them counted."""
    from sonofix import files, flow, receiver
    from sonofix.street import Street

    spent = {"reading": 0.0, "receiver": 0.0, "fixes and track": 0.0, "writing": 0.0}

    def counted(part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            begin = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                spent[part] += time.perf_counter() - begin

        return timed

    before = receiver.acquire, Street.walk
    receiver.acquire, Street.walk = counted("receiver", before[0]), counted("fixes and track", before[1])
    try:
        recording = files.read_recording(folder)
        steps = list(flow.run(recording))
    finally:
        receiver.acquire, Street.walk = before
    assert recording.blocks is not None
    blocks = recording.blocks
    spent["reading"] = once(lambda: sum(1 for _ in blocks(RATE_HZ)))
    spent["writing"] = once(lambda: files.write_run(folder / "again", steps, recording.site))
    return spent


def main() -> None:
    """Print the receiver's tables alone."""
    parser = argparse.ArgumentParser(description="Benchmarks of the receiver; Markdown tables on stdout.")
    parser.add_argument("--quick", action="store_true", help="a fast look: fewer turns, 20 s of recording")
    quick = parser.parse_args().quick
    print(f"Machine: {machine()}.")
    acquisition(turns=3 if quick else 31)
    whole_run(LAP_S if quick else 120.0, turns=1 if quick else 3)


if __name__ == "__main__":
    main()
