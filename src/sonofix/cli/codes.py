"""`sonofix codes`: choose codes for a number of beacons, and show how much they disturb each other."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import Stopped, counted, drawing, print_table, progress_bar, speaker

if TYPE_CHECKING:
    from sonofix.cli.codes_task import Task
    from sonofix.plan.codes import Candidate, ChipCode, CodeSet
    from sonofix.plan.crosstalk import Grid, OnDone
    from sonofix.records import Waveform
    from sonofix.site import Signal


def codes(
    site: Annotated[
        Path | None,
        typer.Option(help="Site file, or recording folder: signal, beacons, reach and speed are taken from it."),
    ] = None,
    count: Annotated[
        int | None, typer.Option(help="Codes wanted.", show_default="the site's beacons on one carrier; 8")
    ] = None,
    degree: Annotated[
        int | None, typer.Option(help="Degree n: codes of 2ⁿ − 1 chips.", show_default="the site's; 9")
    ] = None,
    family: Annotated[
        list[str] | None,
        typer.Option(help="m-sequence, gold or kasami; can be repeated.", show_default="all that have the degree"),
    ] = None,
    chips: Annotated[
        Path | None, typer.Option(help="Text file to choose from in place of families: a code of 0 and 1 a line.")
    ] = None,
    reach: Annotated[
        float | None,
        typer.Option(help="Bursts are heard this far, m (inf: any delay).", show_default="the site's; 15"),
    ] = None,
    max_speed: Annotated[
        float | None,
        typer.Option(
            help="Speed of vehicles, m/s. They may near one beacon and leave another: rates differ by twice as much.",
            show_default="the site's; 2",
        ),
    ] = None,
    carrier: Annotated[float | None, typer.Option(help="Carrier, Hz.", show_default="the site's; 40000")] = None,
    cycles: Annotated[float | None, typer.Option(help="Carrier cycles a chip.", show_default="the site's; 10")] = None,
    bandwidth: Annotated[
        float | None,
        typer.Option(help="Bandwidth of one transducer, Hz; inf: none.", show_default="the site's; 4000"),
    ] = None,
    modulation: Annotated[
        str | None, typer.Option(help="ask (on-off) or bpsk.", show_default="the site's; ask")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same codes.", min=0)] = 0,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for codes.toml, codes.csv and codes.png.")
    ] = None,
    plot: Annotated[bool, typer.Option(help="Draw codes.png.")] = True,
) -> None:
    """Choose codes for beacons: those whose worst pair disturbs least.

    Judged is the loudest that one beacon's burst can be in the search for another's, over all delays and range rates of
    the site: a burst is heard once, stretched by motion, through its transducers. For example:

    sonofix codes --count 8 --degree 9 --reach 15 --max-speed 2 -o codes
    """
    from sonofix.cli.codes_task import task_of
    from sonofix.plan.codes import choose, measure

    task = task_of(site, count, degree, reach, max_speed, carrier, cycles, bandwidth, modulation)
    candidates = _candidates(task, family, chips)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    with _stoppable("no codes were chosen"), _bars() as bar:
        pool, bursts, grid = _laid_out(task, candidates, bar("a first look at each"))
        chosen = choose(bursts, task.count, grid, seed, bar("comparing pairs"), bar("measuring sets"))
        first = measure([_burst(c, task.signal) for c in candidates[: task.count]], grid, bar("measuring the first"))
        present = _present(task, bar("measuring the site's")) if len(task.present) > 1 else None
    named = [candidates[pool[k]].code for k in chosen.members]
    _tell(task, named, chosen, grid, len(candidates), len(pool))
    _compare(task, chosen, first, present)
    speaker().print()
    for beacon, code in zip(task.ids, named, strict=True):
        speaker().print(f"code = {toml(code)}  # {beacon}")
    if out is not None:
        with _stoppable(f"not all was written to {out}"):
            _write(out, task, named, chosen)
            if plot:
                _draw(out / "codes.png", task, named, chosen, [bursts[k] for k in chosen.members], grid)
        speaker().print(f"Written to {out}")


@contextmanager
def _stoppable(kept: str) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        raise Stopped(f"stopped; {kept}") from None


@contextmanager
def _bars() -> Iterator:
    """Yield what opens a bar with a name; the bar is told the share that is done."""
    with progress_bar() as bars:

        def opened(name: str) -> OnDone:
            task = bars.add_task(name, total=1.0)
            return lambda share: bars.update(task, completed=share)

        yield opened


def _candidates(task: Task, families: list[str] | None, chips: Path | None) -> list[Candidate]:
    """Return what there is to choose from.

    Raises
    ------
    ValueError
        If that is less than wanted, or the options contradict each other.
    """
    from sonofix.cli.codes_task import told_chips
    from sonofix.plan.codes import FAMILIES, family_candidates

    if chips is not None:
        if families:
            raise ValueError(f"--family {families[0]} and --chips {chips}: codes come from one or the other; drop one")
        candidates, source = told_chips(chips), str(chips)
    else:
        for family in families or ():
            if family not in FAMILIES:
                raise ValueError(f"--family {family}: families are {', '.join(FAMILIES)}")
        try:
            candidates = family_candidates(task.degree, families or FAMILIES)
        except ValueError as error:
            words = str(error).removeprefix(f"degree = {task.degree}").lstrip("; ")
            raise ValueError(f"--degree {task.degree}: {words}") from None
        source = f"degree {task.degree}" + (f" of {', '.join(families)}" if families else "")
    if task.count > len(candidates):
        raise ValueError(
            f"--count {task.count}: {source} has {counted(len(candidates), 'code')}; ask for fewer, or take another"
            " degree or family"
        )
    return candidates


def _burst(candidate: Candidate, signal: Signal) -> Waveform:
    from sonofix.signals.waveform import keyed_waveform

    return keyed_waveform(candidate.chips, signal)


def _laid_out(task: Task, candidates: list[Candidate], on_done: OnDone) -> tuple[list[int], list[Waveform], Grid]:
    """Return the candidates that are compared, by index, their bursts and the grid."""
    from sonofix.plan.codes import affordable, quiet_alone
    from sonofix.plan.crosstalk import make_grid

    asked = (task.reach_m, task.max_difference_mps, task.sound_speed_mps)
    longest = max(candidates, key=lambda candidate: len(candidate.chips))
    burst = _burst(longest, task.signal)
    grid = make_grid([burst], *asked)
    most = affordable(task.count, burst, grid)
    pool = quiet_alone(candidates, most, lambda candidate: _burst(candidate, task.signal), grid, on_done)
    bursts = [_burst(candidates[i], task.signal) for i in pool]
    return pool, bursts, make_grid(bursts, *asked)


def _present(task: Task, on_done: OnDone) -> CodeSet:
    """Measure what the site's beacons send now, on a grid of their own: they may be longer, or chirps."""
    from sonofix.plan.codes import measure
    from sonofix.plan.crosstalk import make_grid

    heard = list(task.present.values())
    return measure(heard, make_grid(heard, task.reach_m, task.max_difference_mps, task.sound_speed_mps), on_done)


