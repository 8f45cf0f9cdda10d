"""Places on Earth: published examples, and there and back."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sonofix.files.geodesy import SEMI_MAJOR_M, east_north_up, ecef_m, geodetic, on_earth
from sonofix.site import Origin


def rad(degrees: float, minutes: float, seconds: float) -> float:
    return float(np.radians(degrees + minutes / 60 + seconds / 3600))


# EPSG Guidance Note 7-2, examples of methods 9602 (geographic to geocentric) and 9837 (geographic to topocentric)
PLACE = rad(53, 48, 33.820), rad(2, 7, 46.380), 73.0
GEOCENTRIC = np.array([3771793.968, 140253.342, 5124304.349])
TOPOCENTRIC = np.array([-189013.869, -128642.040, -4220.171])
ORIGIN = rad(55, 0, 0), rad(5, 0, 0), 200.0


def test_epsg_geocentric_both_ways():
    np.testing.assert_allclose(ecef_m(*PLACE), GEOCENTRIC, atol=6e-4)
    lat, lon, height = geodetic(GEOCENTRIC)
    np.testing.assert_allclose((lat, lon), PLACE[:2], atol=6e-4 / SEMI_MAJOR_M)
    np.testing.assert_allclose(height, PLACE[2], atol=6e-4)


def test_epsg_topocentric():
    axes = east_north_up(*ORIGIN[:2])
    np.testing.assert_allclose(axes @ (ecef_m(*PLACE) - ecef_m(*ORIGIN)), TOPOCENTRIC, atol=6e-4)
    found = on_earth(Origin(latitude_deg=55.0, longitude_deg=5.0, height_m=200.0), TOPOCENTRIC[None], np.zeros((1, 3)))
    np.testing.assert_allclose(np.radians([found[0][0], found[1][0]]), PLACE[:2], atol=1e-3 / SEMI_MAJOR_M)
    np.testing.assert_allclose(found[2], PLACE[2], atol=1e-3)


@given(lat=st.floats(-np.pi / 2, np.pi / 2), lon=st.floats(-3.14159, 3.14159), height=st.floats(-11_000, 400_000))
def test_there_and_back(lat, lon, height):
    found = geodetic(ecef_m(lat, lon, height))
    np.testing.assert_allclose(ecef_m(*found), ecef_m(lat, lon, height), atol=1e-7)
    np.testing.assert_allclose(found[2], height, atol=1e-7)


def test_the_poles():
    for sign in (-1, 1):
        lat, _, height = geodetic(np.array([0.0, 0.0, sign * 6356752.314245 + sign * 12.0]))
        assert lat == sign * np.pi / 2
        np.testing.assert_allclose(height, 12.0, atol=1e-6)


@given(heading=st.floats(-np.pi, np.pi), lat=st.floats(-85, 85), lon=st.floats(-180, 180))
def test_a_turned_site(heading, lat, lon):
    """Ten metres along a site's x axis, turned from east counter-clockwise, lead there; velocities turn alike."""
    origin = Origin(latitude_deg=lat, longitude_deg=lon, height_m=30.0, heading_rad=heading)
    here, there = np.array([[0.0, 0, 0], [10.0, 0, 0]]), np.array([[2.0, 0, 0], [0, 0, 1.0]])
    lats, lons, _, velocity = on_earth(origin, here, there)
    assert abs(lats[0] - lat) < 1e-12
    axes = east_north_up(np.radians(lat), np.radians(lon))
    step = axes @ (ecef_m(*np.radians([lats[1], lons[1]]), 30.0) - ecef_m(*np.radians([lat, lon]), 30.0))
    np.testing.assert_allclose(step[:2], 10 * np.array([np.cos(heading), np.sin(heading)]), atol=1e-3)
    np.testing.assert_allclose(velocity[0], 2 * np.array([np.cos(heading), np.sin(heading), 0]), atol=1e-9)
    np.testing.assert_allclose(velocity[1], [0, 0, 1], atol=2e-5)
