"""The plug-in makes a graph of a launch file and knows the topics that it declares."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from msgs.bus.local import LocalBus
from msgs.bus.topics import TOPICS
from msgs.files.shipped import CHECKOUT

if TYPE_CHECKING:
    from mirrorwave.testing.fixtures import MakeGraph

pytest_plugins = ("mirrorwave.testing.fixtures",)
EXAMPLE = CHECKOUT / "examples" / "my_topic"
LAUNCH = """
name: toy
topics: {my/distances: {type: my_distances.Distances}}
nodes: {distances: {module: my_distances, params: {max_distance_m: 5.0}}}
"""


def test_a_graph_of_a_launch_file_has_its_topics(
    bus: LocalBus, graph: MakeGraph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    with pytest.raises(ValueError, match="unknown topic 'my/distances'"):
        bus.subscribe("my/distances")
    path = tmp_path / "toy.yaml"
    path.write_text(LAUNCH)
    graph(path).run(until_ns=1_000_000_000)
    bus.subscribe("my/distances")
    assert list(TOPICS.own()) == ["my/distances"]


def test_what_a_test_declares_ends_with_it() -> None:
    assert "my/distances" not in TOPICS
