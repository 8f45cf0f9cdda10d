"""From a burst and a distance to what the receiver makes of it: heard or not, how strong, and the range's deviation.

The air is that of the simulator: a sound that went d metres has the amplitude level · 10^(−α d / 20) / d, and the noise
is white. With N₀ its one-sided density (for noise of deviation σ sampled at f_s: 2σ²/f_s) and a burst s of amplitude A,

- the Fisher information of its parameters is A²/N₀ · Re ∫ (∂s/∂a)* (∂s/∂b) dt (Kay 1993, section 15.7),
- its correlation peak stands A² E / (2 N₀) above the noise, E the energy that the searched-for signature finds.

Delay, range rate, range acceleration (with the receiver's prior) and the complex gain are unknown together, as they are
to the receiver: a chirp, whose delay and range rate look alike, pays for that here too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sonofix.acquire.bank import velocity_step_mps
from sonofix.acquire.baseband import design_band
from sonofix.channel.propagate import NEAREST_M
from sonofix.records import Floats, Waveform

FALSE_ALARM_RATE = 1e-4
ACCELERATION_SD_MPS2 = 4.0
"""The receiver's (`acquire.plan.make_plan`)."""

HEARD_DEVIATIONS = 1.2816
"""A burst counts as heard where nine in ten would be found in a search from nothing."""

HALF_DB = -6.0
"""What a beam's stated width is measured at."""


@dataclass(frozen=True, slots=True)
class Budget:
    """How loud and how quiet a site is.

    Attributes
    ----------
    level : float
        Amplitude of an envelope of 1 at 1 m, full scale 1.
    noise_sd : float
        Of one sample, full scale 1.
    rate_hz : float
        Of the samples.
    beam_rad : float or None
        Full width between −6 dB of the fixed transducers: their amplitude falls as a power of the cosine of the angle
        off their axis, and is 0 behind. None: alike all round.
    """

    level: float
    noise_sd: float
    rate_hz: float
    beam_rad: float | None = None

    @property
    def density(self) -> float:
        """One-sided density N₀ of the noise, full scale² per Hz."""
        return 2.0 * self.noise_sd**2 / self.rate_hz


@dataclass(frozen=True, slots=True)
class Link:
    """What of a burst decides how well it is heard; for an amplitude of 1.

    Attributes
    ----------
    power : float
        Mean of the envelope's square, from the first chip to the last.
    energy : float
        E, as above.
    by_delay, by_both, by_bend : float
        Information Re ∫ … dt of delay and of range acceleration over c (1/s), range rate and gain already paid for.
    threshold : float
        What the correlation peak must exceed over the noise in a search from nothing.
    noise_band_hz : float
        Width of the band in which the receiver states its SNR.
    absorption_db_per_m : float
    """

    power: float
    energy: float
    by_delay: float
    by_both: float
    by_bend: float
    threshold: float
    noise_band_hz: float
    absorption_db_per_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Strength:
    """How bursts are heard, each array in one shape: ``sd_m`` is by noise alone; ``heard`` as `HEARD_DEVIATIONS`."""

    heard: np.ndarray
    snr_db: Floats
    sd_m: Floats


def links_of(
    waveforms: Sequence[Waveform],
    rate_hz: float,
    sound_speed_mps: float,
    absorption_db_per_m: Sequence[float],
    reach_s: float,
    max_rate_mps: float,
) -> list[Link]:
    """Work out the links of a site's bursts.

    Parameters
    ----------
    waveforms : sequence of Waveform
    rate_hz : float
        Of the recording's samples.
    absorption_db_per_m : sequence of float
        At each burst's carrier.
    reach_s, max_rate_mps : float
        How long after it was sent a burst is looked for, and up to which range rate: they make the number of cells
        among which noise may be highest.

    Raises
    ------
    ValueError
        If the sample rate is too low for a carrier.
    """
    links = []
    bands = {w.carrier_hz: None for w in waveforms}
    bands = {f: design_band([w for w in waveforms if w.carrier_hz == f], rate_hz) for f in bands}
    for waveform, absorption in zip(waveforms, absorption_db_per_m, strict=True):
        band = bands[waveform.carrier_hz]
        step_mps = velocity_step_mps(waveform, sound_speed_mps)
        rates = 2 * int(np.ceil(max_rate_mps / step_mps - 0.5)) + 1 if max_rate_mps > step_mps / 2 else 1
        cells = max(reach_s * band.rate_hz, 1.0) * rates
        step_s = 1.0 / waveform.rate_hz
        shared = np.vdot(waveform.signature, waveform.envelope)
        inside = slice(
            int(-waveform.start_s * waveform.rate_hz),
            int((waveform.duration_s - waveform.start_s) * waveform.rate_hz),
        )
        links.append(
            Link(
                power=float(np.mean(np.abs(waveform.envelope[inside]) ** 2)),
                energy=float(abs(shared) ** 2 / np.vdot(waveform.signature, waveform.signature).real) * step_s,
                **_information(waveform),
                threshold=float(np.log(cells / FALSE_ALARM_RATE)),
                noise_band_hz=band.rate_hz / band.whiteness,
                absorption_db_per_m=float(absorption),
            )
        )
    return links


