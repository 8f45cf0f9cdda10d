"""The recorded survey drive: beacons within a centimetre, from samples."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonofix.files import read_recording
from sonofix.flow import run
from sonofix.ranging import stated_epochs
from sonofix.survey.gauge import laid_upon
from sonofix.survey.places import Wishes, survey
from sonofix.survey.sites import unplaced

SHARED = Path(__file__).parents[2].parent / "shared"
CAPTURE = SHARED / "captures" / "survey"


@pytest.fixture(scope="module")
def drive():
    if not CAPTURE.exists():
        pytest.skip("the recording is not here")
    recording = read_recording(CAPTURE, to_run=True)
    steps = list(run(replace(recording, site=unplaced(recording.site))))
    assert not any(step.estimates for step in steps)  # no place is believed: every search is cold
    with (CAPTURE / "beacons_truth.csv").open() as file:
        truth = {row["id"]: [float(row[k]) for k in ("x_m", "y_m", "z_m")] for row in csv.DictReader(file)}
    return recording.site, [s.ranges for s in steps], np.array([truth[b.id] for b in recording.site.beacons])


@pytest.mark.parametrize("wishes", [Wishes(), Wishes(biases="none"), Wishes(speed_sd_mps=0.2)])
def test_beacons_are_found_within_a_centimetre(drive, wishes: Wishes) -> None:
    site, epochs, truth = drive
    found = survey(site, epochs, wishes)
    assert found.status == "ok"
    places = np.array([b.position_m for b in found.beacons])
    off = places - laid_upon(truth, places, True)
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.005
    sd = np.array([b.sd_m for b in found.beacons])
    assert np.abs(off / sd).max() < 4.5


def test_nothing_known_gives_the_same_shape(drive) -> None:
    site, epochs, truth = drive
    found = survey(site, epochs, Wishes(ignore_guesses=True))
    places = np.array([b.position_m for b in found.beacons])
    both = [laid_upon(places * np.array([1.0, side, 1.0]), truth, True) - truth for side in (1, -1)]
    assert min(np.sqrt(np.mean(np.sum(off**2, axis=1))) for off in both) < 0.005
    assert found.status == "open"


def test_pairs_of_a_radio_system_have_their_biases_found() -> None:
    folder = SHARED / "data" / "table-fast"
    if not folder.exists():
        pytest.skip("the recording is not here")
    recording = read_recording(folder)
    assert recording.ranges is not None
    epochs = stated_epochs(recording.ranges, recording.site)[::12]
    found = survey(recording.site, epochs, Wishes(biases="pair", bias_sd_m=0.3))
    assert len(found.pairs) == 24
    assert all(0.04 < pair.bias_m < 0.35 for pair in found.pairs)
    assert found.after_m < 0.3 * found.before_m
