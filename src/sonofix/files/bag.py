"""Recordings of robots: rosbag2 folders and files (sqlite3, mcap) and plain MCAP, message by message, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sonofix.files.problem import Problem, RecordingError, one_line

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

MISSING = "reading and writing ROS messages needs rosbags and mcap; pip install 'sonofix[robotics]'"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag.

    Attributes
    ----------
    name, kind : str
        Its name and its message type, "sensor_msgs/msg/Range" for example.
    encoding : str
        Of its messages; "cdr" can be read.
    definition : str or None
        Of the message type, as the bag holds it (ROS 2 .msg text); None where it holds none.
    """

    name: str
    kind: str
    encoding: str
    definition: str | None


class Bag:
    """A bag to be read from its beginning to its end, once.

    Attributes
    ----------
    path : Path
    counts : dict from Topic to int
        Every topic met so far, with the messages met; complete when `messages` has ended.
    notes : list of str
        What is odd about the bag, a sentence each; complete when `messages` has ended.

    Parameters
    ----------
    path : path
        A rosbag2 folder (with its metadata.yaml), or a file: .mcap, .db3.

    Raises
    ------
    RecordingError
        Where there is no bag, or rosbags and mcap are not installed.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.counts: dict[Topic, int] = {}
        self.notes: list[str] = []
        self._check()

    def messages(self, wanted: Callable[[Topic], bool]) -> Iterator[tuple[Topic, int, bytes]]:
        """Iterate over the messages of the topics that ``wanted`` says yes to: topic, time of receipt (ns), bytes.

        An MCAP file that is cut off or damaged gives what whole chunks come before, and a note.

        Raises
        ------
        RecordingError
            Where the bag cannot be read.
        """
        if self.path.suffix == ".mcap" and self.path.is_file():
            return self._mcap(wanted)
        return self._rosbag2(wanted)

    def _check(self) -> None:
        path = self.path
        with needed():
            import mcap.stream_reader  # noqa: F401
            import rosbags.rosbag2  # noqa: F401
        if not path.exists():
            self._refuse("there is no such file or folder")
        if path.is_dir() and not (path / "metadata.yaml").exists():
            files = sorted(file.name for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
            if files:
                remedy = (
                    "its recorder was stopped before it ended; `ros2 bag reindex` mends it, or give one of its files"
                )
                self._refuse(f"has no metadata.yaml: {remedy}, such as {path / files[0]}")
            self._refuse(
                "is no rosbag2 folder: it has no metadata.yaml; give the bag's folder, or a .mcap or .db3 file"
            )
        if path.is_file() and path.suffix == ".bag":
            self._refuse(f"is a ROS 1 bag; make it one of ROS 2: rosbags-convert --src {path.name} --dst {path.stem}")
        if path.is_file() and path.suffix not in (".mcap", ".db3"):
            self._refuse("is no bag; give a rosbag2 folder, or a .mcap or .db3 file")

    def _refuse(self, remedy: str) -> None:
        raise RecordingError([Problem(str(self.path), "", None, remedy)])

    def _mcap(self, wanted: Callable[[Topic], bool]) -> Iterator[tuple[Topic, int, bytes]]:
        """Read the file from its start, so that neither its index nor its end are needed."""
        from mcap.records import Channel, DataEnd, Message, Schema
        from mcap.stream_reader import StreamReader

        schemas: dict[int, Schema] = {}
        channels: dict[int, tuple[Topic, bool]] = {}
        count = 0
        with self._readable(), self.path.open("rb") as file:
            records = StreamReader(file, validate_crcs=True, record_size_limit=2**31).records
            while True:
                try:
                    record = next(records, None)
                # what a damaged file makes the reader and its decompressors raise is of every kind
                except Exception as error:
                    if isinstance(error, OSError):
                        raise
                    if not count:
                        self._refuse(f"cannot be read: {_reason(error)}; is it whole, and an MCAP file?")
                    reason = _reason(error)
                    self.notes.append(
                        f"{self.path.name} is cut off or damaged after {count} messages ({reason}); those are read"
                    )
                    return
                if record is None or isinstance(record, DataEnd):
                    return
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and record.id not in channels:
                    topic = _mcap_topic(record, schemas.get(record.schema_id))
                    self.counts.setdefault(topic, 0)
                    channels[record.id] = topic, wanted(topic)
                elif isinstance(record, Message) and record.channel_id in channels:
                    topic, taken = channels[record.channel_id]
                    self.counts[topic] += 1
                    count += 1
                    if taken:
                        yield topic, record.log_time, record.data

    def _rosbag2(self, wanted: Callable[[Topic], bool]) -> Iterator[tuple[Topic, int, bytes]]:
        from rosbags.interfaces import ConnectionExtRosbag2, MessageDefinitionFormat
        from rosbags.rosbag2 import Reader

        self._look_for_journals()
        with self._readable():
            reader = Reader(self.path)
            reader.open()
        try:
            taken: dict[Any, Topic] = {}
            for connection in reader.connections:
                ext = connection.ext
                topic = Topic(
                    connection.topic,
                    _full(connection.msgtype),
                    ext.serialization_format if isinstance(ext, ConnectionExtRosbag2) else "",
                    connection.msgdef.data if connection.msgdef.format == MessageDefinitionFormat.MSG else None,
                )
                self.counts[topic] = self.counts.get(topic, 0) + connection.msgcount
                if wanted(topic):
                    taken[connection.id] = topic
            connections = [c for c in reader.connections if c.id in taken]
            messages = reader.messages(connections) if connections else iter(())
            while True:
                with self._readable():
                    message = next(messages, None)
                if message is None:
                    return
                connection, received_ns, data = message
                yield taken[connection.id], received_ns, bytes(data)
        finally:
            reader.close()

    def _look_for_journals(self) -> None:
        files = [self.path] if self.path.is_file() else sorted(self.path.glob("*.db3"))
        for file in files:
            journal = file.with_name(f"{file.name}-wal")
            if journal.exists() and journal.stat().st_size:
                self.notes.append(
                    f"{journal.name} holds messages that are not in {file.name} yet, and is not read; "
                    f"`sqlite3 {file.name} .tables` takes them in"
                )

    @contextmanager
    def _readable(self) -> Iterator[None]:
        """Turn whatever a reader raises on a damaged bag into one line."""
        try:
            yield
        except RecordingError:
            raise
        except Exception as error:
            hint = ""
            if self.path.is_dir() and (files := sorted(self.path.glob("*.mcap"))):
                hint = f"; what is whole of it may be read by giving its file: {files[0]}"
            self._refuse(f"cannot be read: {_reason(error)}{hint}")


class Decoder:
    """Makes objects of the messages of one topic.

    Raises
    ------
    RecordingError
        Where the topic's encoding or message definition cannot be read; `decode` where a message does not fit it.
    """

    def __init__(self, file: str, topic: Topic) -> None:
        self._file, self._topic = file, topic
        if topic.encoding != "cdr":
            remedy = "cannot be read; ROS 2 writes its messages as cdr"
            raise RecordingError([Problem(file, f"{topic.name}, encoding", topic.encoding, remedy)])
        self._store = _store(file, topic)

    def decode(self, data: bytes) -> Any:
        """Return the message as an object with the fields of its definition."""
        try:
            return self._store.deserialize_cdr(data, self._topic.kind)
        # bytes that are not what the definition says make the generated code stumble in any way
        except Exception as error:
            remedy = f"{len(data)} bytes are no {self._topic.kind} as the bag defines it ({_reason(error)})"
            raise RecordingError([Problem(self._file, self._topic.name, None, remedy)]) from None


@contextmanager
def needed() -> Iterator[None]:
    """Import from the extra ``robotics`` within; where it is not installed that is said.

    Raises
    ------
    ValueError
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("mcap", "rosbags"):
            raise
        raise ValueError(MISSING) from None


