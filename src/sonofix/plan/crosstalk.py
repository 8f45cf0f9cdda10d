"""How loud one beacon's burst is in the search for another's: worst over delays and over differences of range rate.

A receiver that looks for beacon j correlates the samples with j's signature, stretched to a range rate
(docs/receiver.md). What beacon i then contributes is

    X_ij(τ, δ) = Σ_t a_i(t + τ; δ) s_j(t)*,   a_i(t; δ) = a_i(T/2 + (1 − δ/c) u) exp(−2πi f_c (δ/c) u),   u = t − T/2,

with i's envelope a_i, j's signature s_j, τ how much later than i's burst the search looks, and δ how much larger i's
range rate is than the one it looks at. That is a cross-ambiguity function (Woodward 1953; Rihaczek 1969, chapter 5)
with the stretch of the envelope kept. A level is |X_ij| over the peak |X_jj(0, 0)| that j itself makes when it is just
as loud.

Bursts are sounded once, so the sums are aperiodic; they are computed by FFT, on spectra padded against wrap-around.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sonofix.records import Floats, Waveform
from sonofix.signals.interpolate import sample

Spectra = NDArray[np.complex64]
OnDone = Callable[[float], None]

BLOCK = 1 << 18
"""Complex values multiplied and transformed in one go: 2 MB, which a cache holds."""


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """What is looked at: delays within ±``span_s``, and differences of range rate.

    Attributes
    ----------
    span_s : float
        Largest difference of two bursts' delays.
    difference_mps : float64 (m,)
        Ascending, symmetric about 0; the even ones alone (0 is one of them) make the coarse grid.
    rate_hz : float
        Of the samples: eight for each hertz of half width that holds 95 % of the signatures' energy. The
        coarse grid reads delays at half this rate, the fine one at twice.
    sound_speed_mps : float
    """

    span_s: float
    difference_mps: Floats
    rate_hz: float
    sound_speed_mps: float


def make_grid(waveforms: Sequence[Waveform], reach_m: float, max_difference_mps: float, sound_speed_mps: float) -> Grid:
    """Lay the grid for a set of bursts.

    The correlation falls with the difference of rate as sinc(f_c T δ/c); the fine grid's steps are a quarter of
    c/(f_c T) at most (0.2 dB lost half a step away, at worst), the coarse grid's half of it (0.9 dB).

    Parameters
    ----------
    waveforms : sequence of Waveform
    reach_m : float
        Bursts are heard from 0 to this far, so their delays differ by ± as much over the speed of sound; infinite: a
        burst may come at any time against another.
    max_difference_mps : float
        Largest difference of two range rates: twice a vehicle's speed, for it may near one beacon and leave another.
    sound_speed_mps : float

    Raises
    ------
    ValueError
        There is no burst, the reach is not above 0, or the difference is not from 0 to a tenth of the speed of sound.
    """
    if not waveforms:
        raise ValueError("waveforms is empty; there is no cross-talk without a burst")
    if not reach_m > 0:
        raise ValueError(f"reach_m = {reach_m:g}; it must be above 0, in m")
    if not 0 <= max_difference_mps <= sound_speed_mps / 10:
        raise ValueError(
            f"max_difference_mps = {max_difference_mps:g}; it must be from 0 to {sound_speed_mps / 10:.3g}, a tenth of"
            " the speed of sound"
        )
    step_mps = min(sound_speed_mps / (w.carrier_hz * w.duration_s) for w in waveforms) / 4
    half = 2 * int(np.ceil(max_difference_mps / step_mps / 2))
    difference_mps = np.linspace(-max_difference_mps, max_difference_mps, 2 * half + 1)
    longest_s = max(len(w.envelope) / w.rate_hz for w in waveforms)
    span_s = min(reach_m / sound_speed_mps, longest_s)
    return Grid(span_s, difference_mps, 8.0 * max(map(_half_width_hz, waveforms)), sound_speed_mps)


def _half_width_hz(waveform: Waveform) -> float:
    """Distance from the carrier within which 95 % of the signature's energy lies."""
    power = np.abs(np.fft.fft(waveform.signature)) ** 2
    offset_hz = np.abs(np.fft.fftfreq(len(power), 1.0 / waveform.rate_hz))
    order = np.argsort(offset_hz)
    energy = np.cumsum(power[order])
    return float(offset_hz[order][np.searchsorted(energy, 0.95 * energy[-1])])


