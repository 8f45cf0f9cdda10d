"""Reading a waveform's table between its samples: cubic (four-point Lagrange) interpolation in a Numba kernel.

At the table's 64 samples a chip its relative error stays below 1e-5 for anything inside the band.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, inline="always")
def read(table: NDArray[np.complex128], position: float) -> complex:
    """Value of ``table`` at a fractional index; 0 outside."""
    i = int(np.floor(position))
    if i < 1 or i > table.shape[0] - 3:
        return 0.0 + 0.0j
    x = position - i
    a, b, c, d = table[i - 1], table[i], table[i + 1], table[i + 2]
    return (
        -a * (x * (x - 1.0) * (x - 2.0) / 6.0)
        + b * ((x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0)
        - c * ((x + 1.0) * x * (x - 2.0) / 2.0)
        + d * ((x + 1.0) * x * (x - 1.0) / 6.0)
    )


@numba.njit(cache=True, inline="always")
def read_slope(table: NDArray[np.complex128], position: float) -> complex:
    """Derivative by the index of what `read` interpolates; 0 outside."""
    i = int(np.floor(position))
    if i < 1 or i > table.shape[0] - 3:
        return 0.0 + 0.0j
    x = position - i
    a, b, c, d = table[i - 1], table[i], table[i + 1], table[i + 2]
    return (
        -a * ((3.0 * x * x - 6.0 * x + 2.0) / 6.0)
        + b * ((3.0 * x * x - 4.0 * x - 1.0) / 2.0)
        - c * ((3.0 * x * x - 2.0 * x - 2.0) / 2.0)
        + d * ((3.0 * x * x - 1.0) / 6.0)
    )


@numba.njit(cache=True)
def sample(
    table: NDArray[np.complex128], rate_hz: float, start_s: float, tau: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Values of a table at burst times ``tau`` (n,), seconds; 0 outside the table."""
    out = np.empty(tau.shape[0], np.complex128)
    for n in range(tau.shape[0]):
        out[n] = read(table, (tau[n] - start_s) * rate_hz)
    return out
