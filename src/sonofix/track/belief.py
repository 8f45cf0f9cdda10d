"""What a filter believes of all vehicles at one instant, and how that ages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import PITCH, POSE, ROLL, SIZE, YAW, from_arm, open_arms, tilting
from sonofix.locate.noise import CLOCK_SPEED_SD
from sonofix.records import Estimate, Fix, Floats, Source
from sonofix.site import Site
from sonofix.track import gyro, paired, stated, steps, wheels
from sonofix.track.anchor import lift
from sonofix.track.arc import bend, open_course
from sonofix.track.held import hold, places
from sonofix.track.inputs import GYRO, STEP, WHEELS, Inputs
from sonofix.track.kernel import stir
from sonofix.track.stated import Trust
from sonofix.track.tilt import open_tilt, rock

SOUND_SPEED_MPS = 343.0
"""Near enough to turn a clock's speed into m/s."""

LOOSE = 0.5
"""Deviation in m and rad with which a place is taken that ranges with errors of their own gave: they speak again at
once."""

PUSHED_S = 1.0
"""A push takes a while: for so long after it was noticed a vehicle's odometry is not heard."""

INSTANT_S = 1e-9
"""Instants that differ by less are one: nothing moves meanwhile."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How freely vehicles move: constant velocity, disturbed by white acceleration.

    ``acceleration_psd`` in m²/s³ per horizontal axis, ``climb_psd`` upwards (vehicles keep to floors), ``turn_psd`` in
    rad²/s³, ``clock_psd`` in m²/s³ of the clock's drift. Roll and pitch of a body that tilts come back upright at
    ``tilt_pace_radps``, the natural frequency of `tilt.rock`.
    """

    acceleration_psd: float = 0.5
    climb_psd: float = 0.01
    turn_psd: float = 0.3
    clock_psd: float = 1e-6
    tilt_pace_radps: float = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Nominal:
    """A track known beforehand, about which a smoother's later passes linearise.

    ``row`` (k, m) is the state just before each row of the inputs, ``now`` (m,) that at the epoch's instant; NaN where
    not known. The m components are those of a belief without copies.
    """

    row: Floats
    now: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Joint Gaussian over all vehicles and the recorder's clock.

    Attributes
    ----------
    time_s : float
    mean : float64 (SIZE V + E + 2,)
        Each vehicle's `geometry.POSE`, the E states that ``inputs`` add, then clock offset (m) and drift (m/s).
    covariance : float64 (SIZE V + E + 2, SIZE V + E + 2)
        Zero rows where a component is known or not estimated.
    free : bool (SIZE V + E + 2,)
        What is estimated.
    placed : bool (V,)
        Vehicles that have a position yet.
    inputs : Inputs or None
        What the vehicles' own sensors tell, past and to come; only what is past enters.
    about : Nominal or None
        Where measurements are linearised; None: at ``mean``.
    tilt_sd_rad : float64 (V,) or None
        How far each vehicle tilts (`geometry.tilting`); None: all stand upright.
    trust : Trust or None
        What has been learnt of ranges that others state; None where ranges are our own.
    rough : float64 (V, 3) or None
        Factors on the noise of each vehicle's odometry that were learnt (`bank`); None: it is as expected.
    heeded : bool
        Whether what sensors tell enters.
    deaf_s : float64 (V,) or None
        Until when each vehicle's odometry does not enter: it was pushed; None: that of all does.
    bends : bool (V,) or None
        Vehicles that drive in arcs: their velocity turns with them (`bend`); None: none do.
    held : int64 (h,) or None
        States that calibrate themselves, but are to stay as they began (`held.places`).

    While it is carried on to be smoothed, copies of earlier states stand before the clock (`chain.copied`), never free.
    """

    time_s: float
    mean: Floats
    covariance: Floats
    free: NDArray[np.bool_]
    placed: NDArray[np.bool_]
    inputs: Inputs | None = None
    about: Nominal | None = None
    tilt_sd_rad: Floats | None = None
    trust: Trust | None = None
    rough: Floats | None = None
    heeded: bool = True
    deaf_s: Floats | None = None
    bends: NDArray[np.bool_] | None = None
    held: NDArray[np.int64] | None = None

    def tilts(self, vehicle: int) -> float:
        """Deviation of a vehicle's roll and pitch as it was before anything was heard; 0: it stands upright."""
        return 0.0 if self.tilt_sd_rad is None else float(self.tilt_sd_rad[vehicle])

    def bent(self, vehicle: int) -> bool:
        """Whether a vehicle drives in arcs."""
        return self.bends is not None and bool(self.bends[vehicle])

    def deaf(self, vehicle: int, time_s: float) -> bool:
        """Whether a vehicle's odometry does not enter at an instant."""
        return self.deaf_s is not None and time_s <= self.deaf_s[vehicle]

    def roughness(self, vehicle: int) -> Floats:
        """Factors (3,) on the noise of a vehicle's odometry."""
        return wheels.AS_EXPECTED if self.rough is None else self.rough[vehicle]

    @property
    def upright(self) -> bool:
        """Whether no vehicle tilts."""
        return self.tilt_sd_rad is None or not self.tilt_sd_rad.any()

    def pose(self) -> Floats:
        """Poses (V, SIZE)."""
        return self.mean[: SIZE * len(self.placed)].reshape(-1, SIZE)

    def near(self, nominal: Floats, mean: Floats) -> Floats:
        """Return where to linearise: a `Nominal` state, its turns counted as ``mean`` counts them, else ``mean``."""
        nominal = nominal.copy()
        for vehicle in range(len(self.placed)):
            at = SIZE * vehicle + POSE.index("yaw")
            off = (mean[at] - nominal[at]) / (2 * np.pi)
            if abs(off) > 0.5:  # never where it is not known
                nominal[at] += 2 * np.pi * round(off)
                if self.inputs is not None and self.inputs.wheel_slot[vehicle] >= 0:
                    nominal[self.inputs.wheel_slot[vehicle] + 2] += 2 * np.pi * round(off)
        out, known = mean.copy(), np.isfinite(nominal)
        out[:-2][: len(nominal) - 2][known[:-2]] = nominal[:-2][known[:-2]]
        out[-2:][known[-2:]] = nominal[-2:][known[-2:]]
        return out


