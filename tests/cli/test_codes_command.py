"""`sonofix codes`: what it tells and writes, and mistakes told in lines."""

import csv
import re
import tomllib

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix.cli import codes as command
from sonofix.cli.main import app
from sonofix.files import read_site
from sonofix.plan.codes import measure
from sonofix.plan.crosstalk import make_grid
from sonofix.signals.waveform import waveforms_of

SITE = """format = 1
[site]
name = "hut"
bounds_m = [[0, 0, 0], [4, 3, 2.5]]
[schedule]
period_s = 0.25
[signal]
carrier_hz = 20000
cycles_per_chip = 8
bandwidth_hz = 3000
[[vehicle]]
id = "cart"
z_m = 0.1
max_speed_mps = 1.0
[[microphone]]
id = "M1"
channel = 0
vehicle = "cart"
"""
PLACES = ("[0, 0, 2]", "[4, 0, 2.1]", "[4, 3, 2]", "[0, 3, 2.2]")


def site_text(codes: list[str]) -> str:
    beacons = [f'[[beacon]]\nid = "B{i}"\nposition_m = {PLACES[i]}\ncode = {code}\n' for i, code in enumerate(codes)]
    return SITE + "".join(beacons)


# B2 is B1 but for its last chip: the worst that codes can be
BAD = ['{ chips = "1110010110001101" }', '{ chips = "1110010110001100" }', '{ chips = "1001101010111100" }']


def ask(*options: object) -> str:
    told = CliRunner().invoke(app, ["codes", *map(str, options)])
    assert told.exit_code == 0, told.output
    return told.stdout


def worst_db(site) -> float:
    bursts = list(waveforms_of(site).values())
    return measure(bursts, make_grid(bursts, 13.4, 2.0, site.sound_speed_mps)).worst_db


