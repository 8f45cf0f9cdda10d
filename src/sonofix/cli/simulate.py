"""`sonofix simulate`: make a recording folder from a site file and motions, with the truth beside it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonofix.cli.console import Stopped, counted, progress_bar

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sonofix.channel import Motion
    from sonofix.records import Recording, ReferenceBurst, Truth, Waveform
    from sonofix.site import Site

MOTION_HELP = """How the vehicle moves; lengths in m, speeds in m/s. still:x,y · line:x,y,vx,vy · circle:cx,cy,r,speed
(speed < 0: clockwise) · waypoints:x1,y1;x2,y2;…@speed (corners are rounded; ends where it began: laps) ·
csv:FILE (columns time_s, x_m, y_m and, if you like, z_m, yaw_rad, roll_rad, pitch_rad; stands before its first row and
after its last).
Repeat it for several vehicles."""


def simulate(
    site: Annotated[Path, typer.Argument(help="Site file (site.toml): what stands where, what it sends, what moves.")],
    out: Annotated[
        Path, typer.Argument(help="Folder to write: site.toml, capture.wav, truth.csv (and sync.csv, odometry.csv).")
    ],
    motion: Annotated[list[str] | None, typer.Option(help=MOTION_HELP)] = None,
    vehicle: Annotated[
        list[str] | None, typer.Option(help="Vehicle that a --motion is of, one for each, in the same order.")
    ] = None,
    z: Annotated[float, typer.Option(help="Height in m of vehicles whose z_m the site does not state.")] = 0.0,
    duration: Annotated[float, typer.Option(help="Length in s.")] = 10.0,
    rate: Annotated[int, typer.Option(help="Samples a second.")] = 192000,
    snr: Annotated[
        float | None,
        typer.Option(help="Mean power of the median burst over the noise in the whole band, dB.", show_default="10"),
    ] = None,
    noise_db: Annotated[
        float | None, typer.Option(help="Noise, dB of full scale (rms), in place of --snr; -inf for none.")
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(
            help="Amplitude of a beacon at 1 m, full scale 1.",
            show_default="as loud as keeps all sounds together below half scale",
        ),
    ] = None,
    echo: Annotated[
        float, typer.Option(help="What the six surfaces of the room (bounds_m) reflect, of the amplitude: 0 to 1.")
    ] = 0.0,
    absorption: Annotated[
        float | None, typer.Option(help="Absorption in dB/m.", show_default="ISO 9613-1 for the site's air")
    ] = None,
    tone_hz: Annotated[float | None, typer.Option(help="Frequency in Hz of an interfering tone.")] = None,
    tone_db: Annotated[float, typer.Option(help="Its amplitude, dB of full scale.")] = -20.0,
    clock_offset: Annotated[
        float,
        typer.Option(
            help="Start of the first epoch on the recorder's clock, s; unknown where beacons are not in sync."
        ),
    ] = 0.0,
    clock_ppm: Annotated[
        float, typer.Option(help="How much longer the beacons' second is than the recorder's, millionths.")
    ] = 0.0,
    clock: Annotated[
        list[str] | None,
        typer.Option(
            help="Where vehicles have clocks of their own, VEHICLE:OFFSET,PPM: what it shows at time 0 (s), and by how "
            "many millionths it runs fast; repeat it. The first vehicle's clock is right.",
            show_default="drawn: a quarter of a period and 20 ppm at most",
        ),
    ] = None,
    sync_jitter: Annotated[
        float, typer.Option(help="Standard deviation in s of sync commands; sync.csv tells when they came.")
    ] = 0.0,
    odometry: Annotated[
        float | None,
        typer.Option(
            help="Write odometry.csv as well, off by such a share: 0.02 is a lasting error of 2 % (1 σ) of speed and "
            "yaw rate, and noise that makes as much of a second's way."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same noise.")] = 0,
    flac: Annotated[bool, typer.Option("--flac", help="Write capture.flac: smaller, at most 8 channels.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a recording that is there already.")] = False,
) -> None:
    """Make a recording folder: what the site's microphones would hear, 16 bit, and the truth beside it.

    Sound is followed sample by sample from moving emitters to moving microphones. For example, a lap of a hall:

    sonofix simulate hall.toml lap --motion "waypoints:1,1;9,1;9,7;1,7;1,1@1.2" --snr 6

    Robots with clocks of their own ([schedule] own_clocks), of which one drives:

    sonofix simulate team.toml out --vehicle A --motion still:0,0 --vehicle B --motion line:5,0,0.3,0 --clock B:0.1,15
    """
    from sonofix import files

    if snr is not None and noise_db is not None:
        raise ValueError("--snr and --noise-db both set the noise; give one of them")
    plan = files.read_site(site)
    references = files.read_references(site.parent, plan)
    _check_folder(site, out, force, () if odometry is None else ("odometry",))
    motions = _motions(plan, motion or [], vehicle or [], z)
    waveforms = _waveforms(plan, references)
    recording, truth = _made(
        plan,
        motions,
        waveforms,
        duration_s=duration,
        rate_hz=rate,
        snr_db=10.0 if snr is None else snr,
        noise_db=noise_db,
        level=level,
        echo=echo,
        absorption=absorption,
        tone=None if tone_hz is None else (tone_hz, 10 ** (tone_db / 20)),
        clock=(clock_offset, 1e-6 * clock_ppm, sync_jitter),
        clocks=_clocks(plan, clock or [], seed),
        seed=seed,
    )
    if odometry is not None:
        from dataclasses import replace

        from sonofix.channel import odometry_of

        told = odometry_of(motions, duration, odometry, seed)
        recording = replace(recording, tables={**recording.tables, "odometry": told})
    _write(out, recording, truth, references, flac, force)
    heard = sum(m.channel is not None for m in plan.microphones)
    typer.echo(
        f"{out}: {duration:g} s at {rate} Hz, {counted(len(waveforms), 'beacon')}, "
        f"{counted(heard, 'microphone')}, {counted(len(truth), 'vehicle')}"
    )


def _check_folder(site: Path, out: Path, force: bool, made: tuple[str, ...]) -> None:
    """Refuse to write over the site file itself, or beside sensor files that another run measured (not ``made``)."""
    if site.resolve() == (out / "site.toml").resolve():
        raise ValueError(f"{out}: holds the site file itself, which would be rewritten; write to another folder")
    if (out / "site.toml").exists():
        if not force:
            raise ValueError(f"{out}: is a recording already; write to another folder, or give --force to replace it")
        from sonofix.files.recording import SENSOR_FILES

        stems = [stem for stem in ("ranges", *SENSOR_FILES) if stem not in made]
        others = [f"{stem}.csv" for stem in stems if (out / f"{stem}.csv").exists()]
        if others:
            raise ValueError(f"{out}: holds {', '.join(others)}, which would not fit new samples; move it away first")


def _motions(site: Site, told: list[str], ids: list[str], z_m: float) -> dict[str, Motion]:
    known = [v.id for v in site.vehicles]
    names = ids or known[:1]
    listed = ", ".join(known) or "none"
    if not known and not told:
        return {}
    if len(names) != len(told):
        raise ValueError(
            f"--motion is given {counted(len(told), 'time')}, for {counted(len(names), 'vehicle')} of the site's "
            f"({listed}); give each a --motion, and where there are several its name by --vehicle"
        )
    for name in names:
        if name not in known:
            raise ValueError(f"--vehicle {name}: the site has no such vehicle; it has {listed}")
        if names.count(name) > 1:
            raise ValueError(f"--vehicle {name}: is given twice; a vehicle has one motion")
    left = [name for name in known if name not in names]
    if left:
        raise ValueError(f"--motion: none for vehicle {', '.join(left)}; give each vehicle one, with --vehicle")
    levels = {v.id: z_m if v.z_m is None else v.z_m for v in site.vehicles}
    return {name: parse_motion(text, levels[name], site, name) for name, text in zip(names, told, strict=True)}


def parse_motion(text: str, z_m: float, site: Site, vehicle: str) -> Motion:
    """Return the motion that a ``--motion`` tells, on the level ``z_m`` where the text names no height.

    Raises
    ------
    ValueError
        Saying how it is written right.
    """
    from sonofix.channel import Circle, Line, Still, Waypoints

    kind, _, rest = text.partition(":")
    try:
        if kind == "still":
            x, y, height = _numbers(rest, 2, 3, z_m)
            return Still((x, y, height))
        if kind == "line":
            x, y, vx, vy = _numbers(rest, 4, 4)
            return Line((x, y, z_m), (vx, vy, 0.0))
        if kind == "circle":
            x, y, radius, speed = _numbers(rest, 4, 4)
            return Circle((x, y, z_m), radius, speed)
        if kind == "waypoints":
            places, at, speed = rest.rpartition("@")
            if not at:
                raise ValueError("no speed; end it with @ and the speed in m/s")
            points = [_numbers(place, 2, 3, z_m) for place in places.split(";")]
            return Waypoints(tuple((x, y, height) for x, y, height in points), _numbers(speed, 1, 1)[0])
    except ValueError as error:
        raise ValueError(f"--motion {text}: {error}") from None
    if kind == "csv":
        return _sampled(Path(rest), z_m, site, vehicle)
    raise ValueError(
        f"--motion {text}: no such motion; write still:x,y or line:x,y,vx,vy or circle:cx,cy,r,speed or "
        "waypoints:x1,y1;x2,y2@speed or csv:FILE"
    )


def _clocks(site: Site, told: list[str], seed: int) -> dict[str, tuple[float, float]]:
    """Clocks as told, or drawn where a site has them and none is told."""
    import numpy as np

    if not told:
        if not site.own_clocks or site.schedule is None:
            return {}
        rng, quarter_s = np.random.default_rng([seed, 4]), (site.schedule.period_s or 0.0) / 4
        others = [v.id for v in site.vehicles[1:]]
        drawn = rng.uniform(-1.0, 1.0, (len(others), 2)) * [quarter_s, 20e-6]
        return {name: (float(offset_s), float(drift)) for name, (offset_s, drift) in zip(others, drawn, strict=True)}
    clocks: dict[str, tuple[float, float]] = {}
    for text in told:
        name, _, rest = text.rpartition(":")
        try:
            offset_s, ppm = _numbers(rest, 2, 2)
        except ValueError as error:
            raise ValueError(f"--clock {text}: {error}; write VEHICLE:OFFSET,PPM") from None
        if name in clocks:
            raise ValueError(f"--clock {name}: is given twice; a vehicle has one clock")
        clocks[name] = (offset_s, 1e-6 * ppm)
    return clocks


def _numbers(text: str, least: int, most: int, last: float = 0.0) -> list[float]:
    """Numbers parted by commas; where one fewer than ``most`` came, ``last`` is added."""
    parts = text.split(",")
    try:
        values = [float(part) for part in parts]
    except ValueError:
        raise ValueError(f'"{text}" is not numbers parted by commas') from None
    if not least <= len(values) <= most:
        count = f"{least}" if least == most else f"{least} or {most}"
        raise ValueError(f'"{text}" holds {len(values)} numbers; {count} are needed')
    return values + [last] * (most - len(values))


def _sampled(path: Path, z_m: float, site: Site, vehicle: str) -> Motion:
    import numpy as np

    from sonofix.channel import Sampled
    from sonofix.files.tables import Layout, read_table

    layout = Layout(
        ("time_s", "x_m", "y_m"),
        ("z_m", "yaw_rad", "roll_rad", "pitch_rad"),
        given=("time_s", "x_m", "y_m"),
        per_vehicle=True,
        key="vehicle",
        strictly=True,
    )
    table = read_table(path, layout, site)
    rows = np.array(table.names["vehicle"]) == vehicle
    columns = {name: values[rows] for name, values in table.columns.items()}
    height = columns.get("z_m", np.full(int(rows.sum()), z_m))
    yaw, roll, pitch = (columns.get(name) for name in ("yaw_rad", "roll_rad", "pitch_rad"))
    try:
        position = np.column_stack([columns["x_m"], columns["y_m"], height])
        return Sampled(columns["time_s"], position, yaw, roll_rad=roll, pitch_rad=pitch)
    except ValueError as error:
        raise ValueError(f"{path.name}: vehicle {vehicle}: {error}") from None


def _waveforms(site: Site, references: Mapping[str, ReferenceBurst]) -> dict[str, Waveform]:
    from sonofix.signals.waveform import waveforms_of

    if not site.coded_beacons:
        raise ValueError("site.toml: no beacon has a code, so none makes a sound; give one a code")
    return waveforms_of(site, references)


def _made(
    site: Site,
    motions: Mapping[str, Motion],
    waveforms: Mapping[str, Waveform],
    *,
    duration_s: float,
    rate_hz: int,
    snr_db: float,
    noise_db: float | None,
    level: float | None,
    echo: float,
    absorption: float | None,
    tone: tuple[float, float] | None,
    clock: tuple[float, float, float],
    clocks: Mapping[str, tuple[float, float]],
    seed: int,
) -> tuple[Recording, dict[str, Truth]]:
    from sonofix import channel

    if not 0 < duration_s < math.inf:
        raise ValueError(f"--duration {duration_s:g}: it must be positive, in s")
    if math.isnan(snr_db) or (noise_db is not None and math.isnan(noise_db)):
        raise ValueError("--snr or --noise-db: not a number; give it in dB")
    if not 0 <= echo <= 1:
        raise ValueError(f"--echo {echo:g}: a reflection coefficient lies from 0 to 1")
    gains = channel.direct_gains(site, motions, waveforms, duration_s, absorption)
    if level is None:
        level = channel.level_below(0.5, gains, waveforms, echo)
    noise = channel.noise_for_snr(snr_db, level, gains, waveforms) if noise_db is None else 10 ** (noise_db / 20)
    offset_s, drift, jitter_s = clock
    return channel.simulate(
        site,
        motions,
        rate_hz=rate_hz,
        duration_s=duration_s,
        waveforms=waveforms,
        noise_sd=noise,
        echo=echo,
        level=level,
        tone=None if tone is None else channel.Tone(*tone),
        absorption_db_per_m=absorption,
        clock_offset_s=offset_s,
        clock_drift=drift,
        sync_jitter_s=jitter_s,
        clocks=clocks,
        seed=seed,
    )


def _write(
    out: Path,
    recording: Recording,
    truth: Mapping[str, Truth],
    references: Mapping[str, ReferenceBurst],
    flac: bool,
    force: bool,
) -> None:
    from sonofix.files import write_recording

    if force and recording.sync_s is None:
        (out / "sync.csv").unlink(missing_ok=True)  # an earlier recording's would rule the new samples
    with progress_bar() as bar:
        task = bar.add_task("simulating", total=recording.sample_count)
        try:
            write_recording(
                out,
                recording,
                truth,
                audio="flac" if flac else "wav",
                references=references,
                overwrite=force,
                on_block=lambda count: bar.update(task, completed=count),
            )
        except KeyboardInterrupt:
            raise Stopped(f"{out}: stopped; the recording is not complete") from None
