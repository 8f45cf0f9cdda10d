"""The first seed's figure 3: coarse fixes and velocities of a straight drive, and the four-state filter on them.

On the seed's own numbers, fixes are true places with white errors of 5 cm. Beside it the same drive is heard: beacons
sound, the receiver ranges, fixes and tracks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sonofix.channel import Line
from sonofix.records import Curve, Finding, Floats, Panel, Sheet
from sonofix.studies import four_state
from sonofix.studies.halls import Heard, hall, laid_out, listened, sounded, truth_at
from sonofix.studies.work import Work, batches, rms

START_M = (0.5, 0.5)
SPEED_MPS = (0.5, 0.5)
PERIOD_S = 0.5
FIX_SD_M = 0.05
SPEED_SD_MPS = 0.02
FIRST = (0.01, 0.01, 0.01, 0.01)
"""X̂(−1)."""

EPOCHS, SETTLED = 120, 60
"""A run of one minute, of which the second half counts: by then the wrong start, which fades by 0.82 an epoch, is
below a hundredth of a millimetre."""

DRIVE_S = 18.0
"""What is drawn, and heard: as far as a hall of 10 m × 10 m allows."""

WARM = 8
"""Epochs of a heard drive that do not count: the track's start."""

LEVEL_M = 0.4
_BEACONS_M = (
    (0.0, 0.0, 3.2),
    (5.0, 0.0, 3.1),
    (10.0, 0.0, 3.2),
    (10.0, 5.0, 3.1),
    (10.0, 10.0, 3.2),
    (5.0, 10.0, 3.1),
    (0.0, 10.0, 3.2),
    (0.0, 5.0, 3.1),
)


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """Runs on the seed's numbers: coarse places and velocities (runs, n, 2), and states by Q with and without places.

    A velocity that would need the fix after the last is NaN.
    """

    coarse_m: Floats
    coarse_mps: Floats
    printed: Floats
    lean: Floats


def study(runs: int, seed: int, waveforms: int, drive_s: float = DRIVE_S) -> Work:
    """Set the study up; a drive from waveforms lasts ``drive_s``, 5 s or more."""
    return _QuasiGps(runs, seed, waveforms, drive_s)


def truth(time_s: Floats) -> tuple[Floats, Floats]:
    """True places (n, 2) and velocities (n, 2)."""
    velocity = np.tile(SPEED_MPS, (len(time_s), 1))
    return np.asarray(START_M) + time_s[:, None] * velocity, velocity


def simulated(numbers: range, seed: int, epochs: int = EPOCHS) -> Runs:
    """Compute runs by their numbers, each with a generator of its own."""
    noise = four_state.measurement_noise(FIX_SD_M, FIX_SD_M)
    places, _ = truth(PERIOD_S * np.arange(epochs))
    errors = [np.random.default_rng([seed, 1, run]).standard_normal((epochs, 2)) for run in numbers]
    coarse = places + FIX_SD_M * np.array(errors)
    speeds = np.full_like(coarse, np.nan)
    speeds[:, :-1] = four_state.coarse_velocities(coarse, PERIOD_S)

    def filtered(sd_m: float) -> Floats:
        process = four_state.process_noise(sd_m, sd_m, SPEED_SD_MPS)
        gain = four_state.gains(PERIOD_S, noise, process, epochs)
        return four_state.follow(coarse, PERIOD_S, gain, np.array(FIRST))

    return Runs(coarse, speeds, filtered(FIX_SD_M), filtered(0.0))


