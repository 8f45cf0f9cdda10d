"""The first seed's filter as it is printed: coarse velocities (eqs 8, 9) and four states (eqs 10 to 19).

States are (x, vx, y, vy). What is printed is kept, also where it is odd: the position variance inside Q, and a start
with P = Q that is far surer of a wrong velocity than it should be.
"""

from __future__ import annotations

import numpy as np

from sonofix.records import Floats


def coarse_velocities(places_m: Floats, period_s: float | Floats) -> Floats:
    """Differences of successive fixes over the time between, eqs 8 and 9.

    Parameters
    ----------
    places_m : float64 (…, n, 2)
    period_s : float or float64 (n − 1,)
        Between successive fixes.

    Returns
    -------
    float64 (…, n − 1, 2)
        In m/s: that of row k belongs to fix k, and knows fix k + 1.
    """
    return np.diff(places_m, axis=-2) / np.reshape(period_s, (-1, 1))


def transition(period_s: float) -> Floats:
    """Φ of eq 11 (4, 4)."""
    phi = np.eye(4)
    phi[0, 1] = phi[2, 3] = period_s
    return phi


def observation() -> Floats:
    """H of eq 13 (2, 4): x and y are measured."""
    return np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])


def measurement_noise(sd_x_m: float, sd_y_m: float) -> Floats:
    """R of eq 18 (2, 2), m²."""
    return np.diag([sd_x_m**2, sd_y_m**2])


def process_noise(sd_x_m: float, sd_y_m: float, sd_u_mps: float) -> Floats:
    """Q of eq 19 (4, 4): with deviations of position in it, as printed; 0 m leaves them out."""
    return np.diag([sd_x_m**2, sd_u_mps**2, sd_y_m**2, sd_u_mps**2])


def gains(period_s: float, noise: Floats, process: Floats, count: int) -> Floats:
    """Gains K(0) … K(count − 1) of eqs 15 to 17, from P(−1) = Q; the fixes do not enter.

    Parameters
    ----------
    period_s : float
    noise, process : float64 (2, 2), (4, 4)
        R and Q.

    Returns
    -------
    float64 (count, 4, 2)
    """
    phi, h, covariance = transition(period_s), observation(), process
    out = np.zeros((count, 4, 2))
    for k in range(count):
        ahead = phi @ covariance @ phi.T + process
        out[k] = np.linalg.solve(h @ ahead @ h.T + noise, h @ ahead).T
        covariance = (np.eye(4) - out[k] @ h) @ ahead
    return out


def follow(places_m: Floats, period_s: float, gain: Floats, start: Floats) -> Floats:
    """States by eq 14 for any number of runs at once.

    Parameters
    ----------
    places_m : float64 (runs, n, 2)
        Coarse fixes Z(0) … Z(n − 1).
    period_s : float
    gain : float64 (n, 4, 2)
    start : float64 (4,)
        X̂(−1).

    Returns
    -------
    float64 (runs, n, 4)
    """
    phi, h = transition(period_s), observation()
    out = np.zeros((*places_m.shape[:2], 4))
    state = np.tile(np.asarray(start, np.float64), (len(places_m), 1))
    for k in range(places_m.shape[1]):
        ahead = state @ phi.T
        state = ahead + (places_m[:, k] - ahead @ h.T) @ gain[k].T
        out[:, k] = state
    return out


def settled_sd(period_s: float, noise: Floats, gain: Floats) -> Floats:
    """Deviations (4,) of the settled filter's errors where the vehicle truly keeps its velocity.

    With A = (I − K H) Φ they are the roots of E = A E Aᵀ + K R Kᵀ (a discrete Lyapunov equation), which differs from
    the covariance that the filter states, since nothing of Q happens.
    """
    from scipy.linalg import solve_discrete_lyapunov

    drift = (np.eye(4) - gain @ observation()) @ transition(period_s)
    return np.sqrt(np.diag(solve_discrete_lyapunov(drift, gain @ noise @ gain.T)))
