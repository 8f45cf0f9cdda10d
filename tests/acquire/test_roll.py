"""Who is listened for: beacons that share a code, bursts of other periods, and when each began."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sonofix.acquire.epochs import Schedule, Window
from sonofix.acquire.roll import EARLIER, LATER, Roll
from sonofix.records import Prediction
from sonofix.signals.codes import m_sequence
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

SPEED = 343.2


def site(beacons: list[dict[str, Any]], period_s: float = 0.5) -> Site:
    return Site.model_validate(
        {
            "schedule": {"period_s": period_s, "synchronised": True},
            "signal": {"carrier_hz": 15e3, "cycles_per_chip": 6},
            "vehicle": [{"id": "v", "z_m": 0.0}],
            "beacon": beacons,
            "microphone": [{"id": "M", "channel": 0, "vehicle": "v"}],
        }
    )


def beacon(name: str, x_m: float, taps: int, **more: Any) -> dict[str, Any]:
    code = {"family": "m-sequence", "degree": 5, "taps": [taps]}
    return {"id": name, "position_m": (x_m, 0.0, 3.0), "code": code} | more


def roll(*beacons: dict[str, Any], period_s: float = 0.5) -> Roll:
    made = site(list(beacons), period_s)
    return Roll(made, waveforms_of(made), SPEED)


def expected(roll: Roll, window: Window, flights_s: dict[str, float]) -> dict[str, Prediction]:
    half_s = 31 * 6 / 15e3 / 2
    return {e: Prediction(e, "M", window.sync_s + f + half_s, 2e-4, 0.0, 0.05) for e, f in flights_s.items()}


def test_one_of_each_code_is_listened_for_where_nothing_is_known() -> None:
    asked = roll(beacon("A", 0, 2, zone="a"), beacon("B", 5, 3), beacon("C", 30, 2, zone="c", offset_s=0.1))
    assert asked.ambiguous
    call = asked.call(Window(0, 0.0, 0.0, 0.2), 0.0, ["A", "B", "C"], {})
    assert set(call.windows) == {"A", "B"}
    # as long as any of its code may come
    assert call.windows["A"] == pytest.approx((0.0, 0.3))
    assert asked.whose("A", Window(0, 0.0, 0.0, 0.2)) == [("A", 0.0), ("C", pytest.approx(-0.1))]
    assert asked.head("C") == "A"


def test_the_same_chips_written_otherwise_are_one_code() -> None:
    chips = "".join(map(str, m_sequence(5, [2]).astype(int)))
    asked = roll(beacon("A", 0, 2, zone="a"), beacon("C", 30, 3, zone="c") | {"code": {"chips": chips}})
    assert asked.sharing == {"A": ("A", "C")}


def test_two_of_a_code_expected_at_one_time_are_not_listened_for() -> None:
    asked = roll(beacon("A", 0, 2, zone="a"), beacon("C", 30, 2, zone="c"))
    window = Window(0, 0.0, 0.0, 0.2)
    apart = asked.call(window, 0.0, ["A", "C"], expected(asked, window, {"A": 0.02, "C": 0.07}))
    assert set(apart.predictions) == {"A", "C"}
    together = asked.call(window, 0.0, ["A", "C"], expected(asked, window, {"A": 0.045, "C": 0.0455}))
    assert not together.predictions
    # nor one that no burst reaches
    far = asked.call(window, 0.0, ["A", "C"], expected(asked, window, {"A": 0.02, "C": 0.19}))
    assert set(far.predictions) == {"A"}


def test_bursts_of_other_periods_are_listened_for_by_their_own_commands() -> None:
    asked = roll(beacon("A", 0, 2), beacon("B", 30, 3), period_s=0.05)
    assert asked.short
    jittery = np.array([0.0, 0.0503, 0.0999, 0.15])
    schedule = Schedule(0.05, 0.2, jittery, known=True, regular=True)
    for _ in range(2):
        schedule.done(np.zeros(0))
    window = schedule.window()
    assert window is not None
    flight_s = 0.07  # heard one period later than sent
    call = asked.call(window, 0.0, ["B"], expected(asked, window, {"B": flight_s}))
    assert call.sent_before_s["B"] == pytest.approx(0.0999 - 0.0503)
    assert call.predictions["B"].arrival_s == pytest.approx(0.0503 + flight_s + 31 * 6 / 15e3 / 2)
    assert {name for name in call.windows if name.startswith("B")} <= {"B", "B" + EARLIER, "B" + LATER}


def test_a_hall_that_a_period_spans_has_no_short_epochs() -> None:
    assert not roll(beacon("A", 0, 2), beacon("B", 30, 3), period_s=0.1).short
