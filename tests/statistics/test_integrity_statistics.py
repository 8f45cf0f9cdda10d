"""Fixes with faulty ranges, over many trials: what is noticed, and that no error hides beyond its protection level.

A count of hits among N is binomial; a band holds all but 1e-6 of a right program's runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.stats import binom

from locate.made_epochs import BOUNDS, HALL, Drive, make_epoch, make_site
from sonofix.locate.detectable import detectable_biases
from sonofix.locate.exclude import APART_SIGMA
from sonofix.locate.fix import fix
from sonofix.locate.integrity import minimum_detectable_bias
from sonofix.locate.many import Fixes, fix_many
from sonofix.records import Fix, Floats, RangeEpoch
from sonofix.site import Site

OUTSIDE = 1e-6
SD_M = 0.01
FAR_M = 20.0
"""Larger biases are not tried."""

TWO_BY_TWO = ((5.0, 0.0, 1.0), (5.1, -1.0, 1.0), (11.0, 4.0, 1.0), (12.0, 4.1, 1.0))
"""Where one of a pair is wrong, the pair tells that, but not which of the two."""

EIGHT = (*HALL, (0.0, 4.0, 1.5), (10.0, 4.0, 2.9))


@dataclass(frozen=True)
class Case:
    site: Site
    clock_m: float | None = None
    rate_sd_mps: float | None = None


def _site(anchors: tuple, level_m: float | None = None) -> Site:
    return make_site(anchors, level_m=level_m, bounds_m=BOUNDS)


CASES = {
    "level, eight": Case(_site(EIGHT, 1.1)),
    "level, three": Case(_site(HALL[:3], 1.1)),
    "level, TDoA, six": Case(_site(HALL, 1.1), clock_m=30.0),
    "space, eight": Case(_site(EIGHT)),
    "space, five": Case(_site(HALL[:5])),
    "space, TDoA, eight": Case(_site(EIGHT), clock_m=30.0),
    "level, two by two, rates": Case(_site(TWO_BY_TWO, 1.1), rate_sd_mps=0.05),
    "level, four, rates": Case(_site(HALL[:4], 1.1), rate_sd_mps=0.2),
    "space, eight, rates": Case(_site(EIGHT), rate_sd_mps=0.05),
}


def jacobian(site: Site, place: Floats, clock: bool, level: bool) -> Floats:
    anchors = np.array([b.position_m for b in site.beacons])
    unit = (place - anchors) / np.linalg.norm(place - anchors, axis=1)[:, None]
    columns = [unit[:, : 2 if level else 3], *([np.ones((len(unit), 1))] if clock else [])]
    return np.hstack(columns)


def drawn(case: Case, rng: np.random.Generator, place: Floats | None = None) -> tuple[RangeEpoch, Floats, Floats]:
    """A noisy epoch of a random place, that place, and the bias of each range that a linear model there detects."""
    level_m = case.site.vehicles[0].z_m
    place = rng.uniform((0.5, 0.5, 0.2), (9.5, 7.5, 2.0)) if place is None else place
    place[2] = place[2] if level_m is None else level_m
    anchors = np.array([b.position_m for b in case.site.beacons])
    exact = EXACT.setdefault(
        id(case), make_epoch(case.site, Drive(place), sd_m=SD_M, rate_sd_mps=case.rate_sd_mps, clock_m=case.clock_m)
    )
    range_m = np.linalg.norm(place - anchors, axis=1) + (case.clock_m or 0.0) + SD_M * rng.standard_normal(len(anchors))
    least = minimum_detectable_bias(
        jacobian(case.site, place, case.clock_m is not None, level_m is not None), exact.covariance_m2
    )
    if case.rate_sd_mps is None:
        return replace(exact, range_m=range_m), place, least
    away = (place - anchors) / np.linalg.norm(place - anchors, axis=1)[:, None]
    velocity_mps = rng.uniform(-1.0, 1.0, 3) * (1.0, 1.0, level_m is None)
    rate_mps = away @ velocity_mps + case.rate_sd_mps * rng.standard_normal(len(anchors))
    return replace(exact, range_m=range_m, range_rate_mps=rate_mps), place, least


EXACT: dict[int, RangeEpoch] = {}
"""An epoch of each case, whose ranges are drawn anew."""


def faulted(case: Case, epoch: RangeEpoch, least: Floats, rng: np.random.Generator) -> RangeEpoch:
    """Return the epoch with a wrong range: of about what is just noticed, or of up to metres, of either sign."""
    range_m = epoch.range_m.copy()
    row = rng.integers(len(range_m))
    size = min(least[row], 1.0) * rng.uniform(0.2, 1.6) if rng.random() < 0.7 else 10 ** rng.uniform(-2, 0.7)
    range_m[row] += size * rng.choice((-1.0, 1.0))
    return replace(epoch, range_m=range_m)


def astray(found: Fix, place: Floats) -> bool:
    """Whether a fix that raises no alarm is further off than it says."""
    if found.status != "ok" or found.position_m is None:
        return False
    away = np.abs(found.position_m - place)
    beyond = found.hpl_m is not None and np.hypot(away[0], away[1]) > found.hpl_m
    return bool(beyond or (found.vpl_m is not None and away[2] > found.vpl_m))


def mistaken(found: Fix, place: Floats) -> bool:
    """Whether ranges were left out, and the rest taken for good, though they put the vehicle elsewhere."""
    if found.status != "ok" or found.position_m is None or found.covariance is None or found.used.all():
        return False
    sd_m = np.sqrt(np.linalg.eigvalsh(found.covariance[:2, :2])[-1])
    # so far apart another choice gainsays them, and that choice has noise of its own
    return bool(np.hypot(*(found.position_m - place)[:2]) > 2 * APART_SIGMA * sd_m)


@dataclass
class Count:
    epochs: int = 0
    alarms: int = 0
    excluded: int = 0
    bounded: int = 0
    misled: int = 0
    mistaken: int = 0
    widest: float = 0.0
    levels: list[float] = field(default_factory=list)


def count_faulted(case: Case, epochs: int, rng: np.random.Generator) -> Count:
    out = Count(epochs)
    for _ in range(epochs):
        epoch, place, least = drawn(case, rng)
        found = fix(faulted(case, epoch, least, rng), case.site, "v")
        out.alarms += found.status != "ok"
        out.excluded += found.status == "ok" and not found.used.all()
        out.misled += astray(found, place)
        out.mistaken += mistaken(found, place)
        if found.status == "ok" and found.hpl_m is not None and found.position_m is not None:
            out.bounded += 1
            out.levels.append(found.hpl_m)
            out.widest = max(out.widest, np.hypot(*(found.position_m - place)[:2]) / found.hpl_m)
    return out


@pytest.mark.parametrize("name", CASES)
def test_no_error_hides_beyond_its_protection_level(name: str, rng: np.random.Generator) -> None:
    epochs = 300
    found = count_faulted(CASES[name], epochs, rng)
    assert found.misled == 0
    assert found.mistaken == 0
    assert found.bounded > 50


def count_noticed(case: Case, places: int, draws: int, rng: np.random.Generator) -> tuple[int, int, int]:
    """False alarms among epochs without fault; trials with a bias just noticed, stated by a fix, and how many slip."""
    false, trials, missed = 0, 0, 0
    for _ in range(places):
        epoch, place, _ = drawn(case, rng)
        found = fix(epoch, case.site, "v")
        if found.status != "ok" or not found.used.all():
            continue
        least_m, sure_m = detectable_biases(epoch, case.site, found)
        for draw in range(draws):
            again = drawn(case, rng, place)[0]
            found = fix(again, case.site, "v")
            false += found.status != "ok" or not found.used.all()
            biases_m = sure_m * rng.uniform(1.0, 1.5) if draw % 2 else least_m
            near = np.flatnonzero(biases_m < FAR_M)
            if not len(near):
                continue
            row = rng.choice(near)
            range_m = again.range_m.copy()
            range_m[row] += biases_m[row] * rng.choice((-1.0, 1.0))
            found = fix(replace(again, range_m=range_m), case.site, "v")
            trials += 1
            missed += found.status == "ok" and bool(found.used.all())
    return false, trials, missed


@pytest.mark.parametrize("name", ["level, three", "space, TDoA, eight", "level, four, rates"])
def test_alarms_are_few_and_biases_beyond_the_least_are_noticed(name: str, rng: np.random.Generator) -> None:
    places, draws = 10, 40
    false, trials, missed = count_noticed(CASES[name], places, draws, rng)
    assert false <= binom.ppf(1 - OUTSIDE, places * draws, 1e-3)
    assert trials > 300
    assert missed <= binom.ppf(1 - OUTSIDE, trials, 1e-3)


UNKNOWNS = {
    "level": (True, False),
    "level, TDoA": (True, True),
    "space": (False, False),
    "space, TDoA": (False, True),
}


@dataclass
class Noticed:
    """How many of as many trials each alarm without fault, and miss biases: those stated, larger, of a linear model."""

    trials: int = 0
    alarms: int = 0
    least: int = 0
    beyond: int = 0
    linear: int = 0
    ratios: list[float] = field(default_factory=list)


def count_in_layouts(
    unknowns: str, spare: int, layouts: int, draws: int, rng: np.random.Generator, linear: bool = False
) -> Noticed:
    """Count what a fix at a random place in random layouts, with so many ranges to spare, says that it notices."""
    (flat, clock), out = UNKNOWNS[unknowns], Noticed()
    clock_m = 20.0 if clock else 0.0
    count, done = 2 + (not flat) + clock + spare, 0
    while done < layouts:
        anchors = rng.uniform((0.0, 0.0, 0.3), (10.0, 8.0, 3.2), (count, 3))
        place = rng.uniform((0.5, 0.5, 0.2), (9.5, 7.5, 2.0))
        level_m = float(place[2]) if flat else None
        site = make_site(anchors, level_m=level_m, bounds_m=BOUNDS)
        epoch = make_epoch(site, Drive(place), sd_m=SD_M, clock_m=clock_m or None, rng=rng)
        found = fix(epoch, site, "v")
        if found.status != "ok" or not found.used.all():
            continue
        done += 1
        least_m, sure_m = detectable_biases(epoch, site, found)
        if not (near := np.flatnonzero(sure_m < FAR_M)).size:
            continue
        row = rng.choice(near)
        straight_m = minimum_detectable_bias(jacobian(site, place, clock, flat), epoch.covariance_m2)[row]
        out.ratios.append(least_m[row] / straight_m)
        exact = np.linalg.norm(place - anchors, axis=1) + clock_m

        def solved(
            biases_m: Floats,
            exact: Floats = exact,
            row: int = row,
            anchors: Floats = anchors,
            level_m: float | None = level_m,
        ) -> Fixes:
            ranges = exact + SD_M * rng.standard_normal((draws, count))
            ranges[:, row] += biases_m * rng.choice((-1.0, 1.0), draws)
            # a range far below 0 is refused beforehand
            ranges = ranges if clock else np.maximum(ranges, 0.0)
            return fix_many(anchors, ranges, np.full(count, SD_M**2), level_m=level_m, clock=clock, bounds_m=BOUNDS)

        def unnoticed(biases_m: Floats, solved: Callable[[Floats], Fixes] = solved) -> int:
            many = solved(biases_m)
            return int(np.count_nonzero((many.status == 0) & many.used.all(axis=1)))

        clean = solved(np.zeros(draws))
        told = np.isfinite(clean.position_m[:, 0])
        out.alarms += int(np.count_nonzero(told & ((clean.status != 0) | ~clean.used.all(axis=1))))
        out.trials += draws
        out.least += unnoticed(np.full(draws, least_m[row]))
        out.beyond += unnoticed(sure_m[row] * rng.uniform(1.0, 1.5, draws))
        if linear:
            out.linear += unnoticed(np.full(draws, straight_m))
    return out


@pytest.mark.parametrize("spare", [1, 2, 3])
@pytest.mark.parametrize("unknowns", UNKNOWNS)
def test_in_any_layout_a_bias_as_large_as_a_fix_says_is_noticed(
    unknowns: str, spare: int, rng: np.random.Generator
) -> None:
    found = count_in_layouts(unknowns, spare, 12, 300, rng)
    assert found.trials > 2000
    most = binom.ppf(1 - OUTSIDE, found.trials, 1e-3)
    assert max(found.least, found.beyond) <= most


MIRRORS = {
    "ceiling": [(0.0, 0.0, 3.2), (10.0, 0.0, 3.2), (10.0, 8.0, 3.2), (0.0, 8.0, 3.2), (4.0, 3.0, 3.2)],
    "uneven ceiling": [(0.0, 0.0, 3.2), (10.0, 0.0, 3.24), (10.0, 8.0, 3.15), (0.0, 8.0, 3.2), (4.0, 3.0, 3.1)],
    "one wall": [(0.0, 0.0, 2.0), (0.05, 3.0, 2.5), (0.0, 5.0, 1.0), (0.0, 8.0, 3.0), (-0.03, 6.0, 2.0)],
    "a corner": [(0.0, 0.0, 2.0), (0.0, 3.0, 2.5), (0.0, 7.0, 2.0), (3.0, 0.0, 1.5), (7.0, 0.0, 2.6)],
}


@pytest.mark.parametrize("clock", [False, True], ids=["ToA", "TDoA"])
@pytest.mark.parametrize("layout", MIRRORS)
def test_ten_thousand_cold_starts_show_no_confident_mirror(layout: str, clock: bool, rng: np.random.Generator) -> None:
    starts, anchors = 10_000, np.array(MIRRORS[layout])
    places = rng.uniform((0.5, 0.5, 0.2), (9.5, 7.5, 2.8), (starts, 3))
    ranges_m = np.linalg.norm(places[:, None] - anchors, axis=2) + 4.0 * clock
    ranges_m += SD_M * rng.standard_normal(ranges_m.shape)
    for bounds in (None, BOUNDS):
        found = fix_many(anchors, ranges_m, np.full(5, SD_M**2), clock=clock, bounds_m=bounds)
        ok = found.status == 0
        away = np.abs(found.position_m - places)[ok]
        sd_m = np.sqrt(np.einsum("nii->ni", found.covariance[ok]))[:, :3]
        # a mirror is metres away: nothing a deviation of centimetres allows for
        confident = (away > 6 * sd_m).any(axis=1) & (np.linalg.norm(away, axis=1) > 0.5)
        assert not confident.any()
        assert ok.any() or bounds is None


@pytest.mark.prove
def test_integrity_over_many_epochs(rng: np.random.Generator) -> None:
    epochs = 50_000
    print(f"\nFixes with one wrong range each, {epochs} epochs a row, in a hall of 10 m × 8 m; ranges good to 1 cm.")
    print("Seven biases in ten are about as large as is just noticed, the others are from 1 cm to 5 m.\n")
    print(
        "| case | no error told of | left out | alarm | protection level, median | nearest error / level | beyond it "
        "| wrong one left out |"
    )
    print("|---|---|---|---|---|---|---|---|")
    misled = 0
    for name, case in CASES.items():
        found = count_faulted(case, epochs, rng)
        misled += found.misled
        quiet = epochs - found.alarms - found.excluded
        cells = [name, f"{quiet}", f"{found.excluded}", f"{found.alarms}", f"{np.median(found.levels):.2f} m"]
        print(
            "| " + " | ".join([*cells, f"{found.widest:.2f}", f"{found.misled}", f"{found.mistaken}"]) + " |",
            flush=True,
        )
    assert misled == 0


@pytest.mark.prove
def test_detection_over_many_epochs(rng: np.random.Generator) -> None:
    places, draws = 200, 50
    print(
        f"\nThe χ² test of a fix, {places * draws} epochs a row: none may alarm without fault more often than 1e-3, and"
    )
    print(
        "at most 1e-3 of biases may go unnoticed. Half are as large as a fix says that it notices, half up to half as"
    )
    print("large again as what it is sure to notice; beyond 20 m none are tried.\n")
    print("| case | false alarms | biases | missed |")
    print("|---|---|---|---|")
    for name, case in CASES.items():
        false, trials, missed = count_noticed(case, places, draws, rng)
        print(f"| {name} | {false} | {trials} | {missed} |", flush=True)
        assert false <= binom.ppf(1 - OUTSIDE, places * draws, 1e-3)
        assert missed <= binom.ppf(1 - OUTSIDE, trials, 1e-3)


@pytest.mark.prove
def test_detection_in_many_layouts(rng: np.random.Generator) -> None:
    layouts, draws = 200, 500
    print(
        f"\nBiases that a fix says it notices, in {layouts} random layouts of beacons a row (10 m × 8 m × 3 m, a random"
    )
    print(
        "place and range each, ranges good to 1 cm): of 10 000 how many slip through at the least bias that is noticed,"
    )
    print(
        "at up to half as large again as what is sure to be, and, beside it, at what the linear model (Baarda) gives;"
    )
    print("how much larger the least one is than that of the linear model; and alarms without fault, of 10 000.\n")
    print("| unknown | to spare | biases | least | beyond sure | linear | least / linear: 50 %, 95 %, most | alarms |")
    print("|---|---|---|---|---|---|---|---|")
    for unknowns in UNKNOWNS:
        for spare in (1, 2, 3, 5):
            found = count_in_layouts(unknowns, spare, layouts, draws, rng, linear=True)
            share = [1e4 * hits / found.trials for hits in (found.least, found.beyond, found.linear, found.alarms)]
            ratio = np.percentile(found.ratios, [50, 95, 100])
            cells = [unknowns, f"{spare}", f"{found.trials}", *(f"{s:.1f}" for s in share[:3])]
            cells += [", ".join(f"{r:.2f}" for r in ratio), f"{share[3]:.1f}"]
            print("| " + " | ".join(cells) + " |", flush=True)
            assert max(found.least, found.beyond, found.alarms) <= 1e-3 * found.trials
