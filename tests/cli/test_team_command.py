"""`sonofix team`: what it writes, draws and says, and how it refuses."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix.channel import Line, simulate
from sonofix.cli.main import app
from sonofix.draw.team import draw_team
from sonofix.files import read_recording, write_recording
from sonofix.records import Table
from sonofix.signals import codes
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site
from team.made_fleet import fleet

COLUMNS = ("time_s", "x_m", "y_m", "yaw_rad")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write a made-up fleet as a recording folder."""
    place = tmp_path_factory.mktemp("fleet")
    recording, truth = fleet(seconds=12)
    lines = ["format = 1", "[site]", 'name = "fleet"']
    for vehicle in recording.site.vehicles:
        lines += ["[[vehicle]]", f'id = "{vehicle.id}"', "z_m = 0.0"]
    for kind, nodes in (("beacon", recording.site.beacons), ("microphone", recording.site.microphones)):
        for node in nodes:
            stands = f"position_m = {list(node.position_m or ())}"
            lines += [f"[[{kind}]]", f'id = "{node.id}"', stands if node.position_m else f'vehicle = "{node.vehicle}"']
    (place / "site.toml").write_text("\n".join(lines), "utf-8")

    def write(name, header, *columns):
        with (place / name).open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(header.split(","))
            rows.writerows(zip(*columns, strict=True))

    heard, odometry = recording.ranges, recording.tables["odometry"]
    assert heard is not None
    write("ranges.csv", "time_s,from,to,range_m", heard.time_s, heard.emitter, heard.receiver, heard.range_m)
    bearing = recording.tables["bearings"].columns["bearing_rad"]
    write("bearings.csv", "time_s,from,to,bearing_rad", heard.time_s, heard.emitter, heard.receiver, bearing)
    told = odometry.columns
    order = np.argsort(told["time_s"], kind="stable")
    whose = np.array(odometry.names["vehicle"])
    values = (told["time_s"][order], whose[order], told["v_mps"][order], told["yaw_rate_radps"][order])
    write("odometry.csv", "time_s,vehicle,v_mps,yaw_rate_radps", *values)
    rows = sorted((t, name, x, y, 0.0, yaw) for name, path in truth.items() for t, x, y, yaw in path)
    write("truth.csv", "time_s,vehicle,x_m,y_m,z_m,yaw_rad", *zip(*rows, strict=True))
    return place


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.parametrize("option", ["--smooth", "--decentralised", "--odometry-alone"])
def test_a_team_is_written_drawn_and_scored(folder, tmp_path, option):
    done = run("team", folder, "-o", tmp_path / "out", option)
    assert done.exit_code == 0, done.stderr
    assert "NEES" in done.stdout
    assert (tmp_path / "out" / "team.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "out" / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["vehicle"] for row in rows} == {"R0", "R1", "R2"}
    assert ({row["source"] for row in rows} == {"smoothed"}) == (option == "--smooth")
    scored = run("score", folder, tmp_path / "out", "--json")
    worst = max(track["rmse_xy_m"] for track in json.loads(scored.stdout)["track"].values())
    assert worst < (2.0 if option == "--odometry-alone" else 0.25)


def test_an_animation_is_drawn(folder, tmp_path):
    done = run("team", folder, "-o", tmp_path / "out", "--no-plot", "--animate", tmp_path / "team.gif")
    assert done.exit_code == 0, done.stderr
    assert (tmp_path / "team.gif").read_bytes().startswith(b"GIF8")
    assert not (tmp_path / "out" / "team.png").exists()


def test_where_nobody_is_placed_that_is_said_and_all_is_written(folder, tmp_path):
    place = tmp_path / "unplaced"
    shutil.copytree(folder, place)
    # of peers alone nobody knows where all of them are
    for name in ("ranges.csv", "bearings.csv"):
        head, *rows = (place / name).read_text("utf-8").splitlines()
        (place / name).write_text("\n".join([head, *(row for row in rows if ",L" not in row)]) + "\n", "utf-8")
    done = run("team", place, "-o", tmp_path / "out", "--animate", tmp_path / "team.gif")
    assert done.exit_code == 0, done.stderr
    assert "Never placed: R0, R1, R2" in done.stdout
    assert "no robot was placed" in done.stdout
    assert not (tmp_path / "team.gif").exists()
    assert (tmp_path / "out" / "team.png").read_bytes().startswith(b"\x89PNG")
    figure = draw_team(read_recording(place), [])
    assert not figure.axes
    assert "no robot was placed" in [text.get_text() for text in figure.texts]


def test_exchanges_of_robots_on_clocks_of_their_own_place_them(folder, tmp_path):
    place = tmp_path / "exchanged"
    place.mkdir()
    for name in ("site.toml", "odometry.csv", "truth.csv"):
        shutil.copy(folder / name, place)
    with (folder / "truth.csv").open() as file:
        rows = list(csv.DictReader(file))
    paths = {
        name: np.array(
            [[float(r[c]) for c in ("time_s", "x_m", "y_m", "yaw_rad")] for r in rows if r["vehicle"] == name]
        )
        for name in ("R0", "R1", "R2")
    }
    rng = np.random.default_rng(3)

    def shows(name, time_s):
        ahead_s, fast = {"R0": (0.0, 0.0), "R1": (0.3, 1e-4), "R2": (-1.7, -1e-4)}[name]
        return (1 + fast) * time_s + ahead_s

    def at(name, time_s):
        return np.array([np.interp(time_s, paths[name][:, 0], paths[name][:, i]) for i in (1, 2)])

    def heard(source, listener, sent_s):
        # at 0.4 m/s the way changes by a millimetre while the sound is under way: two rounds are enough
        time_s = sent_s
        for _ in range(3):
            time_s = sent_s + np.hypot(*(at(listener, time_s) - at(source, sent_s))) / 343.2
        return time_s + rng.normal(0, 2e-6)

    lines = ["from,to,sent_s,heard_s,reply_sent_s,reply_heard_s"]
    for sent_s in np.arange(0.1, 11.5, 0.5):
        for a, b in (("R0", "R1"), ("R0", "R2"), ("R1", "R2")):
            back_s = sent_s + 0.16
            stamps = (shows(a, sent_s), shows(b, heard(a, b, sent_s)), shows(b, back_s), shows(a, heard(b, a, back_s)))
            lines.append(",".join([a, b, *(f"{stamp:.9f}" for stamp in stamps)]))
    (place / "exchanges.csv").write_text("\n".join(lines), "utf-8")
    starts = [f"{name},{path[0, 1]},{path[0, 2]},{path[0, 3]}" for name, path in paths.items()]
    (place / "start.csv").write_text("\n".join(["vehicle,x_m,y_m,yaw_rad", *starts]), "utf-8")
    done = run("team", place, "-o", tmp_path / "out", "--no-plot")
    assert done.exit_code == 0, done.stderr
    scored = json.loads(run("score", place, tmp_path / "out", "--json").stdout)
    # offsets left in would be 100 m and more
    assert scored["ranges"]["used"]["rms_m"] < 0.06
    assert set(scored["track"]) == set(paths)
    # nothing but the start says where all of them together are
    assert max(track["rmse_xy_m"] for track in scored["track"].values()) < 0.3


@pytest.fixture(scope="module")
def sounding(tmp_path_factory):
    """Write a waveform recording of two robots, one channel of which falls silent and one is clipped for a while."""
    place, rate_hz, seconds = tmp_path_factory.mktemp("sounding") / "two", 48e3, 3.0
    corners = [(0.0, 0.0, 2.5), (6.0, 0.2, 2.5), (3.0, 5.0, 2.5)]
    names = [*(f"B{i}" for i in range(3)), "R0", "R1"]
    stands = [*({"position_m": corner} for corner in corners), {"vehicle": "R0"}, {"vehicle": "R1"}]
    taps = codes.primitive_taps(7)
    site = Site.model_validate(
        {
            "air": {"sound_speed_mps": 343.2},
            "schedule": {"period_s": 0.2, "synchronised": True},
            "signal": {"carrier_hz": 15e3, "cycles_per_chip": 6, "bandwidth_hz": 4e3},
            "vehicle": [{"id": "R0", "z_m": 0.4}, {"id": "R1", "z_m": 0.4}],
            "beacon": [
                {"id": name, **where, "code": {"family": "m-sequence", "degree": 7, "taps": list(taps[i])}}
                for i, (name, where) in enumerate(zip(names, stands, strict=True))
            ],
            "microphone": [{"id": f"R{i}", "channel": i, "vehicle": f"R{i}"} for i in range(2)],
        }
    )
    motions = {"R0": Line((1.5, 1.2, 0.4), (0.6, 0.4, 0.0)), "R1": Line((4.0, 3.0, 0.4), (-0.5, 0.0, 0.0))}
    recording, truth = simulate(
        site, motions, rate_hz=rate_hz, duration_s=seconds, waveforms=waveforms_of(site), level=0.3, noise_sd=2e-3
    )
    assert recording.blocks is not None
    samples = np.concatenate(list(recording.blocks(65536)))
    samples[int(1.0 * rate_hz) : int(1.8 * rate_hz), 0] = 0.0
    loud = slice(int(2.0 * rate_hz), int(2.6 * rate_hz))
    samples[loud, 1] = np.clip(30.0 * samples[loud, 1], -0.9, 0.9)
    recording = replace(recording, blocks=lambda count: iter([samples]), sample_count=len(samples))
    time_s = np.repeat(np.arange(0.0, seconds, 0.1), 2)
    speed = np.tile([np.hypot(0.6, 0.4), 0.5], len(time_s) // 2)
    odometry = Table(
        {"time_s": time_s, "v_mps": speed, "yaw_rate_radps": 0 * speed}, {"vehicle": ("R0", "R1") * (len(time_s) // 2)}
    )
    yaw = np.array([np.arctan2(0.4, 0.6), np.pi])
    start = Table({"x_m": np.array([1.5, 4.0]), "y_m": np.array([1.2, 3.0]), "yaw_rad": yaw}, {"vehicle": ("R0", "R1")})
    write_recording(place, replace(recording, tables={"odometry": odometry, "start": start}), truth)
    return place


def test_what_is_wrong_with_samples_is_told_as_of_one_vehicle(sounding, tmp_path):
    told, heard = {}, {}
    for command in ("run", "team"):
        out = tmp_path / command
        done = run(command, sounding, "-o", out, "--no-plot")
        assert done.exit_code == 0, done.stderr
        with (out / "events.csv").open() as file:
            events = [row for row in csv.DictReader(file) if not row["vehicle"]]
        told[command] = [(row["time_s"], row["event"], row["detail"]) for row in events]
        assert f"{len(events)} samples" in done.stdout
        with (out / "ranges.csv").open() as file:
            columns = ("time_s", "from", "to", "range_m", "sd_m", "range_rate_mps", "range_rate_sd_mps", "snr_db")
            heard[command] = sorted(tuple(row[name] for name in columns) for row in csv.DictReader(file))
    assert told["team"] == told["run"]
    assert any("microphone R0: no sound at all" in detail for *_, detail in told["team"])
    assert any("microphone R1" in detail and "clipped" in detail for *_, detail in told["team"])
    assert heard["team"] == heard["run"]
    assert all(all(row) for row in heard["team"])
    scored = json.loads(run("score", sounding, tmp_path / "team", "--json").stdout)
    for track in scored["track"].values():
        assert track["rmse_xy_m"] < 0.02
        assert track["nees_xy"] < 4.0


@pytest.mark.parametrize("source", ["ranges", "samples"])
def test_ranges_but_for_an_unknown_offset_are_refused(folder, sounding, tmp_path, source):
    place = tmp_path / "unknown"
    shutil.copytree(folder if source == "ranges" else sounding, place)
    text = (place / "site.toml").read_text("utf-8")
    schedule = "[schedule]\nperiod_s = 0.4\nsynchronised = false\n"
    changed = (
        text.replace("synchronised = true", "synchronised = false") if source == "samples" else text + "\n" + schedule
    )
    assert changed.count("synchronised = false") == 1
    (place / "site.toml").write_text(changed, "utf-8")
    done = run("team", place, "-o", tmp_path / "out", "--no-plot")
    assert done.exit_code == 2
    told = " ".join(done.stderr.split())
    for words in ("site.toml: schedule.synchronised = false", "exchanges.csv", "own_clocks", "sonofix run"):
        assert words in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--landmarks-of", "R7"], "no vehicle of the site; it has R0, R1, R2"),
        (["--smooth", "--decentralised"], "leave out either"),
        (["--smooth", "--odometry-alone"], "leave out either"),
        (["--odometry-alone", "--decentralised"], "leave out either"),
        (["--animate", "team.mp4"], "must end in .gif"),
    ],
)
def test_what_cannot_be_is_refused(folder, tmp_path, words, told):
    done = run("team", folder, "-o", tmp_path, *words)
    assert done.exit_code == 2
    assert told in done.stderr
