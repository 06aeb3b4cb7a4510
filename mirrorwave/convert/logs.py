"""Logs and captures of others as recordings: `mirrorwave import can` and `mirrorwave import sigmf`.

Provenance goes into the recording's metadata: what the source was called, its SHA-256, what it was read with, and what
the recording's times mean. A recording that could not be finished is removed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from msgs.files.checksums import file_sha256
from msgs.files.text_files import read_text
from msgs.recording.clock_steps import Bridged
from msgs.recording.mcap import RecordingReader, whole_recording
from msgs.values.units import ns_from_s


class CanSource(msgspec.Struct, frozen=True, kw_only=True):
    """A log and what to read it with."""

    log: Path
    dbc: Path
    mapping: Path
    #: Only frames of this channel; None: all.
    channel: str | None = None
    #: Stamp that the first frame is given; None: stamps as in the log.
    start_ns: int | None = None

    def __post_init__(self) -> None:
        if self.start_ns is not None and self.start_ns < 0:
            raise ValueError(f"--start-ns must not be negative, got {self.start_ns}")


def import_can(source: CanSource, out: Path) -> dict[str, Any]:
    """Write the vehicle states of a log to the new recording `out`; returns counts, and `loss` where the log broke off.

    Raises `ValueError` where the log cannot be read at all, or gives not one valid state with this DBC and mapping.
    """
    from mirrorwave.convert.can_log import log_states
    from nodes.can.bus import load_decoder
    from nodes.can.log_file import on_one_clock, read_log

    decoder = load_decoder(source.dbc, source.mapping)
    frames = _Shifted(on_one_clock(read_log(source.log, source.channel)), source.start_ns)
    counts = {"states": 0, "valid_states": 0}
    reason = ""
    with whole_recording(out, _can_provenance(source)) as writer:
        for step in log_states(decoder, frames):
            for state in step.states:
                writer.write("vehicle/state", state, publisher="vehicle_can", sent_ns=state.stamp_ns)
                counts["states"] += 1
                counts["valid_states"] += state.valid
                reason = state.reason
        if frames.count == 0:
            raise ValueError(frames.loss or f"{source.log}: holds no frames")
        if not counts["valid_states"]:
            raise ValueError(f"{source.log}: gives no valid state with {source.dbc} and {source.mapping}: {reason}")
    verdicts = {str(verdict): count for verdict, count in sorted(decoder.counts.items())}
    return {"frames": frames.count, **counts, "frames_by_verdict": verdicts, "loss": frames.loss or None}


class _Shifted:
    """Frames of a log, the first at `start_ns`; one that cannot be read on leaves its reason in `loss`."""

    def __init__(self, frames: Iterator[Any], start_ns: int | None) -> None:
        self._frames, self._start_ns = frames, start_ns
        self.count = 0
        self.loss = ""

    def __iter__(self) -> Iterator[Any]:
        shift_ns = 0
        first = True
        try:
            for frame in self._frames:
                self.count += 1
                if frame.stamp_ns >= 0 and first:
                    first = False
                    shift_ns = 0 if self._start_ns is None else self._start_ns - frame.stamp_ns
                yield frame._replace(stamp_ns=frame.stamp_ns + shift_ns if frame.stamp_ns >= 0 else frame.stamp_ns)
        except ValueError as error:
            self.loss = str(error)


def import_sigmf(path: Path, out: Path, advance: Callable[[], None]) -> dict[str, Any]:
    """Write set-up and beams of a SigMF capture, and the truth beside it, to the new recording `out`.

    `advance` is called after each beam. Raises `ValueError` naming file, field and rule where the capture
    does not fit.
    """
    from msgs.recording.sigmf import SigmfCapture, capture_paths
    from nodes.player import truth_beside

    capture = SigmfCapture.open(path)
    meta, data = capture_paths(path)
    counts = {"beams": 0, "truth": 0}
    with whole_recording(out, _sigmf_provenance(meta, data)) as writer:
        # in the order of measurement, whatever the clock did: a reader goes by the time of sending
        for beam, time_ns in Bridged(capture.beams(), lambda beam: beam.stamp_ns, f"{path}: the clock", noun="beam"):
            if not counts["beams"]:
                writer.write("radar/setup", capture.setup, publisher="import", sent_ns=time_ns)
            # sent when it has been measured, and so after the set-up
            sent_ns = time_ns + ns_from_s(capture.setup.radar.beam_duration_s)
            writer.write("radar/beam", beam, publisher="import", sent_ns=sent_ns)
            counts["beams"] += 1
            advance()
        if (truth := truth_beside(path)).is_file():
            with RecordingReader(truth) as reader:
                for each in reader.messages(("sim/truth",)):
                    stamp_ns: int = getattr(each.message, "stamp_ns", each.log_time_ns)
                    writer.write(each.topic, each.message, publisher="import", sent_ns=max(0, stamp_ns))
                    counts["truth"] += 1
    return counts


def _can_provenance(source: CanSource) -> dict[str, str]:
    time_base = "stamps of the log" if source.start_ns is None else f"first frame at {source.start_ns} ns"
    files = {"source": source.log, "dbc": source.dbc, "mapping": source.mapping}
    return {
        "import": "can",
        **{name: path.name for name, path in files.items()},
        **{f"{name}_sha256": file_sha256(path) for name, path in files.items()},
        "channel": source.channel or "all",
        "time_base": time_base,
    }


def _sigmf_provenance(meta: Path, data: Path) -> dict[str, str]:
    return {
        "import": "sigmf",
        "source": meta.name,
        "source_sha256": file_sha256(meta),
        "data_sha256": file_sha256(data),
        "sigmf_global": json.dumps(json.loads(read_text(meta))["global"]),
        "time_base": "stamps of the capture",
    }
