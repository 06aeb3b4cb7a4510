"""Content of a capture that calibration reads: set-up, beams, vehicle states, from any kind of file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from msgs.recording.mcap import RecordingReader
from msgs.recording.sigmf import SigmfCapture
from msgs.values.radar import RadarBeam, RadarSetup


class Capture:
    """An MCAP recording or a SigMF capture; `loss` says after reading what is missing, None where it is whole.

    Raises ValueError naming the file where it is neither, or where it has no radar set-up.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists() and path.suffix == ".mcap":
            raise FileNotFoundError(2, "no such file", str(path))
        self.path = path
        self.loss: str | None = None
        self._sigmf = None if path.suffix == ".mcap" else SigmfCapture.open(path)
        self.setup = self._first_setup()

    def beams(self) -> Iterator[RadarBeam]:
        """All beams in order; ValueError where there are none."""
        any_beam = False
        for beam in self._sigmf.beams() if self._sigmf is not None else self.messages(("radar/beam",)):
            any_beam = True
            yield beam
        if not any_beam:
            raise ValueError(f"{self.path}: holds no raw beams (radar/beam): record with --raw")

    def messages(self, topics: tuple[str, ...]) -> Iterator[Any]:
        """Messages of some topics of a recording, in order; a SigMF capture has none but its beams."""
        if self._sigmf is not None:
            return
        with RecordingReader(self.path) as reader:
            for recorded in reader.messages(topics):
                yield recorded.message
            unread = ", ".join(f"{count} of {topic}" for topic, count in reader.skipped.items() if topic in topics)
            self.loss = reader.loss or (f"unreadable messages: {unread}" if unread else None)

    def _first_setup(self) -> RadarSetup:
        if self._sigmf is not None:
            return self._sigmf.setup
        setup: RadarSetup | None = next(self.messages(("radar/setup",)), None)
        if setup is None:
            raise ValueError(f"{self.path}: holds no radar/setup")
        return setup

    def scan_count(self) -> int:
        """Estimate the number of scans from the file's size, for a progress bar."""
        radar, beams = self.setup.radar, len(self.setup.beams)
        if self._sigmf is not None:
            return max(len(self._sigmf) // beams, 1)
        return max(self.path.stat().st_size // (4 * radar.chirps_per_beam * radar.samples_per_chirp * beams), 1)


def complete_scans(
    beams: Iterator[RadarBeam], per_scan: int, on_scan: Callable[[], None], limit: int
) -> Iterator[list[RadarBeam]]:
    """Up to `limit` scans of which every beam came, each sorted by beam."""
    scan: dict[int, RadarBeam] = {}
    number, given = -1, 0
    for beam in beams:
        if beam.scan_id != number:
            scan, number = {}, beam.scan_id
        scan[beam.beam_index] = beam
        if len(scan) == per_scan:
            on_scan()
            yield [scan[index] for index in range(per_scan)]
            scan, given = {}, given + 1
            if given == limit:
                return
