"""Surveys of made drives: beacons found whatever was known, and what a drive cannot tell is told."""

import numpy as np
import pytest
from made_drive import HALL, circle, hall, heard, straight, wander

from sonofix.survey.gauge import laid_upon
from sonofix.survey.places import Wishes, survey
from sonofix.survey.sites import corrected, marked, unplaced, without_biases

COUNT = 40
PERIOD_S = 0.8


def guesses(rng, sd_m=0.3, known=0):
    sd = np.full(len(HALL), sd_m)
    sd[:known] = 0.0
    return hall(HALL + sd[:, None] * rng.standard_normal(HALL.shape), sd)


def places(found):
    return np.array([b.position_m for b in found.beacons])


def off_m(found):
    """Root mean square distance from the truth, the frame laid upon it."""
    return float(np.sqrt(np.mean(np.sum((laid_upon(places(found), HALL, True) - HALL) ** 2, axis=1))))


def test_guesses_are_brought_to_millimetres() -> None:
    rng = np.random.default_rng(1)
    site = guesses(rng)
    found = survey(site, heard(site, HALL, wander, COUNT, rng, period_s=PERIOD_S))
    assert found.status == "ok"
    assert off_m(found) < 5e-3
    assert found.before_m > 0.05 > 1e-3 > found.after_m
    assert set(found.frame_sd) == {"x_m", "y_m", "yaw_rad"}
    assert found.frame_sd["x_m"] == pytest.approx(0.3 / np.sqrt(len(HALL)), rel=0.05)
    assert "guesses" in found.gauge


def test_known_beacons_hold_the_frame() -> None:
    rng = np.random.default_rng(2)
    site = guesses(rng, known=2)
    found = survey(site, heard(site, HALL, wander, COUNT, rng, period_s=PERIOD_S))
    assert found.status == "ok"
    assert not found.frame_sd
    assert places(found)[:2] == pytest.approx(HALL[:2])
    assert np.abs(places(found) - HALL).max() < 8e-3


def test_nothing_known_gives_the_shape_and_says_that_it_may_be_mirrored() -> None:
    rng = np.random.default_rng(3)
    site = guesses(rng, sd_m=5.0)
    found = survey(site, heard(site, HALL, wander, COUNT, rng, period_s=PERIOD_S), Wishes(ignore_guesses=True))
    assert found.status == "open"
    assert "mirror" in found.mirror
    assert "above or below" in found.mirror
    assert places(found)[0, :2] == pytest.approx([0, 0], abs=1e-9)
    assert min(off_m(found), _mirrored_off_m(found)) < 4e-3
    # undecided is uncertain
    assert all(b.sd_m.max() > 1.0 for b in found.beacons)


def _mirrored_off_m(found) -> float:
    image = laid_upon(places(found) * np.array([1.0, -1.0, 1.0]), HALL, True)
    return float(np.sqrt(np.mean(np.sum((image - HALL) ** 2, axis=1))))


def test_guesses_of_metres_are_enough_to_tell_mirror_images() -> None:
    rng = np.random.default_rng(4)
    site = guesses(rng, sd_m=1.5)
    site = site.model_copy(update={"section": site.section.model_copy(update={"bounds_m": ((-9, -9, 0), (19, 17, 9))})})
    found = survey(site, heard(site, HALL, wander, COUNT, rng, period_s=PERIOD_S))
    assert (found.status, found.mirror) == ("ok", "")
    assert off_m(found) < 4e-3


def test_all_known_leaves_biases_and_the_sound_speed() -> None:
    rng = np.random.default_rng(5)
    site = hall(HALL, 0.0)
    epochs = heard(site, HALL, wander, COUNT, rng, period_s=PERIOD_S, sound_speed_mps=344.0)
    found = survey(site, epochs, Wishes(speed_sd_mps=1.0))
    assert found.sound_speed_mps == pytest.approx(344.0, abs=4 * found.sound_speed_sd_mps)
    assert found.sound_speed_sd_mps < 0.1
    assert not found.covariance_m2.any()


def test_a_late_beacon_is_found() -> None:
    rng = np.random.default_rng(6)
    site = guesses(rng, known=3)
    bias = np.zeros(len(HALL))
    bias[4] = 0.06
    found = survey(site, heard(site, HALL, wander, COUNT, rng, period_s=PERIOD_S, bias_m=bias))
    for beacon, true in zip(found.beacons, bias, strict=True):
        assert beacon.bias_m == pytest.approx(true, abs=4.5 * beacon.bias_sd_m)
        assert beacon.bias_sd_m < 0.004
    assert corrected(site, found, True).beacon("B5").delay_s == pytest.approx(0.06 / 343.2, abs=2e-5)
    assert corrected(site, found, False).beacon("B5").delay_s == 0.0


