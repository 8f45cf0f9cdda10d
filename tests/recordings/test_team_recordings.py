"""Teams of recordings that lie beside the project."""

import numpy as np

from sonofix.files import read_recording, read_truth
from sonofix.team.feed import gather
from sonofix.team.fleet import follow


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
    assert np.sqrt(np.mean(square)) < 0.18
