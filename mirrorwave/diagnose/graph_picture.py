"""Nodes and topics of a graph: of a running one by its sockets and heartbeats, or of a launch file by declaration.

Of a launch file nothing is started: inputs and outputs are those that the nodes' classes declare.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from msgs.bus.topics import ABOUT_NODES, TOPICS
from msgs.values.wording import counted

if TYPE_CHECKING:
    from nodes.process.launch_file import LaunchFile, NodeEntry


class Link(msgspec.Struct, frozen=True, kw_only=True):
    """A topic at one node: as it reads it or as it publishes it; figures None where nothing was measured."""

    topic: str
    hz: float | None = None
    #: Messages lost on the way or unreadable, as the reader counts them.
    lost: int = 0


class GraphNode(msgspec.Struct, frozen=True, kw_only=True):
    """A node of the graph; `state` is "declared" where it comes from a launch file."""

    node: str
    state: str
    reason: str = ""
    module: str = ""
    inputs: tuple[Link, ...] = ()
    outputs: tuple[Link, ...] = ()


class GraphPicture(msgspec.Struct, frozen=True, kw_only=True):
    """A graph: its nodes, sources first."""

    title: str
    nodes: tuple[GraphNode, ...]

    def topics(self) -> list[str]:
        """Topics of all nodes, in the order of the topic table."""
        used = {link.topic for node in self.nodes for link in (*node.inputs, *node.outputs)}
        return [*(topic for topic in TOPICS if topic in used), *sorted(used - set(TOPICS))]

    def publishers(self, topic: str) -> list[str]:
        """Nodes that publish a topic."""
        return [node.node for node in self.nodes if any(link.topic == topic for link in node.outputs)]

    def readers(self, topic: str) -> list[str]:
        """Nodes that read a topic."""
        return [node.node for node in self.nodes if any(link.topic == topic for link in node.inputs)]

    def as_dict(self) -> dict[str, Any]:
        """Everything, as JSON has it."""
        topics = [
            {
                "topic": topic,
                "nominal_hz": (TOPICS[topic].rate_hz or None) if topic in TOPICS else None,
                "publishers": self.publishers(topic),
                "readers": self.readers(topic),
            }
            for topic in self.topics()
        ]
        return {"title": self.title, "nodes": msgspec.to_builtins(self.nodes), "topics": topics}


def running_picture(domain: str, window_s: float) -> GraphPicture:
    """The running graph of a domain; raises `ConnectionError` where none runs."""
    from mirrorwave.commands.graph.nodes import collect_heartbeats, topic_rows
    from mirrorwave.diagnose.running_graph import no_graph
    from msgs.bus.zmq import list_publishers, run_dir
    from msgs.values.diagnostics import NodeState
    from nodes.viewer.node_table import is_of_peer

    advertised = list_publishers(run_dir(domain))
    # a peer's nodes meet elsewhere: what comes of them is published here by a link
    heard = {
        name: beats for name, beats in collect_heartbeats(run_dir(domain), window_s).items() if not is_of_peer(name)
    }
    rows = {name: topic_rows(beats) for name, beats in heard.items() if beats[-1].state is not NodeState.STOPPING}
    if not rows and not advertised:
        raise no_graph(domain)
    nodes = []
    for name in sorted({*rows, *(node for _, node in advertised)}):
        state, reason = (heard[name][-1].state, heard[name][-1].reason) if name in rows else ("silent", "no heartbeat")
        opened = {topic for topic, node in advertised if node == name}
        outputs = {topic: Link(topic=topic) for topic in opened} | {
            link.topic: link for link in _links(rows.get(name, []), "out")
        }
        inputs = {link.topic: link for link in _links(rows.get(name, []), "in")}
        nodes.append(_node(name, str(state), reason, inputs, outputs))
    # the supervisor reads heartbeats only; it belongs in the picture when it has something to say
    shown = [node for node in nodes if node.inputs or node.outputs or node.reason]
    return GraphPicture(title=f"domain {domain}", nodes=_sources_first(shown))


def launch_picture(path: Path) -> GraphPicture:
    """The graph of a launch file as its nodes' classes declare it; ValueError as from `launch`."""
    from nodes.process.launch_file import expect_topics, read_launch_file

    launch: LaunchFile = read_launch_file(path)
    expect_topics(launch, str(path))
    nodes = []
    for name, entry in launch.nodes.items():
        inputs, outputs = _declared(name, entry)
        links = [{topic: Link(topic=topic) for topic in topics} for topics in (inputs, outputs)]
        node = _node(name, "declared", "", links[0], links[1])
        nodes.append(msgspec.structs.replace(node, module=entry.module))
    return GraphPicture(title=str(path), nodes=_sources_first(nodes))


