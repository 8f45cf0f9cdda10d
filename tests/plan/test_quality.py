"""The map: what it holds, and that the receiver, listening to simulated bursts, finds what was planned."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from made_sites import BUDGET, CORNERS, ROOM, made, ready
from scipy.stats import chi2

from sonofix import flow
from sonofix.acquire.baseband import SHARE
from sonofix.channel import Still, simulate
from sonofix.files import read_recording
from sonofix.plan.budget import Budget, farthest_m, level_for_snr, strength
from sonofix.plan.coverage import coverage
from sonofix.plan.quality import judge, nodes_of, quality, weights
from sonofix.records import Walls
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

LEVEL_M = 0.4
QUIET = Budget(0.5, 1e-3, 96e3)
LOST = 1.005 / np.sqrt(SHARE)
"""What the receiver's pass band leaves out of a delay's information, by the deviation."""


def test_the_receiver_finds_the_deviations_and_strengths_that_were_planned() -> None:
    """Two places, a loud and a quiet site: range errors over planned deviations, SNRs, and fixes.

    Pooled errors are normal with a deviation between 1 and `LOST`: their mean square lies in the interval of χ² that
    a right plan misses once in 10⁴.
    """
    site = made(degree=8)
    waveforms = waveforms_of(site)
    range_errors, snr_differences, fix_errors = [], [], []
    for noise_db, x, y in ((-40.0, 3.0, 4.0), (-34.0, 7.0, 6.5)):
        budget = Budget(0.5, 10 ** (noise_db / 20), 96e3)
        nodes, terms = ready(site, budget)
        place = np.array([[x, y, LEVEL_M]])
        weight = weights(nodes, place, terms)
        distance = np.linalg.norm(nodes.position_m - place, axis=1)
        planned = {}
        for name, link, way in zip(nodes.ids, nodes.links, distance, strict=True):
            assert link is not None
            planned[name] = strength(link, budget, way, 343.2)
        got = judge(nodes.position_m, weight, place, terms, None)
        recording, _ = simulate(
            site,
            {"agv": Still((x, y, 0.0))},
            rate_hz=96e3,
            duration_s=6.0,
            waveforms=waveforms,
            noise_sd=budget.noise_sd,
            level=0.5,
            seed=5,
        )
        assert (weight > 0).all()
        for step in flow.run(recording):
            rows = step.ranges
            assert len(rows) == 4
            for i, name in enumerate(rows.emitter):
                true_m = distance[nodes.ids.index(name)]
                range_errors.append((rows.range_m[i] - true_m) / planned[name].sd_m)
                snr_differences.append(rows.snr_db[i] - planned[name].snr_db)
            fix_errors += [(f.position_m[:2] - [x, y]) / got.sd_m[0] for f in step.fixes if f.position_m is not None]
    count = len(range_errors)
    low, high = (np.sqrt(chi2.ppf(p, count) / count) for p in (5e-5, 1 - 5e-5))
    assert count >= 220
    assert low < np.sqrt(np.mean(np.square(range_errors))) < high * LOST
    assert abs(np.mean(snr_differences)) < 0.3
    # a fix's two coordinates share the planned √(σx² + σy²)
    low, high = (np.sqrt(chi2.ppf(p, len(fix_errors)) / len(fix_errors)) for p in (5e-5, 1 - 5e-5))
    assert low < np.sqrt(np.mean(np.sum(np.square(fix_errors), axis=1))) < high * LOST


def test_one_measured_burst_foretells_the_others(captures) -> None:
    """A recording that another simulator made: the nearest beacon's SNR sets the level, five others follow from it."""
    recording = read_recording(captures / "still")
    steps = list(islice(flow.run(recording), 16))
    names = sorted({name for step in steps for name in step.ranges.emitter})
    rows = {name: [] for name in names}
    for step in steps:
        for i, name in enumerate(step.ranges.emitter):
            values = (step.ranges.range_m[i], step.ranges.covariance_m2[i, i] ** 0.5, step.ranges.snr_db[i])
            rows[name].append(values)
    mean = {name: np.mean(values, axis=0) for name, values in rows.items()}
    assert len(names) == 6
    quiet = Budget(1.0, 1e-3, float(recording.rate_hz or 0))
    nodes = nodes_of(recording.site, quiet, waveforms_of(recording.site), 3.0)
    links = dict(zip(nodes.ids, nodes.links, strict=True))
    nearest = min(names, key=lambda name: mean[name][0])
    link = links[nearest]
    assert link is not None
    budget = replace(quiet, level=level_for_snr(mean[nearest][2], mean[nearest][0], link, quiet))
    for name in names:
        link = links[name]
        assert link is not None
        planned = strength(link, budget, mean[name][:1], recording.site.sound_speed_mps)
        assert planned.heard.all()
        assert planned.snr_db[0] == pytest.approx(mean[name][2], abs=0.5)
        assert planned.sd_m[0] == pytest.approx(mean[name][1], rel=0.06)


