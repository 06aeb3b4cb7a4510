"""Launch files: each class of error names file, field and rule; overrides; what is dumped reads back the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from nodes.node import load_node
from nodes.process.launch_file import (
    MAX_BYTES,
    LaunchFile,
    Restart,
    dump_launch,
    launch_from_mapping,
    parse_yaml,
    processes,
    read_launch_file,
    read_yaml_mapping,
    start_order,
    stop_order,
    with_origin,
    with_overrides,
    with_params,
    with_process,
    with_recorder,
    without_viewers,
)


def _launch(**nodes: dict) -> LaunchFile:
    entries = {name: {"module": f"nodes.{name}", **entry} for name, entry in nodes.items()}
    return launch_from_mapping({"name": "corner", "nodes": entries}, "corner.yaml")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"nodes": {"a": {"module": 3}}}, r"corner\.yaml: nodes\.a\.module: Expected str, got int"),
        (
            {"nodes": {"a": {"module": "nodes.a", "parms": {}}}},
            r"corner\.yaml: nodes\.a: .*field parms; known are module, params",
        ),
        ({"nodes": {"a": {"module": "../a"}}}, r"nodes\.a: module must be a dotted module name, got '\.\./a'"),
        ({"nodes": {"A b": {"module": "nodes.a"}}}, r"nodes\.A b: a node's name must be of a-z, 0-9 and _"),
        ({"nodes": {"supervisor": {"module": "nodes.a"}}}, "belongs to the supervisor"),
        ({"nodes": {"a": {"module": "nodes.a", "after": ["b"]}}}, r"nodes\.a\.after: unknown node 'b'; known are a"),
        ({"nodes": {"a": {"module": "nodes.a", "after": ["a"]}}}, "after makes a cycle among a"),
        ({"nodes": {"a": {"module": "nodes.a", "restart": {"policy": "maybe"}}}}, r"restart\.policy: .*'maybe'"),
        ({"nodes": {"a": {"module": "nodes.a", "restart": {"delay_s": -1}}}}, "delay_s must be finite and not neg"),
        ({"nodes": {"a": {"module": "nodes.a", "hang_timeout_s": 0}}}, "hang_timeout_s must be above zero"),
        ({"nodes": {}}, "nodes must name at least one node"),
        ({"nodes": []}, r"corner\.yaml: nodes: Expected object, got array"),
        ({"nodes": {"a": {"module": "nodes.a"}}, "name": "../x"}, "name must be of a-z"),
        ({"nodes": {"a": {"module": "nodes.a"}}, "name": 3}, r"^corner\.yaml: name: Expected str, got int$"),
        (
            {"nodes": {"a": {"module": "nodes.a"}}, "colour": 1},
            r"^corner\.yaml: .*colour; known are name, nodes, topics$",
        ),
    ],
)
def test_errors_name_the_field_and_the_rule(fields: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        launch_from_mapping({"name": "corner", **fields}, "corner.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2", "line 2, column 1: duplicate key 'a'"),
        ("a: b: c", "line 1"),
        ("!!python/object:os.system {}", "tags are refused"),
        ("a: !!bool x", "line 1, column 4: tags are refused"),
        ("1: 2", "key 1 must be text"),
        ("\x00", "unacceptable character"),
    ],
)
def test_yaml_is_read_strictly(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_yaml(text, "f.yaml")


def test_a_path_on_the_command_line_keeps_its_bytes() -> None:
    assert parse_yaml("{a: [/k\udcfc/x.mcap, 1, \u00fc]}", "-p a") == {"a": ["/k\udcfc/x.mcap", 1, "\u00fc"]}


def test_files_are_bounded_in_size(tmp_path: Path) -> None:
    path = tmp_path / "big.yaml"
    path.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(ValueError, match="at most"):
        read_yaml_mapping(path)


def test_overrides_reach_into_params_and_later_ones_win() -> None:
    launch = _launch(a={"params": {"deep": {"x": 1, "y": 2}}})
    launch = with_params(launch, {"a": {"deep": {"x": 5}, "z": 0}}, "p.yaml")
    launch = with_overrides(launch, ["a.deep.x=6", "a.deep.x=7", "a.s='7'"])
    assert launch.nodes["a"].params == {"deep": {"x": 7, "y": 2}, "z": 0, "s": "7"}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("b.x=1", "unknown node 'b'; known are a"),
        ("a=1", "expected node.key=value"),
        ("a.x", "expected node.key=value"),
        ("a..x=1", "expected node.key=value"),
        ("a.x={", "-p a.x={: line"),
    ],
)
def test_wrong_overrides_are_refused(override: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        with_overrides(_launch(a={}), [override])


def test_order_of_start_and_stop() -> None:
    launch = _launch(player={"after": ["former", "geometry"]}, former={}, geometry={})
    assert start_order(launch) == ("former", "geometry", "player")
    assert stop_order(launch) == ("player", "former", "geometry")
    recorded = with_recorder(launch, Path("out.mcap"))
    assert start_order(recorded)[0] == stop_order(recorded)[-1] == "recorder"


def test_nodes_that_name_a_process_share_it() -> None:
    launch = with_process(
        _launch(player={"after": ["former", "geometry"]}, former={}, geometry={}), "back=former,geometry"
    )
    graph = processes(launch)
    assert list(graph) == ["back", "player"]
    assert graph["back"].module == "nodes.process.group"
    assert list(graph["back"].params) == ["former", "geometry"]
    assert graph["player"].after == ("back",)
    assert graph["player"] is not launch.nodes["player"]
    assert stop_order(launch) == ("player", "back")


@pytest.mark.parametrize(
    ("nodes", "rule"),
    [
        ({"a": {"process": "X"}}, "nodes.a.process must be of a-z, 0-9 and _"),
        ({"a": {"process": "supervisor"}}, "and not supervisor"),
        ({"a": {"process": "b"}, "b": {}}, "node 'b' has a process of this name and is not in it"),
        ({"a": {"process": "p", "module": "nodes.recorder"}}, "a recorder has a process of its own"),
        ({"a": {"process": "p"}, "b": {"process": "p", "env": {"X": "1"}}}, "restart and env must be those of b"),
        ({"a": {"process": "p"}, "b": {"process": "p", "restart": {"policy": "never"}}}, "restart and env must be"),
        ({"a": {"process": "p", "after": ["b"]}, "b": {"after": ["c"]}, "c": {"process": "p"}}, "cycle among p, b"),
    ],
)
def test_processes_that_cannot_be_are_refused(nodes: dict[str, dict], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        _launch(**nodes)


@pytest.mark.parametrize(
    ("group", "rule"),
    [
        ("p", "expected process=node,node"),
        ("=a", "expected process"),
        ("p=x", "unknown node 'x'"),
        ("p=", "unknown node ''"),
    ],
)
def test_wrong_groups_are_refused(group: str, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        with_process(_launch(a={}), group)


def test_headless_leaves_viewers_out() -> None:
    launch = without_viewers(_launch(viewer={"viewer": True}, a={"after": ["viewer"]}))
    assert list(launch.nodes) == ["a"]
    assert launch.nodes["a"].after == ()


def test_recorders_are_told_their_origin_and_wrong_metadata_is_left_to_them() -> None:
    params: dict = {"path": "a.mcap", "metadata": {"driver": "x"}}
    launch = _launch(a={"module": "nodes.recorder", "params": params})
    told = with_origin(launch, "mirrorwave launch", Path("/run")).nodes["a"].params
    assert told["metadata"] == {"launch": told["metadata"]["launch"], "command": "mirrorwave launch", "driver": "x"}
    wrong = _launch(a={"module": "nodes.recorder", "params": {**params, "metadata": [1]}})
    assert with_origin(wrong, "mirrorwave launch", Path("/run")).nodes["a"].params["metadata"] == [1]


def test_a_dumped_launch_file_reads_back_equal(tmp_path: Path) -> None:
    shared = {"k": 1}
    odd = {"a": "1e5", "b": "017", "c": "null", "d": "off", "e": -float("inf"), "f": 1e22, "g": shared, "h": shared}
    launch = _launch(a={"params": odd, "env": {"X": "1"}}, b={"after": ["a"], "restart": {"policy": "never"}})
    path = tmp_path / "l.yaml"
    path.write_text(dump_launch(launch))
    assert read_launch_file(path) == launch


def test_back_off_doubles_up_to_its_limit() -> None:
    restart = Restart(delay_s=0.2, max_delay_s=1.0)
    assert [restart.backoff_s(count) for count in (0, 1, 2, 3, 4, 5000)] == [0.0, 0.2, 0.4, 0.8, 1.0, 1.0]


def test_a_field_whose_name_has_several_lines_is_refused_in_one() -> None:
    with pytest.raises(ValueError, match=r"^lidar_former\.params: Object contains unknown field a b$"):
        load_node("nodes.lidar_former", {"a\nb": 1})
