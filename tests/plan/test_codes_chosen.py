"""Choosing codes: candidates, selection, and that what is chosen is better than what is not."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from sonofix.plan.codes import (
    CodeSet,
    affordable,
    choose,
    family_candidates,
    measure,
    quiet_alone,
    select,
)
from sonofix.plan.crosstalk import Bench, make_grid
from sonofix.signals.codes import gold, kasami, m_sequence
from sonofix.signals.waveform import chips_of, keyed_waveform
from sonofix.site import Beacon, GoldCode, Signal

SPEED_MPS = 343.0
SIGNAL = Signal(carrier_hz=40e3, cycles_per_chip=10.0, bandwidth_hz=4e3)


@pytest.fixture(scope="module")
def seventh():
    """Bursts of the 18 m-sequences of degree 7, and their grid at up to 2 m/s apart."""
    waves = [keyed_waveform(c.chips, SIGNAL) for c in family_candidates(7, ("m-sequence",))]
    return waves, make_grid(waves, 15.0, 2.0, SPEED_MPS)


@pytest.mark.parametrize(
    ("degree", "families", "count"),
    [
        (7, ("m-sequence",), 18),
        (7, ("gold",), 129),
        (7, ("m-sequence", "gold", "kasami"), 18 + 129 - 2),  # u and v of the Gold codes are m-sequences
        (8, ("kasami",), 16),
        (8, ("m-sequence", "gold", "kasami"), 16 + 16 - 1),
    ],
)
def test_families_are_whole_and_without_twins(degree, families, count):
    candidates = family_candidates(degree, families)
    assert len(candidates) == count
    assert len({c.chips.tobytes() for c in candidates}) == count
    for candidate in candidates[:: max(1, count // 20)]:
        beacon = Beacon.model_validate({"id": "B", "position_m": (0.0, 0.0, 0.0), "code": candidate.code.model_dump()})
        np.testing.assert_array_equal(chips_of(beacon), candidate.chips)


def test_all_gold_and_kasami_codes_are_listed_as_numbered():
    for k, candidate in enumerate(family_candidates(5, ("gold",))):
        assert candidate.code == GoldCode(degree=5, index=k)
        np.testing.assert_array_equal(candidate.chips, gold(5, k))
    for k, candidate in enumerate(family_candidates(6, ("kasami",))):
        np.testing.assert_array_equal(candidate.chips, kasami(6, k))


@pytest.mark.parametrize(
    ("degree", "families", "words"),
    [
        (8, ("gold",), "no Gold codes"),
        (7, ("kasami",), "no Kasami codes"),
        (17, ("m-sequence", "gold", "kasami"), "up to degree 11"),
        (1, ("m-sequence",), "from 2 to 20"),
        (7, ("golden",), "families are m-sequence, gold, kasami"),
        (7, (), "families is empty"),
    ],
)
def test_families_that_are_not_there_are_named(degree, families, words):
    with pytest.raises(ValueError, match=words):
        family_candidates(degree, families)


def test_the_first_look_keeps_the_least_side_lobes():
    candidates = family_candidates(5, ("gold",))
    waves = [keyed_waveform(c.chips, SIGNAL) for c in candidates]
    grid = make_grid(waves[:1], 2.0, 0.0, SPEED_MPS)
    lobe = Bench(waves, grid).levels([(i, i) for i in range(33)], coarse=True)
    seen = []
    kept = quiet_alone(candidates, 10, lambda c: keyed_waveform(c.chips, SIGNAL), grid, seen.append)
    assert kept == sorted(kept)
    assert len(kept) == 10
    assert lobe[kept].max() < np.delete(lobe, kept).min()
    assert seen[-1] == 1.0
    assert quiet_alone(candidates, 33, lambda c: keyed_waveform(c.chips, SIGNAL), grid) == list(range(33))


def test_more_speed_leaves_fewer_to_compare():
    wave = keyed_waveform(m_sequence(9, [4]), SIGNAL)
    counts = [affordable(8, wave, make_grid([wave], 15.0, v, SPEED_MPS)) for v in (0.0, 4.0, 12.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] >= 24
    assert affordable(60, wave, make_grid([wave], 15.0, 4.0, SPEED_MPS)) == 180


@pytest.mark.parametrize("count", [2, 3, 5])
def test_selection_finds_the_least_worst_pair(rng, count):
    """Small enough to try every set."""
    for _ in range(15):
        level = rng.random((11, 11))
        level = np.maximum(level, level.T)
        least = min(max(level[i, j] for i, j in combinations(s, 2)) for s in combinations(range(11), count))
        chosen = select(level, count, np.random.default_rng(0))
        assert len(set(chosen)) == count
        assert max(level[i, j] for i, j in combinations(chosen, 2)) == least


def test_selection_of_all_is_all(rng):
    level = rng.random((4, 4))
    assert select(np.maximum(level, level.T), 4, np.random.default_rng(0)) == (0, 1, 2, 3)


def test_the_chosen_set_beats_chance(seventh):
    waves, grid = seventh
    chosen = choose(waves, 6, grid)
    rng = np.random.default_rng(5)
    worst = [measure([waves[i] for i in rng.choice(18, 6, replace=False)], grid).worst_db for _ in range(12)]
    assert chosen.worst_db <= min(worst)
    assert chosen.worst_db < np.median(worst) - 0.5


def test_what_is_told_is_measured(seventh):
    waves, grid = seventh
    chosen = choose(waves, 4, grid, seed=3)
    again = measure([waves[i] for i in chosen.members], grid)
    np.testing.assert_allclose(chosen.level_db, again.level_db, atol=1e-4)
    i, j = chosen.worst_pair
    assert chosen.worst_db == chosen.level_db[i, j]
    assert i != j
    assert (chosen.level_db[~np.eye(4, dtype=bool)] <= chosen.worst_db).all()


def test_same_seed_same_codes(seventh):
    waves, grid = seventh
    one, two = (choose(waves, 5, grid, seed=1) for _ in range(2))
    assert one.members == two.members
    np.testing.assert_array_equal(one.level_db, two.level_db)


def test_speed_changes_the_choice(seventh):
    """A set that is best at rest is not best in motion."""
    waves, moving = seventh
    still = make_grid(waves, 15.0, 0.0, SPEED_MPS)
    at_rest = choose(waves, 6, still)
    in_motion = choose(waves, 6, moving)
    assert at_rest.worst_db < in_motion.worst_db - 1.0
    assert at_rest.members != in_motion.members
    assert measure([waves[i] for i in at_rest.members], moving).worst_db > in_motion.worst_db


@pytest.mark.parametrize(("count", "words"), [(1, "2 or more"), (19, "only 18 codes")])
def test_impossible_counts_are_named(seventh, count, words):
    with pytest.raises(ValueError, match=words):
        choose(seventh[0], count, seventh[1])


def test_one_code_has_no_pair():
    with pytest.raises(ValueError, match="no pair"):
        _ = CodeSet((0,), np.zeros((1, 1))).worst_db