def begin_sensors(inputs: Inputs, covariance: Floats, free: NDArray[np.bool_]) -> None:
    """Open the errors of all vehicles' own sensors, in place, before anything is known of them."""
    for room, slots in ((steps, inputs.step_slot), (wheels, inputs.wheel_slot), (gyro, inputs.gyro_slot)):
        for slot in slots[slots >= 0].tolist():
            room.begin(covariance, free, slot)


def lift_anchors(
    inputs: Inputs | None, vehicle: int, mean: Floats, covariance: Floats, free: NDArray[np.bool_]
) -> None:
    """Take the anchors of a vehicle's own sensors away, in place: they are not known on this track."""
    if inputs is not None:
        lift(mean, covariance, free, int(inputs.step_slot[vehicle]), 2)
        lift(mean, covariance, free, int(inputs.wheel_slot[vehicle]), 3)
        lift(mean, covariance, free, int(inputs.gyro_slot[vehicle]), 1)


def lift_heading(mean: Floats, covariance: Floats, free: NDArray[np.bool_], vehicle: int) -> None:
    """Take a vehicle's heading and how fast it turns away, in place: they are not known on this track."""
    lift(mean, covariance, free, SIZE * vehicle + YAW, 1)
    lift(mean, covariance, free, SIZE * vehicle + YAW + 4, 1)