class _QuasiGps:
    """The study in progress."""

    def __init__(self, runs: int, seed: int, waveforms: int, drive_s: float) -> None:
        self._wanted, self._seed, self._drives, self._drive_s = runs, seed, waveforms, drive_s
        self._done: list[Runs] = []
        self._heard: list[Heard] = []
        self._motion = Line((*START_M, LEVEL_M), (*SPEED_MPS, 0.0))

    def work(self) -> Iterator[tuple[str, float]]:
        """Compute the runs, then the drives from waveforms."""
        for numbers in batches(self._wanted):
            self._done.append(simulated(numbers, self._seed))
            yield "on the seed's numbers", numbers.stop / self._wanted
        site = hall("hall of 10 m × 10 m", (10.0, 10.0, 3.6), _BEACONS_M, "agv", LEVEL_M, synchronised=True)
        epochs = self._drives * round(self._drive_s / PERIOD_S)
        for drive in range(self._drives):
            steps = []
            recording = sounded(site, self._motion, self._drive_s, self._seed + drive)
            for step in listened(recording):
                steps.append(step)
                yield "from waveforms", min(1.0, (drive * epochs / self._drives + len(steps)) / epochs)
            self._heard.append(laid_out(steps))

    def sheet(self) -> Sheet | None:
        """Show what is finished."""
        if not self._done:
            return None
        panels = _panels("as printed", *self._printed()) + (self._ours() if self._heard else ())
        note = f"Fixes of {100 * FIX_SD_M:g} cm every {PERIOD_S:g} s, {SPEED_MPS[0]:g} m/s on each axis" + (
            "; below: the same drive heard, from waveforms" if self._heard else ""
        )
        return Sheet("Quasi-GPS: coarse and filtered", note, 4, panels, self._findings())

    def _findings(self) -> tuple[Finding, ...]:
        runs = Runs(*(np.concatenate([getattr(d, name) for d in self._done]) for name in Runs.__slots__))
        places, velocities = truth(PERIOD_S * np.arange(runs.coarse_m.shape[1]))
        settled = slice(SETTLED, None)
        out = [
            rms((runs.coarse_m - places)[:, settled], "coarse, eq 7", "position", "m", "5.0 cm"),
            rms((runs.coarse_mps - velocities)[:, settled], "coarse, eqs 8, 9", "velocity", "m/s", "14.0 cm/s"),
        ]
        for name, states, claims in (
            ("filtered, Q as printed", runs.printed, ("3.65 ± 0.15 cm", "1.27 ± 0.1 cm/s")),
            ("filtered, Q without places", runs.lean, ("3.1 cm", "1.7 cm/s")),
        ):
            out.append(rms((states[..., 0::2] - places)[:, settled], name, "position", "m", claims[0]))
            out.append(rms((states[..., 1::2] - velocities)[:, settled], name, "velocity", "m/s", claims[1]))
        if self._heard:
            errors = [self._errors(heard) for heard in self._heard]
            fixes, speeds, track, track_speeds = (np.array(each) for each in zip(*errors, strict=True))
            heard = "from waveforms"
            out += [
                rms(fixes, f"{heard}: fixes", "position", "m"),
                rms(speeds, f"{heard}: eqs 8, 9 on them", "velocity", "m/s"),
                rms(track, f"{heard}: track", "position", "m"),
                rms(track_speeds, f"{heard}: track", "velocity", "m/s"),
            ]
        return tuple(out)

    def _errors(self, heard: Heard) -> tuple[Floats, Floats, Floats, Floats]:
        """Errors of fixes, their differences, track and its velocity after the start, (n, 2) each, NaN where none."""
        at_fixes, _ = truth_at(self._motion, heard.fix_s)
        at_track, velocity = truth_at(self._motion, heard.track_s)
        coarse = four_state.coarse_velocities(heard.fix_m, np.diff(heard.fix_s)) - np.asarray(SPEED_MPS)
        return (
            (heard.fix_m - at_fixes)[WARM:],
            coarse[WARM:],
            (heard.track_m - at_track)[WARM:],
            (heard.track_mps - velocity)[WARM:],
        )

    def _printed(self) -> tuple[Floats, ...]:
        shown = round(DRIVE_S / PERIOD_S)
        first, time_s = self._done[0], PERIOD_S * np.arange(shown)
        coarse = np.column_stack([first.coarse_m[0], first.coarse_mps[0]])[:shown]
        states = first.printed[0, :shown][:, [0, 2, 1, 3]]
        return time_s, coarse, time_s, states

    def _ours(self) -> tuple[Panel, ...]:
        heard = self._heard[0]
        speeds = np.full_like(heard.fix_m, np.nan)
        speeds[:-1] = four_state.coarse_velocities(heard.fix_m, np.diff(heard.fix_s))
        coarse = np.column_stack([heard.fix_m, speeds])
        states = np.column_stack([heard.track_m, heard.track_mps])
        return _panels("from waveforms", heard.fix_s, coarse, heard.track_s, states)


def _panels(case: str, coarse_s: Floats, coarse: Floats, states_s: Floats, states: Floats) -> tuple[Panel, ...]:
    """The four panels of figure 3, of rows (n, 4) of x, y, vx and vy."""
    places, velocities = truth(coarse_s)
    true = np.column_stack([places, velocities])
    ours = case == "from waveforms"
    out = []
    for i, (name, unit) in enumerate((("x", "m"), ("y", "m"), ("vx", "m/s"), ("vy", "m/s"))):
        curves = (
            Curve("true", coarse_s, true[:, i], "truth"),
            Curve("fixes, and their differences" if ours else "coarse", coarse_s, coarse[:, i], "raw"),
            Curve("track" if ours else "filtered", states_s, states[:, i], "result"),
        )
        limits = (-0.2, 10.2) if unit == "m" else (-0.05, 1.3)
        out.append(Panel(name, case, "time, s", f"{name}, {unit}", curves, limits))
    return tuple(out)