def code_name(code: ChipCode) -> str:
    """Write a code in a few signs: "m9 4", "gold9 17", "kasami8 3", "0110… (31)"."""
    from sonofix.site import ChipsCode, MSequenceCode

    if isinstance(code, ChipsCode):
        return f"{code.chips[:6]}… ({len(code.chips)})"
    if isinstance(code, MSequenceCode):
        return f"m{code.degree} {','.join(map(str, code.taps))}"
    return f"{code.family}{code.degree} {code.index}"


def toml(code: ChipCode) -> str:
    """Write a code as a site file has it."""
    values = code.model_dump(exclude_none=True)
    return "{ " + ", ".join(f"{name} = {json.dumps(_plain(value))}" for name, value in values.items()) + " }"


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _tell(task: Task, named: list[ChipCode], chosen: CodeSet, grid: Grid, total: int, compared: int) -> None:
    import numpy as np

    apart = np.where(np.eye(task.count, dtype=bool), -np.inf, chosen.level_db)
    rows = {
        beacon: (
            code_name(named[k]),
            f"{chosen.level_db[k, k]:.1f} dB",
            f"{apart[k].max():.1f} dB",
            f"{apart[:, k].max():.1f} dB",
            task.ids[int(np.argmax(np.maximum(apart[k], apart[:, k])))],
        )
        for k, beacon in enumerate(task.ids)
    }
    columns = ("code", "own side lobe", "in others' search", "others in its search", "most with")
    print_table(f"{counted(task.count, 'code')} of {total}: worst pair {chosen.worst_db:.1f} dB", columns, rows)
    say = speaker()
    every = grid.span_s < task.reach_m / task.sound_speed_mps
    way = "every delay at which bursts overlap" if every else f"delays within ±{task.reach_m:.1f} m of way"
    say.print()
    say.print(f"Judged over {way} and range rates up to {task.max_difference_mps:g} m/s apart; {task.describe()}.")
    if compared < total:
        say.print(f"Pairs were compared of the {compared} codes with the least side lobes of their own.")
    if task.remark:
        say.print(task.remark)


