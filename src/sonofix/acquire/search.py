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

TURNED = 0.2
"""Turns by which the outermost range rate of a warm search turns within one part of the replica: 0.6 dB."""

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
    return _peak(best, row, baseband, start_s, first, bank, band, known_s, noise, cells, false_alarm_rate)


def profile(
    stretch: NDArray[np.complexfloating], bank: Bank, count: int
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
    """Highest correlation power over velocities at each of ``count`` delays, its row, and a sample of all cells."""
    best = np.full(count, -1.0, np.float32)
    row = np.zeros(count, np.int64)
    some = np.empty((len(bank.range_rate_mps), (count - 1) // EVERY + 1), np.float32)
    for low, part in correlations(stretch, bank, count):
        _highest(part, low, best, row, some)
    return best, row, some


def correlations(
    stretch: NDArray[np.complexfloating], bank: Bank, count: int
) -> Iterator[tuple[int, NDArray[np.complex64]]]:
    """Correlate samples with a bank's replicas, ``ROWS_AT_ONCE`` at a time.

    Yields the first row of each part and the part (k, count): good until the next.
    """
    import scipy.fft

    length = bank.length(count)
    spectrum = np.asarray(scipy.fft.fft(stretch.astype(np.complex64), length))
    spectra = bank.spectra(length)
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
    """As `search`, for few delays and the range rates ``rates`` (low, high), m/s; noise is the power of all heard.

    The replica is cut into parts, each correlated once; range rates differ in how the parts are put together.
    """
    first, count = delays(baseband, start_s, bank, band, opens_s, closes_s)
    if count < 1:
        return None
    low = max(0, int(np.searchsorted(bank.range_rate_mps, rates[0])) - 1)
    high = max(low + 1, int(np.searchsorted(bank.range_rate_mps, rates[1])) + 1)
    high = min(high, len(bank.range_rate_mps))
    best, row = near(baseband, first, count, bank, low, high, band.rate_hz)
    stretch = baseband[first : first + count - 1 + bank.replicas.shape[1]]
    heard = stretch[stretch != 0]
    noise = band.whiteness * float(np.vdot(heard, heard).real) / max(len(heard), 1)
    cells = count * (high - low)
    return _peak(best, row, baseband, start_s, first, bank, band, known_s, noise, cells, false_alarm_rate)


def near(
    baseband: NDArray[np.complexfloating], first: int, count: int, bank: Bank, low: int, high: int, rate_hz: float
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Highest correlation power over the bank's rows low … high − 1 at delays first … first + count − 1, and its row.

    Within a decibel of the true ones.
    """
    length, middle = bank.replicas.shape[1], (low + high - 1) // 2
    beta = bank.range_rate_mps / bank.sound_speed_mps
    carrier_hz, half_s = bank.waveform.carrier_hz, bank.waveform.duration_s / 2
    farthest = float(np.max(np.abs(beta[low:high] - beta[middle])))
    parts = max(1, int(np.ceil(farthest * carrier_hz * length / rate_hz / TURNED)))
    # what another rate stretches the replica's ends by, in samples
    slip = int(np.ceil(farthest * max(bank.lead_s + half_s, length / rate_hz - bank.lead_s - half_s) * rate_hz))
    wanted = np.zeros(length + count - 1 + 2 * slip, np.complex64)
    begin, end = first - slip, first - slip + len(wanted)
    inside = baseband[max(0, begin) : end]
    wanted[max(0, -begin) : max(0, -begin) + len(inside)] = inside
    parted = _correlate_parts(_apart(bank.replicas[middle]), _apart(wanted), parts, count + 2 * slip)
    best = np.full(count, -1.0, np.float32)
    row = np.zeros(count, np.int64)
    centre = (bank.lead_s + half_s) * rate_hz
    _combine(parted, beta, low, high, middle, carrier_hz, rate_hz, centre, length, slip, best, row)
    return best, row


def mean_near(
    baseband: NDArray[np.complexfloating],
    start_s: float,
    bank: Bank,
    band: Band,
    begins_s: float,
    range_rate_mps: float,
    reach_s: float,
) -> float:
    """Mean correlation power of one emitter's replica within ±``reach_s`` of where a burst begins.

    That of noise is its power per sample; echoes of the same code, too faint to be told apart, have more.
    """
    first, count = delays(baseband, start_s, bank, band, begins_s - reach_s, begins_s + reach_s)
    row = int(np.argmin(np.abs(bank.range_rate_mps - range_rate_mps)))
    power, _ = near(baseband, first, max(count, 1), bank, row, row + 1, band.rate_hz)
    return float(np.mean(power))


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
    baseband: NDArray[np.complexfloating],
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
    # between rows an echo at another rate draws a summit aside; the fit finds it
    here, later = _summit(baseband, bank, first + column, int(row[column]))
    return Peak(
        start_s=start_s + (first + column + later) / band.rate_hz + bank.lead_s,
        range_rate_mps=float(bank.range_rate_mps[row[column]]),
        power=here if best[column] > 0 else 0.0,
        second=float(np.max(elsewhere, initial=0.0)),
        noise=max(noise, 1e-30),
        threshold=float(np.log(cells / false_alarm_rate)),
        worth_trying=float(np.log(cells)) + 1.0,
    )


def _apart(values: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Real and imaginary parts (2, n)."""
    return np.ascontiguousarray(values.view(np.float32).reshape(-1, 2).T)


def _summit(baseband: NDArray[np.complexfloating], bank: Bank, delay: int, row: int) -> tuple[float, float]:
    """Correlation power at a cell, and by how much of a delay, half at most, its summit comes later."""
    length = bank.replicas.shape[1]

    def height(n: int) -> float:
        heard = baseband[n : n + length]
        return float(abs(np.vdot(bank.replicas[row, : len(heard)], heard)))

    here = height(delay)
    return here**2, _vertex(height(delay - 1), here, height(delay + 1)) if delay > 0 else 0.0


def _vertex(before: float, here: float, after: float) -> float:
    """Where a parabola through three equidistant values peaks, from the middle one, half a step at most."""
    bend = 2 * here - before - after
    return float(np.clip(0.5 * (after - before) / bend, -0.5, 0.5)) if bend > 0 else 0.0


@numba.njit(cache=True, fastmath=True)
def _correlate_parts(replica, heard, parts: int, count: int) -> NDArray[np.float32]:
    """Correlation (parts, 2, count) of each part of a replica (2, n) with what is heard (2, n + count − 1).

    Real and imaginary parts apart, here and below: so the loops run eight samples at a time.
    """
    length = replica.shape[1]
    size = -(-length // parts)
    out = np.zeros((parts, 2, count), np.float32)
    for p in range(parts):
        for n in range(p * size, min((p + 1) * size, length)):
            re, im = replica[0, n], replica[1, n]
            for d in range(count):
                out[p, 0, d] += re * heard[0, n + d] + im * heard[1, n + d]
                out[p, 1, d] += re * heard[1, n + d] - im * heard[0, n + d]
    return out


@numba.njit(cache=True, inline="always")
def _turned_by(angle_rad: float) -> complex:
    return complex(np.cos(angle_rad), np.sin(angle_rad))


@numba.njit(cache=True, fastmath=True)
def _combine(parted, beta, low, high, middle, carrier_hz, rate_hz, centre, length, slip, best, row) -> None:
    """Put the parts' correlations together for each row: shifted by its stretch, turned by its Doppler shift."""
    parts, count = parted.shape[0], best.shape[0]
    size = -(-length // parts)
    total = np.empty((2, count), np.float32)
    for j in range(low, high):
        total[:] = 0.0
        off = beta[j] - beta[middle]
        u = (size - 1) / 2.0 - centre
        phase = _turned_by(2.0 * np.pi * carrier_hz / rate_hz * off * u)
        ahead = _turned_by(2.0 * np.pi * carrier_hz / rate_hz * off * size)
        sample = _turned_by(2.0 * np.pi * carrier_hz / rate_hz * beta[j])
        for p in range(parts):
            shift = min(max(int(np.rint(off * u)), -slip), slip)
            value = phase
            for _ in range(abs(shift)):
                value *= sample if shift > 0 else np.conj(sample)
            re, im = np.float32(value.real), np.float32(value.imag)
            for n in range(count):
                a, b = parted[p, 0, n + shift + slip], parted[p, 1, n + shift + slip]
                total[0, n] += re * a - im * b
                total[1, n] += re * b + im * a
            phase *= ahead
            u += size
        for n in range(count):
            power = total[0, n] ** 2 + total[1, n] ** 2
            if power > best[n]:
                best[n] = power
                row[n] = j


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