class Bench:
    """Bursts laid out to be compared: sampled, transformed, their own peaks and main lobes known.

    Parameters
    ----------
    waveforms : sequence of Waveform
        All on one carrier (what is apart in frequency does not disturb).
    grid : Grid
    """

    def __init__(self, waveforms: Sequence[Waveform], grid: Grid) -> None:
        import scipy.fft

        self.grid = grid
        self._waveforms = tuple(waveforms)
        self._first_s = min(w.start_s for w in waveforms)
        self._duration_s: Floats = np.array([w.duration_s for w in waveforms])
        # a stretched burst moves on both ends, by less than a tenth of its length
        slack_s = 0.6 * max(abs(grid.difference_mps)) / grid.sound_speed_mps * max(w.duration_s for w in waveforms)
        self._first_s -= slack_s
        end_s = max(w.start_s + len(w.envelope) / w.rate_hz for w in waveforms) + slack_s
        self._count = int(np.ceil((end_s - self._first_s) * grid.rate_hz)) + 1
        self._length = _fast_length(self._count + grid.span_s * grid.rate_hz + 2)
        time_s = self._time_s()
        listened = [sample(w.signature, w.rate_hz, w.start_s, time_s) for w in waveforms]
        self._signatures: Spectra = np.conj(_spectra(listened, self._length))
        own = _resized(self._at(0.0, range(len(self))) * self._signatures, 2 * self._length)
        correlation = np.abs(np.asarray(scipy.fft.ifft(own, axis=-1))) * 2
        self._peak: Floats = correlation[:, 0].astype(float)
        self._lobe_s: Floats = np.array([_first_rise(row) for row in correlation]) / (2 * grid.rate_hz)

    def __len__(self) -> int:
        """Count of bursts."""
        return len(self._waveforms)

    def levels(self, pairs: ArrayLike, coarse: bool = False, on_done: OnDone | None = None) -> Floats:
        """Worst level of burst i in the search for burst j, for each pair (i, j).

        For i = j that is the worst own side lobe: what lies beyond the main lobe. That ends at the first minimum of the
        burst's autocorrelation, and a stretched burst's as much later as its ends have slipped.

        Parameters
        ----------
        pairs : int (k, 2)
            Sent, listened for.
        coarse : bool
            On the coarse grid: some eight times faster, and up to 1.5 dB too low, 0.5 dB on average.
        on_done : callable, optional
            Told the share that is done, 0 … 1.

        Returns
        -------
        float64 (k,)
            Of the amplitude; 1 is the peak of the burst listened for.
        """
        import scipy.fft

        index = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        length = _fast_length((0.5 if coarse else 2.0) * self._length)
        rate_hz = self.grid.rate_hz * length / self._length
        last = min(int(self.grid.span_s * rate_hz), length // 2)
        differences = self.grid.difference_mps[:: 2 if coarse else 1]
        sent, row = np.unique(index[:, 0], return_inverse=True)
        signatures = _resized(self._signatures, length)
        own = index[:, 0] == index[:, 1]
        worst = np.zeros(len(index), np.float32)
        chunk = max(1, BLOCK // length)
        work = np.empty((min(chunk, len(index)), length), np.complex64)
        for n, difference_mps in enumerate(differences):
            spectra = _resized(self._at(float(difference_mps), sent.tolist()), length)
            slip_s = abs(difference_mps) / self.grid.sound_speed_mps * self._duration_s / 2
            lobe = np.floor((self._lobe_s + slip_s) * rate_hz).astype(np.int64)
            skip = np.where(own, lobe[index[:, 0]], -1)
            for start in range(0, len(index), chunk):
                part = slice(start, start + chunk)
                products = multiplied(spectra, row[part], signatures, index[part, 1], work)
                correlation = np.asarray(scipy.fft.ifft(products, axis=-1, overwrite_x=True))
                np.maximum(worst[part], highest_power(correlation, last, skip[part]), out=worst[part])
            if on_done is not None:
                on_done((n + 1) / len(differences))
        return np.sqrt(worst.astype(float)) * (length / self._length) / self._peak[index[:, 1]]

    def surface(self, sent: int, listened: int) -> tuple[Floats, Floats, Floats]:
        """Level of one burst in the search for another, at every delay and difference of the fine grid.

        Returns
        -------
        level : float32 (m, n)
            Of the amplitude, as in `levels`; all of it for a burst with itself, main lobe included.
        difference_mps : float64 (m,)
        delay_s : float64 (n,)
            How much later than the burst sent the search looks, ascending.
        """
        import scipy.fft

        length = _fast_length(2.0 * self._length)
        rate_hz = self.grid.rate_hz * length / self._length
        last = min(int(self.grid.span_s * rate_hz), length // 2)
        lag = np.arange(-last, last + 1)
        signature = _resized(self._signatures[listened : listened + 1], length)
        scale = np.float32((length / self._length) / self._peak[listened])
        rows = [
            np.abs(np.asarray(scipy.fft.ifft(_resized(self._at(float(d), [sent]), length) * signature))[0, lag]) * scale
            for d in self.grid.difference_mps
        ]
        return np.array(rows), self.grid.difference_mps, lag / rate_hz

    def _time_s(self) -> NDArray[np.float64]:
        return self._first_s + np.arange(self._count) / self.grid.rate_hz

    def _at(self, rate_mps: float, which: Sequence[int]) -> Spectra:
        """Spectra of envelopes heard at a range rate, each stretched about its burst's middle."""
        beta, time_s = rate_mps / self.grid.sound_speed_mps, self._time_s()
        turning: dict[tuple[float, float], NDArray[np.complex128]] = {}
        rows = []
        for i in which:
            w = self._waveforms[i]
            u = time_s - w.duration_s / 2
            phase = turning.get((w.carrier_hz, w.duration_s))
            if phase is None:
                phase = turning[w.carrier_hz, w.duration_s] = np.exp(-2j * np.pi * w.carrier_hz * beta * u)
            rows.append(sample(w.envelope, w.rate_hz, w.start_s, w.duration_s / 2 + (1.0 - beta) * u) * phase)
        return _spectra(rows, self._length)


def _fast_length(least: float) -> int:
    import scipy.fft

    return int(scipy.fft.next_fast_len(int(np.ceil(least))))  # pyright: ignore[reportArgumentType]


def level_db(level: ArrayLike) -> Floats:
    """Amplitude ratios in dB, at least −200."""
    return 20.0 * np.log10(np.maximum(np.asarray(level, dtype=float), 1e-10))


def _spectra(rows: Sequence[NDArray[np.complex128]], length: int) -> Spectra:
    import scipy.fft

    return np.asarray(scipy.fft.fft(np.array(rows, dtype=np.complex64), length, axis=-1))


def _resized(spectra: Spectra, length: int) -> Spectra:
    """Spectra with zeros put in at, or values cut from, their highest frequencies: the same signals, read otherwise."""
    now = spectra.shape[1]
    if length == now:
        return spectra
    half = (min(now, length) - 1) // 2
    out = np.zeros((spectra.shape[0], length), np.complex64)
    out[:, : half + 1] = spectra[:, : half + 1]
    out[:, length - half :] = spectra[:, now - half :]
    return out


@numba.njit(cache=True)
def multiplied(
    left: Spectra, left_row: NDArray[np.int64], right: Spectra, right_row: NDArray[np.int64], out: Spectra
) -> Spectra:
    """Products (k, n) of k pairs of rows, written to the first k rows of ``out``."""
    for k in range(left_row.shape[0]):
        a, b, c = left[left_row[k]], right[right_row[k]], out[k]
        for n in range(c.shape[0]):
            c[n] = a[n] * b[n]
    return out[: left_row.shape[0]]


@numba.njit(cache=True, fastmath=True)
def highest_power(correlation: Spectra, last: int, skip: NDArray[np.int64]) -> NDArray[np.float32]:
    """Largest |·|² of each row (k, n) of circular correlations at lags of −``last`` … ``last``.

    Lags of at most ``skip`` (k,) in magnitude are left out; −1 leaves out none.
    """
    out = np.zeros(correlation.shape[0], np.float32)
    size = correlation.shape[1]
    for k in range(correlation.shape[0]):
        row, first = correlation[k], skip[k] + 1
        best = np.float32(0.0)
        for n in range(first, last + 1):
            best = max(best, row[n].real * row[n].real + row[n].imag * row[n].imag)
        for n in range(size - last, size - max(first, 1) + 1):
            best = max(best, row[n].real * row[n].real + row[n].imag * row[n].imag)
        out[k] = best
    return out


def _first_rise(correlation: NDArray[np.floating]) -> int:
    """Index of the first minimum beside the peak at index 0."""
    rising = np.flatnonzero(np.diff(correlation[: len(correlation) // 2]) > 0)
    return int(rising[0]) if len(rising) else 0
