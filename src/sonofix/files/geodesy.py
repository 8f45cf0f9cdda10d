"""From the site's frame to latitude and longitude: the WGS-84 ellipsoid, exactly."""

from __future__ import annotations

import numpy as np

from sonofix.records import Floats
from sonofix.site import Origin

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563
_E2 = FLATTENING * (2 - FLATTENING)
_SEMI_MINOR_M = SEMI_MAJOR_M * (1 - FLATTENING)


def ecef_m(latitude_rad: Floats | float, longitude_rad: Floats | float, height_m: Floats | float) -> Floats:
    """Return earth-centred, earth-fixed coordinates, (…, 3).

    EPSG Guidance Note 7-2, method 9602. Heights are above the ellipsoid.
    """
    lat, lon, height = np.broadcast_arrays(latitude_rad, longitude_rad, height_m)
    normal = SEMI_MAJOR_M / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    across = (normal + height) * np.cos(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), ((1 - _E2) * normal + height) * np.sin(lat)], axis=-1)


def geodetic(place_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Return latitude, longitude (rad) and height above the ellipsoid (m) of earth-centred coordinates (…, 3).

    Bowring's formula (Survey Review 23, 1976), iterated: three rounds leave nothing but rounding from the ocean's floor
    to low orbits.
    """
    x, y, z = np.moveaxis(np.asarray(place_m, np.float64), -1, 0)
    across = np.hypot(x, y)
    reduced = np.arctan2(z, (1 - FLATTENING) * across)
    lat = reduced
    for _ in range(3):
        top = z + _E2 / (1 - _E2) * _SEMI_MINOR_M * np.sin(reduced) ** 3
        lat = np.arctan2(top, across - _E2 * SEMI_MAJOR_M * np.cos(reduced) ** 3)
        reduced = np.arctan2((1 - FLATTENING) * np.sin(lat), np.cos(lat))
    height = across * np.cos(lat) + z * np.sin(lat) - SEMI_MAJOR_M * np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    return lat, np.arctan2(y, x), height


def east_north_up(latitude_rad: Floats | float, longitude_rad: Floats | float) -> Floats:
    """Return unit vectors east, north, up at places on Earth as rows, (…, 3, 3), in earth-centred coordinates."""
    lat, lon = np.broadcast_arrays(latitude_rad, longitude_rad)
    s, c, sl, cl, none = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon), np.zeros_like(lat)
    rows = ((-sl, cl, none), (-s * cl, -s * sl, c), (c * cl, c * sl, s))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def on_earth(origin: Origin, position_m: Floats, velocity_mps: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return where positions of the site's frame lie on Earth, and velocities there.

    Parameters
    ----------
    origin : Origin
        Where the frame's origin lies, and how its x axis is turned from east.
    position_m, velocity_mps : float64 (n, 3)
        In the site's frame.

    Returns
    -------
    latitude_deg, longitude_deg, height_m : float64 (n,)
        Height above the ellipsoid.
    velocity_mps : float64 (n, 3)
        East, north and up at each place.
    """
    lat, lon = np.radians(origin.latitude_deg), np.radians(origin.longitude_deg)
    c, s = np.cos(origin.heading_rad), np.sin(origin.heading_rad)
    to_east = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    axes = to_east @ east_north_up(lat, lon)
    lats, lons, heights = geodetic(ecef_m(lat, lon, origin.height_m) + position_m @ axes)
    there = np.einsum("nij,nj->ni", east_north_up(lats, lons), velocity_mps @ axes)
    return np.degrees(lats), np.degrees(lons), heights, there
