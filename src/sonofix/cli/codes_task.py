"""What `sonofix codes` is asked for: from its options, a site file, and defaults, in that order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from sonofix.cli.console import counted

if TYPE_CHECKING:
    from sonofix.plan.codes import Candidate
    from sonofix.records import Waveform
    from sonofix.site import Beacon, Signal, Site

COUNT, DEGREE, REACH_M, SPEED_MPS = 8, 9, 15.0, 2.0
SIGNAL = {"carrier_hz": 40e3, "modulation": "ask", "cycles_per_chip": 10.0, "bandwidth_hz": 4e3}

# Of a file that holds something else than codes, so many lines say enough.
_MOST_TOLD = 5


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What codes are wanted for.

    Attributes
    ----------
    ids : list of str
        Of the beacons that get a code.
    signal : Signal
    degree : int
    reach_m : float
        Largest difference of ways; infinite where bursts come at any time.
    max_difference_mps : float
        Of two range rates.
    sound_speed_mps : float
    name : str
        Of the site; empty without one.
    present : mapping from beacon id to Waveform
        What the site's beacons on this carrier send now.
    remark : str
        What of the site was left out.
    """

    ids: list[str]
    signal: Signal
    degree: int
    reach_m: float
    max_difference_mps: float
    sound_speed_mps: float
    name: str = ""
    present: Mapping[str, Waveform] = field(default_factory=dict)
    remark: str = ""

    @property
    def count(self) -> int:
        """Codes wanted."""
        return len(self.ids)

    def describe(self) -> str:
        """Say how chips are keyed: "on-off keyed, 10 cycles a chip at 40 kHz, transducers of 4 kHz"."""
        signal = self.signal
        keyed = "on-off keyed" if signal.modulation == "ask" else "keyed by sign"
        width = "no transducers" if signal.bandwidth_hz is None else f"transducers of {signal.bandwidth_hz / 1e3:g} kHz"
        return f"{keyed}, {signal.cycles_per_chip:g} cycles a chip at {signal.carrier_hz / 1e3:g} kHz, {width}"


def task_of(
    path: Path | None,
    count: int | None,
    degree: int | None,
    reach_m: float | None,
    max_speed_mps: float | None,
    carrier_hz: float | None,
    cycles: float | None,
    bandwidth_hz: float | None,
    modulation: str | None,
) -> Task:
    """Gather the task; options rule over the site, the site over the defaults.

    Raises
    ------
    RecordingError
        With the mistakes of the site file.
    ValueError
        If an option is out of range.
    """
    from sonofix import air, files

    _check(count, reach_m, max_speed_mps, carrier_hz, cycles, bandwidth_hz, modulation)
    site = None if path is None else files.read_site(path)
    own: dict[str, object] = {
        "carrier_hz": carrier_hz,
        "modulation": modulation,
        "cycles_per_chip": cycles,
        "bandwidth_hz": bandwidth_hz,
    }
    if site is None or path is None:
        return Task(
            ids=[f"B{k}" for k in range(1, (count or COUNT) + 1)],
            signal=_signal(SIGNAL, own),
            degree=DEGREE if degree is None else degree,
            reach_m=REACH_M if reach_m is None else reach_m,
            max_difference_mps=2.0 * (SPEED_MPS if max_speed_mps is None else max_speed_mps),
            sound_speed_mps=air.sound_speed_mps(20.0, 0.5, 101.325),
        )
    from sonofix.signals.waveform import waveform_of

    beacons, remark = _on_one_carrier(site)
    coded = [beacon for beacon in beacons if beacon.code is not None]
    references = files.read_references(path if path.is_dir() else path.parent, site)
    degrees = [d for beacon in coded if (d := getattr(beacon.code, "degree", None))]
    known = {}
    if site.signal is not None or coded:
        known = {k: v for k, v in site.signal_of(beacons[0]).model_dump().items() if v is not None}
        known = {"bandwidth_hz": None, **known}  # where the site states none there is none, whatever the default
    ids = [beacon.id for beacon in beacons]
    if count is not None and count != len(ids):
        ids = (ids + [f"new {k}" for k in range(1, count + 1)])[:count]
    elif len(ids) < 2:
        raise ValueError(f"--site {path}: it has one beacon, which disturbs none; give --count for the codes wanted")
    return Task(
        ids=ids,
        signal=_signal({**SIGNAL, **known}, own),
        degree=degree if degree is not None else max(degrees, key=degrees.count) if degrees else DEGREE,
        reach_m=_reach_m(site) if reach_m is None else reach_m,
        max_difference_mps=_max_difference_mps(site, max_speed_mps),
        sound_speed_mps=site.sound_speed_mps,
        name=site.name,
        present={beacon.id: waveform_of(site, beacon, references.get(beacon.id)) for beacon in coded},
        remark=remark,
    )


