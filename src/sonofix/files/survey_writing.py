"""What a survey writes: the site file with beacons where they are, and all it knows as JSON; whole or not at all."""

from __future__ import annotations

import json
import re
import tempfile
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sonofix.files.audio import CAPTURE_NAMES
from sonofix.files.problem import Problem, RecordingError
from sonofix.files.site_file import FILE_NAME, parse_site, site_text, table_text
from sonofix.files.tables import LAYOUTS
from sonofix.files.writing import told, write_text, write_whole
from sonofix.records import Survey
from sonofix.site import Beacon, Microphone, Pair, ReferenceCode, Site

_HEADER = re.compile(r"^\s*(\[\[?)\s*([A-Za-z0-9_.\-\"' ]+?)\s*\]\]?\s*(#.*)?$")
_KEYS = ("position_m", "position_sd_m", "delay_s", "bias_m", "bias_sd_m")


def check_targets(targets: Mapping[str, Path], folder: Path, site: Site, replacing: bool) -> None:
    """Refuse to write where it would destroy something, before any work is done.

    Parameters
    ----------
    targets : mapping from what is written ("site file", "picture", …) to where
    folder : Path
        Of the recording: none of the files it is read from is ever replaced.
    site : Site
        It names the recording's references.
    replacing : bool
        Whether other files that are there may be replaced.

    Raises
    ------
    RecordingError
        Two targets are one file; one is a file of the recording, a folder, there already, or cannot be written.
    """
    own = [folder / name for name in (FILE_NAME, *CAPTURE_NAMES, *(f"{stem}.csv" for stem in LAYOUTS))]
    own += [folder / b.code.reference for b in site.beacons if isinstance(b.code, ReferenceCode)]
    seen: dict[str, Path] = {}
    for what, path in targets.items():
        with told(path.parent, path.name):
            for other, taken in seen.items():
                if _same(path, taken):
                    _refuse(path, f"is where the {other} goes, and the {what} too; give each its own file")
            seen[what] = path
            for file in own:
                if _same(path, file):
                    remedy = f"is the survey's own {file.name}; write the {what} beside it, under another name"
                    _refuse(path, remedy)
            if path.is_dir():
                _refuse(path, f"is a folder; name a file for the {what}")
            if path.exists() and not replacing:
                _refuse(path, f"is there already; give --force, or another name for the {what}")
            _try(path)


def _refuse(path: Path, remedy: str) -> None:
    raise RecordingError([Problem(str(path), "", None, remedy)])


def _same(a: Path, b: Path) -> bool:
    """Whether two paths are one file, there or not: links, and names that the file system takes as one, counted."""
    return a.resolve() == b.resolve() or (a.exists() and b.exists() and a.samefile(b))


def _try(path: Path) -> None:
    """Write a file of no name where the path will be, or as near above it as there is a folder."""
    folder = path.parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    with tempfile.TemporaryFile(dir=folder):
        pass


def corrected_text(text: str, before: Site, after: Site) -> str:
    """Return a site file's text with its fixed beacons' places, deviations, delays and biases as ``after`` has them.

    Comments, order and everything else stay; pairs that are new stand at the end. Where the text is written in a way
    that cannot be edited line by line, the whole is written anew, without comments.

    Parameters
    ----------
    text : str
        Of the site file.
    before, after : Site
        They may differ in these values alone.
    """
    lines = text.splitlines(keepends=True)
    seen = {"beacon": 0, "microphone": 0, "pair": 0}
    out: list[str] = []
    pending: dict[str, str] = {}
    at = 0
    while at < len(lines):
        line = lines[at]
        header = _HEADER.match(line)
        if header:
            _add(out, pending)
            pending = {}
            if header[1] == "[[" and header[2] in seen:
                number = seen[header[2]]
                seen[header[2]] += 1
                old, new = (getattr(site, f"{header[2]}s") for site in (before, after))
                if number < len(old):
                    pending = _changes(old[number], new[number])
        key = re.match(r"^\s*([A-Za-z0-9_]+)\s*=", line)
        if key and key[1] in pending:
            end = _value_end(lines, at)
            last = lines[end - 1].rstrip("\r\n")
            remark = _remark(last)
            indent = line[: len(line) - len(line.lstrip())]
            out.append(f"{indent}{key[1]} = {pending.pop(key[1])}{'  ' + remark if remark else ''}\n")
            at = end
            continue
        out.append(line)
        at += 1
    _add(out, pending)
    edited = "".join(out)
    for pair in after.pairs[len(before.pairs) :]:
        edited += "" if edited.endswith("\n") else "\n"
        edited += "\n" + table_text("pair", pair)
    try:
        if parse_site(edited) == after:
            return edited
    except RecordingError:
        pass
    return site_text(after)


