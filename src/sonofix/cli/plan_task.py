"""What `sonofix plan` is asked for: site, walls, loudness and doubts, from its options and the site file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sonofix.cli.console import counted

if TYPE_CHECKING:
    from sonofix.plan.budget import Budget
    from sonofix.plan.quality import Nodes, Terms
    from sonofix.records import Floats, ReferenceBurst, Walls, Waveform
    from sonofix.site import Site

LEVEL, NOISE_DB, RATE_HZ = 0.5, -50.0, 192_000.0
SLACK_M = 0.01
"""By which a place may be outside the room: a face of it, rounded."""


@dataclass(frozen=True, slots=True)
class Loudness:
    """What options say of the link budget; None where they say nothing."""

    level: float | None = None
    noise_db: float | None = None
    rate_hz: float | None = None
    snr: str | None = None
    beam_deg: float | None = None
    aim: str | None = None
    range_sd_m: float | None = None
    reach_m: float | None = None
    temperature_sd_k: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A site ready to be judged.

    Attributes
    ----------
    site : Site
    folder : Path
        Where its file stands.
    nodes : Nodes
    terms : Terms
    level_m : float
        Of the map.
    told : tuple of str
        What was assumed, in sentences.
    """

    site: Site
    folder: Path
    nodes: Nodes
    terms: Terms
    level_m: float
    told: tuple[str, ...]


def task_of(path: Path, walls: Path | None, vehicle: str | None, height_m: float | None, loudness: Loudness) -> Task:
    """Read the site and gather what places are judged by.

    Raises
    ------
    RecordingError
        With the mistakes of the files.
    ValueError
        If an option is out of range.
    """
    import numpy as np

    from sonofix.air import BY_KELVIN_MPS, THERMOMETER_SD_K
    from sonofix.files.floor_plan import read_walls
    from sonofix.plan.quality import Terms, nodes_of
    from sonofix.receiver import DEFAULT_MAX_SPEED_MPS
    from sonofix.records import Walls

    _check(loudness, height_m)
    site, rate_hz, references = _read(path)
    folder = path if path.is_dir() else path.parent
    plan = Walls.none() if walls is None else _in_room(read_walls(walls), site, walls)
    budget, bursts = _budget(site, loudness, rate_hz, references)
    nodes = nodes_of(site, budget, bursts, DEFAULT_MAX_SPEED_MPS)
    if budget is not None and loudness.snr is not None:
        budget = _as_measured(budget, nodes, loudness.snr)
    kelvin = THERMOMETER_SD_K if loudness.temperature_sd_k is None else loudness.temperature_sd_k
    # a stated speed is taken at its word, and ranges that no link budget makes need not be of sound
    exact = loudness.temperature_sd_k is None and (site.air.sound_speed_mps is not None or budget is None)
    level_m, free = _level(site, vehicle, height_m)
    terms = Terms(
        sound_speed_mps=site.sound_speed_mps,
        speed_sd=0.0 if exact else BY_KELVIN_MPS * kelvin / site.sound_speed_mps,
        free_level=free,
        clock=not site.clock_known,
        budget=budget,
        range_sd_m=None if budget is not None else _range_sd(loudness),
        reach_m=loudness.reach_m,
        aim_m=_aim(site, nodes, level_m) if loudness.aim == "centre" else None,
        bounds_m=None if site.bounds_m is None else np.array(site.bounds_m),
        walls=plan,
    )
    return Task(site, folder, nodes, terms, level_m, tuple(_sentences(site, nodes, terms, loudness, plan)))


