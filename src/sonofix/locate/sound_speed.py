"""The sound speed learnt from epoch to epoch: what redundant ranges say of it corrects the thermometer.

Each fix tells the speed that its own ranges ask for, with the speed it was given as the prior (`Fix.sound_speed_mps`).
Handing on by how much that differs from what the thermometer gives, a little widened for air that changes, is a Kalman
filter of one state. Where `temperature.csv` tells of changes they are followed at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sonofix import air
from sonofix.ranging import with_sound_speed
from sonofix.records import Event, Fix, Floats, RangeEpoch, Table
from sonofix.site import Site

DOUBTED = 6.0
"""Before ranges have spoken, a thermometer may be wrong by so many times what is claimed: it hangs in the sun."""

LEARNT = 0.5
"""The ranges must know the speed this much better than the thermometer before it is theirs."""

WANDER_MPS = 0.6
"""How far the speed strays in `WANDER_S`, one sigma: a kelvin."""

WANDER_S = 600.0

TOLD = 1e-3
"""Relative deviation at which the speed is worth telling of, and change at which it is again."""

PATIENCE = 5
"""Epochs in a row whose ranges disagree before what was learnt is forgotten."""


@dataclass(frozen=True, slots=True)
class _Belief:
    time_s: float
    off_mps: float
    """By how much the ranges' speed is above what the thermometer gives."""
    sd_mps: float
    told_mps: float
    """What the thermometer gave when it was learnt."""


@dataclass(frozen=True, slots=True, eq=False)
class Thermometer:
    """Speeds (k,) that a recording's temperatures give, each from its time (k,) until the next."""

    time_s: Floats
    speed_mps: Floats

    def at(self, time_s: float) -> float:
        """Return the speed at an instant; before the first row that of the first."""
        return float(self.speed_mps[max(int(np.searchsorted(self.time_s, time_s, side="right")) - 1, 0)])


def thermometer(site: Site, table: Table | None) -> Thermometer | None:
    """Return what temperatures told on the way say of the sound speed; None: nothing, or the site states a speed.

    ``table`` holds `time_s` and `temperature_c`; its empty cells are passed over. Humidity and pressure are the site's.
    """
    if table is None or site.air.sound_speed_mps is not None:
        return None
    time_s, temperature_c = table.columns["time_s"], table.columns["temperature_c"]
    told = np.isfinite(time_s) & np.isfinite(temperature_c)
    if not told.any():
        return None
    warmth_c: Floats = np.asarray(temperature_c[told], np.float64)
    speed_mps = air.sound_speed_mps(warmth_c, site.air.humidity, site.air.pressure_kpa)
    return Thermometer(time_s[told], speed_mps)


class SoundSpeed:
    """Follows the sound speed of one run; ranges whose epochs take theirs as it is pass through untouched.

    ``warmth`` is what a thermometer tells on the way; None: the air is as the site states it. Unless it ``learns``,
    that is taken as it is.
    """

    def __init__(self, warmth: Thermometer | None = None, learns: bool = True) -> None:
        self._warmth, self._learns = warmth, learns
        self._belief: _Belief | None = None
        self._last_mps: float | None = None
        self._told_mps: float | None = None
        self._refused = 0

    @property
    def sound_speed_mps(self) -> float | None:
        """That of the last epoch; None where neither thermometer nor ranges have told of it."""
        return self._last_mps

    def take(
        self, epoch: RangeEpoch, solve: Callable[[RangeEpoch], tuple[Fix, ...]]
    ) -> tuple[RangeEpoch, tuple[Fix, ...], tuple[Event, ...]]:
        """Solve an epoch with the best speed known, and learn from it.

        Parameters
        ----------
        epoch : RangeEpoch
            By the speed that the site states or its thermometer gives.
        solve : callable
            Gives the fixes of an epoch.

        Returns
        -------
        epoch : RangeEpoch
            By the speed learnt so far, or else by the thermometer's.
        fixes : tuple of Fix
            Of that.
        events : tuple of Event
            "sound-speed" where it has become known to 0.1 %, or has changed by as much.
        """
        if not epoch.sound_speed_sd_mps:
            return epoch, solve(epoch), ()
        if self._warmth is not None:
            self._last_mps = self._warmth.at(epoch.sync_s)
            epoch = with_sound_speed(epoch, self._last_mps, epoch.sound_speed_sd_mps)
        if not self._learns:
            epoch = with_sound_speed(epoch, epoch.sound_speed_mps, 0.0)
        prior = self._prior(epoch, solve) if self._learns else None
        if prior is None:
            return epoch, solve(epoch), ()
        asked = with_sound_speed(epoch, *prior)
        self._last_mps = prior[0]
        fixes = solve(asked)
        best = _best(fixes)
        self._refused = self._refused + 1 if best is None and any(f.status == "inconsistent" for f in fixes) else 0
        if best is not None:
            self._belief = _Belief(epoch.sync_s, best[0] - epoch.sound_speed_mps, best[1], epoch.sound_speed_mps)
            self._last_mps = best[0]
        elif self._refused >= PATIENCE:
            self._belief, self._refused, self._last_mps = None, 0, epoch.sound_speed_mps
        return asked, fixes, self._tell(epoch)

    def _prior(self, epoch: RangeEpoch, solve: Callable[[RangeEpoch], tuple[Fix, ...]]) -> tuple[float, float] | None:
        """Return speed and deviation to solve an epoch with; None where ranges have not told of it yet."""
        sd_mps = epoch.sound_speed_sd_mps
        if self._belief is not None:
            aged_s = max(epoch.sync_s - self._belief.time_s, 0.0)
            aged_sd_mps = float(np.hypot(self._belief.sd_mps, WANDER_MPS * np.sqrt(aged_s / WANDER_S)))
            # whether the air has changed, or the thermometer only rounds, is for the ranges to say
            changed_mps = epoch.sound_speed_mps - self._belief.told_mps
            return epoch.sound_speed_mps + self._belief.off_mps, float(np.hypot(min(aged_sd_mps, sd_mps), changed_mps))
        found = _best(solve(with_sound_speed(epoch, epoch.sound_speed_mps, DOUBTED * sd_mps)))
        # the speed comes from this very epoch: what is believed of it beforehand stays as wide as before it spoke
        return (found[0], DOUBTED * sd_mps) if found is not None and found[1] < LEARNT * sd_mps else None

    def _tell(self, epoch: RangeEpoch) -> tuple[Event, ...]:
        belief = self._belief
        if belief is None:
            return ()
        speed_mps = epoch.sound_speed_mps + belief.off_mps
        if belief.sd_mps > TOLD * speed_mps:
            return ()
        if self._told_mps is not None and abs(speed_mps - self._told_mps) <= TOLD * speed_mps:
            return ()
        self._told_mps = speed_mps
        source = "the site's air" if self._warmth is None else "temperature.csv"
        text = (
            f"{speed_mps:.2f} ± {belief.sd_mps:.2f} m/s by the ranges themselves, {belief.off_mps:+.2f} m/s from what "
            f"{source} gives"
        )
        return (Event(epoch.sync_s, "", "sound-speed", text),)


def _best(fixes: tuple[Fix, ...]) -> tuple[float, float] | None:
    """Return speed and deviation of the fix that knows it best, among those that are well."""
    known = [
        (f.sound_speed_sd_mps, f.sound_speed_mps)
        for f in fixes
        if f.status == "ok" and f.sound_speed_mps is not None and f.sound_speed_sd_mps is not None
    ]
    sd_mps, speed_mps = min(known, default=(0.0, 0.0))
    return (speed_mps, sd_mps) if known else None
