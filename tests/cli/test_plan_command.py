"""`sonofix plan`: the example of its page, what it writes, and mistakes told in lines."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix.cli.main import app
from sonofix.files import read_site

PAGE = Path(__file__).parents[2] / "docs" / "plan.md"
FAST = ("--spacing", "1", "--no-plot")


def block(language: str, number: int = 0) -> str:
    found = re.findall(rf"^```{language}\n(.*?)^```$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    return found[number]


@pytest.fixture
def store(tmp_path, monkeypatch) -> Path:
    """Lay out the example of the page; its folder is the working one's `store`."""
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "site.toml").write_text(block("toml"), "utf-8")
    (tmp_path / "store" / "shelves.geojson").write_text(block("json"), "utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "store"


def ask(*options: object) -> str:
    told = CliRunner().invoke(app, ["plan", *map(str, options)])
    assert told.exit_code == 0, told.stderr
    return told.stdout


def refused(*options: object) -> str:
    told = CliRunner().invoke(app, ["plan", *map(str, options)])
    assert told.exit_code == 2, told.stdout
    return told.stderr


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "plan.csv").open() as file:
        return list(csv.DictReader(file))


def figure(output: str, name: str) -> list[str]:
    (line,) = [line for line in output.splitlines() if line.startswith(name)]
    return re.split(r"\s{2,}", line.strip())[1:]


def test_the_page_shows_what_the_command_prints_and_draws(store) -> None:
    command = block("sh").split("\n")[0].split()
    assert command[:2] == ["sonofix", "plan"]
    output = ask(*command[2:])
    assert [line.rstrip() for line in output.strip().splitlines()] == block("text").strip().splitlines()
    assert (store / "plan" / "plan.png").read_bytes().startswith(b"\x89PNG")
    shown = PAGE.with_name("plan.png").read_bytes()
    assert shown.startswith(b"\x89PNG")
    assert len(shown) < 250_000


def test_the_table_holds_every_place_and_the_figures(store) -> None:
    output = ask(store, "--walls", store / "shelves.geojson", "-o", store / "p", *FAST)
    table = rows(store / "p")
    assert len(table) == 21 * 13
    assert list(table[0]) == block_columns()
    assert [row["x_m"] for row in table[:3]] == ["0.000", "1.000", "2.000"]
    assert {row["z_m"] for row in table} == {"0.400"}
    inside = [r for r in table if 4 < float(r["x_m"]) < 13 and r["y_m"] in ("3.000", "8.000")]
    assert inside
    assert all(r["heard"] == r["sd_m"] == r["fault_linear_m"] == "" for r in inside)
    floor = [r for r in table if r["heard"]]
    fixed = [r for r in floor if r["sd_m"]]
    assert figure(output, "floor with a fix") == [f"{100 * len(fixed) / len(floor):.1f} %"]
    assert all(int(r["heard"]) >= 2 and float(r["hdop"]) > 0.5 for r in fixed)
    assert all(r["vdop"] == r["sd_z_m"] == "" for r in floor)
    assert all(int(r["heard"]) >= 3 for r in floor if r["fault_linear_m"])
    assert not (store / "p" / "improved.toml").exists()


def block_columns() -> list[str]:
    (columns,) = re.findall(r"`plan.csv` begins `([\w,]+)`", PAGE.read_text("utf-8"))
    return columns.split(",")


def test_an_improved_site_is_a_site_that_is_as_good_as_told(store) -> None:
    first = ask(store, "--improve", 2, "-o", store / "p", *FAST)
    new = read_site(store / "p" / "improved.toml")
    old = read_site(store)
    assert new.beacons[:5] == old.beacons
    assert [b.id for b in new.beacons[5:]] == ["B6", "B7"]
    assert new.vehicles == old.vehicles
    again = ask(store / "p" / "improved.toml", "-o", store / "q", *FAST)
    name = "expected deviation, 95 % of the floor within"
    before, after = figure(first, name)
    assert before != after
    told, found = (float(text.split()[0]) for text in (after, figure(again, name)[0]))
    assert found == pytest.approx(told, rel=0.03)  # the new beacons' own codes differ a little from the first's
    for beacon in new.beacons[5:]:
        assert f"{beacon.id}: new at ({', '.join(f'{v:g}' for v in beacon.position_m or ())}) m" in first


def test_the_site_that_is_planned_is_never_overwritten(store) -> None:
    ask(store, "--improve", 1, "-o", store / "p", *FAST)
    site = store / "p" / "improved.toml"
    text = site.read_text("utf-8")
    assert "would be replaced by what is written" in refused(site, "-o", store / "p", *FAST)
    assert site.read_text("utf-8") == text
    ask(site, *FAST)
    assert (store / "p" / "plan" / "plan.csv").exists()


