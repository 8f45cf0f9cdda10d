"""From a beacon's code to the burst that a microphone hears: keying, carrier, transducers, or a recorded reference.

A transducer is a resonator; a burst passes two, one that sends and one that hears. Both are linear, so the burst
is the keyed envelope filtered by the product of their responses, computed on the exact spectrum of rectangular chips.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sonofix.records import Floats, ReferenceBurst, Waveform
from sonofix.signals import codes
from sonofix.site import (
    Beacon,
    ChipsCode,
    ChirpCode,
    GoldCode,
    KasamiCode,
    MSequenceCode,
    ReferenceCode,
    Signal,
    Site,
)

SAMPLES_PER_CHIP = 64
"""Of a waveform's table; see `interpolate` for what this costs in accuracy."""

REFERENCE_OVERSAMPLING = 16
"""Table samples for each sample of a recorded reference."""


def chips_of(beacon: Beacon) -> NDArray[np.int8] | None:
    """Chips (0/1, first chip first) of a beacon's code; None for chirps and recorded references."""
    match beacon.code:
        case ChipsCode(chips=chips):
            return np.frombuffer(chips.encode("ascii"), np.int8) - ord("0")
        case MSequenceCode(degree=degree, taps=taps):
            return codes.m_sequence(degree, taps)
        case GoldCode(degree=degree, index=index):
            return codes.gold(degree, index)
        case KasamiCode(degree=degree, index=index):
            return codes.kasami(degree, index)
    return None


def resonance(offset_hz: Floats, bandwidth_hz: float) -> NDArray[np.complexfloating]:
    """Response of one transducer to its envelope, at offsets from its resonance: ``1 / (1 + j f / (B/2))``.

    The narrow-band form of a resonator of −3 dB width B: one pole, time constant 1 / (π B), gain 1 at the resonance.
    """
    return 1.0 / (1.0 + 2j * offset_hz / bandwidth_hz)


def keyed_waveform(chips: NDArray[np.int8], signal: Signal) -> Waveform:
    """Burst of a chip sequence: on-off keyed ("ask") or antipodal ("bpsk"), through both transducers.

    Raises
    ------
    ValueError
        If the signal states no ``cycles_per_chip``.
    """
    if signal.cycles_per_chip is None:
        raise ValueError("signal.cycles_per_chip is missing: chips need a length; state the carrier cycles of one chip")
    chip_s = signal.cycles_per_chip / signal.carrier_hz
    levels = chips.astype(float) if signal.modulation == "ask" else 2.0 * chips - 1.0
    # only on-off codes have a mean worth removing: it is the bare carrier, which every beacon shares
    shared = levels.mean() if signal.modulation == "ask" else 0.0
    ring_s = 0.0 if signal.bandwidth_hz is None else 14.0 / (np.pi * signal.bandwidth_hz)
    lead = 2 * SAMPLES_PER_CHIP
    count = lead + SAMPLES_PER_CHIP * (len(chips) + 2 + int(np.ceil(ring_s / chip_s)))
    rate_hz = SAMPLES_PER_CHIP / chip_s
    offset_hz = np.fft.fftfreq(count, 1.0 / rate_hz)
    pulse = SAMPLES_PER_CHIP * np.sinc(offset_hz * chip_s) * np.exp(-1j * np.pi * offset_hz * chip_s)
    if signal.bandwidth_hz is not None:
        pulse = pulse * resonance(offset_hz, signal.bandwidth_hz) ** 2

    def shaped(values: Floats) -> NDArray[np.complex128]:
        train = np.zeros(count)
        train[lead : lead + SAMPLES_PER_CHIP * len(values) : SAMPLES_PER_CHIP] = values
        return np.fft.ifft(np.fft.fft(train) * pulse)

    envelope = shaped(levels)
    signature = shaped(levels - shared) if shared else envelope
    return Waveform(envelope, signature, rate_hz, -lead / rate_hz, signal.carrier_hz, len(chips) * chip_s)


