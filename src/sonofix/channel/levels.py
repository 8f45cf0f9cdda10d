"""How loud a run will be, before it is simulated: for a level that does not clip and a noise that fits an SNR."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sonofix.channel.motion import Motion
from sonofix.channel.propagate import NEAREST_M
from sonofix.channel.scene import position_at, survey_times
from sonofix.channel.simulate import absorption_of
from sonofix.records import Floats, Waveform
from sonofix.site import Site


def direct_gains(
    site: Site,
    motions: Mapping[str, Motion],
    waveforms: Mapping[str, Waveform],
    duration_s: float,
    absorption_db_per_m: float | None = None,
) -> Floats:
    """Amplitude of every beacon's direct sound at every microphone, for ``level`` 1 and an envelope of 1.

    Parameters as in `simulate`.

    Returns
    -------
    float64, shape (microphones with a channel, waveforms, n)
        20 columns a second; 0 where a vehicle does not hear its own beacon.
    """
    time_s = survey_times(duration_s)
    microphones = [m for m in site.microphones if m.channel is not None]
    gains = np.zeros((len(microphones), len(waveforms), len(time_s)))
    for j, (beacon_id, waveform) in enumerate(waveforms.items()):
        beacon = site.beacon(beacon_id)
        sent = position_at(beacon, motions, time_s)
        loss = absorption_of(site, waveform.carrier_hz) if absorption_db_per_m is None else absorption_db_per_m
        for i, microphone in enumerate(microphones):
            if not (beacon.vehicle and beacon.vehicle == microphone.vehicle):
                distance = np.linalg.norm(position_at(microphone, motions, time_s) - sent, axis=1)
                gains[i, j] = 10 ** (-loss * distance / 20) / np.maximum(distance, NEAREST_M)
    return gains


def level_below(peak: float, gains: Floats, waveforms: Mapping[str, Waveform], echo: float = 0.0) -> float:
    """Return the ``level`` at which all sounds together stay below ``peak`` at every microphone, noise aside.

    ``gains`` from `direct_gains`. Six echoes, each no louder than the direct sound, are allowed for where ``echo`` is
    not 0.
    """
    loudest = np.array([float(np.abs(w.envelope).max()) for w in waveforms.values()])
    together = float(np.einsum("ijn,j->in", gains, loudest).max(initial=0.0)) * (1 + 6 * abs(echo))
    return peak / together if together > 0 else peak


def noise_for_snr(snr_db: float, level: float, gains: Floats, waveforms: Mapping[str, Waveform]) -> float:
    """Return the noise's standard deviation for which the median burst has a given SNR.

    The median is over microphones, beacons and instants of ``gains`` (from `direct_gains`); SNR is the mean power of a
    burst while it lasts over the noise power in the whole band, from 0 to half the sample rate.

    Raises
    ------
    ValueError
        If no microphone hears any beacon.
    """
    power = []
    for waveform in waveforms.values():
        time_s = waveform.start_s + np.arange(len(waveform.envelope)) / waveform.rate_hz
        lasting = (time_s >= 0) & (time_s < waveform.duration_s)
        power.append(float(np.mean(np.abs(waveform.envelope[lasting]) ** 2)) / 2)
    heard = gains**2 * np.array(power)[None, :, None]
    if not (heard > 0).any():
        raise ValueError("no microphone hears any beacon, so no burst sets an SNR; state the noise itself")
    return float(level * np.sqrt(np.median(heard[heard > 0]) / 10 ** (snr_db / 10)))
