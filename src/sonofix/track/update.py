"""Ranges and range rates straight into the belief: no fix is needed, one heard beacon still helps.

An iterated extended Kalman update in Joseph form. Rows far from what is expected are left out, row by row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import PITCH, ROLL, SIZE, YAW, Links, rows_at
from sonofix.locate.noise import MANOEUVRE_MPS2, row_noise
from sonofix.records import Floats, Innovation, RangeEpoch
from sonofix.track import paired, sound_rows, stated
from sonofix.track.belief import Belief
from sonofix.track.held import hold
from sonofix.track.sound_rows import Peak

GATE_SIGMA = 5.0
"""A row this many deviations from its prediction is not believed."""

SETTLED = 1e-6
"""Iterations end when nothing in the state moves by more, in its own unit."""

WHOLE_STEPS = 8
"""Iterations after which steps are halved."""

ASTRAY = 1e-3
"""Ranges are not believed where the state still moves by more when iterations have run out."""


MANOEUVRE_RADPS2 = 4.0
"""Acceleration (one sigma) of each angle within an epoch."""

PUSHED_MPS2 = 20.0
"""Acceleration (one sigma) of a vehicle that is being pushed: by a metre in a third of a second."""

BENT = 0.1
"""Share of their own errors by which stated ranges may bend within what places are uncertain by, uniterated."""


def update(
    belief: Belief,
    epoch: RangeEpoch,
    links: Links,
    candidates: NDArray[np.bool_],
    iterations: int = 20,
    pushed: int = -1,
) -> tuple[Belief, NDArray[np.bool_], Floats, Innovation | None]:
    """Correct a belief, already predicted to the epoch's instant, by the epoch's rows.

    Parameters
    ----------
    candidates : bool (n,)
        Rows worth asking; those that touch a vehicle without a position are left out.
    iterations : int
        At most.
    pushed : int
        A vehicle that is just being pushed (−1: none). Within the epoch it moves as no model has it, by as much as
        `PUSHED_MPS2`, and rows that were heard at different moments are not judged together.

    Returns
    -------
    belief : Belief
    used : bool (n,)
    surprise : float64 (m,)
        Of the m rows asked: squared range innovation over its expected variance, 1 on average where that is true.
    innovation : Innovation or None
        Of the rows used, together; None where none was.
    """
    used = np.zeros(len(epoch), bool)
    placed = np.append(belief.placed, True)
    rows = np.flatnonzero(candidates & placed[links.emitter_vehicle] & placed[links.receiver_vehicle])
    clock, with_rates = epoch.clock == "common", epoch.range_rate_mps is not None
    if not len(rows) or (clock and not belief.free[-2]):
        if belief.trust is not None:
            belief = replace(belief, trust=replace(belief.trust, told=0.0))
        return belief, used, np.zeros(0), None
    dt = epoch.time_s[rows] - belief.time_s
    pair = pairs_of(belief, epoch, rows)
    measured = epoch.range_m[rows]
    if epoch.range_rate_mps is not None:
        measured = np.concatenate([measured, epoch.range_rate_mps[rows]])
    whole, links = links, links.rows(rows)
    mean = belief.mean if belief.about is None else belief.near(belief.about.now, belief.mean)
    shown, derivative = expect(links, belief, mean, dt, epoch, pair)
    noise = noise_of(belief, epoch, whole, rows, dt, pair, derivative, pushed)
    trust, claimed = belief.trust if epoch.snr_db is None else None, noise.diagonal().copy()
    if trust is not None:
        noise[np.diag_indices(len(rows))] += trust.extra(pair)
    miss = measured - shown - derivative @ (belief.mean - mean)
    crossed = derivative @ belief.covariance
    spread = np.einsum("ij,ij->i", crossed, derivative) + noise.diagonal()
    if trust is not None:
        trust, jumped = trust.heard(pair, miss, spread, epoch.time_s[rows])
        if jumped.any():
            belief = _jumped(belief, pair[jumped], miss[jumped])
            crossed = derivative @ belief.covariance
            spread = np.einsum("ij,ij->i", crossed, derivative) + noise.diagonal()
        belief = replace(belief, trust=trust)
    surprise = miss**2 / spread
    # a row is believed where its range is, and its rate if it has one
    near = (surprise <= GATE_SIGMA**2).reshape(-1, len(rows)).all(axis=0)
    surprise = surprise[: len(rows)]
    if len(rows) > 2 and 2 * np.count_nonzero(near) < len(rows):
        # most disagree: those that do not may do so by chance, and would drag the track along
        near[:] = False
    asked = (links, dt, measured, pair)
    if trust is not None:
        # the noise of others' ranges has heavy tails: what is far off counts less before it counts for nothing
        trust, larger = trust.weighed(pair, miss, spread, noise.diagonal())
        if np.count_nonzero(near) > 2 and not with_rates:
            some = np.ix_(near, near)
            expected = crossed[near] @ derivative[near].T + noise[some]
            larger[near] = trust.together(miss[near], expected, noise[some].diagonal(), larger[near])
        noise[np.diag_indices(len(rows))] *= larger
        belief = replace(belief, trust=trust)
    if not near.any():
        return belief, used, surprise, None
    used[rows[near]] = True
    hearing = Hearing(links, dt, measured, noise, pair)
    if not near.all():
        both = np.tile(near, 2) if with_rates else near
        hearing, miss, derivative, crossed = hearing.of(near), miss[both], derivative[both], crossed[both]
    if trust is not None and not _bent(
        belief, hearing.measured, hearing.noise.diagonal() + trust.variance[:, hearing.pair].sum(axis=0)
    ):
        iterations = 1
    found = _peak(belief, epoch, hearing, iterations, mean, (miss, derivative, crossed))
    if pushed < 0 and trust is None and len(hearing.dt) > 1 and sound_rows.odd(found):
        after, used[rows[near]], found = _sound(belief, epoch, hearing, iterations, mean, found)
        return after, used, surprise, _innovation(belief, found)
    if not found.settled:
        used[:] = False
        return belief, used, surprise, None
    after = replace(belief, mean=found.mean, covariance=found.covariance(belief.covariance))
    after = after if trust is None else _learn(after, trust, epoch, asked, claimed)
    return after, used, surprise, _innovation(belief, found)


def _innovation(belief: Belief, found: Peak) -> Innovation | None:
    return Innovation(belief.time_s, len(found.miss), found.cost) if found.settled else None


@dataclass(frozen=True, slots=True, eq=False)
class Hearing:
    """Some rows: their ends, their instants (r,) from the belief's, what they measured (m,), its noise, their pairs."""

    links: Links
    dt: Floats
    measured: Floats
    noise: Floats
    pair: NDArray[np.int64]

    def of(self, kept: NDArray[np.bool_]) -> Hearing:
        """Return some of the rows."""
        both = np.tile(kept, len(self.measured) // len(kept))
        pair = self.pair[kept] if len(self.pair) else self.pair
        return Hearing(self.links.rows(kept), self.dt[kept], self.measured[both], self.noise[both][:, both], pair)


def _peak(
    belief: Belief,
    epoch: RangeEpoch,
    hearing: Hearing,
    iterations: int,
    mean: Floats,
    first: tuple[Floats, Floats, Floats] | None = None,
) -> Peak:
    """Return the most likely state, iterated from ``mean``.

    ``first`` are innovations, derivative and its product with the covariance there, if they are known.
    """
    last = np.inf
    expected = gain = np.zeros((0, 0))
    miss, derivative, crossed = first or (np.zeros(0), gain, gain)
    for k in range(iterations if belief.about is None else 1):
        if k or first is None:
            shown, derivative = expect(hearing.links, belief, mean, hearing.dt, epoch, hearing.pair)
            miss = hearing.measured - shown - derivative @ (belief.mean - mean)
            crossed = derivative @ belief.covariance
        expected = crossed @ derivative.T + hearing.noise
        gain = np.linalg.solve(expected, crossed).T
        moved = belief.mean + gain @ miss
        last = float(np.abs(moved - mean).max())
        # steps that go to and fro (a height at the beacons' own, where ranges bend most) meet half-way
        mean = moved if k < WHOLE_STEPS or last < SETTLED else (mean + moved) / 2
        if last < SETTLED:
            break
    settled = last <= ASTRAY or iterations == 1 or belief.about is not None
    return Peak(mean, derivative, miss, expected, hearing.noise, gain, settled)


def _sound(
    belief: Belief, epoch: RangeEpoch, hearing: Hearing, iterations: int, mean: Floats, whole: Peak
) -> tuple[Belief, NDArray[np.bool_], Peak]:
    """Correct a belief by rows that cannot all be true; return which of them the likeliest hypothesis believes.

    And where that has its peak.

    Where none is likely and rows gainsay each other, all are taken to err by as much as they do (Birge 1932).
    """
    count = len(hearing.dt)

    def solve(kept: NDArray[np.bool_]) -> Peak:
        return _peak(belief, epoch, hearing.of(kept), iterations, mean)

    def look(at: Floats) -> tuple[Floats, Floats, Floats]:
        shown, derivative = expect(hearing.links, belief, at, hearing.dt, epoch, hearing.pair)
        return (hearing.measured - shown)[:count], derivative[:count], hearing.noise.diagonal()[:count]

    everything = np.ones(count, bool)
    found = sound_rows.likely(whole, count, belief.covariance, solve, look)
    if not all(one.peak.settled for one in found):
        return belief, ~everything, replace(whole, settled=False)
    if found:
        after, covariance = sound_rows.mixed(found, belief.covariance)
        return replace(belief, mean=after, covariance=covariance), found[0].kept, found[0].peak
    misfit, redundancy = whole.misfit
    if whole.settled and misfit > sound_rows.limit(len(whole.miss)):
        wider = replace(hearing, noise=hearing.noise * (misfit / redundancy))
        whole = _peak(belief, epoch, wider, iterations, mean)
    if not whole.settled:
        return belief, ~everything, whole
    return replace(belief, mean=whole.mean, covariance=whole.covariance(belief.covariance)), everything, whole


def linear(
    belief: Belief, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_]
) -> tuple[Floats, Floats, Floats, NDArray[np.int64]]:
    """Return the rows asked as ``offset (r,) = derivative (r, n) x + noise`` of variance (r,), and their pairs (r,).

    Of ranges that others state, without clock; linearised where the belief expects the vehicle.
    """
    rows = np.flatnonzero(asked)
    dt = epoch.time_s[rows] - belief.time_s
    pair = pairs_of(belief, epoch, rows)
    shown, derivative = expect(links.rows(rows), belief, belief.mean, dt, epoch, pair)
    variance = noise_of(belief, epoch, links, rows, dt, pair, derivative).diagonal()
    if belief.trust is not None:
        variance = variance + belief.trust.extras(pair)[0]
    return derivative, epoch.range_m[rows] - shown + derivative @ belief.mean, variance, pair


