"""`mirrorwave import sensors`: clouds of a LiDAR and images of a camera as a recording, beside or without a radar's."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from contrib.imports.recorded_sensors import SideParams, SideSources, without_position
from mirrorwave.convert.formats import Bar
from msgs.bus.topics import SIDE_TOPICS
from msgs.files.checksums import file_sha256
from msgs.recording.mcap import whole_recording
from msgs.values.lidar import LidarPoints
from msgs.values.wording import counted


def import_sensors(params: SideParams, out: Path, bar: Bar) -> dict[str, Any]:
    """Write all clouds and images of the sources to the new recording `out`; returns counts.

    `refused` has a line for each cloud and image that cannot be read, `loss` says why a bag ended early, `notes` what
    else is odd. Raises `ValueError` naming the sources where nothing can be read, `ImportError` without rosbags.
    """
    refused: list[str] = []
    counts: Counter[str] = Counter()
    missing = clouds_with_missing = 0
    sources = SideSources(params, lambda kind, error: refused.append(f"{kind} left out: {error}"))
    try:
        with whole_recording(out, _provenance(params)) as writer, bar("messages", sources.total or None) as advance:
            for (_, outgoing), time_ns in sources.events():
                topic, message = outgoing
                sent_ns = max(0, time_ns)
                writer.write(topic, message, publisher="import", sequence=counts[topic], sent_ns=sent_ns)
                counts[topic] += 1
                if isinstance(message, LidarPoints) and (without := without_position(message)):
                    missing, clouds_with_missing = missing + without, clouds_with_missing + 1
                advance()
            if not counts:
                reasons = "; ".join([*refused[:1], *filter(None, [sources.loss])]) or "none is there"
                raise ValueError(f"{', '.join(params.sources)}: gives no cloud and no image: {reasons}")
        loss = sources.loss
    finally:
        sources.close()
    where = counted(clouds_with_missing, "cloud")
    notes = [f"{counted(missing, 'point')} of {where} have no position and are kept"] if missing else []
    clouds, images = (counts[topic] for topic in SIDE_TOPICS)
    return {"clouds": clouds, "images": images, "refused": refused, "notes": notes, "loss": loss or None}


def _provenance(params: SideParams) -> dict[str, str]:
    paths = [Path(source) for source in params.sources]
    sums = {f"sha256 of {path.name}": file_sha256(path) for path in paths if path.is_file()}
    sources = ", ".join(path.name for path in paths)
    return {"import": "sensors", "source": sources, **sums, "time_base": "stamps of the sources"}
