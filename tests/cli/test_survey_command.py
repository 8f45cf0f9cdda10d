"""`sonofix survey`: what it tells and writes, and mistakes told in lines."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sonofix.channel import Sampled, direct_gains, noise_for_snr, simulate
from sonofix.cli.main import app
from sonofix.files import RecordingError, read_site, write_recording
from sonofix.files.site_file import site_text
from sonofix.files.survey_writing import check_targets
from sonofix.flow import run
from sonofix.records import RangeRows, Recording
from sonofix.signals.codes import primitive_taps
from sonofix.signals.waveform import waveforms_of
from sonofix.site import ReferenceCode, Site

runner = CliRunner()
PLACES = {"B1": (0.0, 0.0, 2.8), "B2": (8.0, 0.0, 3.1), "B3": (8.0, 6.0, 2.6), "B4": (0.0, 6.0, 2.9), "B5": (4, 6.2, 3)}


def hall(sd_m: float = 0.2) -> dict:
    rng = np.random.default_rng(3)
    taps = primitive_taps(7)
    return {
        "site": {"name": "small hall"},
        "air": {"sound_speed_mps": 343.0},
        "schedule": {"period_s": 0.4},
        "signal": {"carrier_hz": 20e3, "cycles_per_chip": 8, "bandwidth_hz": 4e3},
        "vehicle": [{"id": "agv", "z_m": 0.0}],
        "beacon": [
            {
                "id": name,
                "position_m": (np.array(place) + sd_m * rng.standard_normal(3)).round(3).tolist(),
                "position_sd_m": sd_m,
                "code": {"family": "m-sequence", "degree": 7, "taps": taps[i]},
            }
            for i, (name, place) in enumerate(PLACES.items())
        ],
        "microphone": [{"id": "M1", "channel": 0, "vehicle": "agv", "lever_arm_m": [0.0, 0.0, 0.4]}],
    }


def way(t: np.ndarray) -> np.ndarray:
    return np.column_stack([4 + 3.2 * np.sin(0.5 * t), 3 + 2.2 * np.sin(0.8 * t + 0.4), 0 * t])


def line(t: np.ndarray) -> np.ndarray:
    return np.column_stack([1 + 0.2 * t, 2 + 0.05 * t, 0 * t])


def ranged(folder: Path, drive=way, epochs: int = 60) -> Path:
    rng = np.random.default_rng(5)
    time_s = np.repeat(np.arange(epochs) * 0.4, len(PLACES))
    true = np.tile(np.array(list(PLACES.values())), (epochs, 1))
    range_m = np.linalg.norm(drive(time_s) + [0, 0, 0.4] - true, axis=1) + rng.normal(0, 0.002, len(time_s))
    rows = RangeRows(time_s, tuple(PLACES) * epochs, ("M1",) * len(time_s), range_m, np.full(len(time_s), 0.002))
    write_recording(folder, Recording(Site.model_validate(hall()), ranges=rows), {})
    text = (folder / "site.toml").read_text()
    (folder / "site.toml").write_text("# measured by pacing\n" + text)
    return folder


def shape_error_m(site: Site) -> float:
    from sonofix.survey.gauge import laid_upon

    found = np.array([b.position_m for b in site.beacons])
    true = np.array(list(PLACES.values()))
    return float(np.sqrt(np.mean(np.sum((laid_upon(found, true, True) - true) ** 2, axis=1))))


def test_stated_ranges_in_a_corrected_site_out(tmp_path) -> None:
    folder = ranged(tmp_path / "rec")
    before = (folder / "site.toml").read_bytes()
    told = runner.invoke(app, ["survey", str(folder), "--json", str(tmp_path / "s.json"), "--biases", "none"])
    assert told.exit_code == 0, told.stderr
    out = folder / "site_corrected.toml"
    assert (folder / "site.toml").read_bytes() == before
    assert out.read_text().startswith("# measured by pacing\n")
    site = read_site(out.rename(tmp_path / "site.toml"))
    assert shape_error_m(site) < 0.02 < shape_error_m(Site.model_validate(hall()))
    assert all(0 < b.position_sd_m < 0.02 for b in site.beacons)
    assert (folder / "site_corrected.png").read_bytes().startswith(b"\x89PNG")
    values = json.loads((tmp_path / "s.json").read_text())
    assert np.array(values["covariance_m2"]).shape == (15, 15)
    for words in (
        "small hall: 5 beacons, 300 ranges",
        "moved by",
        "sd z",
        "Frame: shift and turn",
        "Sound speed: 343.00",
    ):
        assert words in told.stdout
    assert "before" in told.stdout


def test_samples_in_a_corrected_site_out(tmp_path) -> None:
    site = Site.model_validate(hall(0.0))
    late = site.beacons[1].model_copy(update={"delay_s": 1e-4})
    true = site.model_copy(update={"beacons": (site.beacons[0], late, *site.beacons[2:])})
    waveforms = waveforms_of(site)
    t = np.arange(0, 14.0, 0.02)
    motions = {"agv": Sampled(t, way(t))}
    noise = noise_for_snr(15.0, 0.1, direct_gains(true, motions, waveforms, 1.0), waveforms)
    recording, truth = simulate(
        true, motions, rate_hz=64000, duration_s=13.6, waveforms=waveforms, level=0.1, noise_sd=noise, seed=3
    )
    folder = tmp_path / "rec"
    write_recording(folder, Recording(Site.model_validate(hall()), recording.rate_hz, recording.sample_count,
                                      recording.blocks, recording.sync_s), truth)  # fmt: skip
    out = tmp_path / "new.toml"
    told = runner.invoke(app, ["survey", str(folder), "-o", str(out), "--no-plot"])
    assert told.exit_code == 0, told.stderr
    assert not (folder / "site_corrected.toml").exists()
    found = read_site(out)
    assert shape_error_m(found) < 0.02
    assert found.beacon("B2").delay_s == pytest.approx(1e-4, abs=3e-5)
    assert "late by" in told.stdout


def test_a_straight_drive_is_told(tmp_path) -> None:
    folder = ranged(tmp_path / "rec", line)
    told = runner.invoke(app, ["survey", str(folder), "--no-plot", "--biases", "none"])
    assert told.exit_code == 0, told.stderr
    assert "This drive does not tell" in told.stdout
    assert "Remedy: drive again: neither straight" in told.stdout
    corrected = tomllib.loads((folder / "site_corrected.toml").read_text())
    assert all(b["position_sd_m"] > 0.1 for b in corrected["beacon"])
    told = runner.invoke(app, ["survey", str(folder), "--ignore-guesses", "--force"])
    assert told.exit_code == 2
    assert "the drive is straight" in told.stderr


def test_all_known_moves_nothing_and_says_so(tmp_path) -> None:
    folder = ranged(tmp_path / "rec")
    marks = [word for name in PLACES for word in ("--known", name)]
    told = runner.invoke(app, ["survey", str(folder), "--no-plot", *marks, "--sound-speed-sd", "2"])
    assert told.exit_code == 0, told.stderr
    assert "none was moved" in told.stdout
    assert "taken as it stands" in told.stdout


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--known", "B9"], "--known B9: the site has no such fixed beacon; it has B1, B2"),
        (["--biases", "some"], "--biases some: one of beacon, pair, none"),
        (["-o", "{folder}/site.toml"], "is the survey's own site.toml"),
        (["-o", "{folder}/site.toml", "--force"], "is the survey's own site.toml"),
        (["-o", "{folder}/j.toml", "--json", "{folder}/site.toml"], "is the survey's own site.toml; write the JSON"),
        (["--json", "{folder}/../rec/site.toml", "--force"], "is the survey's own site.toml"),
        (["-o", "{folder}/ranges.csv", "--force"], "is the survey's own ranges.csv"),
        (["--json", "{folder}/capture.flac", "--force"], "is the survey's own capture.flac"),
        (["-o", "{folder}/x", "--json", "{folder}/../rec/x"], "where the site file goes, and the JSON too"),
        (["-o", "{folder}/x.png"], "where the site file goes, and the picture too"),
        (["--json", "{folder}/site_corrected.png"], "where the JSON goes, and the picture too"),
        (["-o", "{folder}/ranges.csv/x.toml"], "cannot be written"),
        (["-o", "{folder}"], "is a folder"),
        (["-o", "."], "is a folder"),
    ],
)
def test_mistakes_are_told_in_a_line(tmp_path, options, words) -> None:
    folder = ranged(tmp_path / "rec", epochs=12)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    told = runner.invoke(app, ["survey", str(folder), *(o.format(folder=folder) for o in options)])
    assert told.exit_code == 2
    assert words in told.stderr
    assert len(told.stderr.splitlines()) == 1
    assert before == {p.name: p.read_bytes() for p in folder.iterdir()}
    assert sorted(p.name for p in folder.iterdir()) == ["ranges.csv", "site.toml"]


@pytest.mark.parametrize("option", ["-o", "--json"])
def test_a_reference_of_the_recording_is_never_written_over(tmp_path, option) -> None:
    site = Site.model_validate(hall())
    site = site.model_copy(
        update={"beacons": tuple(b.model_copy(update={"code": ReferenceCode(reference="b.wav")}) for b in site.beacons)}
    )
    (tmp_path / "b.wav").write_bytes(b"sound")
    (tmp_path / "link.toml").symlink_to(tmp_path / "b.wav")
    other = {"-o": "site file", "--json": "JSON"}[option]
    with pytest.raises(RecordingError, match=r"is the survey's own b\.wav"):
        check_targets({other: tmp_path / "link.toml"}, tmp_path, site, True)
    check_targets({other: tmp_path / "new.toml"}, tmp_path, site, False)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.wav", "link.toml"]


def test_an_unrelated_picture_is_kept_unless_forced(tmp_path) -> None:
    folder = ranged(tmp_path / "rec")
    (folder / "site_corrected.png").write_bytes(b"a photograph")
    asked = ["survey", str(folder), "--biases", "none"]
    told = runner.invoke(app, asked)
    assert told.exit_code == 2
    assert "site_corrected.png: is there already; give --force, or another name for the picture" in told.stderr
    assert (folder / "site_corrected.png").read_bytes() == b"a photograph"
    assert not (folder / "site_corrected.toml").exists()
    assert runner.invoke(app, [*asked, "--force"]).exit_code == 0
    assert (folder / "site_corrected.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("drive", "epochs", "words"),
    [
        (lambda t: way(0 * t + 1.0), 20, "the vehicle stood still: over 20 epochs no range changes by more than"),
        (
            way,
            1,
            "one epoch alone is heard, which brings 5 different ranges for 22 unknowns (5 guessed places, 5 delays",
        ),
        (way, 4, "too little is heard: 20 ranges and range rates for 22 unknowns"),
    ],
)
def test_what_cannot_be_surveyed_is_told_with_its_true_reason(tmp_path, drive, epochs, words) -> None:
    folder = ranged(tmp_path / "rec", drive, epochs)
    told = runner.invoke(app, ["survey", str(folder)])
    assert told.exit_code == 2
    assert f"{folder}: no survey: {words}" in told.stderr
    assert sorted(p.name for p in folder.iterdir()) == ["ranges.csv", "site.toml"]


@pytest.mark.parametrize("guess_sd", ["0.01", "0.1"])
@pytest.mark.parametrize("biases", ["none", "beacon"])
def test_a_straight_drive_of_unknown_level_is_surveyed_as_far_as_it_goes(tmp_path, guess_sd, biases) -> None:
    folder = ranged(tmp_path / "rec", line)
    site = folder / "site.toml"
    rough = Site.model_validate(hall(float(guess_sd)))
    text = site_text(rough.model_copy(update={"vehicles": (rough.vehicles[0].model_copy(update={"z_m": None}),)}))
    site.write_text(text, "utf-8")
    told = runner.invoke(
        app, ["survey", str(folder), "--no-plot", "--biases", biases, "--json", str(tmp_path / "s.json")]
    )
    assert told.exit_code == 0, told.stderr
    assert "This drive does not tell" in told.stdout
    values = json.loads((tmp_path / "s.json").read_text())
    assert values["unknown"]
    for beacon in values["beacons"]:
        off = np.array(beacon["position_m"]) - PLACES[beacon["id"]]
        assert np.all(np.abs(off) < 5 * float(guess_sd))


def test_biases_of_pairs_are_found_written_and_taken_off_again(tmp_path) -> None:
    biases_m = np.array([0.12, 0.25, 0.18, 0.3, 0.07])
    site = Site.model_validate(hall(0.0))
    rng = np.random.default_rng(8)
    epochs = 80
    time_s = np.repeat(np.arange(epochs) * 0.4, len(PLACES))
    true = np.tile(np.array(list(PLACES.values())), (epochs, 1))
    range_m = np.linalg.norm(way(time_s) + [0, 0, 0.4] - true, axis=1) + np.tile(biases_m, epochs)
    rows = RangeRows(time_s, tuple(PLACES) * epochs, ("M1",) * len(time_s),
                     range_m + rng.normal(0, 0.01, len(time_s)), np.full(len(time_s), 0.01))  # fmt: skip
    folder = tmp_path / "rec"
    write_recording(folder, Recording(site, ranges=rows), {})
    out = tmp_path / "new.toml"
    told = runner.invoke(app, ["survey", str(folder), "--biases", "pair", "-o", str(out), "--no-plot"])
    assert told.exit_code == 0, told.stderr
    found = read_site(out)
    assert [(p.emitter, p.receiver) for p in found.pairs] == [(name, "M1") for name in PLACES]
    off = np.array([p.bias_m for p in found.pairs]) - biases_m
    sd_m = np.array([p.bias_sd_m for p in found.pairs])
    assert np.abs(off).max() < 0.02
    assert np.abs(off / sd_m).max() < 4.5

    def miss_m(placed: Site, what: str) -> float:
        squares = []
        for step in run(Recording(placed, ranges=rows)):
            for told in step.fixes if what == "fixes" else step.estimates:
                if told.position_m is not None:
                    squares.append(np.sum((told.position_m[:2] - way(np.array([told.time_s]))[0, :2]) ** 2))
        assert len(squares) > 0.8 * epochs
        return float(np.sqrt(np.mean(squares)))

    assert miss_m(found, "fixes") < 0.02 < 0.06 < miss_m(site, "fixes")
    assert miss_m(found, "track") < 0.02
    # once more, with the new file: nothing is left to find, and what was found stays
    (folder / "site.toml").write_text(out.read_text())
    again = tmp_path / "again.toml"
    told = runner.invoke(app, ["survey", str(folder), "--biases", "pair", "-o", str(again), "--no-plot"])
    assert told.exit_code == 0, told.stderr
    both = [np.array([p.bias_m for p in read_site(path).pairs]) for path in (out, again)]
    np.testing.assert_allclose(both[0], both[1], atol=0.003)
    # a scale found beside them has no place in the file, and that is said
    assert "too long. A site file states that" not in told.output
    freed = ["survey", str(folder), "--biases", "pair", "--sound-speed-sd", "3", "--no-plot"]
    told = runner.invoke(app, [*freed, "-o", str(tmp_path / "freed.toml")])
    assert told.exit_code == 0, told.stderr
    text = " ".join(told.output.split())
    assert "% too long. A site file states that for times of flight alone ([air] sound_speed_mps)" in text
