"""Which codes to give a site's beacons: of all that a family has, a set whose worst pair disturbs least.

Candidates come from the built-in families or from chips that are given. Levels are those of `crosstalk`: of the bursts
as they are heard, over the delays and differences of range rate that the site allows. The set is chosen by greedy
starts and exchanges on coarse levels; what is told of it is measured on the fine grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from sonofix.plan.crosstalk import Bench, Grid, OnDone, level_db
from sonofix.records import Floats, Waveform
from sonofix.signals import codes
from sonofix.site import ChipsCode, GoldCode, KasamiCode, MSequenceCode

FAMILIES = ("m-sequence", "gold", "kasami")

MOST_WORK = 1_000_000_000
"""Values transformed in comparing all candidates with each other: 10 to 20 s."""

MOST_COMPARED = 160
"""Candidates compared with each other, whatever the work: each holds a megabyte or more."""

AT_ONCE = 32
"""Bursts held in the first look at each alone."""

ROUNDS = 12
"""Sets measured on the fine grid before the best of them is taken."""

STARTS = 40
"""Random sets from which exchanges begin, beside the greedy one."""

ChipCode = MSequenceCode | GoldCode | KasamiCode | ChipsCode


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A code as a site file names it, and its ``chips``: int8 (n,), 0 and 1."""

    code: ChipCode
    chips: NDArray[np.int8]


@dataclass(frozen=True, slots=True, eq=False)
class CodeSet:
    """A set of bursts, measured against each other.

    Attributes
    ----------
    members : tuple of int
        Indices of the bursts among those given.
    level_db : float64 (n, n)
        ``[i, j]``: worst level of member i in the search for member j, dB of the peak that j makes when it is just as
        loud; on the diagonal the worst own side lobe.
    """

    members: tuple[int, ...]
    level_db: Floats

    @property
    def worst_pair(self) -> tuple[int, int]:
        """Sent and listened for, of the loudest cross-talk; rows of `level_db`.

        Raises
        ------
        ValueError
            The set has no pair.
        """
        if len(self.members) < 2:
            raise ValueError("a set of one code has no pair; ask for the worst pair of two codes or more")
        apart = np.where(np.eye(len(self.members), dtype=bool), -np.inf, self.level_db)
        i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
        return int(i), int(j)

    @property
    def worst_db(self) -> float:
        """Level of the worst pair."""
        return float(self.level_db[self.worst_pair])


MOST_DEGREE = 11
"""Of families compared code by code."""


def family_candidates(degree: int, families: Sequence[str] = FAMILIES) -> list[Candidate]:
    """List every code of a degree in the named families; chips that two families share are listed once.

    Parameters
    ----------
    degree : int
        2 … ``MOST_DEGREE``: bursts of 2047 chips last half a second, and there are two thousand of them.
    families : sequence of "m-sequence", "gold", "kasami"
        Several: those that have the degree.

    Raises
    ------
    ValueError
        A family is unknown, none of them has codes of this degree, or there are too many to compare.
    """
    if degree > MOST_DEGREE:
        raise ValueError(
            f"degree = {degree}; codes are compared up to degree {MOST_DEGREE}, beyond there are too many: give a "
            "smaller degree, or some chips"
        )
    makers: dict[str, Callable[[int], list[Candidate]]] = {"m-sequence": _m_sequences, "gold": _gold, "kasami": _kasami}
    found: dict[bytes, Candidate] = {}
    problems = []
    for family in families:
        if family not in makers:
            raise ValueError(f"family = {family!r}; families are {', '.join(FAMILIES)}")
        try:
            every = makers[family](degree)
        except ValueError as error:
            problems.append(str(error))
            continue
        for candidate in every:
            found.setdefault(candidate.chips.tobytes(), candidate)
    if not found:
        raise ValueError(problems[0] if problems else "families is empty; name at least one")
    return list(found.values())


