"""The site file: what stands where, what it sends, what moves.

Models of `site.toml` (format 1). SI units; east-north-up frame; angles in radians counter-clockwise from east; a lever
arm is in the vehicle's body frame (forward, left, up). Values that need no other file to be judged are judged here, all
at once: a `pydantic.ValidationError` holds every mistake, with a remedy in its message where the rule is ours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import combinations
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    ValidatorFunctionWrapHandler,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from sonofix import air

# TOML tells numbers from text and from truth values, so nothing is converted except whole numbers to decimal ones.
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Whole = Annotated[int, Field(strict=True, ge=0)]
Id = Annotated[str, Field(strict=True, min_length=1, pattern=r"^[^,\"\s]([^,\"\r\n]*[^,\"\s])?$")]
Vector = tuple[Number, Number, Number]
Modulation = Literal["ask", "bpsk"]

Mistake = tuple[tuple[str | int, ...], object, str]
"""Where (keys and indices), the value that came, and one sentence that says what would be right."""


def _detail(
    kind: Any, loc: tuple[str | int, ...], value: object, text: str, context: dict[str, Any]
) -> InitErrorDetails:
    """Return one mistake as pydantic takes it back."""
    return InitErrorDetails(type=PydanticCustomError(kind, "{text}", {**context, "text": text}), loc=loc, input=value)


class _Section(BaseModel):
    """A table of the site file: frozen, no unknown keys; field errors and broken rules are reported together."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        """Yield mistakes that several values make together; `get` reads a raw value, None where it is missing."""
        del get
        yield from ()

    @model_validator(mode="wrap")
    @classmethod
    def _judge(cls, data: Any, handler: ValidatorFunctionWrapHandler) -> Self:
        details: list[InitErrorDetails] = []
        section: Self | None = None
        try:
            section = handler(data)
        except ValidationError as error:
            details = [_detail(e["type"], e["loc"], e["input"], e["msg"], e.get("ctx", {})) for e in error.errors()]
        if isinstance(data, Mapping):
            details += [_detail("rule", loc, value, text, {}) for loc, value, text in cls._broken_rules(data.get)]
        if details or section is None:
            raise ValidationError.from_exception_data(cls.__name__, details)
        return section


class SiteSection(_Section):
    """`[site]`: the name, and the room's box for echoes and mirror solutions: lower and upper corner in m."""

    name: Annotated[str, Field(strict=True)] = "site"
    bounds_m: tuple[Vector, Vector] | None = None

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        bounds = get("bounds_m")
        if isinstance(bounds, list | tuple) and len(bounds) == 2 and all(_is_vector(corner) for corner in bounds):
            for axis, lower, upper in zip("xyz", bounds[0], bounds[1], strict=True):
                if not lower < upper:
                    remedy = f"the first corner's {axis} must be below the second's; write [[lower], [upper]]"
                    yield ("bounds_m",), bounds, remedy


class Origin(_Section):
    """`[origin]`: the frame's origin on Earth; `heading_rad` turns its x axis from east, counter-clockwise."""

    latitude_deg: Annotated[float, Field(strict=True, ge=-90, le=90, allow_inf_nan=False)]
    longitude_deg: Annotated[float, Field(strict=True, ge=-180, le=180, allow_inf_nan=False)]
    height_m: Number = 0.0
    heading_rad: Number = 0.0


class AirSection(_Section):
    """`[air]`: humidity from 0 to 1; `sound_speed_mps`, where given, overrides the computed value."""

    temperature_c: Annotated[float, Field(strict=True, ge=-40, le=60, allow_inf_nan=False)] = 20.0
    humidity: Annotated[float, Field(strict=True, ge=0, le=1, allow_inf_nan=False)] = 0.5
    pressure_kpa: Annotated[float, Field(strict=True, ge=50, le=120, allow_inf_nan=False)] = 101.325
    sound_speed_mps: Annotated[float, Field(strict=True, ge=100, le=2000, allow_inf_nan=False)] | None = None


