"""Elements of an OpenStreetMap file as libosmium reads them: the newest of each that exists, nodes before ways.

libosmium keeps what JOSM marked as deleted, every version, and knows no node behind its way.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

_KINDS = ("node", "way", "relation")
#: Attributes that are kept of an element, or of what stands in it.
_KEPT = {"node": ("id", "lat", "lon"), "way": ("id",), "relation": ("id",)} | {
    "tag": ("k", "v"), "nd": ("ref",), "member": ("type", "ref", "role"),
}  # fmt: skip


@dataclass
class _Element:
    """One version of an element."""

    #: Its number, and whether it says that the element is deleted.
    version: tuple[int, bool]
    head: str
    children: list[str] = field(default_factory=list)

    @property
    def exists(self) -> bool:
        """Return whether it is not deleted."""
        return not self.version[1]


def plain_osm(content: bytes) -> bytes:
    """Return an OSM file without replaced and deleted elements, in order, ways' own nodes written out."""
    elements = _Elements()
    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = elements.start, elements.end
    parser.StartDoctypeDeclHandler = elements.refuse_type
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise ValueError(f"not OpenStreetMap XML: {error}") from None
    return elements.written()


class _Elements:
    """Elements of a file by kind and id."""

    def __init__(self) -> None:
        self._depth = 0
        self._root = ""
        self._newest: dict[str, dict[str, list[_Element]]] = {kind: {} for kind in _KINDS}
        self._open: _Element | None = None
        self._inline: dict[str, _Element] = {}

    def refuse_type(self, *_: Any) -> None:
        """Refuse entities, which may grow without bound."""
        raise ValueError("not OpenStreetMap XML: a document type is refused")

    def start(self, name: str, attributes: dict[str, str]) -> None:
        """Take the start of an element, or what stands in one."""
        if self._depth == 0 and name != "osm":
            raise ValueError(f"not OpenStreetMap XML: must be <osm>, got <{name[:40]}>")
        if self._depth == 0:
            self._root = _tag(name, attributes, tuple(attributes))
        elif self._depth == 1:
            self._open = self._element(name, attributes) if name in _KINDS else None
        elif self._depth == 2 and self._open is not None and name in _KEPT:
            self._open.children.append(_tag(name, attributes, _KEPT[name]) + "/>")
            if name == "nd" and {"ref", "lat", "lon"} <= attributes.keys():
                node = _tag("node", {**attributes, "id": attributes["ref"]}, _KEPT["node"])
                self._inline[attributes["ref"]] = _Element((0, False), node)
        self._depth += 1

    def end(self, name: str) -> None:
        """Take the end of an element."""
        self._depth -= 1

    def written(self) -> bytes:
        """Return all that exists as XML."""
        self._newest["node"] = {ref: [node] for ref, node in self._inline.items()} | self._newest["node"]
        lines = [f"{self._root}>"]
        for kind, elements in self._newest.items():
            ordered = sorted(elements.items(), key=lambda item: _order(item[0]))
            lines += [_written(kind, same) for _, same in ordered if same[0].exists]
        return "\n".join([*lines, "</osm>"]).encode()

    def _element(self, kind: str, attributes: dict[str, str]) -> _Element:
        """Return a version of an element, kept unless there is a newer one."""
        text = attributes.get("version", "")
        version = int(text) if text.isdecimal() and len(text) < 10 else 0
        exists = attributes.get("action") != "delete" and attributes.get("visible") != "false"
        element = _Element((version, not exists), _tag(kind, attributes, _KEPT[kind]))
        same = self._newest[kind].setdefault(attributes.get("id", ""), [element])
        if element.version > same[0].version:
            same[:] = [element]
        elif element is not same[0] and element.version == same[0].version:
            same.append(element)
        return element


def _order(number: str) -> tuple[bool, int]:
    """Return the place of an id in the order of libosmium: zero, the negative ones of new elements, the others."""
    try:
        return int(number) > 0, abs(int(number))
    except ValueError:
        raise ValueError(f"not OpenStreetMap XML: id must be a whole number, got {number[:40]!r}") from None


def _written(kind: str, same: list[_Element]) -> str:
    """Return an element that Overpass may have given several times, once with its tags and once without."""
    tags = dict.fromkeys(child for element in same for child in element.children if child.startswith("<tag"))
    rest = max(([child for child in element.children if child not in tags] for element in same), key=len)
    return f"{same[0].head}>{''.join([*rest, *tags])}</{kind}>"


def _tag(name: str, attributes: dict[str, str], kept: tuple[str, ...]) -> str:
    words = [f"{key}={quoteattr(attributes[key])}" for key in kept if key in attributes]
    return " ".join([f"<{name}", *words])
