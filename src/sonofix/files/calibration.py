"""Calibrations: the recording they are learnt from, and what they leave behind for a site file to name."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import soundfile

from sonofix.files.audio import find_capture
from sonofix.files.problem import Problem, RecordingError
from sonofix.files.recording import read_references
from sonofix.files.site_file import FILE_NAME, read_site, site_text
from sonofix.files.tables import LAYOUTS, read_table
from sonofix.files.writing import results_folder, told
from sonofix.records import Calibration, Recording, ReferenceBurst
from sonofix.site import Beacon, ReferenceCode, Site

HIGHEST_FLAC_HZ = 655_350


def read_for_calibration(folder: str | Path) -> Recording:
    """Read site, capture and sync commands of a recording whose beacons may have no code, or a reference yet to come.

    Raises
    ------
    RecordingError
        With every mistake in these files.
    """
    folder = Path(folder)
    if not folder.is_dir():
        remedy = "is a file; give the folder that holds it" if folder.exists() else "there is no such folder"
        raise RecordingError([Problem(str(folder), "", None, remedy)])
    problems: list[Problem] = []
    site = capture = sync = None
    try:
        site = read_site(folder / FILE_NAME)
    except RecordingError as error:
        problems += error.problems
    try:
        capture = find_capture(folder)
    except RecordingError as error:
        problems += error.problems
    else:
        if capture is None:
            remedy = "holds no capture.wav or capture.flac; a burst is learnt from samples"
            problems.append(Problem(str(folder), "", None, remedy))
    if (folder / "sync.csv").exists():
        try:
            sync = read_table(folder / "sync.csv", LAYOUTS["sync"], site)
        except RecordingError as error:
            problems += error.problems
    references: dict[str, ReferenceBurst] = {}
    if site is not None:
        there = [b for b in site.beacons if isinstance(b.code, ReferenceCode) and (folder / b.code.reference).exists()]
        try:
            references = read_references(folder, site.model_copy(update={"beacons": tuple(there)}))
        except RecordingError as error:
            problems += error.problems
    if problems or site is None or capture is None:
        raise RecordingError(problems)
    times = None if sync is None else sync.columns["time_s"]
    if times is not None and len(times) > 1 and site.schedule is not None and site.schedule.period_s is None:
        schedule = site.schedule.model_copy(update={"period_s": float(np.median(np.diff(times)))})
        site = site.model_copy(update={"schedule": schedule})
    return Recording(
        site=site,
        rate_hz=capture.rate_hz,
        sample_count=capture.sample_count,
        blocks=capture.blocks,
        sync_s=times,
        references=references,
    )


def reference_name(calibration: Calibration) -> str:
    """Name of the reference file: the beacon's id as far as a file system takes it, and a lossless format."""
    kind = "flac" if calibration.burst.rate_hz <= HIGHEST_FLAC_HZ else "wav"
    return f"{safe_name(calibration.beacon)}.{kind}"


def safe_name(beacon_id: str) -> str:
    """Return a beacon's id as a file name."""
    return re.sub(r"[^\w-]", "_", beacon_id)


def calibrated_beacon(site: Site, calibration: Calibration) -> Beacon:
    """Return the beacon as it should stand in the site file from now on: code the reference, delay the learnt one."""
    placed = None if calibration.delay_s is None else calibration.flight_m
    code = ReferenceCode(
        reference=reference_name(calibration), distance_m=placed, start_s=round(calibration.start_s, 9)
    )
    old = site.beacon(calibration.beacon)
    delay_s = old.delay_s if calibration.delay_s is None else round(calibration.delay_s, 9)
    return old.model_copy(update={"code": code, "delay_s": delay_s})


def snippet(site: Site, calibration: Calibration) -> str:
    """Return the lines to paste into `site.toml` in place of the beacon's own: TOML, with remarks."""
    beacon = calibrated_beacon(site, calibration)
    only = site.model_copy(update={"beacons": (beacon,), "microphones": (), "vehicles": ()})
    block = next(part for part in site_text(only).split("\n\n") if part.startswith("[[beacon]]"))
    used = calibration.heard - sum(calibration.left_out.values())
    remarks = [f"# learnt from {used} bursts at microphone {calibration.microphone}"]
    if calibration.distance_m is not None:
        remarks[0] += f", {calibration.distance_m:g} m away"
    if calibration.delay_s is not None and calibration.delay_total_sd_s is not None:
        remarks.append(
            f"# delay_s: ± {calibration.delay_total_sd_s:.2g} s; the flight is taken out of the file (distance_m says "
            "what is left of it)"
        )
    else:
        pace = calibration.pace
        period_s = calibration.period_s * (1.0 + pace.rate)
        remarks.append(
            f"# measured: period_s = {period_s:.9f} in [schedule], ± {calibration.period_s * pace.rate_sd:.1g} s"
        )
    return "\n".join([*remarks, block.rstrip()]) + "\n"


def write_calibration(out: str | Path, site: Site, calibration: Calibration) -> list[Path]:
    """Write the reference, the site snippet and the bursts' times to a folder; each file is there whole or not at all.

    `B1.flac` (24 bits; WAV where the rate is beyond FLAC), `B1.toml`, `B1.csv`, named by the beacon.

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
    stem = safe_name(calibration.beacon)
    paths = [out / reference_name(calibration), out / f"{stem}.toml", out / f"{stem}.csv"]
    parts = [path.with_name(f"{path.name}.part") for path in paths]
    try:
        _write_sound(parts[0], calibration.burst, paths[0].suffix)
        with told(out, paths[1].name):
            parts[1].write_text(snippet(site, calibration), encoding="utf-8")
        with told(out, paths[2].name):
            _write_bursts(parts[2], calibration)
        for part, path in zip(parts, paths, strict=True):
            with told(out, path.name):
                part.replace(path)
    finally:
        for part in parts:
            part.unlink(missing_ok=True)
    return paths


def _write_sound(path: Path, burst: ReferenceBurst, suffix: str) -> None:
    kind = "FLAC" if suffix == ".flac" else "WAV"
    try:
        with soundfile.SoundFile(str(path), "w", round(burst.rate_hz), 1, subtype="PCM_24", format=kind) as file:
            file.write(burst.samples)
    except (soundfile.SoundFileError, AssertionError) as error:
        reason = str(getattr(error, "error_string", None) or "stopped short").rstrip(".")
        remedy = f"cannot be written ({reason}); make room or choose another folder with -o"
        raise RecordingError([Problem(str(path.with_suffix("")), "", None, remedy)]) from None


def _write_bursts(path: Path, calibration: Calibration) -> None:
    pace = calibration.pace
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["due_s", "late_s", "residual_s", "used"])
        for due, late, residual, used in zip(pace.scheduled_s, pace.late_s, pace.residual_s, pace.used, strict=True):
            rows.writerow([f"{due:.9f}", f"{late:.9f}", f"{residual:.9f}", int(used)])
