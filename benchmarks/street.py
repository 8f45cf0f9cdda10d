"""The whole street's benchmarks, each against a floor or a peer in the same run, accuracy beside time.

python benchmarks/street.py [--quick] [--into docs/benchmarks.md]: prints the tables that the documentation shows, and
puts them there.
"""

from __future__ import annotations

import os

# products of small matrices: threads would only wait for each other; set before NumPy is loaded
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

import channel  # noqa: E402
import fixes  # noqa: E402
import memory  # noqa: E402
import receiver  # noqa: E402
from measure import machine  # noqa: E402

MARK = "<!-- from here on as printed -->\n"


class Both:
    """Standard output that remembers what was printed."""

    def __init__(self) -> None:
        self.text, self._screen = "", sys.stdout

    def write(self, text: str) -> int:
        self.text += text
        return self._screen.write(text)

    def flush(self) -> None:
        self._screen.flush()


def main() -> None:
    """Run all benchmarks and print their tables."""
    parser = argparse.ArgumentParser(description="Benchmarks of the whole street; Markdown tables on stdout.")
    parser.add_argument("--quick", action="store_true", help="a fast look: fewer turns, no ten-minute recording")
    parser.add_argument("--into", type=Path, help="page whose tables to replace, after its mark")
    told = parser.parse_args()
    quick, begin = told.quick, time.perf_counter()
    sys.stdout = both = Both()
    print(f"Machine: {machine()}.")
    receiver.acquisition(turns=3 if quick else 15)
    channel.simulator(turns=2 if quick else 7)
    fixes.positions(count=50 if quick else 300, turns=2 if quick else 7)
    receiver.whole_run(20.0 if quick else 120.0, turns=1 if quick else 3)
    memory.peaks([20.0, 60.0] if quick else [60.0, 600.0])
    print(f"\nThe whole took {(time.perf_counter() - begin) / 60:.1f} minutes.")
    if told.into is not None:
        page = told.into.read_text("utf-8")
        told.into.write_text(page[: page.index(MARK) + len(MARK)] + "\n" + both.text, "utf-8")


if __name__ == "__main__":
    main()