def chirp_waveform(code: ChirpCode, signal: Signal) -> Waveform:
    """Linear chirp from ``start_hz`` to ``stop_hz``, through both transducers where a bandwidth is stated."""
    sweep_hz = abs(code.stop_hz - code.start_hz)
    rate_hz = 32.0 * max(sweep_hz, signal.bandwidth_hz or 0.0, 4.0 / code.duration_s)
    ring_s = 0.0 if signal.bandwidth_hz is None else 14.0 / (np.pi * signal.bandwidth_hz)
    lead = 64
    count = lead + int(np.ceil((code.duration_s + ring_s) * rate_hz)) + 64
    tau = (np.arange(count) - lead) / rate_hz
    inside = (tau >= 0) & (tau < code.duration_s)
    phase = (code.start_hz - signal.carrier_hz) * tau + (code.stop_hz - code.start_hz) * tau**2 / (2 * code.duration_s)
    envelope = np.where(inside, np.exp(2j * np.pi * phase), 0.0)
    if signal.bandwidth_hz is not None:
        offset_hz = np.fft.fftfreq(count, 1.0 / rate_hz)
        response = resonance(offset_hz, signal.bandwidth_hz) ** 2
        envelope = np.fft.ifft(np.fft.fft(envelope) * response)
    return Waveform(envelope, envelope, rate_hz, -lead / rate_hz, signal.carrier_hz, code.duration_s)


def reference_waveform(
    burst: ReferenceBurst, signal: Signal, sound_speed_mps: float, distance_m: float = 0.0, start_s: float = 0.0
) -> Waveform:
    """Burst as it was recorded at a known distance (the first seed's calibration, eqs 4–6).

    Time 0 of the burst is when it was *sent*: the file's ``start_s``; its sound stands ``distance_m / c`` later in the
    file, so that a delay N against the file means the range ``distance_m + c N``, as the seed's equation 6 has it.

    Raises
    ------
    ValueError
        If the file is too short, or its rate too low for the carrier.
    """
    if 2 * signal.carrier_hz >= burst.rate_hz:
        raise ValueError(
            f"the reference is sampled at {burst.rate_hz:g} Hz, too slow for a carrier of {signal.carrier_hz:g} Hz"
        )
    if len(burst.samples) < 16:
        raise ValueError(f"the reference holds {len(burst.samples)} samples; at least 16 are needed")
    samples = burst.samples - burst.samples.mean()
    factor, pad = REFERENCE_OVERSAMPLING, 32
    padded = np.concatenate([np.zeros(pad), samples, np.zeros(pad)])
    count = len(padded)
    # the analytic signal, moved to base band by whole bins so that the table stays periodic, then the rest in time
    spectrum = np.fft.fft(padded)
    spectrum[count // 2 + 1 :] = 0.0
    spectrum[1 : (count + 1) // 2] *= 2.0
    shift = round(signal.carrier_hz * count / burst.rate_hz)
    wide = np.zeros(count * factor, complex)
    offsets = np.arange(count // 2 + 1) - shift
    wide[offsets % len(wide)] = spectrum[: count // 2 + 1]
    rate_hz = burst.rate_hz * factor
    time_s = (np.arange(len(wide)) / factor - pad) / burst.rate_hz
    residual_hz = shift * burst.rate_hz / count - signal.carrier_hz
    envelope = np.fft.ifft(wide) * factor * np.exp(2j * np.pi * residual_hz * (time_s + pad / burst.rate_hz))
    duration_s = len(samples) / burst.rate_hz - start_s
    start = -pad / burst.rate_hz - start_s - distance_m / sound_speed_mps
    return Waveform(envelope, envelope, rate_hz, start, signal.carrier_hz, duration_s)


def waveforms_of(site: Site, references: Mapping[str, ReferenceBurst] | None = None) -> dict[str, Waveform]:
    """Return what each coded beacon of a site sends, by its id; recorded bursts come from ``references``."""
    return {b.id: waveform_of(site, b, (references or {}).get(b.id)) for b in site.coded_beacons}


def waveform_of(site: Site, beacon: Beacon, reference: ReferenceBurst | None = None) -> Waveform:
    """Return the burst of one beacon of a site.

    Raises
    ------
    ValueError
        If the beacon has no code, or its code is a recorded reference and none is given.
    """
    signal = site.signal_of(beacon)
    if isinstance(beacon.code, ReferenceCode):
        if reference is None:
            raise ValueError(
                f"beacon {beacon.id}: its code is the recording {beacon.code.reference}, which was not given"
            )
        return reference_waveform(
            reference, signal, site.sound_speed_mps, beacon.code.distance_m or 0.0, beacon.code.start_s or 0.0
        )
    if isinstance(beacon.code, ChirpCode):
        return chirp_waveform(beacon.code, signal)
    chips = chips_of(beacon)
    if chips is None:
        raise ValueError(f"beacon {beacon.id} has no code: it takes no part in reading samples")
    return keyed_waveform(chips, signal)
