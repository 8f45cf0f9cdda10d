"""Air: how fast sound goes in it, and how much of it is lost.

Speed: Cramer, J. Acoust. Soc. Am. 93, 2510 (1993), and the linear rule of pedestrian ultrasonic systems. Absorption:
ISO 9613-1:1993. All functions are pure and take scalars or arrays that broadcast against each other.
"""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

ZERO_C_K = 273.15
STANDARD_PRESSURE_KPA = 101.325
TODAYS_CO2_FRACTION = 4.2e-4

# Cramer 1993, table III, column of the speed of sound: a0 ... a15.
_CRAMER = (
    (331.5024, 0.603055, -0.000528),
    (51.471935, 0.1495874, -0.000782),
    (-1.82e-7, 3.73e-8, -2.93e-10),
    (-85.20931, -0.228525, 5.91e-5),
    (-2.835149, -2.15e-13, 29.179762, 0.000486),
)

_RANGES = {
    "temperature_c": (-40.0, 60.0, "°C"),
    "humidity": (0.0, 1.0, "(a fraction, not percent)"),
    "pressure_kpa": (50.0, 120.0, "kPa"),
    "co2_fraction": (0.0, 0.01, "(a mole fraction)"),
    "frequency_hz": (1.0, 1e6, "Hz"),
}


def _checked(name: str, value: ArrayLike) -> Floats:
    """Return ``value`` as float64, or raise ValueError naming the first entry outside the range of ``name``."""
    low, high, unit = _RANGES[name]
    array = np.asarray(value, dtype=np.float64)
    # A NaN fails both comparisons, so it is refused as well.
    bad = ~((array >= low) & (array <= high))
    if np.any(bad):
        raise ValueError(f"{name} = {array[bad].flat[0]:g}; valid is {low:g} to {high:g} {unit}")
    return array


def _saturation_pressure_pa(temperature_c: Floats) -> Floats:
    """Saturation vapour pressure over water: Cramer 1993, appendix (after Giacomo 1982)."""
    t_k = temperature_c + ZERO_C_K
    return np.exp(1.2811805e-5 * t_k**2 - 1.9509874e-2 * t_k + 34.04926034 - 6.3536311e3 / t_k)


def water_fraction(temperature_c: ArrayLike, humidity: ArrayLike, pressure_kpa: ArrayLike) -> Floats:
    """Mole fraction of water vapour in moist air, ``h f p_sat / p`` with the enhancement factor f of Cramer's appendix.

    Parameters
    ----------
    temperature_c : float or array
        −40 … 60 °C.
    humidity : float or array
        Relative, 0 … 1, over water.
    pressure_kpa : float or array
        50 … 120 kPa.

    Returns
    -------
    float64, shape of the inputs broadcast

    Raises
    ------
    ValueError
        A value is out of range; the message names it and the range.
    """
    t_c, h = _checked("temperature_c", temperature_c), _checked("humidity", humidity)
    p_pa = 1e3 * _checked("pressure_kpa", pressure_kpa)
    enhancement = 1.00062 + 3.14e-8 * p_pa + 5.6e-7 * t_c**2
    return np.asarray(h * enhancement * _saturation_pressure_pa(t_c) / p_pa)


BY_KELVIN_MPS = 0.607
"""What a kelvin changes the sound speed by: the rule of the second seed."""

THERMOMETER_SD_K = 1.0
"""Doubt about a temperature that is stated."""


@overload
def sound_speed_mps(
    temperature_c: float,
    humidity: float = 0.5,
    pressure_kpa: float = STANDARD_PRESSURE_KPA,
    co2_fraction: float = TODAYS_CO2_FRACTION,
) -> float: ...


@overload
def sound_speed_mps(
    temperature_c: Floats,
    humidity: Floats | float = 0.5,
    pressure_kpa: Floats | float = STANDARD_PRESSURE_KPA,
    co2_fraction: Floats | float = TODAYS_CO2_FRACTION,
) -> Floats: ...


