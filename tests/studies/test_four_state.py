"""The first seed's filter: its matrices as printed, its twin by the textbook, what theory says of it."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.studies import four_state, quasi_gps

DT = 0.5


def test_matrices_are_those_printed() -> None:
    # eqs 11, 13, 18 and 19, cell by cell
    np.testing.assert_array_equal(
        four_state.transition(0.5), [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]
    )
    np.testing.assert_array_equal(four_state.observation(), [[1, 0, 0, 0], [0, 0, 1, 0]])
    np.testing.assert_allclose(four_state.measurement_noise(0.05, 0.04), [[0.0025, 0], [0, 0.0016]])
    np.testing.assert_allclose(four_state.process_noise(0.05, 0.04, 0.02), np.diag([0.0025, 0.0004, 0.0016, 0.0004]))


def test_coarse_velocities_are_forward_differences() -> None:
    places = np.array([[0.5, 0.5], [0.75, 0.70], [1.05, 0.95]])
    np.testing.assert_allclose(four_state.coarse_velocities(places, DT), [[0.5, 0.4], [0.6, 0.5]])
    np.testing.assert_allclose(four_state.coarse_velocities(places, np.array([0.5, 0.25])), [[0.5, 0.4], [1.2, 1.0]])


def test_many_runs_are_the_textbook_filter_run_by_run(rng: np.random.Generator) -> None:
    noise = four_state.measurement_noise(0.05, 0.07)
    process = four_state.process_noise(0.05, 0.07, 0.02)
    places = rng.standard_normal((3, 12, 2))
    got = four_state.follow(places, DT, four_state.gains(DT, noise, process, 12), np.full(4, 0.01))
    phi, h = four_state.transition(DT), four_state.observation()
    for run in range(3):
        state, covariance = np.full(4, 0.01), process
        for k in range(12):
            ahead, spread = phi @ state, phi @ covariance @ phi.T + process
            gain = spread @ h.T @ np.linalg.inv(h @ spread @ h.T + noise)
            state = ahead + gain @ (places[run, k] - h @ ahead)
            covariance = (np.eye(4) - gain @ h) @ spread
            np.testing.assert_allclose(got[run, k], state, rtol=1e-10)


def test_settled_errors_by_theory_are_those_measured_on_the_papers_numbers() -> None:
    noise = four_state.measurement_noise(0.05, 0.05)
    for with_places, place_cm, speed_cmps in ((0.05, 3.65, 1.27), (0.0, 3.1, 1.7)):
        gain = four_state.gains(DT, noise, four_state.process_noise(with_places, with_places, 0.02), 200)[-1]
        sd = 100 * four_state.settled_sd(DT, noise, gain)
        np.testing.assert_allclose(sd[[0, 2]], place_cm, atol=0.15)
        np.testing.assert_allclose(sd[[1, 3]], speed_cmps, atol=0.1)


def test_the_wrong_start_is_forgotten_before_what_counts() -> None:
    places, velocities = quasi_gps.truth(DT * np.arange(quasi_gps.EPOCHS))
    noise = four_state.measurement_noise(0.05, 0.05)
    gain = four_state.gains(DT, noise, four_state.process_noise(0.05, 0.05, 0.02), quasi_gps.EPOCHS)
    states = four_state.follow(places[None], DT, gain, np.array(quasi_gps.FIRST))[0]
    assert np.abs(states[0, 1::2] - velocities[0]).max() > 0.4  # as printed: P = Q is far too sure of it
    assert np.abs(states[quasi_gps.SETTLED :, 0::2] - places[quasi_gps.SETTLED :]).max() < 1e-5
    assert np.abs(states[quasi_gps.SETTLED :, 1::2] - velocities[quasi_gps.SETTLED :]).max() < 1e-5


def findings(runs: int, seed: int = 0) -> dict[tuple[str, str], tuple[float, float]]:
    work = quasi_gps.study(runs, seed, 0)
    for _ in work.work():
        pass
    sheet = work.sheet()
    assert sheet is not None
    assert all(f.sd is not None and f.runs == runs for f in sheet.findings)
    return {(f.case, f.quantity): (f.value, f.sd or 0.0) for f in sheet.findings}


def test_monte_carlo_comes_out_as_theory_has_it_and_as_asked() -> None:
    found = findings(300)
    noise = four_state.measurement_noise(0.05, 0.05)
    wanted = {
        ("coarse, eq 7", "position"): 0.05,
        ("coarse, eqs 8, 9", "velocity"): np.sqrt(2) * 0.05 / DT,
    }
    for case, with_places in (("filtered, Q as printed", 0.05), ("filtered, Q without places", 0.0)):
        gain = four_state.gains(DT, noise, four_state.process_noise(with_places, with_places, 0.02), 200)[-1]
        sd = four_state.settled_sd(DT, noise, gain)
        wanted[case, "position"], wanted[case, "velocity"] = sd[0], sd[1]
    assert set(found) == set(wanted)
    for key, value in wanted.items():
        got, error = found[key]
        # five standard errors of each: a false alarm in 300 000
        assert abs(got - value) < 5 * error, key
        assert error < 0.01 * value
    assert found["filtered, Q as printed", "position"][0] == pytest.approx(0.0365, abs=0.0015)
    assert found["filtered, Q as printed", "velocity"][0] == pytest.approx(0.0127, abs=0.001)


def test_a_run_is_the_same_however_many_there_are_and_another_by_seed() -> None:
    few, many = quasi_gps.simulated(range(2), 3, 10), quasi_gps.simulated(range(5), 3, 10)
    np.testing.assert_array_equal(few.printed, many.printed[:2])
    np.testing.assert_array_equal(quasi_gps.simulated(range(1, 2), 3, 10).coarse_m, few.coarse_m[1:])
    assert not np.array_equal(quasi_gps.simulated(range(2), 4, 10).coarse_m, few.coarse_m)
