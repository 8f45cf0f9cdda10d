"""Roll, pitch and yaw beside the position: what three ends that are not on a line tell of a body."""

from __future__ import annotations

import numpy as np
import pytest

from locate.made_epochs import BOUNDS, HALL, make_epoch, make_site, rows_of, shifted
from locate.made_tilts import CORNERS, TETRAHEDRON, Flight, flight
from sonofix.geometry import TILT_SD_RAD
from sonofix.locate.fix import fix
from sonofix.records import Fix, Floats
from sonofix.site import Site

CEILING = tuple((float(x), float(y), 3.0) for x in (0, 5, 10) for y in (0, 8))
LEANING = Flight((4.0, 3.0, 1.2), (0.6, -0.4, 0.1), 0.8, 0.5, 0.35, -0.25, -0.7, 0.9)


def tilting(site: Site, tilt_sd_rad: float) -> Site:
    vehicle = site.vehicles[0].model_copy(update={"tilt_sd_rad": tilt_sd_rad})
    return site.model_copy(update={"vehicles": (vehicle,)})


def miss_of(found: Fix, truth: Flight) -> Floats:
    assert found.position_m is not None
    angles = np.array([found.yaw_rad, found.roll_rad, found.pitch_rad], float)
    turned = angles - [truth.yaw_rad, truth.roll_rad, truth.pitch_rad]
    return np.append(found.position_m - truth.position_m, np.angle(np.exp(1j * turned)))


def check_belief(found: Fix, truth: Flight, most: float) -> None:
    """The normalised squared error of position and attitude stays below what chance allows."""
    assert found.covariance is not None
    own = [found.states.index(s) for s in ("x", "y", "z", "yaw", "roll", "pitch")]
    miss = miss_of(found, truth)
    assert miss @ np.linalg.solve(found.covariance[np.ix_(own, own)], miss) < most


@pytest.mark.parametrize("sounding", [False, True])
@pytest.mark.parametrize("clock_m", [None, 7.0])
@pytest.mark.parametrize("rate_sd_mps", [None, 1e-4])
def test_exact_ranges_give_position_and_attitude_without_a_guess(
    rate_sd_mps: float | None, clock_m: float | None, sounding: bool
) -> None:
    site = make_site(HALL, arms_m=CORNERS, sounding=sounding)
    truth = LEANING if rate_sd_mps else Flight(LEANING.position_m, yaw_rad=0.8, roll_rad=0.35, pitch_rad=-0.25)
    found = fix(make_epoch(site, truth, sd_m=1e-4, rate_sd_mps=rate_sd_mps, clock_m=clock_m), site, "v")
    assert found.status == "ok"
    # a prior of 0.3 rad pulls by (0.4 mrad / 0.3 rad)² of the tilt; of a sounding body, whose state is that of when it
    # sent, ranges are taken to be uncertain by a walk meanwhile, and its pose has moved on
    exact = miss_of(found, truth) if not sounding else miss_of(found, truth)[4:]
    np.testing.assert_allclose(exact, 0.0, atol=0.05 if sounding else 1e-4)
    assert {"roll", "pitch"} <= set(found.states)
    assert ("roll_rate" in found.states) == (rate_sd_mps is not None)


def test_an_upright_vehicle_has_no_tilt() -> None:
    for site in (make_site(HALL, arms_m=CORNERS, level_m=1.2), make_site(HALL, arms_m=CORNERS[:2])):
        found = fix(make_epoch(site, Flight((4.0, 3.0, 1.2), yaw_rad=0.8)), site, "v")
        assert found.status == "ok"
        assert found.roll_rad is None
        assert found.pitch_rad is None
        assert not {"roll", "pitch"} & set(found.states)


def test_any_way_up_where_the_site_says_so(rng: np.random.Generator) -> None:
    site = tilting(make_site(HALL, arms_m=TETRAHEDRON, bounds_m=BOUNDS), 9.0)
    for _ in range(15):
        roll, pitch = rng.uniform((-3.1, -1.3), (3.1, 1.3))
        truth = Flight(rng.uniform((2, 2, 0.6), (8, 6, 2)), yaw_rad=rng.uniform(-3, 3), roll_rad=roll, pitch_rad=pitch)
        found = fix(make_epoch(site, truth, sd_m=1e-3, rng=rng), site, "v")
        assert found.status == "ok"
        # χ² of six beyond 45: 5e-8
        check_belief(found, truth, 45.0)


def test_a_plane_of_beacons_mirrors_a_plane_of_microphones(rng: np.random.Generator) -> None:
    # the image of three microphones is a turned triangle again; that of four that span space is none
    truth = flight(rng)
    flat = make_site(CEILING, arms_m=CORNERS)
    assert fix(make_epoch(flat, truth, sd_m=1e-3, rng=rng), flat, "v").status == "ambiguous"
    solid = make_site(CEILING, arms_m=TETRAHEDRON)
    found = fix(make_epoch(solid, truth, sd_m=1e-3, rng=rng), solid, "v")
    assert found.status == "ok"
    check_belief(found, truth, 45.0)


@pytest.mark.parametrize("ends", [2, 1])
def test_where_too_few_ends_are_heard_the_tilt_stays_doubtful(ends: int, rng: np.random.Generator) -> None:
    site = make_site(HALL, arms_m=CORNERS, bounds_m=BOUNDS)
    squared = []
    for _ in range(30):
        truth = flight(rng, TILT_SD_RAD)
        epoch = make_epoch(site, truth, sd_m=1e-3, rng=rng)
        found = fix(rows_of(epoch, [i for i, r in enumerate(epoch.receiver) if int(r[1]) < ends]), site, "v")
        if found.status == "ambiguous":
            continue
        assert found.status == "ok"
        assert found.position_m is not None
        assert found.covariance is not None
        assert (found.roll_rad is None) == (ends == 1)
        miss = found.position_m - truth.position_m
        squared.append(miss @ np.linalg.solve(found.covariance[:3, :3], miss))
        if ends == 2:
            # about the line of the two, nothing is told
            assert max(found.sd("roll") or 0.0, found.sd("pitch") or 0.0) > 0.05
    # the mean of 25 sums of three squares lies below 5.4 but for 2e-5; covariances may be too wide, not too narrow
    assert len(squared) >= 25
    assert np.mean(squared) < 5.4


def test_few_rows_are_ambiguous_rather_than_wrong(rng: np.random.Generator) -> None:
    site, doubted = make_site(HALL, arms_m=CORNERS, bounds_m=BOUNDS), 0
    for _ in range(60):
        truth = flight(rng)
        epoch = make_epoch(site, truth, sd_m=2e-3, rng=rng)
        found = fix(rows_of(epoch, np.sort(rng.choice(len(epoch), 7, replace=False))), site, "v")
        doubted += found.status != "ok"
        if found.status == "ok":
            check_belief(found, truth, 60.0)
    assert 0 < doubted < 60


def test_a_faulty_range_is_left_out_and_the_level_holds(rng: np.random.Generator) -> None:
    site = make_site(HALL, arms_m=CORNERS)
    for _ in range(5):
        truth = flight(rng)
        row = int(rng.integers(18))
        found = fix(shifted(make_epoch(site, truth, sd_m=2e-3, rng=rng), row, 0.5), site, "v")
        assert found.status == "ok"
        assert not found.used[row]
        assert found.hpl_m is not None
        assert found.vpl_m is not None
        miss = miss_of(found, truth)
        assert np.hypot(*miss[:2]) < found.hpl_m < 0.2
        assert abs(miss[2]) < found.vpl_m