def test_beacons_marked_free_are_moved_and_others_are_not(store) -> None:
    site = store / "site.toml"
    text = site.read_text("utf-8").replace("[19.5, 11.5, 4.5]\n", "[1.5, 1.5, 4.5]\nposition_sd_m = 3.0\n")
    site.write_text(text, "utf-8")
    output = ask(site, "--improve", 0, "--move", *FAST)
    new, old = read_site(store / "plan" / "improved.toml"), read_site(site)
    assert [b.id for b, was in zip(new.beacons, old.beacons, strict=True) if b.position_m != was.position_m] == ["B3"]
    assert new.beacons[2].position_sd_m == 0
    assert "B3: moved from (1.5, 1.5, 4.5) m to" in output
    # without --move it stays, and its 3 m make it worthless
    ask(site, *FAST)
    assert not (store / "plan" / "improved.toml").exists()


def test_places_are_where_they_are_allowed(store) -> None:
    places = store / "places.csv"
    places.write_text("x_m,y_m,z_m\n3,11.9,4.5\n18,3,4.5\n6,0.1,4.5\n", "utf-8")
    ask(store, "--improve", 2, "--places", places, *FAST)
    new = read_site(store / "plan" / "improved.toml")
    allowed = {(3.0, 11.9, 4.5), (18.0, 3.0, 4.5), (6.0, 0.1, 4.5)}
    assert {b.position_m for b in new.beacons[5:]} < allowed


def test_a_measured_snr_stands_for_the_level(store) -> None:
    loud, quiet = (ask(store, "--snr", f"{snr}@5", "-o", store / "p", *FAST) for snr in (30, 0))
    far = [float(re.findall(r"heard up to ([\d.]+)", text)[0]) for text in (loud, quiet)]
    assert far[0] > far[1] + 8
    level = re.findall(r"Bursts of ([\d.]+) of full scale", loud)[0]
    same = ask(store, "--level", level, "-o", store / "p", *FAST)
    assert figure(same, "expected deviation, median") == figure(loud, "expected deviation, median")


def test_ranges_of_stated_deviation_need_no_codes(store) -> None:
    site = store / "site.toml"
    site.write_text(re.sub(r"code = .*\n", "", site.read_text("utf-8")), "utf-8")
    output = ask(site, *FAST)
    assert "Ranges of 100 mm deviation (no beacon has a code" in output
    finer = ask(site, "--range-sd", 0.01, "--reach", 15, *FAST)
    assert "Ranges of 10 mm deviation, up to 15 m away" in finer
    ratio = [float(figure(text, "expected deviation, median")[0].split()[0]) for text in (output, finer)]
    assert ratio[0] > 5 * ratio[1]
    improved = ask(site, "--range-sd", 0.01, "--improve", 1, *FAST)
    assert "new at" in improved
    assert read_site(store / "plan" / "improved.toml").beacons[5].code is None


def test_a_vehicle_of_unknown_level_gets_heights(store) -> None:
    site = store / "site.toml"
    site.write_text(site.read_text("utf-8").replace("z_m = 0.0\n", ""), "utf-8")
    output = ask(site, *FAST)
    assert "Unknown at each place: x, y, z." in output
    assert figure(output, "VDOP, 95 % of the floor within")
    table = rows(store / "plan")
    assert all(bool(row["vdop"]) == bool(row["hdop"]) == bool(row["sd_z_m"]) for row in table)
    assert any(row["vdop"] for row in table)


def test_a_recording_tells_its_rate_and_is_not_written_into(store) -> None:
    from sonofix.files import read_recording

    told = CliRunner().invoke(
        app,
        ["simulate", str(store / "site.toml"), "run", "--motion", "still:3,3", "--duration", "0.6", "--rate", "96000"],
    )
    assert told.exit_code == 0, told.stderr
    assert read_recording("run").rate_hz == 96000
    assert "at 96 kHz" in ask("run", *FAST)
    assert (Path("run") / "plan" / "plan.csv").exists()
    assert "is a recording" in refused("run", "-o", "run", *FAST)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--goal", "best"), "--goal best: it must be error or faults"),
        (("--improve", 0), "--improve 0: nothing to place"),
        (("--move",), "--move: nothing to place"),
        (("--goal", "faults"), "--goal faults: nothing is placed without --improve or --move"),
        (("--places", "p.csv"), "--places p.csv: nothing is placed without --improve or --move"),
        (("--aim", "centre"), "--aim centre: only beams point anywhere; give --beam as well"),
        (("--range-sd", 0.1, "--beam", 60), "--range-sd with --beam: "),
        (("--range-sd", 0.1, "--noise-db", -40, "--rate", 96000), "--range-sd with --noise-db, --rate: "),
        (("--range-sd", 0.1, "--level", 1), "--range-sd with --level: "),
        (("--walls", "."), ".: cannot be read: it is a folder"),
        (("--fault", 0), "--fault 0: it must be above 0"),
        (("--spacing", 0), "spacing_m = 0; it must be above 0"),
        (("--margin", 7), "margin_m = 7 leaves nothing of 20 m by 12 m"),
        (("--level", -1), "--level -1: it must be above 0, in parts of full scale"),
        (("--beam", 2), "--beam 2: the full width"),
        (("--aim", "up"), "--aim up: it must be down or centre"),
        (("--snr", "loud"), "--snr loud: write it as DB@M"),
        (("--snr", "20@5", "--level", 1), "--snr sets how loud beacons are, and so do --level"),
        (("--vehicle", "cart"), "--vehicle cart: the site has no such vehicle; it has agv"),
        (("--rate", 60000), "needs samples faster than 80000 Hz"),
        (("--walls", "none.geojson"), "none.geojson: there is no such file"),
        (("--height", 6, "--improve", 1), "not above the map's level of 6 m"),
        (("--temperature-sd", -1), "--temperature-sd -1: it must be from 0 to 50"),
    ],
)
def test_mistakes_are_told_in_one_line(store, options, message) -> None:
    told = refused(store, *options, *(() if "--spacing" in options else FAST))
    assert message in told
    assert "Traceback" not in told


