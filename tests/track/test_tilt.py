"""Tracks of bodies that tilt: roll and pitch followed beside the rest, and doubtful where nothing tells of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2

from locate.made_epochs import BOUNDS, HALL, make_epoch, make_site, rows_of
from locate.made_tilts import CORNERS, Flight
from sonofix.geometry import TILT_SD_RAD
from sonofix.records import Estimate, RangeEpoch
from sonofix.street import Street
from sonofix.track.belief import Motion, estimate, predict
from sonofix.track.follow import Follower, expectations

PERIOD_S = 0.1
SITE = make_site(HALL, arms_m=CORNERS, bounds_m=BOUNDS)
STATES = ("x", "y", "z", "yaw", "roll", "pitch")


@dataclass(frozen=True)
class Rocking:
    """Round a circle, rocking by ``swing_rad`` in roll and pitch."""

    swing_rad: float = 0.2

    def at(self, time_s: float) -> Flight:
        turn, a, b = 0.3, 2.0, 1.6
        angle = turn * time_s
        return Flight(
            (5 + 2 * np.cos(angle), 4 + 2 * np.sin(angle), 1.2),
            (-2 * turn * np.sin(angle), 2 * turn * np.cos(angle), 0.0),
            angle + np.pi / 2,
            turn,
            self.swing_rad * np.sin(a * time_s),
            self.swing_rad * np.sin(b * time_s + 1.0),
            self.swing_rad * a * np.cos(a * time_s),
            self.swing_rad * b * np.cos(b * time_s + 1.0),
        )


def epoch_of(flight: Rocking, time_s: float, rng: np.random.Generator) -> RangeEpoch:
    """All rows heard at one instant, as the flight is then."""
    made = make_epoch(SITE, flight.at(time_s), sd_m=2e-3, rate_sd_mps=0.02, rng=rng)
    return replace(made, time_s=made.time_s + time_s, sync_s=time_s)


def squared(got: Estimate, truth: Flight) -> float:
    angles = np.array([got.yaw_rad, got.roll_rad, got.pitch_rad], float)
    turned = angles - [truth.yaw_rad, truth.roll_rad, truth.pitch_rad]
    miss = np.append(got.position_m - truth.position_m, np.angle(np.exp(1j * turned)))
    own = [got.states.index(s) for s in STATES]
    return float(miss @ np.linalg.solve(got.covariance[np.ix_(own, own)], miss))


def test_a_rocking_body_is_followed_with_its_attitude_and_its_doubt(rng: np.random.Generator) -> None:
    street, nees = Street(SITE), []
    for k in range(80):
        time_s = PERIOD_S * k
        (got,) = street.walk(epoch_of(Rocking(), time_s, rng)).estimates
        truth = Rocking().at(got.time_s)
        nees.append(squared(got, truth))
        assert abs(np.angle(np.exp(1j * (got.roll_rad - truth.roll_rad)))) < 0.05
        assert abs(np.angle(np.exp(1j * (got.pitch_rad - truth.pitch_rad)))) < 0.05
    # an attitude that a smooth process follows is not drawn from it, and rows of a few epochs err together: the band is
    # that of a fifth of the epochs, and on its upper side alone may a filter of freer motion stay below
    assert np.mean(nees[10:]) < chi2.ppf(1 - 1e-4, 6 * 14) / 14


def test_a_tilt_that_falls_silent_is_as_doubtful_as_any_and_the_arms_with_it(rng: np.random.Generator) -> None:
    street = Street(SITE)
    for k in range(20):
        street.walk(epoch_of(Rocking(), PERIOD_S * k, rng))
    last, belief = street.follower.belief.time_s, street.follower.belief
    soon, late = (estimate(predict(belief, last + s, Motion()), SITE, 0, "predicted") for s in (0.0, 8.0))
    assert soon.sd("roll") < 0.03
    assert late.sd("roll") == pytest.approx(TILT_SD_RAD, rel=0.01)
    assert abs(late.roll_rad) < 0.01
    # what a microphone on an arm is expected to hear is the more doubtful for it
    pairs = [("B0", "M0"), ("B4", "M1")]
    aged = predict(belief, last + 8.0, Motion())
    sd = expectations(aged, SITE, pairs, 343.0)[1]
    upright = aged.covariance.copy()
    upright[8:12, :] = upright[:, 8:12] = 0.0
    assert (sd > expectations(replace(aged, covariance=upright), SITE, pairs, 343.0)[1]).all()


@pytest.mark.parametrize("ends", [1, 2])
def test_where_one_or_two_ends_are_heard_for_a_while_nothing_is_claimed(ends: int, rng: np.random.Generator) -> None:
    street, nees = Street(SITE), []
    for k in range(50):
        epoch = epoch_of(Rocking(), PERIOD_S * k, rng)
        if k >= 20:
            epoch = rows_of(epoch, [i for i, r in enumerate(epoch.receiver) if int(r[1]) < ends])
        (got,) = street.walk(epoch).estimates
        nees.append(squared(got, Rocking().at(got.time_s)))
    assert np.mean(nees[20:]) < 12.0
    assert max(got.sd("roll"), got.sd("pitch")) > (0.02 if ends == 2 else 0.05)


def test_a_stated_start_opens_the_tilt() -> None:
    follower = Follower(SITE)
    follower.start("v", 0.0, np.array([5.0, 4.0, 1.0]), 0.3)
    got = estimate(follower.belief, SITE, 0, "predicted")
    assert got.roll_rad == got.pitch_rad == 0.0
    assert got.sd("roll") == pytest.approx(TILT_SD_RAD)
    upright = Follower(make_site(HALL, arms_m=CORNERS, level_m=1.0))
    upright.start("v", 0.0, np.array([5.0, 4.0, 1.0]), 0.3)
    assert estimate(upright.belief, upright.site, 0, "predicted").roll_rad is None
