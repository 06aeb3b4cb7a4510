"""Output of `mirrorwave bag info`."""

from __future__ import annotations

import json
from typing import Any

from mirrorwave.console import print_line, print_table
from msgs.values.wording import counted


def print_info(contents: Any) -> None:
    """Print the summary of a recording."""
    print_line(f"{contents.path}: {contents.size_bytes / (1 << 20):.1f} MiB, {contents.duration_s:.2f} s")
    complete, checksums = "yes" if contents.complete else "no", "good" if contents.checksums_agree else "bad"
    print_line(f"complete: {complete}, checksums: {checksums}")
    for line in origin_lines(contents.metadata):
        print_line(line)
    if contents.loss:
        print_line(f"loss: {contents.loss}")
    columns = ("TOPIC", "TYPE", "MESSAGES", "BYTES", "HZ", "PUBLISHERS")
    rows = [
        (topic.topic, topic.type or None, topic.messages, topic.bytes, topic.rate_hz, ", ".join(topic.publishers))
        for topic in contents.topics
    ]
    print_table(columns, rows, ("TYPE", "BYTES"))
    _print_losses(contents.losses)


#: Where a recording comes from: of a graph, or of a simulated scene.
_ORIGIN = ("started_utc", "part", "command", "scene", "seed", "effects", "for", "budget_db")


def origin_lines(metadata: dict[str, str]) -> list[str]:
    """Return the recorded origin of a recording, in lines; anybody may have written it, so every field is checked."""
    lines = [f"{key}: {metadata[key]}" for key in _ORIGIN if key in metadata]
    try:
        machine = json.loads(metadata.get("machine", ""))
        lines.append(f"machine: {machine['processor']}, {counted(machine['cores'], 'core')}, {machine['kernel']}")
    except (ValueError, KeyError, TypeError):
        pass
    if "launch" in metadata:
        lines.append("launch file: yes (--config prints it)")
    return lines


def _print_losses(losses: Any) -> None:
    if losses is None:
        return
    if losses.ended:
        print_line(f"ended early: {losses.ended}")
    if not losses.topics:
        print_line("missing messages: none")
        return
    print_line(f"missing messages: {losses.total}")
    rows = [(topic.topic, topic.lost, topic.rejected, topic.outdated, topic.missed) for topic in losses.topics]
    print_table(("TOPIC", "LOST", "REJECTED", "OUTDATED", "NOT WRITTEN"), rows)
