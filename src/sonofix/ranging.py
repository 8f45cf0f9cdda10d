"""Detections → ranges, at the one instant that defines a row.

``time_s`` = t is when the microphone hears the middle of the burst; the range is c times the time since that middle
was sent. Where the clock is not common to both ends, all ranges of an epoch share one unknown offset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sonofix.records import Acquisition, Floats, RangeEpoch, RangeRows, Waveform
from sonofix.site import Site

RANGES_WITHOUT_SD_M = 0.1
"""Deviation taken for a stated range that states none: what radio ranging of the better kind shows."""

TIMES_SD = 0.01
"""Share by which times of flight that others state may all be too long, where a thermometer made ranges of them: air
along the way that is not the thermometer's, and a clock that nobody checked."""

JERK_MPS3 = 2.0
"""How fast a range acceleration may change within a burst, one sigma: as a straight pass at 2.1 m/s, 2 m away."""

SWEEP_S = 1.0
"""Stated ranges are gathered into epochs no longer than this."""


def range_epoch(
    site: Site,
    waveforms: Mapping[str, Waveform],
    acquired: Acquisition,
    sound_speed_mps: float,
    sound_speed_sd_mps: float = 0.0,
) -> RangeEpoch:
    """Ranges of what was heard in one epoch, in order of arrival.

    What the site states of a pair's bias is taken off. ``covariance_m2`` holds each range's own variance, that bias's
    doubt, and what all share: the sound speed's error, in proportion. ``range_rate_sd_mps`` allows for a range
    acceleration that changes within the burst (`JERK_MPS3`).
    """
    heard = sorted(acquired.detections, key=lambda d: d.arrival_s)
    beacons = [site.beacon(d.emitter) for d in heard]
    delay_s = np.array([site.microphone(d.receiver).delay_s for d in heard])
    time_s = np.array([d.arrival_s for d in heard]) - delay_s
    sent_s = acquired.sync_s + np.array([b.offset_s + b.delay_s + waveforms[b.id].duration_s / 2 for b in beacons])
    sent_s -= np.array([d.sent_before_s for d in heard])
    emitter, receiver = tuple(d.emitter for d in heard), tuple(d.receiver for d in heard)
    bias_m, bias_sd_m = pair_biases(site, emitter, receiver)
    range_m = sound_speed_mps * (time_s - sent_s) - bias_m
    own = np.array([d.covariance[0, 0] for d in heard]) * sound_speed_mps**2 + bias_sd_m**2
    rate = sound_speed_mps * (1.0 - np.array([d.time_scale for d in heard]))
    # a burst is fitted as a parabola: what is cubic in it, j t³ / 6, tilts that by j T² / 40 (least squares over T)
    bent_mps = JERK_MPS3 * np.array([waveforms[d.emitter].duration_s for d in heard]) ** 2 / 40
    rate_sd = np.hypot(sound_speed_mps * np.sqrt([d.covariance[1, 1] for d in heard]), bent_mps)
    common_clock = not site.clock_known
    flight_m = flights_m(range_m, common_clock)
    shared = (sound_speed_sd_mps / sound_speed_mps) ** 2 * np.outer(flight_m, flight_m)
    return RangeEpoch(
        index=acquired.index,
        sync_s=acquired.sync_s,
        emitter=emitter,
        receiver=receiver,
        time_s=time_s,
        range_m=range_m,
        covariance_m2=np.diag(own) + shared,
        range_rate_mps=rate,
        range_rate_sd_mps=rate_sd,
        snr_db=np.array([d.snr_db for d in heard]),
        clock="common" if common_clock else "known",
        sound_speed_mps=sound_speed_mps,
        flags=acquired.flags,
        sound_speed_sd_mps=sound_speed_sd_mps,
        bias_sd_m=bias_sd_m if bias_sd_m.any() else None,
    )


def pair_biases(site: Site, emitter: Sequence[str], receiver: Sequence[str]) -> tuple[Floats, Floats]:
    """By how much rows of these pairs are too long as the site states it, and its deviation, (n,) each in m."""
    stated = {(p.emitter, p.receiver): (p.bias_m, p.bias_sd_m) for p in site.pairs}
    found = [stated.get(pair, (0.0, 0.0)) for pair in zip(emitter, receiver, strict=True)]
    bias_m, sd_m = np.array(found, float).reshape(-1, 2).T.copy()
    return bias_m, sd_m


