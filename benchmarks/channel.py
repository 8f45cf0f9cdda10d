"""The simulator against real time and against the same sound written plainly in NumPy and SciPy."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from hall import PERIOD_S, RATE_HZ, lap_motion, recorded
from measure import beside, once, rms, table
from sonofix.channel import direct_gains, level_below
from sonofix.channel.simulate import absorption_of
from sonofix.records import Recording
from sonofix.signals.waveform import waveforms_of

LENGTH_S = 0.5


def simulator(turns: int) -> None:
    """Print the simulator's speed, without echoes and with, and its agreement with the plain way."""
    motion = lap_motion()
    quiet, _ = recorded(LENGTH_S, motion, snr_db=None)
    site, c = quiet.site, quiet.site.sound_speed_mps
    waveforms = waveforms_of(site)
    level = level_below(0.5, direct_gains(site, {"agv": motion}, waveforms, LENGTH_S), waveforms)
    splines = {
        beacon: CubicSpline(w.start_s + np.arange(len(w.envelope)) / w.rate_hz, w.envelope, extrapolate=False)
        for beacon, w in waveforms.items()
    }
    time_s = np.arange(round(LENGTH_S * RATE_HZ)) / RATE_HZ

    def plain() -> np.ndarray:
        """Fixed beacons: the delay is the distance at the moment of hearing, over c."""
        out = np.zeros(len(time_s))
        microphone = motion.at(time_s).position_m + np.array(site.microphones[0].lever_arm_m)
        for beacon, w in waveforms.items():
            away = np.linalg.norm(microphone - np.array(site.beacon(beacon).position_m), axis=1)
            gain = level * 10 ** (-absorption_of(site, w.carrier_hz) * away / 20) / away
            sent = time_s - away / c
            for k in range(-1, int(LENGTH_S / PERIOD_S) + 1):
                tau = sent - k * PERIOD_S
                envelope = np.nan_to_num(splines[beacon](tau))
                out += gain * np.real(envelope * np.exp(2j * np.pi * w.carrier_hz * tau))
        return out

    reference, own = plain(), _read(quiet)[:, 0]
    timed = beside(lambda: _read(quiet), plain, turns)
    error = f"{20 * np.log10(rms(own - reference) / rms(reference)):.0f} dB"
    rows = [["direct sound", f"{LENGTH_S / timed.job_s:.1f} ×", f"{1 / timed.ratio:.1f} ×", error]]
    for name, echo in (("direct sound and noise", 0.0), ("and six echoes each", 0.6)):
        made, _ = recorded(LENGTH_S, motion, echo=echo)
        best = min(once(lambda made=made: _read(made)) for _ in range(max(2, turns // 2)))
        rows.append([name, f"{LENGTH_S / best:.1f} ×", "", ""])
    table(
        "Simulator: eight beacons, one moving microphone, 192 kHz",
        ("sound", "faster than real time", "faster than plain NumPy", "difference from it, rms"),
        rows,
    )


def _read(recording: Recording) -> np.ndarray:
    assert recording.blocks is not None
    return np.concatenate(list(recording.blocks(65536)))
