"""YAML 1.2 as values and back (`1e-07` is a number, `off` is text), without unbounded growth or slow parsing."""

from __future__ import annotations

import re
from typing import Any

import yaml
from yaml.composer import Composer

#: No file of this project is deeper, and deep files are slow to parse.
MAX_DEPTH = 32
#: Keys and values of one file: a scene of ten thousand walls has 80,000, which take a second to parse.
MAX_NODES = 100_000


_WORDS = {type(None): "nothing", bool: "true or false", int: "a number", float: "a number", str: "text", list: "a list"}


def in_words(value: object) -> str:
    """Return the kind of a YAML value in words; an empty file has none."""
    return _WORDS.get(type(value), type(value).__name__)


def _loader() -> Any:
    """Return a `SafeLoader` whose nodes are composed here, of events that libyaml reads where it is at hand."""
    if not yaml.__with_libyaml__:
        return yaml.SafeLoader
    return type("_Loader", (Composer, yaml.CSafeLoader), {"__init__": yaml.CSafeLoader.__init__})


class BoundedLoader(_loader()):  # type: ignore[misc]
    """`SafeLoader` without aliases and tags, of `MAX_NODES` keys and values and `MAX_DEPTH` levels at most."""

    _depth = _nodes = 0

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self.anchors: dict[str, Any] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return a node of the tree; raises `yaml.MarkedYAMLError` for a refused one."""
        event: Any = self.peek_event()
        mark: Any = event.start_mark
        if isinstance(event, yaml.AliasEvent):
            # lists of lists of these grow without bound when they are read as values
            raise yaml.MarkedYAMLError(problem="aliases are refused", problem_mark=mark)
        if getattr(event, "tag", None) is not None:
            # PyYAML raises KeyError, IndexError and others for values that do not match their tag
            raise yaml.MarkedYAMLError(problem="tags are refused", problem_mark=mark)
        self._depth += 1
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise yaml.MarkedYAMLError(problem=f"more than {MAX_NODES} keys and values")
        if self._depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"nested deeper than {MAX_DEPTH} levels")
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1


class StrictLoader(BoundedLoader):
    """`BoundedLoader` that refuses keys that are no text or stand twice, which are slips."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Return a mapping; raises `yaml.MarkedYAMLError` for a refused key."""
        keys: set[str] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.MarkedYAMLError(problem=f"key {key!r} must be text", problem_mark=key_node.start_mark)
            if key in keys:
                raise yaml.MarkedYAMLError(problem=f"duplicate key {key!r}", problem_mark=key_node.start_mark)
            keys.add(key)
        return super().construct_mapping(node, deep)


class PlainDumper(yaml.SafeDumper):
    """`SafeDumper` that quotes text which YAML 1.1 or 1.2 would read as another value, and writes no aliases.

    Not libyaml's, which writes no file name that is not UTF-8.
    """

    def ignore_aliases(self, data: Any) -> bool:
        """Return True: lists that occur twice are written twice."""
        return True


_PLAIN_VALUES = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(0|[1-9][0-9]*)|0x[0-9a-fA-F]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", list("-+.")),
)
# what 1.1 adds stays out: the digits of a sexagesimal number multiply, half a megabyte of them takes a minute
BoundedLoader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in _PLAIN_VALUES:
    for _yaml_class in (BoundedLoader, PlainDumper):
        _yaml_class.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), _first)
