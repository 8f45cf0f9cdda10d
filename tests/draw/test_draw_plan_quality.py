"""The picture of a plan: its maps, and that all of it is on the sheet."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.text import Text

from sonofix.draw import style
from sonofix.draw.quality import draw_quality
from sonofix.records import Quality, Walls


def made(free: bool, nx: int = 31, ny: int = 19, fix: bool = True) -> Quality:
    x, y = np.linspace(0, 15, nx), np.linspace(0, 9, ny)
    east, north = np.meshgrid(x, y)
    floor = ~((np.abs(east - 5) < 1) & (np.abs(north - 4) < 1))
    sd = np.where(floor & (east < 13) & fix, 0.002 * np.exp(east / 5), np.nan)
    fault = np.where(north < 6, 20 * sd, np.where(np.isfinite(sd), np.inf, np.nan))
    return Quality(
        x_m=x,
        y_m=y,
        level_m=0.4,
        floor=floor,
        heard=np.where(floor, (1 + east // 3).astype(np.int64), 0),
        hdop=sd * 300,
        vdop=sd * 500 if free else None,
        sd_m=sd,
        sd_z_m=sd * 2 if free else None,
        fault_m=fault,
    )


WALLS = Walls(
    np.array([[4.0, 3], [6, 3], [6, 5], [4, 5], [10, 0], [12, 0]]),
    np.array([[6.0, 3], [6, 5], [4, 5], [4, 3], [10, 4], [12, 4]]),
    np.array([np.inf] * 4 + [np.inf, 2.0]),
    np.array([0, 0, 0, 0, -1, -1]),
)
BEACONS = {f"B{i}": np.array([1 + 4 * i, 8.5 * (i % 2), 3.0]) for i in range(4)}


def words(figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text() and text.get_visible()]


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("before", [False, True])
def test_nothing_is_written_off_the_sheet_or_over_each_other(free, before) -> None:
    figure = draw_quality(
        made(free),
        BEACONS,
        WALLS,
        title="A store with a name of some length",
        note="Bursts of 0.5 of full scale at 1 m, noise of -50.0 dB at 192 kHz: heard up to 23.5 m away",
        before=made(free, fix=False) if before else None,
        added=["B3"],
        moved={"B2": np.array([3.0, 3.0, 3.0])},
        room_m=((0, 0, 0), (15, 9, 4)),
    )
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    assert tuple(figure.get_size_inches()) == (16.0, 10.0)
    for axes in figure.axes:
        titles = [t.get_window_extent(renderer) for t in (axes._left_title, axes._right_title) if t.get_text()]
        for text in (*figure.texts, *axes.texts, axes._left_title, axes._right_title, axes.xaxis.label):
            if text.get_text():
                box = text.get_window_extent(renderer)
                assert box.x0 >= -1, text.get_text()
                assert box.y0 >= -1, text.get_text()
                assert box.x1 <= 1601, text.get_text()
                assert box.y1 <= 1001, text.get_text()
        if len(titles) == 2:
            assert titles[0].x1 < titles[1].x0, axes.get_title("left")
    boxes = [text.get_window_extent(renderer) for text in figure.texts]
    for i, one in enumerate(boxes):
        for other in boxes[i + 1 :]:
            assert not one.overlaps(other)


@pytest.mark.parametrize("free", [False, True])
def test_the_maps_are_named_and_show_the_values(free) -> None:
    quality = made(free)
    figure = draw_quality(quality, BEACONS, WALLS, title="store")
    titles = [axes.get_title("left") for axes in figure.axes if axes.get_title("left")]
    assert titles[:2] == ["Beacons heard", "HDOP"]
    assert titles[-1] == "Fault detected"
    assert ("VDOP" in titles) == ("Expected deviation of the height" in titles) == free
    assert len(titles) == (6 if free else 4)
    shown = {axes.get_title("left"): axes.images[-1].get_array() for axes in figure.axes if axes.get_title("left")}
    np.testing.assert_array_equal(np.ma.filled(shown["HDOP"], np.nan), quality.hdop)
    factor = np.nanmedian(np.ma.filled(shown["Expected deviation"], np.nan)) / np.nanmedian(quality.sd_m)
    assert factor == pytest.approx(1e3)  # millimetres


def test_key_figures_stand_before_and_after() -> None:
    after = made(False)
    figure = draw_quality(after, BEACONS, WALLS, title="store", before=made(False, fix=False), fault_m=0.5)
    told = words(figure)
    assert f"0 % → {100 * after.share(after.fix):.0f} %" in told
    assert "detects a fault of 50 cm" in told
    assert any(text.startswith("no fix → ") or text == "no fix" for text in told)


def test_the_legend_names_what_is_shown_and_nothing_else() -> None:
    def names(*args, **more) -> list[str]:
        return [text.get_text() for text in draw_quality(*args, title="", **more).legends[0].get_texts()]

    plain = names(made(False), BEACONS, Walls.none())
    assert plain == ["beacon", "no fix there, or no fault detected"]
    full = names(made(False), BEACONS, WALLS, added=["B1"], moved={"B2": np.zeros(3)})
    assert full == [
        "beacon",
        "new beacon",
        "moved beacon",
        "obstacle",
        "wall to the ceiling",
        "lower wall",
        "no fix there, or no fault detected",
    ]


def test_a_floor_without_any_fix_says_so() -> None:
    told = words(draw_quality(made(False, fix=False), BEACONS, WALLS, title="store"))
    assert told.count("no fix anywhere") == 2
    assert "no fault is detected anywhere" in told


def test_one_place_and_one_beacon_are_drawn() -> None:
    quality = made(True, 1, 1)
    figure = draw_quality(quality, {"B1": np.zeros(3)}, Walls.none(), title="a point")
    figure.canvas.draw()
    assert figure.axes[0].images[-1].get_array().shape == (1, 1)


@pytest.mark.parametrize("fix", [False, True])
def test_what_is_no_success_is_not_green(fix) -> None:
    figure = draw_quality(made(False, fix=fix), BEACONS, WALLS, title="store", fault_m=0.5)
    colours = {text.get_color() for text in figure.texts if text.get_text() in ("0 %", "no fix")}
    assert colours == {style.EXCLUDED}
    assert any(text.get_color() == style.GOOD for text in figure.texts) is fix