def blank(site: Site, inputs: Inputs | None = None, held: Iterable[str] = ()) -> Belief:
    """Return the belief before anything was heard; ``held`` are names of `held.CALIBRATIONS`."""
    n = SIZE * len(site.vehicles) + (inputs.size if inputs else 0) + 2
    mean, covariance, free = np.zeros(n), np.zeros((n, n)), np.zeros(n, bool)
    for i, vehicle in enumerate(site.vehicles):
        mean[SIZE * i + 2] = vehicle.z_m or 0.0
    if inputs is not None:
        begin_sensors(inputs, covariance, free)
        if inputs.range_slot >= 0:
            stated.begin(mean, covariance, free, inputs.range_slot, inputs.known_sd_m)
        if inputs.bias_slot >= 0:
            paired.begin(covariance, free, inputs.bias_slot, inputs.known_sd_m)
    trust = stated.trust(len(inputs.pairs)) if inputs is not None and inputs.range_slot >= 0 else None
    placed = np.zeros(len(site.vehicles), bool)
    bends = np.array([vehicle.motion == "constant-turn" for vehicle in site.vehicles], bool)
    kept = places(held, inputs)
    hold(covariance, kept, free)
    tilts = tilting(site)
    return Belief(0.0, mean, covariance, free, placed, inputs, tilt_sd_rad=tilts, trust=trust, bends=bends, held=kept)


@numba.njit(cache=True, error_model="numpy")
def drift(mean, covariance, at, rate, free, density, dt):
    """Let a state age by its rate, in place, with white acceleration of a density; ``free``: it is not sure itself."""
    n = len(mean)
    mean[at] += dt * mean[rate]
    for k in range(n):
        covariance[at, k] += dt * covariance[rate, k]
    for k in range(n):
        covariance[k, at] += dt * covariance[k, rate]
    if free:
        stir(covariance, at, rate, density, dt)
    else:
        covariance[rate, rate] += density * abs(dt)


@numba.njit(cache=True, error_model="numpy")
def age(mean, covariance, free, placed, bends, densities, dt):
    """Move a belief's ``mean`` and ``covariance`` by ``dt``, in place.

    ``densities`` (4,) are those of `Motion`: along a horizontal axis, upwards, of turns, and of the clock's drift;
    ``bends`` (V,) are vehicles that drive in arcs.
    The noise of an integrated pair is that of white acceleration (Bar-Shalom 2001, eq 6.2.2-12).
    """
    n = len(mean)
    for pair in range(4 * len(placed) + 1):
        vehicle, part = pair // 4, pair % 4
        at, rate = SIZE * vehicle + part, SIZE * vehicle + 4 + part
        density = densities[max(part - 1, 0)]
        if pair == 4 * len(placed):
            at, rate, density = n - 2, n - 1, densities[3]
        elif not placed[vehicle]:
            continue
        elif bends[vehicle] and part < 2:
            if part == 0:
                bend(mean, covariance, free, vehicle, density, dt)
            continue
        # a course's rate of turn is free without a heading
        if not free[rate] or not (free[at] or part < 3 or pair == 4 * len(placed)):
            continue
        drift(mean, covariance, at, rate, free[at], density, dt)


