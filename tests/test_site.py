from __future__ import annotations

import copy

import numpy as np
import pytest
from pydantic import ValidationError

from sonofix.site import (
    Beacon,
    ChipsCode,
    ChirpCode,
    GoldCode,
    KasamiCode,
    Microphone,
    MSequenceCode,
    ReferenceCode,
    Site,
    Vehicle,
)

RAW = {
    "format": 1,
    "site": {"name": "hall", "bounds_m": [[0, 0, 0], [10, 8, 3.2]]},
    "schedule": {"period_s": 0.5, "synchronised": True},
    "signal": {"carrier_hz": 40000.0, "modulation": "ask", "cycles_per_chip": 10, "bandwidth_hz": 4000.0},
    "vehicle": [{"id": "agv", "z_m": 0.0}],
    "beacon": [
        {"id": "B1", "position_m": [0, 0, 3.2], "code": {"family": "m-sequence", "degree": 9, "taps": [4]}},
        {"id": "B2", "position_m": [10, 0, 3.2], "code": {"family": "gold", "degree": 9, "index": 3}},
    ],
    "microphone": [{"id": "M1", "channel": 0, "vehicle": "agv", "lever_arm_m": [0.3, 0, 0.4]}],
}


def changed(*path: str | int, to: object) -> dict:
    raw = copy.deepcopy(RAW)
    part = raw
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = to
    return raw


def mistakes(raw: object) -> list[tuple[tuple[str | int, ...], str]]:
    with pytest.raises(ValidationError) as caught:
        Site.model_validate(raw)
    return [(error["loc"], error["msg"]) for error in caught.value.errors()]


def test_reads_what_stands_there():
    site = Site.model_validate(RAW)
    assert site.name == "hall"
    assert site.bounds_m == ((0, 0, 0), (10, 8, 3.2))
    assert site.beacon("B1").code == MSequenceCode(degree=9, taps=(4,))
    assert site.beacon("B2").code == GoldCode(degree=9, index=3)
    assert site.microphone("M1").lever_arm_m == (0.3, 0.0, 0.4)
    assert site.vehicle("agv").z_m == 0.0
    assert site.air.temperature_c == 20.0
    assert site.air.humidity == 0.5
    assert site.origin is None


def test_builds_from_python_names_too():
    by_name = Site(
        name="hall",
        bounds_m=((0, 0, 0), (10, 8, 3.2)),
        schedule=RAW["schedule"],
        signal=RAW["signal"],
        vehicles=(Vehicle(id="agv", z_m=0.0),),
        beacons=tuple(Beacon.model_validate(beacon) for beacon in RAW["beacon"]),
        microphones=(Microphone(id="M1", channel=0, vehicle="agv", lever_arm_m=(0.3, 0, 0.4)),),
    )
    assert by_name == Site.model_validate(RAW)


def test_numpy_numbers_are_numbers():
    site = Site(beacons=(Beacon(id="B", position_m=tuple(np.array([1.0, 2.0, 3.0]))),))
    assert site.beacon("B").position_m == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        ({"chips": "0110"}, ChipsCode),
        ({"chips": "0110", "family": "m-sequence", "degree": 9, "taps": [4]}, ChipsCode),
        ({"reference": "burst.flac", "distance_m": 0.1}, ReferenceCode),
        ({"family": "kasami", "degree": 8, "index": 15}, KasamiCode),
        ({"family": "chirp", "start_hz": 20000.0, "stop_hz": 30000, "duration_s": 0.01}, ChirpCode),
    ],
)
def test_keys_tell_the_kind_of_code(code, kind):
    assert type(Site.model_validate(changed("beacon", 0, "code", to=code)).beacon("B1").code) is kind


def test_a_beacon_overrides_the_signal():
    raw = changed("beacon", 1, "carrier_hz", to=38000)
    raw["beacon"][1]["modulation"] = "bpsk"
    site = Site.model_validate(raw)
    own, shared = site.signal_of(site.beacon("B2")), site.signal_of(site.beacon("B1"))
    assert (own.carrier_hz, own.modulation, own.cycles_per_chip, own.bandwidth_hz) == (38000, "bpsk", 10, 4000)
    assert shared == site.signal


def test_signal_of_a_beacon_without_any_carrier_says_what_is_missing():
    site = Site(beacons=(Beacon(id="B", position_m=(0, 0, 0)),))
    with pytest.raises(ValueError, match="carrier_hz"):
        site.signal_of(site.beacon("B"))


def test_only_beacons_with_a_code_take_part():
    raw = copy.deepcopy(RAW)
    del raw["beacon"][0]["code"]
    assert [beacon.id for beacon in Site.model_validate(raw).coded_beacons] == ["B2"]


def test_unknown_names_list_what_is_there():
    with pytest.raises(KeyError, match="B1, B2"):
        Site.model_validate(RAW).beacon("B3")


def test_is_frozen():
    with pytest.raises(ValidationError, match="frozen"):
        Site.model_validate(RAW).air.temperature_c = 25.0


