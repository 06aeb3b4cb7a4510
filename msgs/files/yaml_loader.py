"""YAML of others as values: no unbounded growth, no slow parsing, no value that does not match its tag."""

from __future__ import annotations

from typing import Any

import yaml

#: No file of this project is deeper, and deep files are slow to parse.
MAX_DEPTH = 32


_WORDS = {type(None): "nothing", bool: "true or false", int: "a number", float: "a number", str: "text", list: "a list"}


def in_words(value: object) -> str:
    """Return the kind of a YAML value in words; an empty file has none."""
    return _WORDS.get(type(value), type(value).__name__)


class BoundedLoader(yaml.SafeLoader):
    """`SafeLoader` without aliases and tags, `MAX_DEPTH` levels deep at most."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return a node of the tree; raises `yaml.MarkedYAMLError` for a refused one."""
        if self.check_event(yaml.AliasEvent):
            # lists of lists of these grow without bound when they are read as values
            raise yaml.MarkedYAMLError(problem="aliases are refused", problem_mark=self.peek_event().start_mark)
        if getattr(self.peek_event(), "tag", None) is not None:
            # PyYAML raises KeyError, IndexError and others for values that do not match their tag
            raise yaml.MarkedYAMLError(problem="tags are refused", problem_mark=self.peek_event().start_mark)
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"nested deeper than {MAX_DEPTH} levels")
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1