class Schedule(_Section):
    """`[schedule]`: epochs every `period_s` where no sync file says otherwise.

    With `synchronised`, bursts start at sync + offset_s; without, the recorder's clock has one unknown offset. With
    `own_clocks`, each vehicle sounds and records on a clock of its own, and robots range each other two-way.
    """

    period_s: Positive | None = None
    synchronised: Annotated[bool, Field(strict=True)] = True
    own_clocks: Annotated[bool, Field(strict=True)] = False

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        if get("own_clocks") is True and get("synchronised") is not False:
            remedy = "clocks of their own are not in sync: add synchronised = false, or leave own_clocks out"
            yield ("own_clocks",), True, remedy


class Signal(_Section):
    """`[signal]`: the carrier, how chips are keyed, and the -3 dB width of one transducer (a burst passes two)."""

    carrier_hz: Positive
    modulation: Modulation = "ask"
    cycles_per_chip: Positive | None = None
    bandwidth_hz: Positive | None = None


class Vehicle(_Section):
    """`[[vehicle]]`: its origin moves on the level `z_m` where that is known.

    `tilt_sd_rad` is how far it tilts, one sigma of roll and of pitch; 0: it always stands upright. Where it is not
    stated, `geometry.tilting` says what holds. `motion` is what a track expects of it between two measurements: that it
    goes straight on, or that it drives in arcs (`track.arc`).
    """

    id: Id
    z_m: Number | None = None
    max_speed_mps: Positive | None = None
    tilt_sd_rad: NotNegative | None = None
    motion: Literal["constant-velocity", "constant-turn"] = "constant-velocity"


class MSequenceCode(_Section):
    """The register of `scipy.signal.max_len_seq` with these taps, all-ones start."""

    family: Literal["m-sequence"] = "m-sequence"
    degree: Annotated[int, Field(strict=True, ge=2, le=16)]
    taps: Annotated[tuple[Annotated[int, Field(strict=True)], ...], Field(min_length=1)]

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        degree, taps = get("degree"), get("taps")
        if isinstance(degree, int) and isinstance(taps, list | tuple):
            if any(isinstance(tap, int) and not 0 < tap < degree for tap in taps):
                yield ("taps",), taps, f"taps of degree {degree} lie from 1 to {degree - 1}"
            if len(set(map(repr, taps))) < len(taps):
                yield ("taps",), taps, "name each tap once"


class GoldCode(_Section):
    """Gold sequence `index`: 0 and 1 the preferred pair, k >= 2 their product, the second delayed by k - 2 chips."""

    family: Literal["gold"] = "gold"
    degree: Annotated[int, Field(strict=True, ge=3, le=16)]
    index: Whole

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        degree, index = get("degree"), get("index")
        if isinstance(degree, int) and 3 <= degree <= 16:
            if degree % 4 == 0:
                remedy = "no preferred pair exists for multiples of 4; take 5, 6, 7, 9, 10 or 11"
                yield ("degree",), degree, remedy
            elif isinstance(index, int) and index > 2**degree:
                yield ("index",), index, f"degree {degree} has sequences 0 to {2**degree}"


