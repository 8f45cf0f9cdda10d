"""How far measurements lay from what a track expected of them: what it says of its errors, told without a truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtr

from sonofix.records import Floats

WITHIN = 0.95
"""The band that corrections are held against leaves out as many below it as above."""


@dataclass(frozen=True, slots=True)
class InnovationFigures:
    """Figures of the innovations of a track's corrections (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).

    ``nis_per_row`` is the normalised innovation squared over how many measurements entered: 1 where all covariances
    are right. ``inside_95`` is the share of corrections whose own lies in the band that holds 95 % of them where they
    are: below it where deviations are stated too large, above it where too small (``below`` and ``above``).
    """

    corrections: int
    rows: int
    nis_per_row: float
    inside_95: float
    below: float
    above: float


def score_innovations(rows: Floats, nis: Floats) -> InnovationFigures | None:
    """Score normalised innovations squared (n,) of so many ``rows`` each (n,); None where there are none."""
    told = (rows > 0) & np.isfinite(nis)
    if not told.any():
        return None
    rows, nis = rows[told], nis[told]
    share = chdtr(rows, nis)
    below, above = float(np.mean(share < (1 - WITHIN) / 2)), float(np.mean(share > (1 + WITHIN) / 2))
    return InnovationFigures(
        corrections=len(rows),
        rows=int(rows.sum()),
        nis_per_row=float(nis.sum() / rows.sum()),
        inside_95=1.0 - below - above,
        below=below,
        above=above,
    )