def test_codes_told_are_those_written_and_are_a_site(tmp_path):
    output = ask("--count", 4, "--degree", 5, "--max-speed", 1, "-o", tmp_path / "set")
    lines = re.findall(r"^code = (\{.+\})  # (B\d)$", output, re.MULTILINE)
    assert [beacon for _, beacon in lines] == ["B1", "B2", "B3", "B4"]
    written = tomllib.loads((tmp_path / "set" / "codes.toml").read_text("utf-8"))["beacon"]
    assert [tomllib.loads(f"code = {code}")["code"] for code, _ in lines] == [b["code"] for b in written]
    (tmp_path / "site.toml").write_text(site_text([code for code, _ in lines]), "utf-8")
    assert len(read_site(tmp_path / "site.toml").coded_beacons) == 4
    with (tmp_path / "set" / "codes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 16
    worst = max(float(row["worst_db"]) for row in rows if row["sent"] != row["listened_for"])
    assert f"worst pair {worst:.1f} dB" in output
    assert (tmp_path / "set" / "codes.png").read_bytes().startswith(b"\x89PNG")


def test_a_site_states_signal_reach_speed_and_beacons(tmp_path):
    (tmp_path / "site.toml").write_text(site_text(BAD), "utf-8")
    output = ask("--site", tmp_path, "--degree", 7, "--family", "m-sequence", "-o", tmp_path / "set", "--no-plot")
    assert "3 codes of" in output
    # half as much again as the diagonal of the hut, and 5 m: what the receiver waits for
    assert f"±{1.5 * np.linalg.norm([4, 3, 2.5]) + 5:.1f} m of way" in output
    assert "up to 2 m/s apart; on-off keyed, 8 cycles a chip at 20 kHz, transducers of 3 kHz" in output
    told = re.search(r"present codes have: (-?[\d.]+) dB .*; the chosen ones are ([\d.]+) dB quieter", output)
    assert told is not None
    present, better = told.groups()
    assert float(present) > -1.0
    lines = re.findall(r"^code = (\{.+\})  # B\d$", output, re.MULTILINE)
    (tmp_path / "site.toml").write_text(site_text(lines), "utf-8")
    assert worst_db(read_site(tmp_path)) == pytest.approx(float(present) - float(better), abs=0.15)
    assert not (tmp_path / "set" / "codes.png").exists()


def test_options_rule_over_the_site(tmp_path):
    (tmp_path / "site.toml").write_text(site_text(BAD), "utf-8")
    options = ("--count", 4, "--degree", 4, "--reach", 1, "--max-speed", 0, "--carrier", 30000, "--bandwidth", "inf")
    output = ask("--site", tmp_path, *options, "--modulation", "bpsk", "--cycles", 9)
    assert "±1.0 m of way and range rates up to 0 m/s apart" in output
    assert "keyed by sign, 9 cycles a chip at 30 kHz, no transducers" in output
    assert len(re.findall(r"^code = ", output, re.MULTILINE)) == 4


def test_a_site_without_common_clock_is_judged_at_any_delay(tmp_path):
    text = site_text(BAD).replace("period_s = 0.25", "period_s = 0.25\nsynchronised = false")
    (tmp_path / "site.toml").write_text(text, "utf-8")
    assert "Judged over every delay" in ask("--site", tmp_path, "--degree", 5, "--max-speed", 0)


def test_beacons_on_other_carriers_are_left_out(tmp_path):
    text = site_text([*BAD, '{ chips = "1110010110001101" }\ncarrier_hz = 30000'])
    (tmp_path / "site.toml").write_text(text, "utf-8")
    output = ask("--site", tmp_path, "--degree", 5, "--max-speed", 0)
    assert "for the 3 beacons at 20 kHz; 1 beacon on other carriers" in output


def test_chips_of_a_file_are_chosen_from(tmp_path):
    rng = np.random.default_rng(2)
    texts = ["".join(map(str, rng.integers(0, 2, 31))) for _ in range(8)]
    twins = [texts[0][:-1] + str(1 - int(texts[0][-1])), texts[1][:-1] + str(1 - int(texts[1][-1]))]
    path = tmp_path / "mine.txt"
    path.write_text("# my own\n" + "\n".join([*texts, "", *twins]) + "  # nearly the second\n", "utf-8")
    output = ask("--chips", path, "--count", 6, "--max-speed", 0)
    chosen = re.findall(r'^code = \{ chips = "([01]+)" \}', output, re.MULTILINE)
    assert len(chosen) == 6
    assert set(chosen) <= {*texts, *twins}
    # no set of six that beats chance holds two codes that differ in one chip
    assert not {texts[0], twins[0]} <= set(chosen)
    assert not {texts[1], twins[1]} <= set(chosen)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--count", "1"], "--count 1: codes are chosen by their pairs; ask for 2 or more"),
        (["--count", "19", "--degree", "7", "--family", "m-sequence"], "degree 7 of m-sequence has 18 codes; ask for"),
        (["--degree", "8", "--family", "gold"], "--degree 8: has no Gold codes here; valid is 3, 5, 6, 7"),
        (["--degree", "30"], "--degree 30: codes are compared up to degree 11"),
        (["--family", "golden"], "--family golden: families are m-sequence, gold, kasami"),
        (["--reach", "0"], "--reach 0: it must be above 0, in m, or inf"),
        (["--max-speed", "-1"], "--max-speed -1: it must be from 0 to 15, in m/s"),
        (["--carrier", "inf"], "--carrier inf: it must be above 0, in Hz"),
        (["--modulation", "fm"], "--modulation fm: it must be ask or bpsk"),
        (["--site", "nowhere"], "nowhere: there is no such file"),
        (["--chips", "nowhere.txt"], "nowhere.txt: there is no such file"),
        (["--chips", "x", "--family", "gold"], "codes come from one or the other; drop one"),
    ],
)
def test_mistakes_are_lines(options, words):
    told = CliRunner().invoke(app, ["codes", *options])
    assert told.exit_code == 2
    assert words in told.stderr
    assert told.stdout == ""


def test_every_bad_line_of_chips_is_told(tmp_path):
    path = tmp_path / "mine.txt"
    path.write_text("1010011\n10\n1111111\n1010011\n10 10 11 0\n", "utf-8")
    told = CliRunner().invoke(app, ["codes", "--chips", str(path)])
    assert told.exit_code == 2
    assert [line.split(" =")[0] for line in told.stderr.splitlines()] == [f"mine.txt: line {i}" for i in (2, 3, 4, 5)]
    path.write_text("# none yet\n", "utf-8")
    assert "holds no code" in CliRunner().invoke(app, ["codes", "--chips", str(path)]).stderr


def test_one_beacon_disturbs_none(tmp_path):
    (tmp_path / "site.toml").write_text(site_text(BAD[:1]), "utf-8")
    told = CliRunner().invoke(app, ["codes", "--site", str(tmp_path)])
    assert told.exit_code == 2
    assert "it has one beacon, which disturbs none; give --count" in told.stderr


def test_a_stop_while_comparing_is_told(tmp_path, monkeypatch):
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "_laid_out", stopped)
    told = CliRunner().invoke(app, ["codes", "--degree", "5", "-o", str(tmp_path)])
    assert told.exit_code == 130
    assert told.stderr.strip() == "stopped; no codes were chosen"
    assert not any(tmp_path.iterdir())
