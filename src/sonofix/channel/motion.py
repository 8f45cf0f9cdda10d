"""How a vehicle moves: pose and velocity of its origin at any time, in closed form.

Every motion answers `at(time_s)` for any times, also before the recording begins: sound heard at its first sample
was sent earlier. Positions are continuous and, but for the ends of a `Sampled` motion, so are velocities. Yaw follows
the direction of travel unless given.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from sonofix.records import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of a vehicle's origin, a row an instant.

    Attributes
    ----------
    position_m, velocity_mps : float64 (n, 3)
        East-north-up.
    yaw_rad : float64 (n,)
        Counter-clockwise from east, unwrapped.
    roll_rad, pitch_rad : float64 (n,) or None
        As `attitude` has them, unwrapped; None: upright.
    """

    position_m: Floats
    velocity_mps: Floats
    yaw_rad: Floats
    roll_rad: Floats | None = None
    pitch_rad: Floats | None = None


class Motion(Protocol):
    """Anything that knows its poses: `at(time_s (n,)) -> Poses`, seconds on the recorder's clock."""

    def at(self, time_s: Floats) -> Poses:
        """Return the poses at ``time_s`` (n,)."""
        ...


def _triple(name: str, value: tuple[float, ...]) -> Floats:
    point = np.asarray(value, dtype=np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"{name} = {value}; three finite numbers (x, y, z) are needed")
    return point


@dataclass(frozen=True, slots=True)
class Still:
    """Stands at ``position_m`` (x, y, z), turned by ``yaw_rad``."""

    position_m: tuple[float, float, float]
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        """Check the position."""
        _triple("position_m", self.position_m)

    def at(self, time_s: Floats) -> Poses:
        """Return the poses at ``time_s`` (n,)."""
        count = len(time_s)
        return Poses(
            np.tile(np.asarray(self.position_m, float), (count, 1)),
            np.zeros((count, 3)),
            np.full(count, float(self.yaw_rad)),
        )


@dataclass(frozen=True, slots=True)
class Line:
    """Straight and steady: at ``start_m`` (x, y, z) at time 0, with ``velocity_mps`` (x, y, z) always.

    ``yaw_rad`` None: along the velocity (0 where that has no horizontal part).
    """

    start_m: tuple[float, float, float]
    velocity_mps: tuple[float, float, float]
    yaw_rad: float | None = None

    def __post_init__(self) -> None:
        """Check start and velocity."""
        _triple("start_m", self.start_m)
        _triple("velocity_mps", self.velocity_mps)

    def at(self, time_s: Floats) -> Poses:
        """Return the poses at ``time_s`` (n,)."""
        start, velocity = np.asarray(self.start_m, float), np.asarray(self.velocity_mps, float)
        yaw = float(np.arctan2(velocity[1], velocity[0])) if self.yaw_rad is None else self.yaw_rad
        return Poses(
            start + np.asarray(time_s)[:, None] * velocity,
            np.tile(velocity, (len(time_s), 1)),
            np.full(len(time_s), float(yaw)),
        )


