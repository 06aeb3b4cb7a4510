"""ROS 1 and ROS 2 bags, read by the library rosbags: the messages of some of their topics, until damage ends them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from contrib.ros2.ros2_types import type_store
from msgs.files.unpacking import limited_memory
from msgs.recording.mcap import RecordingReader

#: Ends of names that rosbags reads; a ROS 2 bag may also be a folder.
SUFFIXES = (".bag", ".mcap", ".db3")
#: Memory that a step of reading a bag may take: its chunks are of some MiB.
MAX_BAG_BYTES = 1 << 30


def require_library() -> None:
    """Raise `ImportError` that names the package where rosbags is not installed."""
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError as error:
        raise ImportError("rosbags, which reads ROS bags (pip install mirrorwave[convert])") from error


class RawMessage(NamedTuple):
    """A message of a bag: when it was written, and its bytes."""

    topic: str
    time_ns: int
    data: bytes


class RosBag:
    """An open bag; `kinds` gives the type of each topic, `counts` how many messages it has, where the bag says it."""

    def __init__(
        self,
        path: Path,
        kinds: Mapping[str, str | None],
        counts: Mapping[str, int],
        messages: Callable[[Collection[str]], Iterator[RawMessage]],
        deserialize: Callable[[bytes, str], Any],
        loss: Callable[[], str | None],
    ) -> None:
        self.path, self.kinds, self.counts = path, kinds, counts
        self._messages, self._deserialize, self._loss = messages, deserialize, loss
        self._end = ""

    @property
    def loss(self) -> str:
        """Return why the bag could not be read as a whole; empty where it could."""
        return self._end or (f"{self.path}: {loss}" if (loss := self._loss()) else "")

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield the messages of some topics in the order of the bag; damage ends them, and `loss` says so."""
        messages = self._messages(topics)
        while True:
            try:
                # what a chunk of rosbags unpacks to is not bounded
                with limited_memory(MAX_BAG_BYTES):
                    message = next(messages)
            except StopIteration:
                return
            except Exception as error:  # noqa: BLE001 - a damaged bag fails in whatever way the damage makes its reader
                self._end = f"{self.path}: cannot be read on: {reason_of(error)}"
                return
            yield message

    def deserialize(self, message: RawMessage) -> Any:
        """Return a message by its type; a damaged one raises any exception."""
        return self._deserialize(message.data, self.kinds[message.topic] or "")


@contextmanager
def open_bag(path: Path) -> Iterator[RosBag]:
    """Open a bag; raises `ImportError` without rosbags, `ValueError` naming the bag where it is none."""
    require_library()
    opened = _open_mcap if path.suffix.lower() == ".mcap" and path.is_file() else _open_any
    with ExitStack() as closing:
        with limited_memory(MAX_BAG_BYTES):
            bag = closing.enter_context(opened(path))
        yield bag


def is_bag(path: Path) -> bool:
    """Return whether a path is that of a bag, by its name, or by what a folder holds."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix.lower() in SUFFIXES


@contextmanager
def _open_mcap(path: Path) -> Iterator[RosBag]:
    """Open a bag of one MCAP file by the reader of recordings, which needs no summary and bounds what unpacks."""
    with RecordingReader(path) as reader:

        def messages(topics: Collection[str]) -> Iterator[RawMessage]:
            for channel, raw in reader.raw_messages(None, None, topics):
                yield RawMessage(channel.topic, raw.log_time, raw.data)

        yield RosBag(path, reader.types, {}, messages, type_store().deserialize_cdr, lambda: reader.loss)


@contextmanager
def _open_any(path: Path) -> Iterator[RosBag]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.msg import MSGParser

    # packages of ROS 1 may have capitals in their names, as ars_40X does; the library reads those of ROS 2 alone
    MSGParser.PackageName = MSGParser.MixedSnake
    with _bag_errors(path):
        reader = AnyReader([path], default_typestore=type_store())
        reader.open()

    def messages(topics: Collection[str]) -> Iterator[RawMessage]:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        for connection, time_ns, data in reader.messages(connections=connections):
            yield RawMessage(connection.topic, time_ns, data)

    try:
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
        counts: dict[str, int] = {}
        for connection in reader.connections:
            counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        yield RosBag(path, kinds, counts, messages, reader.deserialize, lambda: None)
    finally:
        reader.close()


@contextmanager
def _bag_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise
        raise ValueError(f"{path}: no ROS bag that can be read: {reason_of(error)}") from None


def reason_of(error: Exception) -> str:
    """Return an exception on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]
