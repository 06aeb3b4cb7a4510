"""Every figure that a test of this folder saves keeps its legends off its data; a run directory for one test."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.figures import recorded, saved_figures

__all__ = ["recorded", "saved_figures"]


@pytest.fixture
def quiet_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A run directory in which no graph runs, its name short enough for sockets."""
    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", folder)
        yield Path(folder)
