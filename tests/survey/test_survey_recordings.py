"""Real beacons in real rooms: what can be told of them without a truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonofix.files.calibration import read_for_calibration
from sonofix.survey.burst import calibrate


def test_one_car_has_one_clock(data: Path) -> None:
    """Five takes, each heard by the microphone that the car is parked at: a few bursts each, amid echoes."""
    rates = []
    for take, microphone in (("02", "M1"), ("03", "M2"), ("04", "M3"), ("05", "M4"), ("06", "M5")):
        learnt = calibrate(read_for_calibration(data / "car-2019-5k_15k" / f"take{take}"), "car-beacon", microphone)
        assert learnt.delay_s is None
        assert learnt.pace.jitter_s < 3e-7
        assert any("not much like the nominal one" in flag for flag in learnt.flags)
        rates.append(learnt.pace.rate)
    assert np.ptp(rates) < 2e-6
    assert np.mean(rates) == pytest.approx(15.7e-6, abs=1e-6)


def test_a_code_that_nobody_knows(data: Path) -> None:
    """The burst that stands out of the quiet is the one that was recorded close by."""
    recording = read_for_calibration(data / "car-2014" / "run4")
    known = calibrate(recording, "car-beacon", "M4")
    assert known.match is not None
    assert known.match > 0.98
    bare = recording.site.beacons[0].model_copy(update={"code": None})
    site = recording.site.model_copy(update={"beacons": (bare,)})
    learnt = calibrate(replace(recording, site=site, references={}), "car-beacon", "M4")
    assert learnt.match is None
    assert 4e-3 < len(learnt.burst.samples) / learnt.burst.rate_hz < 12e-3
    assert learnt.pace.rate == pytest.approx(known.pace.rate, abs=1e-6)