def flights_m(range_m: Floats, common_clock: bool) -> Floats:
    """Return what a wrong sound speed scales: ranges or, with an unknown offset inside, what each has beyond the least.

    That the least one's flight is scaled as well is the offset's to take.
    """
    return range_m - range_m.min() if common_clock and len(range_m) else range_m


def with_sound_speed(epoch: RangeEpoch, sound_speed_mps: float, sound_speed_sd_mps: float) -> RangeEpoch:
    """Return the ranges that the same delays are at another sound speed, of another deviation."""
    scale, common_clock = sound_speed_mps / epoch.sound_speed_mps, epoch.clock == "common"
    before = flights_m(epoch.range_m, common_clock) * (epoch.sound_speed_sd_mps / epoch.sound_speed_mps)
    after = flights_m(epoch.range_m, common_clock) * (sound_speed_sd_mps / epoch.sound_speed_mps)
    rate, rate_sd = epoch.range_rate_mps, epoch.range_rate_sd_mps
    return replace(
        epoch,
        range_m=scale * epoch.range_m,
        covariance_m2=scale**2 * (epoch.covariance_m2 - np.outer(before, before)) + np.outer(after, after),
        range_rate_mps=None if rate is None else scale * rate,
        range_rate_sd_mps=None if rate_sd is None else scale * rate_sd,
        sound_speed_mps=sound_speed_mps,
        sound_speed_sd_mps=sound_speed_sd_mps,
        bias_sd_m=None if epoch.bias_sd_m is None else scale * epoch.bias_sd_m,
    )


def stated_epochs(rows: RangeRows, site: Site) -> list[RangeEpoch]:
    """Epochs of ranges that a recording states: one sweep over the pairs each, until a pair comes again.

    What the site states of a pair's bias is taken off. Delays are not: a stated range is a way already. Whoever
    measured it knew when the burst left and was heard; delays say when the site's own schedule lets it sound.
    """
    epochs: list[RangeEpoch] = []
    order = np.argsort(rows.time_s, kind="stable")
    sweep: list[int] = []
    seen: set[tuple[str, str]] = set()

    c = site.sound_speed_mps
    speed_sd_mps = float(np.hypot(rows.speed_sd_mps, TIMES_SD * c)) if rows.speed_sd_mps else 0.0
    bias_m, bias_sd_m = pair_biases(site, rows.emitter, rows.receiver)
    range_m = rows.range_m - bias_m
    sds_m = np.full(len(range_m), np.nan) if rows.sd_m is None else rows.sd_m
    own_m2 = np.where(np.isnan(sds_m), RANGES_WITHOUT_SD_M, sds_m) ** 2 + bias_sd_m**2

    def close() -> None:
        at = np.array(sweep)
        flight_m = flights_m(range_m[at], not site.clock_known) * (speed_sd_mps / c)
        epochs.append(
            RangeEpoch(
                index=len(epochs),
                sync_s=float(rows.time_s[at[0]]),
                emitter=tuple(rows.emitter[i] for i in sweep),
                receiver=tuple(rows.receiver[i] for i in sweep),
                time_s=rows.time_s[at],
                range_m=range_m[at],
                covariance_m2=np.diag(own_m2[at]) + np.outer(flight_m, flight_m),
                range_rate_mps=None,
                range_rate_sd_mps=None,
                snr_db=None,
                clock="known" if site.clock_known else "common",
                sound_speed_mps=c,
                sound_speed_sd_mps=speed_sd_mps,
                sd_stated=not np.isnan(sds_m[at]).any(),
                bias_sd_m=bias_sd_m[at] if bias_sd_m.any() else None,
            )
        )

    for i in order:
        pair = (rows.emitter[i], rows.receiver[i])
        if sweep and (pair in seen or rows.time_s[i] - rows.time_s[sweep[0]] > SWEEP_S):
            close()
            sweep, seen = [], set()
        sweep.append(int(i))
        seen.add(pair)
    if sweep:
        close()
    return epochs
