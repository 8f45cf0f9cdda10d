"""Corrected site files: values change, all else stays; nothing is written over by mistake."""

import json

import numpy as np
import pytest

from sonofix.files import RecordingError
from sonofix.files.site_file import parse_site
from sonofix.files.survey_writing import check_targets, corrected_text, survey_values, write_site, write_survey
from sonofix.records import OpenDirection, PairBias, Survey, SurveyedBeacon
from sonofix.site import Pair

TEXT = """# our hall
format = 1
[site]
name = "hall"   # the big one

[[beacon]]  # by the door
id = "B1"
position_m = [0.0, 0.0, 3.0]   # taped
position_sd_m = 0.3
# more to come

[[beacon]]
position_m = [
  5.0, 0.0,  # rough
  3.0,
]
id = "B2"

[[microphone]]
id = "M1"
vehicle = "cart"
[[vehicle]]
id = "cart"
"""


def changed(site):
    first, second = site.beacons
    first = first.model_copy(update={"position_m": (0.1, -0.2, 3.05), "position_sd_m": 0.002, "delay_s": 1e-6})
    second = second.model_copy(update={"position_m": (5.5, 0.25, 2.9), "position_sd_m": 0.004})
    return site.model_copy(update={"beacons": (first, second)})


def test_values_change_and_comments_stay() -> None:
    before = parse_site(TEXT)
    after = changed(before)
    text = corrected_text(TEXT, before, after)
    assert parse_site(text) == after
    for kept in ("# our hall", "# the big one", "# by the door", "# taped", "# more to come"):
        assert kept in text
    assert text.index("delay_s") < text.index("# more to come") < text.index('id = "B2"')
    assert text.splitlines().index("position_sd_m = 0.002") == TEXT.splitlines().index("position_sd_m = 0.3")


def test_nothing_to_change_leaves_the_text_alone() -> None:
    site = parse_site(TEXT)
    assert corrected_text(TEXT, site, site) == TEXT


def test_text_that_cannot_be_edited_is_written_anew() -> None:
    inline = (
        'format = 1\nbeacon = [{ id = "B1", position_m = [0.0, 0.0, 3.0] }, { id = "B2", position_m = [5, 0, 3] }]\n'
    )
    before = parse_site(inline)
    after = changed(before)
    assert parse_site(corrected_text(inline, before, after)) == after


def test_a_file_without_a_last_line_break_is_added_to() -> None:
    text = 'format = 1\n[[beacon]]\nid = "B1"\nposition_m = [0, 0, 3]\n[[beacon]]\nid = "B2"\nposition_m = [5, 0, 3]'
    before = parse_site(text)
    after = changed(before)
    edited = corrected_text(text, before, after)
    assert parse_site(edited) == after
    assert edited.startswith('format = 1\n[[beacon]]\nid = "B1"\nposition_m = [0.1, -0.2, 3.05]\n')


def test_writing_over_needs_a_word_and_the_source_stays(tmp_path) -> None:
    target = tmp_path / "new.toml"
    (tmp_path / "site.toml").write_text(TEXT)
    site = parse_site(TEXT)
    check_targets({"site file": target}, tmp_path, site, False)
    target.write_text("x")
    with pytest.raises(RecordingError, match="--force"):
        check_targets({"site file": target}, tmp_path, site, False)
    check_targets({"site file": target}, tmp_path, site, True)
    with pytest.raises(RecordingError, match=r"survey's own site\.toml"):
        check_targets({"site file": tmp_path / "." / "site.toml"}, tmp_path, site, True)
    with pytest.raises(RecordingError, match="is a folder"):
        check_targets({"site file": tmp_path}, tmp_path, site, True)
    write_site(target, "format = 1\n")
    assert target.read_text() == "format = 1\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new.toml", "site.toml"]


def test_a_place_that_cannot_be_written_to_is_named(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written"):
        write_site(tmp_path / "file" / "site.toml", "")


def test_json_holds_the_covariance_and_null_for_unknown(tmp_path) -> None:
    beacon = SurveyedBeacon("B1", np.zeros(3), np.ones(3), None, np.eye(3) * 1e-6, None, None, 9, 8, float("nan"))
    found = Survey(
        "open", "drive", (beacon,), np.eye(3) * 1e-6, "own", {}, "", (OpenDirection(np.eye(1, 3), np.inf, 0.3, "B1"),),
        (PairBias("B1", "M1", 0.1, 0.01),), 343.0, 0.0, 343.0, 0.0, None, None, {}, 9, 1, float("nan"), 1e-3,
        float("nan"), 1.0, (),
    )  # fmt: skip
    write_survey(tmp_path / "s.json", found)
    read = json.loads((tmp_path / "s.json").read_text())
    assert read == survey_values(found)
    assert read["beacons"][0]["sd_m"] == pytest.approx([1e-3] * 3)
    assert read["unknown"][0]["drive_sd_m"] is None
    assert read["residual_before_m"] is None


PAIR = """
[[pair]]  # by the tape
to = "M1"
from = "B1"
bias_m = 0.1  # roughly
"""


def test_biases_change_where_they_stand_and_new_ones_are_added() -> None:
    before = parse_site(TEXT + PAIR)
    first = before.pairs[0].model_copy(update={"bias_m": 0.15, "bias_sd_m": 0.004})
    second = Pair.model_validate({"from": "B2", "to": "M1", "bias_m": -0.02, "bias_sd_m": 0.003})
    after = changed(before).model_copy(update={"pairs": (first, second)})
    text = corrected_text(TEXT + PAIR, before, after)
    assert parse_site(text) == after
    assert "[[pair]]  # by the tape" in text
    assert "bias_m = 0.15  # roughly" in text
    assert text.rstrip().endswith("bias_sd_m = 0.003")
    # without a line's end, too
    bare = parse_site(TEXT)
    assert parse_site(corrected_text(TEXT.rstrip(), bare, bare.model_copy(update={"pairs": (second,)}))).pairs == (
        second,
    )
