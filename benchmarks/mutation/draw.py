"""Mutations drawn at random over the sources: a seeded list of plausible bugs that no author of tests chose.

A draw takes a module uniformly, then a mutation operator uniformly among those that apply somewhere in it, then one of
the sites where it applies. Error texts, log lines, assertions and annotations are left out. Whether a mutation changes
anything that can be observed is judged by a reader, before any test is run (`equivalent` in the list).
Usage: python -m benchmarks.mutation.draw --count 60 --seed 19 > drawn.yaml
"""

from __future__ import annotations

import argparse
import ast
import itertools
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.mutation.mutations import ROOT, Mutation, as_yaml

ROOMS = ("models", "sim_player", "msgs", "nodes")
#: What may stand for what in a call.
NAMES = {
    "mean": "median", "median": "mean", "nanmedian": "nanmean", "sum": "mean", "max": "min", "min": "max",
    "maximum": "minimum", "minimum": "maximum", "argmax": "argmin", "argmin": "argmax", "any": "all", "all": "any",
    "cos": "sin", "sin": "cos", "floor": "ceil", "ceil": "floor", "log1p": "log", "expm1": "exp",
}  # fmt: skip
#: Of these an array has no method of its own.
FUNCTIONS_ONLY = {"median", "nanmean", "sin", "cos"}
COMMUTATIVE = {"max", "min", "maximum", "minimum", "hypot", "multiply", "isclose", "gcd", "isinstance", "zip"}
COMPARED = {ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">")}
SIGNS = {ast.Add: ("+", "-"), ast.Sub: ("-", "+")}


class Site(NamedTuple):
    """Where a mutation operator applies: first byte of what is replaced, the one after its last, what replaces it."""

    operator: str
    first: int
    last: int
    new: str


class Source:
    """A module's text with the places of its syntax, in bytes."""

    def __init__(self, path: Path) -> None:
        self.data = path.read_bytes()
        self.tree = ast.parse(self.data)
        self._lines = [0]
        for line in self.data.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        """First byte of a node and the one after its last."""
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self._lines[node.lineno - 1] + node.col_offset, self._lines[node.end_lineno - 1] + node.end_col_offset

    def text(self, node: ast.expr | ast.stmt) -> str:
        """What a node says."""
        first, last = self.span(node)
        return self.data[first:last].decode()

    def nodes(self) -> Iterator[ast.AST]:
        """All nodes that a program acts by."""
        waiting: list[ast.AST] = [self.tree]
        while waiting:
            node = waiting.pop()
            if _is_silent(node):
                continue
            yield node
            waiting += _acting_children(node)

    def between(self, left: ast.expr, right: ast.expr, old: str, new: str, operator: str) -> list[Site]:
        """An operator exchanged, where it stands alone between its operands."""
        first, last = self.span(left)[1], self.span(right)[0]
        if self.data[first:last].count(old.encode()) != 1 or b"#" in self.data[first:last]:
            return []
        at = first + self.data[first:last].index(old.encode())
        return [Site(operator, at, at + len(old.encode()), new)]

    def replaced(self, node: ast.expr, text: str, operator: str) -> Site:
        """A node exchanged."""
        return Site(operator, *self.span(node), text)


def _is_silent(node: ast.AST) -> bool:
    """Whether nothing but words come of a node."""
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr):
        return True
    if not isinstance(node, ast.Call):
        return False
    name = ast.unparse(node.func)
    return name.startswith("_LOG.") or name.endswith((".add_argument", "_say", "_warn_refused"))


def _acting_children(node: ast.AST) -> Iterator[ast.AST]:
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases", "args") and not isinstance(
            node, ast.Call
        ):
            continue
        yield from (child for child in (value if isinstance(value, list) else [value]) if isinstance(child, ast.AST))


def _is_text(node: ast.expr) -> bool:
    """Whether a sum joins words or lists in place of numbers."""
    words = (ast.JoinedStr, ast.List, ast.Tuple, ast.Dict, ast.ListComp)
    return any(
        isinstance(one, words) or (isinstance(one, ast.Constant) and isinstance(one.value, str | bytes))
        for one in ast.walk(node)
    )


def _arithmetic(source: Source, node: ast.AST) -> list[Site]:
    if not isinstance(node, ast.BinOp) or _is_text(node.left) or _is_text(node.right):
        return []
    sites: list[Site] = []
    if type(node.op) in SIGNS:
        sites += source.between(node.left, node.right, *SIGNS[type(node.op)], "sign swapped")
        kept = _longer(node) if isinstance(node.op, ast.Add) else node.left
        sites.append(source.replaced(node, f"({source.text(kept)})", "term dropped"))
    if isinstance(node.op, ast.Mult | ast.Div):
        kept = _longer(node) if isinstance(node.op, ast.Mult) else node.left
        sites.append(source.replaced(node, f"({source.text(kept)})", "factor dropped"))
    if isinstance(node.op, ast.Pow) and isinstance(node.right, ast.Constant) and node.right.value == 2:
        sites.append(source.replaced(node, f"({source.text(node.left)})", "square or root missing"))
    return sites


