"""One predict and update by filterpy and by Stone Soup, of the very same numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from stonesoup.base import Property
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.models.transition.base import TransitionModel
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.types.array import CovarianceMatrix, StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import ExtendedKalmanUpdater

from sonofix.records import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Wheels:
    """x, y, yaw moved by ``way_m`` and ``turn_rad`` of odometry, a chord; ``noise`` (3, 3) is added."""

    way_m: float
    turn_rad: float
    noise: Floats

    def moved(self, state: Floats) -> tuple[Floats, Floats]:
        """Return the state afterwards, and its derivative."""
        middle = state[2] + self.turn_rad / 2
        cos, sin = np.cos(middle), np.sin(middle)
        derivative = np.eye(3)
        derivative[0, 2], derivative[1, 2] = -self.way_m * sin, self.way_m * cos
        return state + np.array([self.way_m * cos, self.way_m * sin, self.turn_rad]), derivative


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """x, y, z and their velocities for ``dt_s``; white acceleration of ``density`` (3,), m²/s³.

    The noise is that of Bar-Shalom 2001, eq 6.2.2-12.
    """

    dt_s: float
    density: Floats

    @property
    def noise(self) -> Floats:
        dt, density = self.dt_s, np.diag(self.density)
        return np.block([[density * dt**3 / 3, density * dt**2 / 2], [density * dt**2 / 2, density * dt]])

    def moved(self, state: Floats) -> tuple[Floats, Floats]:
        """Return the state afterwards, and its derivative."""
        derivative = np.eye(6)
        derivative[:3, 3:] = self.dt_s * np.eye(3)
        return derivative @ state, derivative


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """State (n,) with its covariance before, motion, and ranges (m,) from ``anchors_m`` (m, 3) with their deviations.

    With `Wheels` the vehicle is at height 0.
    """

    state: Floats
    covariance: Floats
    motion: Wheels | Linear
    anchors_m: Floats
    range_m: Floats
    range_sd_m: Floats

    def shown(self, state: Floats) -> tuple[Floats, Floats]:
        """Return the ranges (m,) that a state shows, and their derivative (m, n)."""
        axes = 2 if isinstance(self.motion, Wheels) else 3
        away = -self.anchors_m
        away[:, :axes] += state[:axes]
        distance = np.sqrt(np.sum(away**2, axis=1))
        derivative = np.zeros((len(distance), len(state)))
        derivative[:, :axes] = away[:, :axes] / distance[:, None]
        return distance, derivative


class _Driven(ExtendedKalmanFilter):
    """filterpy asks for this method where the motion is not linear."""

    motion: Wheels

    def predict_x(self, u: float = 0) -> None:
        self.x, self.F = self.motion.moved(self.x)


def filterpy_step(task: Task) -> Callable[[], tuple[Floats, Floats]]:
    """Return a step that begins at the same state each time."""
    if isinstance(task.motion, Wheels):
        ekf = _Driven(len(task.state), len(task.range_m))
        ekf.motion = task.motion
    else:
        ekf = ExtendedKalmanFilter(len(task.state), len(task.range_m))
        ekf.F = task.motion.moved(task.state)[1]
    ekf.Q, ekf.R = task.motion.noise, np.diag(task.range_sd_m**2)

    def step() -> tuple[Floats, Floats]:
        ekf.x, ekf.P = task.state, task.covariance
        ekf.predict()
        ekf.update(task.range_m, lambda x: task.shown(x)[1], lambda x: task.shown(x)[0])
        return ekf.x, ekf.P

    return step


class _Moves(TransitionModel):
    """Stone Soup's side of a task's motion."""

    task: Task = Property()

    @property
    def ndim_state(self) -> int:
        return len(self.task.state)

    def function(self, state, noise=False, **_):
        return StateVector(self.task.motion.moved(np.asarray(state.state_vector, float)[:, 0])[0])

    def jacobian(self, state, **_):
        return self.task.motion.moved(np.asarray(state.state_vector, float)[:, 0])[1]

    def covar(self, **_):
        return CovarianceMatrix(self.noise)

    def rvs(self, *_, **__):
        raise NotImplementedError("nothing is drawn here")

    def pdf(self, *_, **__):
        raise NotImplementedError("nothing is weighed here")

    noise: np.ndarray = Property()


class _Shows(NonLinearGaussianMeasurement):
    """Stone Soup's side of a task's ranges."""

    task: Task = Property()

    @property
    def ndim_meas(self) -> int:
        return len(self.task.range_m)

    def function(self, state, noise=False, **_):
        return StateVector(self.task.shown(np.asarray(state.state_vector, float)[:, 0])[0])

    def jacobian(self, state, **_):
        return self.task.shown(np.asarray(state.state_vector, float)[:, 0])[1]


def stonesoup_step(task: Task) -> Callable[[], tuple[Floats, Floats]]:
    """Return a step that begins at the same state each time."""
    begin = datetime(2000, 1, 1)
    end = begin + timedelta(seconds=0.1)
    n = len(task.state)
    shows = _Shows(
        ndim_state=n, mapping=tuple(range(n)), noise_covar=CovarianceMatrix(np.diag(task.range_sd_m**2)), task=task
    )
    predictor = ExtendedKalmanPredictor(_Moves(task=task, noise=task.motion.noise))
    updater = ExtendedKalmanUpdater(shows, use_joseph_cov=True)
    prior = GaussianState(StateVector(task.state), CovarianceMatrix(task.covariance), timestamp=begin)
    heard = Detection(StateVector(task.range_m), timestamp=end, measurement_model=shows)

    def step() -> tuple[Floats, Floats]:
        predicted = predictor.predict(prior, timestamp=end)
        after = updater.update(SingleHypothesis(predicted, heard))
        return np.asarray(after.state_vector, float)[:, 0], np.asarray(after.covar, float)

    return step