def _check(loudness: Loudness, height_m: float | None) -> None:
    for name, value, unit in (
        ("level", loudness.level, "parts of full scale"),
        ("rate", loudness.rate_hz, "Hz"),
        ("range-sd", loudness.range_sd_m, "m"),
        ("reach", loudness.reach_m, "m"),
    ):
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise ValueError(f"--{name} {value:g}: it must be above 0, in {unit}")
    if loudness.beam_deg is not None and not 5 <= loudness.beam_deg <= 360:
        raise ValueError(f"--beam {loudness.beam_deg:g}: the full width between -6 dB, from 5 to 360 degrees")
    if loudness.aim not in (None, "down", "centre"):
        raise ValueError(f"--aim {loudness.aim}: it must be down or centre")
    if loudness.noise_db is not None and not -200 <= loudness.noise_db <= 20:
        raise ValueError(f"--noise-db {loudness.noise_db:g}: it must be from -200 to 20, in dB of full scale")
    if loudness.temperature_sd_k is not None and not 0 <= loudness.temperature_sd_k <= 50:
        raise ValueError(f"--temperature-sd {loudness.temperature_sd_k:g}: it must be from 0 to 50, in kelvin")
    if height_m is not None and not math.isfinite(height_m):
        raise ValueError(f"--height {height_m}: it must be a number, in m")
    if loudness.snr is not None and (loudness.level is not None or loudness.range_sd_m is not None):
        raise ValueError("--snr sets how loud beacons are, and so do --level and --range-sd; give one of them")
    if loudness.aim is not None and loudness.beam_deg is None:
        raise ValueError(f"--aim {loudness.aim}: only beams point anywhere; give --beam as well")
    if loudness.range_sd_m is not None:
        shaping = {"--beam": loudness.beam_deg, "--noise-db": loudness.noise_db, "--rate": loudness.rate_hz}
        given = [name for name, value in {"--level": loudness.level, **shaping}.items() if value is not None]
        if given:
            remedy = "stands in place of the link budget, and these would shape it; give one or the other"
            raise ValueError(f"--range-sd with {', '.join(given)}: --range-sd {remedy}")


def _in_room(plan: Walls, site: Site, path: Path) -> Walls:
    """Return the walls; raise ValueError where all of them lie to one side of the room."""
    import numpy as np

    if site.bounds_m is not None:
        low, high = np.array(site.bounds_m)[:, :2]
        ends = np.concatenate([plan.start_m, plan.end_m])
        if np.any(ends.max(axis=0) < low) or np.any(ends.min(axis=0) > high):
            raise ValueError(
                f"--walls {path}: no wall stands in the room, ({low[0]:g}, {low[1]:g}) to ({high[0]:g}, {high[1]:g}) m;"
                " coordinates are site metres, not degrees"
            )
    return plan


def check_places(places_m: Floats, site: Site, level_m: float, path: Path) -> None:
    """Raise ValueError, with the place, where one for a beacon is outside the room or below the floor."""
    import numpy as np

    floor_m = min([v.z_m for v in site.vehicles if v.z_m is not None] or [0.0])
    floor_m = min(floor_m, level_m)
    low, high = np.array([-np.inf, -np.inf, floor_m]), np.full(3, np.inf)
    if site.bounds_m is not None:
        low, high = np.array(site.bounds_m, float)
    for place in places_m:
        if np.all(place >= low - SLACK_M) and np.all(place <= high + SLACK_M):
            continue
        where = "({:g}, {:g}, {:g}) m".format(*place)
        if place[2] < low[2] - SLACK_M:
            raise ValueError(f"--places {path}: {where} is below the floor, at {low[2]:g} m; correct it")
        room = "({:g}, {:g}, {:g}) to ({:g}, {:g}, {:g}) m".format(*low, *high)
        raise ValueError(f"--places {path}: {where} is outside the room, {room}; correct it, or bounds_m")


def _read(path: Path) -> tuple[Site, float | None, Mapping[str, ReferenceBurst]]:
    """Return the site, the rate of its capture where there is one, and its recorded bursts."""
    from sonofix import files

    site = files.read_site(path)
    if path.is_dir() and any((path / f"capture.{kind}").exists() for kind in ("flac", "wav")):
        return site, files.read_recording(path).rate_hz, files.read_references(path, site)
    return site, None, files.read_references(path if path.is_dir() else path.parent, site)


def _budget(
    site: Site, loudness: Loudness, rate_hz: float | None, references: Mapping[str, ReferenceBurst]
) -> tuple[Budget | None, dict[str, Waveform]]:
    from sonofix.plan.budget import Budget
    from sonofix.signals.waveform import waveforms_of

    if loudness.range_sd_m is not None:
        return None, {}
    if not site.coded_beacons:
        budget = {"--level": loudness.level, "--noise-db": loudness.noise_db, "--rate": loudness.rate_hz}
        options = {**budget, "--beam": loudness.beam_deg, "--snr": loudness.snr}
        given = [name for name, value in options.items() if value is not None]
        if given:
            remedy = "give a [[beacon]] one, or state --range-sd"
            raise ValueError(f"{', '.join(given)}: no beacon has a code, so there is no link budget; {remedy}")
        return None, {}
    noise_db = NOISE_DB if loudness.noise_db is None else loudness.noise_db
    budget = Budget(
        level=LEVEL if loudness.level is None else loudness.level,
        noise_sd=10 ** (noise_db / 20),
        rate_hz=loudness.rate_hz or rate_hz or RATE_HZ,
        beam_rad=None if loudness.beam_deg is None else math.radians(loudness.beam_deg),
    )
    return budget, waveforms_of(site, references)


