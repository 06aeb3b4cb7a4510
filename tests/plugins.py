"""Packages with entry points, as an installer leaves them: a folder for the module path."""

from __future__ import annotations

from pathlib import Path

#: A node that does nothing.
NODE = """
'''A node of somebody else.'''
import msgspec
from nodes.node import Node

class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    '''Its parameters.'''
    #: Times a second.
    rate_hz: float = 10.0

class Theirs(Node):
    inputs = ("radar/ra_map",)
    outputs = ("vehicle/state",)
    def step(self, inputs, now_ns):
        return []

def create(params):
    return Theirs()
"""


def write_package(folder: Path, package: str, group: str, points: dict[str, str], **modules: str) -> Path:
    """Write a package, version 1.2, with entry points of a group (name -> module) and its modules; returns `folder`."""
    info = folder / f"{package}-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
    lines = [f"{name} = {module}" for name, module in points.items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines, ""]))
    for name, source in modules.items():
        (folder / f"{name}.py").write_text(source)
    return folder
