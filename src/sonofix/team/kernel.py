"""The compiled heart of the team's filters: robots driven on by their odometry, and what one is expected to hear.

State vectors are `state.STATES` of each robot in turn. Everything is linearised where ``about`` says: a filter gives
its mean, a smoother the track of its last pass.
"""

from __future__ import annotations

import numba
import numpy as np

from sonofix.team.state import (
    BIAS,
    DRIFT,
    LAG,
    OFFSET,
    SCALE,
    SIZE,
    SLIP_S,
    SLIP_SD,
    SPEED,
    SPEED_SLIP,
    TURN,
    TURN_SLIP,
    YAW,
    X,
    Y,
)
from sonofix.track.wheels import CREEP_PSD, LONGEST_S, SLIP_M, TWIST_M, TWIST_PSD, TWIST_RAD

STRAYS = 2
"""Ways in which a robot leaves its odometry's track: its place, its heading."""

UNTOLD_PSD = 0.1
"""In m²/s and rad²/s: how a robot strays whose odometry is silent."""


@numba.njit(cache=True, error_model="numpy")
def drive(own, time_s, told, from_s, until_s, rough, pose, by, stray):
    """Drive a robot on along its odometry, each row of which holds until the next or for `LONGEST_S`.

    With k, l, b the errors of speed, yaw rate and its zero, slips included, a row (v, w) moves it on an arc at
    (1 − k) v and ω = (1 − l) w − b; what is told at t happens at t + lag.

    Parameters
    ----------
    own : float64 (SIZE,)
        The robot's state at ``from_s``.
    time_s, told : float64 (k,), (k, 3)
        Rows of its odometry: speed, yaw rate, and the variance of what it may have turned unseen before.
    from_s, until_s : float
    rough : float64 (4,)
        Factors on the variances that `track.wheels` has its place and heading stray by; the rest is not for here.
    pose : float64 (3,), out
        x, y, yaw at ``until_s``.
    by : float64 (3, SIZE), out
        Its derivative by ``own``.
    stray : float64 (STRAYS,), out
        Variances of what odometry does not tell: of the place (each axis), and of the heading.

    Returns
    -------
    float
        Speed at the end.
    """
    x, y, yaw = own[X], own[Y], own[YAW]
    rest = 1.0 - own[SPEED] - own[SPEED_SLIP]
    slip = own[TURN] + own[TURN_SLIP]
    lag = own[LAG]
    begin, end = from_s - lag, until_s - lag
    n = len(time_s)
    i = np.searchsorted(time_s, begin, side="right") - 1
    first_v = first_w = last_v = last_w = 0.0
    turn_sum = span = 0.0
    x_turn = y_turn = x_drift = y_drift = 0.0
    place = heading = 0.0
    now = begin
    start = True
    while now < end:
        until = end
        v = w = 0.0
        silent = True
        if i < 0:
            if n > 0:
                until = min(end, time_s[0])
        else:
            limit = time_s[i] + LONGEST_S
            if i + 1 < n:
                until = min(until, time_s[i + 1])
            if now < limit:
                until = min(until, limit)
                v, w = told[i, 0], told[i, 1]
                silent = not (np.isfinite(v) and np.isfinite(w))
                if silent:
                    v = w = 0.0
        dt = until - now
        rate = 0.0 if silent else (1.0 - slip) * w - own[DRIFT]
        speed = rest * v
        if start:
            # where a row begins just here, the drive before ended with what was told until then, and so begins this one
            first_v, first_w, start = speed, rate, False
            if i >= 0 and time_s[i] == begin:
                first_v = first_w = 0.0
                if i > 0 and begin <= time_s[i - 1] + LONGEST_S and np.isfinite(told[i - 1, 0] + told[i - 1, 1]):
                    first_v, first_w = rest * told[i - 1, 0], (1.0 - slip) * told[i - 1, 1] - own[DRIFT]
        last_v, last_w = speed, rate
        turned = rate * dt
        half = 0.5 * turned
        bent = 1.0 - half * half / 6.0 if abs(half) < 1e-3 else np.sin(half) / half
        chord = speed * dt * bent
        cos, sin = np.cos(yaw + half), np.sin(yaw + half)
        # a yaw rate's errors have turned this piece by what they made since the start, half its own included
        x_turn += chord * sin * (turn_sum + 0.5 * w * dt)
        y_turn -= chord * cos * (turn_sum + 0.5 * w * dt)
        x_drift += chord * sin * (span + 0.5 * dt)
        y_drift -= chord * cos * (span + 0.5 * dt)
        x += chord * cos
        y += chord * sin
        yaw += turned
        if silent:
            place += UNTOLD_PSD * dt
            heading += UNTOLD_PSD * dt
        else:
            turn_sum += w * dt
            span += dt
            way = abs(speed * dt)
            place += rough[0] * (CREEP_PSD * dt + SLIP_M * way)
            heading += rough[1] * (TWIST_PSD * dt + TWIST_M * way + TWIST_RAD * abs(turned))
        now = until
        if i + 1 < n and now >= time_s[i + 1]:
            i += 1
            heading += told[i, 2]
    dx, dy = x - own[X], y - own[Y]
    pose[0], pose[1], pose[2] = x, y, yaw
    by[:, :] = 0.0
    by[0, X] = by[1, Y] = by[2, YAW] = 1.0
    by[0, YAW], by[1, YAW] = -dy, dx
    if rest != 0.0:
        by[0, SPEED], by[1, SPEED] = -dx / rest, -dy / rest
        by[0, SPEED_SLIP], by[1, SPEED_SLIP] = -dx / rest, -dy / rest
    by[0, TURN], by[1, TURN], by[2, TURN] = x_turn, y_turn, -turn_sum
    by[0, TURN_SLIP], by[1, TURN_SLIP], by[2, TURN_SLIP] = x_turn, y_turn, -turn_sum
    by[0, DRIFT], by[1, DRIFT], by[2, DRIFT] = x_drift, y_drift, -span
    # later by lag: a piece more at the start, of what was told until then, which turns the rest; one less at the end
    c0, s0 = np.cos(own[YAW]), np.sin(own[YAW])
    by[0, LAG] = first_v * c0 - first_w * dy - last_v * np.cos(yaw)
    by[1, LAG] = first_v * s0 + first_w * dx - last_v * np.sin(yaw)
    by[2, LAG] = first_w - last_w
    stray[0], stray[1] = place, heading
    return last_v


