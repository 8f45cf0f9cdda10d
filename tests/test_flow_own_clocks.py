"""Robots on clocks of their own, from waveforms: simulated, heard, ranged two-way, and the same from exchanges.csv."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix import files, flow
from sonofix.channel import Still, simulate
from sonofix.cli.main import app
from sonofix.files.site_file import site_text
from sonofix.records import Floats, Step
from sonofix.signals.codes import primitive_taps
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

C = 343.2
ROBOTS = ("K", "R2", "R1")
PLACES = {"K": (0.0, 0.0), "R2": (7.0, 0.0), "R1": (2.0, 4.0)}
SPEED_MPS = (0.3, 0.1)
PERIOD_S, DURATION_S, RATE_HZ = 0.4, 6.0, 96000


def site(own_clocks: bool = True) -> Site:
    taps = primitive_taps(7)
    return Site.model_validate(
        {
            "air": {"sound_speed_mps": C},
            "schedule": {"period_s": PERIOD_S, "synchronised": False, "own_clocks": own_clocks},
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10, "bandwidth_hz": 4e3},
            "vehicle": [{"id": name, "z_m": 0.0, "max_speed_mps": 0.5} for name in ROBOTS],
            "beacon": [
                {
                    "id": name,
                    "vehicle": name,
                    "offset_s": 0.12 * i,
                    "delay_s": 1e-3 * i,
                    "code": {"family": "m-sequence", "degree": 7, "taps": taps[i]},
                }
                for i, name in enumerate(ROBOTS)
            ],
            "microphone": [
                {"id": name, "vehicle": name, "channel": i, "delay_s": 2e-4 * i} for i, name in enumerate(ROBOTS)
            ],
        }
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of three robots, one of which drives, under a tone; by the command."""
    place = tmp_path_factory.mktemp("own")
    (place / "team.toml").write_text(site_text(site()))
    motions = [f"still:{x},{y}" for x, y in list(PLACES.values())[:2]]
    motions.append("line:{},{},{},{}".format(*PLACES["R1"], *SPEED_MPS))
    options = []
    for name, motion in zip(ROBOTS, motions, strict=True):
        options += ["--vehicle", name, "--motion", motion]
    clocks = ["--clock", "R2:0.07,25", "--clock", "R1:-0.05,-15"]
    more = ["--duration", DURATION_S, "--rate", RATE_HZ, "--snr", 0, "--tone-hz", 40010, "--tone-db", -20, "--seed", 3]
    told = CliRunner().invoke(
        app, ["simulate", str(place / "team.toml"), str(place / "run"), *options, *clocks, *map(str, more)]
    )
    assert told.exit_code == 0, told.output
    rows = "".join(f"{name},{x},{y},0\n" for name, (x, y) in PLACES.items())
    (place / "run" / "start.csv").write_text("vehicle,x_m,y_m,yaw_rad\n" + rows)
    return place / "run"


@pytest.fixture(scope="module")
def steps(folder: Path) -> list[Step]:
    return list(flow.run(files.read_recording(folder)))


def way_m(emitter: str, receiver: str, time_s: float) -> float:
    def at(name: str, t: float) -> Floats:
        moved = np.array(SPEED_MPS) * t if name == "R1" else np.zeros(2)
        return np.array(PLACES[name]) + moved

    way = 0.0
    for _ in range(10):
        way = float(np.linalg.norm(at(receiver, time_s) - at(emitter, time_s - way / C)))
    return way


def misses(steps: list[Step]) -> tuple[Floats, Floats]:
    """Errors of two-way ranges (the mean of both ways), and their stated deviations."""
    miss, sd = [], []
    for step in steps:
        ranges = step.ranges
        ends = list(zip(ranges.emitter, ranges.receiver, strict=True))
        true = np.array([way_m(*pair, float(t)) for pair, t in zip(ends, ranges.time_s, strict=True)])
        for i, (a, b) in enumerate(ends):
            if ROBOTS.index(a) < ROBOTS.index(b):
                rows = [i, ends.index((b, a))]
                miss.append((ranges.range_m - true)[rows].mean())
                sd.append(np.sqrt(ranges.covariance_m2[np.ix_(rows, rows)].sum()) / 2)
    return np.array(miss), np.array(sd)


