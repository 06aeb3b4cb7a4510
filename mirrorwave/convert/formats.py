"""Conversion of recordings into the formats that other tools open: `mirrorwave bag convert`."""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from enum import StrEnum
from pathlib import Path
from typing import Any

import msgspec

from msgs.values.wording import counted


class Format(StrEnum):
    """A format to convert to."""

    FOXGLOVE = "foxglove"
    ROS2 = "ros2"
    SIGMF = "sigmf"
    NUMPY = "numpy"


#: The module that writes each.
WRITERS = {
    Format.FOXGLOVE: "contrib.foxglove.foxglove_recording",
    Format.ROS2: "contrib.ros2.ros2_recording",
    Format.SIGMF: "mirrorwave.convert.sigmf",
    Format.NUMPY: "mirrorwave.convert.numpy",
}
#: What a name's end says of its format.
SUFFIXES = {
    ".mcap": Format.FOXGLOVE,
    ".ros2": Format.ROS2,
    ".sigmf-meta": Format.SIGMF,
    ".sigmf-data": Format.SIGMF,
    ".numpy": Format.NUMPY,
    ".npz": Format.NUMPY,
}

#: Opens a progress bar: (name, total) -> context with what advances it.
Bar = Callable[[str, int | None], AbstractContextManager[Callable[[], None]]]


class Conversion(msgspec.Struct, frozen=True, kw_only=True):
    """Account of a conversion: messages by topic, and by reason those that were left out."""

    source: str
    out: str
    format: Format
    converted: dict[str, int]
    #: Topics that the format has no place for, and those that this program does not know.
    not_converted: dict[str, int]
    #: Messages passed over on purpose, by "topic: reason".
    left_out: dict[str, int]
    #: What was missing, damaged or unreadable; None where nothing was.
    loss: str | None


def format_of(out: Path, wanted: Format | None) -> Format:
    """The format asked for, else what the end of `out`'s name stands for; raises `ValueError` where that is none."""
    target = wanted or SUFFIXES.get(out.suffix)
    if target is None:
        names = ", ".join(SUFFIXES)
        raise ValueError(f"{out}: --to must name a format, or the name must end in one of {names}")
    return target


def convert(source: Path, out: Path, target: Format, bar: Bar) -> Conversion:
    """Convert all that is readable and has a place in the format; a conversion that fails leaves nothing behind.

    Raises `ValueError` where `source` is no recording, holds nothing for the format or cannot be expressed in it,
    `FileExistsError` where a file would be written over, `ImportError` where the format's library is missing.
    """
    from msgs.recording.mcap import RecordingReader

    module = importlib.import_module(WRITERS[target])
    paths = _written_paths(out, target)
    for path in paths:
        if path.exists():
            raise FileExistsError(17, "exists already; choose another name", str(path))
    with RecordingReader(source) as reader:
        try:
            return _convert(reader, out, target, module, bar)
        except BaseException:
            _remove(paths)
            raise


def _convert(reader: Any, out: Path, target: Format, module: Any, bar: Bar) -> Conversion:
    from msgs.files.whole_files import named_errors, require_room
    from nodes.recording.shapes import Account

    summary = reader.info()
    held = {topic.topic: topic.messages for topic in summary.topics}
    topics = tuple(topic for topic in module.topics() if topic in held)
    if not topics:
        takes, holds = ", ".join(module.topics()), ", ".join(held) or "no message"
        raise ValueError(f"{reader.path}: holds nothing for {target.value}, which takes {takes}; it holds {holds}")
    account = Account()
    if target in (Format.SIGMF, Format.NUMPY):
        # written as they are, not compressed
        require_room(out, sum(topic.bytes for topic in summary.topics if topic.topic in topics))
    with named_errors(out), bar(reader.path.name, sum(held[topic] for topic in topics)) as advance:
        module.write(reader, out, topics, account, advance)
    if not +account.written:
        raise ValueError(f"{reader.path}: holds no readable message for {target.value}")
    return Conversion(
        source=str(reader.path),
        out=str(out),
        format=target,
        converted=dict(+account.written),
        not_converted={topic: count for topic, count in held.items() if topic not in topics},
        left_out=dict(+account.left_out),
        loss=_loss(summary.loss, reader.skipped, account.lost),
    )


def _loss(damage: str | None, unreadable: dict[str, int], lost: dict[str, int]) -> str | None:
    reasons = [damage] if damage else []
    reasons += [f"{count} unreadable messages of {topic}" for topic, count in sorted(unreadable.items())]
    reasons += [f"{counted(count, 'message')} of {reason}" for reason, count in sorted(lost.items())]
    return "; ".join(reasons) or None


def _written_paths(out: Path, target: Format) -> tuple[Path, ...]:
    """Return the paths that a conversion writes, so that none is overwritten or left half written."""
    if target is not Format.SIGMF:
        return (out,)
    stem = out.name.removesuffix(".sigmf-meta").removesuffix(".sigmf-data")
    return tuple(out.with_name(stem + end) for end in (".sigmf-meta", ".sigmf-data", ".background.npy"))


def _remove(paths: tuple[Path, ...]) -> None:
    for path in paths:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
