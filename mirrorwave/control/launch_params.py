"""Check parameters given on the command line, and the topics of a launch file, before a graph starts.

The modules of nodes are loaded by another process, which ends: the launcher stays small.
"""

from __future__ import annotations

import json
import os
import select
import sys
from collections.abc import Iterable

import msgspec

from nodes.process.fork_server import START_TIMEOUT_S, ForkServer, environment, spawn
from nodes.process.launch_file import LaunchFile

_MODULE = "mirrorwave.control.launch_params"


def require_params(
    graph: LaunchFile, given: Iterable[tuple[str, str]], server: ForkServer | None, where: str = "launch file"
) -> None:
    """Raise `ValueError` where a node refuses its parameters, or a topic cannot be what the launch file declares.

    `given`: the node that each option names, and the option as it was given, which begins the error. `where`: the
    launch file, for its topics.
    """
    options = dict(given)
    if not (options or graph.topics):
        return
    nodes = {name: {"module": graph.nodes[name].module, "params": graph.nodes[name].params} for name in options}
    asked = {"nodes": nodes, "topics": msgspec.to_builtins(graph.topics), "where": where}
    for name, reason in _refusals(json.dumps(asked), server).items():
        raise ValueError(f"{options[name]}: {reason}" if name in options else reason)


def _refusals(asked: str, server: ForkServer | None) -> dict[str, str]:
    """Return the reason of each node, and of each `topics.NAME`, that is refused.

    None where the process that asks them fails: the graph will tell.
    """
    read_end, write_end = os.pipe()
    with open(os.devnull, "rb") as nothing:
        pid = None
        if server is not None:
            # without it the graph could not start either
            select.select([server], [], [], START_TIMEOUT_S)
            server.look()
            pid = server.fork([_MODULE, asked], nothing.fileno(), write_end)
        if pid is None:
            pid = spawn([_MODULE, asked], environment({}), nothing.fileno(), write_end)
    os.close(write_end)
    with open(read_end, encoding="utf-8", errors="replace") as answer:
        lines = answer.read().splitlines()
    os.waitpid(pid, 0)
    try:
        return dict(json.loads(lines[-1]))
    except (IndexError, ValueError):
        return {}


def main(argv: list[str] | None = None) -> int:
    """Print the reasons of the nodes and topics that are refused as the last line, JSON."""
    from msgs.bus.topics import TOPICS, Declaration
    from nodes.node import node_module
    from nodes.process.validation import convert_at

    asked = json.loads((sys.argv[1:] if argv is None else argv)[0])
    topics = msgspec.convert(asked["topics"], dict[str, Declaration])
    for name, declaration in topics.items():
        TOPICS.expect(name, declaration, asked["where"])
    # all: what packages declare must agree with it
    known = set(TOPICS) if topics else set()
    refused = {f"topics.{name}": TOPICS.refused[name] for name in topics if name not in known or name in TOPICS.refused}
    for name, node in asked["nodes"].items():
        try:
            module = node_module(node["module"], name)
            params = convert_at(node["params"], module.Params, f"{name}.params")
            # what a file must hold, without starting anything
            getattr(module, "check", lambda params: None)(params)
        except ValueError as error:
            refused[name] = str(error)
    sys.stdout.write(f"\n{json.dumps(refused)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