def test_two_way_ranges_from_waveforms_err_as_stated(steps: list[Step]) -> None:
    """The receiver states deviations under a tone up to a quarter too high; n squares scatter by √(2 / n)."""
    miss, sd = misses(steps)
    assert len(miss) >= 3 * (DURATION_S / PERIOD_S - 2)
    ratio = np.sqrt(np.mean((miss / sd) ** 2))
    assert 0.75 - 4 / np.sqrt(2 * len(miss)) < ratio < 1.0 + 4 / np.sqrt(2 * len(miss))
    assert np.sqrt(np.mean(miss[6:] ** 2)) < 0.004


def test_rates_are_told_without_the_clocks_drift(steps: list[Step]) -> None:
    """25 and −15 millionths apart, a burst's length alone would show 1.4 cm/s between robots one of which stands."""
    last = steps[-4:]
    for step in last:
        ranges = step.ranges
        assert ranges.range_rate_mps is not None
        assert ranges.range_rate_sd_mps is not None
        true = []
        for a, b, t in zip(ranges.emitter, ranges.receiver, ranges.time_s, strict=True):
            true.append((way_m(a, b, float(t) + 0.01) - way_m(a, b, float(t) - 0.01)) / 0.02)
        assert (np.abs(ranges.range_rate_mps - true) < 5 * ranges.range_rate_sd_mps).all()


def test_times_and_tracks_are_on_the_first_robots_clock(steps: list[Step]) -> None:
    for step in steps:
        first = [
            t
            for a, b, t in zip(step.ranges.emitter, step.ranges.receiver, step.ranges.time_s, strict=True)
            if (a, b) == ("K", "R2")
        ]
        for t in first:
            # burst k of K, middle and flight, by K's clock
            since = (t - 127 * 10 / 40e3 / 2 - 7.0 / C) / PERIOD_S
            assert abs(since - round(since)) * PERIOD_S < 1e-3
    assert {e.vehicle for e in steps[-1].estimates} == set(ROBOTS)