def _check(
    count: int | None,
    reach_m: float | None,
    max_speed_mps: float | None,
    carrier_hz: float | None,
    cycles: float | None,
    bandwidth_hz: float | None,
    modulation: str | None,
) -> None:
    if count is not None and count < 2:
        raise ValueError(f"--count {count}: codes are chosen by their pairs; ask for 2 or more")
    for name, value, unit in (
        ("reach", reach_m, "m"),
        ("carrier", carrier_hz, "Hz"),
        ("cycles", cycles, "cycles"),
        ("bandwidth", bandwidth_hz, "Hz"),
    ):
        endless = name in ("reach", "bandwidth")
        if value is not None and not (value > 0 and (endless or math.isfinite(value))):
            raise ValueError(f"--{name} {value:g}: it must be above 0, in {unit}" + (", or inf" if endless else ""))
    if max_speed_mps is not None and not 0 <= max_speed_mps <= 15:
        raise ValueError(f"--max-speed {max_speed_mps:g}: it must be from 0 to 15, in m/s")
    if modulation not in (None, "ask", "bpsk"):
        raise ValueError(f"--modulation {modulation}: it must be ask or bpsk")


def _signal(known: Mapping[str, object], own: Mapping[str, object]) -> Signal:
    from sonofix.site import Signal

    values = {**known, **{key: value for key, value in own.items() if value is not None}}
    if values["bandwidth_hz"] == math.inf:
        values["bandwidth_hz"] = None
    return Signal.model_validate(values)


def _on_one_carrier(site: Site) -> tuple[list[Beacon], str]:
    """Return the beacons that codes are for: those on the carrier that most of them share, and what was left out."""
    shared = None if site.signal is None else site.signal.carrier_hz
    groups: dict[float | None, list[Beacon]] = {}
    for beacon in site.coded_beacons or site.beacons:
        groups.setdefault(beacon.carrier_hz or shared, []).append(beacon)
    carrier_hz, most = max(groups.items(), key=lambda item: len(item[1]))
    others = sum(map(len, groups.values())) - len(most)
    if not others or carrier_hz is None:
        return most, ""
    away = f"{counted(others, 'beacon')} on other carriers left out: what is apart in frequency does not disturb."
    return most, f"Codes are for the {counted(len(most), 'beacon')} at {carrier_hz / 1e3:g} kHz; {away}"


def _reach_m(site: Site) -> float:
    """How much later one burst may be heard than another: by the receiver's windows, and by when bursts are set off."""
    from sonofix.acquire.epochs import reach_s

    if site.schedule is not None and not site.schedule.synchronised:
        return math.inf  # the first search runs over a whole period
    span_s = reach_s(site, site.sound_speed_mps)
    if site.schedule is not None and site.schedule.period_s is not None:
        span_s = min(span_s, site.schedule.period_s)
    offsets_s = [beacon.offset_s + beacon.delay_s for beacon in site.coded_beacons] or [0.0]
    return (span_s + max(offsets_s) - min(offsets_s)) * site.sound_speed_mps


def _max_difference_mps(site: Site, max_speed_mps: float | None) -> float:
    """Twice the range rates that the receiver searches: a vehicle's speed, doubled where both ends ride."""
    from sonofix.receiver import DEFAULT_MAX_SPEED_MPS

    speeds = [v.max_speed_mps or DEFAULT_MAX_SPEED_MPS for v in site.vehicles] or [0.0]
    both_ride = any(b.vehicle for b in site.coded_beacons) and any(m.vehicle for m in site.microphones)
    speed_mps = max(speeds) if max_speed_mps is None else max_speed_mps
    return 2.0 * speed_mps * (2.0 if both_ride else 1.0)


def told_chips(path: Path) -> list[Candidate]:
    """Read codes from a text file, one of 0 and 1 a line; empty lines and what follows # are passed over.

    Raises
    ------
    RecordingError
        With every line that is none.
    """
    import numpy as np

    from sonofix.files import Problem, RecordingError
    from sonofix.files.site_file import read_text
    from sonofix.plan.codes import Candidate
    from sonofix.site import ChipsCode

    problems, found = [], {}
    for number, line in enumerate(read_text(path, path.name).splitlines(), 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        if len(text) < 7 or set(text) != {"0", "1"}:
            remedy = "a code is seven or more chips of 0 and 1, both of them, without spaces"
            problems.append(Problem(path.name, f"line {number}", text, remedy))
        elif text in found:
            problems.append(Problem(path.name, f"line {number}", text, "stands there twice; drop one"))
        else:
            chips = (np.frombuffer(text.encode("ascii"), np.int8) - ord("0")).astype(np.int8)
            found[text] = Candidate(ChipsCode(chips=text), chips)
    if not problems and not found:
        problems.append(Problem(path.name, "", None, "holds no code; write one of 0 and 1 a line"))
    if problems:
        raise RecordingError(problems[:_MOST_TOLD])
    return list(found.values())