def test_what_is_planned_as_heard_is_heard_and_far_beyond_nothing_is() -> None:
    """A beacon at nine tenths of the reach, one at half as far again, each heard by itself."""
    heard = []
    for share in (0.9, 1.5):
        noise = 10 ** (-28 / 20)
        probe = made([(1.0, 1.0, 3.0)])
        link = ready(probe, Budget(0.5, noise, 96e3))[0].links[0]
        reach_m = farthest_m(link, Budget(0.5, noise, 96e3), 343.2)
        site = made([(1.0, 1.0, LEVEL_M)])
        recording, _ = simulate(
            site,
            {"agv": Still((1.0 + share * reach_m, 1.0, 0.0))},
            rate_hz=96e3,
            duration_s=6.0,
            waveforms=waveforms_of(site),
            noise_sd=noise,
            level=0.5,
            seed=6,
        )
        heard.append([len(step.ranges) for step in flow.run(recording)])
    assert np.mean(heard[0]) > 0.95
    assert np.mean(heard[1]) < 0.1


def test_the_map_agrees_with_coverage_where_all_is_heard() -> None:
    site = made()
    nodes, terms = ready(site, QUIET)
    got, plain = quality(site, nodes, terms, LEVEL_M, 0.5), coverage(site, LEVEL_M, 0.5)
    np.testing.assert_array_equal(got.x_m, plain.x_m)
    np.testing.assert_array_equal(got.heard, plain.count)
    np.testing.assert_allclose(got.hdop, plain.hdop)
    assert got.vdop is None
    assert got.sd_z_m is None
    assert got.share(got.fix) == plain.share_covered == 1.0


def test_an_unknown_level_brings_heights() -> None:
    site = made(free=True)
    nodes, terms = ready(site, QUIET)
    got = quality(site, nodes, terms, LEVEL_M, 1.0)
    assert got.vdop is not None
    assert got.sd_z_m is not None
    known = quality(site, *ready(made(), QUIET), LEVEL_M, 1.0)
    fix = got.fix
    assert fix.mean() > 0.9
    assert (got.sd_m[fix] >= known.sd_m[fix] * (1 - 1e-9)).all()
    assert (got.sd_z_m[fix] > 0).all()


def test_places_in_obstacles_are_no_floor_and_shade_what_is_behind() -> None:
    corners = np.array([(6.0, 3.0), (8.0, 3.0), (8.0, 6.0), (6.0, 6.0), (6.0, 3.0)])
    column = Walls(corners[:-1], corners[1:], np.full(4, np.inf), np.zeros(4, np.int64))
    site = made()
    got = quality(site, *ready(site, walls=column), LEVEL_M, 0.5)
    i, j = np.searchsorted(got.x_m, 7.0), np.searchsorted(got.y_m, 4.5)
    assert not got.floor[j, i]
    assert got.heard[j, i] == 0
    assert np.isnan(got.hdop[j, i])
    assert got.heard[got.floor].min() < 4
    assert 0 < (~got.floor).sum() <= 7 * 5
    low = Walls(column.start_m, column.end_m, np.full(4, 0.1), column.solid)
    lower = quality(site, *ready(site, walls=low), LEVEL_M, 0.5)
    np.testing.assert_array_equal(lower.floor, got.floor)  # nobody stands in a crate, but it hides nothing
    assert lower.heard[lower.floor].sum() > got.heard[got.floor].sum()
    # shares count the floor alone
    assert got.share(got.heard >= 0) == 1.0


