"""`sonofix study`: a paper's simulation on its own numbers, its claims checked, and the same from waveforms."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import Stopped, drawing, print_table, progress_bar, speaker, stop_if_asked

if TYPE_CHECKING:
    from sonofix.records import Finding, Sheet
    from sonofix.studies.work import Work


def study(
    name: Annotated[str, typer.Argument(help="quasi-gps, pedestrian or robots.")],
    part: Annotated[
        str | None, typer.Option(help="Of robots: detection (the default), collision or leapfrog.", show_default=False)
    ] = None,
    runs: Annotated[int, typer.Option(help="Runs on the paper's numbers.", min=1, max=100_000)] = 300,
    waveforms: Annotated[
        int, typer.Option(help="Runs from waveforms through the receiver, some ten seconds each; 0: none.", min=0)
    ] = 1,
    wanted_m: Annotated[
        float | None,
        typer.Option(
            help="Of leapfrog: end error in m after 100 m (1 σ) that the planner is asked for.", show_default="0.06"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same numbers.", min=0)] = 0,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for study.png, curves.csv, findings.json.")
    ] = None,
    plot: Annotated[bool, typer.Option(help="Draw study.png.")] = True,
) -> None:
    """Redo a paper's simulation on its own numbers, check its claims, and run the same from waveforms.

    \b
    quasi-gps   a vehicle's coarse fixes and velocities, and the paper's four-state filter
    pedestrian  a walker's fixes by arrival-time differences, steps, and the paper's error-state filter
    robots      three robots: a burst picked out of noise (--part detection), a collision repaired (--part collision),
                100 m by leap-frog (--part leapfrog)

    Each figure comes with its standard error over the runs. Ctrl-C keeps the runs that are finished. For example:

    sonofix study quasi-gps -o quasi-gps

    sonofix study pedestrian --runs 1000 --waveforms 0

    sonofix study robots --part collision -o collision

    sonofix study robots --part leapfrog --wanted-m 0.04 -o leapfrog
    """
    from sonofix.files.writing import results_folder
    from sonofix.studies import PARTS, begin

    if part is None and name in PARTS:
        part = PARTS[name][0]
    work = begin(name, runs, seed, waveforms, part, wanted_m)
    if out is not None:
        results_folder(out)
    stopped = not _finished(work)
    sheet = work.sheet()
    if sheet is None:
        raise Stopped("stopped; no run was finished")
    _tell(sheet)
    if out is not None:
        _write(out, name, part, seed, sheet)
        if plot:
            _draw(out / "study.png", sheet)
        speaker().print(f"\nWritten to {out}")
    if stopped:
        raise Stopped("stopped; the table holds the runs that were finished")


def _finished(work: Work) -> bool:
    """Do the work under bars; False where Ctrl-C ended it."""
    try:
        with progress_bar() as bars:
            tasks: dict[str, int] = {}
            for what, share in work.work():
                stop_if_asked()
                if what not in tasks:
                    tasks[what] = bars.add_task(what, total=1.0)
                bars.update(tasks[what], completed=share)  # pyright: ignore[reportArgumentType]
    except KeyboardInterrupt:
        return False
    return True


def _tell(sheet: Sheet) -> None:
    rows = {
        f"{finding.case}: {finding.quantity}": (found_text(finding), str(finding.runs), finding.claim)
        for finding in sheet.findings
    }
    print_table(sheet.title, ("found", "runs", "expected"), rows)
    for listing in sheet.listings:
        lines = {cell_text(first): tuple(map(cell_text, cells)) for first, *cells in listing.rows}
        print_table(listing.title, listing.columns[1:], lines)
        speaker().print(listing.note)


def cell_text(cell: str | float) -> str:
    """Write a cell of a listing, to the centimetre, or below 1 to a tenth of a millimetre."""
    return str(cell) if not isinstance(cell, float) else f"{cell:.2f}" if abs(cell) >= 1 else f"{cell:.4f}"


def found_text(finding: Finding) -> str:
    """Write a figure with its standard error, to the two figures in which that is known, in a unit that reads well."""
    from math import floor, log10

    size = abs(finding.value)
    factor, unit = {
        "m": (1e3, "mm") if size < 0.01 else (1e2, "cm") if size < 1 else (1.0, "m"),
        "m/s": (1e3, "mm/s") if size < 0.005 else (1e2, "cm/s"),
        "": (1e2, "%"),
        "1": (1.0, ""),
    }.get(finding.unit, (1.0, finding.unit))
    value, sd = factor * finding.value, factor * (finding.sd or 0.0)
    scale = sd or abs(value) / 10 or 1.0
    digits = min(max(1 - floor(log10(scale)), 0), 6)
    doubt = f" ± {sd:.{digits}f}" if finding.sd else ""
    return f"{value:.{digits}f}{doubt} {unit}".rstrip()


def _write(out: Path, name: str, part: str | None, seed: int, sheet: Sheet) -> None:
    """Write what is drawn as a table, a row a point, and the figures found in SI units."""
    import csv
    import io
    import json
    from dataclasses import asdict

    from sonofix.files.writing import told, write_text

    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("panel", "curve", "x", "y"))
    for panel in sheet.panels:
        title = f"{panel.title}: {panel.note}" if panel.note else panel.title
        for curve in panel.curves:
            for x, y in zip(curve.x.tolist(), curve.y.tolist(), strict=True):
                rows.writerow((title, curve.name, *("" if v != v else f"{v:.9g}" for v in (x, y))))
    write_text(out / "curves.csv", text.getvalue())
    for listing in sheet.listings:
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(listing.columns)
        rows.writerows([f"{cell:.9g}" if isinstance(cell, float) else cell for cell in row] for row in listing.rows)
        write_text(out / f"{listing.name}.csv", text.getvalue())
    findings = [asdict(finding) for finding in sheet.findings]
    content = {"study": name} | ({"part": part} if part else {}) | {"seed": seed, "findings": findings}
    write_text(out / "findings.json", json.dumps(content, indent=2, ensure_ascii=False) + "\n")
    with told(out, "study.png"):
        (out / "study.png").unlink(missing_ok=True)


def _draw(picture: Path, sheet: Sheet) -> None:
    """Draw the picture; say so where Matplotlib is not installed."""
    with drawing():
        from sonofix.draw.study_sheet import draw_study
        from sonofix.files.writing import write_whole

        figure = draw_study(sheet, [(f.case, f.quantity, found_text(f)) for f in sheet.findings])
        write_whole(picture, lambda part: figure.savefig(part, format="png"))