def sound_speed_mps(
    temperature_c: ArrayLike,
    humidity: ArrayLike = 0.5,
    pressure_kpa: ArrayLike = STANDARD_PRESSURE_KPA,
    co2_fraction: ArrayLike = TODAYS_CO2_FRACTION,
) -> float | Floats:
    """Speed of sound in moist air (Cramer 1993, eq 15 and table III).

    Cramer's fit holds from 0 to 30 °C, 75 to 102 kPa, up to 6 % water and 1 % CO2, with 300 ppm of uncertainty.
    Outside, from −40 °C to 60 °C, the same polynomial is used on. It then stays within 0.1 % of an ideal gas (and
    within 0.3 % in the worst corner, air of 60 °C saturated with water).

    Parameters
    ----------
    temperature_c : float or array
        −40 … 60 °C.
    humidity : float or array
        Relative, 0 … 1.
    pressure_kpa : float or array
        50 … 120 kPa.
    co2_fraction : float or array
        Mole fraction of carbon dioxide, 0 … 0.01.

    Returns
    -------
    float, or float64 in the shape of the inputs broadcast, m/s
        At zero frequency; relaxation makes 40 kHz faster by 0.03 % in a room (docs/air.md).

    Raises
    ------
    ValueError
        A value is out of range; the message names it and the range.
    """
    t = _checked("temperature_c", temperature_c)
    w = water_fraction(temperature_c, humidity, pressure_kpa)
    p = 1e3 * _checked("pressure_kpa", pressure_kpa)
    c = _checked("co2_fraction", co2_fraction)
    dry, water, pressure, carbon, (ww, pp, cc, wpc) = _CRAMER
    powers = (1.0, t, t**2)
    speed = (
        sum(a * b for a, b in zip(dry, powers, strict=True))
        + sum(a * b for a, b in zip(water, powers, strict=True)) * w
        + sum(a * b for a, b in zip(pressure, powers, strict=True)) * p
        + sum(a * b for a, b in zip(carbon, powers, strict=True)) * c
        + (ww * w**2 + pp * p**2 + cc * c**2 + wpc * w * p * c)
    )
    return float(speed) if np.ndim(speed) == 0 else np.asarray(speed)


@overload
def sound_speed_linear_mps(temperature_c: float) -> float: ...


@overload
def sound_speed_linear_mps(temperature_c: Floats) -> Floats: ...


def sound_speed_linear_mps(temperature_c: ArrayLike) -> float | Floats:
    """Speed of sound by the rule 331.5 + 0.607 T m/s of the second seed, T in °C from −40 to 60; ValueError outside.

    The rule knows no humidity: from 0 to 30 °C it lies 0.05 to 0.57 m/s above dry air and, from 10 °C on, below air of
    half humidity.
    """
    speed = 331.5 + BY_KELVIN_MPS * _checked("temperature_c", temperature_c)
    return float(speed) if np.ndim(speed) == 0 else np.asarray(speed)


@overload
def absorption_db_per_m(
    frequency_hz: float, temperature_c: float, humidity: float = 0.5, pressure_kpa: float = STANDARD_PRESSURE_KPA
) -> float: ...


@overload
def absorption_db_per_m(
    frequency_hz: Floats,
    temperature_c: Floats | float,
    humidity: Floats | float = 0.5,
    pressure_kpa: Floats | float = STANDARD_PRESSURE_KPA,
) -> Floats: ...


def absorption_db_per_m(
    frequency_hz: ArrayLike,
    temperature_c: ArrayLike,
    humidity: ArrayLike = 0.5,
    pressure_kpa: ArrayLike = STANDARD_PRESSURE_KPA,
) -> float | Floats:
    """Attenuation of a pure tone by the air alone (ISO 9613-1:1993, eqs 3 to 5, B.1 to B.3).

    The standard claims ±10 % from −20 to 50 °C, 0.05 to 5 % of water and 0.4 mHz to 10 Hz a pascal (40 Hz to 1 MHz at
    sea level), so it covers ultrasound; outside it is an extrapolation.

    Parameters
    ----------
    frequency_hz : float or array
        1 Hz … 1 MHz.
    temperature_c, humidity, pressure_kpa : float or array
        As in `sound_speed_mps`.

    Returns
    -------
    float, or float64 in the shape of the inputs broadcast, dB/m

    Raises
    ------
    ValueError
        A value is out of range; the message names it and the range.
    """
    f = _checked("frequency_hz", frequency_hz)
    t_k = _checked("temperature_c", temperature_c) + ZERO_C_K
    relative_pressure = _checked("pressure_kpa", pressure_kpa) / STANDARD_PRESSURE_KPA
    relative_t = t_k / 293.15
    # B.1 to B.3: molar concentration of water in percent, from 273.16 K, the triple point.
    saturation = 10.0 ** (-6.8346 * (273.16 / t_k) ** 1.261 + 4.6151)
    h = 100.0 * _checked("humidity", humidity) * saturation / relative_pressure
    oxygen_hz = relative_pressure * (24.0 + 4.04e4 * h * (0.02 + h) / (0.391 + h))
    nitrogen_hz = (
        relative_pressure * relative_t**-0.5 * (9.0 + 280.0 * h * np.exp(-4.170 * (relative_t ** (-1.0 / 3.0) - 1.0)))
    )
    classical = 1.84e-11 / relative_pressure * relative_t**0.5
    oxygen = 0.01275 * np.exp(-2239.1 / t_k) / (oxygen_hz + f**2 / oxygen_hz)
    nitrogen = 0.1068 * np.exp(-3352.0 / t_k) / (nitrogen_hz + f**2 / nitrogen_hz)
    absorption = 8.686 * f**2 * (classical + relative_t**-2.5 * (oxygen + nitrogen))
    return float(absorption) if np.ndim(absorption) == 0 else np.asarray(absorption)