def predict(belief: Belief, time_s: float, motion: Motion) -> Belief:
    """Age a belief: positions move with their velocities, uncertainty grows with the white acceleration's integral.

    What sensors told of the motion on the way enters at its own time.
    """
    dt = time_s - belief.time_s
    told = range(0)
    if belief.inputs is not None and belief.heeded:
        told = belief.inputs.within(belief.time_s, time_s)
    if (abs(dt) < INSTANT_S and not told) or not belief.placed.any():
        return replace(belief, time_s=time_s)
    mean, covariance, free = belief.mean.copy(), belief.covariance.copy(), belief.free
    densities = np.array([motion.acceleration_psd, motion.climb_psd, motion.turn_psd, motion.clock_psd])
    bends = np.zeros(len(belief.placed), bool) if belief.bends is None else belief.bends
    inputs, now_s = belief.inputs, belief.time_s
    if inputs is None:
        age(mean, covariance, free, belief.placed, bends, densities, float(dt))
        hold(covariance, belief.held)
        _rock(belief, mean, covariance, motion, float(dt))
        return replace(belief, time_s=time_s, mean=mean, covariance=covariance)
    free = free.copy()
    for row in (*told, None):
        until_s = time_s if row is None else float(inputs.time_s[row])
        age(mean, covariance, free, belief.placed, bends, densities, until_s - now_s)
        _rock(belief, mean, covariance, motion, until_s - now_s)
        for vehicle, (step, wheel) in enumerate(
            zip(inputs.step_slot.tolist(), inputs.wheel_slot.tolist(), strict=True)
        ):
            if step >= 0:
                steps.wander(mean, covariance, vehicle, step, until_s - now_s, bool(belief.placed[vehicle]))
            if wheel >= 0:
                wheels.wander(covariance, wheel, until_s - now_s, belief.roughness(vehicle))
            if inputs.gyro_slot[vehicle] >= 0:
                gyro.wander(covariance, free, vehicle, int(inputs.gyro_slot[vehicle]), until_s - now_s)
        if belief.trust is not None:
            stated.wander(mean, covariance, inputs.range_slot, belief.trust, until_s - now_s)
        hold(covariance, belief.held)
        if row is not None and belief.placed[inputs.vehicle[row]]:
            about = None if belief.about is None else belief.near(belief.about.row[row], mean)
            _sense(mean, covariance, free, belief, row, about)
        now_s = until_s
    return replace(belief, time_s=time_s, mean=mean, covariance=covariance, free=free)


def _rock(belief: Belief, mean: Floats, covariance: Floats, motion: Motion, dt: float) -> None:
    """Age roll and pitch of all vehicles that tilt, in place."""
    for vehicle in range(len(belief.placed)):
        if belief.free[SIZE * vehicle + ROLL]:
            rock(mean, covariance, vehicle, belief.tilts(vehicle), motion.tilt_pace_radps, dt)


def set_out(belief: Belief) -> Belief:
    """Let vehicles that were placed since their last row of odometry move as that row tells."""
    inputs = belief.inputs
    if inputs is None or not belief.heeded:
        return belief
    for vehicle in np.flatnonzero(belief.placed & (inputs.wheel_slot >= 0)).tolist():
        slot, arm = int(inputs.wheel_slot[vehicle]), inputs.arm[vehicle]
        if belief.free[slot] or not belief.free[SIZE * vehicle + YAW] or belief.deaf(vehicle, belief.time_s):
            continue
        row = inputs.holds(vehicle, belief.time_s)
        if row is not None:
            speed, rate = inputs.value[row, 4:6].tolist()
            lone, rough = inputs.lone_wheels(vehicle), belief.roughness(vehicle)
            mean, covariance = belief.mean.copy(), belief.covariance.copy()
            wheels.go_on(mean, covariance, vehicle, slot, (speed, rate), arm, rough, lone)
            belief = replace(belief, mean=mean, covariance=covariance)
    return belief


def _sense(
    mean: Floats, covariance: Floats, free: NDArray[np.bool_], belief: Belief, row: int, about: Floats | None
) -> None:
    """Let one row of a vehicle's sensors enter, in place, at its time, linearised at ``about`` or else at the mean."""
    inputs = belief.inputs
    assert inputs is not None
    vehicle = int(inputs.vehicle[row])
    first, second = inputs.value[row, :2].tolist()
    if inputs.kind[row] == STEP:
        steps.take(mean, covariance, free, vehicle, int(inputs.step_slot[vehicle]), first, second, about)
    elif inputs.kind[row] == WHEELS:
        if belief.deaf(vehicle, float(inputs.time_s[row])):
            return
        slot, arm = int(inputs.wheel_slot[vehicle]), inputs.arm[vehicle]
        lone, rough = inputs.lone_wheels(vehicle), belief.roughness(vehicle)
        wheels.take(mean, covariance, free, vehicle, slot, inputs.value[row], arm, about, rough, lone)
    elif inputs.kind[row] == GYRO:
        gyro.take(mean, covariance, free, vehicle, int(inputs.gyro_slot[vehicle]), first, second)
    else:
        wheels.point(mean, covariance, free, vehicle, first)


