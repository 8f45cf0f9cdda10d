"""Laws that every code obeys, whatever its polynomial (Golomb's postulates) and shift."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sonofix.signals.codes import (
    GOLD_PAIRS,
    KASAMI_TAPS,
    aperiodic_correlation,
    gold,
    is_primitive,
    kasami,
    m_sequence,
    periodic_correlation,
    primitive_taps,
)

Register = tuple[int, tuple[int, ...]]


@st.composite
def registers(draw: st.DrawFn, largest: int = 11) -> Register:
    degree = draw(st.integers(2, largest))
    return degree, draw(st.sampled_from(primitive_taps(degree)))


chips = st.lists(st.integers(0, 1), min_size=1, max_size=80)


@given(registers())
def test_autocorrelation_has_two_values(register: Register) -> None:
    code = m_sequence(*register)
    row = periodic_correlation(code, code)
    assert row[0] == code.size
    assert (row[1:] == -1).all()


@given(registers())
def test_one_more_one_than_zeros(register: Register) -> None:
    assert m_sequence(*register).sum() == 2 ** (register[0] - 1)


@given(registers())
def test_every_window_of_a_degree_occurs_once_but_zero(register: Register) -> None:
    degree, taps = register
    code = m_sequence(degree, taps).astype(np.int64)
    windows = sum(np.roll(code, -i) << i for i in range(degree))
    assert sorted(np.asarray(windows).tolist()) == list(range(1, 2**degree))


@given(registers(), st.data())
def test_product_with_its_own_shift_is_another_shift(register: Register, data: st.DataObject) -> None:
    code = m_sequence(*register)
    shift = data.draw(st.integers(1, code.size - 1))
    product = code ^ np.roll(code, shift)
    assert periodic_correlation(code, product).max() == code.size


@given(registers())
def test_the_mirrored_polynomial_runs_backwards(register: Register) -> None:
    degree, taps = register
    mirrored = tuple(degree - t for t in taps)
    assert is_primitive(degree, mirrored)
    backwards = m_sequence(degree, taps)[::-1]
    assert periodic_correlation(m_sequence(degree, mirrored), backwards).max() == backwards.size


@given(st.sampled_from(sorted(n for n in GOLD_PAIRS if n <= 11)), st.data())
def test_gold_codes_keep_to_their_bound(degree: int, data: st.DataObject) -> None:
    a, b = (data.draw(st.integers(0, 2**degree)) for _ in range(2))
    row = periodic_correlation(gold(degree, a), gold(degree, b))
    t = 1 + 2 ** ((degree + 2) // 2)
    assert set(row[int(a == b) :].tolist()) <= {-1, -t, t - 2}


@given(st.sampled_from(sorted(n for n in KASAMI_TAPS if n <= 10)), st.data())
def test_kasami_codes_keep_to_their_bound(degree: int, data: st.DataObject) -> None:
    a, b = (data.draw(st.integers(0, 2 ** (degree // 2) - 1)) for _ in range(2))
    row = periodic_correlation(kasami(degree, a), kasami(degree, b))
    s = 1 + 2 ** (degree // 2)
    assert set(row[int(a == b) :].tolist()) <= {-1, -s, s - 2}


@given(chips, chips)
def test_aperiodic_correlation_is_the_plain_sum(a: list[int], b: list[int]) -> None:
    plain = np.correlate(2 * np.array(b) - 1, 2 * np.array(a) - 1, "full")
    np.testing.assert_array_equal(aperiodic_correlation(a, b), plain)


@given(chips, st.data())
def test_periodic_correlation_is_the_plain_sum(a: list[int], data: st.DataObject) -> None:
    b = data.draw(st.lists(st.integers(0, 1), min_size=len(a), max_size=len(a)))
    x, y = 2 * np.array(a) - 1, 2 * np.array(b) - 1
    plain = [int(x @ np.roll(y, -k)) for k in range(len(a))]
    np.testing.assert_array_equal(periodic_correlation(a, b), plain)


@given(chips, st.integers(-200, 200))
def test_a_delayed_code_peaks_at_its_delay(a: list[int], delay: int) -> None:
    assert periodic_correlation(a, np.roll(a, delay))[delay % len(a)] == len(a)


@given(st.integers(2, 9), st.data())
def test_order_of_taps_and_copies_are_one_register(degree: int, data: st.DataObject) -> None:
    taps = data.draw(st.sampled_from(primitive_taps(degree)))
    shuffled = data.draw(st.permutations(taps))
    np.testing.assert_array_equal(m_sequence(degree, shuffled), m_sequence(degree, taps))
