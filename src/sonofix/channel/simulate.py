"""A made-up recording: every beacon, every way its sound takes, every microphone, and noise.

Samples come in pages of fixed length, each computed from nothing but the scene and the seed, so that blocks of any
length hold the same samples, and a recording of any length takes the memory of one page.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix import air
from sonofix.channel.motion import Motion
from sonofix.channel.propagate import PoseTable, add_sound
from sonofix.channel.scene import check_inside, mirrored, pose_table, position_at, truth_of
from sonofix.channel.timing import Timing, timing_of
from sonofix.records import Floats, Recording, Truth, Waveform
from sonofix.site import Beacon, Microphone, Site

PAGE = 32768
"""Samples in a page."""


@dataclass(frozen=True, slots=True)
class Tone:
    """A steady interferer, alike on all channels: ``amplitude · sin 2π(frequency_hz t + drift_hz_per_s t² / 2)``."""

    frequency_hz: float
    amplitude: float
    drift_hz_per_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """All that samples follow from."""

    site: Site
    motions: Mapping[str, Motion]
    waveforms: Mapping[str, Waveform]
    timing: Timing
    rate_hz: float
    channels: int
    gain: Mapping[str, float]
    absorption_db_per_m: Mapping[str, float]
    sound_speed_mps: float
    echo: float
    noise_sd: float
    tone: Tone | None
    clip: float | None
    seed: int
    clocks: Mapping[str, tuple[float, float]]

    def heard_by(self, microphone: Microphone) -> tuple[float, float]:
        """Samples a second of true time, and how much later than sound reaches it a sample is told, in true time."""
        offset_s, drift = self.clocks.get(microphone.vehicle or "", (0.0, 0.0))
        return self.rate_hz * (1.0 + drift), microphone.delay_s + offset_s / (1.0 + drift)


def absorption_of(site: Site, carrier_hz: float) -> float:
    """Absorption of a site's air at a frequency, dB/m (ISO 9613-1)."""
    a = site.air
    return float(air.absorption_db_per_m(carrier_hz, a.temperature_c, a.humidity, a.pressure_kpa))


