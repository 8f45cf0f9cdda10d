"""The seeds' simulations, a file a seed: what each claims on its own numbers, and the same through our receiver."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from math import inf

from sonofix.studies.work import Work

STUDIES = {
    "quasi-gps": "an automatic vehicle: coarse fixes and velocities, and the four-state filter",
    "pedestrian": "a walker: differences of arrival times, dead reckoning by steps, and the error-state filter",
    "robots": "three robots: bursts picked out of noise by adaptive filters, a collision repaired, leap-frog",
}
"""Names of the studies and what they are about. Each has a module of its name with a `study` of its own."""

PARTS = {"robots": ("detection", "collision", "leapfrog")}
"""Studies of several parts, of which one is done at a time."""


PLANNED = ("robots", "leapfrog")
"""The study and part that has a planner."""


def begin(
    name: str, runs: int, seed: int, waveforms: int, part: str | None = None, wanted_m: float | None = None
) -> Work:
    """Set a study up; nothing is computed yet.

    Parameters
    ----------
    name : str
        A key of `STUDIES`.
    runs : int
        Of the simulation on the seed's numbers, 1 or more.
    seed : int
        Same seed, same numbers: run k is the same however many there are.
    waveforms : int
        Runs from waveforms through the receiver, 0 or more.
    part : str or None
        Of a study that has `PARTS`.
    wanted_m : float or None
        End error that the planner of `PLANNED` is asked for.

    Raises
    ------
    ValueError
        For another name or part, or counts out of reach.
    """
    if name not in STUDIES:
        raise ValueError(f"study {name}: there is none of that name; there are {', '.join(STUDIES)}")
    for what, value, least in (("runs", runs, 1), ("seed", seed, 0), ("waveforms", waveforms, 0)):
        if value < least:
            raise ValueError(f"{what} {value}: it must be {least} or more")
    parts = PARTS.get(name, ())
    if part not in (parts or (None,)):
        told = f"choose of {', '.join(parts)}" if parts else "it is of one piece: leave the part out"
        raise ValueError(f"study {name}, part {part}: there is none of that name; {told}")
    if wanted_m is not None and (name, part) != PLANNED:
        raise ValueError(f"wanted_m {wanted_m:g}: only study {PLANNED[0]}, part {PLANNED[1]} plans for an end error")
    if wanted_m is not None and not 0 < wanted_m < inf:
        raise ValueError(f"wanted_m {wanted_m:g}: the end error wanted must be above 0 m, and finite")
    study: Callable[..., Work] = import_module(f"sonofix.studies.{name.replace('-', '_')}").study
    if not parts:
        return study(runs, seed, waveforms)
    return study(runs, seed, waveforms, part, wanted_m)
