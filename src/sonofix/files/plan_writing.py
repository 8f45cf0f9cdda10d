"""What planning writes: the map as a table, and a site file with beacons added or moved."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sonofix.files.site_file import site_text
from sonofix.files.writing import results_folder, told, write_text
from sonofix.records import Floats, Quality
from sonofix.site import Site

PLAN_COLUMNS = "x_m,y_m,z_m,heard,hdop,vdop,sd_m,sd_z_m,fault_linear_m"


def write_plan(out: str | Path, quality: Quality, improved: Site | None = None) -> list[Path]:
    """Write ``plan.csv``, a row a place, and ``improved.toml`` where there is an improved site.

    Each file is there whole or not at all; an earlier ``improved.toml`` that is none any more is removed.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    RecordingError
        Where the folder is a recording itself, or cannot be written to.
    """
    out = results_folder(out)
    texts: Mapping[str, str | None] = {
        "plan.csv": plan_text(quality),
        "improved.toml": None if improved is None else site_text(improved),
    }
    written = []
    for name, text in texts.items():
        if text is None:
            with told(out, name):
                (out / name).unlink(missing_ok=True)
            continue
        write_text(out / name, text)
        written.append(out / name)
    return written


def plan_text(quality: Quality) -> str:
    """Return the table: all places, row by row from the south-west; what is not known is empty."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(PLAN_COLUMNS.split(","))
    y, x = (axis.ravel() for axis in np.meshgrid(quality.y_m, quality.x_m, indexing="ij"))
    floor = quality.floor.ravel()
    columns = [
        [f"{value:.3f}" for value in x],
        [f"{value:.3f}" for value in y],
        [f"{quality.level_m:.3f}"] * len(x),
        [str(n) if there else "" for n, there in zip(quality.heard.ravel().tolist(), floor.tolist(), strict=True)],
        *(_cells(values, len(x)) for values in (quality.hdop, quality.vdop)),
        *(_cells(values, len(x), 5) for values in (quality.sd_m, quality.sd_z_m, quality.fault_m)),
    ]
    rows.writerows(zip(*columns, strict=True))
    return text.getvalue()


def _cells(values: Floats | None, count: int, digits: int = 3) -> list[str]:
    if values is None:
        return [""] * count
    return [f"{value:.{digits}f}" if np.isfinite(value) else "" for value in values.ravel().tolist()]
