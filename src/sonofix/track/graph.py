"""The same smoothing by a factor graph (gtsam): all knots at once, each measurement robust, by Levenberg-Marquardt.

Knots, what entered and what was refused come from a pass of the filter (`smooth.settle`); the factors are the filter's
own models. Where rows of odometry or steps measure a difference of two poses the graph ties the two knots themselves:
it needs no anchors (Dellaert and Kaess 2017, "Factor Graphs for Robot Perception").
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonofix.geometry import POSE, link
from sonofix.records import Estimate, Floats
from sonofix.track import steps, wheels
from sonofix.track.belief import SIZE, Belief, predict
from sonofix.track.follow import Follower
from sonofix.track.inputs import COMPASS, STEP, WHEELS
from sonofix.track.passage import YAW, Heard, Mark, Passage
from sonofix.track.slip import SLIPPED_M
from sonofix.track.smooth import PASSES, settle, track
from sonofix.track.update import expect, noise_of, pairs_of

FLOOR = 1e-3
"""What any state may stray by from knot to knot, of its own deviation: a graph knows no constants."""

LEAST = 1e-9
"""No state's unit is less."""

BEYOND = 0.001
"""Share of sound measurements that are off by more than where they begin to count less (Huber 1964)."""

REOPENED_MPS = 1.0
"""Deviation of a pushed vehicle's velocity, as `belief.reopen` has it."""

DRIVEN = tuple(POSE.index(name) for name in ("x", "y", "yaw"))
"""What a row of odometry tells of a vehicle by the arc that it ends."""

GOING = tuple(POSE.index(name) for name in ("vx", "vy", "yaw_rate"))
"""What it tells by what holds from there on: of the last row nothing does."""

ITERATIONS = 30

MISSING = "a factor graph needs gtsam: pip install 'sonofix[graph]', or smooth without one"
"""What is said where gtsam is not installed."""


def smooth(
    begin: Callable[[], Follower],
    heard: Sequence[Heard],
    rate_hz: float | None = None,
    passes: int = PASSES,
    on_epoch: Callable[[], None] = lambda: None,
) -> list[tuple[Estimate, ...]]:
    """Smooth a recording by a factor graph; arguments and result are those of `smooth.smooth`.

    Raises
    ------
    ModuleNotFoundError
        If gtsam is not installed.
    ValueError
        If bursts come from a clock of their own (each epoch has another offset), or a gyro tells of turns.
    """
    try:
        import gtsam
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(MISSING, name=error.name) from error
    follower = begin()
    if follower.free_running:
        raise ValueError("a graph needs a clock that goes on from epoch to epoch; use --smooth without --graph here")
    inputs = follower.belief.inputs
    if inputs is not None and np.any(inputs.gyro_slot >= 0):
        raise ValueError("a graph knows nothing of a gyro (imu.csv); use --smooth without --graph here")
    passage = settle(begin, heard, rate_hz, passes, on_epoch, rows=True)
    if not passage.marks:
        return [() for _ in heard]
    problem = Problem(gtsam, passage)
    return track(passage, heard, problem.solve(), rate_hz)


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """One knot in the graph: as the filter had it, where its states stand (anchors are none), and their units.

    A variable of the graph is in units of the smoothed states' deviations: so states as unlike as a clock and a scale
    weigh alike where the graph is solved.
    """

    mark: Mark
    belief: Belief
    index: NDArray[np.int64]
    unit: Floats

    def at(self, *states: int) -> list[int] | None:
        """Where states stand among the node's own; None if one is not estimated."""
        place = {int(state): i for i, state in enumerate(self.index)}
        return [place[s] for s in states] if all(s in place for s in states) else None

    def whole(self, own: Floats) -> Floats:
        """Return the whole state with the node's own."""
        state = self.belief.mean.copy()
        state[self.index] = own * self.unit
        return state

    def by(self, derivative: Floats) -> Floats:
        """Return a derivative by the whole state as one by the node's variable."""
        return np.asfortranarray(derivative[:, self.index] * self.unit)


