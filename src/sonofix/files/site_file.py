"""`site.toml`: text to `Site` and back; what pydantic finds is put in plain words."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from sonofix import site as models
from sonofix.files.problem import Problem, RecordingError, did_you_mean
from sonofix.site import Beacon, Site

FILE_NAME = "site.toml"

SECTIONS: dict[str, type[BaseModel]] = {
    "site": models.SiteSection,
    "origin": models.Origin,
    "air": models.AirSection,
    "schedule": models.Schedule,
    "signal": models.Signal,
    "vehicle": models.Vehicle,
    "beacon": models.Beacon,
    "microphone": models.Microphone,
    "pair": models.Pair,
}
LISTS = ("vehicle", "beacon", "microphone", "pair")
CODES: dict[str, type[BaseModel]] = {
    "m-sequence": models.MSequenceCode,
    "gold": models.GoldCode,
    "kasami": models.KasamiCode,
    "chirp": models.ChirpCode,
    "chips": models.ChipsCode,
    "reference": models.ReferenceCode,
}
FAMILIES = ("m-sequence", "gold", "kasami", "chirp")

_REMEDIES = {
    "missing": "is missing; add it",
    "string_type": "must be text in quotation marks",
    "int_type": "must be a whole number",
    "float_type": "must be a number, without quotation marks",
    "bool_type": "must be true or false",
    "finite_number": "must be finite",
    "string_too_short": "must not be empty",
    "tuple_type": "must be a list in square brackets",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
}
_VECTORS = {"position_m", "lever_arm_m"}


def read_text(path: Path, name: str) -> str:
    """Return a text file's content.

    Raises
    ------
    RecordingError
        Where it is missing, a folder, unreadable or not UTF-8.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise RecordingError([Problem(name, "", None, f"there is no such file in {path.parent}")]) from None
    except OSError as error:
        reason = "it is a folder" if path.is_dir() else error.strerror or str(error)
        raise RecordingError([Problem(name, "", None, f"cannot be read: {reason}")]) from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        value = data[error.start : error.end].hex(" ")
        problem = Problem(name, f"line {line}", f"byte {value}", "the file is not UTF-8 text; save it as UTF-8")
        raise RecordingError([problem]) from None


def read_site(path: str | Path) -> Site:
    """Read a site file, or the one inside a recording folder.

    Raises
    ------
    RecordingError
        With every mistake in the file.
    """
    path = Path(path)
    if path.is_dir() and path.name != FILE_NAME:
        path = path / FILE_NAME
    return parse_site(read_text(path, path.name), path.name)


def parse_site(text: str, name: str = FILE_NAME) -> Site:
    """Make a `Site` of a site file's text; `name` is what its mistakes are reported under.

    Raises
    ------
    RecordingError
        With every mistake in the text.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        place = re.search(r"line (\d+)", str(error))
        line = int(place[1]) if place else text.count("\n") + 1
        content = (text.splitlines() or [""])[min(line, text.count("\n") + 1) - 1 : line]
        reason = re.sub(r" \(at .*\)$", "", str(error))
        remedy = f"not TOML: {reason}; write one `key = value` a line, text in quotation marks"
        raise RecordingError([Problem(name, f"line {line}", (content or [""])[0].strip(), remedy)]) from None
    except RecursionError:
        raise RecordingError([Problem(name, "", None, "not TOML: nested too deeply")]) from None
    # The model takes Python's plural names too; a file has the singular ones only.
    strays = set(raw) - set(SECTIONS) - {"format"}
    problems = [Problem(name, key, _brief(raw[key]), _unknown(key, ())) for key in sorted(strays)]
    if "format" not in raw:
        problems.append(Problem(name, "format", None, "is missing; add `format = 1` as the first line"))
    site = None
    try:
        site = Site.model_validate({key: value for key, value in raw.items() if key not in strays})
    except ValidationError as error:
        problems += _plain(name, raw, error)
    if site is not None and not problems:
        problems += code_problems(site, name)
    if problems or site is None:
        raise RecordingError(problems)
    return site


def code_problems(site: Site, name: str = FILE_NAME) -> list[Problem]:
    """Judge what only the chips themselves tell: registers that do not run full length, and equal codes."""
    from sonofix.signals.waveform import chips_of

    problems: list[Problem] = []
    first: dict[tuple[bytes, float], list[Beacon]] = {}
    for i, beacon in enumerate(site.beacons):
        field = f'beacon {i + 1} "{beacon.id}" code'
        try:
            chips = chips_of(beacon)
        except ValueError as error:
            code = beacon.code.model_dump(exclude_none=True) if beacon.code else None
            problems.append(Problem(name, field, code, str(error)))
            continue
        if chips is None:
            continue
        key = (chips.tobytes(), site.signal_of(beacon).carrier_hz)
        before = first.setdefault(key, [])
        same = next((b for b in before if beacon.zone is None or b.zone in (None, beacon.zone)), None)
        if same is not None:
            remedy = f"makes the same chips as beacon {same.id}; every beacon of a zone needs its own code"
            problems.append(Problem(name, field, None, remedy))
        before.append(beacon)
    return problems


def _plain(name: str, raw: Mapping[str, Any], error: ValidationError) -> Iterator[Problem]:
    """Yield a Problem for each of pydantic's errors."""
    told: set[tuple[str, str]] = set()
    for detail in error.errors():
        loc = detail["loc"]
        if loc[2:3] == ("code",):  # pydantic puts the kind of code between
            loc = loc[:3] + loc[4:]
        if detail["type"] == "missing" and isinstance(loc[-1], int):  # a list of two where three belong
            loc = loc[:-1]
        field = _field(raw, loc)
        remedy = _remedy(detail, loc)
        if (field, remedy) not in told:
            told.add((field, remedy))
            yield Problem(name, field, _brief(_value(raw, loc)), remedy)


