"""The notebook runs from its first cell to its last."""

from __future__ import annotations

import nbclient
import nbformat
import pytest

from tests.docs.pages import ROOT


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
def test_the_notebook_runs() -> None:
    notebook = nbformat.read(ROOT / "docs" / "examples" / "scan_to_bev.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(ROOT)}}).execute()
    pictures = [
        output for cell in notebook.cells for output in cell.get("outputs", []) if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == 5
