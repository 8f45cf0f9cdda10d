"""Which topic of a bag tells which file of a recording, and of whom: by a few rules, or by a table the user writes."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sonofix.files.bag import Topic
from sonofix.files.problem import Problem, RecordingError, did_you_mean
from sonofix.files.site_file import read_text
from sonofix.site import Site

USES: Mapping[str, tuple[str, ...]] = {
    "nav_msgs/msg/Odometry": ("odometry", "truth"),
    "sensor_msgs/msg/Imu": ("imu", "compass"),
    "sensor_msgs/msg/Range": ("ranges",),
    "sensor_msgs/msg/Temperature": ("temperature",),
    "geometry_msgs/msg/PoseStamped": ("truth",),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("truth",),
}
"""What a message type may become: stems of a recording's files."""

BY_DEFAULT = ("odometry", "imu", "ranges")
"""What is taken without being asked for: a pose need not be the truth, a temperature not that of the air."""

_KEYS = ("name", "frame", "as", "vehicle", "from", "to")


@dataclass(frozen=True, slots=True)
class Rule:
    """One ``[[topic]]`` of a map: what messages of a topic (and of one frame, where given) become, and of whom.

    None: not said, so that the rules of names decide. An empty ``uses``: the topic is left alone.
    """

    name: str
    frame: str | None = None
    uses: tuple[str, ...] | None = None
    vehicle: str | None = None
    emitter: str | None = None
    receiver: str | None = None


class TopicMap:
    """The rules of a map file, asked for each topic and frame.

    Parameters
    ----------
    site : Site
    rules : iterable of Rule
    name : str
        Of the map file, for messages.
    """

    def __init__(self, site: Site, rules: Iterable[Rule] = (), name: str = "--map") -> None:
        self.site, self.name = site, name
        self.rules = tuple(rules)

    def uses(self, topic: Topic) -> tuple[str, ...]:
        """Return the files that a topic's messages go to, by stem.

        Raises
        ------
        RecordingError
            Where the map asks for what the topic's type does not hold.
        """
        able = USES.get(topic.kind, ())
        rules = [rule for rule in self.rules if rule.name == topic.name]
        for rule in rules:
            for use in rule.uses or ():
                if use not in able:
                    holds = f"can be {' or '.join(able)}" if able else "is not read"
                    raise RecordingError([self._problem(rule, "as", use, f"{topic.kind} {holds}")])
        frames = {rule.frame for rule in rules if rule.frame is not None}
        every = [self.uses_of(topic, frame) for frame in (None, *sorted(frames))]
        return tuple(use for use in able if any(use in uses for uses in every))

    def uses_of(self, topic: Topic, frame: str | None) -> tuple[str, ...]:
        """Return the files that a topic's messages of one frame go to; None: of frames that the map does not name."""
        said = self._said(topic.name, frame, "uses")
        return tuple(use for use in USES.get(topic.kind, ()) if use in (BY_DEFAULT if said is None else said))

    def vehicle(self, topic: Topic, frame: str) -> str | None:
        """Return the vehicle that a topic tells of; None where it cannot be told."""
        said = self._said(topic.name, frame, "vehicle")
        if said is not None:
            return said
        found = _named([vehicle.id for vehicle in self.site.vehicles], topic.name, frame)
        return found[0] if len(found) == 1 else None

    def pair(self, topic: Topic, frame: str) -> tuple[str, str] | None:
        """Return the beacon and the microphone that a range lies between; None where it cannot be told."""
        beacons, microphones = self.site.beacons, self.site.microphones
        emitter, receiver = (self._said(topic.name, frame, end) for end in ("emitter", "receiver"))
        emitters = [emitter] if emitter else _named([b.id for b in beacons], topic.name, frame)
        receivers = [receiver] if receiver else _named([m.id for m in microphones], topic.name, frame)
        on = {b.id: b.vehicle for b in beacons if b.vehicle}, {m.id: m.vehicle for m in microphones if m.vehicle}
        # a robot does not hear itself
        pairs = [(e, r) for e in emitters for r in receivers if on[0].get(e, 1) != on[1].get(r, 2)]
        return pairs[0] if len(pairs) == 1 else None

    def absent(self, topics: Iterable[Topic]) -> list[Problem]:
        """Return a problem for each rule whose topic the bag lacks."""
        names = list(dict.fromkeys(topic.name for topic in topics))
        return [
            self._problem(rule, "name", rule.name, f"the bag has no such topic; {did_you_mean(rule.name, names)}")
            for rule in self.rules
            if names and rule.name not in names
        ]

    def _said(self, name: str, frame: str | None, field: str) -> Any:
        """Return what the map says: its rule for the frame goes before its rule for the whole topic."""
        for wanted in (frame, None):
            for rule in self.rules:
                if rule.name == name and rule.frame == wanted and getattr(rule, field) is not None:
                    return getattr(rule, field)
        return None

    def _problem(self, rule: Rule, key: str, value: object, remedy: str) -> Problem:
        return Problem(self.name, f"topic {self.rules.index(rule) + 1} {key}", value, remedy)


