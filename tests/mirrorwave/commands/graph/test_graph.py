"""`mirrorwave graph`: of launch files, of heartbeats, as text, JSON, SVG and DOT."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from xml.etree import ElementTree

import pytest

from mirrorwave.cli import main
from mirrorwave.diagnose.graph_drawing import _boxes, _layout, _positions, dot_text, svg_text
from mirrorwave.diagnose.graph_picture import GraphNode, GraphPicture, Link, launch_picture, layers, text_lines

SVG = "{http://www.w3.org/2000/svg}"


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
    assert svg_text(picture)


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
    assert "a" in svg_text(GraphPicture(title="circle", nodes=circle))


def test_the_drawing_is_xml_and_its_boxes_lie_apart() -> None:
    root = ElementTree.fromstring(svg_text(CHAIN))
    texts = [element.text for element in root.iter(f"{SVG}text")]
    assert {"domain <&>", "player", "radar/ra_map", "no publisher"} <= set(texts)
    assert len([path for path in root.iter(f"{SVG}path") if "lossy" in path.get("class", "")]) == 2
    assert "prefers-color-scheme: dark" in svg_text(CHAIN)
    # it takes the width of where it stands, and keeps its shape
    assert (root.get("width"), root.get("height")) == ("100%", None)
    assert "height: auto" in (root.get("style") or "")
    boxes = [
        tuple(float(rect.get(name, "nan")) for name in ("x", "y", "width", "height"))
        for rect in root.iter(f"{SVG}rect")
    ]
    width, height = (float(side) for side in root.get("viewBox", "0 0 0 0").split()[2:])
    # 28 free around the outer boxes, and a line of title above
    left, above, right, below = zip(
        *((x, y, width - x - wide, height - y - tall) for x, y, wide, tall in boxes), strict=True
    )
    assert (min(left), min(right), min(above)) == pytest.approx((28, 28, 48), abs=0.1)
    assert min(below) >= 28
    for at, (x, y, wide, tall) in enumerate(boxes):
        for other_x, other_y, other_wide, other_tall in boxes[at + 1 :]:
            apart_x = x + wide <= other_x or other_x + other_wide <= x
            apart_y = y + tall <= other_y or other_y + other_tall <= y
            assert apart_x or apart_y


def test_a_reason_with_any_character_does_not_spoil_the_drawing() -> None:
    reason = "\x1b[31m\x00\ud800 </text><script>"
    node = GraphNode(node="a]]>", state="degraded", reason=reason, outputs=(Link(topic="t"),))
    root = ElementTree.fromstring(svg_text(GraphPicture(title="\x07", nodes=(node,))))
    assert "degraded: \ufffd[31m\ufffd\ufffd </text><script>" in [one.text for one in root.iter(f"{SVG}text")]


def test_edges_pass_boxes_at_a_distance() -> None:
    """An edge over several columns has a place of its own in each, half a box away from its neighbours."""
    boxes = _boxes(CHAIN)
    layout = _layout(CHAIN, boxes)
    places, _, _ = _positions(layout, boxes)
    passed = [key for route in layout.routes for key in route[1:-1]]
    assert passed
    for column in layout.columns:
        rows = [places[key].y for key in column]
        assert all(after - before > 20.0 for before, after in itertools.pairwise(rows))


def test_an_empty_picture_is_drawn_too() -> None:
    ElementTree.fromstring(svg_text(GraphPicture(title="", nodes=())))


def test_dot_names_nodes_and_topics() -> None:
    text = dot_text(CHAIN)
    assert '"node former" -> "topic radar/ra_map";' in text
    assert '"topic radar/beam" -> "node former" [label="7 lost", color=red];' in text


def test_files_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    svg, dot = tmp_path / "g.svg", tmp_path / "g.dot"
    words = ["graph", "launch/corner.yaml", "--svg", str(svg), "--dot", str(dot)]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["node"] for row in found["nodes"]} == {"player", "ra_former", "dense_predictor", "geometry"}
    assert next(row for row in found["topics"] if row["topic"] == "radar/ra_map")["publishers"] == ["ra_former"]
    ElementTree.fromstring(svg.read_text())
    assert dot.read_text().startswith("digraph")
    assert main(words) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_quiet_domain_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["graph", "--window", "0.6"]) == 1
    assert "no graph runs in domain 'default'" in capsys.readouterr().err
