"""Air against published values; each with its source, and a tolerance from its rounding or its stated uncertainty."""

from __future__ import annotations

import math

import pytest

from sonofix.air import absorption_db_per_m, sound_speed_linear_mps, sound_speed_mps, water_fraction


@pytest.mark.parametrize(
    ("temperature_c", "humidity", "pressure_kpa", "published_mps"),
    [(23.0, 0.50, 101.325, 345.86652), (20.0, 0.65, 80.0, 344.38267)],
)
def test_speed_equals_the_check_values_of_iec_61094_2(
    temperature_c: float, humidity: float, pressure_kpa: float, published_mps: float
) -> None:
    # IEC 61094-2:2009, table F.1, for 400 ppm of CO2: Cramer's polynomial with the vapour pressure of CIPM-2007 instead
    # of that in Cramer's appendix. The two vapour pressures differ by 0.03 %, which is 3·10⁻⁴ m/s.
    speed = sound_speed_mps(temperature_c, humidity, pressure_kpa, co2_fraction=4e-4)
    assert speed == pytest.approx(published_mps, abs=5e-4)


def test_speed_in_dry_air_at_freezing_point() -> None:
    # Cramer 1993: 331.45 m/s in dry air at 0 °C and 101.325 kPa with 314 ppm of CO2, rounded to 0.01.
    assert sound_speed_mps(0.0, 0.0, 101.325, 3.14e-4) == pytest.approx(331.45, abs=0.006)


def test_speed_agrees_with_the_reference_of_iso_9613_1() -> None:
    # ISO 9613-1:1993, annex A: 343.2 m/s at 20 °C in dry air, an ideal gas; Cramer's real gas is 0.05 % faster.
    assert sound_speed_mps(20.0, 0.0) == pytest.approx(343.2, rel=6e-4)


def test_linear_rule_by_hand() -> None:
    # c = 331.5 + 0.607 T: by hand 331.5 at 0 °C, 343.64 at 20 °C.
    assert sound_speed_linear_mps(0.0) == 331.5
    assert sound_speed_linear_mps(20.0) == pytest.approx(343.64, abs=1e-12)


@pytest.mark.parametrize(
    ("temperature_c", "saturation_kpa", "enhancement"),
    [(0.01, 0.6117, 1.0038), (20.0, 2.3393, 1.0040), (30.0, 4.2470, 1.0043)],
)
def test_saturated_air_holds_the_vapour_of_the_steam_tables(
    temperature_c: float, saturation_kpa: float, enhancement: float
) -> None:
    # Saturation pressure from the IAPWS steam tables, raised in air of one atmosphere by the enhancement factor of
    # Davis, Metrologia 29, 67 (1992); Giacomo's fit of 1982 lies within 0.1 % of them.
    fraction = float(water_fraction(temperature_c, 1.0, 101.325))
    assert fraction == pytest.approx(saturation_kpa * enhancement / 101.325, rel=1e-3)


# ISO 9613-1:1993, table 1 (pure tones, one standard atmosphere): °C, %, nominal Hz, dB/km to three figures.
ISO_9613_1_TABLE_1 = [
    (-20, 10, 50, 0.589),
    (-20, 30, 800, 4.92),
    (-20, 50, 1000, 9.14),
    (-20, 70, 8000, 27.8),
    (-20, 100, 10000, 47.0),
    (0, 10, 50, 0.302),
    (0, 50, 1000, 6.83),
    (0, 20, 2000, 34.6),
    (0, 100, 6300, 88.0),
    (5, 50, 1000, 5.08),
    (10, 10, 100, 0.585),
    (10, 10, 1000, 21.6),
    (10, 70, 1000, 3.66),
    (10, 50, 4000, 46.7),
    (15, 50, 1000, 4.16),
    (15, 100, 10000, 105.0),
    (20, 50, 1000, 4.66),
    (20, 50, 2000, 9.86),
    (20, 10, 5000, 133.0),
    (20, 80, 5000, 30.6),
    (20, 15, 6300, 175.0),
    (25, 50, 1000, 5.68),
    (25, 100, 2000, 11.4),
    (30, 50, 1000, 7.03),
    (30, 50, 4000, 24.5),
    (35, 50, 1000, 8.43),
    (35, 60, 4000, 25.8),
    (40, 50, 1000, 9.52),
    (45, 50, 800, 7.16),
    (50, 70, 1000, 8.03),
    (50, 50, 2000, 24.8),
]


@pytest.mark.parametrize(("temperature_c", "humidity_percent", "nominal_hz", "db_per_km"), ISO_9613_1_TABLE_1)
def test_absorption_equals_the_table_of_iso_9613_1(
    temperature_c: float, humidity_percent: float, nominal_hz: float, db_per_km: float
) -> None:
    # The table is computed at the exact third-octave midbands, 1000 · 10^(k/10) Hz (note 5 there), and printed to three
    # figures: half a unit in the third.
    exact_hz = 1000.0 * 10.0 ** (round(10.0 * math.log10(nominal_hz / 1000.0)) / 10.0)
    absorption = 1e3 * absorption_db_per_m(exact_hz, float(temperature_c), humidity_percent / 100.0)
    assert absorption == pytest.approx(db_per_km, abs=0.501 * 10.0 ** (math.floor(math.log10(db_per_km)) - 2))


@pytest.mark.parametrize(("frequency_hz", "measured_db_per_m"), [(30e3, 0.7), (200e3, 8.0)])
def test_absorption_of_ultrasound_agrees_with_measurement(frequency_hz: float, measured_db_per_m: float) -> None:
    # Lawrence and Simmons, J. Acoust. Soc. Am. 71, 585 (1982), abstract: measured at 25 °C and 50 %, to one figure.
    # With the standard's 10 % and the laboratory's own spread: within a third.
    assert absorption_db_per_m(frequency_hz, 25.0, 0.5) == pytest.approx(measured_db_per_m, rel=1 / 3)


def test_absorption_above_100_khz_exceeds_3_db_per_m() -> None:
    # Lawrence and Simmons 1982: "> 3 dB/m" for signals above 100 kHz at 25 °C and 50 %.
    assert 3.0 < absorption_db_per_m(100e3, 25.0, 0.5) < 5.0
