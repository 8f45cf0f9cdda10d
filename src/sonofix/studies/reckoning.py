"""The second seed's walker: steps with Gauss–Markov errors, and the error-state filter that ties them to fixes.

Angles count counter-clockwise from east, as everywhere here; the seed's states are (δE, δN, δL, δψ), errors of the dead
reckoning in the sense reckoned less true.
"""

from __future__ import annotations

import numpy as np

from sonofix.records import Floats

LENGTH_SD_M = 0.05
HEADING_SD_RAD = float(np.radians(2.0))
CORRELATED_S = 20.0
STEP_S = 0.5


def fade() -> float:
    """Share of a Gauss–Markov error that is left after a step."""
    return float(np.exp(-STEP_S / CORRELATED_S))


def markov(rng: np.random.Generator, count: int) -> Floats:
    """Stationary first-order Gauss–Markov errors of unit deviation, a step apart (count,); Gelb 1974, section 3.7."""
    noise, kept = rng.standard_normal(count), fade()
    out = noise.copy()
    for k in range(1, count):
        out[k] = kept * out[k - 1] + np.sqrt(1.0 - kept**2) * noise[k]
    return out


def told_steps(chords_m: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Lengths and headings (n,) that a step sensor tells of true chords (n, 2)."""
    length = np.hypot(chords_m[:, 0], chords_m[:, 1]) + LENGTH_SD_M * markov(rng, len(chords_m))
    heading = np.arctan2(chords_m[:, 1], chords_m[:, 0]) + HEADING_SD_RAD * markov(rng, len(chords_m))
    return length, heading


def reckoned(start_m: Floats, lengths_m: Floats, headings_rad: Floats) -> Floats:
    """Places (…, n, 2) after each step by dead reckoning alone."""
    chords = lengths_m[..., None] * np.stack([np.cos(headings_rad), np.sin(headings_rad)], axis=-1)
    return start_m + np.cumsum(chords, axis=-2)


def step_transition(length_m: Floats | float, heading_rad: Floats | float) -> Floats:
    """Φ (…, 4, 4) over one step: first δL and δψ age, then the step moves δE and δN by them.

    δE⁺ = δE + cos ψ δL − L sin ψ δψ and δN⁺ = δN + sin ψ δL + L cos ψ δψ.
    """
    phi = np.zeros((*np.shape(length_m), 4, 4))
    phi[..., 0, 0] = phi[..., 1, 1] = 1.0
    phi[..., 2, 2] = phi[..., 3, 3] = fade()
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    phi[..., 0, 2], phi[..., 0, 3] = fade() * cos, -fade() * length_m * sin
    phi[..., 1, 2], phi[..., 1, 3] = fade() * sin, fade() * length_m * cos
    return phi


def step_noise(length_m: Floats | float, heading_rad: Floats | float) -> Floats:
    """Q (…, 4, 4) over one step: what is new in δL and δψ, and moves δE and δN at once."""
    new = 1.0 - fade() ** 2
    drive = np.zeros((*np.shape(length_m), 4, 2))
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    drive[..., 0, 0], drive[..., 1, 0], drive[..., 2, 0] = cos, sin, 1.0
    drive[..., 0, 1], drive[..., 1, 1], drive[..., 3, 1] = -length_m * sin, length_m * cos, 1.0
    return drive @ np.diag(new * np.array([LENGTH_SD_M**2, HEADING_SD_RAD**2])) @ np.swapaxes(drive, -1, -2)


def integrated(
    start_m: Floats, lengths_m: Floats, headings_rad: Floats, fixes_m: Floats, covariance_m2: Floats
) -> tuple[Floats, Floats]:
    """Navigation results of any number of walks at once: dead reckoning, corrected by what fixes say of it.

    A fix's measurement is the difference reckoned − fix = (δE, δN) + noise. What the filter finds is fed back: the
    place is moved, and later steps are told shorter and turned by the δL and δψ believed. Where there is no fix (a
    blind zone), the corrected dead reckoning goes on alone.

    Parameters
    ----------
    start_m : float64 (2,)
        Known, at rest.
    lengths_m, headings_rad : float64 (runs, n)
    fixes_m : float64 (runs, n, 2)
        At the end of each step, NaN where there is none.
    covariance_m2 : float64 (runs, n, 2, 2)

    Returns
    -------
    places_m : float64 (runs, n, 2)
        After each step.
    covariance : float64 (runs, n, 4, 4)
        Of (δE, δN, δL, δψ).
    """
    runs, steps = lengths_m.shape
    place = np.tile(np.asarray(start_m, np.float64), (runs, 1))
    believed = np.zeros((runs, 2))  # δL and δψ; δE and δN are fed back as soon as they are found
    covariance = np.zeros((runs, 4, 4))
    covariance[:, 2, 2], covariance[:, 3, 3] = LENGTH_SD_M**2, HEADING_SD_RAD**2
    places, covariances = np.zeros((runs, steps, 2)), np.zeros((runs, steps, 4, 4))
    for k in range(steps):
        believed = fade() * believed
        length, heading = lengths_m[:, k] - believed[:, 0], headings_rad[:, k] - believed[:, 1]
        place = place + length[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        phi = step_transition(length, heading)
        covariance = phi @ covariance @ np.swapaxes(phi, -1, -2) + step_noise(length, heading)
        known = np.flatnonzero(np.isfinite(fixes_m[:, k, 0]))
        if known.size:
            noise, before = covariance_m2[known, k], covariance[known]
            gain = np.swapaxes(np.linalg.solve(before[:, :2, :2] + noise, before[:, :2]), -1, -2)
            found = (gain @ (place[known] - fixes_m[known, k])[..., None])[..., 0]
            place[known] -= found[:, :2]
            believed[known] += found[:, 2:]
            keep = np.eye(4) - gain @ np.eye(2, 4)
            covariance[known] = keep @ before @ np.swapaxes(keep, -1, -2) + gain @ noise @ np.swapaxes(gain, -1, -2)
        places[:, k], covariances[:, k] = place, covariance
    return places, covariances