def _longer(node: ast.BinOp) -> ast.expr:
    """The side with more to it: what is forgotten is a constant or a name rather."""
    return max((node.left, node.right), key=lambda side: sum(1 for _ in ast.walk(side)))


def _signs(source: Source, node: ast.AST) -> list[Site]:
    if not isinstance(node, ast.UnaryOp) or not isinstance(node.op, ast.USub) or isinstance(node.operand, ast.Constant):
        return []
    return [source.replaced(node, f"({source.text(node.operand)})", "sign swapped")]


def _comparisons(source: Source, node: ast.AST) -> list[Site]:
    if not isinstance(node, ast.Compare) or len(node.ops) != 1 or type(node.ops[0]) not in COMPARED:
        return []
    return source.between(node.left, node.comparators[0], *COMPARED[type(node.ops[0])], "limit moved")


def _conditions(source: Source, node: ast.AST) -> list[Site]:
    """The last of several conditions, not a value that stands in for none."""
    if not isinstance(node, ast.BoolOp):
        return []
    if isinstance(node.op, ast.Or) and not isinstance(node.values[-1], ast.Compare | ast.BoolOp | ast.UnaryOp):
        return []
    rest = [source.text(value) for value in node.values[:-1]]
    word = "and" if isinstance(node.op, ast.And) else "or"
    return [source.replaced(node, f"({f' {word} '.join(rest)})", "condition dropped")]


def _names(source: Source, node: ast.AST) -> list[Site]:
    if not isinstance(node, ast.Call):
        return []
    called = node.func
    name = called.attr if isinstance(called, ast.Attribute) else called.id if isinstance(called, ast.Name) else ""
    of_numpy = isinstance(called, ast.Attribute) and source.text(called.value) in ("np", "math")
    if name not in NAMES or (isinstance(called, ast.Attribute) and not of_numpy and NAMES[name] in FUNCTIONS_ONLY):
        return []
    if isinstance(called, ast.Name) and name not in ("max", "min", "any", "all"):
        return []
    last = source.span(called)[1]
    operator = "sine for cosine" if name in ("sin", "cos") else "one function for another"
    return [Site(operator, last - len(name), last, NAMES[name])]


def _calls(source: Source, node: ast.AST) -> list[Site]:
    if not isinstance(node, ast.Call):
        return []
    name = ast.unparse(node.func).rpartition(".")[2]
    sites: list[Site] = []
    if name in ("sqrt", "square", "conj", "abs") and len(node.args) == 1 and not node.keywords:
        operator = "square or root missing" if name in ("sqrt", "square") else "conjugate or magnitude missing"
        sites.append(source.replaced(node, f"({source.text(node.args[0])})", operator))
    if name in ("conj", "transpose") and isinstance(node.func, ast.Attribute) and not node.args:
        sites.append(source.replaced(node, source.text(node.func.value), "conjugate or magnitude missing"))
    return sites


def _exchanges(source: Source, node: ast.AST) -> list[Site]:
    """Two parameters of one type that a function passes on in the wrong order."""
    if not isinstance(node, ast.FunctionDef):
        return []
    types = {arg.arg: ast.unparse(arg.annotation) for arg in node.args.args if arg.annotation}
    sites: list[Site] = []
    for call in (one for one in ast.walk(node) if isinstance(one, ast.Call)):
        if _is_silent(call) or ast.unparse(call.func).rpartition(".")[2] in COMMUTATIVE:
            continue
        for left, right in itertools.pairwise(call.args):
            if not (isinstance(left, ast.Name) and isinstance(right, ast.Name)) or left.id == right.id:
                continue
            if left.id in types and types[left.id] == types.get(right.id):
                first, last = source.span(left)[0], source.span(right)[1]
                middle = source.data[source.span(left)[1] : source.span(right)[0]].decode()
                sites.append(Site("arguments exchanged", first, last, f"{right.id}{middle}{left.id}"))
    return sites


def _indices(source: Source, node: ast.AST) -> list[Site]:
    if not isinstance(node, ast.Subscript):
        return []
    parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
    sites: list[Site] = []
    for part in parts:
        number = _number(part)
        if number is not None:
            other = {0: 1, 1: 0, -1: 0, -2: -1}.get(number, number - 1)
            sites.append(source.replaced(part, str(other), "wrong index"))
        if isinstance(part, ast.Slice):
            for end in (part.lower, part.upper):
                if end is not None and (number := _number(end)) is not None:
                    sites.append(source.replaced(end, str(number + (1 if number >= 0 else -1)), "off by one"))
    return sites


def _ranges(source: Source, node: ast.AST) -> list[Site]:
    """Loops that end, or begin, one later."""
    if not isinstance(node, ast.Call) or ast.unparse(node.func) != "range":
        return []
    return [source.replaced(arg, f"{source.text(arg)} + 1", "off by one") for arg in node.args[:2]]


