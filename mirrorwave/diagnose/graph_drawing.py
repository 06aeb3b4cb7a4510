"""A graph drawn: nodes in columns from sources to readers, topics between them, as SVG; the same as DOT for Graphviz.

The layout is the usual one of layered graphs: columns by distance from the sources, rows by the mean row of the
neighbours, until crossings settle. It needs nothing installed and answers in a millisecond for graphs of this size.
"""

from __future__ import annotations

import itertools
import re
from typing import NamedTuple
from xml.sax import saxutils

from mirrorwave.diagnose.graph_picture import GraphPicture, Link, layers

_COLUMN_GAP, _ROW_GAP, _MARGIN = 56, 20, 28
_HEIGHT = 46
_CHARACTER = 8.0
_SWEEPS = 8
#: A drawing is shown up to this many times its own size.
_MAX_SCALE = 1.5
#: What XML does not allow in any form: a node's reason may hold anything, and one such character spoils the drawing.
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

_STYLE = """
  svg { font-family: system-ui, sans-serif; font-size: 13px; background: var(--page); }
  :root { --page: #ffffff; --ink: #1b2733; --faint: #5d6b78; --line: #8a99a8; --node: #e8f0fb; --rim: #2d6cb5;
    --topic: #f4f5f6; --bad: #b3261e; --bad-fill: #fde7e5; }
  @media (prefers-color-scheme: dark) { :root { --page: #12171d; --ink: #e6ebf0; --faint: #9aa7b4; --line: #66788a;
    --node: #1b2c42; --rim: #6ea8ee; --topic: #1e252d; --bad: #ff8a80; --bad-fill: #43201d; } }
  .node { fill: var(--node); stroke: var(--rim); stroke-width: 1.5; }
  .topic { fill: var(--topic); stroke: var(--line); }
  .bad { fill: var(--bad-fill); stroke: var(--bad); stroke-width: 1.5; }
  .edge { fill: none; stroke: var(--line); stroke-width: 1.4; }
  .lossy { stroke: var(--bad); stroke-width: 2.2; }
  .head { fill: var(--line); }
  text { fill: var(--ink); text-anchor: middle; }
  .name { font-weight: 600; }
  .small { fill: var(--faint); font-size: 11px; }
"""


def escape(text: str) -> str:
    """Any text as text of an XML document."""
    return saxutils.escape(_NO_XML.sub("\ufffd", text))


class _Box(NamedTuple):
    """A node or a topic: two lines of text at a place of the drawing."""

    key: str
    name: str
    small: str
    kind: str
    wide: float


class _Edge(NamedTuple):
    """From one box to another."""

    start: str
    end: str
    link: Link


class _Place(NamedTuple):
    """Centre of a box or a passage, and the width of its column."""

    x: float
    y: float
    column_wide: float


class _Layout(NamedTuple):
    """Columns of boxes, from left to right; a string stands for an edge that passes through."""

    columns: list[list[str]]
    edges: list[_Edge]
    #: Boxes that each edge passes, both ends included.
    routes: list[list[str]]


def svg_text(picture: GraphPicture) -> str:
    """The drawing, complete with light and dark colours."""
    boxes = _boxes(picture)
    layout = _layout(picture, boxes)
    positions, width, height = _positions(layout, boxes)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        # as wide as where it stands, no wider than is easily read
        f'width="100%" style="max-width: {_MAX_SCALE * width:.0f}px; height: auto" role="img">',
        f"<title>{escape(picture.title)}</title><style>{_STYLE}</style>",
        '<defs><marker id="arrow" viewBox="0 0 10 10" refX="9" refY="5" markerUnits="userSpaceOnUse" '
        'markerWidth="10" markerHeight="10" orient="auto-start-reverse">'
        '<path class="head" d="M0 0 L10 5 L0 10 z"/></marker></defs>',
        f'<text x="{_MARGIN}" y="20" class="small" style="text-anchor: start">{escape(picture.title)}</text>',
    ]
    parts += [_edge(edge, route, positions, boxes) for edge, route in zip(layout.edges, layout.routes, strict=True)]
    parts += [_box(box, positions[key].x, positions[key].y) for key, box in boxes.items()]
    return "\n".join([*parts, "</svg>", ""])


