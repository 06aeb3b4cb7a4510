"""Objects and tracks of drives as text that libraries of other trackers read (MOT Challenge 2015, 3-D)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path

from lab.measures.object_rows import HiddenRow, ScanRow, TrackRow
from msgs.files.whole_files import write_whole


def write_mot_tables(folder: Path, lists: Mapping[str, Sequence[ScanRow]]) -> None:
    """Write `truth/DRIVE/gt/gt.txt` and, of each list by name, `NAME/DRIVE.txt`; scans in the order of their drives.

    A row: frame from 1, id, no box (-1, four times), confidence 1, centre x, y, z in metres. The truth is that of any
    list: objects out of sight that a mirror shows.
    """
    for name, scans in lists.items():
        for place, drive in groupby(scans, key=lambda scan: scan.place):
            rows = list(drive)
            _write(folder / "truth" / f"{place:05d}" / "gt" / "gt.txt", rows, _objects)
            _write(folder / Path(name).stem / f"{place:05d}.txt", rows, _tracks)


def _objects(scan: ScanRow) -> Iterable[tuple[int, HiddenRow]]:
    return ((row.object_id, row) for row in scan.hidden if row.image.mirrored)


def _tracks(scan: ScanRow) -> Iterable[tuple[int, TrackRow]]:
    return ((row.id, row) for row in scan.tracks)


def _write(
    path: Path, scans: Sequence[ScanRow], rows: Callable[[ScanRow], Iterable[tuple[int, HiddenRow | TrackRow]]]
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [
        f"{frame},{key},-1,-1,-1,-1,1,{row.at_m[0]:.6f},{row.at_m[1]:.6f},0\n"
        for frame, scan in enumerate(scans, 1)
        for key, row in rows(scan)
    ]
    write_whole(path, "".join(lines).encode())
