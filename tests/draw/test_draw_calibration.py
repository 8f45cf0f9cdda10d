"""The picture of a calibration: what each panel holds."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.draw.calibration import draw_calibration
from sonofix.records import Calibration
from sonofix.survey.burst import calibrate
from survey.made_bench import bench, distorted, record

PANELS = {
    "The burst",
    "Its first chips, laid upon each other",
    "What single bursts leave",
    "What one chip sounds like",
    "Timing, burst by burst",
}


@pytest.fixture(scope="module")
def learnt() -> Calibration:
    return calibrate(record(distorted(), bench()), "B1", "M")


def test_panels_hold_what_was_learnt(learnt: Calibration) -> None:
    figure = draw_calibration(learnt, "Beacon B1, bench")
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes}
    assert set(panels) == PANELS
    timing = panels["Timing, burst by burst"].lines[0]
    np.testing.assert_allclose(np.asarray(timing.get_ydata()) * 1e-9, learnt.pace.residual_s, atol=1e-12)
    ours, theirs = panels["Its first chips, laid upon each other"].lines
    # narrower transducers rise more slowly
    rise_ms = [np.asarray(line.get_xdata())[np.argmax(np.asarray(line.get_ydata()) > 0.9)] for line in (ours, theirs)]
    assert rise_ms[0] > rise_ms[1] + 0.1
    words = {text.get_text() for text in figure.texts}
    assert {"Beacon B1, bench", f"{1e6 * (learnt.delay_s or 0):.2f} µs", "delay"} <= words


def test_without_code_the_picture_says_so() -> None:
    learnt = calibrate(record(distorted(synchronised=False), bench(code=None, synchronised=False)), "B1", "M")
    figure = draw_calibration(learnt)
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes}
    assert set(panels) == PANELS
    assert any("code is not known" in text.get_text() for text in panels["What one chip sounds like"].texts)
    assert "period" in {text.get_text() for text in figure.texts}
