"""The team's picture: one plan of a short recording, each robot by itself in a long one, roles as they mostly were."""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest

from draw.conftest import HALL, Run, hall_site, loop, make_run
from sonofix.draw.team import LATEST_S, draw_team
from sonofix.draw.team_times import GAP_S, spells

NAMES = ("K", "R1", "R2")


@pytest.fixture(scope="module")
def long_team() -> Run:
    """Two minutes and a half, of which R2 is heard to the end and all else too."""
    ways = {
        name: lambda t, k=k: loop(np.asarray(t) * (1 - 0.2 * k) + 5 * k) * [1, 0.8, 1] for k, name in enumerate(NAMES)
    }
    site = hall_site(HALL, {f"m{name}": name for name in NAMES}, NAMES)
    return make_run(site, ways, duration_s=150, sd_m=0.03)


def titles(figure) -> list[str]:
    return [axes.get_title("left") for axes in figure.axes]


def test_a_short_recording_is_one_plan_and_a_lane_a_robot(team: Run) -> None:
    figure = draw_team(team.recording, team.steps, team.truths)
    # deviations: a lane a robot, the first of which is named
    assert titles(figure) == ["Tracks", "Roles", "Deviation of position (m)", "", ""]
    (plan,) = [axes for axes in figure.axes if axes.get_title("left") == "Tracks"]
    drawn = {line.get_label(): line for line in plan.lines}
    for name in NAMES:
        track = [e for step in team.steps for e in step.estimates if e.vehicle == name]
        np.testing.assert_array_equal(drawn[name].get_xdata(), [e.position_m[0] for e in track])
    lanes = figure.axes[2:]
    assert len({axes.get_ylim() for axes in lanes}) == 1
    for axes, name in zip(lanes, NAMES, strict=True):
        assert name in {text.get_text() for text in axes.texts}
    figure.savefig(BytesIO())


def test_a_long_recording_shows_its_last_minute_and_each_robot_alone(long_team: Run) -> None:
    figure = draw_team(long_team.recording, long_team.steps, long_team.truths)
    plans = [axes for axes in figure.axes if axes.get_title("left") in (f"Last {LATEST_S:g} s", *NAMES)]
    assert [axes.get_title("left") for axes in plans] == [f"Last {LATEST_S:g} s", *NAMES]
    end = max(e.time_s for step in long_team.steps for e in step.estimates)
    for axes in plans:
        drawn = {
            line.get_label(): len(np.asarray(line.get_xdata())) for line in axes.lines if line.get_label() in NAMES
        }
        title = axes.get_title("left")
        since = end - LATEST_S if title not in NAMES else 0.0
        shown = NAMES if title not in NAMES else (title,)
        told = [e for step in long_team.steps for e in step.estimates if e.time_s >= since]
        assert drawn == {name: sum(e.vehicle == name for e in told) for name in shown}
    # all to one scale and extent, with every landmark in sight
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in plans}) == 1
    (left, right), (low, high) = plans[0].get_xlim(), plans[0].get_ylim()
    for beacon in long_team.recording.site.beacons:
        assert beacon.position_m is not None
        assert left < beacon.position_m[0] < right
        assert low < beacon.position_m[1] < high
    # nothing covers anything else
    boxes = [axes.get_position() for axes in figure.axes]
    for i, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[i + 1 :])


def test_lines_break_where_a_robot_had_no_place(team: Run) -> None:
    first, last = 5.0, 5.0 + GAP_S + 1.0
    kept = [
        replace(step, estimates=tuple(e for e in step.estimates if e.vehicle != "K" or not first < e.time_s < last))
        for step in team.steps
    ]
    figure = draw_team(team.recording, kept, team.truths)
    drawn = {line.get_label(): np.asarray(line.get_xdata()) for line in figure.axes[0].lines}
    breaks = {name: np.flatnonzero(np.isnan(drawn[name])).tolist() for name in NAMES}
    before = sum(e.vehicle == "K" and e.time_s <= first for step in kept for e in step.estimates)
    assert breaks == {"K": [before], "R1": [], "R2": []}


def test_one_row_is_drawn(team: Run) -> None:
    """Nothing warns, which would be an error here."""
    draw_team(team.recording, team.steps[:1], {}).savefig(BytesIO())


def test_spells_are_what_a_robot_mostly_did() -> None:
    edges = np.arange(0.0, 6.0)
    time = np.arange(0.05, 3.0, 0.1)
    roles = ["base"] * 8 + ["explores"] * 22
    # one row amid the third spell is too short to be seen
    roles[25] = "alone"
    time, roles = np.append(time, 4.5), [*roles, "explores"]
    assert spells(edges, time, roles) == [(0.0, 1.0, "base"), (1.0, 3.0, "explores"), (4.0, 5.0, "explores")]
