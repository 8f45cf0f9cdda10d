"""The frame of a survey: what is free, how places are laid upon each other, frames by convention."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonofix.survey.gauge import convention, freedom, laid_upon, rigid

PLACES = np.array([[0.0, 0, 3], [5, 0.3, 2.8], [9, 1, 3.1], [8.5, 7, 2.5], [1, 6, 3.3]])


@pytest.mark.parametrize(
    ("known", "level", "free"),
    [(0, True, 3), (1, True, 1), (2, True, 0), (0, False, 6), (1, False, 3), (2, False, 1), (3, False, 0)],
)
def test_free_motions_by_what_is_known(known: int, level: bool, free: int) -> None:
    found = freedom(PLACES[known:], PLACES[:known], level)
    assert found.count == free
    assert found.basis.T @ found.basis == pytest.approx(np.eye(free), abs=1e-12)


def turned(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


@given(angle=st.floats(-3.1, 3.1), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_shape_is_the_same_wherever_the_frame_stands(angle: float, x: float, y: float) -> None:
    moved = PLACES @ turned(angle).T + np.array([x, y, 0.0])
    assert laid_upon(moved, PLACES, True) == pytest.approx(PLACES, abs=1e-9)


def test_heights_are_no_matter_of_the_frame_on_a_level() -> None:
    raised = PLACES + np.array([0.0, 0.0, 0.2])
    assert laid_upon(raised, PLACES, True)[:, 2] == pytest.approx(raised[:, 2])
    assert laid_upon(raised, PLACES, False) == pytest.approx(PLACES, abs=1e-9)


def test_mirror_images_need_a_mirror() -> None:
    mirrored = PLACES * np.array([1.0, -1.0, 1.0])
    ones = np.ones(len(PLACES))
    turn, shift = rigid(mirrored, PLACES, ones, True, reflect=True)
    assert np.linalg.det(turn) == pytest.approx(-1.0)
    assert mirrored @ turn.T + shift == pytest.approx(PLACES, abs=1e-9)
    turn, shift = rigid(mirrored, PLACES, ones, True)
    assert np.abs(mirrored @ turn.T + shift - PLACES).max() > 1.0


def test_own_frame_begins_at_the_first_and_runs_to_the_second() -> None:
    turn, shift = convention(PLACES @ turned(2.0).T + 3.0, True)
    own = (PLACES @ turned(2.0).T + 3.0) @ turn.T + shift
    assert own[0, :2] == pytest.approx([0, 0], abs=1e-9)
    assert own[1, 1] == pytest.approx(0, abs=1e-9)
    assert own[1, 0] > 0
    assert own[:, 2] == pytest.approx(PLACES[:, 2] + 3.0)
    turn, shift = convention(PLACES, False)
    own = PLACES @ turn.T + shift
    assert own[2, 2] == pytest.approx(0, abs=1e-9)
    assert own[2, 1] > 0