def _bent(belief: Belief, range_m: Floats, variance: Floats) -> bool:
    """Whether ranges bend within what places are uncertain by, by more than a share of what they err by themselves.

    Where they do not, an update is not iterated: derivatives at a place that the very same ranges gave share their
    noise, and thousands of such updates tell scale and bias more surely than they are (Huang, Mourikis and
    Roumeliotis 2010, of inconsistent filters).
    """
    poses = np.arange(SIZE * len(belief.placed)).reshape(-1, SIZE)[belief.placed, :3]
    sigma2 = float(belief.covariance[poses, poses].sum(axis=1).max())
    return sigma2 > BENT * 2.0 * float(np.min(np.abs(range_m) * np.sqrt(variance)))


def _jumped(belief: Belief, pair: NDArray[np.int64], miss: Floats) -> Belief:
    """Open the slow errors of pairs by what they miss."""
    assert belief.inputs is not None
    covariance = belief.covariance.copy()
    at = stated.places(belief.inputs.range_slot, pair, len(belief.inputs.pairs))[0]
    covariance[at, at] += miss**2
    hold(covariance, belief.held)
    return replace(belief, covariance=covariance)


def pairs_of(belief: Belief, epoch: RangeEpoch, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number (n,) of each row's pair, −1 where none of its errors is followed; (0,) where no row's are."""
    inputs = belief.inputs
    if inputs is None or (inputs.range_slot < 0 if epoch.snr_db is None else inputs.bias_slot < 0):
        return np.zeros(0, np.int64)
    return np.array([inputs.pairs.get((epoch.emitter[i], epoch.receiver[i]), -1) for i in rows], np.int64)


def noise_of(
    belief: Belief,
    epoch: RangeEpoch,
    links: Links,
    rows: NDArray[np.int64],
    dt: Floats,
    pair: NDArray[np.int64],
    derivative: Floats,
    pushed: int = -1,
) -> Floats:
    """Covariance (m, m) of rows as `row_noise` gives it, less what stays with a pair and is followed as a state.

    ``derivative`` (m, n) is what `expect` told of them. Rows of our own share one acceleration of each vehicle, which
    each sees from its side and for as long as it was heard, or sent, from the instant of the state. Ranges of others
    are weighed one by one, and take it as noise of their own.
    """
    others = belief.trust is not None and epoch.snr_db is None
    noise = row_noise(epoch, links, rows, dt, agile_mps2=MANOEUVRE_MPS2 if others else 0.0)
    if not others:
        seen = _accelerated(belief, derivative, len(rows), pushed)
        noise += seen @ seen.T
    if len(pair):
        at = np.arange(len(rows))
        noise[at, at] -= np.where(pair >= 0, epoch.bias_m2[rows], 0.0)
    return noise


def _accelerated(belief: Belief, derivative: Floats, count: int, pushed: int) -> Floats:
    """Return what each row (m, k) changes by as a vehicle's place or angle is accelerated, by one deviation each.

    A row speaks of a vehicle at w, when it was heard, or sent where the vehicle carries the emitter. By then an
    acceleration a has changed the velocity by a w and the place by a w² / 2; the derivative by the velocity holds w
    times that by the place. ``count``: ranges, the first of the rows.
    """
    seen = []
    for vehicle in np.flatnonzero(belief.placed).tolist():
        places = SIZE * vehicle + np.array([0, 1, 2, YAW, ROLL, PITCH])
        by_place, by_velocity = derivative[:count, places[:3]], derivative[:count, places[:3] + 4]
        square = np.sum(by_place**2, axis=1)
        when = np.where(square > 0.0, np.sum(by_place * by_velocity, axis=1) / np.where(square > 0.0, square, 1.0), 0.0)
        when = np.tile(when, len(derivative) // count)[:, None]
        at = places[belief.free[places]]
        rate = at + np.where(at % SIZE < ROLL, 4, 2)
        moves_mps2 = PUSHED_MPS2 if vehicle == pushed else MANOEUVRE_MPS2
        sd = np.where(at % SIZE < YAW, moves_mps2, MANOEUVRE_RADPS2)
        seen.append(sd * when * (derivative[:, rate] - derivative[:, at] * when / 2))
    return np.hstack([np.zeros((len(derivative), 0)), *seen])


def _learn(
    belief: Belief,
    trust: stated.Trust,
    epoch: RangeEpoch,
    asked: tuple[Links, Floats, Floats, NDArray[np.int64]],
    claimed: Floats,
) -> Belief:
    """Learn from what a corrected belief makes of all rows asked, refused ones too; ``claimed`` (n,) in m²."""
    links, dt, measured, pair = asked
    slot = -1 if belief.inputs is None else belief.inputs.range_slot
    shown, derivative = expect(links, belief, belief.mean, dt, epoch, pair)
    square = (measured - shown) ** 2 + np.einsum("ij,ij->i", derivative @ belief.covariance, derivative)
    at = stated.places(slot, pair, len(trust.count) - 1)
    apart = belief.mean[at]
    apart[0] -= apart[0].mean()  # what all pairs share is the common bias's
    errors = apart**2 + belief.covariance[at, at]
    return replace(belief, trust=trust.after(pair, square, claimed, errors))


def expect(
    links: Links, belief: Belief, mean: Floats, dt: Floats, epoch: RangeEpoch, pair: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Return what rows would show at a mean, and its derivative; ranges stated by others with errors of their own."""
    clock, rates = epoch.clock == "common", epoch.range_rate_mps is not None
    shown, derivative = rows_at(links, mean, dt, epoch.sound_speed_mps, clock, rates, not belief.upright)
    if belief.inputs is None or not len(pair):
        return shown, derivative
    if belief.inputs.bias_slot >= 0:
        return paired.show(mean, belief.inputs.bias_slot, pair, shown, derivative)
    return stated.show(mean, belief.inputs.range_slot, pair, len(belief.inputs.pairs), shown, derivative)


def weighed_rows(belief: Belief, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_]) -> float:
    """Log likelihood of the rows asked for, of which any may be an outlier (`stated.STRAY`); of others' ranges.

    Rows are taken for outliers one by one, the most unlikely first, as long as that makes the whole likelier.
    """

    def told(rows: NDArray[np.bool_]) -> float:
        after, used, *_ = update(belief, epoch, links, rows)
        count = np.count_nonzero(used)
        sound = strangeness(belief, epoch, links, used, after.mean) + count * np.log(2 * np.pi) if count else 0.0
        return stated.STRAY * (np.count_nonzero(asked) - count) - 0.5 * float(sound)

    rows, best = asked, told(asked)
    while np.count_nonzero(rows) > 1:
        fewer = [np.where(np.arange(len(rows)) == i, False, rows) for i in np.flatnonzero(rows)]
        each = [told(some) for some in fewer]
        if max(each) <= best:
            break
        best, rows = max(each), fewer[int(np.argmax(each))]
    return best


