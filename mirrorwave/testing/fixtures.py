"""pytest plug-in: fixtures `bus` and `graph` for tests of one's own nodes, in one process on a virtual clock.

pytest loads it wherever mirrorwave is installed, so it imports nothing but pytest before a fixture is used.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from msgs.bus.local import LocalBus, LocalNetwork
    from nodes.node import InProcessGraph, Node


@pytest.fixture
def mirrorwave_network() -> Iterator[LocalNetwork]:
    """Network of `bus` and `graph`; its clock begins at 0. Topics that a test declares end with the test."""
    from msgs.bus.local import LocalNetwork
    from msgs.bus.topics import TOPICS

    with TOPICS.restored():
        yield LocalNetwork()


@pytest.fixture
def bus(mirrorwave_network: LocalNetwork) -> Iterator[LocalBus]:
    """Connection of the test to the graph: `subscribe(topic)`, `publish(topic, message)`, `receive(0.0)`."""
    connection = mirrorwave_network.bus("test")
    yield connection
    connection.close()


class MakeGraph:
    """Makes graphs on the network of a test: of nodes by name, or those of a launch file."""

    def __init__(self, network: LocalNetwork, stack: ExitStack) -> None:
        self._network, self._stack = network, stack

    def __call__(self, launch_file: Path | str | None = None, **nodes: Node) -> InProcessGraph:
        """Return the graph; `run()` steps its nodes until none has work, or up to a virtual time in nanoseconds.

        Raises `ValueError` as a launch does, for a file, a node or a topic that cannot be.
        """
        from nodes.node import InProcessGraph, load_node
        from nodes.process.launch_file import expect_topics, read_launch_file, start_order

        made: dict[str, Node] = {}
        if launch_file is not None:
            launch = read_launch_file(Path(launch_file))
            expect_topics(launch, str(launch_file))
            for name in start_order(launch):
                made[name] = load_node(launch.nodes[name].module, launch.nodes[name].params, name)
        graph = InProcessGraph(self._network, made | nodes)
        self._stack.callback(graph.close)
        return graph


@pytest.fixture
def graph(mirrorwave_network: LocalNetwork) -> Iterator[MakeGraph]:
    """Make a graph: `graph(name=node)` or `graph("launch.yaml")`; it is closed with the test."""
    with ExitStack() as stack:
        yield MakeGraph(mirrorwave_network, stack)
