"""Adaptive filters, ours beside padasip's on the very same samples, sample by sample.

python benchmarks/adaptive.py [--quick] [--into docs/studies.md]: prints one table, and puts it between its marks.
"""

from __future__ import annotations

import os

# products of small matrices: threads would only wait for each other; set before NumPy is loaded
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
from padasip.filters import FilterLMS, FilterNLMS, FilterRLS  # noqa: E402

from measure import in_turns, machine, renew, table  # noqa: E402
from sonofix.acquire.adaptive import Filtered, lms, nlms, rls  # noqa: E402
from sonofix.records import Floats  # noqa: E402

TAPS = 32
SAMPLES = 20_000
STEP, FLOOR, START = 1e-3, 1e-3, 10.0


def told(rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Input (n,), its windows (n, taps) latest first, as padasip wants them, and the desired output of a room."""
    x = rng.standard_normal(SAMPLES)
    windows = np.lib.stride_tricks.sliding_window_view(np.concatenate([np.zeros(TAPS - 1), x]), TAPS)[:, ::-1].copy()
    room = rng.standard_normal(TAPS) * 0.9 ** np.arange(TAPS)
    return x, windows, windows @ room + 0.1 * rng.standard_normal(SAMPLES)


def rows(turns: int) -> list[list[str]]:
    """Time each filter in turns with padasip's, and compare outputs and last taps."""
    x, windows, wanted = told(np.random.default_rng(3))
    jobs: dict[str, tuple[Callable[[], Filtered], Callable[[], tuple[Floats, Floats, Floats]], str]] = {
        "LMS": (
            lambda: lms(x, wanted, STEP, TAPS),
            lambda: FilterLMS(TAPS, STEP, w="zeros").run(wanted, windows),
            " (wanted: 50)",
        ),
        "NLMS": (
            lambda: nlms(x, wanted, 0.1, TAPS, FLOOR),
            lambda: FilterNLMS(TAPS, 0.1, eps=FLOOR, w="zeros").run(wanted, windows),
            "",
        ),
        "RLS": (
            lambda: rls(x, wanted, TAPS, 0.999, START),
            lambda: FilterRLS(TAPS, 0.999, eps=1 / START, w="zeros").run(wanted, windows),
            "",
        ),
    }
    out = []
    for name, (ours, theirs, goal) in jobs.items():
        mine, (output, error, _) = ours(), theirs()
        apart = max(float(np.abs(mine.output - output).max()), float(np.abs(mine.error - error).max()))
        times = in_turns({"ours": ours, "padasip": theirs}, turns)
        ns = {who: 1e9 * float(np.median(t)) / SAMPLES for who, t in times.items()}
        over = float(np.median(times["padasip"] / times["ours"]))
        cells = [f"{ns['ours']:.0f} ns", f"{ns['padasip'] / 1e3:.1f} µs", f"{over:.0f} ×{goal}", f"{apart:.0e}"]
        out.append([name, *cells])
    return out


def main() -> None:
    """Print the table, and put it between its marks of a page where one is given."""
    parser = argparse.ArgumentParser(description="Adaptive filters beside padasip's; a Markdown table on stdout.")
    parser.add_argument("--quick", action="store_true", help="fewer turns")
    parser.add_argument("--into", type=Path, help="page whose table to replace, between its marks")
    asked = parser.parse_args()
    turns = 3 if asked.quick else 15
    with renew(asked.into, "benchmarks/adaptive.py"):
        print(f"Machine: {machine()}.")
        columns = ("filter", "ours, a sample", "padasip, a sample", "padasip over ours", "outputs apart")
        table(f"Adaptive filters, {TAPS} taps", columns, rows(turns))
        print(
            f"\nMedians of {turns} turns of {SAMPLES} samples in double precision, the same samples, step and start; "
            "×: turn by turn. padasip keeps every sample's taps and takes its windows ready-made, which is not counted."
        )


if __name__ == "__main__":
    main()
