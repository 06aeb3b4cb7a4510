"""Selection of scenes by their contents: training without one kind of wall or object, testing on it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol

import msgspec
import numpy as np


class SceneFacts(Protocol):
    """Facts of a scene: a `Scan` or a `Frame`."""

    @property
    def place(self) -> str:
        """Type of place."""

    @property
    def relays(self) -> tuple[str, ...]:
        """Kinds of its walls."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Classes of its objects."""


#: Criteria of a selection, and how to read the kinds of a scene.
KINDS: dict[str, Callable[[SceneFacts], Iterable[str]]] = {
    "relay": lambda facts: facts.relays,
    "object": lambda facts: facts.objects,
    "place": lambda facts: (facts.place,),
}


class Selection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Scenes with none of the kinds in `without_*` and, if `only_*` names some, with at least one of those."""

    without_relays: tuple[str, ...] = ()
    without_objects: tuple[str, ...] = ()
    without_places: tuple[str, ...] = ()
    only_relays: tuple[str, ...] = ()
    only_objects: tuple[str, ...] = ()
    only_places: tuple[str, ...] = ()

    def takes(self, facts: SceneFacts) -> bool:
        """Return whether one scene is selected."""
        for criterion, kinds_of in KINDS.items():
            kinds = frozenset(kinds_of(facts))
            only = getattr(self, f"only_{criterion}s")
            if kinds.intersection(getattr(self, f"without_{criterion}s")) or (only and not kinds.intersection(only)):
                return False
        return True


def parse_selection(without: Iterable[str] = (), only: Iterable[str] = ()) -> Selection:
    """Return a selection from texts WHAT=KIND, such as `relay=container`; raises `ValueError` naming an invalid one."""
    fields: dict[str, tuple[str, ...]] = {}
    for verb, texts in (("without", without), ("only", only)):
        for text in texts:
            criterion, separator, kind = text.partition("=")
            if criterion not in KINDS or not (separator and kind):
                raise ValueError(f"{verb} must be {'|'.join(KINDS)}=KIND, got {text!r}")
            fields[f"{verb}_{criterion}s"] = (*fields.get(f"{verb}_{criterion}s", ()), kind)
    return Selection(**fields)


def select(
    facts: Sequence[SceneFacts] | Mapping[int, SceneFacts], indices: Iterable[int], selection: Selection
) -> np.ndarray:
    """Return the scene indices that a selection takes, in their order, int64; `facts[index]` is of one scene.

    Raises `ValueError` for a kind that no scene in `facts` has (naming the existing kinds) and if no scene
    is left.
    """
    every = list(facts.values()) if isinstance(facts, Mapping) else list(facts)
    check_kinds(selection, every)
    kept = np.array([index for index in indices if selection.takes(facts[int(index)])], np.int64)
    if not len(kept):
        raise ValueError(f"selection must leave a scene, {_text(selection)} leaves none")
    return kept


def check_kinds(selection: Selection, facts: Iterable[SceneFacts]) -> None:
    """Raise `ValueError` for a kind that no scene has, naming the existing ones."""
    counts = kind_counts(facts)
    for criterion in KINDS:
        for verb in ("without", "only"):
            for kind in getattr(selection, f"{verb}_{criterion}s"):
                if kind not in counts[criterion]:
                    raise ValueError(
                        f"{verb} {criterion} must be one of {', '.join(sorted(counts[criterion]))}, got {kind!r}"
                    )


def kind_counts(facts: Iterable[SceneFacts]) -> dict[str, dict[str, int]]:
    """Return the number of scenes with each kind of relay, object and place."""
    counts: dict[str, dict[str, int]] = {criterion: {} for criterion in KINDS}
    for scene in facts:
        for criterion, kinds_of in KINDS.items():
            for kind in frozenset(kinds_of(scene)) - {""}:
                counts[criterion][kind] = counts[criterion].get(kind, 0) + 1
    return counts


def _text(selection: Selection) -> str:
    """Return a selection as the text of its options."""
    parts = [
        f"{verb} {criterion}={kind}"
        for verb in ("without", "only")
        for criterion in KINDS
        for kind in getattr(selection, f"{verb}_{criterion}s")
    ]
    return ", ".join(parts) or "no condition"