@dataclass(frozen=True, slots=True)
class Circle:
    """Round ``centre_m`` (x, y, z) at constant speed, level.

    ``speed_mps`` > 0 runs counter-clockwise. At time 0 the vehicle stands at ``phase_rad``, seen from the centre.
    ``yaw_rad`` None: along the tangent.
    """

    centre_m: tuple[float, float, float]
    radius_m: float
    speed_mps: float
    phase_rad: float = 0.0
    yaw_rad: float | None = None

    def __post_init__(self) -> None:
        """Check centre and radius."""
        _triple("centre_m", self.centre_m)
        if not self.radius_m > 0:
            raise ValueError(f"radius_m = {self.radius_m}; a circle needs a radius above 0 m (else use Still)")

    def at(self, time_s: Floats) -> Poses:
        """Return the poses at ``time_s`` (n,)."""
        angle = self.phase_rad + np.asarray(time_s, float) * (self.speed_mps / self.radius_m)
        outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        tangent = np.stack([-np.sin(angle), np.cos(angle), np.zeros_like(angle)], axis=1)
        along = angle + (np.pi / 2 if self.speed_mps >= 0 else -np.pi / 2)
        yaw = along if self.yaw_rad is None else np.full(len(angle), float(self.yaw_rad))
        return Poses(np.asarray(self.centre_m, float) + self.radius_m * outward, self.speed_mps * tangent, yaw)


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """Through given poses, for instance the rows of a truth file.

    Attributes
    ----------
    time_s : float64 (n,)
        Strictly increasing, n ≥ 2. The vehicle stands before the first row and after the last.
    position_m : float64 (n, 3)
    yaw_rad : float64 (n,) or None
        None: along the direction of travel at each row; where the vehicle stands, as before.
    roll_rad, pitch_rad : float64 (n,) or None
        None: upright.
    interpolation : "cubic" or "linear"
        "cubic" is a Hermite curve with three-point slopes: C1, and third-order in the rows' spacing. "linear" has
        velocities that jump at every row.
    """

    time_s: Floats
    position_m: Floats
    yaw_rad: Floats | None = None
    interpolation: Literal["cubic", "linear"] = "cubic"
    roll_rad: Floats | None = None
    pitch_rad: Floats | None = None
    _values: Floats = field(init=False, repr=False)  # (n, 6): position and unwrapped yaw, roll, pitch at the rows
    _slopes: Floats = field(init=False, repr=False)  # (n, 6): their three-point derivatives

    def __post_init__(self) -> None:
        """Check shapes, finiteness and order; lay the curve.

        Raises
        ------
        ValueError
            Naming the field, and the row where times do not increase.
        """
        n = len(self.time_s)
        if n < 2:
            raise ValueError(f"time_s has {n} rows; a sampled motion needs at least 2 (else use Still)")
        if np.shape(self.position_m) != (n, 3):
            raise ValueError(f"position_m has shape {np.shape(self.position_m)}; ({n}, 3) would fit time_s")
        for name in ("yaw_rad", "roll_rad", "pitch_rad"):
            angle = getattr(self, name)
            if angle is not None and np.shape(angle) != (n,):
                raise ValueError(f"{name} has shape {np.shape(angle)}; ({n},) would fit time_s")
        if not (np.isfinite(self.time_s).all() and np.isfinite(self.position_m).all()):
            raise ValueError("time_s and position_m must be finite in every row")
        for name in ("yaw_rad", "roll_rad", "pitch_rad"):
            angle = getattr(self, name)
            if angle is not None and not np.isfinite(angle).all():
                raise ValueError(f"{name} must be finite in every row, or None")
        backwards = np.flatnonzero(np.diff(self.time_s) <= 0)
        if backwards.size:
            row = int(backwards[0])
            raise ValueError(
                f"time_s goes from {self.time_s[row]:g} to {self.time_s[row + 1]:g} s in row {row + 1}; "
                "times must strictly increase"
            )

        rows, order = np.asarray(self.time_s, float), 2 if n > 2 else 1
        slope = np.gradient(np.asarray(self.position_m, float), rows, axis=0, edge_order=order)
        angles = [_travel_yaw(slope) if self.yaw_rad is None else np.unwrap(np.asarray(self.yaw_rad, float))]
        for tilt in (self.roll_rad, self.pitch_rad):
            angles.append(np.zeros(n) if tilt is None else np.unwrap(np.asarray(tilt, float)))
        bends = [np.gradient(angle, rows, edge_order=order) for angle in angles]
        object.__setattr__(self, "_values", np.column_stack([self.position_m, *angles]))
        object.__setattr__(self, "_slopes", np.column_stack([slope, *bends]))

    def at(self, time_s: Floats) -> Poses:
        """Return the poses at ``time_s`` (n,)."""
        rows, values, slopes = np.asarray(self.time_s, float), self._values, self._slopes
        wanted = np.asarray(time_s, float)
        inside = np.clip(wanted, rows[0], rows[-1])
        i = np.clip(np.searchsorted(rows, inside, side="right") - 1, 0, len(rows) - 2)
        step = (rows[i + 1] - rows[i])[:, None]
        x = (inside - rows[i])[:, None] / step
        if self.interpolation == "linear":
            value = (1 - x) * values[i] + x * values[i + 1]
            rate = (values[i + 1] - values[i]) / step
        else:
            a, b, m0, m1 = values[i], values[i + 1], slopes[i] * step, slopes[i + 1] * step
            value = (
                (1 + 2 * x) * (1 - x) ** 2 * a + x * (1 - x) ** 2 * m0 + x**2 * (3 - 2 * x) * b + x**2 * (x - 1) * m1
            )
            rate = (6 * x * (x - 1) * (a - b) + (1 - x) * (1 - 3 * x) * m0 + x * (3 * x - 2) * m1) / step
        rate = np.where(((wanted >= rows[0]) & (wanted <= rows[-1]))[:, None], rate, 0.0)
        roll = None if self.roll_rad is None else value[:, 4]
        pitch = None if self.pitch_rad is None else value[:, 5]
        return Poses(value[:, :3], rate[:, :3], value[:, 3], roll, pitch)


def _travel_yaw(slope: Floats) -> Floats:
    """Heading of each row's velocity (n, 3), unwrapped; rows that stand keep the last heading before them."""
    moving = np.flatnonzero(np.hypot(slope[:, 0], slope[:, 1]) > 1e-3)
    if not moving.size:
        return np.zeros(len(slope))
    # before the first moving row, its own heading
    last = np.maximum(np.searchsorted(moving, np.arange(len(slope)), side="right") - 1, 0)
    return np.unwrap(np.arctan2(slope[:, 1], slope[:, 0])[moving[last]])