def test_a_misplaced_beacon_counts_for_less() -> None:
    site = made()
    loose = site.model_copy(
        update={"beacons": (site.beacons[0].model_copy(update={"position_sd_m": 0.1}), *site.beacons[1:])}
    )
    place = np.array([[7.0, 4.0, LEVEL_M]])
    tight_w, loose_w = (weights(*(ready(s)[0], place, ready(s)[1])) for s in (site, loose))
    assert loose_w[0, 0] == pytest.approx(1 / (1 / tight_w[0, 0] + 0.01))
    assert (loose_w[0, 1:] == tight_w[0, 1:]).all()


def test_beams_down_hear_little_at_the_side_and_beams_to_the_centre_do() -> None:
    site = made([(0.5, 4.5, 1.0)])
    place = np.array([[10.0, 4.5, LEVEL_M]])
    narrow = Budget(0.5, 0.003, 96e3, beam_rad=np.deg2rad(60))
    nodes, down = ready(site, narrow)
    _, centre = ready(site, narrow, aim_m=(7.0, 4.5, LEVEL_M))
    assert weights(nodes, place, down)[0, 0] == 0
    on_axis = weights(nodes, place, centre)[0, 0]
    assert on_axis == pytest.approx(weights(*_at(site, place))[0, 0], rel=0.01)


def _at(site: Site, place):
    nodes, terms = ready(site, Budget(0.5, 0.003, 96e3))
    return nodes, place, terms


def test_stated_deviation_and_reach_take_the_budgets_place() -> None:
    site = made()
    nodes, terms = ready(site, None, range_sd_m=0.05, reach_m=8.0)
    weight = weights(nodes, np.array([[1.0, 1.0, LEVEL_M]]), terms)
    distance = np.linalg.norm(nodes.position_m - [1.0, 1.0, LEVEL_M], axis=1)
    np.testing.assert_allclose(weight[0], np.where(distance <= 8.0, 400.0, 0.0))


def test_a_sounding_vehicle_is_heard_by_fixed_microphones_alike() -> None:
    listening = made()
    sounding = Site.model_validate(
        {
            "name": "room",
            "bounds_m": ROOM,
            "air": {"sound_speed_mps": 343.2},
            "schedule": {"period_s": 0.2},
            "signal": {"carrier_hz": 40e3, "cycles_per_chip": 10.0, "bandwidth_hz": 4e3},
            "vehicle": [{"id": "agv", "max_speed_mps": 0.5, "z_m": 0.0}],
            "beacon": [{"id": "B", "vehicle": "agv", "lever_arm_m": (0, 0, 0.4), "code": listening.beacons[0].code}],
            "microphone": [{"id": f"M{i}", "channel": i, "position_m": p} for i, p in enumerate(CORNERS)],
        }
    )
    one, other = (quality(s, *ready(s), LEVEL_M, 1.0) for s in (listening, sounding))
    np.testing.assert_array_equal(one.heard, other.heard)
    np.testing.assert_allclose(one.sd_m, other.sd_m, rtol=0.02)  # codes of one length differ a little


def test_figures_over_the_floor_count_places_without_a_value_as_worst() -> None:
    site = made()
    got = quality(site, *ready(site), LEVEL_M, 1.0)
    values = np.full(got.heard.shape, np.nan)
    values.ravel()[: values.size // 2] = 1.0
    assert got.over_floor(values, 40) == 1.0
    assert got.over_floor(values, 60) == np.inf


def test_progress_reaches_one() -> None:
    site, told = made(), []
    quality(site, *ready(site), LEVEL_M, 0.2, on_done=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_beacon_without_a_burst_is_named() -> None:
    site = made()
    with pytest.raises(ValueError, match=r"no burst is known of B1, B2, B3, B4"):
        nodes_of(site, BUDGET, {}, 3.0)