class Problem:
    """Variables and factors of a passage."""

    def __init__(self, gtsam: Any, passage: Passage) -> None:
        self._gtsam, self._passage = gtsam, passage
        self.graph, self.values, self._zero = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Values()
        inputs = passage.follower.belief.inputs
        anchors: list[int] = []
        if inputs is not None:
            anchors += [s + i for s in inputs.step_slot.tolist() if s >= 0 for i in range(2)]
            anchors += [s + i for s in inputs.wheel_slot.tolist() if s >= 0 for i in range(3)]
        self.nodes: list[Node] = []
        smoothed = [belief for _, belief in passage.back()][::-1]
        for k, (mark, knot, belief) in enumerate(zip(passage.marks, passage.chain.knots, smoothed, strict=True)):
            index = np.setdiff1d(knot.index, anchors)
            unit = np.sqrt(np.maximum(belief.covariance[index, index], LEAST**2))
            node = Node(mark, replace(knot.belief, about=None), index, unit)
            self.nodes.append(node)
            self.values.insert(k, belief.mean[index] / unit)
            self._zero.insert(k, np.zeros(len(node.index)))
        self._begun: dict[tuple[int, int], int] = {}
        self._driven: dict[int, tuple[Floats, Floats | None]] = {}
        self._unseen: dict[int, float] = {}
        self._fresh(0, self.nodes[0].index)
        self._told(0)
        for k in range(1, len(self.nodes)):
            placed = self._move(k)
            self._hear(k, placed)
            self._told(k)

    def solve(self) -> Iterator[tuple[Mark, Belief]]:
        """Return the most likely knots, last first, with their covariances."""
        params = self._gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(ITERATIONS)
        result = self._gtsam.LevenbergMarquardtOptimizer(self.graph, self.values, params).optimize()
        marginals = self._gtsam.Marginals(self.graph, result)
        for k in range(len(self.nodes) - 1, -1, -1):
            node = self.nodes[k]
            if not (node.mark.told or node.mark.ends):
                continue
            covariance = np.zeros_like(node.belief.covariance)
            own = marginals.marginalCovariance(k) * np.outer(node.unit, node.unit)
            covariance[np.ix_(node.index, node.index)] = own
            yield node.mark, replace(node.belief, mean=node.whole(result.atVector(k)), covariance=covariance)

    def _fresh(self, k: int, states: NDArray[np.int64]) -> None:
        """States of a node that nothing ties to the node before: as the filter had them."""
        if not len(states):
            return
        node = self.nodes[k]
        own = node.belief.covariance[np.ix_(states, states)] + self._stray(node, states)
        self._linear({k: np.eye(len(node.belief.mean))[states]}, node.belief.mean[states], own)

    def _stray(self, node: Node, states: NDArray[np.int64]) -> Floats:
        """Return what states of a node may stray by."""
        return np.diag((FLOOR * node.unit[np.searchsorted(node.index, states)]) ** 2)

    def _linear(self, parts: dict[int, Floats], value: Floats, covariance: Floats) -> None:
        """Add what is linear: the sum of matrices times nodes' whole states is ``value``, with this covariance."""
        half = np.linalg.cholesky((covariance + covariance.T) / 2)
        terms = [term for k, part in parts.items() for term in (k, self.nodes[k].by(np.linalg.solve(half, part)))]
        one = self._gtsam.noiseModel.Unit.Create(len(value))
        factor = self._gtsam.JacobianFactor(*terms, np.linalg.solve(half, value), one)
        self.graph.add(self._gtsam.LinearContainerFactor(factor, self._zero))

    def _move(self, k: int) -> NDArray[np.bool_]:
        """Tie a node to the one before by the motion; return the vehicles that were placed there, by ranges or anew."""
        before, node = self.nodes[k - 1], self.nodes[k]
        step, shift, noise = _transition(self._passage, before.belief, node.belief.time_s)
        names = [vehicle.id for vehicle in self._passage.follower.site.vehicles]
        anew = ~before.belief.placed & node.belief.placed
        for event in node.mark.entered.events if node.mark.entered is not None else ():
            if event.event not in ("slip", "reset"):
                continue
            who = names.index(event.vehicle)
            self._begun = {key: at for key, at in self._begun.items() if key[1] != who}
            if event.event == "reset":
                anew[who] = True
                continue
            for name, sd in (("x", SLIPPED_M), ("y", SLIPPED_M), ("vx", REOPENED_MPS), ("vy", REOPENED_MPS)):
                at = SIZE * who + POSE.index(name)
                noise[at, at] += sd**2
        for who, sd in self._unseen.items():
            noise[SIZE * who + YAW, SIZE * who + YAW] += sd**2
        self._unseen = {}
        pose = np.repeat(anew, SIZE)
        cut = np.zeros(len(node.belief.mean), bool)
        cut[: len(pose)] = pose
        self._driven = self._believed(k, anew)
        driven = [
            SIZE * who + i
            for who, (told, noise_of_arc) in self._driven.items()
            for i in (*(() if noise_of_arc is None else DRIVEN), *(GOING if np.isfinite(told[4:]).all() else ()))
        ]
        kept = np.array([s for s in node.index if s in set(before.index.tolist()) and not cut[s]], np.int64)
        kept = np.setdiff1d(kept, driven)
        self._fresh(k, np.setdiff1d(np.setdiff1d(node.index, kept), driven))
        if len(kept):
            known = np.setdiff1d(np.arange(len(step)), before.index)
            constant = step[np.ix_(kept, known)] @ before.belief.mean[known] + shift[kept]
            own = noise[np.ix_(kept, kept)] + self._stray(node, kept)
            self._linear({k - 1: -step[kept], k: np.eye(len(step))[kept]}, constant, own)
        return anew

    def _robust(self, covariance: Floats) -> Any:
        from scipy.stats import chi2

        model, m = self._gtsam.noiseModel, len(covariance)
        bend = model.mEstimator.Huber.Create(float(np.sqrt(chi2.ppf(1 - BEYOND, m))))
        return model.Robust.Create(bend, model.Gaussian.Covariance(covariance))

    def _hear(self, k: int, anew: NDArray[np.bool_]) -> None:
        """Let the ranges of a node's epoch enter that entered the filter; those that placed a vehicle had their say."""
        node = self.nodes[k]
        if node.mark.entered is None:
            return
        epoch = node.mark.entered.ranges
        links = link(self._passage.follower.site, epoch.emitter, epoch.receiver)
        placing = np.append(anew, False)
        used = node.mark.entered.used & ~placing[links.emitter_vehicle] & ~placing[links.receiver_vehicle]
        rows = np.flatnonzero(used)
        if not len(rows):
            return
        dt = epoch.time_s[rows] - node.belief.time_s
        measured = epoch.range_m[rows]
        if epoch.range_rate_mps is not None:
            measured = np.concatenate([measured, epoch.range_rate_mps[rows]])
        pair = pairs_of(node.belief, epoch, rows)
        whole, links = links, links.rows(rows)
        derivative = expect(links, node.belief, node.belief.mean, dt, epoch, pair)[1]
        noise = noise_of(node.belief, epoch, whole, rows, dt, pair, derivative)
        if node.belief.trust is not None and epoch.snr_db is None:
            noise[np.diag_indices(len(rows))] += node.belief.trust.extra(pair)

        def miss(_factor: Any, values: Any, jacobians: Any) -> Floats:
            shown, derivative = expect(links, node.belief, node.whole(values.atVector(k)), dt, epoch, pair)
            if jacobians is not None:
                jacobians[0] = node.by(derivative)
            return shown - measured

        self.graph.add(self._gtsam.CustomFactor(self._robust(noise), [k], miss))

    def _told(self, k: int) -> None:
        """Let rows of the inputs enter that stand just after a node."""
        node, inputs = self.nodes[k], self._passage.follower.belief.inputs
        if inputs is None:
            return
        if not node.belief.heeded:
            self._begun.clear()  # sensors that ranges gainsay are not heard
            return
        for row in node.mark.rows:
            kind, who = int(inputs.kind[row]), int(inputs.vehicle[row])
            first, second, _, fourth = inputs.value[row, :4].tolist()
            if kind == COMPASS:
                self._point(k, who, first)
                continue
            begun = self._begun.get((kind, who))
            self._begun[kind, who] = k
            if kind == STEP:
                if begun is not None and np.isfinite(first) and np.isfinite(second):
                    self._chord(k, begun, who, first, second)
                continue
            if who in self._driven:
                self._drive(k, begun, who, *self._driven[who])
            if fourth > 0:
                # what turns unseen does so after this knot: no arc begins here
                self._unseen[who] = fourth
                del self._begun[kind, who]

    def _point(self, k: int, who: int, heading_rad: float) -> None:
        node, at = self.nodes[k], SIZE * who + YAW
        if node.at(at) is None or not np.isfinite(heading_rad):
            return
        derivative = np.eye(len(node.belief.mean))[[at]]
        model = self._gtsam.noiseModel
        one = model.Isotropic.Sigma(1, wheels.COMPASS_SD_RAD)
        noise = model.Robust.Create(model.mEstimator.Huber.Create(wheels.ROBUST), one)

        def miss(_factor: Any, values: Any, jacobians: Any) -> Floats:
            if jacobians is not None:
                jacobians[0] = node.by(derivative)
            return np.angle(np.exp(1j * (node.whole(values.atVector(k))[[at]] - heading_rad)))

        self.graph.add(self._gtsam.CustomFactor(noise, [k], miss))

    def _chord(self, k: int, begun: int, who: int, length_m: float, heading_rad: float) -> None:
        inputs = self._passage.follower.belief.inputs
        assert inputs is not None
        slot = int(inputs.step_slot[who])

        def measure(state: Floats) -> tuple[Floats, Floats, Floats]:
            return steps.measure(state, who, slot, length_m, heading_rad)

        difference = k, begun, (SIZE * who, SIZE * who + 1), (slot, slot + 1), measure
        noise = self._noise(*difference)
        if noise is not None:
            self._difference(*difference, noise)

    def _believed(self, k: int, anew: NDArray[np.bool_]) -> dict[int, tuple[Floats, Floats | None]]:
        """Return what odometry tells by a node of vehicles that it carries, with the noise of its arc, if any.

        As in the filter, nothing else ties such a vehicle to the node before.
        """
        node, inputs = self.nodes[k], self._passage.follower.belief.inputs
        driven: dict[int, tuple[Floats, Floats | None]] = {}
        for row in node.mark.rows if inputs is not None and node.belief.heeded else ():
            assert inputs is not None
            who, told = int(inputs.vehicle[row]), inputs.value[row]
            begun, at = self._begun.get((WHEELS, who)), SIZE * who
            if inputs.kind[row] != WHEELS or anew[who]:
                continue
            if node.belief.deaf(who, float(inputs.time_s[row])):
                continue
            pose = (at, at + 1, at + YAW)
            if node.at(*pose) is None:
                continue
            if begun is None:
                driven[who] = told, None
                continue
            if not np.isfinite(told[:4]).all() or not 0.0 < told[2] <= wheels.LONGEST_S:
                continue
            slot = int(inputs.wheel_slot[who])
            noise = self._noise(k, begun, pose, (slot, slot + 1, slot + 2), self._arc(k, who, told))
            if noise is not None:
                driven[who] = told, noise
        return driven

    def _arc(self, k: int, who: int, told: Floats) -> Callable[[Floats], tuple[Floats, Floats, Floats]]:
        """Return what measures an arc that leads to a node."""
        inputs, rough = self._passage.follower.belief.inputs, self.nodes[k].belief.roughness(who)
        assert inputs is not None
        slot, arm, (way, turn, dt) = int(inputs.wheel_slot[who]), inputs.arm[who], told[:3].tolist()
        return lambda state: wheels.measure(state, who, slot, (way, turn, dt), arm, rough)

    def _drive(self, k: int, begun: int | None, who: int, told: Floats, noise: Floats | None) -> None:
        """Let an arc lead to a node, and what is told next say how it goes on from there."""
        inputs, node, at = self._passage.follower.belief.inputs, self.nodes[k], SIZE * who
        assert inputs is not None
        slot, arm, rough = int(inputs.wheel_slot[who]), inputs.arm[who], node.belief.roughness(who)
        speed, rate = told[4:].tolist()

        def miss(_factor: Any, values: Any, jacobians: Any) -> Floats:
            off, derivative, _ = wheels.going(node.whole(values.atVector(k)), who, slot, (speed, rate), arm, rough)
            if jacobians is not None:
                jacobians[0] = node.by(derivative)
            return -off

        pose, anchor = (at, at + 1, at + YAW), (slot, slot + 1, slot + 2)
        if begun is not None and noise is not None:
            self._difference(k, begun, pose, anchor, self._arc(k, who, told), noise)
        if not np.isfinite(told[4:]).all():
            return
        uneven = wheels.going(node.whole(self.values.atVector(k)), who, slot, (speed, rate), arm, rough)[2]
        self.graph.add(self._gtsam.CustomFactor(self._robust(uneven), [k], miss))

    def _noise(
        self,
        k: int,
        begun: int,
        pose: tuple[int, ...],
        anchor: tuple[int, ...],
        measure: Callable[[Floats], tuple[Floats, Floats, Floats]],
    ) -> Floats | None:
        """Return the noise of a `_difference`; None where it cannot be, and is left out, as the filter does.

        So a push goes on after the epoch that told of it.
        """
        node, start = self.nodes[k], self.nodes[begun]
        own = start.at(*pose)
        if own is None:
            return None
        state = node.whole(self.values.atVector(k))
        state[list(anchor)] = start.whole(self.values.atVector(begun))[list(pose)]
        off, derivative, noise = measure(state)
        # just before a row nothing but ranges and free motion may tell of a node
        doubt = np.zeros(len(state))
        doubt[node.index] = node.unit**2
        doubt[list(anchor)] = start.unit[own] ** 2
        expected = (derivative * doubt) @ derivative.T + noise
        return noise if off @ np.linalg.solve(expected, off) <= wheels.UNLIKELY else None

    def _difference(
        self,
        k: int,
        begun: int,
        pose: tuple[int, ...],
        anchor: tuple[int, ...],
        measure: Callable[[Floats], tuple[Floats, Floats, Floats]],
        noise: Floats,
    ) -> None:
        """Add a measurement of a node and of the pose at an earlier one, which takes the anchor's place."""
        node, start = self.nodes[k], self.nodes[begun]

        def miss(_factor: Any, values: Any, jacobians: Any) -> Floats:
            state = node.whole(values.atVector(k))
            state[list(anchor)] = start.whole(values.atVector(begun))[list(pose)]
            off, derivative, _ = measure(state)
            if jacobians is not None:
                earlier = np.zeros_like(derivative)
                earlier[:, list(pose)] = derivative[:, list(anchor)]
                jacobians[0], jacobians[1] = node.by(derivative), start.by(earlier)
            return -off

        self.graph.add(self._gtsam.CustomFactor(self._robust(noise), [k, begun], miss))