def test_a_floor_plan_that_leaves_no_floor_is_refused(store) -> None:
    outline = [[-1, -1], [21, -1], [21, 13], [-1, 13], [-1, -1]]
    (store / "all.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [outline]}), "utf-8")
    told = refused(store, "--walls", store / "all.geojson", *FAST)
    assert "leaves no floor" in told


def test_a_narrow_beam_hears_less_than_none(store) -> None:
    def heard(*options: object) -> float:
        ask(store, "-o", store / "p", *options, *FAST)
        return float(np.mean([int(row["heard"]) for row in rows(store / "p")]))

    assert heard("--beam", 60) < heard("--beam", 120) < heard()


def test_walls_in_degrees_are_noticed(store) -> None:
    line = {"type": "LineString", "coordinates": [[8.54, 47.37], [8.55, 47.37]]}
    (store / "city.geojson").write_text(json.dumps(line), "utf-8")
    told = refused(store, "--walls", store / "city.geojson", *FAST)
    assert "no wall stands in the room, (0, 0) to (20, 12) m; coordinates are site metres, not degrees" in told


def test_a_stop_keeps_the_map_of_what_is_there(store, monkeypatch) -> None:
    from sonofix.plan import improve

    def stopped(*_: object) -> float:
        raise KeyboardInterrupt

    monkeypatch.setattr(improve, "cost", stopped)
    told = CliRunner().invoke(app, ["plan", "store", "--improve", "1", *FAST])
    assert told.exit_code == 130
    assert "stopped; store/plan holds the map of the beacons as they are" in told.stderr.replace("\\", "/")
    assert len(rows(store / "plan")) == 21 * 13
    assert not (store / "plan" / "improved.toml").exists()


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("18,3,-0.5", "(18, 3, -0.5) m is below the floor, at 0 m"),
        ("18,3,5.5", "(18, 3, 5.5) m is outside the room, (0, 0, 0) to (20, 12, 5) m"),
        ("-2,3,4", "(-2, 3, 4) m is outside the room"),
    ],
)
def test_places_where_nothing_can_be_fastened_are_refused(store, place, message) -> None:
    places = store / "places.csv"
    places.write_text(f"x_m,y_m,z_m\n3,11.9,4.5\n{place}\n20,6,5\n", "utf-8")
    assert message in refused(store, "--improve", 1, "--places", places, *FAST)
    assert not (store / "plan").exists()


def test_what_is_read_is_not_written_over(store) -> None:
    places = store / "plan" / "plan.csv"
    places.parent.mkdir()
    places.write_text("x_m,y_m,z_m\n3,11.9,4.5\n", "utf-8")
    assert "would be replaced by what is written" in refused(store, "--improve", 1, "--places", places, *FAST)
    assert places.read_text("utf-8").endswith("3,11.9,4.5\n")


def test_a_level_ceiling_promises_no_height_without_a_room_that_ends_below_its_mirror(store) -> None:
    site = store / "site.toml"
    text = site.read_text("utf-8").replace("z_m = 0.0\n", "").replace("4.8]", "4.5]")
    fixed = {}
    for name, bounds in (("open", ""), ("tall", "12.0]]"), ("room", "5.0]]")):
        changed = re.sub(r"bounds_m = .*\n", "", text) if not bounds else text.replace("5.0]]", bounds)
        site.write_text(changed, "utf-8")
        fixed[name] = ask(site, *FAST)
    assert figure(fixed["open"], "floor with a fix") == figure(fixed["tall"], "floor with a fix") == ["0.0 %"]
    assert figure(fixed["room"], "floor with a fix") == ["100.0 %"]
    assert "The map is of the box of the beacons, (0.5, 0.5) to (19.5, 11.5) m" in fixed["open"]
    assert "The map is of" not in fixed["room"]


def test_a_single_obstacle_is_counted_as_one(store) -> None:
    outline = [[4, 2], [6, 2], [6, 4], [4, 4], [4, 2]]
    (store / "one.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [outline]}), "utf-8")
    assert "; 1 obstacle and 0 pieces of wall." in ask(store, "--walls", store / "one.geojson", *FAST)
