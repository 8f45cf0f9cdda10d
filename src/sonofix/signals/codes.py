"""Code families: m-sequences of any primitive polynomial, Gold codes, the small Kasami set, and their correlations.

A code is an int8 array of chips 0 and 1. Its register is given in the convention of ``scipy.signal.max_len_seq``: taps
t₁, t₂, … of degree n mean the recurrence ``s[i + n] = s[i] ⊕ s[i + t₁] ⊕ s[i + t₂] ⊕ …``, hence the polynomial
``xⁿ + x^t₁ + x^t₂ + … + 1`` over GF(2), started from n ones. Correlations map chip 1 to +1 and chip 0 to −1.

Sources: S. W. Golomb, Shift Register Sequences (1967); R. Gold, IEEE Trans. Inf. Theory 13, 619 (1967); T. Kasami,
report R-285, University of Illinois (1966); D. V. Sarwate and M. B. Pursley, Proc. IEEE 68, 593 (1980), who give the
correlation values of all three.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Chips = NDArray[np.int8]

DEGREES = (2, 20)

#: Preferred pairs by degree (docs/codes.md prints the same table): every cross-correlation has Gold's three values.
GOLD_PAIRS: dict[int, tuple[tuple[int, ...], tuple[int, ...]]] = {
    3: ((1,), (2,)),
    5: ((2,), (2, 3, 4)),
    6: ((1,), (1, 2, 5)),
    7: ((3,), (1, 2, 3)),
    9: ((4,), (3, 4, 6)),
    10: ((3,), (2, 3, 8)),
    11: ((2,), (2, 5, 8)),
    13: ((1, 3, 4), (2, 8, 12)),
    14: ((1, 3, 5), (6, 8, 13)),
    15: ((1,), (1, 3, 12)),
}

#: The m-sequence of each small Kasami set (docs/codes.md prints the same table).
KASAMI_TAPS: dict[int, tuple[int, ...]] = {
    4: (1,),
    6: (1,),
    8: (2, 3, 4),
    10: (3,),
    12: (1, 4, 6),
    14: (1, 3, 5),
    16: (1, 3, 12),
}


def _degree_problem(degree: int) -> str | None:
    low, high = DEGREES
    if isinstance(degree, bool) or not isinstance(degree, (int, np.integer)) or not low <= degree <= high:
        return f"degree = {degree!r}; valid is a whole number from {low} to {high}"
    return None


def _prime_factors(number: int) -> tuple[int, ...]:
    """Return the distinct primes that divide ``number``, by trial division."""
    factors, candidate = [], 2
    while candidate * candidate <= number:
        if number % candidate == 0:
            factors.append(candidate)
            while number % candidate == 0:
                number //= candidate
        candidate += 1
    return tuple([*factors, number] if number > 1 else factors)


def _power_of_x(exponent: int, polynomials: NDArray[np.int64], degree: int) -> NDArray[np.int64]:
    """Return x to the ``exponent`` modulo each polynomial over GF(2), by squaring; bit i is the coefficient of xⁱ."""
    top = np.int64(1) << degree

    def squared(a: NDArray[np.int64]) -> NDArray[np.int64]:
        product = np.zeros_like(a)
        for bit in range(degree - 1, -1, -1):
            product <<= 1
            product ^= np.where(product & top, polynomials, 0)
            product ^= np.where((a >> bit) & 1, a, 0)
        return product

    result = np.ones_like(polynomials)
    for bit in bin(exponent)[2:]:
        result = squared(result)
        if bit == "1":
            result <<= 1
            result ^= np.where(result & top, polynomials, 0)
    return result


def _primitive(polynomials: NDArray[np.int64], degree: int) -> NDArray[np.int64]:
    """Keep those polynomials (xⁿ and 1 among their terms) modulo which x has the full order 2ⁿ − 1.

    That x^(2ⁿ−1) = 1 and x^((2ⁿ−1)/q) ≠ 1 for every prime q | 2ⁿ − 1 is necessary and sufficient: modulo a reducible
    polynomial of degree n no element has that order (Lidl and Niederreiter, Finite Fields, theorems 3.16 and 3.18).
    """
    order = 2**degree - 1
    kept = polynomials[_power_of_x(order, polynomials, degree) == 1]
    for prime in _prime_factors(order):
        kept = kept[_power_of_x(order // prime, kept, degree) != 1]
    return kept


def is_primitive(degree: int, taps: Iterable[int]) -> bool:
    """Say whether the register of ``degree`` with ``taps`` runs through all 2ⁿ − 1 states.

    Raises
    ------
    ValueError
        The degree is not 2 … 20, or a tap is not a whole number of 1 … degree − 1, or stands twice.
    """
    polynomial = 1 | (1 << degree) | sum(1 << t for t in _checked_taps(degree, taps))
    return _primitive(np.array([polynomial], dtype=np.int64), degree).size == 1


def _checked_taps(degree: int, taps: Iterable[int]) -> tuple[int, ...]:
    if problem := _degree_problem(degree):
        raise ValueError(problem)
    given = tuple(taps)
    whole = all(isinstance(t, (int, np.integer)) and not isinstance(t, bool) for t in given)
    if not given or not whole or min(given) < 1 or max(given) >= degree or len(set(given)) != len(given):
        raise ValueError(
            f"taps = {list(given)}; a register of degree {degree} needs different whole numbers from 1 to {degree - 1}"
        )
    return tuple(sorted(int(t) for t in given))


@lru_cache(maxsize=32)
def primitive_taps(degree: int) -> tuple[tuple[int, ...], ...]:
    """List the taps of all φ(2ⁿ − 1)/n primitive polynomials of a degree, fewest taps first, then in order.

    Parameters
    ----------
    degree : int
        2 … 20; kept once listed (degree 16 takes about 0.1 s, degree 20 about 2 s).

    Returns
    -------
    tuple of tuples of int
        Each ascending, as ``scipy.signal.max_len_seq`` and the site file take them.

    Raises
    ------
    ValueError
        The degree is out of range.
    """
    if problem := _degree_problem(degree):
        raise ValueError(problem)
    # A primitive polynomial has a constant term and, lest x + 1 divide it, an odd number of terms.
    middle = np.arange(1 << (degree - 1), dtype=np.int64)
    parity = middle.copy()
    for shift in (16, 8, 4, 2, 1):
        parity ^= parity >> shift
    polynomials = (middle[parity & 1 == 1] << 1) | 1 | (1 << degree)
    good = _primitive(polynomials, degree).tolist()
    sets = [tuple(t for t in range(1, degree) if polynomial >> t & 1) for polynomial in good]
    return tuple(sorted(sets, key=lambda taps: (len(taps), taps)))


def m_sequence(degree: int, taps: Iterable[int]) -> Chips:
    """Return one period of the m-sequence of a primitive polynomial, started from all ones.

    Parameters
    ----------
    degree : int
        n, 2 … 20.
    taps : iterable of int
        In the convention of this module and of ``scipy.signal.max_len_seq``, in any order.

    Returns
    -------
    int8, shape (2ⁿ − 1,)
        Chips 0 and 1; chip 0 is the first sent.

    Raises
    ------
    ValueError
        Degree or taps are out of range, or their polynomial is not primitive; the message names taps that are.
    """
    checked = _checked_taps(degree, taps)
    if not is_primitive(degree, checked):
        known = primitive_taps(degree)
        examples = ", ".join(str(list(t)) for t in known[:3])
        raise ValueError(
            f"taps = {list(checked)} of degree {degree} are not primitive: the sequence would repeat before"
            f" {2**degree - 1} chips; choose one of the {len(known)} sets of primitive_taps({degree}), as {examples}"
        )
    register, mask = (1 << degree) - 1, 1 | sum(1 << t for t in checked)
    chips = bytearray(2**degree - 1)
    for i in range(len(chips)):
        chips[i] = register & 1
        register = (register >> 1) | (((register & mask).bit_count() & 1) << (degree - 1))
    return np.frombuffer(chips, dtype=np.int8)


def gold_preferred_pair(degree: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the taps of the two m-sequences that make the Gold codes of a degree (the table of docs/codes.md).

    Raises
    ------
    ValueError
        The degree has no preferred pair (multiples of 4, and 2), or is beyond the table (3 … 15).
    """
    if degree not in GOLD_PAIRS:
        raise ValueError(
            f"degree = {degree!r} has no Gold codes here; valid is {', '.join(map(str, GOLD_PAIRS))}"
            " (multiples of 4 have no preferred pair: take a Kasami code there)"
        )
    return GOLD_PAIRS[degree]


