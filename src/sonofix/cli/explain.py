"""`sonofix explain`: what the receiver saw in one epoch, in tables and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import Stopped, counted, drawing, length_text, print_table, progress_bar, speaker, watched

if TYPE_CHECKING:
    from sonofix.records import BandInsight, BeaconInsight, Insight, Recording
    from sonofix.site import Site

_COLUMNS = ("beacon", "range_m", "sd_m", "range_rate_mps", "range_rate_sd_mps", "level_db", "amplitude", "is_range",
            "dropped")  # fmt: skip
_MOST_STAGES = 12
_DEEDS = {
    "as heard": "as heard",
    "tones": "tones taken out",
    "burst": "bursts cancelled",
    "clicks": "clicks set aside",
    "echo": "echoes cancelled",
    "dropped": "paths dropped again",
    "refined": "refined to the end",
}


def explain(
    recording: Annotated[Path, typer.Argument(help="Recording folder: site.toml and samples.")],
    epoch: Annotated[int, typer.Option(help="Which epoch; 0 is the first.", min=0)],
    microphone: Annotated[str | None, typer.Option(help="Id of the microphone. [default: the first]")] = None,
    beacon: Annotated[
        list[str] | None, typer.Option(help="Id of a beacon to show; can be repeated. [default: all]")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder to write to. [default: explain/ in the recording]")
    ] = None,
    plot: Annotated[bool, typer.Option(help="Draw pictures.")] = True,
) -> None:
    """Show what the receiver saw in one epoch: spectrum, searches, paths, what was cancelled and left out.

    The recording is run up to that epoch, so that what the search expected is what it expected in the run. For example:

    sonofix explain hall --epoch 12 --microphone M1 --beacon B1 --beacon B2
    """
    from sonofix import files, flow
    from sonofix.files.calibration import safe_name

    source = files.read_recording(recording, to_run=True)
    site = source.site
    _check(site, microphone, beacon or [])
    try:
        with progress_bar() as bar:
            task = bar.add_task(f"to epoch {epoch}", total=_samples_wanted(source, epoch))
            seen = flow.explain(watched(source, lambda n: bar.advance(task, n)), epoch, microphone)
    except KeyboardInterrupt:
        raise Stopped("stopped; nothing was written") from None
    if beacon:
        seen = _narrowed(seen, beacon)
    _tell(seen, site)
    out = out or recording / "explain"
    out.mkdir(parents=True, exist_ok=True)
    stem = f"epoch-{epoch}-{safe_name(seen.microphone)}"
    try:
        _write_paths(out / f"{stem}-paths.csv", seen)
        for kind in ("overview", "beacons"):
            for old in (*out.glob(f"{stem}-{kind}*.png"), *out.glob(f"{stem}-*kHz-{kind}*.png")):
                old.unlink()
        if plot:
            _draw(out, stem, seen, site.name)
    except KeyboardInterrupt:
        raise Stopped(f"stopped; not all was written to {out}") from None
    speaker().print(f"Written to {out}")


def _check(site: Site, microphone: str | None, beacons: list[str]) -> None:
    """Refuse what the site does not have."""
    listening = [m.id for m in site.microphones if m.channel is not None]
    if microphone is not None and microphone not in listening:
        raise ValueError(
            f"--microphone {microphone}: the capture has no channel of such a microphone; it has those of "
            f"{', '.join(listening) or 'none'}"
        )
    known = [b.id for b in site.coded_beacons]
    for name in beacons:
        if name not in known:
            raise ValueError(
                f"--beacon {name}: the site has no such beacon with a code; it has {', '.join(known) or 'none'}"
            )


def _samples_wanted(source: Recording, epoch: int) -> int | None:
    """Samples that will be read, about: those up to the epoch's end."""
    schedule = source.site.schedule
    if schedule is None or schedule.period_s is None or source.rate_hz is None:
        return source.sample_count
    needed = int((epoch + 1.5) * schedule.period_s * source.rate_hz)
    return needed if source.sample_count is None else min(needed, source.sample_count)


