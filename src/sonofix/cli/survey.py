"""`sonofix survey`: where the beacons are, from a drive among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import Stopped, counted, drawing, length_text, print_table, progress_bar, speaker, watched

if TYPE_CHECKING:
    from sonofix.records import RangeEpoch, Recording, Survey, SurveyedBeacon
    from sonofix.site import Site

_KINDS = ("beacon", "pair", "none")
_SOUND_BIAS_M, _STATED_BIAS_M = 0.1, 0.3


def survey(
    recording: Annotated[Path, typer.Argument(help="Recording folder of a drive: site.toml and samples or ranges.")],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Site file to write. [default: site_corrected.toml in the recording]"),
    ] = None,
    guess_sd: Annotated[
        float | None,
        typer.Option(
            help="Take every beacon's place as a guess of this deviation (m). [default: position_sd_m of each]",
            min=1e-6,
            max=1000.0,
        ),
    ] = None,
    known: Annotated[
        list[str] | None, typer.Option(help="Id of a beacon whose place is known; can be repeated.")
    ] = None,
    ignore_guesses: Annotated[
        bool, typer.Option("--ignore-guesses", help="Do not look at guesses: places come from ranges alone.")
    ] = False,
    biases: Annotated[
        str, typer.Option(help="Delays to find: one for each beacon, for each pair with a microphone, or none.")
    ] = "beacon",
    bias_sd: Annotated[
        float | None,
        typer.Option(
            help="What they are expected to be (m of way). [default: 0.1; 0.3 for ranges.csv]", min=1e-6, max=100.0
        ),
    ] = None,
    sound_speed_sd: Annotated[
        float | None,
        typer.Option(
            help="Deviation of the sound speed (m/s). [default: 0 where stated, else by the thermometer]",
            min=0.0,
            max=30.0,
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Write over what is there (never over files of the recording).")
    ] = False,
    as_json: Annotated[
        Path | None, typer.Option("--json", help="Write all that was found, with covariance, to this file.")
    ] = None,
    plot: Annotated[bool, typer.Option(help="Draw a picture beside the site file.")] = True,
) -> None:
    """Find beacons, their delays and the sound speed from a drive among them; write a corrected site file.

    Drive for a minute or more, neither straight nor in one circle, close by every beacon and far from it. Beacons with
    position_sd_m above 0 are guesses and move; others are known and stay. For example:

    sonofix survey hall -o hall/site_corrected.toml
    """
    from sonofix import files
    from sonofix.files import survey_writing as writing
    from sonofix.files.site_file import FILE_NAME, read_text
    from sonofix.survey.places import Wishes
    from sonofix.survey.places import survey as find
    from sonofix.survey.sites import corrected, marked

    if biases not in _KINDS:
        raise ValueError(f"--biases {biases}: one of {', '.join(_KINDS)}")
    source = files.read_recording(recording, to_run=True)
    origin = recording / FILE_NAME
    target = out or recording / "site_corrected.toml"
    picture = target.parent / f"{target.stem}.png"
    targets = {"site file": target, **({"JSON": as_json} if as_json else {}), **({"picture": picture} if plot else {})}
    writing.check_targets(targets, recording, source.site, force)
    site = marked(source.site, guess_sd, known or [])
    stated = source.blocks is None
    usual = _STATED_BIAS_M if stated else _SOUND_BIAS_M
    wishes = Wishes(ignore_guesses, biases, bias_sd or usual, sound_speed_sd)
    try:
        with progress_bar() as bar:
            listening = bar.add_task("listening", total=source.sample_count)
            epochs = _heard(replace(source, site=site), lambda n: bar.advance(listening, n))
            if not epochs:
                raise ValueError(f"{recording}: nothing was heard; `sonofix check` and `sonofix explain` tell why")
            adjusting = bar.add_task("adjusting", total=None)
            found = find(site, epochs, wishes, lambda: bar.advance(adjusting))
    except KeyboardInterrupt:
        raise Stopped("stopped; nothing was written") from None
    if found.status == "failed":
        raise ValueError(f"{recording}: no survey: {found.remedy}")
    text = writing.corrected_text(read_text(origin, FILE_NAME), source.site, corrected(site, found, not stated))
    try:
        writing.write_site(target, text)
        if as_json is not None:
            writing.write_survey(as_json, found)
        written = [target, *([as_json] if as_json else [])]
        if plot and _draw(picture, site, found):
            written.append(picture)
    except KeyboardInterrupt:
        raise Stopped(f"stopped; not all was written beside {target}") from None
    # told once all is written: whoever reads may leave early
    _tell(site, found, stated)
    speaker().print(f"\nWritten: {', '.join(map(str, written))}")


def _heard(source: Recording, seen: Callable[[int], None]) -> list[RangeEpoch]:
    """Range a drive without believing any place."""
    from sonofix.flow import run
    from sonofix.ranging import stated_epochs
    from sonofix.survey.sites import unplaced

    if source.blocks is None and source.ranges is not None:
        return stated_epochs(source.ranges, source.site)
    listened = replace(watched(source, seen), site=unplaced(source.site), tables={})
    return [step.ranges for step in run(listened) if len(step.ranges)]


def _tell(site: Site, found: Survey, stated: bool) -> None:
    """Print what was found: beacon by beacon, then what all share, then what stays unknown."""
    import numpy as np

    say = speaker()
    columns = ("moved by", "x", "y", "z", "sd x", "sd y", "sd z", "late by", "± sd", "used", "residual")
    rows = {beacon.id: _row(beacon) for beacon in found.beacons}
    title = f"{site.name}: {counted(len(rows), 'beacon')}, {counted(found.rows, 'range')}"
    if rows:
        print_table(title, columns, rows)
    else:
        say.print(f"{title}; no beacon is fixed")
    if found.pairs:
        pairs = {
            f"{p.emitter} → {p.receiver}" if p.emitter else f"at {p.receiver}": (
                length_text(p.bias_m),
                length_text(p.sd_m),
            )
            for p in found.pairs
        }
        print_table("Ranges too long", ("by", "± sd"), pairs)
    say.print()
    say.print(f"Frame: {found.gauge}.")
    if found.frame_sd:
        parts = [
            f"{key[:-2]} ± {length_text(sd)}" if key.endswith("_m") else f"{key[:-4]} ± {np.degrees(sd):.2g}°"
            for key, sd in found.frame_sd.items()
        ]
        say.print(f"       The guesses tell it to {', '.join(parts)}.")
    say.print(f"Sound speed: {_speed_text(found)}.")
    if found.clock_offset_m is not None and found.clock_drift_mps is not None:
        c = found.sound_speed_prior_mps
        drift = 1e6 * found.clock_drift_mps / c
        say.print(f"Clock: offset {1e3 * found.clock_offset_m / c:.3f} ms, drift {drift:+.3f} ppm.")
    before = f"{length_text(found.before_m)} before, " if np.isfinite(found.before_m) else ""
    rates = f"; range rates {1e3 * found.rate_after_mps:.2g} mm/s" if np.isfinite(found.rate_after_mps) else ""
    left_out = f"; {counted(found.excluded, 'range')} left out" if found.excluded else ""
    say.print(f"Residuals of ranges, rms: {before}{length_text(found.after_m)} after{rates}{left_out}.")
    if found.inflation > 1.3:
        say.print(f"Note: ranges scatter {found.inflation:.1f} times as much as they state; deviations are so widened.")
    for event in found.events:
        say.print(f"Note: {event.detail}.")
    if found.beacons and not any(beacon.before_sd_m != 0.0 for beacon in found.beacons):
        say.print("Note: no beacon is marked as a guess (position_sd_m, --guess-sd): none was moved.")
    if stated and found.beacons and any(b.bias_m is not None for b in found.beacons):
        say.print("Note: ranges.csv is taken as it stands, so these delays are not written to the site file.")
    if stated and found.pairs and found.sound_speed_prior_sd_mps:
        scale = 100 * (found.sound_speed_prior_mps / found.sound_speed_mps - 1.0)
        say.print(
            f"Note: these biases go with ranges {scale:+.2f} % too long. A site file states that for times of flight "
            "alone ([air] sound_speed_mps); for ranges in metres leave --sound-speed-sd out."
        )
    if found.open:
        say.print("\nThis drive does not tell (deviation by the drive alone, and with what was known):")
        for direction in found.open[:24]:
            alone = length_text(direction.drive_sd_m) if direction.drive_sd_m < 1e3 else "nothing"
            say.print(f"  {direction.text}: {alone}, {length_text(direction.sd_m)}")
        if len(found.open) > 24:
            say.print(f"  and {len(found.open) - 24} more directions")
    if found.mirror:
        say.print(f"\nUndecided: {found.mirror}.")
    if found.open:
        say.print(f"Remedy: {found.remedy}.")


def _row(beacon: SurveyedBeacon) -> tuple[str, ...]:
    import numpy as np

    if not beacon.heard:
        return ("not heard", *(f"{v:.3f}" for v in beacon.position_m), "", "", "", "", "", "", "")
    fixed = not np.any(beacon.covariance_m2)
    moved = "known" if fixed else length_text(float(np.linalg.norm(beacon.position_m - beacon.before_m)))
    return (
        moved,
        *(f"{v:.4f}" for v in beacon.position_m),
        *(("",) * 3 if fixed else (length_text(float(sd)) for sd in beacon.sd_m)),
        length_text(beacon.bias_m),
        length_text(beacon.bias_sd_m),
        f"{beacon.used} of {beacon.heard}",
        length_text(beacon.residual_m) if beacon.used else "",
    )


def _speed_text(found: Survey) -> str:
    if not found.sound_speed_prior_sd_mps:
        return f"{found.sound_speed_mps:.2f} m/s, taken as it is (--sound-speed-sd lets it move)"
    told = found.sound_speed_sd_mps < 0.9 * found.sound_speed_prior_sd_mps
    text = f"{found.sound_speed_mps:.3f} ± {found.sound_speed_sd_mps:.3f} m/s"
    began = f"began with {found.sound_speed_prior_mps:.3f} ± {found.sound_speed_prior_sd_mps:.3f}"
    return f"{text} ({began}{'' if told else '; the drive tells nothing of it: two known beacons would'})"


def _draw(picture: Path, site: Site, found: Survey) -> bool:
    """Draw the picture; say so where Matplotlib is not installed."""
    with drawing():
        from sonofix.draw.survey import draw_survey
        from sonofix.files.survey_writing import write_picture

        figure = draw_survey(found, site.name, site.bounds_m)
        write_picture(picture, lambda part: figure.savefig(part, format="png"))
        return True
    return False
