"""Words of `docs/glossary.md` that are retired name nothing new in the code."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator, Sequence

import pytest

#: Words that stand in no name, alone or beside others.
RETIRED_WORDS = {
    *("leg", "legs", "thing", "things", "drowned", "told", "bearable", "remembered", "anew", "welcome"),
}
#: Words that name nothing alone: the noun that they stand for does.
RETIRED_NAMES = RETIRED_WORDS | {"one", "ones", "found", "seen", "way", "ways", "chosen", "others", "named", "placed"}
#: Limits are `MAX_`.
RETIRED_PREFIX = re.compile(r"_?MOST_")


@functools.cache
def retired(name: str) -> bool:
    """Whether a name holds a word that it must not."""
    words = {word.lower() for word in re.split(r"_+|(?<=[a-z0-9])(?=[A-Z])", name)}
    return name in RETIRED_NAMES or bool(words & RETIRED_WORDS) or RETIRED_PREFIX.match(name) is not None


def defined_names(nodes: Sequence[ast.AST]) -> Iterator[tuple[int, str]]:
    """Line and name of all that nodes define; fields of classes apart, which files and messages hold by name."""
    fields = {
        statement.target
        for node in nodes
        if isinstance(node, ast.ClassDef)
        for statement in node.body
        if isinstance(statement, ast.AnnAssign)
    }
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node not in fields:
            yield node.lineno, node.id


def retired_names(nodes: Sequence[ast.AST]) -> list[str]:
    """Names in a source that hold a retired word; `tests/test_house.py` asks of every module."""
    return [f"{line}: {name}" for line, name in defined_names(nodes) if retired(name)]


@pytest.mark.parametrize(
    "source",
    ["for one in rows: pass", "def _told(): ...", "def f(leg_m): ...", "class SameThing: ...", "MOST_ROWS = 1"],
)
def test_the_law_catches_a_breach(source: str) -> None:
    assert retired_names([*ast.walk(ast.parse(source))])


@pytest.mark.parametrize("source", ["one_way_m = 1.0", "class Row:\n    found: int = 0", "MAX_ROWS = 1"])
def test_terms_of_the_field_and_fields_of_files_stay(source: str) -> None:
    assert retired_names([*ast.walk(ast.parse(source))]) == []