def strangeness(
    belief: Belief, epoch: RangeEpoch, links: Links, asked: NDArray[np.bool_], about: Floats | None = None
) -> float:
    """Minus twice the log likelihood (but for a constant) of all rows asked for, ranges and rates together.

    Linearised at the mean, or at a state ``about``.
    """
    placed = np.append(belief.placed, True)
    rows = np.flatnonzero(asked & placed[links.emitter_vehicle] & placed[links.receiver_vehicle])
    dt = epoch.time_s[rows] - belief.time_s
    others = belief.trust is not None and epoch.snr_db is None
    pair = pairs_of(belief, epoch, rows)
    mean = belief.mean if about is None else about
    shown, derivative = expect(links.rows(rows), belief, mean, dt, epoch, pair)
    measured = epoch.range_m[rows]
    if epoch.range_rate_mps is not None:
        measured = np.concatenate([measured, epoch.range_rate_mps[rows]])
    noise = noise_of(belief, epoch, links, rows, dt, pair, derivative)
    expected = derivative @ belief.covariance @ derivative.T + noise
    if others and belief.trust is not None:
        expected[np.diag_indices(len(rows))] += belief.trust.extra(pair)
    miss = measured - shown - derivative @ (belief.mean - mean)
    return float(miss @ np.linalg.solve(expected, miss) + np.linalg.slogdet(expected)[1])
