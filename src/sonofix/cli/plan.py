"""`sonofix plan`: before holes are drilled, what a layout of beacons promises over the floor, and a better one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sonofix.cli.console import Stopped, counted, drawing, length_text, print_table, progress_bar, speaker

if TYPE_CHECKING:
    from sonofix.cli.plan_task import Task
    from sonofix.plan.quality import Nodes, OnDone
    from sonofix.records import Floats, Quality
    from sonofix.site import Site

OUTPUTS = ("plan.csv", "plan.png", "improved.toml")


def plan(
    site: Annotated[Path, typer.Argument(help="Site file, or recording folder.")],
    improve: Annotated[int | None, typer.Option(help="Place so many more beacons.", min=0, max=50)] = None,
    move: Annotated[
        bool,
        typer.Option("--move", help="Move beacons whose position_sd_m is above 0, too; they count as placed exactly."),
    ] = False,
    goal: Annotated[
        str | None,
        typer.Option(
            help="What --improve betters: error (deviation that 95 % of the floor stays within) or faults (share of the"
            " floor with a fix where a fault of --fault is detected).",
            show_default="error",
        ),
    ] = None,
    fault: Annotated[float, typer.Option(help="Fault of one range that is to be detected, m.")] = 0.5,
    places: Annotated[
        Path | None,
        typer.Option(
            help="Where beacons may go: GeoJSON Points, or CSV x_m,y_m,z_m.",
            show_default="ceiling and walls of bounds_m",
        ),
    ] = None,
    walls: Annotated[
        Path | None,
        typer.Option(
            help="Floor plan, GeoJSON in site metres: LineStrings and Polygons, height_m where not to the top."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="Folder for plan.csv, plan.png, improved.toml.",
            show_default="plan/ beside the site file",
        ),
    ] = None,
    spacing: Annotated[float, typer.Option(help="Grid, m.")] = 0.25,
    margin: Annotated[float, typer.Option(help="Strip along the edges that does not count, m.")] = 0.0,
    height: Annotated[
        float | None, typer.Option(help="Height of what listens, m.", show_default="the vehicle's z_m and lever arm")
    ] = None,
    vehicle: Annotated[str | None, typer.Option(help="Whose height counts.", show_default="the first")] = None,
    level: Annotated[
        float | None, typer.Option(help="Amplitude of a beacon at 1 m, full scale 1.", show_default="0.5")
    ] = None,
    noise_db: Annotated[float | None, typer.Option(help="Noise, dB of full scale (rms).", show_default="-50")] = None,
    rate: Annotated[float | None, typer.Option(help="Samples a second.", show_default="the capture's; 192000")] = None,
    snr: Annotated[
        str | None, typer.Option(help="In place of --level, as measured: snr_db@range_m of a row of ranges.csv.")
    ] = None,
    beam: Annotated[
        float | None,
        typer.Option(help="Full width of the beacons' beam at -6 dB, degrees.", show_default="alike all round"),
    ] = None,
    aim: Annotated[
        str | None,
        typer.Option(help="Where beams point: down, or centre (of the floor).", show_default="down"),
    ] = None,
    range_sd: Annotated[
        float | None,
        typer.Option(help="Deviation of every range, m, in place of a link budget.", show_default="0.1 without codes"),
    ] = None,
    reach: Annotated[
        float | None, typer.Option(help="No range is had from farther, m.", show_default="by the link budget")
    ] = None,
    temperature_sd: Annotated[
        float | None,
        typer.Option(help="Deviation of the air's temperature, K.", show_default="1; 0 with sound_speed_mps"),
    ] = None,
    plot: Annotated[bool, typer.Option(help="Draw plan.png.")] = True,
) -> None:
    """Map what the beacons promise over the floor, and place more where they help most.

    At each place: beacons heard, dilution of precision, expected deviation by the link budget, and the fault of a range
    that is detected (by the linear model). For example, two more beacons for a hall with shelves:

    sonofix plan hall/site.toml --walls shelves.geojson --improve 2
    """
    from sonofix.cli.plan_task import Loudness, task_of
    from sonofix.files.plan_writing import write_plan
    from sonofix.plan.quality import quality

    aimed = _goal(goal or "error")
    for name, value in (("--goal", goal), ("--places", places)):
        if value is not None and improve is None and not move:
            raise ValueError(f"{name} {value}: nothing is placed without --improve or --move; give one of them")
    if not 0 < fault < 1000:
        raise ValueError(f"--fault {fault:g}: it must be above 0 and below 1000, in m")
    asked = "--move" if improve is None else f"--improve {improve}"
    if move and improve is None:
        improve = 0
    loudness = Loudness(level, noise_db, rate, snr, beam, aim, range_sd, reach, temperature_sd)
    task = task_of(site, walls, vehicle, height, loudness)
    moving = [i for i, sd in enumerate(task.nodes.misplaced_m) if sd > 0] if move else []
    if moving:  # what is yet to be fastened is not misplaced
        task = replace(task, nodes=task.nodes.placed(moving))
    if improve == 0 and not moving:
        hint = "mark beacons as free by position_sd_m" if move else "give --move and mark beacons by position_sd_m"
        raise ValueError(f"{asked}: nothing to place; ask for one beacon or more with --improve, or {hint}")
    out = out or task.folder / "plan"
    for given in (site, walls, places):
        if given is not None and given.resolve() in [(out / name).resolve() for name in OUTPUTS]:
            raise ValueError(f"{given}: would be replaced by what is written to {out}; write to another folder with -o")
    candidates = None if places is None else _places(places, task)
    after, better, nodes = None, None, task.nodes
    kept = "nothing was written"
    with _bars() as bar:
        try:
            before = quality(task.site, nodes, task.terms, task.level_m, spacing, margin, bar("judging the floor"))
            if not before.floor.any():
                raise ValueError("the floor plan leaves no floor: an obstacle covers all of it; correct --walls")
            write_plan(out, before)
            kept = f"{out} holds the map of the beacons as they are"
            if improve is not None:
                on_done = bar("placing beacons")
                nodes, better = _improved(task, moving, improve, candidates, aimed, fault, spacing, margin, on_done)
                after = quality(task.site, nodes, task.terms, task.level_m, spacing, margin, bar("judging it anew"))
                write_plan(out, after, better)
        except KeyboardInterrupt:
            raise Stopped(f"stopped; {kept}") from None
    picture = out / "plan.png"
    picture.unlink(missing_ok=True)
    _tell(task, before, after, fault)
    if better is not None:
        _tell_places(task, nodes, moving, better)
    if plot:
        _draw(picture, task, nodes, moving, before, after, fault)
    speaker().print(f"Written to {out}")


def _places(path: Path, task: Task) -> Floats:
    """Read where beacons may go; refuse what no beacon can be fastened to."""
    from sonofix.cli.plan_task import check_places
    from sonofix.files.floor_plan import read_places

    found = read_places(path)
    check_places(found, task.site, task.level_m, path)
    return found


def _goal(text: str) -> Literal["error", "faults"]:
    if text == "error" or text == "faults":
        return text
    raise ValueError(f"--goal {text}: it must be error or faults")


@contextmanager
def _bars() -> Iterator:
    """Yield what opens a bar with a name; the bar is told the share that is done."""
    with progress_bar() as bars:

        def opened(name: str) -> OnDone:
            task = bars.add_task(name, total=1.0)
            return lambda share: bars.update(task, completed=share)

        yield opened


def _improved(
    task: Task,
    moving: list[int],
    count: int,
    candidates: Floats | None,
    goal: Literal["error", "faults"],
    fault_m: float,
    spacing_m: float,
    margin_m: float,
    on_done: OnDone,
) -> tuple[Nodes, Site]:
    """Return all nodes with some moved and added, and the site with them."""
    import numpy as np

    from sonofix.plan.extend import extended, free_ids, rounded
    from sonofix.plan.improve import candidates_of, improve
    from sonofix.plan.quality import Nodes, places_of

    walls, nodes = task.terms.walls, task.nodes
    if candidates is None:
        candidates = candidates_of(task.site, walls, task.level_m)
    _, _, floor, open_ = places_of(task.site, walls, task.level_m, spacing_m, margin_m)
    standing = [i for i in range(len(nodes)) if i not in moving]
    found = improve(
        nodes.pick(standing),
        nodes.pick(moving),
        count,
        rounded(candidates),
        floor[open_],
        task.terms,
        goal,
        fault_m,
        on_done,
    )
    ids = tuple(free_ids(task.site, count))
    position = nodes.position_m.copy()
    position[moving] = found.position_m[: len(moving)]
    new = Nodes(ids, found.position_m[len(moving) :], np.zeros(count), nodes.links[:1] * count)
    there = Nodes(nodes.ids, position, nodes.misplaced_m, nodes.links)
    moved = {nodes.ids[i]: position[i] for i in moving}
    return there.joined(new), extended(task.site, moved, dict(zip(ids, new.position_m, strict=True)))


def _figures(quality: Quality, fault_m: float) -> dict[str, str]:
    """Say a map in figures; empty where there is none."""
    import numpy as np

    def over(values: Floats, percent: float, form: str = "length") -> str:
        value = quality.over_floor(values, percent)
        if not np.isfinite(value):
            return "none is" if values is quality.fault_m else "no fix"
        return length_text(value) if form == "length" else f"{value:.2f}"

    heard = quality.heard[quality.floor]
    rows = {
        "floor with a fix": f"{100 * quality.share(quality.fix):.1f} %",
        "beacons heard, fewest and median": f"{heard.min()} and {np.median(heard):.0f}" if heard.size else "",
        "HDOP, median": over(quality.hdop, 50, "number"),
        "HDOP, 95 % of the floor within": over(quality.hdop, 95, "number"),
    }
    if quality.vdop is not None and quality.sd_z_m is not None:
        rows["VDOP, 95 % of the floor within"] = over(quality.vdop, 95, "number")
        rows["deviation of the height, 95 % of the floor within"] = over(quality.sd_z_m, 95)
    rows["expected deviation, median"] = over(quality.sd_m, 50)
    rows["expected deviation, 95 % of the floor within"] = over(quality.sd_m, 95)
    rows["fault detected on 95 % of the floor"] = over(quality.fault_m, 95)
    rows[f"floor where a fault of {length_text(fault_m)} is detected"] = (
        f"{100 * quality.share(quality.fault_m <= fault_m):.1f} %"
    )
    return rows


def _tell(task: Task, before: Quality, after: Quality | None, fault_m: float) -> None:
    shown = [_figures(q, fault_m) for q in (before, after) if q is not None]
    columns = ("", "") if after is None else ("before", "after")
    rows = {name: [each[name] for each in shown] for name in shown[0]}
    kind = "beacon" if any(b.position_m is not None for b in task.site.beacons) else "microphone"
    count = counted(len(task.nodes), kind)
    print_table(f"{task.site.name}: {count}, level {task.level_m:g} m", columns[: len(shown)], rows)
    say = speaker()
    say.print()
    for sentence in task.told:
        say.print(sentence)


def _tell_places(task: Task, nodes: Nodes, moving: list[int], better: Site) -> None:
    say = speaker()
    say.print()
    old = len(task.nodes)
    for i in [*moving, *range(old, len(nodes))]:
        to = "({:g}, {:g}, {:g}) m".format(*nodes.position_m[i])
        origin = "" if i >= old else " from ({:g}, {:g}, {:g}) m".format(*task.nodes.position_m[i])
        say.print(f"{nodes.ids[i]}: {'new at' if i >= old else 'moved'}{origin}{'' if i >= old else ' to'} {to}")
    bare = [b.id for b in better.beacons if b.id in nodes.ids[old:] and b.code is None]
    if bare and task.site.coded_beacons:
        say.print(f"No code is left for {', '.join(bare)}: give each one; `sonofix codes` chooses them.")
    elif len(nodes) > old and any(b.id in nodes.ids[old:] for b in better.beacons) and task.site.coded_beacons:
        say.print("improved.toml gives new beacons the next free codes; `sonofix codes --site` chooses better ones.")
    if any(getattr(b.code, "reference", None) for b in better.beacons):
        say.print("Recorded bursts are named relative to the site file: put improved.toml where site.toml stands.")


def _draw(
    picture: Path, task: Task, nodes: Nodes, moving: list[int], before: Quality, after: Quality | None, fault_m: float
) -> None:
    """Draw the picture; say so where Matplotlib is not installed."""
    with drawing():
        from sonofix.draw.quality import draw_quality

        old = len(task.nodes)
        added, moved = nodes.ids[old:], [nodes.ids[i] for i in moving]
        draw_quality(
            after or before,
            dict(zip(nodes.ids, nodes.position_m, strict=True)),
            task.terms.walls,
            title=task.site.name,
            note="  ·  ".join(sentence.rstrip(".") for sentence in task.told[:2]),
            before=None if after is None else before,
            fault_m=fault_m,
            added=added,
            moved={name: task.nodes.position_m[i] for name, i in zip(moved, moving, strict=True)},
            room_m=task.site.bounds_m,
        ).savefig(picture)
