"""Innovations against χ², drawn from it and from wrong ones."""

import numpy as np
import pytest

from sonofix.score import score_innovations

ROWS = np.tile([4.0, 8.0, 16.0], 3000)


def test_right_ones_have_one_a_row_and_lie_in_their_band(rng: np.random.Generator) -> None:
    found = score_innovations(ROWS, rng.chisquare(ROWS))
    assert found is not None
    assert (found.corrections, found.rows) == (9000, 84000)
    # the mean of χ² of 84000 degrees, and binomial shares of 9000: four deviations
    assert abs(found.nis_per_row - 1.0) < 4 * np.sqrt(2 / 84000)
    assert abs(found.inside_95 - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 9000)
    assert found.below + found.above + found.inside_95 == pytest.approx(1.0)
    assert abs(found.below - 0.025) < 4 * np.sqrt(0.025 * 0.975 / 9000)


@pytest.mark.parametrize("over", [0.25, 4.0])
def test_deviations_that_are_wrong_show(rng: np.random.Generator, over: float) -> None:
    found = score_innovations(ROWS, over * rng.chisquare(ROWS))
    assert found is not None
    assert found.nis_per_row == pytest.approx(over, rel=0.03)
    assert (found.above if over > 1 else found.below) > 0.5
    assert (found.below if over > 1 else found.above) < 0.01


def test_nothing_is_told_where_nothing_entered() -> None:
    assert score_innovations(np.zeros(0), np.zeros(0)) is None
    assert score_innovations(np.array([0.0, 3.0]), np.array([1.0, np.nan])) is None