def simulate(
    site: Site,
    motions: Mapping[str, Motion],
    *,
    rate_hz: float,
    duration_s: float,
    waveforms: Mapping[str, Waveform],
    noise_sd: float = 0.0,
    echo: float = 0.0,
    level: float | Mapping[str, float] = 0.5,
    tone: Tone | None = None,
    clip: float | None = None,
    absorption_db_per_m: float | None = None,
    sound_speed_mps: float | None = None,
    clock_offset_s: float = 0.0,
    clock_drift: float = 0.0,
    beacon_drift: Mapping[str, float] | None = None,
    sync_jitter_s: float = 0.0,
    clocks: Mapping[str, tuple[float, float]] | None = None,
    seed: int = 0,
) -> tuple[Recording, dict[str, Truth]]:
    """Make a recording of a site whose vehicles move as told, and the truth about it.

    Each microphone with a channel hears each beacon that has a waveform, but for beacons on its own vehicle. The
    amplitude of a sound that went d metres is ``level · 10^(−absorption d / 20) / d``.

    Parameters
    ----------
    site : Site
        With a schedule that states ``period_s``. Beacons have been sending since before the recording.
    motions : mapping from vehicle id to Motion
        One for each vehicle, of its origin.
    rate_hz, duration_s : float
    waveforms : mapping from beacon id to Waveform
        Beacons that are missing here are silent.
    noise_sd : float
        Standard deviation of white Gaussian noise on every channel, full scale 1.
    echo : float
        Reflection coefficient (−1 … 1) of the room's six surfaces, ``site.bounds_m``; first-order images.
    level : float or mapping from beacon id to float
        Amplitude, full scale 1, that an envelope of 1 would have at 1 m without absorption.
    tone : Tone, optional
    clip : float, optional
        Samples beyond ± this are cut.
    absorption_db_per_m, sound_speed_mps : float, optional
        In place of what follows from ``site.air`` at each beacon's carrier.
    clock_offset_s, clock_drift : float
        First epoch's start on the recorder's clock, and the relative excess of the beacons' second over the recorder's.
        The recording's ``sync_s`` tells them where the site is synchronised, else nothing does.
    beacon_drift : mapping from beacon id to float, optional
        What single beacons' clocks add to ``clock_drift``: a relative error of the period where they run free, and
        of the chips' and the carrier's length always.
    sync_jitter_s : float
        Standard deviation of sync commands about the regular grid; ``sync_s`` tells when they came.
    clocks : mapping from vehicle id to (offset_s, drift), optional
        Of a site with ``own_clocks``: what each vehicle's clock shows at time 0, and by what share it runs fast. It
        times what the vehicle sounds and the samples of its channels. Vehicles not named, the first among them, keep
        the time that motions and truth are told in.
    seed : int
        Same seed, same samples, however they are read.

    Returns
    -------
    recording : Recording
        ``blocks`` computes samples as they are read, float32, not quantised.
    truth : dict from vehicle id to Truth
        200 rows a second.

    Raises
    ------
    ValueError
        Naming the argument or field that does not fit; from ``blocks``, a vehicle nearly as fast as sound.
    """
    _check(site, motions, rate_hz, duration_s, waveforms)
    levels = {b: level.get(b) if isinstance(level, Mapping) else level for b in waveforms}
    unset = [b for b, value in levels.items() if value is None]
    if unset:
        raise ValueError(f"level: none for beacon {', '.join(unset)}; give every beacon that sounds one")
    for name, value, low, high in (
        ("noise_sd", noise_sd, 0.0, 1e6),
        ("echo", echo, -1.0, 1.0),
        ("seed", seed, 0, 2**63),
        ("clip", clip, 1e-6, 1e6),
        ("absorption_db_per_m", absorption_db_per_m, 0.0, 1e3),
        ("sound_speed_mps", sound_speed_mps, 1.0, 1e5),
        ("clock_offset_s", clock_offset_s, -1e6, 1e6),
        ("clock_drift", clock_drift, -0.01, 0.01),
        ("tone.frequency_hz", tone and tone.frequency_hz, 0.0, rate_hz / 2),
        ("tone.amplitude", tone and tone.amplitude, 0.0, 1e6),
        *((f"level of beacon {b}", value, 0.0, 1e6) for b, value in levels.items()),
        *((f"beacon_drift of {b}", value, -0.01, 0.01) for b, value in (beacon_drift or {}).items()),
    ):
        if value is not None and not low <= value <= high:
            raise ValueError(f"{name} = {value:g}; it must lie from {low:g} to {high:g}")
    if echo:
        check_inside(site, motions, duration_s)
    schedule = site.schedule
    if schedule is None or schedule.period_s is None:
        raise ValueError("schedule.period_s is missing: when do beacons burst? Add [schedule] with period_s")
    clocks = dict(clocks or {})
    _check_clocks(site, clocks, clock_offset_s, clock_drift)
    own = {b.id: clocks[b.vehicle] for b in site.beacons if b.vehicle in clocks}
    slow = {b: 1.0 / (1.0 + drift) - 1.0 for b, (_, drift) in own.items()}
    timing = timing_of(
        schedule.period_s,
        schedule.synchronised,
        duration_s,
        offset_s=clock_offset_s,
        drift=clock_drift,
        beacon_drift={b: slow.get(b, 0.0) + (beacon_drift or {}).get(b, 0.0) for b in (*slow, *(beacon_drift or {}))},
        jitter_s=sync_jitter_s,
        beacon_offset_s={b: -offset / (1.0 + drift) for b, (offset, drift) in own.items()},
        seed=seed,
    )
    scene = _Scene(
        site=site,
        motions=dict(motions),
        waveforms=dict(waveforms),
        timing=timing,
        rate_hz=float(rate_hz),
        channels=1 + max(m.channel for m in site.microphones if m.channel is not None),
        gain={b: value for b, value in levels.items() if value is not None},
        absorption_db_per_m={
            b: absorption_of(site, w.carrier_hz) if absorption_db_per_m is None else absorption_db_per_m
            for b, w in waveforms.items()
        },
        sound_speed_mps=sound_speed_mps or site.sound_speed_mps,
        echo=echo,
        noise_sd=noise_sd,
        tone=tone,
        clip=clip,
        seed=seed,
        clocks=clocks,
    )
    count = max(round(duration_s * rate_hz), 1)
    irregular = schedule.synchronised and bool(clock_offset_s or clock_drift or sync_jitter_s)
    recording = Recording(
        site=site,
        rate_hz=float(rate_hz),
        sample_count=count,
        blocks=lambda length: _blocks(scene, count, length),
        sync_s=timing.sync_s if irregular else None,
    )
    return recording, {v.id: truth_of(v.id, motions[v.id], duration_s) for v in site.vehicles}