@numba.njit(cache=True, error_model="numpy")
def strayed(by, stray, noise):
    """Write the covariance (3, 3) of what a drive of derivative ``by`` leaves open, its heading astray all along it."""
    dx, dy = by[1, YAW], -by[0, YAW]
    place, heading = stray[0], stray[1]
    noise[0, 0] = place + heading * dy * dy / 3.0
    noise[1, 1] = place + heading * dx * dx / 3.0
    noise[0, 1] = -heading * dx * dy / 3.0
    noise[1, 0] = noise[0, 1]
    noise[0, 2] = noise[2, 0] = -heading * dy / 2.0
    noise[1, 2] = noise[2, 1] = heading * dx / 2.0
    noise[2, 2] = heading


@numba.njit(cache=True, error_model="numpy")
def advance(
    mean, covariance, about, placed, first, time_s, told, from_s, until_s, rough, wander_psd, by, noise, speed,
):  # fmt: skip
    """Drive all robots on, in place; of those not ``placed`` the mean alone moves.

    The mean moves by what ``about`` does, and by its distance from there. ``first`` (V + 1,) says where each robot's
    rows of odometry begin; ``rough`` (V, 4) has two factors as `drive` has them, and those on the variances of slips;
    ``by`` (V, 3, SIZE), ``noise`` (V, 3, 3) and ``speed`` (V,) are written.
    """
    n = len(mean)
    robots = len(placed)
    pose = np.empty(3)
    carried = np.empty((3, n))
    stray = np.empty(STRAYS)
    for r in range(robots):
        at = SIZE * r
        own = about[at : at + SIZE].copy()
        a, b = first[r], first[r + 1]
        speed[r] = drive(own, time_s[a:b], told[a:b], from_s, until_s, rough[r], pose, by[r], stray)
        strayed(by[r], stray, noise[r])
        moved = np.empty(3)
        for i in range(3):
            moved[i] = pose[i]
            for j in range(SIZE):
                moved[i] += by[r, i, j] * (mean[at + j] - own[j])
        for i in range(3):
            mean[at + i] = moved[i]
        if not placed[r]:
            continue
        for i in range(3):
            for k in range(n):
                told_k = 0.0
                for j in range(SIZE):
                    told_k += by[r, i, j] * covariance[at + j, k]
                carried[i, k] = told_k
        for i in range(3):
            for k in range(n):
                covariance[at + i, k] = carried[i, k]
        for k in range(n):
            for i in range(3):
                value = 0.0
                for j in range(SIZE):
                    value += by[r, i, j] * covariance[k, at + j]
                carried[i, k] = value
        for i in range(3):
            for k in range(n):
                covariance[k, at + i] = carried[i, k]
        for i in range(3):
            for j in range(3):
                covariance[at + i, at + j] += noise[r, i, j]
        for i in range(3):
            for k in range(n):
                covariance[at + i, k] = covariance[k, at + i]
        for j in range(SIZE):
            covariance[at + j, at + j] += wander_psd[j] * (until_s - from_s)
        left = np.exp(-(until_s - from_s) / SLIP_S)
        for j in (SPEED_SLIP, TURN_SLIP):
            mean[at + j] *= left
            for k in range(n):
                covariance[at + j, k] *= left
                covariance[k, at + j] *= left
            covariance[at + j, at + j] += (1.0 - left * left) * rough[r, 2 if j == SPEED_SLIP else 3] * SLIP_SD**2