def test_beacons_of_two_zones_may_share_a_code():
    raw = changed("beacon", 1, "code", to=RAW["beacon"][0]["code"])
    for zones in (("n", "n"), ("n", None), (None, None)):
        for beacon, zone in zip(raw["beacon"], zones, strict=False):
            beacon["zone"] = zone
        assert any("same code" in str(m) for m in mistakes(raw))
    raw["beacon"][0]["zone"], raw["beacon"][1]["zone"] = "n", "s"
    assert Site.model_validate(raw).beacons[1].zone == "s"


@pytest.mark.parametrize(
    ("path", "value", "where", "says"),
    [
        (("beacon", 1, "id"), "B1", ("beacon", 1, "id"), "beacon 1 has it already"),
        (("microphone", 0, "vehicle"), "car", ("microphone", 0, "vehicle"), "known: agv"),
        (("beacon", 0, "vehicle"), "agv", ("beacon", 0, "position_m"), "not both"),
        (("beacon", 0, "position_m"), None, ("beacon", 0, "position_m"), "fixed or mounted"),
        (("beacon", 0, "lever_arm_m"), [0, 0, 1], ("beacon", 0, "lever_arm_m"), "lever arm"),
        (("site", "bounds_m"), [[0, 0, 0], [10, 0, 3]], ("site", "bounds_m"), "y must be below"),
        (("beacon", 0, "offset_s"), 0.5, ("beacon", 0, "offset_s"), "within their period"),
        (("beacon", 1, "code"), RAW["beacon"][0]["code"], ("beacon", 1, "code"), "same code"),
        (("signal", "carrier_hz"), float("nan"), ("signal", "carrier_hz"), "finite"),
        (("signal", "carrier_hz"), True, ("signal", "carrier_hz"), "number"),
        (("signal", "carrier_hz"), "40000", ("signal", "carrier_hz"), "number"),
        (("signal", "carrier_hz"), 0, ("signal", "carrier_hz"), "greater than 0"),
        (("beacon", 0, "code", "taps"), [9], ("beacon", 0, "code", "m-sequence", "taps"), "from 1 to 8"),
        (("beacon", 1, "code", "degree"), 8, ("beacon", 1, "code", "gold", "degree"), "no preferred pair"),
        (("beacon", 1, "code", "index"), 513, ("beacon", 1, "code", "gold", "index"), "0 to 512"),
        (("format",), 2, ("format",), "1"),
        (("beacon",), [], ("beacon",), "nothing sends"),
    ],
)
def test_a_mistake_is_told_where_it_is(path, value, where, says):
    found = mistakes(changed(*path, to=value))
    assert [loc for loc, _ in found] == [where]
    assert says in found[0][1]


def test_only_vehicles_that_nothing_hears_need_no_beacon():
    assert Site.model_validate({"name": "yard", "vehicle": [{"id": "agv"}]}).beacons == ()
    for rest in ({}, {"vehicle": [{"id": "agv"}], "microphone": [{"id": "M1", "position_m": [0, 0, 0]}]}):
        assert (("beacon",), "nothing sends; add at least one [[beacon]]") in [
            (where, says.removeprefix("Value error, ")) for where, says in mistakes({"name": "yard"} | rest)
        ]


def test_all_mistakes_are_told_at_once():
    """Field errors must not hide broken rules of the same table, nor of the site."""
    raw = copy.deepcopy(RAW)
    raw["beacon"][0] |= {"colour": "red", "vehicle": "agv"}
    raw["beacon"][1] |= {"id": "B1", "position_m": [0, "x", 0], "code": {"family": "gold", "degree": 8, "index": -1}}
    raw["signal"]["cycles_per_chip"] = None
    raw["microphone"].append({"id": "M2", "channel": 0, "vehicle": "van"})
    assert {loc for loc, _ in mistakes(raw)} == {
        ("beacon", 0, "colour"),
        ("beacon", 0, "position_m"),
        ("beacon", 1, "position_m", 1),
        ("beacon", 1, "code", "gold", "index"),
        ("beacon", 1, "code", "gold", "degree"),
        ("beacon", 1, "id"),
        ("microphone", 1, "channel"),
        ("microphone", 1, "vehicle"),
        ("signal", "cycles_per_chip"),
    }


@pytest.mark.parametrize("junk", [1, "x", [1], {"id": [1]}, [[1]], {}, None, [{"id": {}}], [{"code": {"taps": 3}}]])
@pytest.mark.parametrize("key", ["site", "air", "schedule", "signal", "vehicle", "beacon", "microphone"])
def test_rules_take_any_junk_without_falling_over(key, junk):
    """A rule that tripped over junk would raise something else than the mistake that is told here."""
    assert (("colour",), "Extra inputs are not permitted") in mistakes({**RAW, key: junk, "colour": "red"})


def test_the_same_code_on_another_carrier_can_be_told_apart():
    raw = changed("beacon", 1, "code", to=RAW["beacon"][0]["code"])
    raw["beacon"][1]["carrier_hz"] = 25000
    assert len(Site.model_validate(raw).coded_beacons) == 2