def place(belief: Belief, vehicle: int, fix: Fix, arm: Floats, tilt_pace_radps: float = 2.0) -> Belief:
    """Put a vehicle where a fix says, forgetting what was believed of it.

    ``arm`` (2,) is its `geometry.open_arms`: the motion is followed there. Velocities that the fix leaves open start
    at 0 ± 1 m/s, and how fast a body that tilts rocks at what ``tilt_pace_radps`` of `Motion` makes of its tilt.
    """
    if fix.position_m is None or fix.covariance is None:
        raise ValueError(f"a fix of status {fix.status!r} has no position to place vehicle {fix.vehicle} at")
    at = SIZE * vehicle
    names = {name: at + i for i, name in enumerate(POSE)}
    shift, _ = from_arm(arm, np.zeros(3) if fix.velocity_mps is None else fix.velocity_mps)
    begun = unplaced(belief, vehicle)
    mean, covariance, free, placed = begun.mean, begun.covariance, begun.free, begun.placed
    mean[at : at + 3] = fix.position_m - np.append(shift, 0.0)
    if fix.velocity_mps is not None:
        mean[at + 4 : at + 7] = fix.velocity_mps
    mean[at + YAW] = fix.yaw_rad or 0.0
    mean[at + ROLL], mean[at + PITCH] = fix.roll_rad or 0.0, fix.pitch_rad or 0.0
    if "clock" in fix.states:
        names["clock"] = len(mean) - 2
        clock = [len(mean) - 2, len(mean) - 1]
        covariance[clock, :] = covariance[:, clock] = 0.0
        mean[clock] = [fix.clock_offset_m or 0.0, 0.0]
        covariance[-1, -1] = (CLOCK_SPEED_SD * SOUND_SPEED_MPS) ** 2
        free[clock] = True
        hold(covariance, belief.held, free)
    index = [names[state] for state in fix.states]
    covariance[np.ix_(index, index)] = fix.covariance
    free[index] = True
    for i, open_by in ((4, 0), (5, 1), (6, 2), (7, 3)):
        if free[at + open_by] and not free[at + i]:
            free[at + i] = True
            covariance[at + i, at + i] = 1.0
    if belief.bent(vehicle) and not free[at + YAW]:
        open_course(covariance, free, vehicle)
    if free[at + YAW] and belief.tilts(vehicle):
        open_tilt(covariance, free, vehicle, belief.tilts(vehicle), tilt_pace_radps)
    placed[vehicle] = True
    return replace(belief, mean=mean, covariance=covariance, free=free, placed=placed)


def unplaced(belief: Belief, vehicle: int) -> Belief:
    """Return a belief to which a vehicle's place is not known, as before anything was heard of it."""
    own = np.arange(SIZE * vehicle, SIZE * (vehicle + 1))
    mean, covariance, free = belief.mean.copy(), belief.covariance.copy(), belief.free.copy()
    mean[np.delete(own, 2)] = 0.0  # a level that is stated stays
    covariance[own, :] = covariance[:, own] = 0.0
    free[own] = False
    lift_anchors(belief.inputs, vehicle, mean, covariance, free)
    placed = belief.placed.copy()
    placed[vehicle] = False
    return replace(belief, mean=mean, covariance=covariance, free=free, placed=placed)


def loosen(belief: Belief, vehicle: int) -> Belief:
    """Return a belief in which a fix only says where a vehicle's track begins: it knew nothing of lasting errors."""
    covariance, at = belief.covariance.copy(), SIZE * vehicle
    for i in (*range(at, at + YAW + 1), -2):
        covariance[i, i] += LOOSE**2 if belief.free[i] else 0.0
    return replace(belief, covariance=covariance)


