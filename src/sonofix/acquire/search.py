"""Delay × velocity search by FFT, and detection at a stated false-alarm rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.bank import Bank
from sonofix.acquire.baseband import Band

SHORT_SEARCH = 256
"""Delays that a warm search spans at most, mostly."""


@dataclass(frozen=True, slots=True, eq=False)
class Peak:
    """The highest cell of one emitter's search.

    ``start_s`` is when the burst's first chip is heard, recorder's clock; ``power`` the correlation power against the
    unit-energy replica; ``noise`` that of noise in the same search (mean, from its median); ``threshold`` what
    ``power / noise`` must exceed once nothing else disturbs. Peaks above ``worth_trying``, which noise alone reaches in
    one search of three, are tried: in echoes a true burst may not stand out until others are taken away.
    """

    start_s: float
    range_rate_mps: float
    power: float
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
    rates: tuple[float, float] | None,
    known_s: list[float],
    false_alarm_rate: float,
) -> Peak | None:
    """Find the highest correlation of one emitter's burst starting within [opens_s, closes_s].

    The search of the first seed, eqs 4–6, with its window stretched and its mean removed.

    Parameters
    ----------
    baseband : complex128 (n,)
        First sample at ``start_s``.
    rates : (low, high) in m/s or None
        Only range rates within; None: the whole bank.
    known_s : list of float
        Starts of paths already found; what stands within a correlation peak of them is their remainder.
    false_alarm_rate : float
        Probability that noise alone gives a detection in this search. Correlation power of noise is exponential, its
        mean is the median over ln 2, and the cells searched count as independent (they are fewer: conservative).

    Returns
    -------
    Peak or None
        None where no sample of the interval lies within the base band.
    """
    import scipy.fft

    first = max(0, int(np.floor((opens_s - bank.lead_s - start_s) * band.rate_hz)))
    last = min(len(baseband) - 1, int(np.ceil((closes_s - bank.lead_s - start_s) * band.rate_hz)))
    if last <= first:
        return None
    rows = slice(None)
    if rates is not None:
        low = max(0, int(np.searchsorted(bank.range_rate_mps, rates[0])) - 1)
        high = int(np.searchsorted(bank.range_rate_mps, rates[1])) + 1
        rows = slice(low, max(high, low + 1))
    count = last - first + 1
    stretch = baseband[first : last + bank.replicas.shape[1]].astype(np.complex64)
    # short searches share one length, so that their spectra are computed once
    length = int(scipy.fft.next_fast_len(bank.replicas.shape[1] + max(count, SHORT_SEARCH)) or 0)
    spectrum = np.asarray(scipy.fft.fft(stretch, length))
    surface: NDArray[np.complex64] = np.asarray(
        scipy.fft.ifft(spectrum * bank.spectra(length, rows), axis=-1, overwrite_x=True)
    )[:, :count]
    power = surface.real**2 + surface.imag**2
    noise = float(np.median(power)) / np.log(2.0)
    half = int(np.ceil(band.rate_hz / band.half_width_hz))
    for known in known_s:
        at = round((known - bank.lead_s - start_s) * band.rate_hz) - first
        power[:, max(0, at - half) : max(0, at + half + 1)] = 0.0
    row, column = np.unravel_index(int(np.argmax(power)), power.shape)
    threshold = float(np.log(power.size / false_alarm_rate))
    return Peak(
        start_s=start_s + (first + column) / band.rate_hz + bank.lead_s,
        range_rate_mps=float(bank.range_rate_mps[rows][row]),
        power=float(power[row, column]),
        noise=max(noise, 1e-30),
        threshold=threshold,
        worth_trying=float(np.log(power.size)) + 1.0,
    )
