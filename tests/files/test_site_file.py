from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonofix.files import RecordingError, read_site, site_text
from sonofix.files.schema import schema_text, site_schema
from sonofix.files.site_file import parse_site
from sonofix.site import (
    AirSection,
    Beacon,
    ChipsCode,
    ChirpCode,
    GoldCode,
    Microphone,
    MSequenceCode,
    Origin,
    Pair,
    ReferenceCode,
    Schedule,
    Signal,
    Site,
    Vehicle,
)

ROOT = Path(__file__).parents[2]

numbers = st.floats(-1e6, 1e6)
vectors = st.tuples(numbers, numbers, numbers)
ids = st.text(
    st.characters(codec="utf-8", exclude_categories=("C", "Z"), exclude_characters=',"'), min_size=1, max_size=9
)
positive = st.floats(1e-6, 1e6)
codes = st.one_of(
    st.builds(GoldCode, degree=st.just(7), index=st.integers(0, 128)),
    st.builds(ChirpCode, start_hz=st.floats(1, 9), stop_hz=st.floats(10, 99), duration_s=positive),
    st.builds(ChipsCode, chips=st.text("01", max_size=40).map(lambda tail: "01" + tail), family=st.none() | ids),
    st.builds(ReferenceCode, reference=ids, distance_m=st.none() | positive, start_s=st.none() | positive),
    st.just(MSequenceCode(degree=9, taps=(1, 4, 5))),
)


@st.composite
def sites(draw):
    code_list = draw(st.lists(codes, max_size=3, unique_by=repr))
    names = draw(st.lists(ids, min_size=len(code_list) + 1, max_size=len(code_list) + 1, unique=True))
    beacons = [Beacon(id=names[0], vehicle="agv", lever_arm_m=draw(vectors), delay_s=draw(numbers))]
    beacons += [
        Beacon(id=name, position_m=draw(vectors), code=code, position_sd_m=draw(positive))
        for name, code in zip(names[1:], code_list, strict=True)
    ]
    return Site(
        name=draw(st.text()),
        bounds_m=draw(st.none() | st.just(((0.0, 0.0, 0.0), (1.0, 2.0, 3.5)))),
        origin=draw(st.none() | st.builds(Origin, latitude_deg=st.floats(-90, 90), longitude_deg=st.floats(-180, 180))),
        air=draw(st.builds(AirSection, temperature_c=st.floats(-40, 60), sound_speed_mps=st.none() | st.just(343.2))),
        schedule=draw(st.builds(Schedule, period_s=st.none() | positive, synchronised=st.booleans())),
        signal=draw(
            st.builds(Signal, carrier_hz=positive, cycles_per_chip=positive, bandwidth_hz=st.none() | positive)
        ),
        vehicles=(Vehicle(id="agv", z_m=draw(st.none() | numbers)),),
        beacons=tuple(beacons),
        microphones=(Microphone(id="M", channel=0, position_m=draw(vectors)),),
    )


@given(sites())
def test_a_site_survives_being_written_and_read(site):
    assert Site.model_validate(tomllib.loads(site_text(site))) == site


def problems(text: str) -> list[str]:
    with pytest.raises(RecordingError) as caught:
        parse_site(text)
    return [str(problem) for problem in caught.value.problems]


GOOD = 'format = 1\n[[beacon]]\nid = "B"\nposition_m = [0, 0, 1]\n'


def test_a_mistake_is_one_line_with_file_field_value_and_remedy():
    assert problems(GOOD + "position_sd_m = -0.5\n") == [
        'site.toml: beacon 1 "B" position_sd_m = -0.5: must be greater than or equal to 0'
    ]


def test_mistakes_of_different_kinds_come_together():
    lines = problems(GOOD + "colour = 1\n" + '[[beacon]]\nid = "B"\n[air]\ntemprature_c = 3\n[extra]\nx = 1\n')
    assert len(lines) == 5
    for fragment in ("extra", "temperature_c?", "colour", "has it already", "fixed or mounted"):
        assert any(fragment in line for line in lines), fragment


def test_syntax_errors_name_and_show_the_line():
    (line,) = problems(GOOD + "delay_s = 1,5\n")
    assert line.startswith('site.toml: line 5 = "delay_s = 1,5": not TOML')