def gold(degree: int, index: int) -> Chips:
    """Return a Gold code: of the preferred pair u, v the codes u, v, u ⊕ v, u ⊕ (v one chip later), ….

    The periodic correlation of any two, and of each with itself off its peak, takes the values −1, −t and t − 2 only,
    with t = 1 + 2^⌊(n + 2)/2⌋ (Gold 1967).

    Parameters
    ----------
    degree : int
        n, of `gold_preferred_pair`.
    index : int
        k, 0 … 2ⁿ: 0 and 1 give u and v, k ≥ 2 gives ``u[i] ⊕ v[i − (k − 2)]``, indices modulo 2ⁿ − 1.

    Returns
    -------
    int8, shape (2ⁿ − 1,)

    Raises
    ------
    ValueError
        The degree has no Gold codes, or the index is out of range.
    """
    first, second = gold_preferred_pair(degree)
    _check_index("Gold", degree, index, 2**degree + 1)
    if index == 0:
        return m_sequence(degree, first)
    v = m_sequence(degree, second)
    return v if index == 1 else m_sequence(degree, first) ^ np.roll(v, index - 2)


def kasami(degree: int, index: int) -> Chips:
    """Return a code of the small Kasami set: u, u ⊕ w, u ⊕ (w one chip later), ….

    w is u decimated by q = 2^(n/2) + 1, ``w[i] = u[q i]``, of period 2^(n/2) − 1. The periodic correlation of any two,
    and of each with itself off its peak, takes the values −1, −s and s − 2 only, with s = 2^(n/2) + 1 (Kasami 1966).

    Parameters
    ----------
    degree : int
        n, even, 4 … 16; the taps of u stand in ``KASAMI_TAPS`` and docs/codes.md.
    index : int
        k, 0 … 2^(n/2) − 1: 0 gives u, k ≥ 1 gives ``u[i] ⊕ w[i − (k − 1)]``.

    Returns
    -------
    int8, shape (2ⁿ − 1,)

    Raises
    ------
    ValueError
        The degree has no Kasami set here, or the index is out of range.
    """
    if degree not in KASAMI_TAPS:
        raise ValueError(
            f"degree = {degree!r} has no Kasami codes here; valid is {', '.join(map(str, KASAMI_TAPS))}"
            " (odd degrees have none: take a Gold code there)"
        )
    _check_index("Kasami", degree, index, 2 ** (degree // 2))
    u = m_sequence(degree, KASAMI_TAPS[degree])
    if index == 0:
        return u
    w = u[(2 ** (degree // 2) + 1) * np.arange(u.size) % u.size]
    return u ^ np.roll(w, index - 1)


def _check_index(family: str, degree: int, index: int, count: int) -> None:
    if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or not 0 <= index < count:
        raise ValueError(f"index = {index!r}; the {family} codes of degree {degree} are numbered 0 to {count - 1}")


def _bipolar(name: str, chips: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(chips)
    if array.ndim != 1 or array.size == 0 or not np.isin(array, (0, 1)).all():
        raise ValueError(f"{name} must be a row of chips 0 and 1; it has shape {array.shape}")
    return 2.0 * array - 1.0


def periodic_correlation(a: ArrayLike, b: ArrayLike) -> NDArray[np.int64]:
    """Correlate two codes that repeat without end, chip 1 as +1 and chip 0 as −1.

    Parameters
    ----------
    a, b : 0/1, shape (n,)

    Returns
    -------
    int64, shape (n,)
        ``R[k] = Σ_i A[i] B[i + k mod n]``: peaks at k where b is a delayed by k chips.

    Raises
    ------
    ValueError
        Something other than chips 0 and 1 is given, or the lengths differ.
    """
    x, y = _bipolar("a", a), _bipolar("b", b)
    if x.size != y.size:
        raise ValueError(f"codes of {x.size} and {y.size} chips; a periodic correlation needs equal lengths")
    spectrum = np.fft.rfft(x).conj() * np.fft.rfft(y)
    return np.rint(np.fft.irfft(spectrum, x.size)).astype(np.int64)


def aperiodic_correlation(a: ArrayLike, b: ArrayLike) -> NDArray[np.int64]:
    """Correlate two codes that sound once, chip 1 as +1, chip 0 as −1 and silence around them.

    Parameters
    ----------
    a : 0/1, shape (n,)
    b : 0/1, shape (m,)

    Returns
    -------
    int64, shape (n + m − 1,)
        Entry j is ``C[k] = Σ_i A[i] B[i + k]`` at the delay ``k = j − (n − 1)`` of b against a.

    Raises
    ------
    ValueError
        Something other than chips 0 and 1 is given.
    """
    x, y = _bipolar("a", a), _bipolar("b", b)
    length = x.size + y.size - 1
    # Correlation is convolution with the reversed code; padding to a power of two keeps prime lengths fast.
    size = 1 << (length - 1).bit_length()
    product = np.fft.rfft(x[::-1], size) * np.fft.rfft(y, size)
    return np.rint(np.fft.irfft(product, size)[:length]).astype(np.int64)
