"""The picture of a set of codes: what it shows, and that all of it is on the sheet."""

import numpy as np
import pytest
from matplotlib.text import Text

from sonofix.draw.codes import LEVEL_MAP, draw_codes


def made(count: int, rates: int):
    """Levels whose worst pair is (1, 0), and a surface with its peak at a known place."""
    rng = np.random.default_rng(count)
    level_db = -15 + rng.random((count, count))
    level_db[1, 0] = -11.25
    np.fill_diagonal(level_db, -18.5)
    surface_db = -30 + 5 * rng.random((rates, 901))
    surface_db[rates // 2, 600] = -11.25
    difference = np.linspace(-4, 4, rates) if rates > 1 else np.zeros(1)
    names = [f"B{i + 1}  m9 {i},5,7" for i in range(count)]
    return names, level_db, surface_db, difference, np.linspace(-0.045, 0.045, 901), 343.0


def words(figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text() and text.get_visible()]


@pytest.mark.parametrize(("count", "rates"), [(2, 241), (8, 961), (8, 1), (40, 61)])
def test_nothing_is_written_off_the_sheet(count, rates):
    figure = draw_codes(*made(count, rates), title="Codes for a hall with a name", note="on-off keyed")
    figure.canvas.draw()
    assert tuple(figure.get_size_inches()) == (16.0, 10.0)
    for axes in figure.axes:
        labels = [*axes.get_xticklabels(), *axes.get_yticklabels()] if axes is figure.axes[0] else []
        for text in (*figure.texts, *axes.texts, axes._left_title, axes._right_title, axes.xaxis.label, *labels):
            if not text.get_text():
                continue
            box = text.get_window_extent(figure.canvas.get_renderer())
            assert box.x0 >= -1, text.get_text()
            assert box.y0 >= -1, text.get_text()
            assert box.x1 <= 1601, text.get_text()
            assert box.y1 <= 1001, text.get_text()


def test_the_worst_pair_is_named_and_ringed():
    names, level_db, *rest = made(6, 101)
    figure = draw_codes(names, level_db, *rest, title="six", note="")
    assert f"{names[1]}  in the search for  {names[0]}" in words(figure)
    assert "−11.2 dB" in words(figure)
    assert "−18.5 dB" in words(figure)
    # entry 600 of 901 from −45 to 45 ms, at the middle rate
    assert f"loudest at +{0.015 * 343:.2f} m, +0.00 m/s".replace("-", "−") in words(figure)
    frame = figure.axes[0].patches[-1]
    assert frame.get_xy() == (-0.5, 0.5)


def test_levels_are_written_while_they_can_be_read():
    few, many = (draw_codes(*made(n, 31), title="") for n in (8, 40))
    assert len(few.axes[0].texts) == 64
    assert not many.axes[0].texts


def test_a_map_gathered_into_fewer_cells_keeps_its_peak():
    names, level_db, surface_db, *rest = made(3, 901)
    figure = draw_codes(names, level_db, surface_db, *rest, title="")
    shown = figure.axes[1].images[0].get_array()
    assert shown.shape[0] < 901
    assert shown.max() == surface_db.max()
    i, j = np.unravel_index(np.argmax(shown), shown.shape)
    assert i / shown.shape[0] == pytest.approx(0.5, abs=0.01)
    assert j / shown.shape[1] == pytest.approx(600 / 901, abs=0.01)


def test_at_rest_the_picture_says_so():
    assert "nothing moves: −11.2 dB at rest" in words(draw_codes(*made(4, 1), title=""))


def test_louder_is_lighter():
    weight = np.array([0.2126, 0.7152, 0.0722])
    light = [float(np.array(LEVEL_MAP(x)[:3]) @ weight) for x in np.linspace(0, 1, 33)]
    assert (np.diff(light) > 0).all()
