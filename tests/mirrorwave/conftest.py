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


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans of the corner, of four chirps a beam and basic effects."""
    from mirrorwave.cli import main

    path = tmp_path_factory.mktemp("capture") / "corner.mcap"
    command = ["sim", "run", "launch/scenes/corner.yaml", "--out", str(path), "--scans", "2", "--effects", "basic"]
    assert main([*command, "--chirps-per-beam", "4"]) == 0
    return path
