"""Levels and noise that are set before a run come out of it as asked."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.channel import Circle, Motion, Still, direct_gains, level_below, noise_for_snr, simulate
from sonofix.records import Waveform
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

SITE = Site.model_validate(
    {
        "site": {"name": "hall", "bounds_m": ((0, 0, 0), (6, 5, 3))},
        "schedule": {"period_s": 0.1},
        "signal": {"carrier_hz": 30e3, "cycles_per_chip": 10, "bandwidth_hz": 4e3},
        "vehicle": [{"id": "v"}],
        "beacon": [
            {"id": "A", "position_m": (0.0, 0.0, 3.0), "code": {"family": "gold", "degree": 6, "index": 0}},
            {"id": "B", "position_m": (6.0, 5.0, 3.0), "code": {"family": "gold", "degree": 6, "index": 3}},
            {"id": "C", "vehicle": "v", "code": {"family": "gold", "degree": 6, "index": 4}},
        ],
        "microphone": [
            {"id": "M", "channel": 0, "vehicle": "v"},
            {"id": "N", "channel": 1, "position_m": (1.0, 1.0, 1.0)},
            {"id": "unused", "position_m": (0.01, 0.0, 3.0)},
        ],
    }
)
DRIVE: dict[str, Motion] = {"v": Circle((3.0, 2.5, 0.5), 1.0, 2.0)}


def _waveforms() -> dict[str, Waveform]:
    return waveforms_of(SITE)


def test_gains_are_spreading_and_absorption() -> None:
    gains = direct_gains(SITE, {"v": Still((3.0, 4.0, 3.0))}, _waveforms(), 1.0, 1.5)
    assert gains.shape == (2, 3, 21)
    np.testing.assert_allclose(gains[0, 0], 10 ** (-1.5 * 5 / 20) / 5, rtol=1e-12)
    assert (gains[0, 2] == 0).all()
    assert (gains[1, 2] > 0).all()


@pytest.mark.parametrize("echo", [0.0, 0.6])
def test_no_sample_exceeds_the_peak_asked_for(echo: float) -> None:
    waveforms = _waveforms()
    level = level_below(0.5, direct_gains(SITE, DRIVE, waveforms, 1.0), waveforms, echo)
    recording, _ = simulate(SITE, DRIVE, rate_hz=96e3, duration_s=1.0, waveforms=waveforms, level=level, echo=echo)
    assert recording.blocks is not None
    peak = max(float(np.abs(b).max()) for b in recording.blocks(20_000))
    assert 0.05 < peak <= 0.5


def test_noise_has_the_snr_asked_for() -> None:
    waveforms = {"A": _waveforms()["A"]}
    motions: dict[str, Motion] = {"v": Still((3.0, 4.0, 1.0))}
    site = SITE.model_copy(update={"microphones": SITE.microphones[:1]})
    sd = noise_for_snr(6.0, 0.5, direct_gains(site, motions, waveforms, 1.0), waveforms)
    recording, _ = simulate(site, motions, rate_hz=96e3, duration_s=0.1, waveforms=waveforms, level=0.5)
    assert recording.blocks is not None
    x = np.concatenate(list(recording.blocks(20_000)))[:, 0].astype(float)
    start = np.linalg.norm([3.0, 4.0, 2.0]) / 343.2
    burst = x[int(start * 96e3) : int((start + waveforms["A"].duration_s) * 96e3)]
    assert 10 * np.log10(np.mean(burst**2) / sd**2) == pytest.approx(6.0, abs=0.1)


def test_an_snr_needs_a_sound() -> None:
    with pytest.raises(ValueError, match="no microphone hears"):
        noise_for_snr(6.0, 0.5, np.zeros((1, 0, 5)), {})
    assert level_below(0.5, np.zeros((1, 0, 5)), {}) == 0.5
