"""Coded bursts of a fellow robot under a steady tone on the very carrier: the tables of docs/statistics.md.

Target asserted: under a tone 20 dB louder than a burst of 0 dB and more, one in a thousand is missed and one
in a thousand trials reports what is not there, at most, by the upper 95 % bound of a binomial count.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np
import pytest

from sonofix.studies import robots_bursts as bursts

pytestmark = pytest.mark.prove

TRIALS, BATCHES = 5000, 50
TARGET = 1e-3
TONE_DB = 20.0


def batch(number: int, snr_db: float) -> tuple[float, float]:
    """Count misses and false alarms of one batch."""
    missed, alarmed = bursts.decided(bursts.bench(snr_db), number, 11, TRIALS // BATCHES, TONE_DB)
    return float(missed.sum()), float(alarmed.sum())


def test_table_of_coded_bursts_under_a_tone() -> None:
    rows = []
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for snr_db in (0.0, 6.0):
            counts = np.array(list(pool.map(partial(batch, snr_db=snr_db), range(BATCHES)))).sum(axis=0)
            rows.append((snr_db, *((int(n), bursts.at_most(int(n), TRIALS)) for n in counts)))
    print(
        f"\nCoded bursts of 255 chips under a tone on the carrier, {TONE_DB:g} dB louder: {TRIALS} trials a row, each "
        "with a burst and again without; bounds of 95 %, where none at all would give 0.06 %\n"
    )
    print("| SNR in 4 kHz | missed | missed, at most | false alarms | false alarms, at most |\n|---|---|---|---|---|")
    for snr_db, (missed, miss_most), (alarms, alarm_most) in rows:
        print(f"| {snr_db:g} dB | {missed} | {miss_most:.3%} | {alarms} | {alarm_most:.3%} |")
    for _, (_, miss_most), (_, alarm_most) in rows:
        assert alarm_most <= TARGET
        assert miss_most <= TARGET
