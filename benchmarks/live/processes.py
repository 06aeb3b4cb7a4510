"""Processes of a running graph, found by what their command lines name."""

from __future__ import annotations

import os
from pathlib import Path

import psutil


def processes_of(graph: str | Path) -> list[int]:
    """Return every process whose command line names a graph's domain or folder, this one and zombies left out."""
    found = []
    for process in psutil.process_iter(["pid", "cmdline", "status"]):
        names_it = any(str(graph) in part for part in process.info["cmdline"] or ())
        if names_it and process.info["pid"] != os.getpid() and process.info["status"] != psutil.STATUS_ZOMBIE:
            found.append(process.info["pid"])
    return found
