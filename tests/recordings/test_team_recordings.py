"""Teams of recordings that lie beside the project."""

import csv
import shutil

import numpy as np
from typer.testing import CliRunner

from sonofix import flow
from sonofix.cli.main import app
from sonofix.files import read_recording, read_truth
from sonofix.team.feed import gather
from sonofix.team.fleet import follow
from sonofix.team.smooth import smooth
from sonofix.team.tell import ranges_of
from team.made_fleet import watched


def test_five_real_robots_find_themselves_and_each_other(data):
    recording, truths = read_recording(data / "robots6"), read_truth(data / "robots6")
    feed = gather(recording)
    # five minutes
    feed = feed.keep(feed.time_s < 300.0)
    square = []
    for moment, _ in follow(feed):
        for r in np.flatnonzero(moment.placed & (moment.time_s < 300.0)).tolist():
            truth = truths[feed.robots[r]]
            true = [np.interp(moment.time_s, truth.time_s, truth.position_m[:, i]) for i in range(2)]
            square.append(float(np.sum((moment.pose[r, :2] - true) ** 2)))
        if moment.time_s >= 300.0:
            break
    assert len(square) > 10_000
    assert np.sqrt(np.mean(square)) < 0.144


def test_a_pushed_robot_is_found_from_waveforms_and_nobody_else_blamed(captures):
    folder = captures / "team"
    heard = ranges_of(step.ranges for step in flow.run(read_recording(folder, to_run=True)))
    feed = gather(read_recording(folder, to_run=True), heard, own_ranges=True)
    moments, means, belief = watched(feed)
    for name, truth in read_truth(folder).items():
        r = feed.robots.index(name)
        outside = [m for m in moments if not 9.0 <= m.time_s <= 10.0]
        true = [[np.interp(m.time_s, truth.time_s, truth.position_m[:, i]) for i in range(2)] for m in outside]
        error = np.array([m.pose[r, :2] for m in outside]) - true
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.02
    events = [event for moment in moments for event in moment.events]
    assert [(event.vehicle, event.event) for event in events] == [("R1", "slip")]
    # within three epochs of half a second
    assert 9.0 < events[0].time_s < 10.5
    # a start or stop of 0.5 or 0.9 m/s leaves no trace: wheels do not lag behind what they tell here
    stops = {"R1": 8.0, "R2": 17.5, "K": 14.0}
    for name, stop_s in stops.items():
        r, truth = feed.robots.index(name), read_truth(folder)[name]
        for m in (m for m in moments if abs(m.time_s - stop_s) < 0.1):
            off = m.pose[r, :2] - [np.interp(m.time_s, truth.time_s, truth.position_m[:, i]) for i in range(2)]
            assert np.hypot(*off) < 0.015

    # smoothed, it is as open while it is pushed as nobody knows then where it is
    after = smooth(feed, moments, belief, means)
    r, truth = feed.robots.index("R1"), read_truth(folder)["R1"]
    for m in after:
        off = m.pose[r, :2] - [np.interp(m.time_s, truth.time_s, truth.position_m[:, i]) for i in range(2)]
        assert off @ np.linalg.solve(m.covariance[r, :2, :2], off) < 9.0
        # when between two epochs it began is not known
        assert np.hypot(*off) < 0.02 or 8.8 < m.time_s < 9.4


def test_samples_count_before_ranges_that_lie_beside_them(captures, tmp_path):
    shutil.copytree(captures / "team", tmp_path / "team")
    (tmp_path / "team").chmod(0o755)
    (tmp_path / "team" / "ranges.csv").write_text("time_s,from,to,range_m\n1.0,K,R2,77.0\n", "utf-8")
    done = CliRunner().invoke(app, ["team", str(tmp_path / "team"), "-o", str(tmp_path / "out"), "--no-plot"])
    assert done.exit_code == 0, done.stderr
    with (tmp_path / "out" / "ranges.csv").open() as file:
        ranges = [float(row["range_m"]) for row in csv.DictReader(file)]
    assert len(ranges) > 200
    assert max(ranges) < 10.0