class KasamiCode(_Section):
    """Sequence `index` of the small Kasami set, 0 the m-sequence."""

    family: Literal["kasami"] = "kasami"
    degree: Annotated[int, Field(strict=True, ge=4, le=16)]
    index: Whole

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        degree, index = get("degree"), get("index")
        if isinstance(degree, int) and 4 <= degree <= 16:
            if degree % 2:
                yield ("degree",), degree, "the small Kasami set needs an even degree, 4, 6, 8 or 10"
            elif isinstance(index, int) and index >= 2 ** (degree // 2):
                yield ("index",), index, f"degree {degree} has sequences 0 to {2 ** (degree // 2) - 1}"


class ChirpCode(_Section):
    """A linear sweep from `start_hz` to `stop_hz`, up or down."""

    family: Literal["chirp"] = "chirp"
    start_hz: Positive
    stop_hz: Positive
    duration_s: Positive

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        if get("start_hz") is not None and get("start_hz") == get("stop_hz"):
            yield ("stop_hz",), get("stop_hz"), "a sweep needs two different frequencies"


class ChipsCode(_Section):
    """Given chips, first chip first; they decide, and whatever stands beside them is kept but not used."""

    chips: Annotated[str, Field(strict=True, pattern="^[01]*$", min_length=2)]
    family: str | None = None
    degree: int | None = None
    taps: tuple[int, ...] | None = None
    index: int | None = None
    start_hz: float | None = None
    stop_hz: float | None = None
    duration_s: float | None = None
    reference: str | None = None
    distance_m: float | None = None
    start_s: float | None = None

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        chips = get("chips")
        if isinstance(chips, str) and len(chips) > 1 and len(set(chips)) == 1 and chips[0] in "01":
            yield ("chips",), chips, "chips that are all alike cannot be found in a recording; use both 0 and 1"


class ReferenceCode(_Section):
    """A recorded burst as its own replica, heard at `distance_m`; `start_s` is the burst's start in that file."""

    reference: Annotated[str, Field(strict=True, min_length=1)]
    distance_m: Positive | None = None
    start_s: NotNegative | None = None


def _code_kind(code: object) -> str | None:
    """Tell the kind of a code by its keys: chips decide over a reference, a reference over a family."""
    if isinstance(code, ChipsCode | ReferenceCode):
        return "chips" if isinstance(code, ChipsCode) else "reference"
    if isinstance(code, Mapping):
        family = next((key for key in ("chips", "reference") if key in code), code.get("family"))
        return family if isinstance(family, str) else None
    return getattr(code, "family", None)


Code = Annotated[
    Annotated[MSequenceCode, Tag("m-sequence")]
    | Annotated[GoldCode, Tag("gold")]
    | Annotated[KasamiCode, Tag("kasami")]
    | Annotated[ChirpCode, Tag("chirp")]
    | Annotated[ChipsCode, Tag("chips")]
    | Annotated[ReferenceCode, Tag("reference")],
    Discriminator(_code_kind),
]


def _mounting(get: Callable[[str], Any], kind: str) -> Iterator[Mistake]:
    """Judge whether a node is fixed or mounted, and not both."""
    fixed, mounted = get("position_m") is not None, get("vehicle") is not None
    if fixed == mounted:
        remedy = "give position_m (fixed) or vehicle and lever_arm_m (mounted)" + (", not both" if fixed else "")
        yield ("position_m",), get("position_m"), f"a {kind} is either fixed or mounted: {remedy}"
    elif fixed and _is_vector(get("lever_arm_m")) and any(get("lever_arm_m")):
        yield ("lever_arm_m",), get("lever_arm_m"), f"only a {kind} on a vehicle has a lever arm; remove it"


class Beacon(_Section):
    """`[[beacon]]`: an emitter, fixed at `position_m` or at `lever_arm_m` on a vehicle.

    `position_sd_m` above 0 marks a guess; `offset_s` is when it bursts after the sync command; `delay_s` how much later
    than commanded the sound leaves it. Beacons of different `zone`s, out of each other's reach, may send the same code.
    Keys of `[signal]` given here override that section.
    """

    id: Id
    position_m: Vector | None = None
    vehicle: Id | None = None
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    position_sd_m: NotNegative = 0.0
    offset_s: Number = 0.0
    delay_s: Number = 0.0
    code: Code | None = None
    zone: Id | None = None
    carrier_hz: Positive | None = None
    modulation: Modulation | None = None
    cycles_per_chip: Positive | None = None
    bandwidth_hz: Positive | None = None

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        yield from _mounting(get, "beacon")
        if get("vehicle") is not None and get("position_sd_m"):
            yield ("position_sd_m",), get("position_sd_m"), "only a fixed beacon's place can be a guess; remove it"


class Microphone(_Section):
    """`[[microphone]]`: a receiver on channel `channel` of the capture, fixed or at `lever_arm_m` on a vehicle."""

    id: Id
    channel: Whole | None = None
    position_m: Vector | None = None
    vehicle: Id | None = None
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    delay_s: Number = 0.0

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        yield from _mounting(get, "microphone")


MOST_BIAS_M, MOST_BIAS_SD_M = 1000.0, 100.0
"""Of a pair's ranges; beyond these sums of variances lose the ranges' own."""


class Pair(_Section):
    """`[[pair]]`: ranges from beacon `from` to microphone `to` are `bias_m` too long, known to `bias_sd_m`.

    That error stays as it is for the whole recording, whatever the way. In Python the two are `emitter` and `receiver`.
    """

    model_config = ConfigDict(populate_by_name=False)

    emitter: Id = Field(alias="from")
    receiver: Id = Field(alias="to")
    bias_m: Annotated[Number, Field(ge=-MOST_BIAS_M, le=MOST_BIAS_M)] = 0.0
    bias_sd_m: Annotated[NotNegative, Field(le=MOST_BIAS_SD_M)] = 0.0

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        if get("bias_m") is None and get("bias_sd_m") is None:
            remedy = "the pair tells nothing: give how much its ranges are too long, its deviation bias_sd_m, or both"
            yield ("bias_m",), None, remedy


_Node = TypeVar("_Node", Vehicle, Beacon, Microphone)


class Site(_Section):
    """All of `site.toml`.

    The file's tables `[site]`, `[[vehicle]]`, `[[beacon]]`, `[[microphone]]` and `[[pair]]` are the attributes
    `section`, `vehicles`, `beacons`, `microphones` and `pairs`; a Site can be built by both names, and with `name` and
    `bounds_m` directly.
    `Site.model_json_schema()` describes the file for editors.
    """

    format: Literal[1] = 1
    section: SiteSection = Field(default=SiteSection(), alias="site")
    origin: Origin | None = None
    air: AirSection = AirSection()
    schedule: Schedule | None = None
    signal: Signal | None = None
    vehicles: tuple[Vehicle, ...] = Field(default=(), alias="vehicle")
    beacons: tuple[Beacon, ...] = Field(default=(), alias="beacon")
    microphones: tuple[Microphone, ...] = Field(default=(), alias="microphone")
    pairs: tuple[Pair, ...] = Field(default=(), alias="pair")

    @model_validator(mode="before")
    @classmethod
    def _lift(cls, data: Any) -> Any:
        """Let a Site be built from `name` and `bounds_m` without the section that holds them in the file."""
        if isinstance(data, Mapping) and not {"site", "section"} & set(data) and {"name", "bounds_m"} & set(data):
            section = {key: data[key] for key in ("name", "bounds_m") if key in data}
            return {**{k: v for k, v in data.items() if k not in section}, "site": section}
        return data

    @classmethod
    def _broken_rules(cls, get: Callable[[str], Any]) -> Iterator[Mistake]:
        kinds = {kind: _rows(get(kind), get(f"{kind}s")) for kind in ("vehicle", "beacon", "microphone")}
        for kind, rows in kinds.items():
            yield from _twice(kind, rows, "id", f"every {kind} needs its own id")
        yield from _twice("microphone", kinds["microphone"], "channel", "two microphones cannot share a channel")
        # vehicles alone may be followed by positions that others computed
        positioned = kinds["vehicle"] and not kinds["microphone"]
        none = isinstance(get("beacon") or get("beacons"), list | tuple | None) and not kinds["beacon"]
        if none and not positioned:
            yield ("beacon",), None, "nothing sends; add at least one [[beacon]]"
        vehicles = sorted(str(row("id")) for row in kinds["vehicle"])
        for kind in ("beacon", "microphone"):
            for i, row in enumerate(kinds[kind]):
                vehicle = row("vehicle")
                if isinstance(vehicle, str) and vehicle not in vehicles:
                    known = ", ".join(vehicles) or "none"
                    remedy = f"no [[vehicle]] has this id (known: {known}); add it or correct the name"
                    yield (kind, i, "vehicle"), vehicle, remedy
        yield from _pair_rules(_rows(get("pair"), get("pairs")), kinds["beacon"], kinds["microphone"])
        yield from _code_rules(kinds["beacon"], get("schedule"), get("signal"))
        if _reader(get("schedule"))("own_clocks") is True:
            for kind in ("beacon", "microphone"):
                for i, row in enumerate(kinds[kind]):
                    if row("vehicle") is None:
                        remedy = "with own_clocks all is timed by vehicles' clocks; mount it on one, which may stand"
                        yield (kind, i, "vehicle"), None, remedy

    @property
    def name(self) -> str:
        """The site's name."""
        return self.section.name

    @property
    def bounds_m(self) -> tuple[Vector, Vector] | None:
        """Lower and upper corner of the room, in m."""
        return self.section.bounds_m

    @property
    def sound_speed_mps(self) -> float:
        """Speed of sound as the site states it, else by Cramer 1993 for its air."""
        stated = self.air.sound_speed_mps
        if stated is not None:
            return stated
        return air.sound_speed_mps(self.air.temperature_c, self.air.humidity, self.air.pressure_kpa)

    @property
    def sound_speed_sd_mps(self) -> float:
        """Its deviation: a stated speed is taken as it is, a computed one rests on a thermometer."""
        return 0.0 if self.air.sound_speed_mps is not None else air.BY_KELVIN_MPS * air.THERMOMETER_SD_K

    @property
    def clock_known(self) -> bool:
        """Whether the moments of sending are known on the recorder's clock, so that ranges are not just differences.

        They are not where bursts start at no sync command, nor where a recorded reference states no distance. Two-way
        ranges know both ends' clocks.
        """
        unplaced = any(isinstance(b.code, ReferenceCode) and b.code.distance_m is None for b in self.beacons)
        return not unplaced and (self.schedule is None or self.schedule.synchronised or self.own_clocks)

    @property
    def free_running(self) -> bool:
        """Whether every burst has an offset of its own: beacons that only ride on vehicles, on their own clocks."""
        unsynchronised = self.schedule is not None and not self.schedule.synchronised
        riding = all(b.vehicle is not None for b in self.coded_beacons or self.beacons)
        return unsynchronised and not self.own_clocks and riding

    @property
    def own_clocks(self) -> bool:
        """Whether each vehicle sounds and records on a clock of its own, so that ranges are two-way."""
        return self.schedule is not None and self.schedule.own_clocks

    @property
    def coded_beacons(self) -> tuple[Beacon, ...]:
        """The beacons that take part in reading samples."""
        return tuple(beacon for beacon in self.beacons if beacon.code is not None)

    def signal_of(self, beacon: Beacon) -> Signal:
        """Return what a beacon keys its code on: `[signal]` with the beacon's own values in place.

        Raises
        ------
        ValueError
            If neither names a carrier.
        """
        values = self.signal.model_dump() if self.signal else {}
        own = {key: getattr(beacon, key) for key in Signal.model_fields}
        values |= {key: value for key, value in own.items() if value is not None}
        if "carrier_hz" not in values:
            raise ValueError(f"beacon {beacon.id} has no carrier_hz; add a [signal] section or give the beacon one")
        return Signal.model_validate(values)

    def beacon(self, beacon_id: str) -> Beacon:
        """Return a beacon by its id; raise KeyError naming those that exist."""
        return _find(self.beacons, beacon_id, "beacon")

    def microphone(self, microphone_id: str) -> Microphone:
        """Return a microphone by its id; raise KeyError naming those that exist."""
        return _find(self.microphones, microphone_id, "microphone")

    def vehicle(self, vehicle_id: str) -> Vehicle:
        """Return a vehicle by its id; raise KeyError naming those that exist."""
        return _find(self.vehicles, vehicle_id, "vehicle")


def _find(nodes: tuple[_Node, ...], node_id: str, kind: str) -> _Node:
    for node in nodes:
        if node.id == node_id:
            return node
    raise KeyError(f"no {kind} {node_id!r}; the site has {', '.join(node.id for node in nodes) or 'none'}")


_PAIR_KEYS = (("from", "emitter"), ("to", "receiver"))


def _is_vector(value: object) -> bool:
    return isinstance(value, list | tuple) and len(value) == 3 and all(isinstance(v, int | float) for v in value)


def _reader(table: object) -> Callable[[str], Any]:
    """Read keys alike from a raw table and from a model; None where there is no such key."""
    if isinstance(table, Mapping):
        return table.get
    return lambda key: getattr(table, key, None)


def _rows(*candidates: object) -> list[Callable[[str], Any]]:
    rows = next((c for c in candidates if isinstance(c, list | tuple)), ())
    return [_reader(row) for row in rows]


def _twice(kind: str, rows: list[Callable[[str], Any]], key: str, remedy: str) -> Iterator[Mistake]:
    first: dict[Any, int] = {}
    for i, row in enumerate(rows):
        value = row(key)
        if isinstance(value, str | int) and first.setdefault(value, i) != i:
            yield (kind, i, key), value, f"{kind} {first[value] + 1} has it already; {remedy}"


def _pair_rules(
    pairs: list[Callable[[str], Any]], beacons: list[Callable[[str], Any]], microphones: list[Callable[[str], Any]]
) -> Iterator[Mistake]:
    """Pairs name a beacon and a microphone that are there, and no two of them the same ones."""
    first: dict[tuple[str, str], int] = {}
    for i, row in enumerate(pairs):
        names = tuple(row(key) if row(key) is not None else row(field) for key, field in _PAIR_KEYS)
        for (key, _), name, kind, nodes in zip(
            _PAIR_KEYS, names, ("beacon", "microphone"), (beacons, microphones), strict=True
        ):
            ids = sorted(str(node("id")) for node in nodes)
            if isinstance(name, str) and name not in ids:
                known = ", ".join(ids) or "none"
                yield ("pair", i, key), name, f"no [[{kind}]] has this id (known: {known}); correct the name"
        if all(isinstance(name, str) for name in names) and first.setdefault(names, i) != i:
            remedy = f"pair {first[names] + 1} is from {names[0]} to {names[1]} already; state each pair once"
            yield ("pair", i, "from"), names[0], remedy


def _code_rules(beacons: list[Callable[[str], Any]], schedule: object, signal: object) -> Iterator[Mistake]:
    """Codes need a signal to key and a schedule, must differ, and must start within their period."""
    coded = [(i, row) for i, row in enumerate(beacons) if row("code") is not None]
    shared = _reader(signal)
    bare = [row("id") for _, row in coded if row("carrier_hz") is None and shared("carrier_hz") is None]
    if bare:
        yield ("signal", "carrier_hz"), None, f"beacons with a code ({_join(bare)}) need a carrier; add it to [signal]"
    bare = [row("id") for _, row in coded if _is_chipped(row) and row("cycles_per_chip") is None]
    if bare and shared("cycles_per_chip") is None:
        yield ("signal", "cycles_per_chip"), None, f"chips ({_join(bare)}) need a length; add it to [signal]"
    if coded and schedule is None:
        bare = [row("id") for _, row in coded]
        yield ("schedule",), None, f"beacons with a code ({_join(bare)}) need [schedule] with period_s"
    period = _reader(schedule)("period_s")
    for i, row in coded:
        offset = row("offset_s")
        if isinstance(offset, int | float) and isinstance(period, int | float) and 0 < period <= abs(offset):
            yield ("beacon", i, "offset_s"), offset, f"bursts start within their period of {period} s"
    for (i, a), (k, b) in combinations(coded, 2):
        alike = (_code_key(a("code")), repr(a("carrier_hz"))) == (_code_key(b("code")), repr(b("carrier_hz")))
        if alike and _in_two_zones(a, b):
            if _reader(schedule)("synchronised") is False:
                remedy = f"codes that zones share ({a('id')}, {b('id')}) need synchronised = true, or a code each"
                yield ("schedule", "synchronised"), False, remedy
        elif alike:
            remedy = f"beacon {i + 1} ({a('id')}) sends the same code; every beacon of a zone needs its own"
            yield ("beacon", k, "code"), b("id"), remedy


def _in_two_zones(a: Callable[[str], Any], b: Callable[[str], Any]) -> bool:
    """Whether two beacons may share a code: both stand still, each in a zone of its own."""
    return None not in (a("zone"), b("zone")) and a("zone") != b("zone") and not (a("vehicle") or b("vehicle"))


def _join(ids: list[object]) -> str:
    return ", ".join(map(str, ids))


def _is_chipped(beacon: Callable[[str], Any]) -> bool:
    code = _reader(beacon("code"))
    return code("chips") is not None or code("family") in ("m-sequence", "gold", "kasami")


def _code_key(code: object) -> object:
    """Return what makes two codes the same as written."""
    get = _reader(code)
    if get("chips") is not None:
        return get("chips")
    keys = ("reference", "start_s", "family", "degree", "index", "start_hz", "stop_hz", "duration_s")
    taps = get("taps")
    return (*(repr(get(key)) for key in keys), tuple(sorted(map(repr, taps))) if isinstance(taps, list | tuple) else ())
