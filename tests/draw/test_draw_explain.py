"""The pictures of an epoch: what each panel holds, and how many pages there are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sonofix.draw.explain import draw_insight
from sonofix.draw.surfaces import shown_ways
from sonofix.records import BandInsight, BeaconInsight, Event, Insight, PathInsight, Stage

PANELS = {"Spectrum", "Power over time", "What was cancelled", "Paths found"}


def made_beacon(i: int, warm: bool = True) -> BeaconInsight:
    """A beacon at 2 + i m with an echo a metre on, and one tried path; the third was not heard."""
    ways, rates = np.linspace(0.0, 20.0, 400), np.linspace(-2.0, 2.0, 81)
    way, rate = 2.0 + i, 0.1 * i - 0.5
    plane = 30.0 * np.exp(-(((ways - way) / 0.1) ** 2) - ((rates[:, None] - rate) / 0.1) ** 2)
    paths = (
        PathInsight(way, 1.2e-3, rate, 0.01, 30.0, 0.1, True),
        PathInsight(way + 1.0, 2e-3, rate, 0.01, 20.0, 0.05, False),
        PathInsight(way + 2.0, None, rate, None, 8.0, 0.01, False, "stands 8.0 dB over the noise; 12.0 dB are asked"),
    )
    silent = i == 2
    return BeaconInsight(
        beacon=f"B{i}",
        range_m=ways,
        range_rate_mps=rates,
        heard_db=np.maximum(plane, 25.0).astype(np.float32),
        alone_db=(0.1 * plane if silent else plane).astype(np.float32),
        threshold_db=12.0,
        predicted=((way - 0.4, way + 0.5), (rate - 0.3, rate + 0.2)) if warm else None,
        paths=() if silent else paths,
        verdict="highest peak 9.0 dB over the noise; 12.0 dB are asked" if silent else "",
    )


def made(count: int, warm: bool = True, carriers: tuple[float, ...] = (40e3,)) -> Insight:
    time_s = np.linspace(1.0, 1.2, 500)
    aside = np.zeros(500, bool)
    aside[100:110] = True
    bands = tuple(
        BandInsight(
            carrier_hz=carrier_hz,
            edges_hz=(carrier_hz - 4e3, carrier_hz + 4e3),
            frequency_hz=carrier_hz + np.linspace(-4e3, 4e3, 160),
            heard_db=np.linspace(-60, -50, 160),
            clean_db=np.linspace(-62, -52, 160),
            left_db=np.full(160, -80.0),
            quiet_db=-79.0,
            tones_hz=(carrier_hz + 500.0,),
            time_s=time_s,
            heard_power_db=np.full(500, 20.0),
            left_power_db=np.full(500, 0.5),
            aside=aside,
            stages=(
                Stage("as heard", (), 20.0),
                Stage("tones", (), 15.0),
                Stage("burst", ("B0", "B1"), 6.0),
                Stage("echo", ("B0",), 2.0),
                Stage("dropped", ("B3",), 2.1),
                Stage("refined", (), 0.5),
            ),
            beacons=tuple(made_beacon(i, warm) for i in range(count)),
        )
        for carrier_hz in carriers
    )
    return Insight(
        epoch=12,
        sync_s=6.0,
        microphone="M1",
        search="warm" if warm else "cold: no track says where to look",
        sound_speed_mps=343.0,
        clock="known",
        frequency_hz=np.linspace(0, 96e3, 2000),
        spectrum_db=np.full(2000, -79.0),
        bands=bands,
        detections=(),
        notes=("a tone at 40.500 kHz, 9 dB over all else in the band, was taken out",),
        used={"B0": True, "B1": False},
        events=(Event(6.0, "agv", "lost", "no fix for 2 s"),),
    )


def panels(figure: Figure) -> dict:
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def words(figure: Figure) -> str:
    return "\n".join(t.get_text() for t in [*figure.texts, *(t for axes in figure.axes for t in axes.texts)])


def test_pages_hold_eight_beacons_each() -> None:
    assert set(draw_insight(made(8))) == {"overview", "beacons"}
    pages = draw_insight(made(19))
    assert list(pages) == ["overview", "beacons", "beacons-2", "beacons-3"]
    # two maps and a scale each
    assert [len(pages[page].axes) for page in list(pages)[1:]] == [24, 24, 9]
    assert "B16" in words(pages["beacons-3"])
    assert "B16" not in words(pages["beacons-2"])
    assert set(draw_insight(made(0))) == {"overview"}


def test_carriers_have_pages_of_their_own() -> None:
    pages = draw_insight(made(1, carriers=(40e3, 25e3)))
    assert set(pages) == {"40kHz-overview", "40kHz-beacons", "25kHz-overview", "25kHz-beacons"}


@pytest.mark.parametrize("warm", [True, False])
def test_headings_say_epoch_time_microphone_and_how(warm: bool) -> None:
    for page, figure in draw_insight(made(3, warm), "hall").items():
        text = words(figure)
        assert "Epoch 12 at 6.000 s" in text
        assert "microphone M1" in text
        assert "hall" in text
        assert ("warm search" in text) == warm, page
        assert ("cold search, as no track says where to look" in text) == (not warm)


def test_the_overview_holds_what_was_seen() -> None:
    told = made(4)
    band = told.bands[0]
    figure = draw_insight(told)["overview"]
    there = panels(figure)
    assert set(there) == PANELS
    spectrum = {line.get_label(): line for line in there["Spectrum"].lines}
    np.testing.assert_allclose(spectrum["bursts taken out too"].get_ydata(), band.left_db)
    np.testing.assert_allclose(spectrum["tones and clicks taken out"].get_xdata(), band.frequency_hz / 1e3)
    assert list(spectrum["quiet margins"].get_ydata()) == [-79.0, -79.0]
    edges = [line.get_xdata()[0] for line in there["Spectrum"].lines if list(line.get_ydata()) == [0, 1]]
    assert edges == [36.0, 44.0]
    np.testing.assert_allclose(there["What was cancelled"].lines[0].get_ydata(), [s.left_db for s in band.stages])
    assert "B0 B1" in words(figure)
    text = words(figure)
    for line in told.left_out(band.beacons):
        assert line.split(";")[0] in text
    assert "B2: no range" in text
    assert "B1: ranged, but believed by no fix nor track." in text
    assert "3 of 4" in text


def test_paths_stand_at_their_way_and_level() -> None:
    told = made(3)
    axes = panels(draw_insight(told)["overview"])["Paths found"]
    marks = {(line.get_marker(), *np.round((line.get_xdata()[0], line.get_ydata()[0]), 6)) for line in axes.lines
             if len(line.get_xdata()) == 1}  # fmt: skip
    # rows from the top; 0.86 of a row is the loudest of all
    for row, beacon in ((2, told.bands[0].beacons[0]), (1, told.bands[0].beacons[1])):
        first, later, dropped = beacon.paths
        top = 0.86 / 30.0 * np.array([first.level_db, later.level_db, dropped.level_db])
        tallest = max(float(b.alone_db.max()) for b in told.bands[0].beacons)
        top *= 30.0 / tallest
        assert ("v", round(first.range_m, 6), round(row + top[0], 6)) in marks
        assert ("o", round(later.range_m, 6), round(row + top[1], 6)) in marks
        inside = axes.get_xlim()[0] <= dropped.range_m <= axes.get_xlim()[1]
        assert inside == (row == 2)
        assert (("x", round(dropped.range_m, 6), round(row + top[2], 6)) in marks) == inside
    text = "\n".join(t.get_text() for t in axes.texts)
    assert "2.000 m ± 1.20 mm\n30 dB, \u22120.50 m/s" in text
    assert "no range" in text
    bands = [c for c in axes.collections if isinstance(c, PolyCollection)]
    starts = {round(float(c.get_paths()[0].vertices[:, 0].min()), 6) for c in bands}
    assert {1.6, 2.6} <= starts


def test_maps_show_the_plane_where_it_matters() -> None:
    told = made(3)
    figure = draw_insight(told)["beacons"]
    beacon = told.bands[0].beacons[0]
    heard, alone = figure.axes[0], figure.axes[1]
    assert heard.get_xlim() == alone.get_xlim() == pytest.approx(shown_ways(beacon))
    low, high = shown_ways(beacon)
    assert low < 1.6
    assert high > 3.0
    (image,) = alone.get_images()
    cells = np.asarray(image.get_array())
    row, column = np.unravel_index(np.argmax(cells), cells.shape)
    left, right, bottom, top = image.get_extent()
    assert left + (column + 0.5) * (right - left) / cells.shape[1] == pytest.approx(2.0, abs=0.06)
    assert bottom + (row + 0.5) * (top - bottom) / cells.shape[0] == pytest.approx(-0.5, abs=0.06)
    boxes = [patch for patch in heard.patches if isinstance(patch, Rectangle)]
    assert {tuple(np.round((*b.get_xy(), b.get_width(), b.get_height()), 6)) for b in boxes} == {(1.6, -0.8, 0.9, 0.5)}
    rings = [line for line in alone.lines if line.get_marker() == "o"]
    assert {round(line.get_xdata()[0], 6) for line in rings} == {2.0, 3.0}
    assert not [line for line in heard.lines if line.get_marker() == "o"]
    # what was not heard is shown over its whole window, with the reason
    assert shown_ways(told.bands[0].beacons[2]) == (0.0, 20.0)
    assert "highest peak 9.0 dB over the noise" in words(figure)
    assert "not used" in words(figure)


def test_what_is_missing_is_drawn_as_missing() -> None:
    told = made(2, warm=False)
    band = told.bands[0]
    empty = replace(
        band.beacons[0], range_m=np.zeros(0), heard_db=np.zeros((81, 0), np.float32),
        alone_db=np.zeros((81, 0), np.float32), paths=(), verdict="no samples of its window",
    )  # fmt: skip
    stages = tuple(Stage("echo", ("B0",), 20.0 - 0.1 * i) for i in range(90))
    bare = replace(band, beacons=(empty,), quiet_db=None, tones_hz=(), aside=np.zeros(500, bool), stages=stages)
    pages = draw_insight(replace(told, bands=(bare,), notes=(), events=(), used={}))
    assert "no samples of its window" in words(pages["overview"])
    assert "no samples" in words(pages["beacons"])
    for figure in pages.values():
        figure.canvas.draw()
