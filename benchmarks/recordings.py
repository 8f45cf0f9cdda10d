"""Recordings of others with truth: our track beside least squares, filterpy and GTSAM, all run here.

python benchmarks/recordings.py [FOLDER] [--only NAME ...] [--into docs/benchmarks.md]
(FOLDER holds labyrinth/, plaza1/, carpark-513/, table-fast/; default ../shared/data): prints two tables, and puts
them between their marks on a page.
"""

from __future__ import annotations

import os

# products of small matrices: threads would only wait for each other; set before NumPy is loaded
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Sequence  # noqa: E402
from dataclasses import fields  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TypeVar  # noqa: E402

import numpy as np  # noqa: E402

from measure import machine, renew, table  # noqa: E402
from peers import graph, kalman, least_squares  # noqa: E402
from peers.problem import Model, Setting, problem  # noqa: E402
from peers.settings import TOLD, Told  # noqa: E402
from sonofix import flow  # noqa: E402
from sonofix.cli.score import score_run  # noqa: E402
from sonofix.files import read_recording, read_truth  # noqa: E402
from sonofix.records import Floats, Truth  # noqa: E402
from sonofix.score import TrackColumns, TrackFigures, score_track, track_columns  # noqa: E402

DATA = Path(__file__).parents[2] / "shared" / "data"
GRAPH_ITERATIONS = 12
COLUMNS = (
    "recording",
    "least squares",
    "filterpy",
    "filterpy, more unknowns",
    "GTSAM batch, more unknowns",
    *(f"{who}{what}" for who in ("ours, causal", "ours, smoothed") for what in ("", ": inside 2 sd", ": NEES")),
)

_T = TypeVar("_T")


def main() -> None:
    """Print the tables, and put them between their marks of a page where one is given."""
    parser = argparse.ArgumentParser(description="Tracks of recordings with truth, beside peers; Markdown on stdout.")
    parser.add_argument("folder", nargs="?", type=Path, default=DATA, help="holds the recordings [../shared/data]")
    parser.add_argument("--only", nargs="+", choices=list(TOLD), default=list(TOLD), help="these recordings alone")
    parser.add_argument("--into", type=Path, help="page whose tables to replace, between their marks")
    told = parser.parse_args()
    there = [name for name in told.only if (told.folder / name / "truth.csv").exists()]
    for name in told.only:
        if name not in there:
            print(f"{told.folder / name}: is not there or holds no truth.csv; left out", file=sys.stderr)
    if not there or (told.into is not None and len(there) < len(TOLD)):
        page = "" if told.into is None else f"; {told.into}, which shows all of {', '.join(TOLD)}, stays as it is"
        print(f"nothing done{page}; name the folder that holds them", file=sys.stderr)
        return
    begin = time.perf_counter()
    with renew(told.into, "benchmarks/recordings.py"):
        print(f"Machine: {machine()}.")
        table("Recordings with truth: position (x, y) error, rms", COLUMNS, [row(told.folder / name) for name in there])
        print(f"\n{TEXT}")
        columns = ("recording", "peer", "told")
        table("What peers were told", columns, [cells for name in there for cells in settings(name, TOLD[name])])
        print(f"\n{defaults()}")
        print(f"\nThe whole took {(time.perf_counter() - begin) / 60:.1f} minutes.")


def row(folder: Path) -> list[str]:
    """Run all on one recording."""
    name, told = folder.name, TOLD[folder.name]
    recording, truths = read_recording(folder, to_run=True), read_truth(folder)
    given, (truth,) = problem(recording), truths.values()
    vehicle = recording.site.vehicles[0].id

    places = timed(f"{name}: least squares", lambda: least_squares.epochs(Model(given, told.plain)))
    cells = [name, f"{metres(peer(truth, *places))} ({len(places[0])} fixes)"]
    for what, setting in (("filterpy", told.plain), ("filterpy, more unknowns", told.extra)):
        found = timed(f"{name}: {what}", lambda s=setting: kalman.run(Model(given, s)))
        cells.append(metres(peer(truth, found.time_s, found.state)))
    batch_of = Model(given, told.graph)
    whole = timed(f"{name}: GTSAM", lambda: graph.batch(batch_of, kalman.run(batch_of), GRAPH_ITERATIONS))
    cells.append(metres(peer(truth, whole.time_s, whole.state)))
    tracks = timed(f"{name}: ours, causal", lambda: track_columns(flow.run(recording)))
    cells += ours(score_track(truth, tracks[vehicle]) if vehicle in tracks else None)
    cells += ours(timed(f"{name}: ours, smoothed", lambda: smoothed(folder, vehicle)))
    return cells


