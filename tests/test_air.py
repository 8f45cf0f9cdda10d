from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonofix import air

DOCS = Path(__file__).parents[1] / "docs" / "air.md"

temperatures = st.floats(-40, 60)
humidities = st.floats(0, 1)
pressures = st.floats(50, 120)


def ideal_gas_speed_mps(temperature_c: float, humidity: float) -> float:
    """Dry air and vapour as ideal gases of constant heat capacity: a model that shares nothing but the vapour."""
    water = float(air.water_fraction(temperature_c, humidity, 101.325))
    heat = 29.12 * (1 - water) + 33.6 * water
    mass = 28.9645e-3 * (1 - water) + 18.015e-3 * water
    return math.sqrt(heat / (heat - 8.314463) * 8.314463 * (temperature_c + 273.15) / mass)


@pytest.mark.parametrize("humidity", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("temperature_c", [-40.0, -20.0, 0.0, 10.0, 20.0, 30.0, 45.0, 60.0])
def test_extrapolated_speed_stays_near_an_ideal_gas(temperature_c: float, humidity: float) -> None:
    tolerance = 3e-3 if temperature_c > 45 and humidity == 1 else 1e-3
    expected = ideal_gas_speed_mps(temperature_c, humidity)
    assert air.sound_speed_mps(temperature_c, humidity) == pytest.approx(expected, rel=tolerance)


@given(temperatures, humidities, pressures)
def test_warmer_is_faster_by_about_six_decimetres_a_second(t: float, h: float, p: float) -> None:
    if t <= 59:
        slope = air.sound_speed_mps(t + 1, h, p) - air.sound_speed_mps(t, h, p)
        assert 0.5 < slope < 2.6


@given(temperatures, st.floats(0, 0.9), pressures)
def test_moister_is_never_slower(t: float, h: float, p: float) -> None:
    assert air.sound_speed_mps(t, h + 0.1, p) > air.sound_speed_mps(t, h, p)


def test_carbon_dioxide_slows_sound() -> None:
    # It stands in for oxygen (44 for 32 g/mol), with 8 J/(mol K) more heat capacity: for 1000 ppm an ideal gas loses
    # c/2 (12.0/28.96 + 8 (1/20.8 − 1/29.1)) 10⁻³ = 0.090 m/s.
    change = air.sound_speed_mps(20.0, co2_fraction=1.4e-3) - air.sound_speed_mps(20.0, co2_fraction=4e-4)
    assert change == pytest.approx(-0.090, abs=0.002)


def test_linear_rule_lies_near_dry_air() -> None:
    t = np.linspace(0.0, 30.0, 31)
    difference = air.sound_speed_linear_mps(t) - air.sound_speed_mps(t, 0.0)
    assert difference.min() > 0.05
    assert difference.max() < 0.57
    assert (air.sound_speed_linear_mps(t[10:]) < air.sound_speed_mps(t[10:], 0.5)).all()


def test_scalars_give_floats_and_arrays_broadcast() -> None:
    assert type(air.sound_speed_mps(20.0)) is float
    assert type(air.sound_speed_linear_mps(20.0)) is float
    assert type(air.absorption_db_per_m(40e3, 20.0)) is float
    t, h = np.array([0.0, 10.0, 20.0])[:, None], np.array([0.0, 1.0])
    grid = air.sound_speed_mps(t, h)
    assert grid.shape == (3, 2)
    assert grid[2, 1] == air.sound_speed_mps(20.0, 1.0)
    loss = air.absorption_db_per_m(np.array([1e3, 40e3]), 20.0, 0.5)
    assert loss[1] == air.absorption_db_per_m(40e3, 20.0, 0.5)


def test_default_air_is_half_humid_at_sea_level_today() -> None:
    assert air.sound_speed_mps(20.0) == air.sound_speed_mps(20.0, 0.5, 101.325, 4.2e-4)


@given(st.floats(10, 9e5), temperatures, humidities, pressures)
def test_absorption_is_positive_and_grows_with_frequency(f: float, t: float, h: float, p: float) -> None:
    low, high = air.absorption_db_per_m(f, t, h, p), air.absorption_db_per_m(1.1 * f, t, h, p)
    assert 0 < low < high


@given(st.floats(1e3, 4e5), temperatures, humidities)
def test_absorption_a_wavelength_depends_on_frequency_over_pressure(f: float, t: float, h: float) -> None:
    # Losses a wavelength depend on f/p and the molar humidity alone (ISO 9613-1): half the pressure, half the frequency
    # and half the relative humidity, half the loss a metre.
    full = air.absorption_db_per_m(2 * f, t, h, 100.0)
    half = air.absorption_db_per_m(f, t, h / 2, 50.0)
    assert half == pytest.approx(full / 2, rel=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: air.sound_speed_mps(-40.1), r"temperature_c = -40.1; valid is -40 to 60 °C"),
        (lambda: air.sound_speed_mps(293.15), r"temperature_c = 293.15; valid is -40 to 60 °C"),
        (lambda: air.sound_speed_mps(math.nan), r"temperature_c = nan; valid"),
        (lambda: air.sound_speed_mps(np.array([20.0, 61.0, 70.0])), r"temperature_c = 61; valid"),
        (lambda: air.sound_speed_mps(20.0, 50.0), r"humidity = 50; valid is 0 to 1 \(a fraction, not percent\)"),
        (lambda: air.sound_speed_mps(20.0, -0.1), r"humidity = -0.1; valid"),
        (lambda: air.sound_speed_mps(20.0, 0.5, 101325.0), r"pressure_kpa = 101325; valid is 50 to 120 kPa"),
        (lambda: air.sound_speed_mps(20.0, 0.5, 101.0, 420.0), r"co2_fraction = 420; valid is 0 to 0.01"),
        (lambda: air.sound_speed_linear_mps(100.0), r"temperature_c = 100; valid"),
        (lambda: air.absorption_db_per_m(0.0, 20.0), r"frequency_hz = 0; valid is 1 to 1e\+06 Hz"),
        (lambda: air.absorption_db_per_m(40e3, 20.0, 1.1), r"humidity = 1.1; valid"),
        (lambda: air.absorption_db_per_m(40e3, 99.0), r"temperature_c = 99; valid"),
        (lambda: air.water_fraction(20.0, 0.5, 0.0), r"pressure_kpa = 0; valid"),
    ],
)
def test_values_out_of_range_are_named(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_documented_figures_are_what_the_command_prints() -> None:
    blocks = re.findall(r"```(\w+)\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    (script,) = (text for kind, text in blocks if kind == "python")
    (shown,) = (text for kind, text in blocks if kind == "text")
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, encoding="utf-8")
    assert run.stdout.strip() == shown.strip()
