"""Positions that others computed, loosely coupled: each corrects where its vehicle is, as far as it is believed.

What they were made of is not known here: a fix that is wrong is refused as a whole, and none of it helps where it lacks
one range (docs/track.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sonofix.geometry import POSE, SIZE, YAW
from sonofix.records import Fix
from sonofix.track.belief import Belief, Motion, place, predict
from sonofix.track.kernel import joseph
from sonofix.track.rival import bare
from sonofix.track.scatter import ROOM_M
from sonofix.track.spreads import Spreads

UNLIKELY = 4.0
"""Distance of a position from the track, in deviations, beyond which it is not believed: noise alone comes
there three times in ten thousand, and one that is left out costs little."""

SPEED_SD_MPS = 3.0
"""Of a vehicle that positions have just placed, each axis, where its site states no ``max_speed_mps``."""

JUMPS = float(np.log(1e-3))
"""Logarithm of how likely it is that a position far off is no outlier: the vehicle is there at once."""

DECIDED = 7.0
"""Difference of log likelihoods at which one of two places is dropped: odds of a thousand to one."""

DOUBTED = 2.0
"""Distance of a first position from a stated start, in deviations, beyond which the two contest."""

AROUND = 2.0 * np.pi * float(np.log(1e3))
"""Of a density that is the same for each logarithm of a distance between 0.1 and 100 m: that times its square."""

AGREEING = 3
"""Positions that another place takes at least: an outlier may come twice."""

TRIED = 10
"""Positions after which a place that has not won is dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """What a position did: the belief and what is known of noise after it, and how it lay.

    ``told`` is the logarithm of how likely the position was before, over that of one that may be anything; ``free`` the
    same to the members of `Spreads`. ``led``: the vehicle's own sensors lead it. ``off`` is by how many deviations and
    ``off_m`` by how many metres it is off.
    """

    belief: Belief
    scatter: Spreads
    told: float
    free: float
    led: bool
    off: float
    off_m: float
    rows: int
    """Coordinates that it told."""

    @property
    def believed(self) -> bool:
        """Whether it entered."""
        return self.off <= UNLIKELY


def take(belief: Belief, scatter: Spreads, vehicle: int, fix: Fix) -> Taken:
    """Learn from a fix of that instant how far such fixes err, and correct where a vehicle is by it, if it is believed.

    The track follows the vehicle's origin, of which a fix tells.
    """
    assert fix.position_m is not None
    assert fix.covariance is not None
    at, n = SIZE * vehicle, len(belief.mean)
    own = [i for i, name in enumerate("xyz") if name in fix.states and belief.free[at + i]]
    miss = (fix.position_m - belief.mean[at : at + 3])[own]
    derivative, axes = np.eye(n)[[at + i for i in own]], ["xyz"[i] for i in own]
    crossed = derivative @ belief.covariance
    spread = crossed @ derivative.T
    # a miss that swells the noise may not by that be believed
    noise = scatter.noise(fix, axes)
    off = float(np.sqrt(miss @ np.linalg.solve(spread + noise, miss)))
    off_m = float(np.linalg.norm(miss))
    judged, told = scatter.judged(miss, spread, fix, axes)
    if scatter.begins:  # it was placed by its stated start
        scatter, free = scatter.begun(belief.time_s, fix, SPEED_SD_MPS), told
    else:
        scatter, free = scatter.taken(belief.time_s, fix)
    leads = led(belief, vehicle)
    scatter = scatter.led(judged if leads else None)
    if off <= UNLIKELY:
        noise = scatter.noise(fix, axes)
        gain = np.linalg.solve(spread + noise, crossed).T
        covariance = joseph(belief.covariance, gain, derivative, noise)
        belief = replace(belief, mean=belief.mean + gain @ miss, covariance=covariance)
    return Taken(belief, scatter, told, free, leads, off, off_m, len(axes))


def led(belief: Belief, vehicle: int) -> bool:
    """Whether wheels or steps lead a vehicle from position to position."""
    inputs = belief.inputs
    if inputs is None or not belief.heeded:
        return False
    # wheels lead along a heading
    headed = inputs.wheel_slot[vehicle] >= 0 and bool(belief.free[SIZE * vehicle + YAW])
    headed = headed and not belief.deaf(vehicle, belief.time_s)
    step = int(inputs.step_slot[vehicle])
    return bool(headed or (step >= 0 and belief.free[step]))


