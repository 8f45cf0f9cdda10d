"""Accuracy in the demonstration's hall, from kind conditions to unkind ones: the table of the README.

python benchmarks/accuracy.py [--into README.md]
"""

from __future__ import annotations

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse  # noqa: E402
from pathlib import Path  # noqa: E402

from hall import LAP_S, PERIOD_S, lap_motion, recorded  # noqa: E402
from sonofix.air import sound_speed_mps  # noqa: E402
from sonofix.channel import Tone  # noqa: E402
from sonofix.cli.console import length_text  # noqa: E402
from sonofix.flow import run  # noqa: E402
from sonofix.score import range_columns, score_ranges, score_track, track_columns  # noqa: E402

BEGIN, END = "<!-- printed by benchmarks/accuracy.py -->\n", "<!-- end of print -->"
CASES = {
    "`sonofix demo`: 6 dB SNR": {},
    "noise 16 dB stronger: −10 dB": {"snr_db": -10.0},
    "a tone of half full scale at 40.5 kHz": {"tone": Tone(40.5e3, 0.5)},
    "air 2 K warmer than the site file says": {"sound_speed_mps": float(sound_speed_mps(22.0))},
}


def rows() -> list[str]:
    """Run every case and return the lines of a Markdown table."""
    head = ("conditions", "bursts ranged and used", "range error, rms", "beyond 5 cm", "fixes", "position, rms", "95 %")
    out = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, conditions in CASES.items():
        recording, truth = recorded(LAP_S, lap_motion(), **conditions)
        steps = list(run(recording))
        truths = {truth.vehicle: truth}
        site = recording.site
        used = score_ranges(site, truths, range_columns(steps), site.sound_speed_mps).used
        track = score_track(truth, track_columns(steps)[truth.vehicle])
        assert track is not None
        fixed = sum(fix.status == "ok" for step in steps for fix in step.fixes)
        cells = [
            name,
            f"{used.count} of {len(site.beacons) * round(LAP_S / PERIOD_S)}",
            length_text(used.rms_m),
            f"{used.beyond_5cm}",
            f"{fixed} of {len(steps)}",
            length_text(track.rmse_xy_m),
            length_text(track.p95_xy_m),
        ]
        out.append("| " + " | ".join(cells) + " |")
        print("\n".join(out if len(out) == 3 else out[-1:]), flush=True)
    return out


def main() -> None:
    """Print the table, and put it between the marks of a page where one is given."""
    parser = argparse.ArgumentParser(description="Accuracy in the demonstration's hall; a Markdown table on stdout.")
    parser.add_argument("--into", type=Path, help="page whose table to replace, between its marks")
    page = parser.parse_args().into
    found = rows()
    if page is not None:
        before, rest = page.read_text("utf-8").split(BEGIN, 1)
        page.write_text(before + BEGIN + "\n".join(found) + "\n" + END + rest.split(END, 1)[1], "utf-8")


if __name__ == "__main__":
    main()
