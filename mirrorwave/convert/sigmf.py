"""Raw beams of a recording as a SigMF capture, by the writer that all captures come from."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from msgs.recording.mcap import RecordingReader
from msgs.recording.sigmf import SigmfCapture, write_capture
from msgs.values.radar import RadarBeam, RadarSetup
from nodes.recording.shapes import Account, counted

TOPICS = ("radar/setup", "radar/beam")


def topics() -> tuple[str, ...]:
    """Return the topics that have a place in this format."""
    return TOPICS


def write(
    reader: RecordingReader, out: Path, topics: tuple[str, ...], account: Account, advance: Callable[[], None]
) -> None:
    """Write all beams under the recording's first set-up, byte for byte; beams that come late or twice are lost.

    Raises `ValueError` where set-up or beams are missing, beams are not the set-up's, or what was written cannot be
    read again.
    """
    if "radar/beam" not in topics:
        raise ValueError(f"{reader.path}: holds no radar/beam; raw beams are recorded with `bag record --raw`")
    setup = next((each.message for each in reader.messages(("radar/setup",))), None)
    if not isinstance(setup, RadarSetup):
        raise ValueError(f"{reader.path}: holds no readable radar/setup, without which beams are no capture")
    try:
        write_capture(out, setup, _beams(reader, topics, account, advance))
        SigmfCapture.open(out, verify=False)
    except ValueError as error:
        raise ValueError(f"{reader.path}: as SigMF: {error}") from error


def _beams(
    reader: RecordingReader, topics: tuple[str, ...], account: Account, advance: Callable[[], None]
) -> Iterator[RadarBeam]:
    """Beams whose scan and index rise, as a capture wants them; a set-up after the first is left out."""
    last: tuple[int, int] | None = None
    for recorded in counted(reader, topics, account, advance):
        message = recorded.message
        if not isinstance(message, RadarBeam):
            if account.written[recorded.topic] > 1:
                account.leave_out(recorded.topic, "a capture holds one, the first")
            continue
        key = message.scan_id, message.beam_index
        if last is not None and key <= last:
            account.lose(recorded.topic, "late or twice")
            continue
        last = key
        yield message
