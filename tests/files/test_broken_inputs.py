"""A hundred broken inputs: each is answered in clear lines and exit code 2, or is flagged; never a traceback."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile
from typer.testing import CliRunner, Result

from sonofix.cli.main import app

RATE_HZ = 48000


# ---- ways to break a folder -----------------------------------------------------------------------------------------
def edit(old: str, new: str, count: int = 1) -> Callable[[Path], None]:
    """Replace text in the site file."""

    def apply(folder: Path) -> None:
        text = (folder / "site.toml").read_text()
        assert old in text, f"the test edits {old!r}, which the site file no longer holds"
        (folder / "site.toml").write_text(text.replace(old, new, count))

    return apply


def add(text: str) -> Callable[[Path], None]:
    """Append to the site file."""
    return lambda folder: (folder / "site.toml").write_text(f"{(folder / 'site.toml').read_text()}\n{text}\n") and None


def put(name: str, content: str | bytes) -> Callable[[Path], None]:
    """Write a file."""
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(data) and None


def both(*steps: Callable[[Path], None]) -> Callable[[Path], None]:
    return lambda folder: [step(folder) for step in steps] and None


def without_capture(folder: Path) -> None:
    (folder / "capture.wav").unlink()


def ranges(text: str) -> Callable[[Path], None]:
    """Make it a recording of ranges instead of samples."""
    return both(without_capture, put("ranges.csv", text))


def samples(
    change: Callable[[np.ndarray], np.ndarray], subtype: str = "PCM_16", rate: int = RATE_HZ, name="capture.wav"
):
    """Change the samples themselves."""

    def apply(folder: Path) -> None:
        values = soundfile.read(folder / "capture.wav", dtype="float32", always_2d=True)[0]
        (folder / "capture.wav").unlink()
        soundfile.write(folder / name, change(values), rate, subtype=subtype)

    return apply


def bytes_of(change: Callable[[bytes], bytes], flac: bool = False) -> Callable[[Path], None]:
    """Change the bytes of the sound file."""

    def apply(folder: Path) -> None:
        path = folder / "capture.wav"
        if flac:
            values, rate = soundfile.read(path)
            path.unlink()
            path = folder / "capture.flac"
            soundfile.write(path, values, rate)
        path.write_bytes(change(path.read_bytes()))

    return apply


def data_size(size: int) -> Callable[[bytes], bytes]:
    """State another length in a WAV's header."""

    def change(wav: bytes) -> bytes:
        at = wav.index(b"data") + 4
        return wav[:at] + struct.pack("<I", size) + wav[at + 4 :]

    return change


def flac_total(total: int) -> Callable[[bytes], bytes]:
    """State another length in a FLAC's header (the lower 36 bits of bytes 18 to 25)."""

    def change(flac: bytes) -> bytes:
        word = int.from_bytes(flac[18:26], "big")
        return flac[:18] + (word >> 36 << 36 | total).to_bytes(8, "big") + flac[26:]

    return change


