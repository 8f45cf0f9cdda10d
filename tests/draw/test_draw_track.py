"""Pictures of runs: what they show, and that it can be read."""

import subprocess
import sys
from dataclasses import replace
from io import BytesIO

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from sonofix.draw.track import draw_track

RUNS = ("driving", "standing", "lost", "team", "sounding", "long")


@pytest.fixture(scope="module")
def pictures(request) -> dict[str, Figure]:
    """Every kind of run, drawn once."""
    drawn = {}
    for name in RUNS:
        run = request.getfixturevalue(name)
        drawn[name] = draw_track(run.recording, run.steps, run.truths)
        drawn[name].canvas.draw()
    return drawn


def words(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text() and text.get_visible()]


def plan(figure: Figure):
    return figure.axes[0]


def drawn(figure: Figure) -> list[Text]:
    """All texts but the labels of ticks, which exist for ticks outside the limits as well."""
    found = [*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())]
    for axes in figure.axes:
        found += [axes.title, axes._left_title, axes._right_title, axes.xaxis.label, axes.yaxis.label]
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        for text in axes.texts:
            x, y = getattr(text, "xy", (left, low))
            if getattr(text, "xycoords", "") != "data" or (left <= x <= right and low <= y <= high):
                found.append(text)
    return [text for text in found if text.get_text()]


@pytest.mark.parametrize("name", RUNS)
def test_nothing_is_written_off_the_sheet(pictures, name):
    figure = pictures[name]
    for text in drawn(figure):
        box = text.get_window_extent(figure.canvas.get_renderer())
        assert box.x0 >= -1, text.get_text()
        assert box.y0 >= -1, text.get_text()
        assert box.x1 <= 1601, text.get_text()
        assert box.y1 <= 1001, text.get_text()


@pytest.mark.parametrize("name", RUNS)
def test_plan_is_to_scale_and_of_one_size(pictures, name):
    figure = pictures[name]
    assert tuple(figure.get_size_inches() * figure.dpi) == (1600, 1000)
    axes = plan(figure)
    box = axes.get_window_extent()
    across = box.width / np.ptp(axes.get_xlim())
    assert across == pytest.approx(box.height / np.ptp(axes.get_ylim()), rel=1e-9)


def test_driving_shows_hall_track_truth_and_panels(pictures, driving):
    figure = pictures["driving"]
    said = words(figure)
    for expected in ("hall", "B1", "B6", "start", "end", "true path", "east", "north", "up", "Heard, by beacon"):
        assert expected in said
    assert any(text.startswith("95 % ellipse × ") for text in said)
    assert f"{len(driving.steps)} epochs" in " ".join(said)
    low, high = figure.axes[1].get_xlim()
    assert low < driving.steps[0].ranges.time_s[0]
    assert driving.steps[-1].ranges.time_s[-1] < high


def test_key_figure_is_the_rms_error(pictures, driving):
    errors = []
    for step in driving.steps:
        for estimate in step.estimates:
            truth = driving.truths["agv"]
            true = [np.interp(estimate.time_s, truth.time_s, truth.position_m[:, k]) for k in range(2)]
            errors.append(np.hypot(*(estimate.position_m[:2] - true)))
    rms_mm = 1e3 * np.sqrt(np.mean(np.square(errors)))
    assert f"{rms_mm:.3g} mm" in words(pictures["driving"])


def test_a_parked_vehicle_is_enlarged(pictures):
    said = words(pictures["standing"])
    assert any("enlarged" in text for text in said)
    assert "start" not in said
    assert not any("enlarged" in text for text in words(pictures["driving"]))


def test_no_fix_says_so_and_what_would_help(pictures):
    said = words(pictures["lost"])
    assert "No fix" in said
    assert any("add beacons" in text.replace("\n", " ") for text in said)
    assert "no fix, so no residuals" in said


def test_several_vehicles_are_named(pictures):
    said = words(pictures["team"])
    for vehicle in ("K", "R1", "R2"):
        assert said.count(vehicle) >= 3  # legend, end of the track, error panel
    assert "horizontal" in said
    assert not any("coloured by time" in text for text in said)


def test_without_truth_fixes_are_compared_with_the_track(pictures):
    said = words(pictures["sounding"])
    assert any(text.startswith("Fixes about the track") for text in said)
    assert "true path" not in said
    assert "M5" in said
    assert "Heard, by microphone" in said


def test_a_run_without_epochs_is_a_picture_too(driving):
    figure = draw_track(driving.recording, [], {})
    said = words(figure)
    assert "No fix" in said
    assert "The recording holds no whole epoch." in said
    figure.savefig(BytesIO())


def test_one_epoch_is_a_picture_too(driving):
    figure = draw_track(driving.recording, driving.steps[:1], driving.truths)
    figure.savefig(BytesIO())
    assert "1 epoch" in " ".join(words(figure))


def test_estimates_of_little_known_do_not_break_it(driving):
    """No covariance of x and y, no velocity, wild places: what a filter may say while it is lost."""
    steps = []
    for step in driving.steps[:6]:
        known = [
            replace(e, states=("clock",), covariance=np.eye(1), velocity_mps=np.full(3, np.nan)) for e in step.estimates
        ]
        steps.append(replace(step, estimates=tuple(known)))
    draw_track(driving.recording, steps, {}).savefig(BytesIO())


def test_style_stays_in_the_house(driving):
    before = dict(mpl.rcParams)
    draw_track(driving.recording, driving.steps, driving.truths)
    assert dict(mpl.rcParams) == before


def test_no_window_toolkit_is_touched():
    code = "import sys; import sonofix.draw.track; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
