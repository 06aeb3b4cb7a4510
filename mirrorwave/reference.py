"""The reference pages of the documentation, written from the types and the verbs themselves.

    python -m mirrorwave.reference docs/reference

writes messages.md, parameters.md and commands.md; a test holds the committed pages against what it would write.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import sys
from collections.abc import Iterator, Sequence
from enum import Enum, IntEnum
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import msgspec

from mirrorwave.plots.markdown import table
from msgs.bus.interface import Envelope
from msgs.bus.topics import MIB, SHIPPED, TOPICS, Topic
from msgs.files.shipped import CHECKOUT
from msgs.values.arrays import Checked, limits_of

#: Where nodes are: those of the road, and plug-ins.
NODE_FOLDERS = "nodes", "contrib"
#: In a table cell this would end the cell.
_BAR = "\\|"

_MESSAGES_HEAD = """\
# Messages

Written by `make reference` from the types in `msgs/`.

## On the wire

A message is a ZeroMQ multipart of frames: the topic's name and a zero byte; the header, a msgpack map `{"envelope",
"body"}`; then the arrays as raw little-endian C-order bytes. In the body an array is `{"dtype", "shape", "frame"}`,
`frame` counting the array frames from 0. In recordings the body stands alone and an array is `{"dtype", "shape",
"data"}` with the bytes inside. `dtype` is NumPy's (`<c8` is complex64, `<i2` int16, `|u1` uint8). Publishers bind a
Unix socket `<topic with . for />@<node>` in the graph's run directory; subscribers connect to every one there is.

Lengths are metres, angles radians, times seconds or, as `_ns`, nanoseconds. Frames are x forward, y left; azimuth is
counter-clockwise from x. `stamp_ns` is the time of acquisition on the clock of the machine that measured.
"""
_PARAMETERS_HEAD = """\
# Parameters of the nodes

Written by `make reference` from each node's `Params`. They stand in
launch files under `nodes.NAME.params`, and `mirrorwave launch FILE -p NAME.KEY=VALUE` sets one. A word or a key that is
not here is refused with its name. Parameters that are structures of their own are listed below each node.
"""
_COMMANDS_HEAD = """\
Written by `make reference` from the command line itself. Exit codes
of all: 0 done, 1 failed, 2 wrong usage or bad input, 3 done with loss, above 128 ended by a signal
([watch a graph](../guides/watch-a-graph.md#exit-codes)).
"""


class Field(NamedTuple):
    """One field of a type as its source says it."""

    name: str
    annotation: str
    default: str
    comment: str


def pages() -> dict[str, str]:
    """File name -> text of every reference page."""
    return {"messages.md": messages_page(), "parameters.md": parameters_page(), "commands.md": commands_page()}


def messages_page() -> str:
    """All topics and all types that travel on them."""
    shipped = [TOPICS[name] for name in SHIPPED]
    types = _closure([Envelope, *(topic.type for topic in shipped)])
    topics = [_topic_row(topic) for topic in shipped]
    parts = [
        _MESSAGES_HEAD,
        "## Topics\n",
        _table(("topic", "type", "nominal Hz", "at most", "delivery"), topics),
        "## Types\n",
        *(_type_section(kind) for kind in types),
    ]
    return "\n".join(parts)


def parameters_page() -> str:
    """The parameters of every module that is a node."""
    return "\n".join([_PARAMETERS_HEAD, *(_node_section(name) for name in node_modules())])


def commands_page() -> str:
    """All verbs with their options, by typer's own writer of documentation."""
    import typer
    from typer.cli import get_docs_for_click

    from mirrorwave.cli import COMMON_OPTIONS, command_line

    command = typer.main.get_command(command_line())
    text = get_docs_for_click(obj=command, ctx=typer.Context(command), name="mirrorwave", title="Commands")
    title, _, body = text.partition("\n\n")
    common = "".join(f"* `{name}`: {text}\n" for name, text in COMMON_OPTIONS.items())
    head = f"{_COMMANDS_HEAD}\nOptions that mean the same in every verb that names them as common:\n\n{common}"
    return f"{title}\n\n{head}\n{body.rstrip()}\n"


def node_modules() -> list[str]:
    """Dotted names of the modules that can stand in a launch file."""
    paths = [path for folder in NODE_FOLDERS for path in sorted((CHECKOUT / folder).rglob("*.py"))]
    sources = {path.relative_to(CHECKOUT): path.read_text(encoding="utf-8") for path in paths}
    return [
        ".".join(path.with_suffix("").parts)
        for path, text in sources.items()
        if "\nclass Params(" in text and "\ndef create(" in text
    ]


def _topic_row(topic: Topic) -> tuple[str, ...]:
    delivery = "latched: late joiners get the last" if topic.latched else "in order"
    if topic.newest_only:
        delivery = "newest only"
    rate = f"{topic.rate_hz:.3g}" if topic.rate_hz else "when needed"
    limit = f"{topic.max_bytes / MIB:g} MiB" if topic.max_bytes >= MIB else f"{topic.max_bytes >> 10} KiB"
    return f"`{topic.name}`", f"[{topic.type.__name__}](#{_anchor(topic.type.__name__)})", rate, limit, delivery


def _type_section(kind: type) -> str:
    head = f"### {kind.__name__}\n\n{_summary(kind)}\n"
    if issubclass(kind, Enum):
        rows = [(f"`{member.name}`", f"`{member.value!r}`", comment) for member, comment in _members(kind)]
        return "\n".join([head, _table(("name", "value", ""), rows)])
    return "\n".join([head, _fields_table(kind)])


def _fields_table(kind: type) -> str:
    rows = [(f"`{row.name}`", f"`{row.annotation}`", row.default, row.comment) for row in fields_of(kind)]
    return _table(("field", "type", "default", ""), rows) if rows else "No fields.\n"


def _node_section(module_name: str) -> str:
    module = importlib.import_module(module_name)
    inner = [inner_type for inner_type in _closure([module.Params])[1:] if not issubclass(inner_type, Enum)]
    parts = [f"## {module_name}\n", f"{_paragraph(inspect.getdoc(module) or '')}\n", _fields_table(module.Params)]
    for inner_type in inner:
        parts += [f"### {module_name}: {inner_type.__name__}\n", f"{_summary(inner_type)}\n", _fields_table(inner_type)]
    return "\n".join(parts)


def fields_of(kind: type) -> list[Field]:
    """Fields of a Struct in the order of its definition, those of its bases first."""
    # of a type without source, as one that a program makes, its fields alone are known
    comments = {field.name: (_type_text(field.type), "") for field in msgspec.structs.fields(kind)}
    comments |= {name: text for base in reversed(kind.__mro__) for name, text in _source_fields(base)}
    if issubclass(kind, Checked):
        plain, ruled = get_type_hints(kind), get_type_hints(kind, include_extras=True)
        comments = {
            name: (_type_text(plain[name]), f"{comment} {limits_of(ruled[name])}")
            for name, (_, comment) in comments.items()
        }
    return [
        Field(field.name, _cell(comments[field.name][0]), _default(field), _cell(comments[field.name][1]))
        for field in msgspec.structs.fields(kind)
    ]


def _type_text(hint: Any) -> str:
    """Return a type as its source names it, without the limits of its annotation."""
    if isinstance(hint, type) and not get_args(hint):
        return "np.ndarray" if hint.__name__ == "ndarray" else hint.__name__
    text = re.sub(r"\b(?:msgs(?:\.\w+)*|typing)\.", "", str(hint)).replace("numpy.", "np.")
    return re.sub(r"^Optional\[(.*)\]$", r"\1 | None", text)


@cache
def _source_fields(kind: type) -> tuple[tuple[str, tuple[str, str]], ...]:
    """(name, (annotation, comment)) of each annotated field that a class's own body has."""
    if kind in (object, msgspec.Struct) or kind.__module__ == "builtins":
        return ()
    lines, tree = _class_source(kind)
    own = [node for node in tree.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)]
    return tuple((node.target.id, (ast.unparse(node.annotation), _comment(lines, node.lineno))) for node in own)  # type: ignore[union-attr]


def _class_source(kind: type) -> tuple[list[str], ast.ClassDef]:
    try:
        source = inspect.cleandoc("\n" + inspect.getsource(kind))
    except (OSError, TypeError):
        return [], ast.ClassDef(kind.__name__, [], [], [], [])
    tree = ast.parse(source).body[0]
    assert isinstance(tree, ast.ClassDef)
    return source.splitlines(), tree


def _comment(lines: list[str], lineno: int) -> str:
    """The `#:` comment above a line, joined."""
    comments: list[str] = []
    for line in reversed(lines[: lineno - 1]):
        if not line.strip().startswith("#:"):
            break
        comments.insert(0, line.strip()[2:].strip())
    return " ".join(comments)