@numba.njit(cache=True, error_model="numpy")
def end_of(about, robot, point, place, by):
    """Write where an end of a row stands: a fixed ``point``, or one at that lever arm on a robot.

    ``by`` (2,) is its x and y by that robot's yaw.
    """
    if robot < 0:
        place[0], place[1] = point[0], point[1]
        by[0] = by[1] = 0.0
        return
    at = SIZE * robot
    cos, sin = np.cos(about[at + YAW]), np.sin(about[at + YAW])
    ax, ay = cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]
    place[0], place[1] = about[at + X] + ax, about[at + Y] + ay
    by[0], by[1] = -ay, ax


@numba.njit(cache=True, error_model="numpy")
def expect(about, listener, source, listener_point, source_point, flight_s_per_m, speed, common, rows):
    """Return the range and bearing that a state makes a listener measure, and the way; write their derivatives.

    Range (1 + k) r + b with r = |p_source(t − r/c) − p_listener(t)|; bearing atan2(Δy, Δx) − yaw + offset.

    Parameters
    ----------
    about : float64 (n,)
    listener, source : int
        Robots; −1: fixed.
    listener_point, source_point : float64 (3,)
        Place of a fixed end, lever arm of a mounted one; heights as they stand in the frame.
    flight_s_per_m : float
        One over the speed of sound.
    speed : float64 (V,)
        How fast each robot drives.
    common : bool
        k and b are the same for all, so that what a fixed listener hears has them too; else they are the listener's.
    rows : float64 (2, n), out
    """
    here, there = np.empty(2), np.empty(2)
    here_by, there_by = np.empty(2), np.empty(2)
    end_of(about, listener, listener_point, here, here_by)
    end_of(about, source, source_point, there, there_by)
    dx, dy, dz = there[0] - here[0], there[1] - here[1], source_point[2] - listener_point[2]
    way, cos, sin = 0.0, 1.0, 0.0
    if source >= 0:
        way = np.sqrt(dx * dx + dy * dy + dz * dz) * flight_s_per_m * speed[source]
        cos, sin = np.cos(about[SIZE * source + YAW]), np.sin(about[SIZE * source + YAW])
        dx -= way * cos
        dy -= way * sin
        # where it was when it sent turns with its heading
        there_by[0] += way * sin
        there_by[1] -= way * cos
    flat = max(dx * dx + dy * dy, 1e-12)
    r = np.sqrt(flat + dz * dz)
    rows[:, :] = 0.0
    scale = 1.0
    shown = r
    direction = np.arctan2(dy, dx)
    whose = source if common and listener < 0 else listener
    if whose >= 0:
        at = SIZE * whose
        scale += about[at + SCALE]
        shown = scale * r + about[at + BIAS]
        rows[0, at + SCALE] = r
        rows[0, at + BIAS] = 1.0
    if listener >= 0:
        at = SIZE * listener
        direction += about[at + OFFSET] - about[at + YAW]
        rows[0, at + X], rows[0, at + Y] = -scale * dx / r, -scale * dy / r
        rows[0, at + YAW] = -scale * (dx * here_by[0] + dy * here_by[1]) / r
        rows[1, at + X], rows[1, at + Y] = dy / flat, -dx / flat
        rows[1, at + YAW] = -1.0 + (dy * here_by[0] - dx * here_by[1]) / flat
        rows[1, at + OFFSET] = 1.0
    if source >= 0:
        at = SIZE * source
        rows[0, at + X], rows[0, at + Y] = scale * dx / r, scale * dy / r
        rows[0, at + YAW] = scale * (dx * there_by[0] + dy * there_by[1]) / r
        rest = 1.0 - about[at + SPEED] - about[at + SPEED_SLIP]
        if rest != 0.0:
            rows[0, at + SPEED] = rows[0, at + SPEED_SLIP] = scale * way * (dx * cos + dy * sin) / (r * rest)
            rows[1, at + SPEED] = rows[1, at + SPEED_SLIP] = way * (dx * sin - dy * cos) / (flat * rest)
        rows[1, at + X], rows[1, at + Y] = -dy / flat, dx / flat
        rows[1, at + YAW] = (-dy * there_by[0] + dx * there_by[1]) / flat
    return shown, direction, r


@numba.njit(cache=True, error_model="numpy")
def turned_by(angle):
    """Return an angle between −π and π."""
    return angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi))
