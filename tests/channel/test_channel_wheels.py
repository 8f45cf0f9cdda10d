"""Odometry of a motion: right where it errs by nothing, and off by as much as is asked for."""

from __future__ import annotations

import numpy as np
import pytest

from sonofix.channel import Circle, Still, odometry_of
from sonofix.channel.wheels import WHEELS_HZ

MOTIONS = {"K": Still((1.0, 2.0, 0.0)), "R1": Circle((0.0, 0.0, 0.0), 4.0, -0.8)}


def test_wheels_without_errors_tell_speed_and_yaw_rate() -> None:
    table = odometry_of(MOTIONS, 20.0, 0.0, 1)
    names, columns = np.array(table.names["vehicle"]), table.columns
    assert (np.diff(columns["time_s"]) >= 0).all()
    assert columns["time_s"][-1] == pytest.approx(20.0)
    # the chord of a tenth of a second is shorter than the arc by 2e-5
    np.testing.assert_allclose(columns["v_mps"][names == "R1"], 0.8, rtol=3e-5)
    np.testing.assert_allclose(columns["yaw_rate_radps"][names == "R1"], -0.2, rtol=1e-9)
    assert not columns["v_mps"][names == "K"].any()


def test_errors_last_and_scatter_by_the_share() -> None:
    """A mean over T s scatters by the lasting share and by as much over √T; of n robots that is known to 1 / √(2 n)."""
    robots, share, seconds = 300, 0.03, 8.0
    table = odometry_of({f"R{k}": Circle((0.0, 0.0, 0.0), 4.0, 0.8) for k in range(robots)}, seconds, share, 2)
    for name, true in (("v_mps", 0.8), ("yaw_rate_radps", 0.2)):
        off = table.columns[name].reshape(-1, robots) / true - 1
        mean = share * np.sqrt(1 + 1 / seconds)
        assert np.std(off.mean(axis=0)) == pytest.approx(mean, rel=4 / np.sqrt(2 * robots))
        assert np.std(np.diff(off, axis=0)) == pytest.approx(share * np.sqrt(2 * WHEELS_HZ), rel=0.05)
    again = odometry_of({f"R{k}": Circle((0.0, 0.0, 0.0), 4.0, 0.8) for k in range(robots)}, seconds, share, 2)
    np.testing.assert_array_equal(again.columns["v_mps"], table.columns["v_mps"])


@pytest.mark.parametrize("share", [-0.1, 1.0, np.nan])
def test_a_share_that_is_none_is_told(share: float) -> None:
    with pytest.raises(ValueError, match="0 or more, and below 1"):
        odometry_of(MOTIONS, 1.0, share, 0)
