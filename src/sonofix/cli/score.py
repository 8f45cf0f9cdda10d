"""`sonofix score`: what a run wrote against the recording's truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import figure_text, length_text, print_table

if TYPE_CHECKING:
    from sonofix.records import Floats, Table
    from sonofix.score import InnovationFigures, RangeColumns, RangeFigures, TrackColumns, TrackFigures
    from sonofix.site import Site


def score(
    recording: Annotated[Path, typer.Argument(help="Recording folder with a truth.csv.")],
    out: Annotated[
        Path | None, typer.Argument(help="Folder that `sonofix run` wrote. [default: out/ in the recording]")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, lengths in m.")] = False,
) -> None:
    """Score ranges and track of a run against the recording's truth."""
    scored = score_run(recording, out or recording / "out")
    if as_json:
        import json

        typer.echo(json.dumps(asdict(scored), indent=2, allow_nan=False))
        return
    if scored.ranges is not None:
        print_table("Ranges", ("used", "all"), _range_rows(scored.ranges))
    if scored.track:
        print_table("Track", tuple(scored.track), track_rows(scored.track))
    else:
        typer.echo("No row of track.csv lies in the time of the truth.")
    if scored.innovations is not None:
        print_table("Measurements against what the causal track expected", ("",), _nis_rows(scored.innovations))


@dataclass(frozen=True, slots=True)
class Scored:
    """Figures of one run: of its ranges and innovations (None where it wrote none), and of each vehicle's track."""

    ranges: RangeFigures | None
    track: Mapping[str, TrackFigures]
    innovations: InnovationFigures | None


def score_run(recording: Path, out: Path) -> Scored:
    """Score what a run wrote to a folder.

    Raises
    ------
    RecordingError
        If the recording has no truth, or the folder holds no run or one with mistakes in its files.
    """
    from sonofix import air, files
    from sonofix.score import score_ranges, score_track

    site = files.read_site(recording / "site.toml")
    truths = files.read_truth(recording)
    if not truths:
        remedy = "there is none, so there is nothing to score against"
        raise files.RecordingError([files.Problem(str(recording / "truth.csv"), "", None, remedy)])
    if not any((out / name).is_file() for name in ("ranges.csv", "track.csv")):
        remedy = f"holds neither ranges.csv nor track.csv; first: sonofix run {recording}"
        raise files.RecordingError([files.Problem(str(out), "", None, remedy)])
    ranges, track = range_columns(out / "ranges.csv"), track_columns(out / "track.csv", site)
    # the speed matters only to say how long ago a moving beacon's sound left it: the simple formula is near enough
    speed = site.air.sound_speed_mps or float(air.sound_speed_linear_mps(site.air.temperature_c))
    figures = {
        vehicle.id: score_track(truths[vehicle.id], track[vehicle.id])
        for vehicle in site.vehicles
        if vehicle.id in truths and vehicle.id in track
    }
    return Scored(
        ranges=None if ranges is None else score_ranges(site, truths, ranges, speed),
        track={vehicle: found for vehicle, found in figures.items() if found is not None},
        innovations=_innovations(out / "innovations.csv"),
    )


def _innovations(path: Path) -> InnovationFigures | None:
    from sonofix.files.results import read_innovations
    from sonofix.score import score_innovations

    table = read_innovations(path)
    return None if table is None else score_innovations(table.columns["rows"], table.columns["nis"])


def _nis_rows(figures: InnovationFigures) -> dict[str, list[str]]:
    return {
        "corrections": [str(figures.corrections)],
        "measurements": [str(figures.rows)],
        "NIS per measurement (1 is right)": [figure_text(figures.nis_per_row, ".2f")],
        "inside their 95 % band": [figure_text(100 * figures.inside_95, ".1f", "%")],
        "below it, above it": [f"{100 * figures.below:.1f} %, {100 * figures.above:.1f} %"],
    }


def range_columns(path: Path) -> RangeColumns | None:
    """Read the ranges of a run as what is scored; None where it wrote none."""
    from sonofix.files.results import column, read_ranges
    from sonofix.score import RangeColumns

    table = read_ranges(path)
    if table is None:
        return None
    used = column(table, "used")
    return RangeColumns(
        time_s=table.columns["time_s"],
        emitter=table.names["from"],
        receiver=table.names["to"],
        range_m=table.columns["range_m"],
        sd_m=column(table, "sd_m"),
        range_rate_mps=column(table, "range_rate_mps"),
        clock_offset_m=column(table, "clock_offset_m"),
        used=used != 0.0,
    )


