"""`sonofix check`: read everything in a recording and say in plain words what is there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.table import Table as RichTable

    from sonofix.files.figures import CaptureFigures
    from sonofix.records import Recording, ReferenceBurst, Truth
    from sonofix.site import Beacon, Microphone

MOST_ROWS = 40
MOST_GRID_POINTS = 100


def check(
    recording: Annotated[Path, typer.Argument(help="Recording folder: site.toml and what stands beside it.")],
) -> None:
    """Say what a recording holds: beacons, codes, microphones, samples, coverage, and anything odd.

    Mistakes are listed, one a line, and the exit code is 2.
    """
    from rich.console import Console

    from sonofix import files
    from sonofix.files.figures import capture_figures
    from sonofix.files.oddities import oddities, stray_files

    try:
        found = files.read_recording(recording)
        references = files.read_references(recording, found.site)
        truth = files.read_truth(recording)
        figures = capture_figures(found.blocks) if found.blocks else None
    except files.RecordingError as error:
        try:
            files.read_truth(recording)
            problems = error.problems
        except files.RecordingError as second:
            problems = error.problems + tuple(p for p in second.problems if p not in error.problems)
        for problem in problems:
            typer.echo(str(problem), err=True)
        raise typer.Exit(2) from None

    console = Console(highlight=False)
    for part in (
        *_site_lines(found),
        _beacon_table(found, references),
        _microphone_table(found),
        *_measurement_lines(found, figures),
        *_table_lines(found, truth),
        *_coverage_lines(found),
    ):
        console.print(part, soft_wrap=isinstance(part, str))
    odd = [*oddities(found, references, figures, bool(truth)), *stray_files(recording)]
    console.print(f"\nOdd: {len(odd)}" if odd else "\nNothing odd.")
    for sentence in odd:
        console.print(f"  - {sentence}", soft_wrap=True, markup=False)


def _site_lines(recording: Recording) -> Iterator[str]:
    from rich.markup import escape

    site = recording.site
    yield f"[bold]{escape(site.name)}[/bold]"
    if site.bounds_m:
        size = [upper - lower for lower, upper in zip(*site.bounds_m, strict=True)]
        yield "Room: " + " x ".join(f"{length:g}" for length in size) + " m"
    why = "stated" if site.air.sound_speed_mps else f"air at {site.air.temperature_c:g} °C"
    yield f"Sound speed: {site.sound_speed_mps:.2f} m/s ({why})"
    if site.signal:
        s = site.signal
        chip = f", {s.cycles_per_chip:g} cycles a chip" if s.cycles_per_chip else ""
        width = f", transducers {s.bandwidth_hz:g} Hz wide" if s.bandwidth_hz else ""
        keying = {"ask": "on-off keyed", "bpsk": "phase keyed (BPSK)"}[s.modulation]
        yield f"Signal: {s.carrier_hz:g} Hz, {keying}{chip}{width}"
    if site.schedule:
        every = f"every {site.schedule.period_s:g} s, " if site.schedule.period_s else ""
        clock = "synchronised" if site.schedule.synchronised else "recorder's clock offset unknown"
        clock = "each vehicle on a clock of its own" if site.own_clocks else clock
        yield f"Schedule: {every}{clock}"


def _plural(count: int, word: str) -> str:
    return f"{count} {word}" + ("" if count == 1 else "s")


def _where(node: Beacon | Microphone) -> str:
    if node.position_m is not None:
        return "({:g}, {:g}, {:g}) m".format(*node.position_m)
    return "on {} at ({:g}, {:g}, {:g}) m".format(node.vehicle, *node.lever_arm_m)


def _code_text(beacon: Beacon, chip_count: int | None) -> str:
    from sonofix import site as models

    match beacon.code:
        case None:
            return "none"
        case models.ChirpCode(start_hz=start, stop_hz=stop):
            return f"chirp {start:g}-{stop:g} Hz"
        case models.ReferenceCode(reference=name):
            return f"recorded burst {name}"
        case models.ChipsCode(family=family):
            return f"{family or 'no family'}, {chip_count} given chips"
        case models.MSequenceCode(taps=taps):
            kind = f"m-sequence, taps {list(taps)}"
        case models.GoldCode(index=index) | models.KasamiCode(index=index):
            kind = f"{beacon.code.family} {index}"
    return f"{kind}, {chip_count} chips"


def _beacon_table(recording: Recording, references: dict[str, ReferenceBurst]) -> RichTable:
    from rich.markup import escape
    from rich.table import Table

    from sonofix.files.figures import burst_s
    from sonofix.signals.waveform import chips_of

    site = recording.site
    table = Table("beacon", "where", "code", "burst", title=_plural(len(site.beacons), "beacon"), title_justify="left")
    for beacon in site.beacons[:MOST_ROWS]:
        chips = chips_of(beacon)
        code = _code_text(beacon, None if chips is None else len(chips))
        length = f"{1e3 * burst_s(site, beacon, references.get(beacon.id)):.4g} ms" if beacon.code else ""
        table.add_row(*map(escape, (beacon.id, _where(beacon), code, length)))
    return table


def _microphone_table(recording: Recording) -> RichTable:
    from rich.markup import escape
    from rich.table import Table

    site = recording.site
    title = f"{_plural(len(site.microphones), 'microphone')}, {_plural(len(site.vehicles), 'vehicle')}"
    table = Table("microphone", "where", "channel", title=title, title_justify="left")
    for microphone in site.microphones[:MOST_ROWS]:
        channel = "" if microphone.channel is None else str(microphone.channel)
        table.add_row(*map(escape, (microphone.id, _where(microphone), channel)))
    for vehicle in site.vehicles:
        level = "moves in height too" if vehicle.z_m is None else f"moves on level {vehicle.z_m:g} m"
        speed = "" if vehicle.max_speed_mps is None else f", up to {vehicle.max_speed_mps:g} m/s"
        table.add_row(escape(f"vehicle {vehicle.id}"), level + speed, "")
    return table


def _measurement_lines(recording: Recording, figures: CaptureFigures | None) -> Iterator[str]:
    import numpy as np

    from sonofix.files.figures import epoch_count

    if figures is not None and recording.rate_hz is not None:
        channels = len(figures.peak)
        yield (
            f"Capture: {figures.sample_count / recording.rate_hz:.3f} s, {figures.sample_count} samples at "
            f"{recording.rate_hz:g} Hz, {_plural(channels, 'channel')}"
        )
        for channel in range(channels):
            with np.errstate(divide="ignore"):
                peak, rms = (20 * np.log10(level[channel]) for level in (figures.peak, figures.rms))
            yield (
                f"  channel {channel}: peak {peak:.1f} dB, rms {rms:.1f} dB of full scale, "
                f"clipped {100 * figures.clipped[channel]:.3g} %, NaN {figures.not_finite[channel]}"
            )
        epochs = epoch_count(recording, figures.sample_count)
        source = "sync.csv" if recording.sync_s is not None else "one a period"
        if epochs is not None:
            yield f"Epochs: {epochs} ({source})"
    if recording.ranges is not None:
        rows = recording.ranges
        pairs = len(set(zip(rows.emitter, rows.receiver, strict=True)))
        yield (
            f"Ranges: {_plural(len(rows.time_s), 'row')} of {_plural(pairs, 'pair')}, at "
            f"{_plural(len(np.unique(rows.time_s)), 'instant')} in "
            f"{np.ptp(rows.time_s):.1f} s, {rows.range_m.min():.2f} to {rows.range_m.max():.2f} m"
        )
    if figures is None and recording.ranges is None and not {"exchanges", "positions"} & set(recording.tables):
        yield "No samples and no ranges: nothing to compute positions from."


def _table_lines(recording: Recording, truth: dict[str, Truth]) -> Iterator[str]:
    import numpy as np
    from rich.markup import escape

    for stem, table in recording.tables.items():
        count = len(next(iter(table.columns.values())))
        times = table.columns.get("time_s")
        span = f", {np.ptp(times):.1f} s" if times is not None else ""
        yield f"{stem}.csv: {_plural(count, 'row')}{span}"
    for vehicle, pose in truth.items():
        yield f"Truth of {escape(vehicle)}: {_plural(len(pose.time_s), 'row')}, {np.ptp(pose.time_s):.1f} s"


def _coverage_lines(recording: Recording) -> Iterator[str]:
    """Coverage of each level that a vehicle's microphone (or beacon, where it sounds) moves on."""
    import numpy as np
    from rich.markup import escape

    from sonofix.plan.coverage import coverage

    site = recording.site
    levels: dict[float, list[str]] = {}
    for vehicle in site.vehicles:
        mounted = [n for n in (*site.microphones, *site.beacons) if n.vehicle == vehicle.id]
        arm_m = mounted[0].lever_arm_m[2] if mounted else 0.0
        levels.setdefault((vehicle.z_m or 0.0) + arm_m, []).append(vehicle.id)
    fixed = [n.position_m for n in (*site.beacons, *site.microphones) if n.position_m is not None]
    if not fixed:
        yield "Coverage: no beacon or microphone is fixed, so no map can be drawn"
        return
    size_m = np.ptp(np.array(site.bounds_m or fixed)[:, :2], axis=0).max()
    for level_m, vehicles in levels.items():
        who = ", ".join(vehicles) + ("" if site.vehicle(vehicles[0]).z_m is not None else ", taken as z = 0")
        try:
            found = coverage(site, level_m, spacing_m=max(0.5, float(size_m) / MOST_GRID_POINTS))
        except ValueError as error:
            yield escape(f"Coverage: none can be told ({error})")
            continue
        fix = np.isfinite(found.hdop)
        text = f"Coverage of level {level_m:g} m ({who}): a fix at {100 * np.mean(fix):.0f} % of the places"
        if np.any(fix):
            low, middle, high = np.percentile(found.hdop[fix], [0, 50, 95])
            text += f", HDOP {low:.2f} at best, {middle:.2f} median, {high:.2f} at the 95th percentile"
        yield escape(text)
