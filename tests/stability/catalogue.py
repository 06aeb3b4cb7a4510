"""The catalogue of hard cases: what each is, how far the naive form is off, how far ours, and the page that lists them.

A case is a test with the marker `hard` and the fixture `errors`:

    @pytest.mark.hard("models.physics.fresnel", "growing exponential written out", 1e-12, "",
                      "rounding of two products")
    def test_opaque_slab_is_a_half_space(errors: Errors) -> None:
        \"\"\"A metre of metal: e^{+4e6} on the way back.\"\"\"
        errors(naive=..., ours=...)

It holds only where ours is within the bound and the naive form is not: a case that is not hard is no case.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Protocol

HEADER = """# Hard cases

Cases in which naive numerics break, each a test in `tests/stability/` that fails unless our form stays within its bound
*and* the naive form does not. Errors are largest deviations from the reference or limit that the bound's source names;
"none" stands for an infinity, a NaN or an exception. Written by `make stability`.
"""
COLUMNS = ("case", "why it is hard", "naive form", "its error", "ours", "bound", "where the bound comes from", "in")


class Errors(Protocol):
    """What a case calls once with its two errors, in the unit of its bound."""

    def __call__(self, *, naive: float, ours: float) -> None:
        """Hold the case, and record it."""


@dataclass(frozen=True)
class Case:
    """One case with its two errors."""

    family: str
    name: str
    why: str
    where: str
    naive_form: str
    naive: float
    ours: float
    bound: float
    unit: str
    source: str

    def hold(self) -> None:
        """Raise `AssertionError` unless ours is within the bound and the naive form is not."""
        assert math.isfinite(self.bound), f"bound must be finite, got {self.bound}"
        assert self.ours <= self.bound, f"ours is off by {self.ours:.3g} {self.unit}, bound {self.bound:.3g}"
        assert not self.naive <= self.bound, f"the naive form is only off by {self.naive:.3g}, bound {self.bound:.3g}"


def cells(case: Case) -> tuple[str, ...]:
    """A case as `COLUMNS`."""
    numbers = (_number(value, case.unit) for value in (case.naive, case.ours, case.bound))
    return (case.name, case.why, case.naive_form, *numbers, case.source, f"`{case.where}`")


def _number(value: float, unit: str) -> str:
    return f"{value:.1e} {unit}".rstrip() if math.isfinite(value) else "none"


def page(cases: Iterable[Case]) -> str:
    """All cases as Markdown, a table a family; the same text for the same errors, whatever order they ran in."""
    ordered = sorted(cases, key=lambda case: (case.family, case.name))
    lines = [HEADER, f"{len(ordered)} cases."]
    for family, members in groupby(ordered, key=lambda case: case.family):
        lines += ["", f"## {family}", "", _row(COLUMNS), "|" + " --- |" * len(COLUMNS)]
        lines += [_row(cells(case)) for case in members]
    return "\n".join(lines) + "\n"


def _row(values: Iterable[str]) -> str:
    return "| " + " | ".join(value.replace("|", "\\|") for value in values) + " |"


def write_page(cases: Iterable[Case], path: Path) -> None:
    """Write the page."""
    path.write_text(page(cases))
