"""The picture of a survey: what it shows, and that all of it is on the sheet."""

import numpy as np
import pytest
from matplotlib.patches import Ellipse
from matplotlib.text import Text

from sonofix.draw.survey import draw_survey
from sonofix.records import OpenDirection, Survey, SurveyedBeacon


def made(count: int = 6, sd_m: float = 0.002, guess_sd: float | None = 0.3, known: int = 0) -> Survey:
    rng = np.random.default_rng(count)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = np.column_stack([5 + 5 * np.cos(angle), 4 + 4 * np.sin(angle), np.full(count, 3.0)])
    beacons = tuple(
        SurveyedBeacon(
            f"B{i + 1}", place if i < known else place + 0.3 * rng.standard_normal(3), place,
            0.0 if i < known else guess_sd, np.zeros((3, 3)) if i < known else np.diag([1.0, 2.0, 4.0]) * sd_m**2,
            0.01, 1e-3, 40, 39, 8e-4,
        )
        for i, place in enumerate(places)
    )  # fmt: skip
    t = np.arange(50.0)
    way = np.column_stack([t, 5 + 3 * np.sin(t / 7), 4 + 2 * np.sin(t / 4), 0 * t])
    joint = np.zeros((3 * count, 3 * count))
    opened = (OpenDirection(np.eye(count, 3), np.inf, 0.3, "B1 up or back"),) if sd_m > 0.1 else ()
    return Survey(
        "open" if opened else "ok", "drive again", beacons, joint, "shift and turn", {"x_m": 0.1}, "", opened, (),
        343.2, 0.1, 343.2, 0.6, None, None, {"cart": way}, 240, 3, 0.2, 7e-4, 3e-4, 1.0, (),
    )  # fmt: skip


CASES = [made(), made(count=30), made(sd_m=0.3), made(sd_m=40.0), made(guess_sd=None), made(known=2), made(known=6)]


@pytest.mark.parametrize("found", CASES)
def test_nothing_is_written_off_the_sheet(found: Survey) -> None:
    figure = draw_survey(found, "A hall with a name", ((0, 0, 0), (10, 8, 3.5)))
    figure.canvas.draw()
    assert tuple(figure.get_size_inches()) == (16.0, 10.0)
    # ticks beyond an axis' ends are not drawn
    both = [axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)]
    ticks = {text for axis in both for text in axis.get_ticklabels(which="both")}
    for text in set(figure.findobj(Text)) - ticks:
        if not text.get_text() or not text.get_visible():
            continue
        box = text.get_window_extent(figure.canvas.get_renderer())
        if box.width == 0:
            continue
        assert box.x0 >= -1, text.get_text()
        assert box.x1 <= 1601, text.get_text()
        assert box.y0 >= -1, text.get_text()
        assert box.y1 <= 1001, text.get_text()


def test_ellipses_stand_where_beacons_are_and_are_enlarged_as_told() -> None:
    found = made()
    figure = draw_survey(found)
    plan = figure.axes[0]
    ellipses = [p for p in plan.patches if isinstance(p, Ellipse)]
    assert len(ellipses) == 6
    assert ellipses[0].center == pytest.approx(tuple(found.beacons[0].position_m[:2]))
    told = next(t.get_text() for t in plan.get_legend().get_texts() if "95 %" in t.get_text())
    factor = int(told.split(",")[1].split()[0])
    # the larger axis is y's: √2 of 2 mm, 2.4477 deviations to either side
    assert max(ellipses[0].width, ellipses[0].height) == pytest.approx(2 * 2.4477 * factor * 0.002 * np.sqrt(2))


def test_known_beacons_have_no_ellipse_and_no_arrow() -> None:
    plan = draw_survey(made(known=6)).axes[0]
    assert not [p for p in plan.patches if isinstance(p, Ellipse)]
    assert "known" in [t.get_text() for t in plan.get_legend().get_texts()]


def test_open_directions_are_counted_in_the_head() -> None:
    words = [t.get_text() for t in draw_survey(made(sd_m=0.3)).texts]
    assert any("1 direction stays unknown" in w for w in words)
