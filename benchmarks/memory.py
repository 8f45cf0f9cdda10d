"""Peak memory of `sonofix run` by length of the recording."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from hall import LAP_S, laps
from measure import millimetres, table
from sonofix.files import write_recording
from sonofix.files.recording_writer import write_truth

# A process begins with the peak of the one that started it, so a small one stands between.
_WATCH = """
import json, resource, subprocess, sys, time
begin = time.perf_counter()
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)
peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
print(json.dumps({"peak_mb": peak, "wall_s": time.perf_counter() - begin}))
"""


def peaks(lengths_s: list[float]) -> None:
    """Print the peak of whole runs: samples alone at each length, then with truth, score and picture at the last."""
    from sonofix.cli.score import score_run

    rows = []
    for length_s, whole in [*((length_s, False) for length_s in lengths_s), (lengths_s[-1], True)]:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "laps"
            recording, truth = laps(round(length_s / LAP_S))
            write_recording(folder, recording, {truth.vehicle: truth} if whole else None)
            size_mb = (folder / "capture.wav").stat().st_size / 2**20
            option = "--plot" if whole else "--no-plot"
            command = [str(Path(sys.executable).with_name("sonofix")), "run", str(folder), option]
            told = subprocess.run(
                [sys.executable, "-c", _WATCH, *command], check=True, stdout=subprocess.PIPE, text=True
            )
            found = json.loads(told.stdout)
            write_truth(folder / "truth.csv", {truth.vehicle: truth})
            track = score_run(folder, folder / "out").track["agv"]
            rows.append(
                [
                    f"{length_s:g} s" + (", with truth, score and picture" if whole else ""),
                    f"{size_mb:.0f} MB",
                    f"{found['peak_mb']:.0f} MB",
                    f"{found['wall_s']:.0f} s",
                    f"{length_s / found['wall_s']:.1f} ×",
                    f"{millimetres(track.rmse_xy_m)} rms",
                ]
            )
    table(
        "Peak memory of `sonofix run`: eight beacons at 192 kHz",
        ("recording", "its samples (16 bit)", "peak", "wall time", "faster than real time", "position"),
        rows,
    )