def _compare(task: Task, chosen: CodeSet, first: CodeSet, present: CodeSet | None) -> None:
    say = speaker()
    say.print(f"The first {task.count} of the list would have: {first.worst_db:.1f} dB.")
    if present is not None:
        names = list(task.present)
        i, j = present.worst_pair
        say.print(
            f"The site's present codes have: {present.worst_db:.1f} dB ({names[i]} in the search for {names[j]});"
            f" the chosen ones {_against(chosen.worst_db - present.worst_db)}."
        )


def _against(more_db: float) -> str:
    return f"are {abs(more_db):.1f} dB {'louder' if more_db > 0 else 'quieter'}"


def _write(out: Path, task: Task, named: list[ChipCode], chosen: CodeSet) -> None:
    """Write codes.toml (a beacon a table) and codes.csv (a level a row)."""
    import csv

    tables = [
        f"[[beacon]]\nid = {json.dumps(beacon, ensure_ascii=False)}\ncode = {toml(code)}\n"
        for beacon, code in zip(task.ids, named, strict=True)
    ]
    head = f"# Worst pair {chosen.worst_db:.1f} dB; {task.describe()}.\n"
    (out / "codes.toml").write_text("\n".join([head, *tables]), encoding="utf-8")
    with (out / "codes.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(("sent", "listened_for", "worst_db"))
        rows.writerows(_level_rows(task.ids, chosen))


def _level_rows(ids: list[str], chosen: CodeSet) -> Iterable[tuple[str, str, str]]:
    for i, sent in enumerate(ids):
        for j, listened in enumerate(ids):
            yield sent, listened, f"{chosen.level_db[i, j]:.2f}"


def _draw(
    picture: Path, task: Task, named: list[ChipCode], chosen: CodeSet, bursts: list[Waveform], grid: Grid
) -> None:
    """Draw the picture; say so where Matplotlib is not installed."""
    from sonofix.plan.crosstalk import Bench, level_db

    with drawing():
        from sonofix.draw.codes import draw_codes

        i, j = chosen.worst_pair
        surface, difference_mps, delay_s = Bench([bursts[i], bursts[j]], grid).surface(0, 1)
        labels = [f"{beacon}  {code_name(code)}" for beacon, code in zip(task.ids, named, strict=True)]
        draw_codes(
            labels,
            chosen.level_db,
            level_db(surface),
            difference_mps,
            delay_s,
            task.sound_speed_mps,
            title=f"{counted(task.count, 'code')}{f' for {task.name}' if task.name else ''}",
            note=task.describe(),
        ).savefig(picture)