def smoothed(folder: Path, vehicle: str) -> TrackFigures | None:
    """Figures of what `sonofix run --smooth` writes."""
    with tempfile.TemporaryDirectory() as out:
        command = [Path(sys.executable).with_name("sonofix"), "run", folder, "-o", out, "--smooth", "--no-plot"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return score_run(folder, Path(out)).track.get(vehicle)


def peer(truth: Truth, time_s: Floats, state: Floats) -> TrackFigures | None:
    """Figures of a peer's track: states begin with x and y; the rest is not judged."""
    n = len(time_s)
    unknown = np.full((n, 3), np.nan)
    place = np.column_stack([state[:, :2], np.zeros(n)])
    return score_track(truth, TrackColumns(time_s, place, unknown, unknown[:, 0], np.full((n, 3, 3), np.nan)))


def ours(figures: TrackFigures | None) -> list[str]:
    if figures is None or figures.inside_2sd is None or figures.nees_xy is None:
        return [metres(figures), "-", "-"]
    return [metres(figures), f"{figures.inside_2sd:.2f}", f"{figures.nees_xy:.1f}"]


def metres(figures: TrackFigures | None) -> str:
    return "-" if figures is None else f"{figures.rmse_xy_m:.3f} m"


def settings(name: str, told: Told) -> list[Sequence[str]]:
    """Rows that state what a recording's peers were told, but for what is everyone's."""
    out = []
    for who, shown in (("plain", "filterpy"), ("extra", "filterpy, more unknowns"), ("graph", "GTSAM batch")):
        setting: Setting = getattr(told, who)
        parts = [
            f"{f.name}: {value:.3g}" if isinstance(value, float) else f"{f.name}: each {value}"
            for f in fields(Setting)
            if (value := getattr(setting, f.name)) != f.default and (setting.bias or not f.name.startswith("bias"))
        ]
        out.append((name, shown, ", ".join(parts)))
    return out


def defaults() -> str:
    """State what peers are told unless stated."""
    given = [f"{f.name}: {f.default:g}" for f in fields(Setting) if isinstance(f.default, float) and f.default]
    return "Unless stated: " + ", ".join(part for part in given if not part.endswith("inf")) + "; no gate."


def timed(what: str, job: Callable[[], _T]) -> _T:
    """Run a job and tell on stderr that it runs and how long it took."""
    print(f"{what} … ", end="", file=sys.stderr, flush=True)
    begin = time.perf_counter()
    found = job()
    print(f"{time.perf_counter() - begin:.1f} s", file=sys.stderr, flush=True)
    return found


TEXT = (
    "Every figure was computed in this run, over each track's rows inside the truth's time span. Peers were tuned "
    "to each recording by someone who has seen its truth: noise, what else is unknown and about how large it is, "
    "heading and speed at the start (listed below). Ours ran on one set of defaults for all and was told nothing "
    "but the recording. Causal: a row rests on nothing later than its epoch; least squares and "
    "filterpy are causal too, GTSAM and smoothing look at the whole. More unknowns: labyrinth and carpark-513 a "
    "bias of each anchor, plaza1 a scale of all ranges, table-fast a bias of each anchor and tag. GTSAM begins at "
    f"what filterpy found and takes at most {GRAPH_ITERATIONS} iterations. Least squares: runs of rows in which no "
    "pair comes twice, of three anchors or more. Inside 2 sd: rows with x and y both within two stated "
    "deviations, 0.91 where these are right; NEES of x and y: 2 is right."
)

if __name__ == "__main__":
    main()
