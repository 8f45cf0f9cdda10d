"""`sonofix calibrate`: what a beacon really sends, learnt from a recording at a known distance."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import Stopped, drawing, figure_text, length_text, print_table, progress_bar, speaker, watched

if TYPE_CHECKING:
    from sonofix.records import Calibration, Recording
    from sonofix.site import Beacon, Site


def calibrate(
    recording: Annotated[Path, typer.Argument(help="Recording folder: site.toml and samples of the beacon at rest.")],
    beacon: Annotated[str | None, typer.Option(help="Id of the beacon. [default: the only one]")] = None,
    microphone: Annotated[str | None, typer.Option(help="Id of the microphone. [default: the only one]")] = None,
    distance: Annotated[
        float | None,
        typer.Option(
            help="From beacon to microphone (m). [default: as the site file places them]", min=1e-3, max=100.0
        ),
    ] = None,
    distance_sd: Annotated[
        float, typer.Option(help="Standard deviation of that distance (m).", min=0.0, max=10.0)
    ] = 1e-3,
    gate: Annotated[
        float,
        typer.Option(help="Sound later than this after a chip (s) is the room's; 0: keep it all.", min=0.0, max=0.01),
    ] = 2e-3,
    length: Annotated[
        float | None, typer.Option(help="Length of a burst whose code is not known (s). [default: as heard]", min=1e-4)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder to write to. [default: calibration/ in the recording]")
    ] = None,
    plot: Annotated[bool, typer.Option(help="Draw a picture.")] = True,
) -> None:
    """Learn a beacon's real burst, its delay and its clock from a recording at rest."""
    from sonofix import files
    from sonofix.files.calibration import read_for_calibration, safe_name, snippet, write_calibration
    from sonofix.survey.burst import calibrate as learn

    source = read_for_calibration(recording)
    site = source.site
    beacon_id = _chosen("beacon", beacon, [b.id for b in site.coded_beacons] or [b.id for b in site.beacons],
                        [b.id for b in site.beacons])  # fmt: skip
    microphones = [m.id for m in site.microphones if m.channel is not None]
    microphone_id = _chosen("microphone", microphone, microphones, [m.id for m in site.microphones])
    _check_channel(source, recording, microphone_id)
    _check_distance(source, beacon_id, microphone_id, distance)
    out = out or recording / "calibration"
    try:
        with progress_bar() as bar:
            task = bar.add_task(
                f"beacon {beacon_id}", total=None if source.sample_count is None else 2 * source.sample_count
            )
            learnt = learn(
                watched(source, lambda count: bar.advance(task, count)),
                beacon_id,
                microphone_id,
                distance_m=distance,
                distance_sd_m=distance_sd,
                gate_s=gate or None,
                length_s=length,
            )
        written = write_calibration(out, site, learnt)
    except KeyboardInterrupt:
        raise Stopped("stopped; nothing was written") from None
    except ValueError as error:
        if type(error) is not ValueError:
            raise
        raise files.RecordingError([files.Problem(str(recording), "", None, str(error))]) from None
    _tell(site.beacon(beacon_id), site, learnt)
    picture = out / f"{safe_name(beacon_id)}.png"
    picture.unlink(missing_ok=True)
    if plot:
        _draw(picture, learnt, site.name)
    say = speaker()
    say.print(f"\nFor site.toml, with {written[0].name} beside it:\n")
    say.print(snippet(site, learnt))
    say.print(f"Written to {out}")


def _chosen(kind: str, given: str | None, likely: list[str], known: list[str]) -> str:
    """Return the id that was given, or the only one there is."""
    if given is not None and given in known:
        return given
    names = ", ".join(known) or "none"
    if given is not None:
        raise ValueError(f"--{kind} {given}: the site has no such {kind}; it has {names}")
    if len(likely) != 1:
        raise ValueError(f"which {kind}? Name one with --{kind}: {names}")
    return likely[0]


def _check_channel(source: Recording, folder: Path, microphone_id: str) -> None:
    """Refuse a microphone that the capture does not hold."""
    channel = source.site.microphone(microphone_id).channel
    if source.blocks is None or channel is None:
        return
    first = next(source.blocks(1), None)
    if first is not None and channel >= first.shape[1]:
        raise ValueError(
            f"{folder}: microphone {microphone_id} is on channel {channel}, but the capture has {first.shape[1]}, from "
            "0 on"
        )