def _m_sequences(degree: int) -> list[Candidate]:
    if degree > 16:
        raise ValueError(f"degree = {degree}; a site file takes m-sequences of degree 2 to 16")
    return [
        Candidate(MSequenceCode(degree=degree, taps=taps), codes.m_sequence(degree, taps))
        for taps in codes.primitive_taps(degree)
    ]


def _gold(degree: int) -> list[Candidate]:
    u, v = (codes.m_sequence(degree, taps) for taps in codes.gold_preferred_pair(degree))
    chips = [u, v, *(u ^ np.roll(v, k) for k in range(len(u)))]
    return [Candidate(GoldCode(degree=degree, index=k), row) for k, row in enumerate(chips)]


def _kasami(degree: int) -> list[Candidate]:
    codes.kasami(degree, 0)
    every = range(2 ** (degree // 2))
    return [Candidate(KasamiCode(degree=degree, index=k), codes.kasami(degree, k)) for k in every]


def quiet_alone(
    candidates: Sequence[Candidate],
    most: int,
    burst: Callable[[Candidate], Waveform],
    grid: Grid,
    on_done: OnDone | None = None,
) -> list[int]:
    """Return the indices of those ``most`` candidates with the least side lobes of their own, in their order.

    A first look, where a family is too large for all its pairs to be compared; at every eighth difference of rate. In
    motion the code searched for matters as much as the pair: an on-off code's bare carrier correlates with any.
    """
    if len(candidates) <= most:
        return list(range(len(candidates)))
    middle = len(grid.difference_mps) // 2
    sparse = replace(grid, difference_mps=grid.difference_mps[middle % 4 :: 4])
    lobes: list[float] = []
    for start in range(0, len(candidates), AT_ONCE):
        waveforms = [burst(candidate) for candidate in candidates[start : start + AT_ONCE]]
        own = [(i, i) for i in range(len(waveforms))]
        lobes += Bench(waveforms, sparse).levels(own, coarse=True).tolist()
        if on_done is not None:
            on_done(len(lobes) / len(candidates))
    return sorted(np.argsort(lobes, kind="stable")[:most].tolist())


def affordable(count: int, waveform: Waveform, grid: Grid) -> int:
    """How many candidates can be compared in ``MOST_WORK``, at least three for each of ``count`` to be chosen."""
    seconds = len(waveform.envelope) / waveform.rate_hz + grid.span_s
    a_pair = len(grid.difference_mps[::2]) * seconds * grid.rate_hz / 2
    return max(min(int(np.sqrt(MOST_WORK / a_pair)), MOST_COMPARED), 3 * count)


def measure(waveforms: Sequence[Waveform], grid: Grid, on_done: OnDone | None = None) -> CodeSet:
    """Measure all pairs of a set of bursts on the fine grid."""
    count = len(waveforms)
    pairs = [(i, j) for i in range(count) for j in range(count)]
    level = Bench(waveforms, grid).levels(pairs, on_done=on_done)
    return CodeSet(tuple(range(count)), level_db(level).reshape(count, count))


def choose(
    waveforms: Sequence[Waveform],
    count: int,
    grid: Grid,
    seed: int = 0,
    on_compared: OnDone | None = None,
    on_measured: OnDone | None = None,
) -> CodeSet:
    """Choose ``count`` bursts whose worst pair disturbs least.

    All pairs are compared on the coarse grid and a set is selected; its pairs are then measured on the fine grid, and
    with what that tells the selection is repeated, until a set is selected that is measured already. Of all sets
    measured, the best is returned. That need not be the best of all: a bottleneck clique is NP-hard to find.

    Parameters
    ----------
    waveforms : sequence of Waveform
        Candidates.
    count : int
        2 or more.
    seed : int
        Of the random starts; same seed, same set.
    on_compared, on_measured : callable, optional
        Told the share that is done of the comparison, and of the measurements (at most).

    Raises
    ------
    ValueError
        ``count`` is below 2, or there are fewer candidates.
    """
    total = len(waveforms)
    if count < 2:
        raise ValueError(f"count = {count}; codes are chosen by their pairs, so it must be 2 or more")
    if count > total:
        raise ValueError(f"count = {count}; there are only {total} codes to choose from")
    bench = Bench(waveforms, grid)
    every = np.array(list(permutations(range(total), 2)))
    level = np.zeros((total, total))
    level[every[:, 0], every[:, 1]] = bench.levels(every, coarse=True, on_done=on_compared)
    coarse, known = level.copy(), np.eye(total, dtype=bool)
    best: tuple[float, float, tuple[int, ...]] | None = None
    for turn in range(ROUNDS):
        # what is not measured yet is taken to be as much louder as what is measured turned out to be
        seen = known & ~np.eye(total, dtype=bool)
        louder = float(np.mean(level[seen] / coarse[seen])) if seen.any() else 1.0
        likely = np.where(known, level, level * louder)
        chosen = select(np.maximum(likely, likely.T), count, np.random.default_rng(seed))
        fresh = np.array([pair for pair in permutations(chosen, 2) if not known[pair]]).reshape(-1, 2)
        if len(fresh):
            level[fresh[:, 0], fresh[:, 1]] = bench.levels(fresh)
            known[fresh[:, 0], fresh[:, 1]] = True
        among = np.maximum(level, level.T)[np.ix_(chosen, chosen)]
        best = min(filter(None, (best, (float(among.max()), float(np.sum(among**2)), chosen))))
        if on_measured is not None:
            on_measured((turn + 1) / ROUNDS)
        if not len(fresh):
            break
    assert best is not None
    members = best[2]
    among = level[np.ix_(members, members)]
    among[np.diag_indices(count)] = bench.levels([(i, i) for i in members])
    return CodeSet(members, level_db(among))


def select(level: Floats, count: int, rng: np.random.Generator) -> tuple[int, ...]:
    """Choose ``count`` rows of a symmetric matrix of pair levels, the largest among them as low as can be found.

    From a greedy set and from random ones, that row is exchanged for another which lowers the worst pair most, or with
    an equal worst pair the sum of squares, until no exchange does.

    Parameters
    ----------
    level : float64 (n, n)
        Symmetric; the diagonal is not looked at.

    Returns
    -------
    tuple of int
        Ascending.
    """
    level = level.copy()
    np.fill_diagonal(level, 0.0)
    total = len(level)
    starts = [_greedy(level, count)]
    starts += [rng.choice(total, count, replace=False).tolist() for _ in range(STARTS)]
    found = [_exchanged(level, start) for start in starts]
    return min(found)[2]


def _merit(level: Floats, members: Sequence[int]) -> tuple[float, float, tuple[int, ...]]:
    among = level[np.ix_(members, members)]
    return float(among.max()), float(np.sum(among**2)), tuple(sorted(members))


def _greedy(level: Floats, count: int) -> list[int]:
    """Begin with the quietest pair; add what adds least."""
    apart = np.where(np.eye(len(level), dtype=bool), np.inf, level)
    i, j = np.unravel_index(int(np.argmin(apart)), apart.shape)
    members = [int(i), int(j)]
    while len(members) < count:
        added = level[members].max(axis=0)
        added[members] = np.inf
        members.append(int(np.argmin(added)))
    return members


def _exchanged(level: Floats, members: list[int]) -> tuple[float, float, tuple[int, ...]]:
    """Exchange one member for an outsider as long as that helps."""
    now = _merit(level, members)
    while True:
        options = []
        for member in now[2]:
            rest = [m for m in now[2] if m != member]
            among = level[np.ix_(rest, rest)]
            worst = np.maximum(level[rest].max(axis=0), among.max())
            total = np.sum(among**2) + 2 * np.sum(level[rest] ** 2, axis=0)
            worst[list(now[2])] = np.inf
            outsider = int(np.lexsort((total, worst))[0])
            if np.isfinite(worst[outsider]):
                options.append(_merit(level, [*rest, outsider]))
        better = min(options, default=now)
        # sums differ by rounding with the order of the members: demand more than that
        if better[:2] >= (now[0], now[1] * (1 - 1e-12)):
            return now
        now = better
