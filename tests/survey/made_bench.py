"""A bench: one beacon, one microphone, a metre between them, and a site file that does not know the beacon well."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sonofix.channel import simulate
from sonofix.records import Recording
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

SPEED_MPS = 343.2
CODE = {"family": "m-sequence", "degree": 6, "taps": [1]}
OTHER = {"family": "m-sequence", "degree": 6, "taps": [5]}
DELAY_S = 2e-4


def bench(
    code: dict[str, Any] | None = CODE,
    bandwidth_hz: float = 4e3,
    delay_s: float = 0.0,
    distance_m: float = 1.0,
    period_s: float = 0.1,
    synchronised: bool = True,
    others: tuple[dict[str, Any], ...] = (),
    bounds_m: list[list[float]] | None = None,
    **signal: Any,
) -> Site:
    beacon = {"id": "B1", "position_m": [0.0, 0.0, 1.0], "delay_s": delay_s} | ({} if code is None else {"code": code})
    return Site.model_validate(
        {
            "site": {"name": "bench"} | ({} if bounds_m is None else {"bounds_m": bounds_m}),
            "air": {"sound_speed_mps": SPEED_MPS},
            "schedule": {"period_s": period_s, "synchronised": synchronised},
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10, "bandwidth_hz": bandwidth_hz} | signal,
            "beacon": [beacon, *others],
            "microphone": [{"id": "M", "channel": 0, "position_m": [distance_m, 0.0, 1.0]}],
        }
    )


def record(
    true: Site,
    told: Site,
    bursts: int = 16,
    rate_hz: float = 192e3,
    noise_sd: float = 1e-3,
    beacons: tuple[str, ...] = ("B1",),
    **more: Any,
) -> Recording:
    """Record the true site's beacons; the recording comes with the site file that the user has."""
    assert true.schedule is not None
    assert true.schedule.period_s is not None
    waveforms = {name: w for name, w in waveforms_of(true).items() if name in beacons}
    made, _ = simulate(
        true,
        {},
        rate_hz=rate_hz,
        duration_s=(bursts - 0.5) * true.schedule.period_s,
        waveforms=waveforms,
        noise_sd=noise_sd,
        **{"level": 0.3} | more,
    )
    return replace(made, site=told)


def distorted(**more: Any) -> Site:
    """Narrower transducers than the site file says, and a delay that it does not mention."""
    return bench(**{"bandwidth_hz": 2.2e3, "delay_s": DELAY_S} | more)