def dot_text(picture: GraphPicture) -> str:
    """The graph in Graphviz's language: nodes as boxes, topics as ellipses."""
    lines = ["digraph mirrorwave {", "  rankdir=LR;", '  node [fontname="sans-serif"];']
    for key, box in _boxes(picture).items():
        shape = "ellipse" if box.key.startswith("topic ") else "box"
        lines.append(f"  {_quoted(key)} [shape={shape}, label={_quoted(box.name, box.small)}];")
    for edge in _edges(picture):
        label = f" [label={_quoted(f'{edge.link.lost} lost')}, color=red]" if edge.link.lost else ""
        lines.append(f"  {_quoted(edge.start)} -> {_quoted(edge.end)}{label};")
    return "\n".join([*lines, "}", ""])


def _quoted(*lines: str) -> str:
    plain = [line.replace("\\", "\\\\").replace('"', '\\"') for line in lines if line]
    return '"' + "\\n".join(plain) + '"'


def _boxes(picture: GraphPicture) -> dict[str, _Box]:
    boxes = {}
    for node in picture.nodes:
        bad = node.state in ("silent", "degraded", "stopping")
        small = node.module or (f"{node.state}: {node.reason}" if node.reason else node.state)
        boxes[f"node {node.node}"] = _sized(f"node {node.node}", node.node, _cut(small), "bad" if bad else "node")
    for topic in picture.topics():
        rates = [link.hz for node in picture.nodes for link in node.outputs if link.topic == topic and link.hz]
        absent = not picture.publishers(topic)
        small = "no publisher" if absent else f"{sum(rates):.3g} Hz" if rates else ""
        boxes[f"topic {topic}"] = _sized(f"topic {topic}", topic, small, "bad" if absent else "topic")
    return boxes


def _sized(key: str, name: str, small: str, kind: str) -> _Box:
    return _Box(key, name, small, kind, max(len(name) * _CHARACTER, len(small) * 0.85 * _CHARACTER) + 28)


def _cut(text: str, limit: int = 40) -> str:
    return text if len(text) <= limit else text[: limit - 3] + "..."


def _edges(picture: GraphPicture) -> list[_Edge]:
    edges = []
    for node in picture.nodes:
        edges += [_Edge(f"node {node.node}", f"topic {link.topic}", link) for link in node.outputs]
        edges += [_Edge(f"topic {link.topic}", f"node {node.node}", link) for link in node.inputs]
    return edges


def _columns_of(picture: GraphPicture) -> dict[str, int]:
    """Column of each box: nodes in even columns, a topic right behind the last node that publishes it."""
    depth = layers(picture.nodes)
    columns = {f"node {name}": 2 * at for name, at in depth.items()}
    for topic in picture.topics():
        publishers, readers = picture.publishers(topic), picture.readers(topic)
        if publishers:
            columns[f"topic {topic}"] = 2 * max(depth[name] for name in publishers) + 1
        else:
            columns[f"topic {topic}"] = 2 * min(depth[name] for name in readers) - 1
    first = min(columns.values(), default=0)
    return {key: at - first for key, at in columns.items()}


def _layout(picture: GraphPicture, boxes: dict[str, _Box]) -> _Layout:
    at = _columns_of(picture)
    columns: list[list[str]] = [[] for _ in range(max(at.values(), default=-1) + 1)]
    for key in boxes:
        columns[at[key]].append(key)
    edges = _edges(picture)
    routes = []
    for number, edge in enumerate(edges):
        # columns that the edge crosses hold a place for it, so that it does not run through a box
        step = 1 if at[edge.end] > at[edge.start] else -1
        passed = [f"pass {number} {column}" for column in range(at[edge.start] + step, at[edge.end], step)]
        for key, column in zip(passed, range(at[edge.start] + step, at[edge.end], step), strict=True):
            columns[column].append(key)
        routes.append([edge.start, *passed, edge.end])
    _settle(columns, routes)
    return _Layout(columns, edges, routes)