def track_columns(path: Path, site: Site) -> dict[str, TrackColumns]:
    """Read the track of a run as what is scored, by vehicle; empty where it wrote none."""
    from sonofix.files.results import by_vehicle, read_track

    return {vehicle: _track_of(table) for vehicle, table in by_vehicle(read_track(path, site))} if path.exists() else {}


def _track_of(table: Table) -> TrackColumns:
    import numpy as np

    from sonofix.files.results import column
    from sonofix.score import TrackColumns

    place, velocity, sd = (
        np.column_stack([column(table, f"{prefix}{axis}{unit}") for axis in "xyz"])
        for prefix, unit in (("", "_m"), ("v", "_mps"), ("sd_", "_m"))
    )
    variance = np.full((len(place), 3, 3), np.nan)
    variance[:, range(3), range(3)] = sd**2
    for i, j in ((0, 1), (0, 2), (1, 2)):
        variance[:, i, j] = variance[:, j, i] = np.where(np.isnan(sd[:, i] + sd[:, j]), np.nan, 0.0)
    tilt: tuple[Floats, ...] = ()
    if "roll_rad" in table.columns:
        sds = [column(table, f"sd_{name}_rad") for name in ("roll", "pitch", "yaw")]
        tilt = (column(table, "roll_rad"), column(table, "pitch_rad"), np.column_stack(sds))
    return TrackColumns(table.columns["time_s"], place, velocity, column(table, "yaw_rad"), variance, *tilt)


def _range_rows(figures: RangeFigures) -> dict[str, tuple[str, str]]:
    both = (figures.used, figures.every)
    return {
        "rows judged": (str(both[0].count), str(both[1].count)),
        "bias (median)": (length_text(both[0].median_m), length_text(both[1].median_m)),
        "rms": (length_text(both[0].rms_m), length_text(both[1].rms_m)),
        "95 % within": (length_text(both[0].p95_m), length_text(both[1].p95_m)),
        "beyond 5 cm": (str(both[0].beyond_5cm), str(both[1].beyond_5cm)),
        "rms of the others": (length_text(both[0].rms_within_5cm_m), length_text(both[1].rms_within_5cm_m)),
        "error over stated sd, rms": (figure_text(figures.error_over_sd_rms, ".2f"), ""),
        "range rate, rms": (figure_text(_times(figures.range_rate_rms_mps, 1e3), ".1f", "mm/s"), ""),
        "share of expected": (figure_text(_times(figures.share_of_expected, 100), ".1f", "%"), ""),
    }


def track_rows(track: Mapping[str, TrackFigures]) -> dict[str, list[str]]:
    """Return the rows of a table of track figures, a column a vehicle."""
    every = list(track.values())
    tilt: dict[str, list[str]] = {}
    if any(f.rmse_roll_rad is not None for f in every):
        tilt = {
            "roll error, rms": [figure_text(_times(f.rmse_roll_rad, _DEGREES), ".2f", "°") for f in every],
            "pitch error, rms": [figure_text(_times(f.rmse_pitch_rad, _DEGREES), ".2f", "°") for f in every],
            "NEES of roll, pitch, yaw (3 is right)": [figure_text(f.nees_attitude, ".2f") for f in every],
        }
    return {
        "rows in the truth's time": [str(f.rows) for f in every],
        "position error, rms": [length_text(f.rmse_xy_m) for f in every],
        "median": [length_text(f.median_xy_m) for f in every],
        "95 % within": [length_text(f.p95_xy_m) for f in every],
        "largest": [length_text(f.max_xy_m) for f in every],
        "height error, rms": [length_text(f.rmse_z_m or None) for f in every],
        "heading error, rms": [figure_text(_times(f.rmse_yaw_rad, _DEGREES), ".2f", "°") for f in every],
        "velocity error, rms": [figure_text(_times(f.velocity_rms_mps, 1e3), ".1f", "mm/s") for f in every],
        "inside 2 sd": [figure_text(_times(f.inside_2sd, 100), ".1f", "%") for f in every],
        "NEES of x, y (2 is right)": [figure_text(f.nees_xy, ".2f") for f in every],
        "longest gap": [figure_text(f.longest_gap_s, ".2f", "s") for f in every],
        **tilt,
    }


_DEGREES = 57.29577951308232
"""In a radian."""


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor
