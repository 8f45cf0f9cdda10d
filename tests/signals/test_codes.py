from __future__ import annotations

import itertools
import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import max_len_seq

from sonofix.signals import codes
from sonofix.signals.codes import (
    GOLD_PAIRS,
    KASAMI_TAPS,
    aperiodic_correlation,
    gold,
    gold_preferred_pair,
    is_primitive,
    kasami,
    m_sequence,
    periodic_correlation,
    primitive_taps,
)

DOCS = Path(__file__).parents[2] / "docs" / "codes.md"


def totient(number: int) -> int:
    return sum(math.gcd(number, k) == 1 for k in range(1, number + 1))


def period_of_register(degree: int, taps: tuple[int, ...]) -> int:
    """How long the register really takes to come back to all ones, by stepping it."""
    state = start = (1 << degree) - 1
    for count in itertools.count(1):
        feedback = state & 1
        for t in taps:
            feedback ^= state >> t & 1
        state = state >> 1 | feedback << (degree - 1)
        if state == start:
            return count
    raise AssertionError


@pytest.mark.parametrize("degree", range(2, 17))
def test_number_of_primitive_polynomials_is_totient_over_degree(degree: int) -> None:
    # Golomb 1967: φ(2ⁿ − 1)/n of them.
    taps = primitive_taps(degree)
    assert len(taps) == len(set(taps)) == totient(2**degree - 1) // degree


@pytest.mark.parametrize("degree", [2, 3, 4, 5, 6, 8, 10])
def test_primitive_means_that_the_register_visits_every_state(degree: int) -> None:
    full = {
        taps
        for count in range(1, degree)
        for taps in itertools.combinations(range(1, degree), count)
        if period_of_register(degree, taps) == 2**degree - 1
    }
    assert set(primitive_taps(degree)) == full


@pytest.mark.parametrize("degree", [2, 3, 5, 8, 9])
def test_every_m_sequence_equals_that_of_scipy(degree: int) -> None:
    for taps in primitive_taps(degree):
        np.testing.assert_array_equal(m_sequence(degree, taps), max_len_seq(degree, taps=list(taps))[0])


def test_degree_9_has_its_48_sequences() -> None:
    assert len({m_sequence(9, taps).tobytes() for taps in primitive_taps(9)}) == 48


@pytest.mark.parametrize("degree", [12, 14, 16, 17])
def test_long_m_sequences_equal_those_of_scipy(degree: int) -> None:
    taps = primitive_taps(degree)[-1]
    np.testing.assert_array_equal(m_sequence(degree, taps), max_len_seq(degree, taps=list(taps))[0])


def test_order_of_taps_does_not_matter() -> None:
    np.testing.assert_array_equal(m_sequence(9, [8, 1, 5]), m_sequence(9, (1, 5, 8)))


def test_codes_of_a_recording_are_made_from_their_taps(captures: Path) -> None:
    compared = 0
    for path in sorted(captures.glob("*/site.toml")):
        for beacon in tomllib.loads(path.read_text(encoding="utf-8")).get("beacon", []):
            code = beacon.get("code", {})
            if code.get("family") == "m-sequence" and "chips" in code:
                made = "".join(map(str, m_sequence(code["degree"], code["taps"])))
                assert made == code["chips"], (path, beacon["id"])
                compared += 1
    assert compared >= 8


def gold_bound(degree: int) -> int:
    return 1 + 2 ** ((degree + 2) // 2)


def correlation_values(family: list[np.ndarray]) -> set[int]:
    """Every periodic correlation value between any two codes, off the peaks of each with itself."""
    values: set[int] = set()
    for a, b in itertools.combinations_with_replacement(family, 2):
        row = periodic_correlation(a, b)
        values.update((row[1:] if a is b else row).tolist())
    return values


@pytest.mark.parametrize("degree", [3, 5, 6, 7])
def test_all_pairs_of_gold_codes_have_three_values(degree: int) -> None:
    family = [gold(degree, k) for k in range(2**degree + 1)]
    assert len({code.tobytes() for code in family}) == 2**degree + 1
    t = gold_bound(degree)
    assert correlation_values(family) == {-1, -t, t - 2}


@pytest.mark.parametrize("degree", [9, 10, 11, 13, 14, 15])
def test_random_pairs_of_longer_gold_codes_have_three_values(degree: int, rng: np.random.Generator) -> None:
    t = gold_bound(degree)
    indices = [0, 1, 2, 2**degree, *rng.integers(3, 2**degree, 4).tolist()]
    assert correlation_values([gold(degree, k) for k in indices]) == {-1, -t, t - 2}


def test_gold_codes_are_the_pair_and_its_products() -> None:
    u, v = (m_sequence(5, taps) for taps in gold_preferred_pair(5))
    np.testing.assert_array_equal(gold(5, 0), u)
    np.testing.assert_array_equal(gold(5, 1), v)
    np.testing.assert_array_equal(gold(5, 2), u ^ v)
    # The second delayed by k − 2 = 3 chips: what it sent at chip 0 comes at chip 3.
    np.testing.assert_array_equal(gold(5, 5)[3:] ^ u[3:], v[:-3])


@pytest.mark.parametrize("degree", [4, 6, 8, 10])
def test_all_pairs_of_kasami_codes_have_three_values(degree: int) -> None:
    family = [kasami(degree, k) for k in range(2 ** (degree // 2))]
    assert len({code.tobytes() for code in family}) == len(family)
    s = 1 + 2 ** (degree // 2)
    assert correlation_values(family) == {-1, -s, s - 2}


@pytest.mark.parametrize("degree", [12, 14, 16])
def test_some_longer_kasami_codes_have_three_values(degree: int) -> None:
    s = 1 + 2 ** (degree // 2)
    assert correlation_values([kasami(degree, k) for k in (0, 1, 2, 2 ** (degree // 2) - 1)]) == {-1, -s, s - 2}


def test_kasami_starts_with_the_m_sequence() -> None:
    np.testing.assert_array_equal(kasami(8, 0), m_sequence(8, KASAMI_TAPS[8]))


def test_kasami_second_part_repeats_and_is_itself_an_m_sequence() -> None:
    w = kasami(8, 1) ^ kasami(8, 0)
    np.testing.assert_array_equal(w[15:], w[:-15])
    assert set(periodic_correlation(w[:15], w[:15])[1:].tolist()) == {-1}
    np.testing.assert_array_equal(kasami(8, 3) ^ kasami(8, 0), np.roll(w, 2))


def table_rows(heading: str) -> list[list[list[int]]]:
    section = DOCS.read_text(encoding="utf-8").split(f"## {heading}")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if re.match(r"\| \d", line)]
    return [[[int(n) for n in cell.split(",")] for cell in row] for row in rows]


def test_documented_gold_table_is_the_one_in_use() -> None:
    documented = {row[0][0]: (tuple(row[1]), tuple(row[2]), row[3][0]) for row in table_rows("Gold")}
    assert documented == {n: (*pair, gold_bound(n)) for n, pair in GOLD_PAIRS.items()}


def test_documented_kasami_table_is_the_one_in_use() -> None:
    documented = {row[0][0]: (tuple(row[1]), row[2][0]) for row in table_rows("Kasami, small set")}
    assert documented == {n: (taps, 1 + 2 ** (n // 2)) for n, taps in KASAMI_TAPS.items()}


def test_documented_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    example = DOCS.read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
    names: dict[str, object] = {}
    exec(example, names)
    assert capsys.readouterr().out.strip() in example
    assert np.size(names["chips"]) == 511  # type: ignore[arg-type]


def test_aperiodic_correlation_places_a_late_code_at_its_delay() -> None:
    late = np.concatenate([np.ones(6, dtype=np.int8), m_sequence(6, [1])])
    row = aperiodic_correlation(m_sequence(6, [1]), late)
    assert np.argmax(row) - (63 - 1) == 6
    assert row.max() == 63


def test_barker_code_has_unit_side_lobes() -> None:
    # Barker 1953: the code of 13 chips has aperiodic side lobes of 0 and 1 only.
    barker = [1, 1, 1, 1, 1, 0, 0, 1, 1, 0, 1, 0, 1]
    row = aperiodic_correlation(barker, barker)
    assert row.tolist() == [1, 0] * 6 + [13] + [0, 1] * 6


@pytest.mark.parametrize("taps", [(1,), (3, 4), (1, 2, 3, 4, 5, 6, 7, 8), (3,)])
def test_taps_that_are_not_primitive_are_refused_with_a_way_out(taps: tuple[int, ...]) -> None:
    assert not is_primitive(9, taps)
    with pytest.raises(ValueError, match=rf"{re.escape(str(list(taps)))}.*not primitive.*48 sets.*\[4\]"):
        m_sequence(9, taps)


@pytest.mark.parametrize("taps", [(), (0, 4), (4, 4), (4, 9), (-1,), (4.0,), (True,), ("4",)])
def test_taps_out_of_range_are_named(taps: tuple) -> None:
    with pytest.raises(ValueError, match=r"taps = .*from 1 to 8"):
        m_sequence(9, taps)


@pytest.mark.parametrize("degree", [1, 21, 0, -3, 9.0, True])
def test_degree_out_of_range_is_named(degree: int) -> None:
    with pytest.raises(ValueError, match=r"degree = .*2 to 20"):
        primitive_taps(degree)
    with pytest.raises(ValueError, match=r"degree = .*2 to 20"):
        m_sequence(degree, [1])


@pytest.mark.parametrize("degree", [2, 4, 8, 12, 16, 17])
def test_degrees_without_gold_codes_name_those_with(degree: int) -> None:
    with pytest.raises(ValueError, match=rf"degree = {degree} .*valid is 3, 5, 6, 7, 9, 10, 11, 13, 14, 15"):
        gold(degree, 0)


@pytest.mark.parametrize("degree", [2, 5, 9, 18])
def test_degrees_without_kasami_codes_name_those_with(degree: int) -> None:
    with pytest.raises(ValueError, match=rf"degree = {degree} .*valid is 4, 6, 8, 10, 12, 14, 16"):
        kasami(degree, 0)


@pytest.mark.parametrize(("make", "index", "last"), [(gold, 65, 64), (gold, -1, 64), (kasami, 8, 7), (kasami, 1.0, 7)])
def test_index_out_of_range_names_the_last(make, index: int, last: int) -> None:
    with pytest.raises(ValueError, match=rf"index = {index}; .* degree 6 are numbered 0 to {last}"):
        make(6, index)


def test_correlation_refuses_what_is_no_code() -> None:
    with pytest.raises(ValueError, match="chips 0 and 1"):
        periodic_correlation([1, -1], [0, 1])
    with pytest.raises(ValueError, match="3 and 2 chips"):
        periodic_correlation([1, 0, 1], [0, 1])
    with pytest.raises(ValueError, match="chips 0 and 1"):
        aperiodic_correlation([], [0, 1])


def test_chips_may_be_changed_without_changing_the_next_code() -> None:
    chips = m_sequence(4, [1])
    chips[:] = 0
    assert codes.m_sequence(4, [1]).sum() == 8
