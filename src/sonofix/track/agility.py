"""How agile vehicles are, learnt where ranges are stated by others and nothing else tells of the motion.

Corrections of velocity that follow each other agree in direction where motion is taken as too calm, and oppose each
other where it is taken as too free (Mehra 1970: innovations of an optimal filter are white).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonofix.records import Floats
from sonofix.track.belief import Belief, Motion

RATE = 0.1
"""How fast the density of acceleration follows, per epoch."""

LIMITS = (1e-3, 2.0)
"""Least and most that it may become, in m²/s³."""


class Agility:
    """Remembers the latest correction of velocities."""

    def __init__(self) -> None:
        self._last: Floats | None = None

    def take(self, before: Belief, after: Belief, motion: Motion) -> Motion:
        """Return the motion to go on with, as an epoch has corrected a belief."""
        inputs = before.inputs
        if before.trust is None or before.trust.sizes is not None:
            return motion
        if inputs is None or len(inputs.time_s) or not before.placed.any():
            return motion
        now = (after.pose() - before.pose())[before.placed, 4:6].ravel()
        last, self._last = self._last, now
        size = float(np.linalg.norm(now))
        if last is None or last.shape != now.shape or size * float(np.linalg.norm(last)) == 0.0:
            return motion
        agree = float(now @ last) / (size * float(np.linalg.norm(last)))
        psd = motion.acceleration_psd * float(np.exp(RATE * agree))
        return replace(motion, acceleration_psd=float(np.clip(psd, *LIMITS)))