def text_lines(picture: GraphPicture) -> list[str]:
    """The graph for people: each node, what it reads and from whom, what it publishes and for whom."""
    lines = [f"{picture.title}: {counted(len(picture.nodes), 'node')}, {counted(len(picture.topics()), 'topic')}"]
    for node in picture.nodes:
        state = "" if node.state == "declared" else f" [{node.state}{': ' + node.reason if node.reason else ''}]"
        lines += ["", f"{node.node}{state}"]
        arrows = [(link, "<-", picture.publishers(link.topic), "NO PUBLISHER") for link in node.inputs]
        arrows += [(link, "->", picture.readers(link.topic), "nobody reads it") for link in node.outputs]
        for at, (link, arrow, peers, nobody) in enumerate(arrows):
            branch = "`-" if at == len(arrows) - 1 else "|-"
            parts = ([] if link.hz is None else [f"{link.hz:.3g} Hz"]) + ([f"{link.lost} LOST"] if link.lost else [])
            figures = f"  ({', '.join(parts)})" if parts else ""
            lines.append(f"  {branch} {link.topic} {arrow} {', '.join(peers) or nobody}{figures}")
    return lines


def dot_text(picture: GraphPicture) -> str:
    """The graph in Graphviz's language: nodes as boxes, topics as ellipses, silent and missing parts in red."""
    lines = ["digraph mirrorwave {", "  rankdir=LR;", '  node [fontname="sans-serif"];']
    for node in picture.nodes:
        small = node.module or (f"{node.state}: {node.reason}" if node.reason else node.state)
        red = ", color=red" if node.state in ("silent", "degraded", "stopping") else ""
        lines.append(f"  {_quoted(f'node {node.node}')} [shape=box, label={_quoted(node.node, small)}{red}];")
    for topic in picture.topics():
        rates = [link.hz for node in picture.nodes for link in node.outputs if link.topic == topic and link.hz]
        absent = not picture.publishers(topic)
        small = "no publisher" if absent else f"{sum(rates):.3g} Hz" if rates else ""
        red = ", color=red" if absent else ""
        lines.append(f"  {_quoted(f'topic {topic}')} [shape=ellipse, label={_quoted(topic, small)}{red}];")
    for node in picture.nodes:
        name = _quoted(f"node {node.node}")
        lines += [f"  {name} -> {_quoted(f'topic {link.topic}')};" for link in node.outputs]
        for link in node.inputs:
            label = f" [label={_quoted(f'{link.lost} lost')}, color=red]" if link.lost else ""
            lines.append(f"  {_quoted(f'topic {link.topic}')} -> {name}{label};")
    return "\n".join([*lines, "}", ""])


def _quoted(*lines: str) -> str:
    plain = [line.replace("\\", "\\\\").replace('"', '\\"') for line in lines if line]
    return '"' + "\\n".join(plain) + '"'


def _links(rows: list[dict[str, Any]], direction: str) -> list[Link]:
    return [
        Link(topic=row["topic"], hz=row["hz"], lost=row["lost"] + row["rejected"])
        for row in rows
        if row["way"] == direction
    ]


def _node(name: str, state: str, reason: str, inputs: dict[str, Link], outputs: dict[str, Link]) -> GraphNode:
    topics = [tuple(links[topic] for topic in sorted(links) if topic not in ABOUT_NODES) for links in (inputs, outputs)]
    return GraphNode(node=name, state=state, reason=reason, inputs=topics[0], outputs=topics[1])


def _declared(name: str, entry: NodeEntry) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Inputs and outputs of a node by its class; parameters are checked, nothing is created."""
    from mirrorwave.diagnose.node_types import node_classes
    from nodes.node import node_module
    from nodes.process.validation import convert_at

    module = node_module(entry.module, name)
    params = convert_at(dict(entry.params), module.Params, f"{name}.params")
    nodes = node_classes(module)
    # what a recorder reads is in its parameters, and what a link carries
    topics = params.selected_topics() if hasattr(params, "selected_topics") else ()
    imported = params.imported_topics() if hasattr(params, "imported_topics") else ()
    inputs = dict.fromkeys([*(topic for kind in nodes for topic in kind.inputs), *topics])
    return tuple(inputs), tuple(dict.fromkeys([*(topic for kind in nodes for topic in kind.outputs), *imported]))


def layers(nodes: tuple[GraphNode, ...] | list[GraphNode]) -> dict[str, int]:
    """Return the distance of each node from the sources: one more than that of the furthest node whose topics it reads.

    A node that would close a circle counts from what stands before the circle.
    """
    publishers: dict[str, list[str]] = {}
    for node in nodes:
        for link in node.outputs:
            publishers.setdefault(link.topic, []).append(node.node)
    before = {
        node.node: [name for link in node.inputs for name in publishers.get(link.topic, []) if name != node.node]
        for node in nodes
    }
    depth: dict[str, int] = {}

    def depth_of(name: str, path: tuple[str, ...]) -> int:
        if name not in depth:
            sources = [other for other in before[name] if other not in path]
            deepest = max((depth_of(other, (*path, name)) + 1 for other in sources), default=0)
            if len(sources) < len(before[name]):
                return deepest
            depth[name] = deepest
        return depth[name]

    return {name: depth_of(name, (name,)) for name in before}


def _sources_first(nodes: list[GraphNode]) -> tuple[GraphNode, ...]:
    depth = layers(nodes)
    return tuple(sorted(nodes, key=lambda node: depth[node.node]))