def mutate(index: object, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values[index] = value
        return values

    return change


def in_one_place(folder: Path) -> None:
    text = (folder / "site.toml").read_text()
    for place in ("[0.0, 0.0, 2.5]", "[4.0, 0.0, 2.4]", "[4.0, 3.0, 2.5]", "[0.0, 3.0, 2.3]"):
        text = text.replace(f"position_m = {place}", "position_m = [2.0, 1.0, 2.5]")
    (folder / "site.toml").write_text(text)


def on_one_line(folder: Path) -> None:
    text = (folder / "site.toml").read_text()
    for i, place in enumerate(("[0.0, 0.0, 2.5]", "[4.0, 0.0, 2.4]", "[4.0, 3.0, 2.5]", "[0.0, 3.0, 2.3]")):
        text = text.replace(f"position_m = {place}", f"position_m = [{i}.0, 1.0, 2.5]")
    (folder / "site.toml").write_text(text)


def directory(name: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).mkdir()

    return apply


def reference(change: Callable[[Path], None]) -> Callable[[Path], None]:
    """Let B1's code be a recorded burst, and break that."""
    named = edit('{ family = "m-sequence", degree = 6, taps = [1] }', '{ reference = "burst.wav" }')
    return both(named, lambda folder: change(folder / "burst.wav"))


def sound(values: np.ndarray, rate: int = RATE_HZ, subtype: str = "PCM_16") -> Callable[[Path], None]:
    return lambda path: soundfile.write(path, values, rate, subtype=subtype)


def m(code: str) -> Callable[[Path], None]:
    """Give B1 another code."""
    return edit('{ family = "m-sequence", degree = 6, taps = [1] }', code)


def several_vehicles(then: Callable[[Path], None]) -> Callable[[Path], None]:
    return both(add('[[vehicle]]\nid = "second"\nz_m = 0.0'), then)


BURST = np.sin(np.arange(300) * 1.5) * 0.5
ROWS = "time_s,from,to,range_m\n0.0,B1,M1,3.0\n0.0,B2,M1,2.6\n0.0,B3,M1,3.2\n"
ODOMETRY = "time_s,v_mps,yaw_rate_radps\n"

# ---- what must be refused: name, how it is broken, words that the answer must hold -----------------------------------
REFUSED: list[tuple[str, Callable[[Path], None], tuple[str, ...]]] = [
    # the site file as a file
    ("no site file", lambda f: (f / "site.toml").unlink(), ("site.toml", "no such file")),
    ("site file is a folder", directory("site.toml"), ("site.toml", "folder")),
    ("site file empty", put("site.toml", ""), ("format = 1", "nothing sends")),
    ("site file not UTF-8", put("site.toml", b'format = 1\n[site]\nname = "\xff\xfe"\n'), ("line 3", "UTF-8")),
    ("site file binary", put("site.toml", bytes(range(256))), ("site.toml",)),
    ("TOML: no value", edit("period_s = 0.1", "period_s ="), ("line", "period_s =", "not TOML")),
    ("TOML: bare word", edit('id = "M1"', "id = M1"), ("line", "id = M1")),
    ("TOML: open string", edit('id = "M1"', 'id = "M1'), ("line", "not TOML")),
    ("TOML: key twice", edit("period_s = 0.1", "period_s = 0.1\nperiod_s = 0.2"), ("not TOML",)),
    ("TOML: section twice", add("[air]\nhumidity = 0.4"), ("not TOML",)),
    ("TOML: decimal comma", edit("period_s = 0.1", "period_s = 0,1"), ("period_s = 0,1", "not TOML")),
    ("TOML: nested deeply", put("site.toml", "a = " + "[" * 20000), ("not TOML",)),
    # keys
    ("format missing", edit("format = 1\n", ""), ("format", "is missing")),
    ("format of the future", edit("format = 1", "format = 2"), ("format = 2", "must be 1")),
    ("format as text", edit("format = 1", 'format = "1"'), ("format", "must be 1")),
    ("unknown section", add("[speakers]\nwatt = 3"), ("speakers", "unknown key")),
    ("misspelt section", add("[orign]\nlatitude_deg = 1.0"), ("orign", "did you mean origin")),
    ("unknown key in [site]", edit('name = "lab"', 'name = "lab"\ncolour = "red"'), ("site.colour", "unknown key")),
    ("unknown key in [air]", edit("temperature_c = 20.0", "temprature_c = 20.0"), ("did you mean temperature_c",)),
    ("unknown key in [schedule]", edit("period_s = 0.1", "perod_s = 0.1"), ("did you mean period_s",)),
    ("unknown key in [signal]", edit("carrier_hz =", "carier_hz ="), ("did you mean carrier_hz",)),
    ("unknown key in [origin]", add("[origin]\nlatitude_deg=1.0\nlongitude_deg=2.0\nlat=3"), ("origin.lat",)),
    ("unknown key in [[vehicle]]", edit("z_m = 0.0", "zm = 0.0"), ('vehicle 1 "agv" zm', "did you mean z_m")),
    ("unknown key in [[microphone]]", edit("channel = 0", "chanel = 0"), ("did you mean channel",)),
    ("unknown key in [[beacon]]", edit('id = "B2"', 'id = "B2"\npos = 3'), ('beacon 2 "B2" pos', "unknown key")),
    ("unknown key in code", edit("taps = [5]", "taps = [5], tabs = [3]"), ("code.tabs", "did you mean taps")),
    ("key in the wrong section", edit('id = "B2"', 'id = "B2"\nperiod_s = 1'), ("it belongs in [schedule]",)),
    ("name at the top", edit("format = 1", 'format = 1\nname = "x"'), ("name", "it belongs in [site]")),
    ("plural section", edit("[[vehicle]]", "[[vehicles]]"), ("vehicles", "did you mean vehicle")),
    ("single brackets", edit("[[vehicle]]", "[vehicle]"), ("vehicle", "[[vehicle]]")),
    ("double brackets", edit("[air]", "[[air]]"), ("air", "[air]")),
    # values
    ("text for a number", edit("period_s = 0.1", 'period_s = "0.1"'), ("schedule.period_s", "must be a number")),
    ("number for text", edit('id = "B3"', "id = 3"), ("beacon 3", "must be text")),
    ("truth value for a number", edit("period_s = 0.1", "period_s = true"), ("must be a number",)),
    ("text for a truth value", edit("synchronised = true", 'synchronised = "yes"'), ("must be true or false",)),
    ("period zero", edit("period_s = 0.1", "period_s = 0"), ("period_s = 0", "greater than 0")),
    ("period negative", edit("period_s = 0.1", "period_s = -1"), ("greater than 0",)),
    ("period infinite", edit("period_s = 0.1", "period_s = inf"), ("finite",)),
    ("temperature NaN", edit("temperature_c = 20.0", "temperature_c = nan"), ("temperature_c", "nan")),
    ("temperature in kelvin", edit("temperature_c = 20.0", "temperature_c = 293.15"), ("less than or equal to 60",)),
    ("humidity in percent", edit("temperature_c = 20.0", "humidity = 50"), ("humidity = 50", "equal to 1")),
    ("pressure in pascal", edit("temperature_c = 20.0", "pressure_kpa = 101325"), ("pressure_kpa",)),
    ("sound speed zero", edit("sound_speed_mps = 343.2", "sound_speed_mps = 0"), ("sound_speed_mps",)),
    ("carrier zero", edit("carrier_hz = 12000.0", "carrier_hz = 0"), ("carrier_hz = 0",)),
    ("modulation unknown", edit('modulation = "ask"', 'modulation = "fsk"'), ("'ask' or 'bpsk'",)),
    ("bandwidth negative", edit("cycles_per_chip = 6", "cycles_per_chip = 6\nbandwidth_hz = -1"), ("bandwidth_hz",)),
    ("chips without length", edit("cycles_per_chip = 6", ""), ("signal.cycles_per_chip", "length")),
    ("bounds upside down", edit("[-0.1, -0.1, 0.0]", "[-0.1, -0.1, 9.0]"), ("bounds_m", "z must be below")),
    ("bounds of one corner", edit(", [4.1, 3.1, 2.6]]", "]"), ("bounds_m", "two corners")),
    ("bounds flat list", edit("[[-0.1, -0.1, 0.0], [4.1, 3.1, 2.6]]", "[4.1, 3.1, 2.6]"), ("bounds_m",)),
    ("two coordinates", edit("[4.0, 0.0, 2.4]", "[4.0, 0.0]"), ('beacon 2 "B2" position_m', "three numbers")),
    ("four coordinates", edit("[4.0, 0.0, 2.4]", "[4.0, 0.0, 2.4, 1]"), ("three numbers",)),
    ("text coordinate", edit("[4.0, 0.0, 2.4]", '[4.0, "0", 2.4]'), ("position_m[1]", "must be a number")),
    ("NaN coordinate", edit("[4.0, 0.0, 2.4]", "[4.0, nan, 2.4]"), ("position_m[1]", "finite")),
    ("place as a number", edit("[4.0, 0.0, 2.4]", "4.0"), ("three numbers",)),
    ("empty id", edit('id = "B2"', 'id = ""'), ("beacon 2", "must not be empty")),
    ("id with a comma", edit('id = "B2"', 'id = "B,2"'), ("must not hold commas",)),
    ("latitude 100", add("[origin]\nlatitude_deg = 100.0\nlongitude_deg = 0.0"), ("origin.latitude_deg",)),
    ("origin without longitude", add("[origin]\nlatitude_deg = 10.0"), ("origin.longitude_deg", "is missing")),
    # what must fit together
    (
        "no beacon",
        lambda f: put("site.toml", (f / "site.toml").read_text().split("[[beacon]]")[0])(f),
        ("nothing sends",),
    ),
    (
        "no microphone",
        lambda f: (
            edit((f / "site.toml").read_text().split("[[microphone]]")[1].split("[[")[0], "")(f)
            or edit("[[microphone]]", "")(f)
        ),
        ("nothing listens",),
    ),
    ("duplicate beacon id", edit('id = "B2"', 'id = "B1"'), ("beacon 2", "beacon 1 has it already")),
    ("duplicate vehicle id", add('[[vehicle]]\nid = "agv"'), ("vehicle 2", "has it already")),
    ("duplicate microphone id", add('[[microphone]]\nid = "M1"\nvehicle = "agv"'), ("microphone 2", "has it already")),
    ("duplicate channel", add('[[microphone]]\nid = "M2"\nchannel = 0\nvehicle = "agv"'), ("share a channel",)),
    ("unknown vehicle", edit('vehicle = "agv"', 'vehicle = "avg"'), ("no [[vehicle]]", "known: agv")),
    ("fixed and mounted", edit('id = "B2"', 'id = "B2"\nvehicle = "agv"'), ("not both",)),
    ("neither fixed nor mounted", edit("position_m = [4.0, 0.0, 2.4]", ""), ("either fixed or mounted",)),
    ("lever arm of a fixed beacon", edit('id = "B2"', 'id = "B2"\nlever_arm_m = [0, 0, 1]'), ("lever arm",)),
    ("guess on a vehicle", add('[[beacon]]\nid = "V"\nvehicle = "agv"\nposition_sd_m = 0.3'), ("position_sd_m",)),
    ("offset beyond the period", edit('id = "B2"', 'id = "B2"\noffset_s = 0.2'), ("offset_s", "within their period")),
    ("no signal", edit("[signal]\ncarrier_hz = 12000.0", "[signal]"), ("carrier",)),
    ("no schedule", edit("[schedule]\nperiod_s = 0.1\nsynchronised = true\n", ""), ("schedule", "period_s")),
    ("no period", edit("period_s = 0.1", ""), ("schedule.period_s", "is missing")),
    # codes
    ("code as text", m('"gold"'), ("code", "table with family")),
    ("code of no kind", m("{ degree = 5 }"), ("families are m-sequence",)),
    ("family misspelt", m('{ family = "m-sequense", degree = 5, taps = [2] }'), ("did you mean m-sequence",)),
    ("m-sequence without taps", m('{ family = "m-sequence", degree = 5 }'), ("code.taps", "is missing")),
    ("degree too large", m('{ family = "m-sequence", degree = 40, taps = [2] }'), ("code.degree = 40",)),
    ("degree as decimal", m('{ family = "m-sequence", degree = 5.5, taps = [2] }'), ("code.degree", "whole number")),
    ("tap outside", m('{ family = "m-sequence", degree = 5, taps = [5] }'), ("code.taps", "from 1 to 4")),
    ("taps empty", m('{ family = "m-sequence", degree = 5, taps = [] }'), ("code.taps",)),
    ("taps not primitive", m('{ family = "m-sequence", degree = 5, taps = [1] }'), ("beacon 1", "taps")),
    ("duplicate code", edit("taps = [5]", "taps = [1]"), ("same code",)),
    (
        "same chips, described twice",
        m('{ chips = "111111010101100110111011010010011100010111100101000110000100000" }'),
        ("same", "own code"),
    ),
    ("Gold of degree 8", m('{ family = "gold", degree = 8, index = 0 }'), ("no preferred pair",)),
    ("Gold index", m('{ family = "gold", degree = 5, index = 33 }'), ("sequences 0 to 32",)),
    ("Kasami of odd degree", m('{ family = "kasami", degree = 5, index = 0 }'), ("even degree",)),
    ("Kasami index", m('{ family = "kasami", degree = 6, index = 8 }'), ("sequences 0 to 7",)),
    (
        "chirp that stands",
        m('{ family = "chirp", start_hz = 9e3, stop_hz = 9e3, duration_s = 0.01 }'),
        ("two different",),
    ),
    ("chirp too high", m('{ family = "chirp", start_hz = 9e3, stop_hz = 3e4, duration_s = 0.01 }'), ("sample rate",)),
    ("chips with a 2", m('{ chips = "0120" }'), ("must hold 0 and 1 only",)),
    ("chips all alike", m('{ chips = "1111" }'), ("alike",)),
    ("chips empty", m('{ chips = "" }'), ("code.chips",)),
    ("chips as a number", m("{ chips = 1011 }"), ("code.chips", "text")),
    # recorded references
    ("reference missing", reference(lambda path: None), ("code.reference", "burst.wav")),
    ("reference no sound file", reference(lambda path: path.write_text("x") and None), ("burst.wav", "cannot be read")),
    ("reference of one sample", reference(sound(BURST[:1])), ("burst.wav", "16 at least")),
    ("reference stereo", reference(sound(np.column_stack([BURST, BURST]))), ("burst.wav", "channels")),
    ("reference silent", reference(sound(0 * BURST)), ("burst.wav", "all zero")),
    ("reference NaN", reference(sound(BURST + np.nan, subtype="FLOAT")), ("burst.wav", "NaN")),
    ("reference too slow", reference(sound(BURST, rate=16000)), ("burst.wav", "sample rate")),
    ("reference too long", reference(sound(np.tile(BURST, 2000))), ("burst.wav", "one burst")),
    # the capture
    ("capture is a folder", directory("capture.wav"), ("capture.wav", "folder")),
    ("capture empty", put("capture.wav", b""), ("capture.wav", "0 bytes")),
    ("capture is text", put("capture.wav", "hello\n" * 100), ("capture.wav", "cannot be read")),
    ("capture cut in its header", bytes_of(lambda wav: wav[:30]), ("capture.wav", "cannot be read")),
    ("capture is a header", bytes_of(lambda wav: wav[:44]), ("capture.wav", "none follow")),
    ("capture of no samples", samples(lambda x: x[:0]), ("capture.wav", "no sample")),
    ("header states no samples", bytes_of(data_size(0)), ("states no samples", "follow")),
    ("header states no rate", bytes_of(lambda wav: wav[:24] + bytes(4) + wav[28:]), ("capture.wav",)),
    ("FLAC cut in its header", bytes_of(lambda flac: flac[:30], flac=True), ("capture.flac", "cannot be read")),
    ("FLAC without frames", bytes_of(lambda flac: flac[:100], flac=True), ("capture.flac",)),
    ("both captures", lambda f: shutil.copy(f / "capture.wav", f / "capture.flac") and None, ("keep one",)),
    ("channel that the capture lacks", edit("channel = 0", "channel = 3"), ("channel = 3", "channel 0 only")),
    ("channel negative", edit("channel = 0", "channel = -1"), ("channel = -1",)),
    ("channel not given", edit("channel = 0\n", ""), ("channel", "is missing")),
    ("rate too low", samples(lambda x: x[::2], rate=24000), ("sample rate = 24000", "too slow")),
    (
        "no beacon has a code",
        lambda f: put(
            "site.toml",
            "\n".join(line for line in (f / "site.toml").read_text().splitlines() if not line.startswith("code")),
        )(f),
        ("has a code",),
    ),
    # sync.csv
    ("sync empty", put("sync.csv", ""), ("sync.csv", "is empty")),
    ("sync of no rows", put("sync.csv", "time_s\n"), ("sync.csv", "has no rows")),
    ("sync backwards", put("sync.csv", "time_s\n0.1\n0.0\n"), ("line 3", "backwards")),
    ("sync twice", put("sync.csv", "time_s\n0.1\n0.1\n"), ("line 3", "same time")),
    ("sync text", put("sync.csv", "time_s\nnow\n"), ("line 2, time_s", "must be a number")),
    ("sync NaN", put("sync.csv", "time_s\nnan\n"), ("must be finite",)),
    ("sync blank cell", put("sync.csv", 'time_s\n""\n'), ("empty",)),
    ("sync is a folder", directory("sync.csv"), ("sync.csv", "folder")),
    ("sync not UTF-8", put("sync.csv", b"time_s\n\xff\n"), ("sync.csv", "UTF-8")),
    # ranges.csv
    ("ranges without a column", ranges("time_s,from,range_m\n0,B1,1\n"), ("column to is missing",)),
    ("ranges with a stray column", ranges(ROWS.replace("range_m", "range_m,rang_sd")), ("unknown column",)),
    ("ranges with one column twice", ranges("time_s,time_s,from,to,range_m\n0,0,B1,M1,1\n"), ("twice",)),
    ("ranges and times of flight", ranges("time_s,from,to,range_m,time_of_flight_s\n0,B1,M1,1,1\n"), ("exactly one",)),
    ("neither range nor time of flight", ranges("time_s,from,to\n0,B1,M1\n"), ("exactly one",)),
    ("ranges with semicolons", ranges(ROWS.replace(",", ";")), ("separated by commas",)),
    ("ranges with decimal commas", ranges(ROWS.replace("3.0", "3,0")), ("5 cells",)),
    ("range as text", ranges(ROWS.replace("2.6", "far")), ("line 3, range_m", '"far"', "number")),
    ("range with a unit", ranges(ROWS.replace("2.6", "2.6 m")), ("line 3, range_m",)),
    ("range with an underscore", ranges(ROWS.replace("2.6", "2_6")), ("line 3, range_m",)),
    ("range infinite", ranges(ROWS.replace("2.6", "inf")), ("finite",)),
    ("range negative", ranges(ROWS.replace("2.6", "-2.6")), ("range_m = -2.6", "below 0")),
    ("range left empty", ranges(ROWS.replace("2.6", "")), ("line 3, range_m", "empty")),
    ("sd zero", ranges("time_s,from,to,range_m,sd_m\n0,B1,M1,1,0\n"), ("sd_m", "from 1e-09")),
    ("range from nobody", ranges(ROWS.replace("B2", "B9")), ("no [[beacon]]",)),
    ("range to nobody", ranges(ROWS.replace("M1", "M9")), ("no [[microphone]]", "known are M1")),
    ("range backwards in time", ranges(ROWS + "-1.0,B1,M1,3.0\n"), ("line 5, time_s", "backwards")),
    ("ranges cut off", ranges(ROWS + "0.5,B1"), ("line 5", "2 cells")),
    ("ranges with an open quote", ranges(ROWS + '0.5,"B1,M1,3.0\n'), ("not CSV",)),
    ("ranges is binary", ranges(bytes(range(128, 256)).decode("latin-1")), ("ranges.csv",)),
    (
        "a robot hears itself",
        both(add('[[beacon]]\nid = "own"\nvehicle = "agv"'), ranges(ROWS.replace("B2", "own"))),
        ("does not hear itself",),
    ),
    # sensor files and truth
    ("odometry text", put("odometry.csv", ODOMETRY + "0,fast,0\n"), ("odometry.csv", "line 2, v_mps")),
    ("odometry backwards", put("odometry.csv", ODOMETRY + "1,0,0\n0.5,0,0\n"), ("odometry.csv", "backwards")),
    ("odometry of no vehicle", several_vehicles(put("odometry.csv", ODOMETRY + "0,1,0\n")), ("several vehicles",)),
    (
        "odometry of another vehicle",
        put("odometry.csv", "time_s,vehicle,v_mps,yaw_rate_radps\n0,avg,1,0\n"),
        ("did you",),
    ),
    ("steps negative", put("steps.csv", "time_s,length_m,heading_rad\n0,-1,0\n"), ("steps.csv", "from 0 to 100 m")),
    ("compass in degrees", put("compass.csv", "time_s,heading_rad\n0,271.5\n"), ("line 2, heading_rad", "not degrees")),
    (
        "compass in degrees, up to 90",
        put("compass.csv", "time_s,heading_rad\n0,3\n0.5,6\n1,45\n1.5,90\n"),
        ("line 4, heading_rad", "45", "line 5", "not degrees"),
    ),
    (
        "bearings in degrees",
        put("bearings.csv", "time_s,from,to,bearing_rad\n0,B1,M1,-40\n"),
        ("bearings.csv", "line 2, bearing_rad", "-40", "not degrees"),
    ),
    ("start in degrees, up to 90", put("start.csv", "x_m,y_m,yaw_rad\n0,0,90\n"), ("yaw_rad", "90", "not degrees")),
    ("steps in degrees", put("steps.csv", "time_s,length_m,heading_rad\n0,0.6,180\n"), ("heading_rad", "not degrees")),
    ("start in degrees", put("start.csv", "x_m,y_m,yaw_rad\n0,0,180\n"), ("yaw_rad", "not degrees")),
    ("start beyond the earth", put("start.csv", "x_m,y_m,yaw_rad\n1e30,0,0\n"), ("start.csv", "line 2, x_m", "1e+08")),
    ("odometry of a bullet", put("odometry.csv", ODOMETRY + "0,1e30,0\n"), ("line 2, v_mps", "1000 m/s")),
    ("odometry turns in degrees", put("odometry.csv", ODOMETRY + "0,1,180\n"), ("yaw_rate_radps", "100 rad/s")),
    ("odometry in nanoseconds", put("odometry.csv", ODOMETRY + "1.7e18,1,0\n"), ("line 2, time_s", "1e+10 s")),
    ("compass without heading", put("compass.csv", "time_s\n0\n"), ("column heading_rad is missing",)),
    ("imu short", put("imu.csv", "time_s,gx_radps\n0,0\n"), ("column gy_radps is missing",)),
    ("thermometer in kelvin", put("temperature.csv", "time_s,temperature_c\n0,293\n"), ("from -40 to 60",)),
    ("two starts", put("start.csv", "x_m,y_m,yaw_rad\n0,0,0\n1,1,0\n"), ("start.csv", "two start poses")),
    ("start without yaw", put("start.csv", "x_m,y_m\n0,0\n"), ("column yaw_rad is missing",)),
    ("bearing from nobody", put("bearings.csv", "time_s,from,to,bearing_rad\n0,X,M1,0\n"), ("bearings.csv",)),
    ("exchange cut", put("exchanges.csv", "from,to,sent_s\nB1,M1,0\n"), ("column heard_s is missing",)),
    ("truth text", put("truth.csv", "time_s,x_m,y_m,z_m\n0,a,0,0\n"), ("truth.csv", "line 2, x_m")),
    ("truth backwards", put("truth.csv", "time_s,x_m,y_m,z_m\n1,0,0,0\n0,0,0,0\n"), ("truth.csv", "backwards")),
]

# ---- what runs, and must be flagged: name, how it is broken, what `check` says of it ---------------------------------
FLAGGED: list[tuple[str, Callable[[Path], None], str]] = [
    ("NaN samples", samples(mutate(slice(2000, 2100), np.nan), "FLOAT"), "100 samples NaN or infinite"),
    ("one NaN", samples(mutate(6000, np.nan), "FLOAT"), "1 samples NaN or infinite"),
    ("infinite samples", samples(mutate(slice(6000, 6010), np.inf), "FLOAT"), "10 samples NaN or infinite"),
    ("all NaN", samples(lambda x: x * np.nan, "FLOAT"), "silent throughout"),
    ("clipped", samples(lambda x: np.clip(40 * x, -1, 1)), "samples are clipped"),
    ("clipped below full scale", samples(lambda x: np.clip(x, -0.02, 0.02)), "samples are clipped"),
    ("silent", samples(lambda x: 0 * x), "silent throughout"),
    ("one sample", samples(lambda x: x[:1]), "less than one period"),
    ("ten samples", samples(lambda x: x[:10]), "less than one period"),
    ("shorter than a burst", samples(lambda x: x[:500]), "less than one period"),
    ("FLAC of one sample", samples(lambda x: x[:1], name="capture.flac"), "less than one period"),
    ("WAV cut in half", bytes_of(lambda wav: wav[: len(wav) // 2]), "cut off or damaged"),
    ("WAV cut in a sample", bytes_of(lambda wav: wav[: len(wav) // 2 + 1]), "cut off or damaged"),
    ("FLAC cut in half", bytes_of(lambda flac: flac[: len(flac) // 2], flac=True), "cut off or damaged"),
    (
        "FLAC damaged",
        bytes_of(lambda flac: flac[:9000] + b"\x55" * 3000 + flac[12000:], flac=True),
        "cut off or damaged",
    ),
    ("WAV header states too much", bytes_of(data_size(10**6)), "cut off or damaged"),
    ("WAV header states too little", bytes_of(data_size(4000)), "less than one period"),
    ("FLAC header states too much", bytes_of(flac_total(10**6), flac=True), "cut off or damaged"),
    ("FLAC header states too little", bytes_of(flac_total(1000), flac=True), "less than one period"),
    ("wrong rate in the header", samples(lambda x: x, rate=44100), "Capture: 0.218 s"),
    (
        "odometry on another clock",
        put("odometry.csv", ODOMETRY + "1.7e9,1,0\n1700000001,1,0\n"),
        "tells nothing of the time of what is heard",
    ),
    ("beacons in one point", in_one_place, "stand in one point"),
    ("beacons on one line", on_one_line, "stand on one line"),
    ("beacon far outside", edit("[4.0, 0.0, 2.4]", "[14.0, 0.0, 2.4]"), "outside the site's bounds_m"),
    ("beacon at the ear", edit("[4.0, 0.0, 2.4]", "[2.5, 1.0, 0.5]"), "Nothing odd"),
    (
        "one beacon",
        lambda f: put("site.toml", "[[beacon]]".join((f / "site.toml").read_text().split("[[beacon]]")[:2]))(f),
        "1 fixed beacon cannot give",
    ),
    ("bursts longer than the period", edit("period_s = 0.1", "period_s = 0.01"), "longer than the period"),
    ("sync beyond the capture", put("sync.csv", "time_s\n0.0\n0.1\n0.2\n99.0\n"), "sync instants lie outside"),
    ("sync all beyond the capture", put("sync.csv", "time_s\n98.0\n99.0\n"), "2 of 2 sync instants lie outside"),
    ("stated sound speed of water", edit("sound_speed_mps = 343.2", "sound_speed_mps = 1480"), "is not that of"),
    (
        "chips unlike their family",
        m('{ family = "m-sequence", degree = 5, taps = [2], chips = "1110010" }'),
        "are not the",
    ),
    ("no truth", lambda f: (f / "truth.csv").unlink(), "no truth.csv"),
    ("misspelt file", put("odometery.csv", "time_s\n"), "did you mean odometry.csv"),
    ("spare channel", samples(lambda x: np.column_stack([x, x])), "names channel 1"),
    ("ranges of a lie", ranges(ROWS.replace("2.6", "26000.0")), "26000.00 m"),
    ("ranges at one instant from one beacon", ranges("time_s,from,to,range_m\n0,B1,M1,3\n"), "1 row of 1 pair"),
]


# ---- what `run` says of those: exit code, and words in the events, the fixes or the answer ------------------------
CUT = ("WAV cut in half", "FLAC cut in half", "FLAC damaged", "WAV header states too much")
RUNS: dict[str, tuple[int, tuple[str, ...]]] = {
    "NaN samples": (0, ("100 of", "not finite", ",ok,")),
    "one NaN": (0, ("1 of", "not finite", ",ok,")),
    "infinite samples": (0, ("10 of", "not finite", ",ok,")),
    "all NaN": (0, ("not finite", ",too-few,")),
    "clipped": (0, ("samples are clipped",)),
    "silent": (0, ("no sound at all", ",too-few,")),
    "one sample": (2, ("no whole epoch",)),
    "ten samples": (2, ("no whole epoch",)),
    "shorter than a burst": (2, ("no whole epoch",)),
    "FLAC of one sample": (2, ("no whole epoch",)),
    "FLAC header states too little": (2, ("no whole epoch",)),
    "sync all beyond the capture": (2, ("no whole epoch",)),
    "wrong rate in the header": (0, (",too-few,",)),
    "beacons in one point": (0, (",ambiguous,",)),
    "beacons on one line": (0, (",ambiguous,",)),
    "beacon far outside": (0, ("excluded,B2 to M1", ",ok,")),
    "beacon at the ear": (0, ("excluded",)),
    "one beacon": (0, (",too-few,",)),
    "ranges of a lie": (0, (",no-convergence,",)),
    "ranges at one instant from one beacon": (0, (",too-few,",)),
    "WAV header states too little": (0, (",ok,",)),
    **{name: (0, (",ok,",)) for name in CUT},
}


def names(cases: list) -> list[str]:
    found = [case[0] for case in cases]
    assert len(set(found)) == len(found)
    return found


def invoke(*words: str) -> Result:
    result = CliRunner().invoke(app, list(words))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exc_info
    assert "Traceback" not in result.output
    return result


def assert_refused(result: Result, words: tuple[str, ...]) -> None:
    assert result.exit_code == 2, result.output
    lines = result.stderr.splitlines()
    assert lines
    assert all(0 < len(line) < 400 and line.isprintable() for line in lines)
    for word in words:
        assert word in result.stderr


def test_there_are_a_hundred_of_them():
    assert len(REFUSED) + len(FLAGGED) >= 100


def test_the_unbroken_recording_is_right(lab):
    result = invoke("check", str(lab))
    assert result.exit_code == 0
    assert "Nothing odd" in result.output


@pytest.mark.parametrize(("_name", "break_it", "words"), REFUSED, ids=names(REFUSED))
def test_is_refused(lab, _name, break_it, words):
    break_it(lab)
    assert_refused(invoke("check", str(lab)), words)
    assert_refused(invoke("run", str(lab), "--no-plot"), words)
    assert not (lab / "out").exists()


@pytest.mark.parametrize(("_name", "break_it", "odd"), FLAGGED, ids=names(FLAGGED))
def test_check_flags(lab, _name, break_it, odd):
    break_it(lab)
    result = invoke("check", str(lab))
    assert result.exit_code == 0, result.output
    assert odd in result.output


@pytest.mark.parametrize("name", RUNS)
def test_run_flags(lab, name):
    break_it = next(case[1] for case in FLAGGED if case[0] == name)
    code, words = RUNS[name]
    break_it(lab)
    result = invoke("run", str(lab), "--no-plot")
    assert result.exit_code == code, result.output
    if code:
        assert_refused(result, words)
        return
    written = "".join((lab / "out" / file).read_text() for file in ("events.csv", "fixes.csv"))
    for word in words:
        assert word in written


@pytest.mark.parametrize("name", CUT)
def test_run_tells_that_a_capture_is_cut_off(lab, name):
    next(case[1] for case in FLAGGED if case[0] == name)(lab)
    assert invoke("run", str(lab), "--no-plot").exit_code == 0
    assert "header states" in (lab / "out" / "events.csv").read_text()


def test_all_mistakes_of_all_files_are_told_at_once(lab):
    edit('id = "B2"', 'id = "B1"\ncolour = "red"')(lab)
    put("capture.wav", b"")(lab)
    put("odometry.csv", ODOMETRY + "0,x,0\n")(lab)
    put("sync.csv", "time_s\n1\n0\n")(lab)
    put("truth.csv", "time_s\n0\n")(lab)
    lines = invoke("check", str(lab)).stderr.splitlines()
    files = {line.split(":")[0] for line in lines}
    assert {"site.toml", "capture.wav", "odometry.csv", "sync.csv"} <= files
    assert sum(line.startswith("site.toml") for line in lines) == 2


def test_many_mistakes_in_one_file_are_counted_not_listed(lab):
    put("odometry.csv", ODOMETRY + "0,x,0\n" * 1000)(lab)
    lines = invoke("check", str(lab)).stderr.splitlines()
    assert len(lines) == 6
    assert "995 more" in lines[-1]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: None, ("no such folder",)),
        (lambda path: path.write_text("x"), ("is a file", "folder")),
        (lambda path: path.mkdir(), ("site.toml", "no such file")),
    ],
)
def test_a_recording_that_is_none(tmp_path, make, words):
    make(tmp_path / "none")
    assert_refused(invoke("check", str(tmp_path / "none")), words)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_that_may_not_be_read(lab):
    (lab / "site.toml").chmod(0)
    assert_refused(invoke("check", str(lab)), ("cannot be read",))


def test_the_command_itself(lab):
    """Once through a real process: the exit code, the stream, and no traceback."""
    edit("channel = 0", "channel = 7")(lab)
    command = [sys.executable, "-c", "from sonofix.cli.main import main; main()", "check", str(lab)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines() == ['site.toml: microphone 1 "M1" channel = 7: capture.wav has channel 0 only']
    assert done.stdout == ""