def test_each_pair_may_have_its_own_bias() -> None:
    rng = np.random.default_rng(7)
    arms = ((0.2, 0.0, 0.4), (-0.2, 0.1, 0.4))
    site = hall(HALL, 0.0, arms=arms)
    epochs = heard(site, HALL, wander, 30, rng, period_s=PERIOD_S, yaw=lambda t: 0.1 * t, bias_m=0.05)
    found = survey(site, epochs, Wishes(biases="pair"))
    assert len(found.pairs) == 2 * len(HALL)
    assert [p.bias_m for p in found.pairs] == pytest.approx([0.05] * 14, abs=0.01)
    clean = without_biases(epochs[0], found)
    assert epochs[0].range_m - clean.range_m == pytest.approx(np.full(14, 0.05), abs=0.01)


def test_wrong_ranges_are_left_out_and_told() -> None:
    rng = np.random.default_rng(8)
    site = guesses(rng)
    epochs = heard(site, HALL, wander, COUNT, rng, period_s=PERIOD_S)
    for epoch in epochs[::4]:
        epoch.range_m[2] += 0.8
    found = survey(site, epochs)
    assert found.excluded == 10
    assert off_m(found) < 3e-3
    assert next(e.detail for e in found.events if e.event == "excluded").startswith("10 of 40 ranges of B3")


def test_an_unknown_clock_is_found_with_the_beacons() -> None:
    rng = np.random.default_rng(9)
    site = guesses(rng, known=2)
    epochs = heard(site, HALL, wander, COUNT, rng, period_s=PERIOD_S, clock=(4.0, 3e-3))
    found = survey(site, epochs, Wishes(biases="none"))
    assert np.abs(places(found) - HALL).max() < 8e-3
    assert found.clock_offset_m == pytest.approx(4.0, abs=5e-3)
    assert found.clock_drift_mps == pytest.approx(3e-3, abs=2e-4)


def test_understated_noise_does_not_come_out_as_confidence() -> None:
    rng = np.random.default_rng(10)
    site = guesses(rng)
    epochs = heard(site, HALL, wander, COUNT, rng, period_s=PERIOD_S)
    calm = survey(site, epochs, Wishes(biases="none"))
    for epoch in epochs:
        epoch.range_m[:] += 5e-3 * rng.standard_normal(len(epoch))
    rough = survey(site, epochs, Wishes(biases="none"))
    assert rough.inflation > 3.0
    assert all(r.sd_m.max() > 1.5 * c.sd_m.max() for r, c in zip(rough.beacons, calm.beacons, strict=True))


@pytest.mark.parametrize("seed", [11, 12])
def test_a_straight_drive_tells_no_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    site = guesses(rng)
    found = survey(site, heard(site, HALL, straight, COUNT, rng), Wishes(biases="none"))
    assert found.status == "open"
    assert "straight" in found.remedy
    alone = [d for d in found.open if "together" not in d.text]
    assert {d.text.split()[0] for d in alone} >= {"B1", "B2", "B3", "B4", "B5"}
    for direction in alone:
        assert direction.drive_sd_m > 0.3
        assert direction.sd_m > 0.2
    _assert_honest(found)


@pytest.mark.parametrize("seed", [13, 14])
def test_a_circle_tells_no_size(seed: int) -> None:
    rng = np.random.default_rng(seed)
    site = guesses(rng)
    found = survey(site, heard(site, HALL, circle, COUNT, rng), Wishes(biases="none"))
    assert found.status == "open"
    assert [d.text for d in found.open] == ["all beacons together, outwards and down from their middle or back"]
    assert found.open[0].drive_sd_m > 0.5
    _assert_honest(found)


def _assert_honest(found) -> None:
    off = places(found) - laid_upon(HALL, places(found), True)
    sd = np.array([b.sd_m for b in found.beacons])
    assert np.abs(off / sd).max() < 4.0


@pytest.mark.parametrize(("way", "word"), [(straight, "straight"), (circle, "circle")])
def test_such_drives_find_nothing_without_guesses(way, word: str) -> None:
    rng = np.random.default_rng(15)
    site = guesses(rng)
    found = survey(site, heard(site, HALL, way, COUNT, rng), Wishes(ignore_guesses=True))
    assert found.status == "failed"
    assert word in found.remedy
    assert places(found) == pytest.approx(np.array([b.position_m for b in site.beacons]))


def test_a_listening_site_believes_no_place() -> None:
    site = unplaced(hall(HALL, 0.0))
    assert all(b.position_sd_m >= 1000 for b in site.beacons)


def test_marks_are_set_and_strangers_refused() -> None:
    site = marked(hall(HALL, 0.0), 0.5, ["B2"])
    assert [b.position_sd_m for b in site.beacons] == [0.5, 0.0] + [0.5] * 5
    with pytest.raises(ValueError, match="--known B9: the site has no such fixed beacon; it has B1, B2"):
        marked(site, None, ["B9"])
