"""Every figure that a test of this folder saves keeps its legends off its data."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from matplotlib.figure import Figure

from tests.mirrorwave.figures import assert_legends_off_data

SAVED: list[Figure] = []


@pytest.fixture(scope="session", autouse=True)
def _recorded() -> Iterator[None]:
    """Figures are noted as they are saved, whoever saves them."""
    save = Figure.savefig

    def noted(self: Figure, *arguments: Any, **options: Any) -> None:
        SAVED.append(self)
        save(self, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", noted)
        yield


@pytest.fixture(autouse=True)
def saved_figures() -> Iterator[list[Figure]]:
    """The figures that this test saved, oldest first; looked at when it ends."""
    # what tests of other folders saved in this process is not this test's
    SAVED.clear()
    yield SAVED
    figures = SAVED.copy()
    SAVED.clear()
    for figure in figures:
        assert_legends_off_data(figure)