def _mcap_topic(channel: Any, schema: Any) -> Topic:
    definition = schema.data.decode("utf-8", "replace") if schema and schema.encoding == "ros2msg" else None
    return Topic(channel.topic, _full(schema.name if schema else ""), channel.message_encoding, definition)


def _full(kind: str) -> str:
    """Return a message type's full name: some writers leave out the middle part."""
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name}" if name and "/" not in name else kind


def _store(file: str, topic: Topic) -> Typestore:
    """Return the message types that a topic needs: as the bag defines them, else the standard ones."""
    from rosbags.typesys import Stores, get_typestore

    if topic.definition is None:
        # Bags without definitions are of Humble or before: later recorders always write them.
        return get_typestore(Stores.ROS2_HUMBLE)
    try:
        return _defined(topic.kind, topic.definition)
    except Exception as error:
        remedy = f"the bag's definition of {topic.kind} cannot be read ({_reason(error)})"
        raise RecordingError([Problem(file, topic.name, None, remedy)]) from None


@lru_cache(maxsize=32)
def _defined(kind: str, definition: str) -> Typestore:
    """Return a message type and those it is made of; many topics are of one type, and reading it takes a while."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, kind))
    return store


def _reason(error: Exception) -> str:
    from mcap.exceptions import EndOfFile

    if isinstance(error, EndOfFile):
        return "it ends too early"
    return one_line(str(error)).rstrip(".")[:200] or type(error).__name__