def _settle(columns: list[list[str]], routes: list[list[str]]) -> None:
    """Sort each column by the mean row of its neighbours in the column before, then behind, and again."""
    neighbours: dict[str, set[str]] = {}
    for route in routes:
        for hop, other in itertools.pairwise(route):
            neighbours.setdefault(hop, set()).add(other)
            neighbours.setdefault(other, set()).add(hop)
    for sweep in range(_SWEEPS):
        order = range(1, len(columns)) if sweep % 2 == 0 else range(len(columns) - 2, -1, -1)
        for at in order:
            beside = columns[at - 1 if sweep % 2 == 0 else at + 1]
            row = {key: index - 0.5 * len(beside) for index, key in enumerate(beside)}
            own = {key: index - 0.5 * len(columns[at]) for index, key in enumerate(columns[at])}
            means = {
                key: _mean([row[other] for other in neighbours.get(key, ()) if other in row], own[key]) for key in own
            }
            columns[at].sort(key=means.__getitem__)


def _mean(values: list[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise


def _positions(layout: _Layout, boxes: dict[str, _Box]) -> tuple[dict[str, _Place], float, float]:
    """Return the position of each box and each passage, and the size of the drawing."""
    heights = [sum(_tall(key) for key in column) for column in layout.columns]
    height = max(heights, default=0.0) + 2 * _MARGIN + 10
    positions: dict[str, _Place] = {}
    left = float(_MARGIN)
    for column, own in zip(layout.columns, heights, strict=True):
        wide = max((boxes[key].wide for key in column if key in boxes), default=20.0)
        top = 0.5 * (height + 10 - own)
        for key in column:
            positions[key] = _Place(left + 0.5 * wide, top + 0.5 * _tall(key), wide)
            top += _tall(key)
        left += wide + _COLUMN_GAP
    return positions, left - _COLUMN_GAP + _MARGIN, height


def _tall(key: str) -> float:
    return 22.0 if key.startswith("pass ") else float(_HEIGHT + _ROW_GAP)


def _edge(edge: _Edge, route: list[str], positions: dict[str, _Place], boxes: dict[str, _Box]) -> str:
    start, end = positions[route[0]], positions[route[-1]]
    direction = 1 if end.x > start.x else -1
    points = [(start.x + direction * 0.5 * boxes[edge.start].wide, start.y)]
    for passed in (positions[key] for key in route[1:-1]):
        # straight through the column: a bend there would touch the boxes above and below
        points += [(passed.x + side * direction * 0.5 * passed.column_wide, passed.y) for side in (-1, 1)]
    points.append((end.x - direction * 0.5 * boxes[edge.end].wide, end.y))
    path = [f"M{points[0][0]:.1f} {points[0][1]:.1f}"]
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        middle = 0.5 * (x0 + x1)
        path.append(f"C{middle:.1f} {y0:.1f} {middle:.1f} {y1:.1f} {x1:.1f} {y1:.1f}")
    kind = "edge lossy" if edge.link.lost else "edge"
    lost = f"<title>{edge.link.lost} lost</title>" if edge.link.lost else ""
    return f'<path class="{kind}" d="{" ".join(path)}" marker-end="url(#arrow)">{lost}</path>'


def _box(box: _Box, x: float, y: float) -> str:
    radius = _HEIGHT / 2 if box.key.startswith("topic ") else 6
    name_y = y + (-2 if box.small else 5)
    small = f'<text x="{x:.1f}" y="{y + 14:.1f}" class="small">{escape(box.small)}</text>' if box.small else ""
    return (
        f'<rect class="{box.kind}" x="{x - box.wide / 2:.1f}" y="{y - _HEIGHT / 2:.1f}" width="{box.wide:.1f}" '
        f'height="{_HEIGHT}" rx="{radius}"/>'
        f'<text x="{x:.1f}" y="{name_y:.1f}" class="name">{escape(box.name)}</text>{small}'
    )
