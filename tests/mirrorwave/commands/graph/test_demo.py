"""The demo's launch file; `docs/guides/watch-a-graph.md` runs the demo itself."""

from __future__ import annotations

from mirrorwave.commands.graph.demo import DEMO_LAUNCH
from nodes.process.launch_file import VIEWER_MODULE, read_launch_file


def test_the_demo_finds_its_launch_file() -> None:
    modules = {entry.module for entry in read_launch_file(DEMO_LAUNCH).nodes.values()}
    assert {"nodes.player", "nodes.geometry", VIEWER_MODULE} <= modules
