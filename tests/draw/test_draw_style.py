"""The house style: round numbers, units, and colours that all can tell apart."""

import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb

from sonofix.draw import style

# Full dichromacy in linear RGB: Machado, Oliveira and Fernandes 2009, table 1, severity 1.0.
DICHROMATS = {
    "normal": np.eye(3),
    "protan": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deutan": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritan": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
# Differences below this are hard to see between small marks (about 2.3 is the least that can be seen at all).
PLAIN = 9.0


def seen(colour: str, eye: np.ndarray) -> np.ndarray:
    """CIELAB coordinates of a colour as an eye sees it."""
    code = np.array(to_rgb(colour))
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    x, y, z = (_XYZ @ np.clip(eye @ linear, 0, 1)) / (_XYZ @ np.ones(3))
    fx, fy, fz = (np.cbrt(v) if v > 0.008856 else 7.787 * v + 16 / 116 for v in (x, y, z))
    return np.array([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)])


@pytest.mark.parametrize("eye", DICHROMATS)
@pytest.mark.parametrize("colours", [style.CATEGORIES[:6], (style.USED, style.EXCLUDED, style.PANEL)])
def test_colours_can_be_told_apart(eye, colours):
    places = [seen(colour, DICHROMATS[eye]) for colour in colours]
    for i, a in enumerate(places):
        for j in range(i):
            assert np.linalg.norm(a - places[j]) > PLAIN, (colours[i], colours[j])


def test_time_runs_one_way_in_lightness_for_every_eye():
    hues = [to_hex(style.TIME_MAP(x)) for x in np.linspace(0, 1, 9)]
    for eye in DICHROMATS.values():
        lightness = [seen(hue, eye)[0] for hue in hues]
        assert (np.diff(lightness) > 0).all()


@pytest.mark.parametrize(
    ("value", "expected"), [(1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (4.9, 2.0), (0.0057, 0.005), (830.0, 500.0)]
)
def test_round_below(value, expected):
    assert style.round_below(value) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("length_m", "expected"),
    [(0.00043, "0.43 mm"), (-0.0213, "-21.3 mm"), (0.521, "52.1 cm"), (3.851, "3.85 m"), (0.0, "0 mm")],
)
def test_lengths_read_well(length_m, expected):
    assert style.length_text(length_m) == expected