def test_a_run_writes_exchanges_and_they_make_the_same_ranges(folder: Path, steps: list[Step], tmp_path: Path) -> None:
    out = tmp_path / "out"
    files.write_run(out, steps, files.read_recording(folder).site)
    with (out / "exchanges.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(step.exchanges) for step in steps)
    assert set(rows[0]) >= {"from", "to", "sent_s", "heard_s", "reply_sent_s", "reply_heard_s", "heard_sd_s"}
    again = tmp_path / "again"
    again.mkdir()
    for name in ("site.toml", "start.csv"):
        shutil.copy(folder / name, again / name)
    shutil.copy(out / "exchanges.csv", again / "exchanges.csv")
    told = CliRunner().invoke(app, ["run", str(again), "--no-plot"])
    assert told.exit_code == 0, told.output
    others = list(flow.run(files.read_recording(again)))
    heard = {(a, b, round(t, 3)): r for step in steps for a, b, t, r in _rows(step)}
    read = {(a, b, round(t, 3)): r for step in others for a, b, t, r in _rows(step)}
    assert len(read) == len(heard)
    # a nanosecond in a file is a third of a micrometre
    near = [abs(read[key] - value) for key, value in heard.items() if key in read]
    assert len(near) > 0.9 * len(heard)
    assert max(near) < 1e-5


def _rows(step: Step) -> list[tuple[str, str, float, float]]:
    r = step.ranges
    return list(zip(r.emitter, r.receiver, r.time_s.tolist(), r.range_m.tolist(), strict=True))


def test_exchanges_without_deviations_are_learnt_from(folder: Path, steps: list[Step], tmp_path: Path) -> None:
    for name in ("site.toml", "start.csv"):
        shutil.copy(folder / name, tmp_path / name)
    lines = ["from,to,sent_s,heard_s,reply_sent_s,reply_heard_s"]
    for step in steps:
        for e in step.exchanges:
            stamps = (e.sent_s, e.heard_s, e.reply_sent_s, e.reply_heard_s)
            lines.append(",".join([e.emitter, e.receiver, *(f"{t:.9f}" for t in stamps)]))
    (tmp_path / "exchanges.csv").write_text("\n".join(lines) + "\n")
    found = list(flow.run(files.read_recording(tmp_path, to_run=True)))
    assert found
    assert not found[0].ranges.sd_stated
    miss, sd = misses(found)
    assert np.sqrt(np.mean(miss**2)) < 0.005
    assert np.median(sd[-6:]) < 0.3 * sd[0]


def test_all_sound_at_once_and_codes_tell_them_apart() -> None:
    plan = site()
    beacons = tuple(b.model_copy(update={"offset_s": 0.0, "delay_s": 0.0}) for b in plan.beacons)
    plan = plan.model_copy(update={"beacons": beacons})
    motions = {name: Still((*place, 0.0)) for name, place in PLACES.items()}
    clocks = {"R2": (0.03, 1e-5), "R1": (-0.02, -2e-5)}
    settings = {"level": 0.5, "noise_sd": 0.02, "seed": 4}
    recording, _ = simulate(
        plan, motions, rate_hz=RATE_HZ, duration_s=2.0, waveforms=waveforms_of(plan), clocks=clocks, **settings
    )
    found = list(flow.run(recording))
    assert all(len(step.ranges) == 6 for step in found[1:-1])
    for step in found:
        for a, b, r, sd in zip(
            step.ranges.emitter,
            step.ranges.receiver,
            step.ranges.range_m,
            np.sqrt(np.diag(step.ranges.covariance_m2)),
            strict=True,
        ):
            assert abs(r - np.hypot(*np.subtract(PLACES[a], PLACES[b]))) < 5 * sd


def test_epochs_in_which_nobody_is_heard_are_told_empty() -> None:
    plan = site()
    motions = {name: Still((*place, 0.0)) for name, place in PLACES.items()}
    recording, _ = simulate(plan, motions, rate_hz=RATE_HZ, duration_s=1.5, waveforms={}, noise_sd=0.01)
    found = list(flow.run(recording))
    assert [len(step.ranges) for step in found] == [0] * len(found)
    np.testing.assert_allclose([step.ranges.sync_s for step in found], PERIOD_S * np.arange(len(found)))
    with pytest.raises(ValueError, match="heard by `sonofix run` alone"):
        flow.explain(recording, 0)


def test_a_channel_keeps_its_robots_time() -> None:
    """A clock 0.1 s ahead that runs 0.1 % fast: the same burst is told later, and drawn out."""
    plan = site()
    waveforms = {"K": waveforms_of(plan)["K"]}
    motions = {name: Still((*place, 0.0)) for name, place in PLACES.items()}
    peaks = []
    for clocks in ({}, {"R2": (0.1, 1e-3)}):
        recording, _ = simulate(
            plan, motions, rate_hz=RATE_HZ, duration_s=2.4, waveforms=waveforms, level=0.5, clocks=clocks
        )
        assert recording.blocks is not None
        heard = np.concatenate(list(recording.blocks(100_000)))[:, 1]
        loud = np.flatnonzero(np.abs(heard) > 0.3 * np.abs(heard).max()) / RATE_HZ
        peaks.append(loud[np.diff(loud, prepend=-1.0) > 0.2])
    plain, shifted = peaks
    told = 0.1 + 1.001 * plain
    for begin in told[told < 2.3]:
        # the first loud sample may be the next swing's, 25 µs on, or the one after
        assert np.abs(shifted - begin).min() < 6e-5


@pytest.mark.parametrize(
    ("clocks", "own", "words"),
    [
        ({"R2": (0.0, 0.0)}, False, "share one"),
        ({"R9": (0.0, 0.0)}, True, "R9 is not in the site"),
        ({"R2": (0.0, 0.5)}, True, "clocks of R2"),
        ({"K": (0.1, 0.0)}, True, "K, the first vehicle, keeps the time"),
    ],
)
def test_clocks_that_cannot_be_are_told(clocks: dict, own: bool, words: str) -> None:
    plan = site(own)
    motions = {name: Still((*place, 0.0)) for name, place in PLACES.items()}
    with pytest.raises(ValueError, match=words):
        simulate(plan, motions, rate_hz=RATE_HZ, duration_s=1.0, waveforms=waveforms_of(plan), clocks=clocks)


def test_sites_with_clocks_of_their_own_are_judged() -> None:
    raw = site().model_dump(by_alias=True, exclude_none=True)
    with pytest.raises(ValueError, match="not in sync"):
        Site.model_validate(raw | {"schedule": {"period_s": 0.4, "own_clocks": True}})
    fixed = [{"id": "wall", "channel": 3, "position_m": [0.0, 0.0, 0.0]}, *raw["microphone"]]
    with pytest.raises(ValueError, match="mount it on one"):
        Site.model_validate(raw | {"microphone": fixed})