def test_a_byte_order_mark_is_no_mistake(tmp_path):
    (tmp_path / "site.toml").write_text(GOOD, encoding="utf-8-sig")
    assert read_site(tmp_path / "site.toml").beacon("B").position_m == (0, 0, 1)


def test_a_folder_is_read_through_its_site_file(tmp_path):
    (tmp_path / "site.toml").write_text(GOOD)
    assert read_site(tmp_path) == read_site(tmp_path / "site.toml")


def test_a_remedy_is_never_pydantics_own_wording():
    lines = problems(
        'format = "1"\nbeacon = 3\n[air]\nhumidity = 7\ntemperature_c = "x"\n[signal]\ncarrier_hz = nan\n'
        'modulation = 3\n[schedule]\nsynchronised = 1\n[[vehicle]]\nid = "a,b"\n'
    )
    assert len(lines) == 8
    for line in lines:
        assert not re.search(r"Input|String should|validation|pydantic|valid (tuple|dict)", line)


def test_the_published_schema_is_up_to_date():
    """Made by `python -m sonofix.files.schema > docs/site.schema.json`."""
    assert json.loads((ROOT / "docs" / "site.schema.json").read_text()) == json.loads(schema_text())


def test_the_schema_knows_every_key():
    schema = site_schema()
    known = set(schema["properties"]) | {key for part in schema["$defs"].values() for key in part["properties"]}
    for model in (
        AirSection,
        Beacon,
        Microphone,
        Vehicle,
        Signal,
        Schedule,
        Origin,
        ChipsCode,
        ChirpCode,
        ReferenceCode,
    ):
        assert set(model.model_fields) <= known
    assert {"site", "beacon", "microphone", "vehicle", "format"} <= set(schema["properties"])
    assert "null" not in schema_text()


PAIRED = (
    GOOD
    + """
[[microphone]]
id = "M"
position_m = [1, 2, 3]
[[pair]]
from = "B"
to = "M"
"""
)


def test_a_pairs_bias_is_read_and_written_back():
    site = parse_site(PAIRED + "bias_m = 0.2\nbias_sd_m = 0.01\n")
    assert site.pairs == (Pair.model_validate({"from": "B", "to": "M", "bias_m": 0.2, "bias_sd_m": 0.01}),)
    assert parse_site(site_text(site)) == site
    # 0 is what a key is that is left out, but one of the two is stated
    known = parse_site(PAIRED + "bias_m = 0.0\n")
    assert known.pairs[0].bias_sd_m == 0.0
    assert parse_site(site_text(known)) == known


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("bias_m = nan\n", "pair 1 bias_m = nan: must be finite"),
        ("bias_m = 1e300\n", "pair 1 bias_m = 1e+300: must be less than or equal to 1000"),
        ("bias_m = 0.1\nbias_sd_m = 1e6\n", "pair 1 bias_sd_m = 1000000.0: must be less than or equal to 100"),
        ("bias_m = 0.1\nbias_sd_m = -0.1\n", "pair 1 bias_sd_m = -0.1: must be greater than or equal to 0"),
        ("bias_m = '0.1'\n", "must be a number"),
        ("", "pair 1 bias_m: the pair tells nothing: give"),
        ("bias_m = 0.1\nbias = 2\n", "pair 1 bias = 2: unknown key; did you mean bias_m"),
        ("bias_m = 0.1\nemitter = 'B'\n", "pair 1 emitter"),
        (
            "bias_m = 0.1\n[[pair]]\nfrom = 'C'\nto = 'M'\nbias_m = 0.1\n",
            'pair 2 from = "C": no [[beacon]] has this id',
        ),
        ("bias_m = 0.1\n[[pair]]\nfrom = 'B'\nto = 'N'\nbias_m = 0.1\n", "(known: M); correct the name"),
        ("bias_m = 0.1\n[[pair]]\nfrom = 'B'\nto = 'M'\nbias_m = 0.2\n", "pair 1 is from B to M already"),
        ("bias_m = 0.1\n[[pair]]\nto = 'M'\nbias_m = 0.2\n", "pair 2 from: is missing; add it"),
    ],
)
def test_mistakes_in_pairs_name_field_value_and_remedy(text, told):
    lines = problems(PAIRED + text)
    assert len(lines) == 1
    assert told in lines[0]