def _members(kind: type[Enum]) -> Iterator[tuple[Enum, str]]:
    lines, tree = _class_source(kind)
    at = {node.targets[0].id: node.lineno for node in tree.body if isinstance(node, ast.Assign)}  # type: ignore[attr-defined]
    for member in kind:
        yield member, _comment(lines, at.get(member.name, 0))


def _default(field: Any) -> str:
    if field.default_factory is not msgspec.NODEFAULT:
        value = field.default_factory()
        return f"`{value!r}`" if not value else ""
    if field.default is msgspec.NODEFAULT:
        return "required"
    value = field.default
    if isinstance(value, msgspec.Struct):
        return "as below"
    return f"`{value.value!r}`" if isinstance(value, Enum) else f"`{value!r}`".replace("|", _BAR)


def _closure(roots: list[type]) -> list[type]:
    """`roots` and every Struct and Enum that their fields mention, each once, as they come up."""
    types: list[type] = []
    waiting = list(roots)
    while waiting:
        kind = waiting.pop(0)
        if kind in types:
            continue
        types.append(kind)
        if issubclass(kind, msgspec.Struct):
            waiting += [mentioned for hint in get_type_hints(kind).values() for mentioned in _mentioned(hint)]
    return types


def _mentioned(hint: Any) -> Iterator[type]:
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct | Enum) and hint is not IntEnum:
        yield hint
    for part in get_args(hint):
        yield from _mentioned(part)


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    return "\n".join(table(head, rows)) + "\n"


def _anchor(title: str) -> str:
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")


def _summary(kind: type) -> str:
    return _paragraph(inspect.getdoc(kind) or "")


def _paragraph(text: str) -> str:
    """Everything a docstring says, each paragraph on one line."""
    return "\n\n".join(" ".join(part.split()) for part in inspect.cleandoc(text).split("\n\n"))


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", _BAR)


def main(argv: list[str]) -> int:
    """Write all pages into the folder that is named."""
    if len(argv) != 1 or argv[0].startswith("-"):
        sys.stderr.write("usage: python -m mirrorwave.reference DIR\n")
        return 2
    out = Path(argv[0])
    out.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (out / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