def start_at(
    belief: Belief,
    vehicle: int,
    position_m: Floats,
    yaw_rad: float,
    level_known: bool,
    turns: bool,
    tilt_pace_radps: float = 2.0,
) -> Belief:
    """Put a vehicle at a stated start pose, good to 5 cm and 0.1 rad, at rest as far as is known (0 ± 0.5 m/s).

    Its heading is followed where ``turns``: its ends do not all sit on one vertical line.
    """
    at = SIZE * vehicle
    mean, covariance, free = belief.mean.copy(), belief.covariance.copy(), belief.free.copy()
    mean[at : at + 3] = position_m
    mean[at + 3] = yaw_rad
    for i, sd in enumerate((0.05, 0.05, 0.05, 0.1, 0.5, 0.5, 0.5, 0.5)):
        if (level_known and i in (2, 6)) or (not turns and i in (3, 7)):
            continue
        free[at + i] = True
        covariance[at + i, at + i] = sd**2
    if belief.bent(vehicle) and not turns:
        open_course(covariance, free, vehicle)
    if turns and belief.tilts(vehicle):
        open_tilt(covariance, free, vehicle, belief.tilts(vehicle), tilt_pace_radps)
    placed = belief.placed.copy()
    placed[vehicle] = True
    return replace(belief, mean=mean, covariance=covariance, free=free, placed=placed)


def reopen(belief: Belief, vehicle: int, far_m: float) -> Belief:
    """Return a belief in which a vehicle has been pushed: up to about ``far_m`` aside, at any speed up to 1 m/s."""
    covariance, mean, free = belief.covariance.copy(), belief.mean.copy(), belief.free.copy()
    for i, sd in ((0, far_m), (1, far_m), (4, 1.0), (5, 1.0)):
        covariance[SIZE * vehicle + i, SIZE * vehicle + i] += sd**2
    lift_anchors(belief.inputs, vehicle, mean, covariance, free)
    return unheard(replace(belief, mean=mean, covariance=covariance, free=free), vehicle, PUSHED_S)


def unheard(belief: Belief, vehicle: int, silent_s: float) -> Belief:
    """Return a belief into which a vehicle's odometry does not enter for a while."""
    deaf_s = np.full(len(belief.placed), -np.inf) if belief.deaf_s is None else belief.deaf_s.copy()
    deaf_s[vehicle] = belief.time_s + silent_s
    return replace(belief, deaf_s=deaf_s)


def estimate(belief: Belief, site: Site, vehicle: int, source: Source) -> Estimate:
    """Return what is believed of one vehicle."""
    at, n = SIZE * vehicle, len(belief.mean)
    free = belief.free.tolist()
    own = [at + i for i, name in enumerate(POSE) if free[at + i] and not name.endswith("_rate")]
    names = [POSE[i - at] for i in own]
    if free[n - 2]:
        own.append(n - 2)
        names.append("clock")
    pose, index = belief.mean[at : at + SIZE], np.array(own, np.int64)
    covariance = belief.covariance[index[:, None], index]
    shift, sd_m = from_arm(open_arms(site)[vehicle], pose[4:7])
    position = pose[:3].copy()
    position[:2] += shift
    if sd_m:
        covariance[0, 0] += sd_m**2
        covariance[1, 1] += sd_m**2
    return Estimate(
        time_s=belief.time_s,
        vehicle=site.vehicles[vehicle].id,
        states=tuple(names),
        position_m=position,
        velocity_mps=pose[4:7].copy(),
        yaw_rad=_angle(pose[YAW]) if free[at + YAW] else None,
        clock_offset_m=float(belief.mean[n - 2]) if free[n - 2] else None,
        covariance=covariance,
        source=source,
        roll_rad=_angle(pose[ROLL]) if free[at + ROLL] else None,
        pitch_rad=_angle(pose[PITCH]) if free[at + PITCH] else None,
    )


def _angle(angle_rad: float) -> float:
    """Return the same angle between −π and π."""
    return float(np.angle(np.exp(1j * angle_rad)))
