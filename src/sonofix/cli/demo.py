"""`sonofix demo`: a hall made up, driven through, run, scored and drawn."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import progress_bar, speaker

if TYPE_CHECKING:
    from sonofix.channel import Motion
    from sonofix.site import Site

RATE_HZ = 192_000
SNR_DB = 6.0
PERIOD_S = 0.25

_BEACONS = {
    "B1": (0.9, 0.9, 3.4),
    "B2": (4.3, 0.8, 3.1),
    "B3": (8.1, 1.0, 3.5),
    "B4": (11.3, 3.1, 3.2),
    "B5": (11.2, 8.0, 3.4),
    "B6": (7.4, 8.1, 3.0),
    "B7": (3.2, 8.2, 3.5),
    "B8": (0.8, 5.2, 3.2),
}
# Two aisles and a crossing: out along the south wall, back through the middle, home along the north.
_WAY = ((1.9, 2.1), (9.8, 1.9), (10.0, 5.0), (5.9, 5.3), (5.6, 7.2), (2.0, 7.0), (1.9, 2.1))
_CORNER_M = 1.2


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the recording; its out/ takes the results.")] = (
        Path("demo")
    ),
    seconds: Annotated[float, typer.Option(help="Length of the drive.", min=1.0, max=600.0)] = 20.0,
) -> None:
    """Simulate a drive through a hall, run the receiver on it, draw.

    Eight beacons on the ceiling, a vehicle on its round below: what it would hear is written as a recording, which is
    then run and scored like any other.
    """
    from sonofix import files
    from sonofix.channel import direct_gains, level_below, noise_for_snr, simulate
    from sonofix.cli.run import run_folder
    from sonofix.signals.waveform import waveforms_of

    site = demo_site()
    motions = {"agv": demo_motion(seconds)}
    waveforms = waveforms_of(site)
    gains = direct_gains(site, motions, waveforms, seconds)
    level = level_below(0.5, gains, waveforms)
    recording, truth = simulate(
        site,
        motions,
        rate_hz=RATE_HZ,
        duration_s=seconds,
        waveforms=waveforms,
        level=level,
        noise_sd=noise_for_snr(SNR_DB, level, gains, waveforms),
        seed=1,
    )
    _check_folder(out)
    say = speaker()
    say.print(f"A hall of 12 m × 9 m, eight beacons, a vehicle on its round for {seconds:g} s; {SNR_DB:g} dB SNR.")
    with progress_bar() as bar:
        task = bar.add_task("simulating", total=recording.sample_count)
        files.write_recording(
            out, recording, truth, overwrite=True, on_block=lambda done: bar.update(task, completed=done)
        )
    run_folder(out, out / "out", plot=True, rate_hz=None)
    if (out / "out" / "track.png").exists():
        say.print(f"Picture: {out / 'out' / 'track.png'}")


def demo_site() -> Site:
    """Return the demonstration's hall: eight ceiling beacons, each with its own m-sequence of degree 9."""
    from sonofix.signals.codes import primitive_taps
    from sonofix.site import Site

    taps = primitive_taps(9)
    return Site.model_validate(
        {
            "site": {"name": "Demonstration hall", "bounds_m": [[0, 0, 0], [12, 9, 3.6]]},
            "schedule": {"period_s": PERIOD_S, "synchronised": True},
            "signal": {"carrier_hz": 40e3, "modulation": "ask", "cycles_per_chip": 10, "bandwidth_hz": 4e3},
            "vehicle": [{"id": "agv", "z_m": 0.0, "max_speed_mps": 2.0}],
            "beacon": [
                {"id": name, "position_m": place, "code": {"family": "m-sequence", "degree": 9, "taps": taps[i]}}
                for i, (name, place) in enumerate(_BEACONS.items())
            ],
            "microphone": [{"id": "M1", "channel": 0, "vehicle": "agv", "lever_arm_m": [0.0, 0.0, 0.4]}],
        }
    )


def demo_motion(seconds: float) -> Motion:
    """Return a round through the hall that ends where it began after the given time, at 0.4 to 1.5 m/s."""
    from sonofix.channel import Waypoints

    points = tuple((x, y, 0.0) for x, y in _WAY)
    length_m = Waypoints(points, 1.0, radius_m=_CORNER_M).length_m
    return Waypoints(points, min(max(length_m / seconds, 0.4), 1.5), radius_m=_CORNER_M)


def _check_folder(out: Path) -> None:
    """Refuse a folder that holds anything but an earlier demonstration.

    Raises
    ------
    RecordingError
        If something else stands there.
    """
    from sonofix import files

    if not out.exists():
        return
    ours = out.is_dir() and (not any(out.iterdir()) or files.read_site(out / "site.toml").name == demo_site().name)
    if not ours:
        remedy = "holds something else than an earlier demonstration; choose another folder with -o"
        raise files.RecordingError([files.Problem(str(out), "", None, remedy)])
