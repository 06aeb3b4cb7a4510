"""Which scenes of a data set count, by what is in them: training without one kind of wall or object, testing on it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol

import msgspec
import numpy as np


class SceneFacts(Protocol):
    """What is known of a scene: a `Scan` or a `Frame`."""

    @property
    def place(self) -> str:
        """Type of place."""

    @property
    def relays(self) -> tuple[str, ...]:
        """Kinds of its walls."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Classes of its objects."""


#: What a scene is chosen by, and how its kinds are read off.
KINDS: dict[str, Callable[[SceneFacts], Iterable[str]]] = {
    "relay": lambda facts: facts.relays,
    "object": lambda facts: facts.objects,
    "place": lambda facts: (facts.place,),
}


class Selection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Scenes with none of the kinds in `without_*` and, where `only_*` names some, with one of those at least."""

    without_relays: tuple[str, ...] = ()
    without_objects: tuple[str, ...] = ()
    without_places: tuple[str, ...] = ()
    only_relays: tuple[str, ...] = ()
    only_objects: tuple[str, ...] = ()
    only_places: tuple[str, ...] = ()

    @property
    def left_out(self) -> tuple[Selection, ...]:
        """For each kind that this selection is without, the selection of the scenes that have it: what to test on."""
        return tuple(
            Selection(**{f"only_{what}s": (kind,)}) for what in KINDS for kind in getattr(self, f"without_{what}s")
        )

    def takes(self, facts: SceneFacts) -> bool:
        """Return whether one scene counts."""
        for what, kinds_of in KINDS.items():
            there = frozenset(kinds_of(facts))
            only = getattr(self, f"only_{what}s")
            if there.intersection(getattr(self, f"without_{what}s")) or (only and not there.intersection(only)):
                return False
        return True


def parse_selection(without: Iterable[str] = (), only: Iterable[str] = ()) -> Selection:
    """A selection from texts WHAT=KIND, such as `relay=container`; raises `ValueError` naming a text that is none."""
    found: dict[str, tuple[str, ...]] = {}
    for verb, texts in (("without", without), ("only", only)):
        for text in texts:
            what, separator, kind = text.partition("=")
            if what not in KINDS or not (separator and kind):
                raise ValueError(f"{verb} must be {'|'.join(KINDS)}=KIND, got {text!r}")
            found[f"{verb}_{what}s"] = (*found.get(f"{verb}_{what}s", ()), kind)
    return Selection(**found)


def select(
    facts: Sequence[SceneFacts] | Mapping[int, SceneFacts], indices: Iterable[int], selection: Selection
) -> np.ndarray:
    """Return those of the scene indices that a selection takes, in their order, int64; `facts[index]` is of one scene.

    Raises `ValueError` for a kind that no scene in `facts` has (the kinds that there are, by name) and where no scene
    is left.
    """
    every = list(facts.values()) if isinstance(facts, Mapping) else list(facts)
    check_kinds(selection, every)
    kept = np.array([index for index in indices if selection.takes(facts[int(index)])], np.int64)
    if not len(kept):
        raise ValueError(f"selection must leave a scene, {_text(selection)} leaves none")
    return kept


def check_kinds(selection: Selection, facts: Iterable[SceneFacts]) -> None:
    """Raise `ValueError` for a kind that no scene has, with those that there are."""
    counts = kind_counts(facts)
    for what in KINDS:
        for verb in ("without", "only"):
            for kind in getattr(selection, f"{verb}_{what}s"):
                if kind not in counts[what]:
                    raise ValueError(f"{verb} {what} must be one of {', '.join(sorted(counts[what]))}, got {kind!r}")


def kind_counts(facts: Iterable[SceneFacts]) -> dict[str, dict[str, int]]:
    """Return in how many scenes each kind of relay, object and place is."""
    counts: dict[str, dict[str, int]] = {what: {} for what in KINDS}
    for one in facts:
        for what, kinds_of in KINDS.items():
            for kind in frozenset(kinds_of(one)) - {""}:
                counts[what][kind] = counts[what].get(kind, 0) + 1
    return counts


def _text(selection: Selection) -> str:
    """Return a selection as it is asked for."""
    parts = [
        f"{verb} {what}={kind}"
        for verb in ("without", "only")
        for what in KINDS
        for kind in getattr(selection, f"{verb}_{what}s")
    ]
    return ", ".join(parts) or "no condition"