def put(belief: Belief, scatter: Spreads, vehicle: int, fix: Fix, speed_sd_mps: float) -> tuple[Belief, Spreads]:
    """Put a vehicle where a fix says, moving anyhow, and forget what was believed of it."""
    assert fix.position_m is not None
    assert fix.covariance is not None
    wider = replace(fix, covariance=scatter.noise(fix, fix.states))
    belief = place(belief, vehicle, wider, np.zeros(2))
    covariance, at = belief.covariance.copy(), SIZE * vehicle + 4
    covariance[at, at] = covariance[at + 1, at + 1] = speed_sd_mps**2
    scatter = scatter.begun(belief.time_s, fix, speed_sd_mps)
    return replace(belief, covariance=covariance), scatter


@dataclass(frozen=True, slots=True, eq=False)
class Elsewhere:
    """Another place that positions put a vehicle, by themselves: what a track believes that hears no sensor.

    ``ahead`` is by how much it is likelier than the track, of ``count`` positions; ``follows``: it took the last one.
    """

    belief: Belief
    scatter: Spreads
    ahead: float
    count: int = 1
    follows: bool = True

    @classmethod
    def begun(cls, track: Taken, known: Spreads, vehicle: int, fix: Fix, speed_sd_mps: float) -> Elsewhere:
        """Begin where a fix puts a vehicle; ``known`` is how such fixes erred before.

        The track did not take it, or this is the first one after a stated start. That is wrong as often as a fix is,
        and then by centimetres as likely as by tens of metres: the logarithm of how far has no size of its own.
        """
        begun = put(bare(replace(track.belief, heeded=False)), known, vehicle, fix, speed_sd_mps)
        why = JUMPS if not known.begins else track.rows * np.log(ROOM_M / track.off_m) - np.log(AROUND)
        return cls(*begun, float(why) - track.told)

    def taken(self, track: Taken, vehicle: int, fix: Fix, motion: Motion) -> Elsewhere:
        """Follow a fix that was shown to the track, too."""
        taken = take(predict(self.belief, track.belief.time_s, motion), self.scatter, vehicle, fix)
        ahead = self.ahead + taken.told - track.told
        return Elsewhere(taken.belief, taken.scatter, ahead, self.count + 1, taken.believed)

    @property
    def won(self) -> bool:
        """Whether it is likelier beyond doubt."""
        return self.ahead > DECIDED and self.count >= AGREEING

    @property
    def lost(self) -> bool:
        """Whether it is less likely beyond doubt, lies elsewhere itself, or has had its time."""
        return self.ahead < -DECIDED or not self.follows or self.count >= TRIED

    def fix(self, vehicle: int, like: Fix) -> Fix:
        """Return what it says of a vehicle's place and velocity, as a fix."""
        at = SIZE * vehicle
        own = [at + i for i, name in enumerate(POSE[:7]) if name[-1] in "xyz" and name[-1] in like.states]
        pose = self.belief.mean[at:]
        return replace(
            like,
            states=tuple(POSE[i - at] for i in own),
            position_m=pose[:3].copy(),
            velocity_mps=pose[4:7].copy(),
            covariance=self.belief.covariance[np.ix_(own, own)],
        )


def freely(scatter: Spreads, like: Fix) -> Fix:
    """Return what the members of `Spreads` say of a vehicle's place and velocity, as a fix."""
    assert like.position_m is not None
    (place_m, velocity_mps), level = scatter.level.mixed()
    place_m, velocity_mps = np.append(place_m, like.position_m[2]), np.append(velocity_mps, 0.0)
    covariance, states = level, ("x", "y", "vx", "vy")
    if "z" in like.states:
        upwards, height = scatter.height.mixed()
        place_m[2], velocity_mps[2] = upwards.ravel()
        covariance, states = np.zeros((6, 6)), (*states, "z", "vz")
        covariance[:4, :4], covariance[4:, 4:] = level, height
    return replace(like, states=states, position_m=place_m, velocity_mps=velocity_mps, covariance=covariance)