def _check_clocks(
    site: Site, clocks: Mapping[str, tuple[float, float]], clock_offset_s: float, clock_drift: float
) -> None:
    if not clocks:
        return
    if not site.own_clocks:
        raise ValueError("clocks: the site's vehicles share one; add own_clocks = true to [schedule] or leave them out")
    if clock_offset_s or clock_drift:
        raise ValueError("clock_offset_s, clock_drift: no common clock is there to be off; leave them out with clocks")
    known = [v.id for v in site.vehicles]
    for vehicle, (offset_s, drift) in clocks.items():
        if vehicle not in known:
            raise ValueError(f"clocks: {vehicle} is not in the site; it has {', '.join(known)}")
        if not (abs(offset_s) <= 1e6 and abs(drift) <= 0.01):
            raise ValueError(f"clocks of {vehicle}: {offset_s:g} s, {drift:g}; at most 1e6 s and a hundredth")
    if any(clocks.get(known[0], (0.0, 0.0))):
        raise ValueError(f"clocks: {known[0]}, the first vehicle, keeps the time; tell the others' clocks against it")


def _check(
    site: Site, motions: Mapping[str, Motion], rate_hz: float, duration_s: float, waveforms: Mapping[str, Waveform]
) -> None:
    for name, value in (("rate_hz", rate_hz), ("duration_s", duration_s)):
        if not 0 < value < np.inf:
            raise ValueError(f"{name} = {value}; it must be positive")
    vehicles, beacons = [v.id for v in site.vehicles], [b.id for b in site.beacons]
    for name, given, known in (("motions", motions, vehicles), ("waveforms", waveforms, beacons)):
        unknown = [key for key in given if key not in known]
        if unknown:
            raise ValueError(f"{name}: {', '.join(unknown)} is not in the site; it has {', '.join(known) or 'none'}")
    still = [v for v in vehicles if v not in motions]
    if still:
        raise ValueError(f"motions: none for vehicle {', '.join(still)}; give each a motion (Still, if it stands)")
    if not any(m.channel is not None for m in site.microphones):
        raise ValueError("site.toml: no microphone has a channel, so there is nothing to record; give one channel = 0")
    for beacon, waveform in waveforms.items():
        if 2 * waveform.carrier_hz >= rate_hz:
            raise ValueError(
                f"rate_hz = {rate_hz:g}; beacon {beacon} sends on {waveform.carrier_hz:g} Hz, "
                f"which needs a rate well above {2 * waveform.carrier_hz:g} Hz"
            )


