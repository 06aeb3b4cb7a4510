"""Where the time goes from the command to the first view, and from a node's interpreter to its first step.

`graph`: N launches of a launch file, seconds from the command to each step, medians; the first launch is not counted.
Of a node: *lives*: it says its first word; *made*: its module and what it works with are loaded; *begins*: all nodes
before it are ready; then what it publishes first.
`nodes`: each node made by itself in a fresh interpreter, processor time by step, medians; kernels are those that its
making and a set-up load from numba's cache.

Usage: python -m benchmarks.live.start graph|nodes [--repeats 5] [--launch FILE] [--group PROCESS=NODE,NODE] [--json]
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.live.faults import HEARD, ROOT, Graph, hear_ctrl_c
from msgs.bus.interface import Envelope, Received
from msgs.files.shipped import LAUNCH
from msgs.values.diagnostics import LogRecord, NodeState, NodeStatus
from msgs.values.radar import RadarSetup
from nodes.process.child import NODE_ENVIRONMENT
from nodes.process.launch_file import SUPERVISOR

NODES = ("player", "ra_former", "dense_predictor", "geometry")
SCENE = str(LAUNCH / "scenes" / "facade_across_lane.yaml")


def launch_steps(launch: Path, domain: str, folder: Path, options: list[str]) -> dict[str, float]:
    """Return seconds from the command to each step of one launch, up to the first view."""
    graph, steps = Graph(launch, domain, folder, options=options), dict[str, float]()

    def note(step: str, at_ns: int) -> None:
        steps.setdefault(step, 1e-9 * (at_ns - graph.started_ns))

    def take(received: Received) -> None:
        message, publisher = received.message, received.envelope.publisher
        if isinstance(message, LogRecord) and message.node == SUPERVISOR and " nodes" in message.text:
            note("supervisor runs", message.stamp_ns)
        elif isinstance(message, NodeStatus):
            states = {NodeState.STARTING: "lives", NodeState.READY: "begins"}
            if message.node != SUPERVISOR and message.state in states:
                note(f"{message.node} {states[message.state]}", message.stamp_ns)
                if message.reason == MADE:
                    note(f"{message.node} made", message.stamp_ns)
        elif received.topic in HEARD:
            note(f"{publisher}: {received.topic}", received.envelope.sent_ns)

    try:
        graph.observe()
        graph.wait_for(lambda: any(step.endswith("perception/hidden_objects") for step in steps), take)
    finally:
        graph.stop()
    return steps
