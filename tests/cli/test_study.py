"""`sonofix study`: the table, what is written, a stop halfway, and mistakes told in lines."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix import studies
from sonofix.cli.main import app
from sonofix.cli.study import found_text
from sonofix.draw.study_sheet import draw_study
from sonofix.records import Finding, Sheet


def ask(*options: object) -> str:
    told = CliRunner().invoke(app, ["study", *map(str, options)])
    assert told.exit_code == 0, told.output
    return told.stdout


def test_table_picture_curves_and_findings(tmp_path: Path) -> None:
    out = tmp_path / "q"
    told = ask("quasi-gps", "--runs", 30, "--waveforms", 0, "--seed", 2, "-o", out)
    assert "filtered, Q as printed: velocity" in told
    assert f"Written to {out}" in told
    found = json.loads((out / "findings.json").read_text("utf-8"))
    assert (found["study"], found["seed"]) == ("quasi-gps", 2)
    for finding in found["findings"]:
        assert found_text(Finding(**finding)) in told
        assert finding["runs"] == 30
    with (out / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["panel"] for row in rows} == {f"{axis}: as printed" for axis in ("x", "y", "vx", "vy")}
    assert {row["curve"] for row in rows} == {"true", "coarse", "filtered"}
    # true places at half a metre a second from half a metre on
    true = [(float(r["x"]), float(r["y"])) for r in rows if (r["panel"], r["curve"]) == ("x: as printed", "true")]
    assert len(true) == 36
    assert all(y == pytest.approx(0.5 + 0.5 * x) for x, y in true)
    assert (out / "study.png").read_bytes().startswith(b"\x89PNG")


def test_a_part_is_chosen_and_one_that_is_none_is_told(tmp_path: Path) -> None:
    ask("robots", "--part", "collision", "--runs", 2, "--waveforms", 0, "-o", tmp_path / "c", "--no-plot")
    content = json.loads((tmp_path / "c" / "findings.json").read_text("utf-8"))
    assert (content["study"], content["part"]) == ("robots", "collision")
    told = CliRunner().invoke(app, ["study", "robots", "--part", "leap"])
    assert told.exit_code == 2
    assert (
        told.stderr.strip()
        == "study robots, part leap: there is none of that name; choose of detection, collision, leapfrog"
    )


def test_same_seed_same_numbers_and_no_picture_where_none_is_wanted(tmp_path: Path) -> None:
    first, again, other = (
        ask("quasi-gps", "--runs", 5, "--waveforms", 0, "--seed", seed, "-o", tmp_path / str(i), "--no-plot")
        for i, seed in enumerate((1, 1, 2))
    )
    assert first.split("Written")[0] == again.split("Written")[0] != other.split("Written")[0]
    assert not (tmp_path / "0" / "study.png").exists()


def test_the_picture_shows_every_curve_within_its_panel() -> None:
    work = studies.begin("pedestrian", 1, 0, 0)
    for _ in work.work():
        pass
    sheet = work.sheet()
    assert sheet is not None
    figure = draw_study(sheet, [(f.case, f.quantity, found_text(f)) for f in sheet.findings])
    assert [axes.get_title("left") for axes in figure.axes] == [panel.title for panel in sheet.panels]
    for axes, panel in zip(figure.axes, sheet.panels, strict=True):
        assert [line.get_label() for line in axes.lines] == [curve.name for curve in panel.curves]
        low, high = axes.get_ylim()
        for curve in panel.curves:
            assert np.nanmax(curve.y) <= high
            assert np.nanmedian(curve.y) >= low
    written = {text.get_text() for text in figure.texts}
    assert {found_text(f) for f in sheet.findings} <= written


def test_maps_have_equal_axes_and_long_names_end_before_their_figures(caplog: pytest.LogCaptureFixture) -> None:
    work = studies.begin("robots", 2, 0, 0, "collision")
    for _ in work.work():
        pass
    sheet = work.sheet()
    assert sheet is not None
    found = [(f.case, f.quantity, found_text(f)) for f in sheet.findings]
    case, quantity, figure_text = found[0]
    found[0] = (f"{case}, and what else there is to say of it, told at length and without haste", quantity, figure_text)
    figure = draw_study(sheet, found)
    figure.draw_without_rendering()
    assert not caplog.records
    maps = [axes for axes in figure.axes if (axes.get_xlabel(), axes.get_ylabel()) == ("x, m", "y, m")]
    assert maps
    for axes in maps:
        (left, low), (right, high) = axes.transData.transform([(0.0, 0.0), (1.0, 1.0)])
        assert right - left == pytest.approx(high - low)
        assert np.ptp(axes.get_ylim()) >= 27.0 - 1e-9
    texts = {text.get_text(): text.get_window_extent() for text in figure.texts}
    for case, quantity, figure_text in found:
        name = texts[f"{case}: {quantity}"]
        beside = [
            text.get_window_extent()
            for text in figure.texts
            if text.get_text() == figure_text and abs(text.get_window_extent().y0 - name.y0) < 6
        ]
        assert any(box.x0 > name.x1 for box in beside)


class _Halted:
    """Does some pieces of a study, then is stopped."""

    def __init__(self, name: str, pieces: int) -> None:
        self._work, self._pieces = studies.begin(name, 60, 0, 0), pieces

    def work(self) -> Iterator[tuple[str, float]]:
        yield from islice(self._work.work(), self._pieces)
        raise KeyboardInterrupt

    def sheet(self) -> Sheet | None:
        return self._work.sheet()


def test_a_stop_keeps_what_is_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    halted = _Halted("quasi-gps", 1)
    monkeypatch.setattr(studies, "begin", lambda *_: halted)
    told = CliRunner().invoke(app, ["study", "quasi-gps", "-o", str(tmp_path / "q")])
    assert told.exit_code == 130
    assert told.stderr.strip() == "stopped; the table holds the runs that were finished"
    found = json.loads((tmp_path / "q" / "findings.json").read_text("utf-8"))
    assert {finding["runs"] for finding in found["findings"]} == {25}


def test_a_stop_before_anything_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    halted = _Halted("quasi-gps", 0)
    monkeypatch.setattr(studies, "begin", lambda *_: halted)
    told = CliRunner().invoke(app, ["study", "quasi-gps", "-o", str(tmp_path / "q")])
    assert told.exit_code == 130
    assert told.stderr.strip() == "stopped; no run was finished"
    assert not list((tmp_path / "q").iterdir())


def test_mistakes_are_lines(tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["study", "robot"])
    assert told.exit_code == 2
    assert told.stderr.strip() == "study robot: there is none of that name; there are quasi-gps, pedestrian, robots"
    (tmp_path / "site.toml").write_text("")
    told = CliRunner().invoke(app, ["study", "quasi-gps", "-o", str(tmp_path)])
    assert told.exit_code == 2
    assert "is a recording" in told.stderr


@pytest.mark.parametrize(
    ("value", "sd", "unit", "text"),
    [
        (0.03671, 0.00016, "m", "3.671 ± 0.016 cm"),
        (0.000107, None, "m", "0.107 mm"),
        (1.4397, 0.0457, "m", "1.440 ± 0.046 m"),
        (0.14089, 0.00068, "m/s", "14.089 ± 0.068 cm/s"),
        (0.997, 0.00018, "", "99.700 ± 0.018 %"),
        (0.0, 0.0, "m", "0.0 mm"),
        (4.9536, 0.0021, "V", "4.9536 ± 0.0021 V"),
        (4.97790012, 0.0000234, "V", "4.977900 ± 0.000023 V"),
        (2.049, 0.048, "1", "2.049 ± 0.048"),
    ],
)
def test_figures_read_well(value: float, sd: float | None, unit: str, text: str) -> None:
    assert found_text(Finding("c", "q", value, sd, unit, 3)) == text


def test_a_wanted_end_error_is_planned_leap_by_leap(tmp_path: Path) -> None:
    words = ("robots", "--part", "leapfrog", "--wanted-m", 0.08, "--runs", 1, "--waveforms", 0, "--no-plot")
    told = ask(*words, "-o", tmp_path / "l")
    assert "8 cm wanted; foreseen at the start: " in told
    with (tmp_path / "l" / "leaps.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = ["leap", "robot", "way_m", "x_m", "y_m", "step_m", "width_m", "sd_m", "end_sd_m", "left"]
    assert list(rows[0]) == columns
    assert 0.0 < float(rows[-1]["end_sd_m"]) < 1.05 * 0.08
    # each row stands in the table as well, whole on a narrow screen
    shown = [line.split() for line in told.splitlines()]
    assert columns[1:] in shown
    for row in rows:
        (line,) = [words for words in shown if words[:2] == [row["leap"], row["robot"]]]
        assert [float(word) for word in line[2:]] == pytest.approx([float(row[c]) for c in columns[2:]], abs=0.0051)
    refused = CliRunner().invoke(app, ["study", "robots", "--part", "collision", "--wanted-m", "0.05"])
    assert refused.exit_code == 2
    assert refused.stderr.strip() == "wanted_m 0.05: only study robots, part leapfrog plans for an end error"