def _transition(passage: Passage, belief: Belief, until_s: float) -> tuple[Floats, Floats, Floats]:
    """Return how a belief's states move until an instant, sensors aside.

    That is ``step`` (n, n) times the states, linearised at their mean, plus ``shift`` (n,), and the noise's covariance.
    `predict` acts on rows of a covariance as it does on states: given the identity beside nothing, it leaves the matrix
    in its place, and the noise.
    """
    n, inputs = len(belief.mean), belief.inputs
    if inputs is not None:
        none = np.zeros(0, np.int64)
        inputs = replace(inputs, time_s=np.zeros(0), kind=none, vehicle=none, value=np.zeros((0, 6)))
    covariance = np.zeros((2 * n, 2 * n))
    own, copy = np.r_[0 : n - 2, 2 * n - 2 : 2 * n], np.arange(n - 2, 2 * n - 2)
    covariance[own, copy] = covariance[copy, own] = 1.0
    free = np.zeros(2 * n, bool)
    free[own] = belief.free
    mean = np.zeros(2 * n)
    mean[own] = belief.mean
    carried = replace(belief, mean=mean, covariance=covariance, free=free, inputs=inputs)
    after = predict(carried, until_s, passage.follower.motion)
    step = after.covariance[np.ix_(own, copy)]
    return step, after.mean[own] - step @ belief.mean, after.covariance[np.ix_(own, own)]