def read_map(path: str | Path, site: Site) -> TopicMap:
    """Read a map file.

    Raises
    ------
    RecordingError
        With every mistake in the file.
    """
    path = Path(path)
    try:
        raw = tomllib.loads(read_text(path, path.name))
    except tomllib.TOMLDecodeError as error:
        raise RecordingError([Problem(path.name, "", None, f"not TOML: {error}")]) from None
    problems = [
        Problem(path.name, key, None, "unknown key; a map is a list of [[topic]]") for key in raw if key != "topic"
    ]
    tables = raw.get("topic", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise RecordingError([Problem(path.name, "topic", None, "write it as [[topic]], in two brackets")])
    rules = [_rule(path.name, i, table, site, problems) for i, table in enumerate(tables, 1)]
    for i, rule in enumerate(rules, 1):
        if any((rule.name, rule.frame) == (other.name, other.frame) for other in rules[: i - 1]):
            problems.append(Problem(path.name, f"topic {i} name", rule.name, "stands there twice; join the two"))
    if problems:
        raise RecordingError(problems)
    return TopicMap(site, rules, path.name)


def _rule(file: str, number: int, table: Mapping[str, Any], site: Site, problems: list[Problem]) -> Rule:
    def tell(key: str, value: object, remedy: str) -> None:
        problems.append(Problem(file, f"topic {number} {key}", value, remedy))

    for key in table:
        if key not in _KEYS:
            tell(key, table[key], f"unknown key; {did_you_mean(key, _KEYS)}")
    texts: dict[str, str | None] = {}
    for key in ("name", "frame", "vehicle", "from", "to"):
        value = table.get(key)
        if value is not None and not isinstance(value, str):
            tell(key, value, "must be text in quotation marks")
        texts[key] = value if isinstance(value, str) else None
    if not texts["name"]:
        tell("name", table.get("name"), 'name the topic, such as "/odom"')
    for key, kind, nodes in (
        ("vehicle", "vehicle", site.vehicles),
        ("from", "beacon", site.beacons),
        ("to", "microphone", site.microphones),
    ):
        value, known = texts[key], [node.id for node in nodes]
        if value is not None and value not in known:
            near = did_you_mean(value, known) if known else "it has none"
            tell(key, value, f"the site has no [[{kind}]] of this id; {near}")
    uses = table.get("as")
    if isinstance(uses, str):
        uses = [uses]
    known_uses = tuple(dict.fromkeys(use for able in USES.values() for use in able))
    if uses is not None and not isinstance(uses, list):
        tell("as", uses, f"must be text, or a list of it; {', '.join(known_uses)}")
        uses = None
    for use in uses or ():
        if use not in known_uses:
            tell("as", use, f"no file that a topic can become; {did_you_mean(str(use), known_uses)}")
    return Rule(
        name=texts["name"] or "",
        frame=texts["frame"],
        uses=None if uses is None else tuple(map(str, uses)),
        vehicle=texts["vehicle"],
        emitter=texts["from"],
        receiver=texts["to"],
    )


def _named(ids: list[str], topic: str, frame: str) -> list[str]:
    """Return the ids that a frame names, else those that a topic names, else all: names between slashes count."""
    for words in (frame.split("/"), topic.split("/")):
        found = [node for node in ids if node in words]
        if found:
            return found
    return ids
