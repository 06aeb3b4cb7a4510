"""`mirrorwave import detections`: tables, ROS bags and data sets of a radar's detections as `radar/detections`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from contrib.imports.detection_bags import open_bag
from contrib.imports.detection_columns import DetectionMapping, detections_of
from contrib.imports.detection_mapping import mapping_path, read_mapping
from contrib.imports.detection_sets import (
    ARRAYS,
    DRIVE_SUFFIXES,
    array_files,
    array_scans,
    read_drive,
    shipped_mapping,
)
from contrib.imports.detection_tables import ScanRows, count_lines, table_scans
from contrib.imports.ros_bag import SUFFIXES
from mirrorwave.convert.formats import Bar
from msgs.files.checksums import file_sha256
from msgs.files.shipped import shipped_path
from msgs.recording.clock_steps import Bridged
from msgs.recording.mcap import RecordingWriter, whole_recording
from msgs.values.arrays import MAX_STAMP_NS

TEXT_SUFFIXES = (".csv", ".tsv", ".txt")


def import_detections(source: Path, out: Path, given: Path | None, topic: str | None, bar: Bar) -> dict[str, Any]:
    """Write the detections of a table, a bag or a data set to the new recording `out`; returns counts and `loss`.

    Raises `ValueError` where file, mapping and topic do not fit, or no scan comes out; `ImportError` without rosbags or
    h5py.
    """
    if files := array_files(source):
        return _import_arrays(source, files, out, given, topic, bar)
    if source.suffix.lower() in DRIVE_SUFFIXES:
        return _import_drive(source, out, given, topic, bar)
    if source.is_dir() or source.suffix.lower() in SUFFIXES:
        return _import_bag(source, out, given, topic, bar)
    if source.suffix.lower() not in TEXT_SUFFIXES:
        ends = ", ".join((*TEXT_SUFFIXES, *ARRAYS, *DRIVE_SUFFIXES, *SUFFIXES))
        raise ValueError(
            f"{source}: must be a table, a data set or a ROS bag, by the end of its name: {ends}, or a bag's folder"
        )
    if topic is not None:
        raise ValueError(f"{source}: --topic is for bags, got {topic!r}")
    if given is None:
        raise ValueError(f"{source}: --mapping must name what the columns are, such as launch/detections/table.yaml")
    used = shipped_path(given)
    mapping = read_mapping(used)
    if mapping.stamp is None:
        raise ValueError(f"{used}: stamp must be given: the column with a row's time")
    sink = _Sink(source, mapping)
    provenance = _provenance(source, used)
    with bar("lines", count_lines(source)) as advance, whole_recording(out, provenance) as writer:
        sink.write(writer, table_scans(source, mapping, sink.left_out, advance))
    return sink.summary("")


def _import_arrays(
    source: Path, files: list[Path], out: Path, given: Path | None, topic: str | None, bar: Bar
) -> dict[str, Any]:
    if topic is not None:
        raise ValueError(f"{source}: --topic is for bags, got {topic!r}")
    kinds = {file.suffix.lower() for file in files}
    if len(kinds) > 1:
        raise ValueError(f"{source}: must hold files of one kind, got {' and '.join(sorted(kinds))}")
    used = shipped_path(given) if given else shipped_mapping(ARRAYS[kinds.pop()].mapping)
    sink = _Sink(source, read_mapping(used))
    facts = {"files": ", ".join(file.name for file in files[:: max(1, len(files) - 1)])}
    provenance = _provenance(files[0], used) | facts
    with bar("files", len(files)) as advance, whole_recording(out, provenance) as writer:
        sink.write(writer, array_scans(files, advance))
    return sink.summary("")


def _import_drive(source: Path, out: Path, given: Path | None, sensor: str | None, bar: Bar) -> dict[str, Any]:
    drive = read_drive(source, shipped_path(given) if given else None, sensor)
    sink = _Sink(source, drive.mapping)
    provenance = _provenance(source, drive.mapping_path) | {"sensor": drive.mapping.sensor}
    with bar("scans", len(drive.starts)) as advance, whole_recording(out, provenance) as writer:
        sink.write(writer, drive.scans(advance))
    return sink.summary("")


def _import_bag(source: Path, out: Path, given: Path | None, topic: str | None, bar: Bar) -> dict[str, Any]:
    with open_bag(source, topic) as bag:
        used = mapping_path(bag.kind, given)
        mapping = read_mapping(used)
        sink = _Sink(source, mapping)
        provenance = _provenance(source, used) | {"topic": bag.topic, "type": bag.kind}
        with bar("messages", bag.count) as advance, whole_recording(out, provenance) as writer:
            scans = bag.scans(mapping.columns.values(), sink.left_out, advance)
            sink.write(writer, scans, lambda: bag.loss)
        return sink.summary(bag.loss) | {"topic": bag.topic}


class _Sink:
    """Writes scans and counts what becomes of them."""

    def __init__(self, source: Path, mapping: DetectionMapping) -> None:
        self._source, self._mapping = source, mapping
        self._last_ns = -1
        self.scans = self.detections = 0
        self.left_out: Counter[str] = Counter()

    def write(self, writer: RecordingWriter, scans: Iterator[ScanRows], loss: Callable[[], str] = lambda: "") -> None:
        """Write all scans, without steps of their clock.

        Raises `ValueError` naming the file, what was left out and its loss, where none comes out.
        """
        for rows, time_ns in Bridged(scans, lambda rows: rows.stamp_ns, f"{self._source}: the clock", noun="scan"):
            self._take(writer, rows._replace(stamp_ns=time_ns))
        if not self.detections:
            reasons = ", ".join(f"{count} {reason}" for reason, count in self.left_out.items())
            said = (f"; left out: {reasons}" if reasons else "") + (f"; {loss()}" if loss() else "")
            raise ValueError(f"{self._source}: gives no detection{said}")

    def _take(self, writer: RecordingWriter, rows: ScanRows) -> None:
        count = len(next(iter(rows.columns.values()), ()))
        if not self._last_ns < rows.stamp_ns <= MAX_STAMP_NS:
            self.left_out["stamp is not after that of the scan before"] += count
            return
        self._last_ns = rows.stamp_ns
        try:
            detections, left_out = detections_of(rows.columns, self._mapping, rows.stamp_ns, self.scans)
        except ValueError as error:
            raise ValueError(f"{self._source}: {error}") from None
        self.left_out += left_out
        writer.write("radar/detections", detections, publisher="import", sequence=self.scans, sent_ns=rows.stamp_ns)
        self.scans += 1
        self.detections += len(detections)

    def summary(self, loss: str) -> dict[str, Any]:
        """Return counts; `loss` says why the source could not be read to its end."""
        return {
            "scans": self.scans, "detections": self.detections, "left_out": dict(self.left_out), "loss": loss or None,
        }  # fmt: skip


def _provenance(source: Path, mapping: Path) -> dict[str, str]:
    checksum = {} if source.is_dir() else {"source_sha256": file_sha256(source)}
    return {
        "import": "detections",
        "source": source.name,
        **checksum,
        "mapping": mapping.name,
        "mapping_sha256": file_sha256(mapping),
        "time_base": "stamps of the source",
    }