def _remedy(detail: Any, loc: tuple[str | int, ...]) -> str:
    kind, key = detail["type"], str(loc[-1])
    context = detail.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown(key, detail["loc"][:-1])
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        family = context.get("tag")
        near = did_you_mean(family, FAMILIES) if isinstance(family, str) else f"families are {', '.join(FAMILIES)}"
        return f"a code is a table with family, chips or reference; {near}"
    if key in _VECTORS and kind in ("missing", "too_long", "too_short", "tuple_type"):
        return "must be three numbers, [x, y, z] in m"
    if "bounds_m" in loc and kind in ("missing", "too_long", "too_short", "tuple_type"):
        return "must be two corners, [[x, y, z], [x, y, z]] in m"
    if kind == "literal_error":
        expected = context.get("expected", "")
        return f"must be {expected}"
    if kind == "string_pattern_mismatch":
        return "must hold 0 and 1 only" if key == "chips" else "must not hold commas, quotes or outer spaces"
    if kind in ("tuple_type", "model_type", "model_attributes_type") and key in SECTIONS:
        return f"write it as [[{key}]], in two brackets" if key in LISTS else f"write it as a section [{key}]"
    if kind in _REMEDIES:
        return _REMEDIES[kind]
    return str(detail["msg"]).replace("Input should", "must").replace("String should", "must")


def _unknown(key: str, where: tuple[str | int, ...]) -> str:
    """Say what an unknown key might have meant, or where it belongs."""
    if not where:
        known = ("format", *SECTIONS)
    else:
        model = CODES[str(where[3])] if where[2:3] == ("code",) else SECTIONS[str(where[0])]
        known = _keys(model)
    homes = [name for name, model in SECTIONS.items() if key in _keys(model)]
    near = did_you_mean(key, known)
    if homes and not near.startswith("did"):
        brackets = " or ".join(f"[[{home}]]" if home in LISTS else f"[{home}]" for home in homes)
        return f"unknown key here; it belongs in {brackets}"
    return f"unknown key; {near}"


def _keys(model: type[BaseModel]) -> tuple[str, ...]:
    """Return the keys of a table as the file has them."""
    return tuple(info.alias or name for name, info in model.model_fields.items())


def _field(raw: Mapping[str, Any], loc: tuple[str | int, ...]) -> str:
    """Return where, as a user would say it: `beacon 2 "B2" code.taps`."""
    if loc and loc[0] in LISTS and len(loc) > 1 and isinstance(loc[1], int):
        node = _value(raw, loc[:2])
        node_id = node.get("id") if isinstance(node, Mapping) else None
        head = f"{loc[0]} {loc[1] + 1}" + (f' "{node_id}"' if isinstance(node_id, str) and len(node_id) < 30 else "")
        rest = loc[2:]
    else:
        head, rest = "", loc
    tail = ""
    for part in rest:
        tail += f"[{part}]" if isinstance(part, int) else f".{part}"
    return " ".join(word for word in (head, tail.lstrip(".")) if word)


def _value(raw: Any, loc: tuple[str | int, ...]) -> Any:
    for part in loc:
        try:
            raw = raw[part]
        except (KeyError, IndexError, TypeError):
            return None
    return raw


def _brief(value: Any) -> Any:
    """Return a value to show; whole tables are not repeated."""
    table = isinstance(value, Mapping) or (isinstance(value, list) and any(isinstance(item, Mapping) for item in value))
    return None if table else value


def site_text(site: Site) -> str:
    """Return the site file of a `Site`: reading it back gives an equal Site."""
    lines = [f"format = {site.format}"]
    for key in SECTIONS:
        field = next(name for name, info in Site.model_fields.items() if (info.alias or name) == key)
        part = getattr(site, field)
        if part is None:
            continue
        for table in part if isinstance(part, tuple) else (part,):
            lines += ["", table_text(key, table).rstrip("\n")]
    return "\n".join(lines) + "\n"


def table_text(key: str, table: BaseModel) -> str:
    """Return one table of a site file, ``[key]`` or ``[[key]]`` and its lines."""
    lines = [f"[[{key}]]" if key in LISTS else f"[{key}]"]
    values = table.model_dump(by_alias=True, exclude_none=True, exclude_defaults=key in LISTS)
    if isinstance(table, Beacon) and table.code is not None:
        values["code"] = table.code.model_dump(exclude_none=True)
    if isinstance(table, models.Pair) and not {"bias_m", "bias_sd_m"} & set(values):
        values["bias_m"] = table.bias_m
    lines += [f"{name} = {_toml(value)}" for name, value in values.items()]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    """Return a value as TOML."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case list() | tuple():
            return "[" + ", ".join(map(_toml, value)) + "]"
        case dict():
            return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
        case int():
            return str(value)
        case float():
            return repr(float(value))
    raise TypeError(f"no TOML for {type(value).__name__} {value!r}")
