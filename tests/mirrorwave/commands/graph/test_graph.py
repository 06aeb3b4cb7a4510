"""`mirrorwave graph`: of launch files, of heartbeats, as text, JSON and DOT."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mirrorwave.cli import main
from mirrorwave.diagnose.graph_picture import (
    GraphNode,
    GraphPicture,
    Link,
    dot_text,
    launch_picture,
    layers,
    text_lines,
)

pytestmark = pytest.mark.usefixtures("quiet_domain")


def node(name: str, inputs: str = "", outputs: str = "", state: str = "ready", lost: int = 0) -> GraphNode:
    return GraphNode(
        node=name,
        state=state,
        inputs=tuple(Link(topic=topic, hz=3.3, lost=lost) for topic in inputs.split()),
        outputs=tuple(Link(topic=topic, hz=3.3) for topic in outputs.split()),
    )


CHAIN = GraphPicture(
    title="domain <&>",
    nodes=(
        node("player", "", "radar/beam radar/setup"),
        node("former", "radar/beam radar/setup", "radar/ra_map", lost=7),
        node("predictor", "radar/ra_map radar/setup", "perception/peaks"),
        node("geometry", "perception/peaks vehicle/state", "perception/hidden_objects", state="silent"),
    ),
)


def test_a_launch_file_is_read_and_nothing_is_started() -> None:
    picture = launch_picture(Path("launch/corner_can_out.yaml"))
    names = [each.node for each in picture.nodes]
    assert names.index("player") < names.index("ra_former") < names.index("dense_predictor") < names.index("can_out")
    assert picture.publishers("radar/ra_map") == ["ra_former"]
    assert "dense_predictor" in picture.readers("radar/ra_map")
    assert not {"log", "diagnostics/node"} & set(picture.topics())


def test_what_a_recorder_reads_is_in_its_parameters(tmp_path: Path) -> None:
    path = tmp_path / "l.yaml"
    path.write_text("name: x\nnodes: {rec: {module: nodes.recorder, params: {path: a.mcap, topics: [sim/truth]}}}")
    assert [link.topic for link in launch_picture(path).nodes[0].inputs] == ["sim/truth"]
    assert not (tmp_path / "a.mcap").exists()


def test_what_a_link_carries_is_in_its_parameters() -> None:
    picture = launch_picture(Path("launch/two_hosts_compute.yaml"))
    assert picture.publishers("radar/ra_map") == ["link"]
    assert "link" in picture.readers("perception/hidden_objects")
    assert [node.node for node in picture.nodes][:3] == ["link", "dense_predictor", "geometry"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("name: x\nnodes: {a: {module: nodes.nothing}}", "a.module: no module named 'nodes.nothing'"),
        ("name: x\nnodes: {a: {module: nodes.process.child}}", "a.module: nodes.process.child is no node"),
        ("name: x\nnodes: {a: {module: nodes.geometry, params: {nope: 1}}}", "nope"),
        ("", "expected a mapping"),
    ],
)
def test_a_launch_file_that_does_not_fit_is_one_line(
    text: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "l.yaml"
    path.write_text(text)
    assert main(["graph", str(path)]) == 2
    error = capsys.readouterr().err
    assert reason in error
    assert error.count("\n") == 1


def test_the_text_says_who_reads_what_and_who_is_missing() -> None:
    text = "\n".join(text_lines(CHAIN))
    assert "radar/setup -> former, predictor" in text
    assert "vehicle/state <- NO PUBLISHER" in text
    assert "perception/hidden_objects -> nobody reads it" in text
    assert "radar/beam <- player  (3.3 Hz, 7 LOST)" in text
    assert "geometry [silent]" in text


def test_layers_count_from_the_sources_and_circles_end() -> None:
    assert layers(CHAIN.nodes) == {"player": 0, "former": 1, "predictor": 2, "geometry": 3}
    circle = (node("a", "sim/truth", "radar/beam"), node("b", "radar/beam", "sim/truth"))
    assert sorted(layers(circle)) == ["a", "b"]


def test_dot_names_nodes_and_topics() -> None:
    text = dot_text(CHAIN)
    assert '"node former" -> "topic radar/ra_map";' in text
    assert '"topic radar/beam" -> "node former" [label="7 lost", color=red];' in text
    assert '"topic radar/beam" [shape=ellipse, label="radar/beam\\n3.3 Hz"];' in text
    assert '"topic vehicle/state" [shape=ellipse, label="vehicle/state\\nno publisher", color=red];' in text
    assert '"node geometry" [shape=box, label="geometry\\nsilent", color=red];' in text
    quoted = GraphNode(node='a"b', state="degraded", reason="c\\d")
    assert '"node a\\"b" [shape=box, label="a\\"b\\ndegraded: c\\\\d", color=red];' in dot_text(
        GraphPicture(title="", nodes=(quoted,))
    )


def test_files_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dot = tmp_path / "g.dot"
    words = ["graph", "launch/corner.yaml", "--dot", str(dot)]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["node"] for row in found["nodes"]} == {"player", "ra_former", "dense_predictor", "geometry"}
    assert next(row for row in found["topics"] if row["topic"] == "radar/ra_map")["publishers"] == ["ra_former"]
    assert dot.read_text().startswith("digraph")
    assert main(words) == 2
    assert "exists already" in capsys.readouterr().err