def _check_distance(source: Recording, beacon_id: str, microphone_id: str, distance_m: float | None) -> None:
    """Ask for a distance where a delay can be told, and it alone is missing."""
    from sonofix.survey.burst import placed_distance_m

    schedule = source.site.schedule
    if schedule is None or not schedule.synchronised or distance_m is not None:
        return
    if placed_distance_m(source, beacon_id, microphone_id) is None:
        raise ValueError(
            f"how far is beacon {beacon_id} from microphone {microphone_id}? Give --distance in m, or position_m of "
            "both in site.toml; without it there is no delay"
        )


def _tell(before: Beacon, site: Site, learnt: Calibration) -> None:
    """Print what was learnt: a figure and its deviation a row."""
    pace = learnt.pace
    used = learnt.heard - sum(learnt.left_out.values())
    why = ", ".join(f"{count} {reason}" for reason, count in learnt.left_out.items())
    rows: dict[str, tuple[str, str]] = {"bursts used": (f"{used} of {learnt.heard}", "")}
    if why:
        rows["left out"] = (why, "")
    if learnt.distance_m is not None:
        rows["distance"] = (f"{learnt.distance_m:.4f} m", f"± {length_text(learnt.distance_sd_m)}")
    if learnt.delay_s is not None and learnt.delay_sd_s is not None and learnt.delay_total_sd_s is not None:
        rows["delay"] = (_micro(learnt.delay_s), f"± {_micro(learnt.delay_sd_s)} by noise and jitter")
        rows[" "] = ("", f"± {_micro(learnt.delay_total_sd_s)} with distance and air")
        off_m = site.sound_speed_mps * (learnt.delay_s - before.delay_s)
        rows["ranges by the old site file"] = (
            f"{length_text(abs(off_m))} too {'long' if off_m > 0 else 'short'}",
            f"± {length_text(site.sound_speed_mps * learnt.delay_total_sd_s)}",
        )
    rows["amplitude"] = (f"{learnt.amplitude:.4g} of full scale", f"± {learnt.amplitude_sd:.2g} from burst to burst")
    rows["SNR of one burst"] = (f"{learnt.snr_db:.1f} dB", f"averaging adds {learnt.snr_gain_db:.1f} dB")
    rows["likeness to the nominal burst"] = (figure_text(learnt.match, ".4f"), "")
    if learnt.stretch is not None and learnt.stretch_sd is not None:
        rows["carrier off the nominal"] = (
            f"{1e6 * learnt.stretch:+.3f} ppm",
            f"± {1e6 * learnt.stretch_sd:.2g} ppm by noise",
        )
    if learnt.delay_s is None:
        period_s = learnt.period_s * (1 + pace.rate)
        rows["period"] = (f"{period_s:.9f} s", f"± {learnt.period_s * pace.rate_sd:.2g} s")
    rate = (f"{1e6 * pace.rate:+.4f} ppm", f"± {1e6 * pace.rate_sd:.2g} ppm")
    rows["rate" if learnt.delay_s is None else "drift against the schedule"] = rate
    if pace.drift_per_s is not None and pace.drift_sd_per_s is not None:
        rows["drift of the rate"] = (
            f"{3600e6 * pace.drift_per_s:+.3g} ppm an hour", f"± {3600e6 * pace.drift_sd_per_s:.2g} ppm an hour"
        )  # fmt: skip
    rows["jitter, rms"] = (_micro(pace.jitter_s), "")
    if len(pace.allan):
        last = len(pace.allan) - 1
        spans = f"over {pace.allan_tau_s[0]:.3g} s; {pace.allan[last]:.2g} over {pace.allan_tau_s[last]:.3g} s"
        rows["Allan deviation"] = (f"{pace.allan[0]:.2g}", spans)
    for i, echo in enumerate(learnt.echoes):
        rows["echoes" if not i else "  " + " " * i] = (f"{echo.gain_db:.0f} dB", f"{1e3 * echo.delay_s:.2f} ms later")
    print_table(f"Beacon {learnt.beacon} at microphone {learnt.microphone}", ("", ""), rows)
    for flag in learnt.flags:
        speaker().print(f"Note: {flag}")


def _micro(time_s: float) -> str:
    """Write a short time in µs, or ns where that reads better."""
    return f"{1e9 * time_s:.2f} ns" if abs(time_s) < 1e-7 else f"{1e6 * time_s:.3f} µs"


def _draw(picture: Path, learnt: Calibration, name: str) -> None:
    """Draw the picture; say so where Matplotlib is not installed."""
    with drawing():
        from sonofix.draw.calibration import draw_calibration

        draw_calibration(learnt, f"Beacon {learnt.beacon}, {name}").savefig(picture)
