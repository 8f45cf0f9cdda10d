"""Delay × velocity search by FFT, and detection at a stated false-alarm rate.

Cold: the whole plane, a row a velocity. Warm: few rows and delays round a prediction.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.bank import Bank
from sonofix.acquire.baseband import Band

ROWS_AT_ONCE = 16
"""Velocities transformed in one go: what stays in the cache."""

SHORT_SEARCH = 256
"""Delays that a warm search spans at most, mostly."""

EVERY = 23
"""One delay in so many tells the noise of a cold search."""

REMAINDER = 0.4
"""Of the shortest time a burst resolves: this close to a known path nothing else can be told from it."""


@dataclass(frozen=True, slots=True, eq=False)
class Peak:
    """The highest cell of one emitter's search.

    ``start_s`` is when the burst's first chip is heard, recorder's clock; ``power`` the correlation power against the
    unit-energy replica; ``second`` the highest one elsewhere in the search; ``noise`` the mean that noise has there;
    ``threshold`` what ``power / noise`` must exceed once nothing else disturbs. Peaks above ``worth_trying``, which
    noise alone reaches in one search of three, are tried: a true burst may not stand out until others are taken away.
    """

    start_s: float
    range_rate_mps: float
    power: float
    second: float
    noise: float
    threshold: float
    worth_trying: float


def search(
    baseband: NDArray[np.complexfloating],
    start_s: float,
    bank: Bank,
    band: Band,
    opens_s: float,
    closes_s: float,
    known_s: list[float],
    false_alarm_rate: float,
) -> Peak | None:
    """Find the highest correlation of one emitter's burst starting within [opens_s, closes_s], at any velocity.

    The search of the first seed, eqs 4–6, with its window stretched and its mean removed.

    Parameters
    ----------
    baseband : complex128 (n,)
        First sample at ``start_s``.
    known_s : list of float
        Starts of paths already found; what stands within ``REMAINDER`` of what a burst resolves is theirs.
    false_alarm_rate : float
        Probability that noise alone gives a detection in this search. Correlation power of noise is exponential, its
        mean is the median over ln 2, and the cells searched count as independent (they are fewer: conservative).

    Returns
    -------
    Peak or None
        None where no sample of the interval lies within the base band.
    """
    first, count = delays(baseband, start_s, bank, band, opens_s, closes_s)
    if count < 2:
        return None
    best, row, some = profile(baseband[first : first + count - 1 + bank.replicas.shape[1]], bank, count)
    noise = float(np.median(some)) / np.log(2.0)
    cells = count * len(bank.replicas)
    return _peak(best, row, start_s, first, bank, band, known_s, noise, cells, false_alarm_rate)


def profile(
    stretch: NDArray[np.complexfloating], bank: Bank, count: int, rows: slice = slice(None)
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
    """Highest correlation power over velocities at each of ``count`` delays, its row, and a sample of all cells."""
    best = np.full(count, -1.0, np.float32)
    row = np.zeros(count, np.int64)
    some = np.empty((len(bank.range_rate_mps[rows]), (count - 1) // EVERY + 1), np.float32)
    for low, part in correlations(stretch, bank, count, rows):
        _highest(part, low, best, row, some)
    return best, row, some


def correlations(
    stretch: NDArray[np.complexfloating], bank: Bank, count: int, rows: slice = slice(None)
) -> Iterator[tuple[int, NDArray[np.complex64]]]:
    """Correlate samples with a bank's replicas (or some rows of it), ``ROWS_AT_ONCE`` at a time.

    Yields the first row of each part, counted from the first asked for, and the part (k, count): good until the next.
    """
    import scipy.fft

    # short searches share one length, so that their spectra are computed once
    length = bank.length(max(count, SHORT_SEARCH))
    spectrum = np.asarray(scipy.fft.fft(stretch.astype(np.complex64), length))
    spectra = bank.spectra(length)[rows]
    work = np.empty((ROWS_AT_ONCE, length), np.complex64)  # one that stays in the cache
    for low in range(0, len(spectra), ROWS_AT_ONCE):
        part = spectra[low : low + ROWS_AT_ONCE]
        product = np.multiply(part, spectrum, out=work[: len(part)])
        yield low, np.asarray(scipy.fft.ifft(product, axis=-1, overwrite_x=True), np.complex64)[:, :count]


def search_near(
    baseband: NDArray[np.complexfloating],
    start_s: float,
    bank: Bank,
    band: Band,
    opens_s: float,
    closes_s: float,
    rates: tuple[float, float],
    known_s: list[float],
    false_alarm_rate: float,
) -> Peak | None:
    """As `search`, for few delays and the range rates ``rates`` (low, high), m/s; noise is the power of all heard."""
    first, count = delays(baseband, start_s, bank, band, opens_s, closes_s)
    if count < 1:
        return None
    low = max(0, int(np.searchsorted(bank.range_rate_mps, rates[0])) - 1)
    high = max(low + 1, int(np.searchsorted(bank.range_rate_mps, rates[1])) + 1)
    stretch = baseband[first : first + count - 1 + bank.replicas.shape[1]]
    best, row, _ = profile(stretch, bank, count, slice(low, high))
    row += low
    heard = stretch[stretch != 0]
    noise = band.whiteness * float(np.vdot(heard, heard).real) / max(len(heard), 1)
    return _peak(best, row, start_s, first, bank, band, known_s, noise, count * (high - low), false_alarm_rate)


def delays(
    baseband: NDArray[np.complexfloating], start_s: float, bank: Bank, band: Band, opens_s: float, closes_s: float
) -> tuple[int, int]:
    """First sample at which a replica may begin, and how many there are; at most 0 where the base band ends before."""
    first = max(0, int(np.floor((opens_s - bank.lead_s - start_s) * band.rate_hz)))
    last = min(len(baseband) - 1, int(np.ceil((closes_s - bank.lead_s - start_s) * band.rate_hz)))
    return first, last - first + 1


def _peak(
    best: NDArray[np.float32],
    row: NDArray[np.int64],
    start_s: float,
    first: int,
    bank: Bank,
    band: Band,
    known_s: list[float],
    noise: float,
    cells: int,
    false_alarm_rate: float,
) -> Peak:
    half = int(np.ceil(band.rate_hz / band.half_width_hz))
    close = int(np.ceil(REMAINDER * band.rate_hz / band.half_width_hz))
    for known in known_s:
        at = round((known - bank.lead_s - start_s) * band.rate_hz) - first
        best[max(0, at - close) : max(0, at + close + 1)] = 0.0
    column = int(np.argmax(best))
    elsewhere = np.concatenate([best[: max(0, column - half)], best[column + half + 1 :]])
    return Peak(
        start_s=start_s + (first + column) / band.rate_hz + bank.lead_s,
        range_rate_mps=float(bank.range_rate_mps[row[column]]),
        power=float(best[column]),
        second=float(np.max(elsewhere, initial=0.0)),
        noise=max(noise, 1e-30),
        threshold=float(np.log(cells / false_alarm_rate)),
        worth_trying=float(np.log(cells)) + 1.0,
    )


@numba.njit(cache=True)
def _highest(
    surface: NDArray[np.complex64],
    low: int,
    best: NDArray[np.float32],
    row: NDArray[np.int64],
    some: NDArray[np.float32],
) -> None:
    """Keep the highest power of each delay and its row, and every so many cells."""
    for i in range(surface.shape[0]):
        for n in range(best.shape[0]):
            power = surface[i, n].real ** 2 + surface[i, n].imag ** 2
            if power > best[n]:
                best[n] = power
                row[n] = low + i
        for k in range(some.shape[1]):
            value = surface[i, k * EVERY]
            some[low + i, k] = value.real**2 + value.imag**2
