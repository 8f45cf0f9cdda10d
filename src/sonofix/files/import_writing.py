"""What an import writes: the tables of a bag into a recording folder, all of them or none."""

from __future__ import annotations

import shutil
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from sonofix.files.audio import CAPTURE_NAMES
from sonofix.files.bag_import import Imported
from sonofix.files.problem import Problem, RecordingError
from sonofix.files.recording_writer import write_recording
from sonofix.files.site_file import FILE_NAME, read_site, read_text
from sonofix.files.tables import LAYOUTS
from sonofix.files.writing import told, write_whole
from sonofix.records import Recording
from sonofix.site import ReferenceCode, Site

CLOCK_NAME = "import.toml"


def site_of_import(folder: Path, site_file: Path | None) -> Path:
    """Return the site file that an import goes by: that of the folder, or the one given for a new folder.

    Raises
    ------
    RecordingError
        Where there is none, or both.
    """
    own = folder / FILE_NAME
    if folder.exists() and not folder.is_dir():
        raise RecordingError([Problem(str(folder), "", None, "is a file; give a folder")])
    if site_file is None and not own.exists():
        raise RecordingError(
            [Problem(str(folder), "", None, f"holds no {FILE_NAME}; say what stands where with --site")]
        )
    if site_file is None or (own.exists() and own.samefile(site_file)):
        return own
    if own.exists():
        remedy = "the folder has its own site.toml, which goes first; leave --site away, or import to a new folder"
        raise RecordingError([Problem(str(own), "", None, remedy)])
    return site_file / FILE_NAME if site_file.is_dir() else site_file


def zero_of_import(folder: Path) -> int | None:
    """Return the instant (ns since 1970) that is time 0 of a folder; None where the first message may decide.

    Raises
    ------
    RecordingError
        Where the folder holds samples or tables, whose time 0 nothing tells.
    """
    zero_ns = read_zero(folder)
    if zero_ns is not None:
        return zero_ns
    for name in (*CAPTURE_NAMES, *(f"{stem}.csv" for stem, layout in LAYOUTS.items() if layout.order)):
        if (folder / name).exists():
            remedy = (
                f"its time 0 has to be that of the bag: say with --zero when that was, s since 1970 ({name} is there)"
            )
            raise RecordingError([Problem(str(folder), "", None, remedy)])
    return None


def read_zero(folder: Path) -> int | None:
    """Return the instant of time 0 that an earlier import noted in a folder, ns since 1970; None where none did.

    Raises
    ------
    RecordingError
        Where the note cannot be read.
    """
    path = folder / CLOCK_NAME
    if not path.exists():
        return None
    try:
        zero_ns = tomllib.loads(read_text(path, path.name)).get("zero_ns")
    except tomllib.TOMLDecodeError as error:
        raise RecordingError([Problem(str(path), "", None, f"not TOML: {error}")]) from None
    if not isinstance(zero_ns, int) or isinstance(zero_ns, bool):
        raise RecordingError([Problem(str(path), "zero_ns", zero_ns, "must be a whole number, ns since 1970")])
    return zero_ns


def write_import(folder: str | Path, imported: Imported, site_file: Path, *, force: bool = False) -> list[str]:
    """Write what a bag holds into a recording folder, made where it does not exist; its site file as it stands.

    All files are written beside their places first, so that a full disk or Ctrl-C leaves the folder as it was.

    Returns
    -------
    list of str
        Names of the files written.

    Raises
    ------
    RecordingError
        Where a file is there already and ``force`` is not given, where it cannot be written, or where an earlier import
        into the folder went by another time 0.
    """
    folder = Path(folder)
    site = read_site(site_file)
    before_ns = read_zero(folder)
    if before_ns not in (None, imported.zero_ns):
        remedy = f"time 0 of this folder, not {imported.zero_ns}; leave --zero away, or import to a new folder"
        raise RecordingError([Problem(str(folder / CLOCK_NAME), "zero_ns", before_ns, remedy)])
    with _beside(folder) as stage:
        write_recording(
            stage, Recording(site=site, ranges=imported.ranges, tables=imported.tables), imported.truth or None
        )
        text = _clock_text(imported)
        write_whole(stage / CLOCK_NAME, lambda part: part.write_text(text, encoding="utf-8"))
        (stage / FILE_NAME).unlink()
        if not (folder / FILE_NAME).exists():
            _copy_references(stage, site_file.parent, site)
            with told(stage, FILE_NAME):
                shutil.copyfile(site_file, stage / FILE_NAME)
        files = [path.relative_to(stage) for path in sorted(stage.rglob("*")) if path.is_file()]
        there = [] if force else [name for name in files if name.name != CLOCK_NAME and (folder / name).exists()]
        if there:
            remedy = "is there already; give --force to replace it, or leave its topic out by a --map (as = [])"
            raise RecordingError([Problem(str(folder / name), "", None, remedy) for name in there])
        # the site file last: without it a folder is no recording
        for name in sorted(files, key=lambda name: name.name == FILE_NAME):
            with told(folder, str(name)):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (stage / name).replace(folder / name)
    return [str(name) for name in files]


def _copy_references(stage: Path, beside: Path, site: Site) -> None:
    for beacon in site.beacons:
        if isinstance(beacon.code, ReferenceCode) and (beside / beacon.code.reference).is_file():
            target = stage / beacon.code.reference
            with told(stage, beacon.code.reference):
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(beside / beacon.code.reference, target)


@contextmanager
def _beside(folder: Path) -> Iterator[Path]:
    """Give a folder on the same disk, which goes away again."""
    place = folder if folder.is_dir() else folder.parent
    with told(place, ""):
        place.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=".import-", dir=place))
    try:
        yield stage
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _clock_text(imported: Imported) -> str:
    second, rest = divmod(imported.zero_ns, 1_000_000_000)
    try:
        when = f"{datetime.fromtimestamp(second, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"
    except (OverflowError, ValueError, OSError):
        when = "beyond the calendar"
    source = "".join(c if c.isprintable() and c not in '"\\' else "_" for c in imported.source)
    return (
        f'# what `sonofix import` read, and the instant that is time 0 of this recording: {when}\nbag = "{source}"\n'
        f"zero_ns = {imported.zero_ns}  # since 1970, by the clock of the bag\n"
    )
