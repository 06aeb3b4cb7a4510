"""Counts with their nouns."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from msgs.files.shipped import CHECKOUT
from msgs.values.wording import as_utf8, counted


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ((0, "scan"), "0 scans"),
        ((1, "scan"), "1 scan"),
        ((2, "scan"), "2 scans"),
        ((1, "frequency", "frequencies"), "1 frequency"),
        ((2, "process"), "2 processes"),
        ((3, "frequency", "frequencies"), "3 frequencies"),
    ],
)
def test_one_is_singular(words: tuple[int, str], text: str) -> None:
    assert counted(*words) == text


@pytest.mark.parametrize(
    ("text", "plain"),
    [("a", "a"), ("ü", "ü"), ("k\udcfc\udcc3.log", "k\\xfc\\xc3.log"), ("ü\udcfc", "ü\\xfc"), ("\ud800", "\\ud800")],
)
def test_any_name_of_a_file_can_be_written_as_utf8(text: str, plain: str) -> None:
    assert as_utf8(text) == plain
    assert as_utf8(plain) == plain


#: Position of the noun in calls by the last part of their name.
_NOUN_AT = {"counted": 1, "shed.add": 0, "shed.note": 0, "_shed": 0}
_LAST = {name.rpartition(".")[2] for name in _NOUN_AT}


def nouns(tree: ast.AST) -> Iterator[str]:
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and getattr(call.func, "attr", getattr(call.func, "id", "")) in _LAST:
            at = next((at for name, at in _NOUN_AT.items() if ast.unparse(call.func).endswith(name)), len(call.args))
            if at < len(call.args) and isinstance(call.args[at], ast.Constant | ast.JoinedStr):
                yield ast.unparse(call.args[at]).strip("f'\"")


def test_what_is_counted_is_named_in_the_singular() -> None:
    """A plural noun becomes "270 objectss"."""
    roots = ("mirrorwave", "msgs", "models", "sim_player", "nodes", "lab", "contrib")
    sources = [path.read_text() for root in roots for path in (CHECKOUT / root).rglob("*.py")]
    counting = [source for source in sources if any(f"{name}(" in source for name in _NOUN_AT)]
    found = {noun for source in counting for noun in nouns(ast.parse(source))}
    assert {"scan", "beam", "{topic} message"} <= found
    assert {noun for noun in found if re.search(r"[a-rt-z]s$", noun)} == set()