def _information(waveform: Waveform) -> dict[str, float]:
    """Information of delay and bend when the complex gain and the range rate are unknown too."""
    time_s = waveform.start_s + np.arange(len(waveform.envelope)) / waveform.rate_hz
    u, turn = time_s - waveform.duration_s / 2, 2j * np.pi * waveform.carrier_hz
    slope = np.gradient(waveform.envelope, 1.0 / waveform.rate_hz) + turn * waveform.envelope
    # heard at t: τ = T/2 + u − βu − κu²/2, so that each parameter moves τ, and τ the sound
    columns = np.stack([waveform.envelope, 1j * waveform.envelope, u * slope, slope, u**2 / 2 * slope])
    real = np.concatenate([columns.real, columns.imag], axis=1)
    whole = real @ real.T / waveform.rate_hz
    scale = np.sqrt(np.diag(whole))
    whole /= np.outer(scale, scale)
    paid, kept = slice(0, 3), slice(3, 5)
    rest = whole[kept, kept] - whole[kept, paid] @ np.linalg.solve(whole[paid, paid], whole[paid, kept])
    rest *= np.outer(scale[kept], scale[kept])
    return {"by_delay": float(rest[0, 0]), "by_both": float(rest[0, 1]), "by_bend": float(rest[1, 1])}


def strength(
    link: Link, budget: Budget, distance_m: Floats, sound_speed_mps: float, cos_off_axis: Floats | None = None
) -> Strength:
    """How a burst is heard from each distance.

    Parameters
    ----------
    link : Link
    budget : Budget
    distance_m : float64, any shape
    cos_off_axis : float64, same shape, optional
        Of the angle between the fixed transducer's axis and the way; needed where the budget has a beam.

    Returns
    -------
    Strength
    """
    amplitude = budget.level * 10 ** (-link.absorption_db_per_m * distance_m / 20) / np.maximum(distance_m, NEAREST_M)
    if budget.beam_rad is not None:
        if cos_off_axis is None:
            raise ValueError("cos_off_axis is missing: a beam needs the angle off its axis")
        amplitude = amplitude * pattern(budget.beam_rad, cos_off_axis)
    times = np.maximum(amplitude**2, 1e-300) / budget.density
    # the acceleration's prior stands beside its information: inverse of [[d, b], [b, k + prior]], top left
    prior = (sound_speed_mps / ACCELERATION_SD_MPS2) ** 2
    delay = times * (link.by_delay - times * link.by_both**2 / (times * link.by_bend + prior))
    peak = times * link.energy / 2
    return Strength(
        heard=np.sqrt(peak) >= np.sqrt(link.threshold) + HEARD_DEVIATIONS / np.sqrt(2),
        snr_db=10 * np.log10(times * link.power / (2 * link.noise_band_hz)),
        sd_m=sound_speed_mps / np.sqrt(delay),
    )


def pattern(beam_rad: float, cos_off_axis: Floats) -> Floats:
    """Amplitude off a transducer's axis: cosⁿ, with −6 dB at half the beam's full width; 0 behind.

    Beams of half a turn and more are taken as alike all round.
    """
    half = np.cos(beam_rad / 2)
    if half <= 1e-9:
        return np.ones_like(cos_off_axis)
    return np.maximum(cos_off_axis, 0.0) ** (HALF_DB / 20 * np.log(10) / np.log(half))


def farthest_m(link: Link, budget: Budget, sound_speed_mps: float) -> float:
    """Greatest distance at which a burst is heard on its axis; 0 where it is heard nowhere."""
    distance_m = np.geomspace(NEAREST_M, 1e4, 20000)
    heard = strength(link, budget, distance_m, sound_speed_mps, np.ones_like(distance_m)).heard
    return float(distance_m[heard][-1]) if heard.any() else 0.0


def level_for_snr(snr_db: float, distance_m: float, link: Link, budget: Budget) -> float:
    """Level at which a burst from ``distance_m``, on its axis, has an SNR as ``ranges.csv`` states it."""
    times = 10 ** (snr_db / 10) * 2 * link.noise_band_hz / link.power
    loss = 10 ** (-link.absorption_db_per_m * distance_m / 20) / max(distance_m, NEAREST_M)
    return float(np.sqrt(times * budget.density) / loss)