def _as_measured(budget: Budget, nodes: Nodes, snr: str) -> Budget:
    """Return the budget at which a burst is heard as it was measured: "DB@M"."""
    from sonofix.plan.budget import level_for_snr

    text, _, way = snr.partition("@")
    try:
        snr_db, distance_m = float(text), float(way)
    except ValueError:
        raise ValueError(f"--snr {snr}: write it as DB@M, snr_db and range_m of a row of ranges.csv: 21@5.2") from None
    if not (-60 <= snr_db <= 150 and 0 < distance_m < 1000):
        raise ValueError(f"--snr {snr}: from -60 to 150 dB, at a range between 0 and 1000 m")
    link = nodes.links[0]
    if link is None:
        raise ValueError("--snr needs beacons with a code; give the site's beacons one")
    return replace(budget, level=level_for_snr(snr_db, distance_m, link, budget))


def _range_sd(loudness: Loudness) -> float:
    from sonofix.ranging import RANGES_WITHOUT_SD_M

    return RANGES_WITHOUT_SD_M if loudness.range_sd_m is None else loudness.range_sd_m


def _level(site: Site, vehicle: str | None, height_m: float | None) -> tuple[float, bool]:
    """Return the height of what listens or sounds, and whether it is unknown to the receiver."""
    known = [v.id for v in site.vehicles]
    if vehicle is not None and vehicle not in known:
        raise ValueError(f"--vehicle {vehicle}: the site has no such vehicle; it has {', '.join(known) or 'none'}")
    if not known:
        return height_m or 0.0, False
    rides = site.vehicle(vehicle or known[0])
    mounted = [n for n in (*site.microphones, *site.beacons) if n.vehicle == rides.id]
    arm_m = mounted[0].lever_arm_m[2] if mounted else 0.0
    return (rides.z_m or 0.0) + arm_m if height_m is None else height_m, rides.z_m is None


def _aim(site: Site, nodes: Nodes, level_m: float) -> tuple[float, float, float]:
    import numpy as np

    x, y = np.mean(np.array(site.bounds_m or nodes.position_m)[:, :2], axis=0)
    return float(x), float(y), level_m


def _sentences(site: Site, nodes: Nodes, terms: Terms, loudness: Loudness, walls: Walls) -> list[str]:
    """Say what was assumed."""
    import numpy as np

    from sonofix.plan.budget import farthest_m

    told = []
    if terms.budget is not None and nodes.links[0] is not None:
        reach = [farthest_m(link, terms.budget, terms.sound_speed_mps) for link in set(nodes.links) if link]
        span = f"{min(reach):.1f} m" if np.ptp(reach) < 0.05 else f"{min(reach):.1f} to {max(reach):.1f} m"
        b = terms.budget
        beam = "" if b.beam_rad is None else f", beams of {loudness.beam_deg:g}°"
        told.append(
            f"Bursts of {b.level:.3g} of full scale at 1 m{beam}, noise of {20 * math.log10(b.noise_sd):.1f} dB at"
            f" {b.rate_hz / 1e3:g} kHz: heard up to {span} away."
        )
    else:
        far = "" if terms.reach_m is None else f", up to {terms.reach_m:g} m away"
        why = "" if loudness.range_sd_m is not None else " (no beacon has a code, so there is no link budget)"
        told.append(f"Ranges of {1e3 * (terms.range_sd_m or 0.0):g} mm deviation{far}{why}.")
    if terms.speed_sd:
        told.append(f"The sound speed is known within {100 * terms.speed_sd:.2f} %, which all ranges share.")
    unknown = ["x", "y"] + ["z"] * terms.free_level + ["clock"] * terms.clock
    obstacles, pieces = len(np.unique(walls.solid[walls.solid >= 0])), int(np.sum(walls.solid < 0))
    pieces_text = f"{pieces} piece{'' if pieces == 1 else 's'} of wall"
    stand = f"; {counted(obstacles, 'obstacle')} and {pieces_text}" if len(walls) else ""
    told.append(f"Unknown at each place: {', '.join(unknown)}{stand}.")
    if site.bounds_m is None:
        low, high = nodes.position_m.min(axis=0), nodes.position_m.max(axis=0)
        kind = "beacon" if any(b.position_m is not None for b in site.beacons) else "microphone"
        told.append(
            f"The map is of the box of the {kind}s, ({low[0]:g}, {low[1]:g}) to ({high[0]:g}, {high[1]:g}) m; bounds_m"
            " states another, and tells mirror images apart."
        )
    return told