def _narrowed(seen: Insight, names: list[str]) -> Insight:
    """Keep some beacons only."""
    bands = [replace(band, beacons=tuple(b for b in band.beacons if b.beacon in names)) for band in seen.bands]
    return replace(seen, bands=tuple(band for band in bands if band.beacons))


def _tell(seen: Insight, site: Site) -> None:
    say = speaker()
    say.print(f"Epoch {seen.epoch} of {site.name}, at {seen.sync_s:.3f} s, microphone {seen.microphone}; {seen.search}")
    if seen.clock == "common":
        say.print("Ways and ranges share one unknown offset: the clock's")
    for band in seen.bands:
        columns = ("way", "± noise", "range rate", "± noise", "over the noise", "")
        print_table(f"Paths, {band.carrier_hz / 1e3:g} kHz", columns, dict(_path_rows(seen, band)))
        print_table("What was cancelled", ("beacons", "left, over the quiet"), dict(_stage_rows(band)))
    say.print()
    say.print("Left out, and why:")
    for line in seen.left_out(b for band in seen.bands for b in band.beacons) or ["Nothing."]:
        say.print(f"  {line}")
    say.print()


def _path_rows(seen: Insight, band: BandInsight) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Rows of the paths kept: the range first, then what came beside it."""
    for beacon in band.beacons:
        kept = sorted((p for p in beacon.paths if not p.dropped), key=lambda p: (not p.is_range, p.range_m))
        for i, path in enumerate(kept):
            remark = ""
            if path.is_range:
                remark = "range" if seen.used.get(beacon.beacon, True) else "range, not used"
            yield (
                f"{beacon.beacon}{f'  path {i + 1}' if i else ''}",
                (
                    f"{path.range_m:.4f} m",
                    length_text(path.range_sd_m),
                    f"{path.range_rate_mps:+.3f} m/s",
                    "" if path.range_rate_sd_mps is None else f"{length_text(path.range_rate_sd_mps)}/s",
                    f"{path.level_db:.1f} dB",
                    remark,
                ),
            )
        if not kept:
            yield beacon.beacon, ("", "", "", "", "", "no range")


def _stage_rows(band: BandInsight) -> Iterator[tuple[str, tuple[str, str]]]:
    """Rows of the stages; where there are many, what is alike and follows each other in one."""
    alone = len(band.stages) <= _MOST_STAGES
    groups = groupby(enumerate(band.stages), key=lambda item: (item[1].deed, item[0] if alone else 0))
    for number, (_, group) in enumerate(groups):
        stages = [stage for _, stage in group]
        beacons = [name for stage in stages for name in stage.beacons]
        text = " ".join(beacons) if len(beacons) <= _MOST_STAGES else f"{counted(len(beacons), 'path')}"
        yield f"{number}  {_DEEDS[stages[-1].deed]}", (text, f"{stages[-1].left_db:.1f} dB")


def _write_paths(path: Path, seen: Insight) -> None:
    """Write all paths, kept and dropped, a row each."""
    import csv

    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(_COLUMNS)
        for band in seen.bands:
            for beacon in band.beacons:
                rows.writerows(_cells(beacon))


def _cells(beacon: BeaconInsight) -> Iterator[tuple[str, ...]]:
    for path in beacon.paths:
        yield (
            beacon.beacon,
            f"{path.range_m:.6f}",
            "" if path.range_sd_m is None else f"{path.range_sd_m:.6f}",
            f"{path.range_rate_mps:.5f}",
            "" if path.range_rate_sd_mps is None else f"{path.range_rate_sd_mps:.5f}",
            f"{path.level_db:.2f}",
            f"{path.amplitude:.4g}",
            str(int(path.is_range)),
            path.dropped,
        )


def _draw(out: Path, stem: str, seen: Insight, name: str) -> None:
    """Draw the pictures; say so where Matplotlib is not installed."""
    with drawing():
        from sonofix.draw.explain import draw_insight

        for page, figure in draw_insight(seen, name).items():
            figure.savefig(out / f"{stem}-{page}.png")
