"""Unknown fields and choices: those that stand in their place are listed, wherever the place is."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

import msgspec
import pytest

from msgs.values.known_names import refuse_unknown, with_known_names


class Colour(StrEnum):
    RED = "red"
    DARK_BLUE = "dark-blue"


class Choices(msgspec.Struct, forbid_unknown_fields=True):
    colour: Colour | None = None
    size: tuple[Literal["s", "m"], ...] = ()


class Inner(msgspec.Struct, forbid_unknown_fields=True):
    depth_m: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0
    kind_: str = msgspec.field(name="kind", default="")


class Outer(msgspec.Struct, forbid_unknown_fields=True):
    name: str = ""
    one: Inner | None = None
    many: tuple[Inner, ...] = ()
    pair: tuple[int, Inner] = (0, Inner())
    named: dict[str, Inner] = {}
    deep: dict[str, list[Inner]] = {}


@pytest.mark.parametrize(
    ("value", "known", "place"),
    [
        ({"nmae": "x"}, "name, one, many, pair, named, deep; did you mean 'name'?", None),
        ({"one": {"x": 1}}, "depth_m, kind", "$.one"),
        ({"many": [{}, {"x": 1}]}, "depth_m, kind", "$.many[1]"),
        ({"pair": [1, {"kind_": ""}]}, "depth_m, kind; did you mean 'kind'?", "$.pair[1]"),
        ({"named": {"a": {"x": 1}}}, "depth_m, kind", "$.named[...]"),
        ({"deep": {"a": [{"x": 1}]}}, "depth_m, kind", "$.deep[...][0]"),
        ({"odd`, name": 1}, "name, one, many, pair, named, deep; did you mean 'name'?", None),
    ],
)
def test_the_fields_of_the_place_are_listed(value: object, known: str, place: str | None) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(value, Outer)
    text = with_known_names(caught.value, Outer)
    assert text.endswith(f"; known are {known}" + (f" - at `{place}`" if place else ""))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (
            {"colour": "blue"},
            "Invalid enum value 'blue'; known are red, dark-blue; did you mean 'dark-blue'? - at `$.colour`",
        ),
        ({"size": ["m", "l"]}, "Invalid enum value 'l'; known are m, s - at `$.size[1]`"),
    ],
)
def test_choices_are_listed(value: object, text: str) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(value, Choices)
    assert with_known_names(caught.value, Choices) == text


def test_what_is_unknown_is_refused_before_it_is_converted() -> None:
    refuse_unknown({"named": {"any": {"depth_m": 1.0}}}, Outer, "")
    refuse_unknown({"colour": "red"}, Choices, "")
    with pytest.raises(ValueError, match="colour: unknown 'blue'; known are red, dark-blue"):
        refuse_unknown({"colour": "blue"}, Choices, "")


@pytest.mark.parametrize("value", [{"name": 3}, {"one": {"depth_m": -1.0}}, 3])
def test_other_errors_stay_as_they_are(value: object) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(value, Outer)
    assert with_known_names(caught.value, Outer) == str(caught.value)
