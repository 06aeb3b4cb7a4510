"""Scenes chosen by what is in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from lab.training.data.selection import Selection, kind_counts, parse_selection, select


@dataclass(frozen=True)
class Facts:
    relays: tuple[str, ...]
    objects: tuple[str, ...]
    place: str = "street"


SCENES = [
    Facts(("facade", "container"), ("car",)),
    Facts(("facade",), ("car", "bus", "car")),
    Facts(("brick_wall",), (), "parking_lot"),
    Facts(("container", "container"), ("bus",)),
    Facts((), ("car",)),
]


@pytest.mark.parametrize(
    ("selection", "kept"),
    [
        (Selection(), [4, 0, 1, 2, 3]),
        (Selection(without_relays=("container",)), [4, 1, 2]),
        (Selection(without_objects=("bus",)), [4, 0, 2]),
        (Selection(without_relays=("container",), without_objects=("bus",)), [4, 2]),
        (Selection(only_relays=("container",)), [0, 3]),
        (Selection(only_relays=("container", "brick_wall")), [0, 2, 3]),
        (Selection(only_relays=("container",), without_objects=("bus",)), [0]),
        (Selection(without_places=("street",)), [2]),
    ],
)
def test_scenes_that_are_taken(selection: Selection, kept: list[int]) -> None:
    """In the order they were asked for; facts as a list or by index."""
    order = [4, 0, 1, 2, 3]
    for facts in (SCENES, dict(enumerate(SCENES))):
        found = select(facts, np.array(order), selection)
        assert found.dtype == np.int64
        assert found.tolist() == kept


def test_unknown_kinds_and_empty_selections_are_refused() -> None:
    with pytest.raises(ValueError, match="without relay must be one of brick_wall, container, facade, got 'hedge'"):
        select(SCENES, range(5), Selection(without_relays=("hedge",)))
    with pytest.raises(ValueError, match="only object must be one of bus, car, got 'tram'"):
        select(SCENES, range(5), Selection(only_objects=("tram",)))
    with pytest.raises(ValueError, match="must leave a scene, without relay=container leaves none"):
        select(SCENES, [0, 3], Selection(without_relays=("container",)))


def test_texts() -> None:
    assert parse_selection(["relay=container", "relay=facade", "object=bus"]) == Selection(
        without_relays=("container", "facade"), without_objects=("bus",)
    )
    assert parse_selection(only=["place=street"]) == Selection(only_places=("street",))
    for text in ("container", "wall=container", "relay=", "=container"):
        with pytest.raises(ValueError, match=rf"without must be relay\|object\|place=KIND, got '{text}'"):
            parse_selection([text])


def test_counts_are_of_scenes() -> None:
    """A kind twice in a scene counts once; an imported scene without a place counts nowhere."""
    counts = kind_counts([*SCENES, Facts((), (), "")])
    assert counts["object"] == {"car": 3, "bus": 2}
    assert counts["relay"]["container"] == 2
    assert counts["place"] == {"street": 4, "parking_lot": 1}