def _changes(old: Beacon | Microphone | Pair, new: Beacon | Microphone | Pair) -> dict[str, str]:
    """Keys of one beacon, microphone or pair that differ, as TOML."""
    out = {}
    for key in _KEYS:
        value = getattr(new, key, None)
        if value is not None and value != getattr(old, key):
            out[key] = json.dumps(list(value) if isinstance(value, tuple) else value)
    return out


def _add(out: list[str], pending: Mapping[str, str]) -> None:
    """Write keys that a table did not have yet behind its last one."""
    if not pending:
        return
    at = len(out)
    while at and (not out[at - 1].strip() or out[at - 1].lstrip().startswith("#")):
        at -= 1
    if at and not out[at - 1].endswith("\n"):
        out[at - 1] += "\n"
    out[at:at] = [f"{key} = {value}\n" for key, value in pending.items()]


def _value_end(lines: list[str], start: int) -> int:
    """Index of the line after a value: lists may run over several."""
    for end in range(start + 1, min(start + 12, len(lines)) + 1):
        try:
            tomllib.loads("".join(lines[start:end]))
        except tomllib.TOMLDecodeError:
            continue
        return end
    return start + 1


def _remark(line: str) -> str:
    """Return the comment at a line's end; numbers hold no #."""
    _, mark, rest = line.partition("#")
    return mark + rest


def write_site(path: str | Path, text: str) -> None:
    """Write a site file; it is there whole or not at all.

    Raises
    ------
    RecordingError
        Where it cannot be written.
    """
    write_text(Path(path), text)


def write_survey(path: str | Path, found: Survey) -> None:
    """Write all that a survey found, with its covariance, as JSON; unknown values are null.

    Raises
    ------
    RecordingError
        Where it cannot be written.
    """
    write_text(Path(path), json.dumps(survey_values(found), indent=1, allow_nan=False) + "\n")


def survey_values(found: Survey) -> dict[str, Any]:
    """Return a survey as plain values."""
    return {
        "status": found.status,
        "remedy": found.remedy,
        "gauge": found.gauge,
        "mirror": found.mirror,
        "frame_sd": dict(found.frame_sd),
        "beacons": [
            {
                "id": b.id,
                "before_m": b.before_m.tolist(),
                "before_sd_m": b.before_sd_m,
                "position_m": b.position_m.tolist(),
                "sd_m": b.sd_m.tolist(),
                "bias_m": b.bias_m,
                "bias_sd_m": b.bias_sd_m,
                "heard": b.heard,
                "used": b.used,
                "residual_m": _number(b.residual_m),
                "mirrored": b.mirrored,
            }
            for b in found.beacons
        ],
        "covariance_m2": found.covariance_m2.tolist(),
        "unknown": [
            {"text": d.text, "drive_sd_m": _number(d.drive_sd_m), "sd_m": d.sd_m, "move_m": d.move_m.tolist()}
            for d in found.open
        ],
        "pairs": [{"from": p.emitter, "to": p.receiver, "bias_m": p.bias_m, "sd_m": p.sd_m} for p in found.pairs],
        "sound_speed_mps": found.sound_speed_mps,
        "sound_speed_sd_mps": found.sound_speed_sd_mps,
        "clock_offset_m": found.clock_offset_m,
        "clock_drift_mps": found.clock_drift_mps,
        "ranges": found.rows,
        "excluded": found.excluded,
        "residual_before_m": _number(found.before_m),
        "residual_after_m": _number(found.after_m),
        "rate_residual_after_mps": _number(found.rate_after_mps),
    }


def _number(value: float) -> float | None:
    """Return a number, None where JSON has none for it."""
    return value if abs(value) < float("inf") else None


def write_picture(path: str | Path, save: Callable[[Path], None]) -> None:
    """Have a picture saved; it is there whole or not at all.

    Parameters
    ----------
    path : path
    save : callable
        Writes the picture, in PNG whatever the name, to the path it is given.

    Raises
    ------
    RecordingError
        Where it cannot be written.
    """
    write_whole(Path(path), save)