def _number(node: ast.expr) -> int | None:
    """The whole number a node is."""
    sign = 1
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        sign, node = -1, node.operand
    is_number = isinstance(node, ast.Constant) and type(node.value) is int
    return sign * node.value if is_number else None  # type: ignore[attr-defined]


def _ignored(source: Source, node: ast.AST) -> list[Site]:
    """A parameter with a default that a function does not look at."""
    if not isinstance(node, ast.FunctionDef) or len(node.body) < 1:
        return []
    ordered = [*node.args.posonlyargs, *node.args.args]
    pairs = list(zip(ordered[::-1], node.args.defaults[::-1], strict=False))
    pairs += [
        (arg, default) for arg, default in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True) if default
    ]
    used = {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}
    is_documented = isinstance(node.body[0], ast.Expr) and isinstance(node.body[0].value, ast.Constant)
    if is_documented and len(node.body) < 2:
        return []
    start = source.span(node.body[1 if is_documented else 0])[0]
    indent = " " * node.body[0].col_offset
    return [
        Site("parameter ignored", start, start, f"{arg.arg} = {source.text(default)}\n{indent}")
        for arg, default in pairs
        if arg.arg in used
    ]


def _settings(source: Source, node: ast.AST, defaults: dict[str, str]) -> list[Site]:
    """A setting of a parameter class whose default is taken whatever was asked for."""
    if not isinstance(node, ast.Attribute) or not isinstance(node.ctx, ast.Load) or node.attr not in defaults:
        return []
    if source.text(node.value).rpartition(".")[2].lstrip("_") not in ("params", "config", "settings"):
        return []
    return [source.replaced(node, defaults[node.attr], "parameter ignored")]


OPERATORS = (
    _arithmetic, _signs, _comparisons, _conditions, _names, _calls, _exchanges, _indices, _ranges, _ignored,
)  # fmt: skip


@cache
def field_defaults() -> dict[str, str]:
    """Plain defaults of the fields of parameter classes, by names that stand for one default alone."""
    values_of: dict[str, set[str]] = {}
    for path in sources():
        for node in ast.walk(ast.parse(path.read_text())):
            if not (isinstance(node, ast.ClassDef) and node.name.endswith(("Params", "Config"))):
                continue
            for field in node.body:
                if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                    value = field.value
                    plain = isinstance(value, ast.Constant) and not isinstance(value.value, str)
                    values_of.setdefault(field.target.id, set()).add(ast.unparse(value) if plain and value else "")
    return {name: next(iter(values)) for name, values in values_of.items() if len(values) == 1 and "" not in values}


def sources() -> list[Path]:
    """The modules mutations are drawn from."""
    return [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py")) if path.name != "__init__.py"]


def sites_of(path: Path, defaults: dict[str, str]) -> tuple[Source, dict[str, list[Site]]]:
    """All sites of a module by mutation operator."""
    source, sites = Source(path), dict[str, set[Site]]()
    for node in source.nodes():
        own = [site for operator in OPERATORS for site in operator(source, node)]
        for site in own + _settings(source, node, defaults):
            sites.setdefault(site.operator, set()).add(site)
    return source, {operator: sorted(sites[operator]) for operator in sorted(sites)}


def as_mutation(path: Path, source: Source, site: Site) -> Mutation | None:
    """A site as whole lines that stand once in the file; None where the mutant is no Python or the same program."""
    operator, first, last, new = site
    start = source.data.rfind(b"\n", 0, first) + 1
    end = source.data.find(b"\n", last)
    mutated = source.data[:first] + new.encode() + source.data[last:]
    try:
        if ast.dump(ast.parse(mutated)) == ast.dump(source.tree):
            return None
    except SyntaxError:
        return None
    while source.data.count(source.data[start:end]) > 1:
        start = source.data.rfind(b"\n", 0, max(start - 1, 0)) + 1
    old = source.data[start:end].decode()
    file, line = str(path.relative_to(ROOT)), source.data[:first].count(b"\n") + 1
    shift = len(new.encode()) - (last - first)
    return Mutation(
        name=f"{file}:{line} {operator}",
        file=file,
        old=old,
        new=mutated[start : end + shift].decode(),
        reason=operator,
        group="drawn",
    )


def draw(count: int, seed: int) -> list[Mutation]:
    """So many different mutations."""
    rng, defaults, paths = np.random.default_rng(seed), field_defaults(), sources()
    drawn: dict[str, Mutation] = {}
    while len(drawn) < count:
        path = paths[int(rng.integers(len(paths)))]
        source, sites = sites_of(path, defaults)
        if not sites:
            continue
        places = sites[list(sites)[int(rng.integers(len(sites)))]]
        mutation = as_mutation(path, source, places[int(rng.integers(len(places)))])
        if mutation is not None:
            drawn.setdefault(mutation.name, mutation)
    return list(drawn.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=19)
    arguments = parser.parse_args()
    sys.stdout.write(as_yaml(draw(arguments.count, arguments.seed)))


if __name__ == "__main__":
    main()