def _blocks(scene: _Scene, count: int, length: int) -> Iterator[NDArray[np.float32]]:
    """Yield samples in blocks of ``length`` rows; only the last may be shorter."""
    if length < 1:
        raise ValueError(f"blocks of {length} samples; at least 1 is needed")
    waiting: list[NDArray[np.float32]] = []
    held = 0
    for page in range(-(-count // PAGE)):
        samples = _page(scene, page)[: count - page * PAGE]
        waiting.append(samples)
        held += len(samples)
        if held >= length:
            joined = np.concatenate(waiting)
            whole = held - held % length
            for start in range(0, whole, length):
                yield joined[start : start + length]
            waiting, held = [joined[whole:]], held - whole
    if held:
        yield np.concatenate(waiting)


def _page(scene: _Scene, page: int) -> NDArray[np.float32]:
    """Compute samples ``page * PAGE`` to ``(page + 1) * PAGE`` of all channels."""
    first = page * PAGE
    out = np.zeros((scene.channels, PAGE))
    for microphone in scene.site.microphones:
        if microphone.channel is None:
            continue
        for beacon in scene.site.beacons:
            if beacon.id in scene.waveforms and not (beacon.vehicle and beacon.vehicle == microphone.vehicle):
                _hear(scene, out[microphone.channel], first, microphone, beacon)
    if scene.tone is not None:
        t = (first + np.arange(PAGE)) / scene.rate_hz
        cycles = scene.tone.frequency_hz * t + scene.tone.drift_hz_per_s * t**2 / 2
        out += scene.tone.amplitude * np.sin(2 * np.pi * (cycles % 1.0))
    if scene.noise_sd:
        rng = np.random.default_rng([scene.seed, 2, page])
        out += scene.noise_sd * rng.standard_normal(out.shape)
    if scene.clip is not None:
        np.clip(out, -scene.clip, scene.clip, out=out)
    return np.ascontiguousarray(out.T, dtype=np.float32)


def _hear(scene: _Scene, out: Floats, first: int, microphone: Microphone, beacon: Beacon) -> None:
    """Add one beacon's sound, direct and by way of the walls, to one page of one channel."""
    waveform, speed = scene.waveforms[beacon.id], scene.sound_speed_mps
    rate_hz, delay_s = scene.heard_by(microphone)
    from_s = first / rate_hz - delay_s
    to_s = (first + PAGE - 1) / rate_hz - delay_s
    heard = pose_table(microphone, scene.motions, from_s, to_s, speed)
    # emitters are slower than c / 3: travel takes at most 1.5 times what the distance when it is heard would
    edge = np.linspace(from_s, to_s, 9)
    gap = position_at(microphone, scene.motions, edge) - position_at(beacon, scene.motions, edge)
    between = (to_s - from_s) / 8 * speed / 3  # how much farther apart they may get between those instants
    room = np.ptp(np.asarray(scene.site.bounds_m, float), axis=0).max() if scene.echo else 0.0
    travel_s = 1.5 * (float(np.linalg.norm(gap, axis=1).max()) + between + 2 * float(room)) / speed
    length_s = len(waveform.envelope) / waveform.rate_hz
    stretch = scene.timing.stretch(beacon)
    starts = scene.timing.starts_s(beacon, from_s - travel_s - (waveform.start_s + length_s) * stretch, to_s)
    begins = starts + waveform.start_s * stretch
    starts = starts[(begins <= to_s) & (begins + length_s * stretch >= from_s - travel_s)]
    if not len(starts):
        return
    sent = pose_table(beacon, scene.motions, from_s - travel_s, to_s, speed)
    ways: list[tuple[PoseTable, float]] = [(sent, 1.0)]
    if scene.echo:
        low, high = np.asarray(scene.site.bounds_m, float)
        ways += [(mirrored(sent, axis, wall[axis]), scene.echo) for axis in range(3) for wall in (low, high)]
    for emitter, reflection in ways:
        add_sound(
            out,
            first,
            rate_hz,
            heard,
            emitter,
            waveform,
            starts,
            sound_speed_mps=speed,
            gain=scene.gain[beacon.id] * reflection,
            absorption_db_per_m=scene.absorption_db_per_m[beacon.id],
            stretch=stretch,
            microphone_delay_s=delay_s,
        )
