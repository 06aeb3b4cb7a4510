"""Check parameters given on the command line against what their nodes take, before a graph starts.

The modules of nodes are loaded by another process, which ends: the launcher stays small.
"""

from __future__ import annotations

import json
import os
import select
import sys
from collections.abc import Iterable

from nodes.process.fork_server import START_TIMEOUT_S, ForkServer, environment, spawn
from nodes.process.launch_file import LaunchFile

_MODULE = "mirrorwave.control.launch_params"


def require_params(graph: LaunchFile, given: Iterable[tuple[str, str]], server: ForkServer | None) -> None:
    """Raise `ValueError` where a node refuses its parameters: for an unknown key, a value of a wrong type or a limit.

    `given`: the node that each option names, and the option as it was given, which begins the error.
    """
    options = dict(given)
    nodes = {name: {"module": graph.nodes[name].module, "params": graph.nodes[name].params} for name in options}
    for name, reason in _refusals(json.dumps(nodes), server).items() if nodes else ():
        raise ValueError(f"{options[name]}: {reason}")


def _refusals(nodes: str, server: ForkServer | None) -> dict[str, str]:
    """Return the reason of each node that refuses; none where the process that asks them fails: the graph will tell."""
    read_end, write_end = os.pipe()
    with open(os.devnull, "rb") as nothing:
        pid = None
        if server is not None:
            # without it the graph could not start either
            select.select([server], [], [], START_TIMEOUT_S)
            server.look()
            pid = server.fork([_MODULE, nodes], nothing.fileno(), write_end)
        if pid is None:
            pid = spawn([_MODULE, nodes], environment({}), nothing.fileno(), write_end)
    os.close(write_end)
    with open(read_end, encoding="utf-8", errors="replace") as answer:
        lines = answer.read().splitlines()
    os.waitpid(pid, 0)
    try:
        return dict(json.loads(lines[-1]))
    except (IndexError, ValueError):
        return {}


def main(argv: list[str] | None = None) -> int:
    """Print the reasons of the nodes that refuse as the last line, JSON."""
    from nodes.node import node_module
    from nodes.process.validation import convert_at

    refused = {}
    for name, node in json.loads((sys.argv[1:] if argv is None else argv)[0]).items():
        try:
            convert_at(node["params"], node_module(node["module"], name).Params, f"{name}.params")
        except ValueError as error:
            refused[name] = str(error)
    sys.stdout.write(f"\n{json.dumps(refused)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
