"""The catalogue itself: a case that is not hard, or not held, fails."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from tests.stability.catalogue import Case, page

CASE = Case(
    family="phase",
    name="one",
    why="It is | long.",
    where="models.physics.waveform",
    naive_form="float32",
    naive=0.5,
    ours=1e-9,
    bound=1e-6,
    unit="rad",
    source="rounding",
)


@pytest.mark.parametrize("naive", [1e-5, math.inf, math.nan])
def test_a_case_holds_where_the_naive_form_breaks(naive: float) -> None:
    replace(CASE, naive=naive).hold()


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"ours": 1e-5}, "ours is off by 1e-05 rad"),
        ({"ours": math.nan}, "ours is off by nan"),
        ({"naive": 1e-7}, "the naive form is only off by 1e-07"),
        ({"bound": math.inf}, "bound must be finite"),
    ],
)
def test_others_do_not(changes: dict[str, float], fault: str) -> None:
    with pytest.raises(AssertionError, match=fault):
        replace(CASE, **changes).hold()


def test_page_lists_each_family_in_order() -> None:
    text = page([replace(CASE, family="time", naive=math.inf), replace(CASE, name="two"), CASE])
    assert text == page([CASE, replace(CASE, family="time", naive=math.inf), replace(CASE, name="two")])
    assert text.index("## phase") < text.index("| one |") < text.index("| two |") < text.index("## time")
    assert "3 cases." in text
    assert "| one | It is \\| long. | float32 | 5.0e-01 rad | 1.0e-09 rad | 1.0e-06 rad |" in text
    assert "| float32 | none |" in text
